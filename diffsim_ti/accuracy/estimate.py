"""The error of a number of a run, by what makes it: mesh, steps, solver, rounding."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.accuracy.finer import interpolation, rollout_on_finer
from diffsim_ti.accuracy.replay import Replay
from diffsim_ti.common.brief import brief_fields
from diffsim_ti.common.checked import as_numbers
from diffsim_ti.common.names import no_such
from diffsim_ti.common.public import Public
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.scene.locking import LOCKING_RATIO
from diffsim_ti.state.schedule import UnequalSteps
from diffsim_ti.terms import Robot, SelfContact

if TYPE_CHECKING:
    from diffsim_ti.rollout import Frames, Rollout

CANCELS = 2.5  # times the estimate: where as much would be there if nothing cancelled, it is small by chance
COARSE = 0.25  # of the number's change: errors are mostly estimated too small where they are larger
SMALL = 1e-6  # of the number's change: what is less is left over by solvers
# what estimates miss, as shares of them and of what would be there if nothing cancelled, as random problems say
# (examples/benchmarks/random_error_bars.py)
MISSED, CANCELLED = 1 / 2, 1 / 6
FEW, MOST = 0.05, 0.5  # where so few elements have so much of the error, something is singular there
PER_VERTEX = ("positions", "velocities", "displacements")  # outputs that count vertices, of which a finer mesh has more


@dataclass(repr=False)
class Accuracy(metaclass=Public):
    """How accurate a number of a run is; what `Rollout.accuracy` returns. Errors are those of `value`: value less truth.

    value: the number on the rollout's own mesh, in its own steps and precision; size: how much the corrected value differs
        from that of the first frame.
    mesh: what the mesh costs; the number of elements of ten nodes, or of halved edges, is taken for the truth.
    step: what steps of this length cost (zero of equilibria). solver: what the solver's tolerance leaves.
    rounding: what rounding may cost: of float32 the distance from float64, of float64 a bound without sign; of explicit
        steps as if each rounded the number.
    uncancelled: {"mesh": ..., "step": ...}, how large these would be if nothing cancelled: errors of all components and
        places of the output, by the size of their weights, of all frames or, if that is more, in any frame.
    shares: of `mesh` by tetrahedron; their sum is `mesh`. `save_picture(path, mesh, positions, accuracy.shares)` shows them.
    cost: seconds of the run itself and of the finer mesh; unknowns of both.
    doubts: why the estimate may be off, in words, by name: "singular", "mesh cancels", "step cancels", "unplaced",
        "contact", "locking", "coarse".
    """

    output: str
    value: float
    size: float
    mesh: float
    step: float
    solver: float
    rounding: float
    uncancelled: dict
    shares: np.ndarray = field(repr=False)
    cost: dict
    doubts: dict[str, str] = field(default_factory=dict)

    __repr__ = brief_fields

    @property
    def error(self) -> float:
        """What has a sign of the error, added up: value less truth."""
        return self.mesh + self.step + self.solver

    @property
    def bar(self) -> float:
        """How far the truth may be from the value: 1.5 (|mesh| + |step|) + |solver| + |rounding|, and a sixth of the sum of
        `uncancelled`. Where nothing cancels that is (|mesh| + |step|) / 0.6. It is no bound: of random problems on coarse
        meshes it held the error in 93 % (examples/benchmarks/random_error_bars.py)."""
        apart, rest = abs(self.mesh) + abs(self.step), abs(self.solver) + abs(self.rounding)
        return (1 + MISSED) * apart + CANCELLED * sum(self.uncancelled.values()) + rest

    @property
    def corrected(self) -> float:
        """The value less its estimated error."""
        return self.value - self.error

    @property
    def relative(self) -> float:
        """Size of the error, with rounding, over that of the number's change."""
        return (abs(self.error) + abs(self.rounding)) / max(self.size, np.finfo(float).tiny)

    def __str__(self) -> str:
        cost = self.cost
        lines = [
            f"{self.output}: {self.value:.6g}, bar {self.bar:.2g}, off by {self.error:+.2g} ({self.relative:.2g} of its "
            f"change); corrected {self.corrected:.6g}",
            f"  mesh {self.mesh:+.2g} by {cost['finer unknowns']} unknowns in {cost['finer']:.2g} s (the "
            f"run: {cost['unknowns']} in {cost['run']:.2g} s)",
            f"  step {self.step:+.2g}, solver {self.solver:+.2g}, rounding {self.rounding:.2g}",
        ]
        return "\n".join([*lines, *(f"  {doubt}" for doubt in self.doubts.values())])


class Number:
    """A number J of a run: sum of weights times an output in the last frame, or in all; or a loss of it.

    weights: of the output's shape in a frame (or something that stretches to it), or of all frames; or a function of the
    output's values that returns the loss and its derivative by them.
    """

    def __init__(self, rollout: "Rollout", output: str, weights: ArrayLike | Callable | None):
        if output not in rollout.outputs:
            raise ValueError(no_such("output", output, rollout.outputs, "this rollout"))
        self.output, self.loss = output, None
        self.shape = shape = tuple(rollout.outputs[output].shape(rollout.num_frames))
        self.count = rollout.scene.mesh.num_vertices if output in PER_VERTEX else None
        if callable(weights):
            self.loss = weights
            return
        if weights is None and int(np.prod(shape[1:])) != 1:
            raise ValueError(
                f"accuracy is of one number, and {output} has shape {shape[1:]} in a frame: pass weights of this shape, "
                "whose products with it add up to the number"
            )
        w = np.ones(()) if weights is None else as_numbers("weights", weights)
        try:
            if w.shape == shape:
                self.weights = w
            else:
                self.weights = np.zeros(shape)
                self.weights[-1] = np.broadcast_to(w, shape[1:])
        except ValueError:
            raise ValueError(f"weights: expected shape {shape[1:]} or {shape}, got {w.shape}") from None

    def _own(self, y: np.ndarray) -> np.ndarray:
        """Of values on whatever mesh those that this mesh's have."""
        return y if self.count is None else y[:, : self.count]

    def start(self, frames: "Frames") -> float:
        """J if all frames were the first."""
        own = self._own(np.asarray(frames[self.output], np.float64))
        own = np.broadcast_to(own[:1], own.shape)
        return float(self.loss(own)[0] if self.loss else (self.weights * own).sum())

    def of(self, frames: "Frames") -> tuple[float, np.ndarray]:
        """(J, its derivative by the output) of frames on this mesh or a finer one, whose first vertices are its own."""
        y = np.asarray(frames[self.output], np.float64)
        seed = np.zeros_like(y)
        own = self._own(y)
        if own.shape != self.shape:
            raise ValueError(
                f"{self.output} has shape {own.shape} on a finer mesh: take an output of places or sets, such as "
                "MaterialPoints, or Stress at points"
            )
        value, slope = self.loss(own) if self.loss else ((self.weights * own).sum(), self.weights)
        self._own(seed)[...] = slope
        return float(value), seed

    def largest(self, frames: "Frames", others: "Frames") -> float:
        """The difference of two runs if none of it cancelled: products of the sizes of weights and of differences at each
        place, components together, summed over all frames or, if that is more, in any frame by the weights of the last
        that has some."""
        slope, *both = self.of(frames)[1], *(np.asarray(x[self.output], np.float64) for x in (frames, others))
        slope, y, z = (self._own(x) for x in (slope, *both))
        places = 1 if slope.shape[1:] == (3,) else (*slope.shape, 1)[1]  # a vector, or what is at places
        slope, apart = (np.linalg.norm(x.reshape(len(x), places, -1), axis=2) for x in (slope, y - z))
        last = slope.any(1).nonzero()[0].max(initial=0)
        return float(max((slope * apart).sum(), (apart[: last + 1] @ slope[last]).max()))


def accuracy(
    rollout: "Rollout",
    output: str,
    weights: ArrayLike | Callable | None = None,
    finer: Callable[[TetrahedralMesh], TetrahedralMesh] | None = None,
    values: dict | None = None,
) -> Accuracy:
    """See Rollout.accuracy."""
    return estimated(rollout, Number(rollout, output, weights), finer, dict(values or {}))[0]


def estimated(
    rollout: "Rollout", number: Number, finer: Callable | None, values: dict, given: list | None = None
) -> tuple[Accuracy, Replay]:
    """(the accuracy of a number, the run that it is of, in float64); given: displacements of each pass to begin with."""
    begin = time.perf_counter()
    value, own, frames = _run(rollout, number, values, given)
    seconds, begin = time.perf_counter() - begin, time.perf_counter()
    finer = finer or (TetrahedralMesh.quadratic if rollout.scene.mesh.order == 1 else TetrahedralMesh.refined)
    mesh, solver, shares, exact = _of_mesh(own, frames, number, values, finer)
    cost = dict(run=seconds, finer=time.perf_counter() - begin, unknowns=3 * rollout.scene.mesh.num_vertices)
    cost["finer unknowns"] = 3 * exact["vertices"]
    if rollout.scene.precision == "f32":
        rounding = value - number.of(frames)[0]
    else:
        rounding = exact["rounding"]
    step, most = _of_steps(own, frames, number, values)
    size = abs(value - mesh - step - solver - number.start(frames))
    errors = dict(mesh=mesh, step=step, solver=solver, rounding=rounding)
    errors["uncancelled"] = dict(mesh=exact["uncancelled"], step=most)
    found = Accuracy(number.output, value, size or abs(value), **errors, shares=shares, cost=cost)
    found.doubts = _doubts(rollout.scene, found, exact)
    return found, own


def _run(rollout: "Rollout", number: Number, values: dict, given: list | None) -> tuple:
    """(J of the rollout, Replay of it in float64, its frames), without options that change gradients or hide errors."""
    plain = dict(gradients="initial_positions", runs=None, clip=None, truncate=None, health=False, raise_errors=True)
    own, value = rollout.on(rollout.solver, **plain), None
    if rollout.scene.precision == "f32":
        value = number.of(own.forward(**values))[0]
        own = own.with_scene(precision="f64")
    replay = Replay(own, given, solves=True)
    frames = own.forward(**values)
    return number.of(frames)[0] if value is None else value, replay, frames


def on_finer_mesh(rollout: "Rollout", finer: Callable, values: dict, **solver) -> tuple:
    """(the rollout on the finer mesh, values of inputs there, the matrix P that carries fields, parents of tetrahedra);
    solver: arguments of the solver that are others there."""
    fine = rollout_on_finer(rollout, finer, values, **solver)
    mesh, coarse = fine.scene.mesh, rollout.scene.mesh
    P, parents = interpolation(mesh), np.arange(coarse.num_tetrahedra)
    if mesh.refinement is not None:
        parents = mesh.refinement.parents
    there = {}
    for name, x in values.items():
        if name in ("initial_positions", "initial_velocities", "rest_positions", "shape") and np.ndim(x) == 2:
            x = P @ np.asarray(x)
        elif mesh.refinement is not None and name in (*rollout.scene.material.inputs, "density"):
            x = mesh.refinement.spread(x)
        there[name] = x
    return fine, there, P, parents


def _of_mesh(own: Replay, frames: "Frames", number: Number, values: dict, finer: Callable) -> tuple:
    """(error of the mesh, of the solver's tolerance, shares of the first by tetrahedron, other numbers)"""
    scene, solver, tight = own.rollout.scene, own.rollout.solver, {}
    if not solver.explicit:
        tight = dict(tolerance=max(0.01 * solver.tolerance, 1e-12))  # so that its own does not count
    fine, there, P, parents = on_finer_mesh(own.rollout, finer, values, **tight)
    value, seed = number.of(frames)
    n, mesh, eps = scene.mesh.num_vertices, fine.scene.mesh, np.finfo(float).eps
    replay, residuals = Replay(fine, [P @ u for u in own.each("places")]), ()
    nodal, rounding, of_solver, unplaced = np.zeros(mesh.num_vertices), eps * abs(value), 0.0, ""
    if solver.explicit or scene.has_multipliers or scene.term(Robot):  # `Replay` does not have all of their residual
        unplaced = "explicit steps, robots and what is held exactly have no residual by vertices on the finer mesh"
        rounding *= own.rollout.sweep.num_passes
        if tight:
            of_solver = number.of(own.rollout.on(solver.for_scene(scene, **tight)).forward(**values))[0] - value
    else:
        own.rollout.vjp(frames, **{number.output: seed})
        of_solver, sizes = own.estimate(), zip(own.each("sizes"), own.each("weights"))
        rounding += eps * sum(float((np.reshape(f, (n, -1)) * np.abs(z)).sum()) for f, z in sizes)
        try:
            fine.forward(**there)
            residuals = replay.each("residuals")
        except FloatingPointError:  # such as one in an obstacle
            unplaced = "states of the run are none of the finer mesh"
    replay.solves = True
    at = fine.forward(**there)
    exact, slope = number.of(at)
    if residuals:
        try:
            fine.vjp(at, **{number.output: slope})
            of_own = own.each("residuals"), own.each("weights")
            for R, z, R_own, z_own in zip(residuals, replay.each("weights"), *of_own):
                nodal += (R * (z - P @ z_own)).sum(1)
                nodal[:n] += ((P.T @ R - R_own) * z_own).sum(1)
        except FloatingPointError:  # beyond a limit point
            unplaced = "the finer mesh has no adjoint"
    shares = _by_element(mesh, -nodal, parents, scene.mesh.num_tetrahedra)
    sizes = np.abs(shares) if shares.any() else scene.mesh.volumes
    error = value - exact + of_solver
    shares = shares + (error - shares.sum()) * sizes / sizes.sum()  # what is of no place, and not of first order
    contact = bool(scene.obstacles or scene.term(SelfContact))
    known = dict(vertices=mesh.num_vertices, rounding=rounding, contact=contact, unplaced=unplaced)
    known["uncancelled"] = max(abs(error), number.largest(frames, at))
    return error, 0.0 - of_solver, shares, known


def _by_element(mesh: TetrahedralMesh, nodal: np.ndarray, parents: np.ndarray, count: int) -> np.ndarray:
    """What vertices of the finer mesh have, in equal parts to the elements around, added up in coarse tetrahedra.

    Richter, Wick 2015, Variational localizations of the dual weighted residual estimator, doi:10.1016/j.cam.2014.11.008.
    """
    around = np.bincount(mesh.elements.ravel(), minlength=mesh.num_vertices)
    each = (nodal / np.maximum(around, 1))[mesh.elements].sum(1)
    return np.bincount(parents, each, count)


def _of_steps(own: Replay, frames: "Frames", number: Number, values: dict) -> tuple[float, float]:
    """Error of the steps, and that if nothing of it cancelled: by steps of half the length, and the order of the solver."""
    rollout, solver = own.rollout, own.rollout.solver
    if not solver.order:
        return 0.0, 0.0
    if rollout.schedule is not None:
        finer = solver.on(UnequalSteps(rollout.schedule.lengths, 2 * np.asarray(rollout.schedule.substeps)))
    else:
        finer = solver.for_scene(rollout.scene, substeps=2 * solver.substeps)
    halved, part = rollout.on(finer).forward(**values), 1 - 0.5**solver.order
    step = (number.of(frames)[0] - number.of(halved)[0]) / part
    return step, max(abs(step), number.largest(frames, halved) / part)


def _doubts(scene, found: Accuracy, exact: dict) -> dict[str, str]:
    """What may make an estimate of the mesh's error wrong, in words, by name."""
    doubts, sizes = {}, np.sort(np.abs(found.shares))[::-1]
    few = max(1, int(FEW * len(sizes)))
    matters = abs(found.mesh) > SMALL * found.size
    if matters and len(sizes) >= 1 / FEW and sizes[:few].sum() > MOST * sizes.sum():
        doubts["singular"] = (
            f"{few} of {len(sizes)} tetrahedra have more than half of the error: near what is singular, such as corners "
            "that point inwards and ends of supports, errors fall slowly, and this one may be larger than estimated: refine "
            "there, as ds.refine does"
        )
    for name, remedy in dict(mesh="refine the mesh once", step="halve the steps").items():
        size = found.uncancelled[name]
        if size > max(CANCELS * abs(getattr(found, name)), 0.1 * abs(found.error), SMALL * found.size):
            doubts[f"{name} cancels"] = (
                f"errors of the {name} cancel: those of all components in the frames add up to {size:.2g}, and the estimate "
                f"may be wrong by as much as its own size: {remedy}, and compare"
            )
    if exact["unplaced"]:
        doubts["unplaced"] = (
            f"{exact['unplaced']}: shares are by volume alone, and do not say whether the error is near what is singular, "
            "where it may be larger than estimated"
        )
    if exact["contact"]:
        doubts["contact"] = (
            "parts in contact: the estimate is of the finer mesh's own contacts, and jumps where these change"
        )
    locks = scene.mesh.order == 1 and scene.volume == "tetrahedra"
    if matters and locks and scene.largest_poissons_ratio() > LOCKING_RATIO + 1e-12:
        doubts["locking"] = (
            "the mesh locks (Poisson's ratio above 0.45), and ten nodes do so a little: the error may be larger"
        )
    if abs(found.mesh) > COARSE * found.size:
        doubts["coarse"] = "the mesh is too coarse for this number: its error is more than a quarter of its change"
    return doubts
