"""What is known beside the data, in units of the free variables: a number about right, neighbours alike."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from diffsim_ti.identification.unknowns import Free


@dataclass(frozen=True)
class Normal:
    """t is normal around t(mean) with this deviation: relative where an unknown is a logarithm (0.1 for ten per cent).

    Tarantola, Inverse Problem Theory, 2005, sec. 3.2, doi:10.1137/1.9780898717921.
    """

    mean: float
    deviation: float

    def rows(self, free: "Free", mesh) -> tuple[np.ndarray, np.ndarray]:
        """(R, r): R t - r has unit deviation."""
        return np.eye(free.size) / self.deviation, free.free(self.mean) / self.deviation


@dataclass(frozen=True)
class Smooth:
    """Jumps of t across inner faces, weighted by the square root of the face's area over the mean, are normal.

    edges=True: total variation, smoothed: a jump costs 2 (sqrt(1 + z^2) - 1), z = jump / deviation, so that sharp edges
    stay sharp. Rudin, Osher, Fatemi 1992, doi:10.1016/0167-2789(92)90242-F.
    """

    deviation: float
    edges: bool = False

    def rows(self, free: "Free", mesh) -> tuple[np.ndarray, np.ndarray]:
        """(R, r), a row for each inner face whose two sides lie in different groups."""
        groups = next(iter(free.rows.values()))
        if groups.shape != (mesh.num_tetrahedra,):
            raise ValueError(f"{free.label}: a smoothing prior needs regions or 'each', numbers of tetrahedra")
        pairs, areas = inner_faces(mesh)
        a, b = groups[pairs].T
        kept = (a != b) & (a >= 0) & (b >= 0)
        R = np.zeros((kept.sum(), free.size))
        weight = np.sqrt(areas[kept] / areas.mean()) / self.deviation
        at = np.arange(len(R))
        R[at, a[kept]], R[at, b[kept]] = weight, -weight
        base = free.free(1.0) if free.kind == "log" else 0.0 * free.start  # starts may differ: jumps are those of log x
        return R, R @ (base - base.mean()) if np.ptp(base) else np.zeros(len(R))


def inner_faces(mesh) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of tetrahedra that share a face, shape (k, 2), and the areas of these faces [m^2]."""
    corners = mesh.tetrahedra[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3)
    order = np.lexsort(np.sort(corners, 1).T)
    same = np.all(np.diff(np.sort(corners, 1)[order], axis=0) == 0, 1)
    first, second = order[:-1][same], order[1:][same]
    a, b, c = np.moveaxis(mesh.vertices[corners[first]], 1, 0)
    return np.stack([first // 4, second // 4], 1), np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


class Priors:
    """All priors on the free variables as rows R t - r, and the weight of each row at the present t."""

    def __init__(self, priors: dict | None, unknowns: list["Free"], mesh):
        size, parts, right, edges = sum(free.size for free in unknowns), [], [], []
        labels = [free.label for free in unknowns]
        for label, given in (priors or {}).items():
            if label not in labels:
                raise ValueError(f"prior: no unknown named {label!r}; there are {', '.join(labels)}")
            k = labels.index(label)
            start = sum(free.size for free in unknowns[:k])
            for one in given if isinstance(given, list | tuple) else [given]:
                rows, r = one.rows(unknowns[k], mesh)
                wide = np.zeros((len(rows), size))
                wide[:, start : start + unknowns[k].size] = rows
                parts.append(wide), right.append(r), edges.append(np.full(len(r), getattr(one, "edges", False)))
        self.R = np.concatenate(parts) if parts else np.zeros((0, size))
        self.r = np.concatenate(right) if parts else np.zeros(0)
        self.edges = np.concatenate(edges) if parts else np.zeros(0, bool)

    def cost(self, t: np.ndarray) -> float:
        """Sum of squares, or of what stands for them."""
        z = self.R @ t - self.r
        return float(np.where(self.edges, 2 * (np.sqrt(1 + z**2) - 1), z**2).sum())

    def weights(self, t: np.ndarray) -> np.ndarray:
        """w: half the cost's gradient is R^T w z, and R^T w R stands for half its Hessian."""
        return np.where(self.edges, 1 / np.sqrt(1 + (self.R @ t - self.r) ** 2), 1.0)

    def gradient(self, t: np.ndarray) -> np.ndarray:
        return self.R.T @ (self.weights(t) * (self.R @ t - self.r))
