"""What is known beside the data, in units of the free variables: a number about right, neighbours alike."""

from dataclasses import dataclass

import numpy as np

from diffsim_ti.common.public import Public
from diffsim_ti.identification.unknowns import Free
from diffsim_ti.mesh.geometry import inner_faces, triangle_normals


@dataclass(frozen=True)
class Normal(metaclass=Public):
    """t is normal around t(mean) with this deviation: relative where an unknown is a logarithm (0.1 for ten per cent).

    Tarantola, Inverse Problem Theory, 2005, sec. 3.2, doi:10.1137/1.9780898717921.
    """

    mean: float
    deviation: float

    def rows(self, free: Free, mesh) -> tuple[np.ndarray, np.ndarray]:
        """(R, r): R t - r has unit deviation."""
        return np.eye(free.size) / self.deviation, free.free(self.mean) / self.deviation


@dataclass(frozen=True)
class Smooth(metaclass=Public):
    """Jumps of t across inner faces, weighted by the square root of the face's area over the mean, are normal.

    edges=True: total variation, smoothed: a jump costs 2 (sqrt(1 + z^2) - 1), z = jump / deviation, so that sharp edges
    stay sharp. Rudin, Osher, Fatemi 1992, doi:10.1016/0167-2789(92)90242-F.
    """

    deviation: float
    edges: bool = False

    def rows(self, free: Free, mesh) -> tuple[np.ndarray, np.ndarray]:
        """(R, r), a row for each inner face whose two sides lie in different groups."""
        groups = next(iter(free.rows.values()))
        if groups.shape != (mesh.num_tetrahedra,):
            raise ValueError(f"{free.label}: a smoothing prior needs regions or 'each', numbers of tetrahedra")
        pairs, faces = inner_faces(mesh.tetrahedra, mesh.num_vertices)
        areas = np.linalg.norm(triangle_normals(mesh.vertices, faces), axis=1)
        a, b = groups[pairs].T
        kept = (a != b) & (a >= 0) & (b >= 0)
        R = np.zeros((kept.sum(), free.size))
        weight = np.sqrt(areas[kept] / areas.mean()) / self.deviation
        at = np.arange(len(R))
        R[at, a[kept]], R[at, b[kept]] = weight, -weight
        base = free.free(1.0) if free.kind == "log" else 0.0 * free.start  # starts may differ: jumps are those of log x
        return R, R @ (base - base.mean()) if np.ptp(base) else np.zeros(len(R))


class Priors:
    """All priors on the free variables as rows R t - r, and the weight of each row at the present t."""

    def __init__(self, priors: dict | None, unknowns: list[Free], mesh):
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
        """w: half the cost's gradient is R^T w z."""
        return np.where(self.edges, 1 / np.sqrt(1 + (self.R @ t - self.r) ** 2), 1.0)

    def hessian(self, t: np.ndarray) -> np.ndarray:
        """What stands for half the cost's Hessian."""
        return (self.R.T * self.weights(t)) @ self.R

    def gradient(self, t: np.ndarray) -> np.ndarray:
        return self.R.T @ (self.weights(t) * (self.R @ t - self.r))
