"""Proofs that a user can run: Taylor test, dot-product test, a table of every gradient, its health, Hessian products."""

from collections.abc import Callable, Iterable
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti import runtime
from diffsim_ti.differences import CentralDifferences, TaylorResult, central_difference, taylor_test
from diffsim_ti.identification import Identifiability, identifiability
from diffsim_ti.inputs import RunSize
from diffsim_ti.rollout import Frames, Rollout
from diffsim_ti.solvers import NotConverged

__all__ = [
    "Loss",
    "TaylorResult",
    "taylor_test",
    "central_difference",
    "input_scale",
    "pull_back",
    "linear_loss",
    "dot_product_test",
    "GradientCheck",
    "GradientReport",
    "check_gradients",
    "GradientHealth",
    "gradient_health",
    "Identifiability",
    "identifiability",
    "hessian_product",
    "gauss_newton_product",
]

Loss = Callable[[Frames], tuple]  # frames -> (value, gradient by positions, by velocities[, {output: gradient by it}])


def _mean_step(rollout: Rollout) -> float:
    """Length of its steps [s], on average."""
    return float(rollout.solver.schedule.time(rollout.steps)) / rollout.steps if rollout.steps else rollout.solver.dt


def input_scale(rollout: Rollout, name: str) -> float:
    """A size of change that matters for an input: its own, or for lengths and velocities that of a tetrahedron's edge."""
    scene = rollout.scene
    run = RunSize(float(np.cbrt(np.mean(scene.mesh.volumes))), rollout.steps, _mean_step(rollout))
    return scene.inputs.described[name].change(rollout.values[name], run)


def _random_direction(rollout: Rollout, name: str, rng) -> np.ndarray:
    return rng.standard_normal(rollout.values[name].shape) * input_scale(rollout, name)


def pull_back(rollout: Rollout, frames: Frames, loss: Loss) -> dict[str, np.ndarray]:
    """Gradients of a loss by every wanted input."""
    _, *parts = loss(frames)
    outputs = parts.pop() if isinstance(parts[-1], dict) else {}
    return rollout.vjp(frames, *parts, **outputs)


def linear_loss(rollout: Rollout, seed: int = 0) -> Loss:
    """A loss that no symmetry hides from: w . positions + z . velocities + |positions|^2 / 2 with random w, z.

    Where the rollout computes further outputs it adds r . output for each of them, r random and in units of its size.
    """
    rng = np.random.default_rng(seed)
    shape = (rollout.num_frames, rollout.scene.mesh.num_vertices, 3)
    w, z = rng.standard_normal(shape), rng.standard_normal(shape)
    first = rollout.forward().outputs if rollout.computed else {}
    weights = {name: rng.standard_normal(y.shape) / (np.abs(y).max(initial=0.0) or 1.0) for name, y in first.items()}

    def loss(frames: Frames):
        x, v = frames.positions.astype(np.float64), frames.velocities.astype(np.float64)
        value = (w * x).sum() + (z * v).sum() + 0.5 * (x**2).sum()
        value += sum((r * frames[name]).sum() for name, r in weights.items())
        return (float(value), w + x, z, weights) if weights else (float(value), w + x, z)

    return loss


def dot_product_test(rollout: Rollout, inputs: Iterable[str] | None = None, seed: int = 0, **values) -> float:
    """Relative difference of <w, J v> and <J^T w, v> for random v in all inputs and random w in all frames.

    Further outputs of the rollout are tried each by itself, since they have other units; the largest difference counts.
    Round-off alone (1e-13 in f64, 1e-5 in f32) if `vjp` is the transpose of the tangent.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> material = ds.StableNeoHookean(E=1e5, nu=0.3)
    >>> scene = ds.Scene(mesh, material, terms=[ds.Gravity()], precision="f64")
    >>> rollout = ds.Rollout(ds.VelocityVerletSolver(scene, dt=1e-3), steps=10)
    >>> ds.dot_product_test(rollout) < 1e-12
    True
    """
    rng = np.random.default_rng(seed)
    frames = rollout.forward(**values)
    names = rollout.wanted if inputs is None else tuple(inputs)
    directions = {name: _random_direction(rollout, name, rng) for name in names}
    changes, differences = rollout.tangents(frames, **directions), []
    for outputs in (("positions", "velocities"), *((name,) for name in rollout.computed)):
        seeds = {output: rng.standard_normal(frames[output].shape) for output in outputs}
        gradients = rollout.vjp(frames, **seeds)
        forward = float(sum((seeds[output] * changes[output]).sum() for output in outputs))
        reverse = sum(float((gradients[name] * directions[name]).sum()) for name in names)
        size = sum(np.abs(seeds[output] * changes[output]).sum() for output in outputs)
        scale = max(size, 1e-300) / np.sqrt(seeds[outputs[0]].size)
        differences.append(abs(forward - reverse) / max(abs(forward), scale))
    return max(differences)


RIGHT, WRONG, NOT_RESOLVED = "right", "WRONG", "NOT RESOLVED"
TIGHT = {"f64": 1e-12, "f32": 1e-6}  # tolerance of solves whose gradients are checked
COARSE = 1e-3  # resolution beyond which no gradient is called right
FAILURES = (ValueError, ArithmeticError, NotConverged)  # of a run whose numbers went too far


@dataclass
class GradientCheck:
    """One row of `check_gradients`: directional derivatives along a random direction, and what they show.

    resolution: the smallest relative error that could have been seen; a gradient is never right where that is coarse.
    verdict: "right", "WRONG" or "NOT RESOLVED"; advice: why, and what to change. taylor_rate: 2 where the gradient is right,
    infinite where the loss is linear along the direction; the verdict does not depend on it.
    """

    input: str
    analytic: float
    differences: float
    relative_error: float
    resolution: float
    taylor_rate: float
    verdict: str
    advice: str = ""

    @property
    def passed(self) -> bool:
        """Whether the gradient is right, and was resolved."""
        return self.verdict == RIGHT


@dataclass
class GradientReport:
    """The rows of `check_gradients` and notes on how they were found; `passed` if all are right; `str()` is the table."""

    rows: list[GradientCheck] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """Whether every row did."""
        return all(row.passed for row in self.rows)

    def __str__(self) -> str:
        lines = [
            f"{'input':22s} {'analytic':>16s} {'differences':>16s} {'rel. error':>11s} {'resolution':>11s} "
            f"{'Taylor rate':>12s}  verdict"
        ]
        for r in self.rows:
            rate = "linear" if np.isinf(r.taylor_rate) else "-" if np.isnan(r.taylor_rate) else f"{r.taylor_rate:.3f}"
            resolution = f"{r.resolution:.1e}" if r.resolution else "exact"
            lines.append(
                f"{r.input:22s} {r.analytic: 16.8e} {r.differences: 16.8e} {r.relative_error:11.1e} {resolution:>11s} "
                f"{rate:>12s}  {r.verdict}"
            )
        lines += [f"{r.input}: {r.advice}" for r in self.rows if r.advice]
        return "\n".join(lines + self.notes)


class _Pulled:
    """Gradients of a loss by a rollout's own `vjp`, solved to a tight tolerance meanwhile, and how far off they may be."""

    def __init__(self, rollout: Rollout, loss: Loss, stack: ExitStack):
        self.rollout, self.loss = rollout, loss
        self.frames, self.own = self._at({})
        self.gradients, self.tolerance, self.left = self.own, None, 0.0
        self._scattered: list | None = None
        asked = getattr(rollout.solver, "tolerance", None)
        if asked is None:
            return
        loose, self.tolerance = self.own, asked
        for k in range(3):
            tolerance = TIGHT[rollout.scene.precision] * 100.0**k
            if tolerance < asked and self._solve_to(tolerance, stack):
                break
        if self.tolerance == asked:  # tight as it is, or it cannot be tighter
            asked = min(100 * asked, 0.1)
            with _solved_to(rollout, asked):
                loose = self._at({})[1]
        self._loose, self.left = loose, (self.tolerance / asked) ** 0.5

    def _at(self, values: dict) -> tuple[Frames, dict]:
        frames = self.rollout.forward(**values)
        return frames, pull_back(self.rollout, frames, self.loss)

    def _solve_to(self, tolerance: float, stack: ExitStack) -> bool:
        with ExitStack() as trial:
            trial.enter_context(_solved_to(self.rollout, tolerance))
            try:
                self.frames, self.gradients = self._at({})
            except NotConverged:
                return False
            stack.push(trial.pop_all())
        self.tolerance = tolerance
        return True

    def unsolved(self, name: str, direction: np.ndarray) -> float:
        """What the solver's tolerance may leave of a derivative: what a looser one changes, by the root of their ratio."""
        return (
            self.left * abs(float(((self._loose[name] - self.gradients[name]) * direction).sum())) if self.left else 0.0
        )

    def scatter(self, name: str, direction: np.ndarray) -> float:
        """What rounding makes of a derivative: twice its largest change in two runs whose numbers, other than places, which
        would strain the body, differ by one unit in the last place."""
        if self._scattered is None:
            rng, self._scattered = np.random.default_rng(0), []
            eps = np.finfo(runtime.NUMPY[self.rollout.scene.precision]).eps
            numbers = {n: x for n, x in self.rollout.values.items() if not n.endswith(("_positions", "_motion"))}
            for _ in range(2):
                try:
                    near = {n: x * (1 + eps * rng.choice([-1, 1], x.shape)) for n, x in numbers.items()}
                    self._scattered.append(self._at(near)[1])
                except FAILURES:
                    continue
        changes = [float(((g[name] - self.gradients[name]) * direction).sum()) for g in self._scattered]
        return 2 * max(map(abs, changes), default=0.0)


@contextmanager
def _solved_to(rollout: Rollout, tolerance: float):
    """The same Rollout, so with whatever its `vjp` is, solved to another tolerance meanwhile."""
    kept, other = (
        (rollout.solver, rollout.sweep),
        rollout.on(rollout.solver.for_scene(rollout.scene, tolerance=tolerance)),
    )
    rollout.solver, rollout.sweep = other.solver, other.sweep
    try:
        yield
    finally:
        rollout.solver, rollout.sweep = kept


def check_gradients(
    rollout: Rollout,
    loss: Loss | None = None,
    inputs: Iterable[str] | None = None,
    seed: int = 0,
    verbose: bool = True,
    tolerance: float | None = None,
) -> GradientReport:
    """Check the gradient by every input against extrapolated central differences, and print a table with three verdicts.

    right: the error is within the tolerance and what is not known of the differences, and one of `resolution` would have
    been seen; that is never coarser than 1e-3, or ten times the tolerance.
    WRONG: differences of the smallest steps that rounding leaves settle on another value, and both sides of the start do.
    NOT RESOLVED: neither can be said; the advice names what hides it and what to change.

    loss(frames) -> (value, gradient by positions, gradient by velocities or None), and a dict {output: gradient by it}
    where it names further outputs; default `linear_loss`, which names all.
    Differences are taken in float64, of an f32 scene too: differences in f32 see nothing. Implicit and static solvers are
    solved to a tolerance of 1e-12 meanwhile, since differences see what looser solves leave; a note says how far the
    gradients at their own tolerance are from those.
    inputs: names, default all; verbose: whether to print. tolerance: largest relative error, default 1e-6 in f64 (what
    differences resolve on a long run), 1e-3 in f32.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> material = ds.StableNeoHookean(E=1e5, nu=0.3)
    >>> scene = ds.Scene(mesh, material, terms=[ds.Gravity()], precision="f64")
    >>> rollout = ds.Rollout(ds.VelocityVerletSolver(scene, dt=1e-3), steps=10)
    >>> ds.check_gradients(rollout, inputs=["gravity", "initial_velocities"], verbose=False).passed
    True
    """
    single, names = rollout.scene.precision == "f32", rollout.wanted if inputs is None else tuple(inputs)
    loss, tolerance = loss or linear_loss(rollout, seed), tolerance or (1e-3 if single else 1e-6)
    report, rng = GradientReport(), np.random.default_rng(seed + 1)
    with ExitStack() as stack:
        own = _Pulled(rollout, loss, stack)
        exact = _Pulled(rollout.with_scene(precision="f64"), loss, stack) if single else own
        start = float(loss(exact.frames)[0])
        for name in names:
            direction = _random_direction(rollout, name, rng)
            report.rows.append(_Row(own, exact, name, direction, start, tolerance).check())
        report.notes += _note(own, report.rows)
    if verbose:
        print(report)
    return report


def _note(own: _Pulled, rows: list[GradientCheck]) -> list[str]:
    """What the tolerance that the user asked for leaves of the gradients."""
    if own.gradients is own.own:
        return []
    sizes = {r.input: max(float(np.linalg.norm(own.gradients[r.input])), 1e-300) for r in rows}
    off = {name: float(np.linalg.norm(own.own[name] - own.gradients[name])) / size for name, size in sizes.items()}
    worst = max(off, key=off.get)
    return [
        f"Solved to a tolerance of {own.tolerance:.0e} for this check. At the solver's own, gradients differ from these by "
        f"up to {off[worst]:.1e} ({worst})."
    ]


class _Row:
    """The check of one input."""

    def __init__(self, own: _Pulled, exact: _Pulled, name: str, direction, start: float, tolerance: float):
        self.own, self.exact, self.name, self.tolerance = own, exact, name, tolerance
        self.single, x = own is not exact, exact.rollout.values[name]
        self.analytic, self.slope = (float((p.gradients[name] * direction).sum()) for p in (own, exact))
        self.direction = direction

        def along(t: float) -> float:
            return float(own.loss(exact.rollout.forward(**{name: x + t * direction}))[0])

        self.differences = CentralDifferences(along, 1.0, start, FAILURES)
        self.left = own.unsolved(name, direction) + (exact.unsolved(name, direction) if self.single else 0.0)
        self.scatter = own.scatter(name, direction) if self.single else 0.0

    @property
    def scale(self) -> float:
        return max(abs(self.analytic), abs(self.differences.value))

    @property
    def error(self) -> float:
        return abs(self.analytic - self.differences.value)

    @property
    def uncertainty(self) -> float:
        return self.differences.uncertainty + self.left + self.scatter

    @property
    def resolution(self) -> float:
        return self.tolerance + 4 * self.uncertainty / self.scale if self.scale > 0 else np.inf

    @property
    def is_zero(self) -> bool:
        """Whether the gradient is zero, and the loss the same everywhere."""
        values = set(self.differences.known.values())
        return self.analytic == 0 and len(values) == 1 and len(self.differences.known) > 1

    @property
    def is_right(self) -> bool:
        near = self.error <= self.tolerance * self.scale + self.uncertainty
        return self.is_zero or bool(near and self.resolution <= max(COARSE, 10 * self.tolerance))

    def check(self) -> GradientCheck:
        """The row: with three steps where that is enough, and else with as many as tell more."""
        of, enough = self.differences, 2 * min(self.tolerance, 1e-6)
        of.begin()
        verdict = RIGHT
        if not self.is_zero and not (self.is_right and of.uncertainty <= enough * self.scale):
            of.improve(enough * self.scale)
            if not self.is_right:
                self.scatter = self.own.scatter(self.name, self.direction)
            if not self.is_right:
                least = self.tolerance * self.scale + 3 * (self.left + self.scatter)
                off = of.settles_off(self.analytic, least)
                verdict = RIGHT if self.is_right else WRONG if off and self.error > least else NOT_RESOLVED
        error = self.error / self.scale if self.scale > 0 else 0.0
        resolution = (
            0.0 if self.is_zero else max(self.resolution, error) if verdict == NOT_RESOLVED else self.resolution
        )
        advice = self._advice(verdict, error)
        rate = of.taylor_rate(self.slope)
        return GradientCheck(self.name, self.analytic, of.value, error, resolution, rate, verdict, advice)

    def _advice(self, verdict: str, error: float) -> str:
        of, rollout = self.differences, self.own.rollout
        if verdict == RIGHT:
            return ""
        if not of.steps:
            return f"no run near the start succeeds ({of.failure}): move the start away from that"
        span = f"steps of {of.steps[0]:.0e} to {of.steps[-1]:.0e} of its size"
        if verdict == WRONG:
            return f"off by {error:.1e}, where differences by {span} settle to {self.uncertainty / self.scale:.1e}"
        fewer = f", or take fewer than its {rollout.steps} steps" if rollout.steps > 1 else ""
        elsewhere = of.noise > 1e5 * np.finfo(np.float64).eps * max(map(abs, of.known.values()))
        parts = dict(gradient=self.scatter, solver=self.left, loss=of.rounding, kinks=of.spread + of.jump)
        known = dict(
            gradient=f"rounding makes the gradient scatter by {self.scatter:.1e}: "
            + ('make the scene with precision="f64"' if self.single else "watch an output that depends on it more")
            + fewer,
            solver=f"its tolerance of {self.own.tolerance} may leave {self.left:.1e} of the derivative: pass a smaller one, "
            "and more max_iterations if the solver does not get there",
            loss=f"the loss scatters by {of.noise:.1e} and changes by {abs(of.value):.1e} with the input's size: "
            + (
                f"inputs that differ by {of.close:.0e} lead to other states (buckling, chaotic contact), so follow one of "
                "them by smaller steps, more load steps"
                if elsewhere
                else "rounding hides it, so watch an output that depends on it more"
            )
            + fewer,
            kinks=f"differences by {span} agree to no better than {parts['kinks'] / max(self.scale, 1e-300):.1e} (kinks of "
            f"contact or friction, or a chaotic run): start where nothing touches{fewer}",
        )
        return known[max(parts, key=parts.get)]


@dataclass
class GradientHealth:
    """How an adjoint grows through a reverse sweep: norms per step (last step first), growth rate [1/s] and horizon."""

    steps: np.ndarray
    norms: np.ndarray
    growth_rate: float
    exceeded_at: int | None

    def __str__(self) -> str:
        where = "never" if self.exceeded_at is None else f"going back past step {self.exceeded_at}"
        norms = f"{self.norms[0]:.3g} to {self.norms[-1]:.3g}"
        return f"adjoint norm {norms}, growth {self.growth_rate:.3g} 1/s, limit exceeded {where}"


def gradient_health(rollout: Rollout, limit: float = 1e10) -> GradientHealth:
    """Health of the last reverse sweep of a Rollout made with health=True: is the gradient still of use?

    Norms are those of the adjoint of the state, |(dt p, q)|; the growth rate is the least-squares slope of their logarithm
    backwards in time; `exceeded_at` is the latest step at which they exceed `limit` times the first.
    """
    if not rollout.health:
        raise ValueError("no health report: make the Rollout with health=True and run its reverse sweep first")
    steps = np.array([h["step"] for h in rollout.health])
    times, dt = rollout.solver.schedule.time(steps), _mean_step(rollout)
    norms = np.array([np.hypot(dt * h["norm_position"], h["norm_velocity"]) for h in rollout.health])
    good = norms > 0
    slope = np.polyfit(-times[good], np.log(norms[good]), 1)[0] if good.sum() > 2 else 0.0
    over = np.nonzero(norms > limit * norms[good][0])[0] if good.any() else []
    return GradientHealth(steps, norms, float(slope), int(steps[over[0]]) if len(over) else None)


def hessian_product(rollout: Rollout, loss: Loss, direction: dict, epsilon: float = 1e-5, **values) -> dict:
    """Hessian of the loss times a direction over some inputs, by central differences of exact gradients.

    direction: input name -> change of that input. Error O(epsilon^2) of the direction as given; use f64.
    """
    base = rollout.values | rollout.scene.inputs.check(values)
    out = {}
    for sign in (1, -1):
        frames = rollout.forward(**values | {n: base[n] + sign * epsilon * np.asarray(d) for n, d in direction.items()})
        gradients = pull_back(rollout, frames, loss)
        for name in direction:
            out[name] = out.get(name, 0.0) + sign * gradients[name] / (2 * epsilon)
    return out


def gauss_newton_product(rollout: Rollout, frames: Frames, direction: dict, weight: ArrayLike = 1.0) -> dict:
    """J^T (weight J d): the Gauss-Newton Hessian of 1/2 |sqrt(weight) (positions - target)|^2 times a direction; exact.

    One tangent run and one reverse sweep; positive semi-definite, so CG works on it.
    """
    dx, _ = rollout.jvp(frames, **direction)
    gradients = rollout.vjp(frames, weight * dx)
    return {name: gradients[name] for name in direction}
