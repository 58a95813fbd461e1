"""Speed against accuracy: solvers x steps x precision x meshes on one problem, timed back to back, with the Pareto front."""

import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from diffsim_ti.common.brief import brief_fields
from diffsim_ti.common.progress import progress
from diffsim_ti.common.public import public
from diffsim_ti.rollout import Rollout
from diffsim_ti.scene import Scene
from diffsim_ti.solvers import SOLVERS, StaticSolver, VelocityVerletSolver, stable_dt
from diffsim_ti.solvers.solver import Solver
from diffsim_ti.study.charts import without_nan
from diffsim_ti.study.executors import each
from diffsim_ti.study.problem import VARIANTS, Problem, distance

# wall time per tetrahedron and substep, before anything was measured [s]; with gradients three times as much
GUESS = {True: 6e-8, False: 1e-5}
HOPELESS = 30  # times as long as the front at the same error: a solver that takes that on a mesh skips the larger ones
SHARE = 0.8  # of the stable step at the start, with which explicit solvers begin: elements get squeezed on the way


@dataclass
class Point:
    """One run: what it was, how long it took (compile time apart), how far off it was; `said`: why it gave no number."""

    solver: str
    cells: int
    pattern: str
    element: str
    precision: str
    tetrahedra: int
    substep: float  # [s]
    substeps: int
    seconds: float = np.nan  # wall time per simulated second, or per equilibrium
    error: float = np.nan
    first_call: float = np.nan  # [s], with compiling
    said: str = ""
    on_front: bool = False

    @property
    def order(self) -> int:
        """Of the elements."""
        return VARIANTS[self.element].get("order", 1)

    @property
    def label(self) -> str:
        """Mesh and step in words, as charts show them."""
        mesh = f"{self.cells} cells {self.pattern}" if self.cells > 1 else self.pattern
        mesh += "" if self.element == "linear" else f" {self.element}"
        step = "" if self.solver == "StaticSolver" else f", {1e3 * self.substep:.3g} ms"
        return f"{self.solver.removesuffix('Solver')}, {mesh}{step}, {self.precision}"


@dataclass(repr=False)
class Chart:
    """The runs of a problem, the reference they were measured against and its own error (relative, like theirs)."""

    problem: Problem
    points: list[Point]
    reference_error: float
    left_out: list[str] = field(default_factory=list)

    __repr__ = brief_fields

    @property
    def front(self) -> list[Point]:
        """Runs that none beats in both time and error, the cheapest first."""
        return pareto_front(self.points)

    def with_points(self, more: list[Point]) -> "Chart":
        """The same with more runs, and with the front marked again."""
        out = replace(self, points=[*self.points, *more])
        front = out.front
        for p in out.points:
            p.on_front = p in front
        return out

    def time_to(self, error: float) -> Point | None:
        """The cheapest run whose error is at most this."""
        good = [p for p in self.points if p.error <= error]
        return min(good, key=lambda p: p.seconds, default=None)

    def record(self) -> dict:
        """Everything in numbers and words, as JSON takes it."""
        rows, problem = [without_nan(asdict(p)) for p in self.points], self.problem
        of_problem = dict(problem=problem.name, title=problem.title, error=problem.error, duration_s=problem.duration)
        return of_problem | dict(reference_error=self.reference_error, points=rows, left_out=self.left_out)


def pareto_front(points: Iterable) -> list:
    """Those of `points` (seconds, error) that no other beats in both, by time."""
    front, best = [], np.inf
    for p in sorted((p for p in points if np.isfinite(p.error)), key=lambda p: (p.seconds, p.error)):
        if p.error < best:
            front.append(p)
            best = p.error
    return front


def choose_substeps(problem: Problem, scene: Scene, kind: type[Solver], levels: int) -> list[int]:
    """Substeps per frame to try: an explicit solver starts at its stable step, an implicit one at a frame."""
    if kind is StaticSolver:
        return [1]
    frame = problem.duration / problem.frames
    stable = int(np.ceil(frame / min(SHARE * stable_dt(scene).dt, problem.largest_step)))
    if kind.explicit:
        return [stable * 2**k for k in range(levels)]
    return [2**k for k in range(levels + 1) if 2**k <= max(4 * stable, 16)]


def make_rollout(problem: Problem, scene: Scene, kind: type[Solver], substeps: int) -> Rollout:
    """The problem's frames, by one solver and step."""
    if kind is StaticSolver:
        return Rollout(StaticSolver(scene), 1, gradients=problem.inputs)
    solver = kind(scene, dt=problem.duration / problem.frames, substeps=substeps)
    return Rollout(solver, problem.frames, save_every=1, gradients=problem.inputs)


def run(problem: Problem, rollout: Rollout) -> tuple[float, np.ndarray]:
    """(wall time [s] of the run with its gradient if the problem asks for one, its numbers)."""
    begin = time.perf_counter()
    frames = rollout.forward()
    gradients = rollout.vjp(frames, problem.adjoint(frames, rollout.scene.mesh)) if problem.differentiates else {}
    seconds = time.perf_counter() - begin
    return seconds, problem.quantity(frames, gradients)


# ---- references -------------------------------------------------------------------------------------------------------


def reference(
    problem: Problem, cells: int | None = None, pattern: str = "five", substeps: int = 4, element: str = "linear"
) -> tuple:
    """(the right numbers, their own relative error): the closed form, or extrapolated from converging runs in float64.

    By steps on a mesh of so many cells: from h and h / 2 of velocity Verlet, whose error falls as h^2; the error is the
    last change. By meshes (problem.reference_cells) of ten-node tetrahedra: from the last two, whose error falls about as
    the square of the cell (what edges of a clamp leave of the third order); the error is the distance from what the first
    two give.
    """
    if problem.exact is not None:
        return problem.exact, 0.0
    if problem.reference_cells is None or cells is not None:
        scene = problem.scene(cells or problem.cells[0], pattern, "f64", **VARIANTS[element])
        k = substeps * choose_substeps(problem, scene, VelocityVerletSolver, 1)[0]
        coarse, fine = (run(problem, make_rollout(problem, scene, VelocityVerletSolver, s))[1] for s in (k, 2 * k))
        best = fine + (fine - coarse) / 3
        return best, distance(problem, fine, best)
    values = [reference(problem, n, substeps=1, element="quadratic")[0] for n in problem.reference_cells]
    sizes = 1 / np.array(problem.reference_cells, float) ** 2

    def extrapolate(a, b):
        return values[b] + (values[b] - values[a]) * sizes[b] / (sizes[a] - sizes[b])

    best = extrapolate(-2, -1)
    return best, distance(problem, extrapolate(-3, -2), best)


# ---- the runs ---------------------------------------------------------------------------------------------------------


@contextmanager
def refused(point: Point) -> Iterator[None]:
    """A run that raises counts as refused: the point keeps what was said and no error. Warnings of coarse steps are
    left out, for their error is what is measured."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            yield
    except (ValueError, FloatingPointError) as error:
        point.said, point.error = f"{type(error).__name__}: {error}", np.nan


class Runs:
    """The runs of a chart, mesh by mesh; predicts what they cost and leaves out those beyond `limit` seconds each."""

    def __init__(
        self, problem: Problem, solvers: Sequence, precisions: Sequence[str], levels: int, repeats: int, limit: float
    ):
        self.problem, self.solvers, self.precisions = problem, solvers, precisions
        self.levels, self.repeats, self.limit = levels, repeats, limit
        self.rate: dict = {}  # (solver, order, precision) -> [s] per tetrahedron and substep
        self.left_out: list[str] = []
        self._done: list[Point] = []

    def meshes(self) -> list[tuple[int, str, str]]:
        """(cells, pattern, element) of each mesh, the small ones first."""
        return [(n, p, e) for n in self.problem.cells for p in self.problem.patterns for e in self.problem.elements]

    def of_mesh(self, cells: int, pattern: str, element: str) -> list[tuple[Point, type, object]]:
        """(point, solver class, scene) of everything to run on a mesh."""
        out = []
        for precision in self.precisions:
            scene = self.problem.scene(cells, pattern, precision, **VARIANTS[element])
            what = cells, pattern, element, precision, scene.mesh.num_tetrahedra
            for kind in self.solvers:
                for k in choose_substeps(self.problem, scene, kind, self.levels):
                    total = k * self.problem.frames
                    out.append((Point(kind.__name__, *what, self.problem.duration / total, total), kind, scene))
        return out

    def predict(self, point: Point, explicit: bool) -> float:
        """Expected wall time of one run [s]."""
        guess = GUESS[explicit] * (3 if self.problem.differentiates else 1) * (5 if point.order == 2 else 1)
        rate = self.rate.get((point.solver, point.order, point.precision), guess)
        return 2e-4 + rate * max(point.tetrahedra, 200) * point.substeps

    def estimate(self) -> float:
        """Expected wall time of all runs [s], compile time apart."""
        total = 0.0
        for mesh in self.meshes():
            for point, kind, _ in self.of_mesh(*mesh):
                cost = self.predict(point, kind.explicit)
                total += 0 if cost > self.limit else (1 + self.repeats) * cost
        return total

    def measure(self, mesh: tuple[int, str, str], right: np.ndarray, show: Callable = lambda note: None) -> list[Point]:
        """All runs of a mesh: once to compile and to see the error, then round by round; the best time counts."""
        points, timed = [], []
        for point, kind, scene in self.of_mesh(*mesh):
            cost = self.predict(point, kind.explicit)
            if cost > self.limit:
                self.left_out.append(f"{point.label}: would take {cost:.2g} s a run")
                continue
            show(point.label)
            points.append(point)
            begin = time.perf_counter()
            with refused(point):
                rollout = make_rollout(self.problem, scene, kind, point.substeps // self.problem.frames)
                numbers = run(self.problem, rollout)[1]
                point.first_call = time.perf_counter() - begin
                point.error = distance(self.problem, numbers, right)
                timed.append((point, rollout, []))
        for _ in range(self.repeats):
            for point, rollout, times in timed:
                with refused(point):
                    times.append(run(self.problem, rollout)[0])
        for point, _, times in timed:
            if point.said:
                continue
            best = min(times)
            point.seconds = best / self.problem.duration
            known = self.rate.get((point.solver, point.order, point.precision))
            rate = best / max(point.tetrahedra, 200) / point.substeps
            self.rate[point.solver, point.order, point.precision] = rate if known is None else 0.5 * (known + rate)
        self._drop_hopeless(points)
        return points

    def _drop_hopeless(self, points: list[Point]) -> None:
        """Leave out of the larger meshes what is far behind the front on this one."""
        self._done += points
        front = pareto_front(self._done)
        for kind in self.solvers:
            own = [p for p in points if p.solver == kind.__name__ and np.isfinite(p.seconds)]
            behind = [p.seconds / min(q.seconds for q in front if q.error <= p.error) for p in own]
            if behind and min(behind) > HOPELESS:
                self.solvers = tuple(k for k in self.solvers if k is not kind)
                self.left_out.append(
                    f"{kind.__name__} beyond {own[0].cells} cells {own[0].pattern}: "
                    f"{min(behind):.0f} times as long as the front at the same error"
                )


@public
def chart(
    problem: Problem,
    solvers: Sequence[type[Solver]] | None = None,
    precisions: Sequence[str] = ("f32", "f64"),
    levels: int | None = None,
    repeats: int = 3,
    limit: float = 1.0,
    quick: bool = False,
    say: Callable = lambda line: None,
    executor: Executor | None = None,
) -> Chart:
    """Run a problem by every solver, step, precision and mesh, and measure time and error.

    solvers: classes; default all. levels: steps per solver, each half the last; default the problem's.
    repeats: timed rounds, the best counts.
    limit [s]: runs expected to take longer are left out, and named. quick: small meshes, float32.
    executor: any `concurrent.futures.Executor`, which takes a mesh at a time; errors are the same, and times are comparable
    where its workers do not share cores.
    say: called with what the chart will do and how long that takes. Raises ValueError for a problem no solver can do.
    """
    levels = levels or problem.levels
    if quick:
        problem, precisions, levels, repeats, limit = problem.quick(), ("f32",), (levels + 2) // 2, 2, min(limit, 0.4)
    solvers = solvers or ((StaticSolver,) if problem.static else SOLVERS)
    if problem.static != (tuple(solvers) == (StaticSolver,)):
        raise ValueError(f"{problem.name} is {'an equilibrium' if problem.static else 'a motion'}: solvers do not fit")
    runs = Runs(problem, solvers, precisions, levels, repeats, limit)
    meshes = runs.meshes()
    say(f"{problem.title}: {len(meshes)} meshes, about {runs.estimate():.0f} s of runs, and compiling before them")
    right, own_error = None, 0.0
    with progress(problem.name, len(meshes) + 1) as show:
        show(0, "reference")
        if problem.exact is not None or problem.reference_cells:
            right, own_error = reference(problem)
        if executor is None:
            parts = [_of_mesh(runs, m, right, lambda note, k=k: show(k + 1, note)) for k, m in enumerate(meshes)]
        else:
            parts = each(executor, _of_mesh, [(runs, mesh, right) for mesh in meshes], show)
    left_out = runs.left_out if executor is None else [line for *_, lines in parts for line in lines]
    points = [point for part, *_ in parts for point in part]
    return Chart(problem, [], max(own_error, *(error for _, error, _ in parts)), left_out).with_points(points)


def _of_mesh(
    runs: Runs, mesh: tuple, right: np.ndarray | None, show: Callable = lambda note: None
) -> tuple[list[Point], float, list[str]]:
    """(points of a mesh, its reference's own error, what was left out); right: numbers that do not depend on the mesh."""
    error = 0.0
    if right is None:
        right, error = reference(runs.problem, mesh[0], mesh[1])
    return runs.measure(mesh, right, show), error, runs.left_out
