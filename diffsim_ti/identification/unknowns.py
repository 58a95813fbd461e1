"""What is looked for: numbers of inputs, each as a free variable without bounds, spread over the input by regions; and what
is known of them beside the data, in units of the free variables."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.brief import brief
from diffsim_ti.common.checked import numbers, shape_of, shown
from diffsim_ti.common.public import Public
from diffsim_ti.differentiation.arrays import Recorded, forward
from diffsim_ti.mesh.geometry import inner_faces, triangle_normals
from diffsim_ti.rollout import Rollout

TIME_OFFSET = "time_offset"  # of measurements with times of their own [s]
EDGE = 7.0  # |s| of bounded numbers at most: a thousandth of their range from its ends, from where they still come back


class Unknown(metaclass=Public):
    """Numbers x of an input, found through free variables t in which no bound exists:

        logarithm  x = start exp(t)                      (default where start > 0)
        bounded    x = low + (high - low) / (1 + e^-s),  s = t + s(start)    (with `range`; |s| is at most 7, but of torch)
        linear     x = start + scale t                   (with `scale`, and where start <= 0)

    start: a guess, one number or one per group, or of the input's shape, which then are numbers of their own. range: (low,
    high). scale: a change that matters, in the input's unit, one or one for each number.
    regions: names of the mesh's sets of tetrahedra, a number for each, what lies in none keeps the scene's value; "each" for
    one per tetrahedron; or whole numbers of the input's shape, equal ones for what changes together, -1 for what is fixed.
    input: its name; default the unknown's own. "time_offset" [s] is added to the times of measurements,
    which it keeps within those of the run.
    experiments: indices of the rollouts that it acts in; default all.
    Errors are ValueErrors before any run. Seber, Wild, Nonlinear Regression, 1989, sec. 2.8, on such transformations.
    """

    def __init__(
        self,
        start: ArrayLike,
        range: tuple[float, float] | None = None,
        regions: str | Iterable[str] | ArrayLike | None = None,
        input: str | None = None,
        scale: ArrayLike | None = None,
        experiments: Iterable[int] | None = None,
    ):
        self.start, self.range, self.regions, self.input = numbers("Unknown: start", start), range, regions, input
        self.scale, self.experiments = scale, None if experiments is None else tuple(experiments)
        if range is not None and (shape_of("Unknown: range", range) != (2,) or isinstance(range, str | dict)):
            raise ValueError(f"Unknown: range must be two numbers (low, high), got {shown(range)}")
        if range is not None and not np.all(np.isfinite(range)):
            raise ValueError(
                f"Unknown: range must be finite, got {shown(range)}; a start > 0 alone is searched by its logarithm"
            )
        if range is not None and not (range[0] < self.start.min() and self.start.max() < range[1]):
            raise ValueError(f"Unknown: start = {self.start} must lie inside range = {range}")
        if range is not None and scale is not None:
            raise ValueError("Unknown: give range or scale, not both")

    def __repr__(self) -> str:
        given = {name: x for name, x in vars(self).items() if x is not None}
        return f"Unknown({', '.join(f'{name}={brief(x)}' for name, x in given.items())})"


class Free:
    """An unknown of given experiments: `size` variables t, their numbers x, and where these go in the input."""

    def __init__(self, unknown: Unknown, label: str, rollouts: list[Rollout]):
        self.label, self.input, self.unknown = label, unknown.input or label, unknown
        self.experiments = range(len(rollouts)) if unknown.experiments is None else unknown.experiments
        if not self.experiments or not set(self.experiments) <= set(range(len(rollouts))):
            said = f"one or more indices in 0..{len(rollouts) - 1}, got {list(self.experiments)}"
            raise ValueError(f"{label}: experiments must be {said}")
        self.rows = {k: self._groups(rollouts[k]) for k in self.experiments}
        self.is_offset = self.input == TIME_OFFSET
        self.size = 1 + max(int(rows.max(initial=0)) for rows in self.rows.values())
        given = unknown.start.ravel()
        if given.shape not in ((1,), (self.size,)):
            shapes = {rollouts[k].values[self.input].shape for k in self.experiments if not self.is_offset}
            each = self.size if unknown.regions is not None else f"the input's shape, {shapes.pop()}" if shapes else 1
            raise ValueError(f"{label}: start has shape {unknown.start.shape}, expected one number or {each}")
        self.start = np.broadcast_to(given, (self.size,)).astype(float)
        scale, is_log = unknown.scale, unknown.scale is None and unknown.range is None and np.all(self.start > 0)
        if scale is not None:
            if np.size(scale) not in (1, self.size):
                raise ValueError(f"{label}: scale has shape {np.shape(scale)}, expected one number or {self.size}")
            self.scale = np.broadcast_to(np.ravel(np.asarray(scale, float)), (self.size,))
            if not (np.all(np.isfinite(self.scale)) and np.all(self.scale != 0)):
                raise ValueError(f"{label}: scale must be finite and not 0, got {shown(scale)}")
        self.kind = "bounded" if unknown.range is not None else "log" if is_log else "linear"
        if self.kind == "linear" and scale is None:
            raise ValueError(
                f"{label}: start = {unknown.start} has no logarithm; give range or scale [the input's unit]"
            )

    def _groups(self, rollout: Rollout) -> np.ndarray:
        regions, mesh = self.unknown.regions, rollout.scene.mesh
        if self.input == TIME_OFFSET:
            return np.zeros((), int)
        if self.input not in rollout.inputs:
            said = rollout.scene.inputs.no_input(self.input, "this rollout", rollout.inputs)
            raise ValueError(f"{self.label}: {said}")
        if regions is None:
            shape = rollout.values[self.input].shape
            each = self.unknown.start.ndim > 0 and self.unknown.start.shape == shape
            return np.arange(self.unknown.start.size).reshape(shape) if each else np.zeros(shape, int)
        if isinstance(regions, str) and regions == "each":
            return np.arange(mesh.num_tetrahedra)
        named = [regions] if isinstance(regions, str) else list(regions) if not isinstance(regions, np.ndarray) else []
        if named and all(isinstance(name, str) for name in named):
            rows = np.full(mesh.num_tetrahedra, -1)
            for k, name in enumerate(named):
                if name not in mesh.tetrahedron_sets:
                    known = ", ".join(mesh.tetrahedron_sets) or "none"
                    raise ValueError(f"{self.label}: no set of tetrahedra named {name!r}; the mesh has {known}")
                rows[mesh.tetrahedron_sets[name]] = k
            return rows
        rows = np.asarray(regions, int)
        if rows.shape not in (rollout.values[self.input].shape, (mesh.num_tetrahedra,)):
            shape = rollout.values[self.input].shape
            raise ValueError(f"{self.label}: regions have shape {rows.shape}, the input {shape}")
        return rows

    @property
    def _at_start(self) -> np.ndarray:
        """s of bounded numbers at the start."""
        low, high = self.unknown.range
        return np.log((self.start - low) / (high - self.start))

    def numbers(self, t: np.ndarray) -> np.ndarray:
        """x(t); t may record."""
        if self.kind == "log":
            return self.start * np.exp(t)
        if self.kind == "linear":
            return self.start + self.scale * t
        low, high = self.unknown.range
        return low + (high - low) / (1 + np.exp(-(t + self._at_start)))

    def slopes(self, t: np.ndarray) -> np.ndarray:
        """dx/dt"""
        t = Recorded(t)
        return forward(self.numbers(t), [(t, np.ones(self.size))])

    def free(self, x: ArrayLike) -> np.ndarray:
        """t(x)"""
        x = np.broadcast_to(np.asarray(x, float), (self.size,))
        if self.kind == "log":
            return np.log(x / self.start)
        if self.kind == "linear":
            return (x - self.start) / self.scale
        low, high = self.unknown.range
        return np.log((x - low) / (high - x)) - self._at_start

    def reach(self) -> np.ndarray:
        """The least and the largest t of each number, shape (2, size)."""
        if self.kind != "bounded":
            return np.outer((-np.inf, np.inf), np.ones(self.size))
        return np.stack([np.minimum(-EDGE - self._at_start, 0.0), np.maximum(EDGE - self._at_start, 0.0)])

    def spread(self, k: int, x: np.ndarray, into: np.ndarray) -> np.ndarray:
        """The input of experiment k with these numbers where they go, and `into` elsewhere."""
        rows = self.rows[k]
        return np.where(rows < 0, np.broadcast_to(into, rows.shape), x[rows])

    def gathered(self, k: int, gradient: np.ndarray) -> np.ndarray:
        """The transpose of `spread` in x."""
        rows = self.rows[k].ravel()
        kept = rows >= 0
        return np.bincount(rows[kept], np.broadcast_to(gradient, self.rows[k].shape).ravel()[kept], self.size)


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
                with np.errstate(invalid="ignore", divide="ignore"):
                    rows, r = one.rows(unknowns[k], mesh)
                if not (np.isfinite(rows).all() and np.isfinite(r).all()):
                    raise ValueError(
                        f"prior of {label}: {one!r} lies where the unknown cannot be, or its deviation is 0"
                    )
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
