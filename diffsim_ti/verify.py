"""Proofs that a user can run: Taylor test, dot-product test, a table of every gradient, its health, Hessian products."""

from collections.abc import Callable, Iterable
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti import runtime
from diffsim_ti.common.differences import CentralDifferences, TaylorResult, central_difference, taylor_test
from diffsim_ti.common.public import public
from diffsim_ti.identification import Identifiability, identifiability
from diffsim_ti.inputs import RunSize
from diffsim_ti.inputs.description import InputValue
from diffsim_ti.rollout import Frames, Rollout
from diffsim_ti.solvers import NotConverged

__all__ = ["Loss", "TaylorResult", "taylor_test", "central_difference", "input_scale", "pull_back", "linear_loss"]
__all__ += ["dot_product_test", "CentralDifferences", "Judgement", "GradientCheck", "GradientReport"]
__all__ += ["check_gradients", "GradientHealth", "gradient_health", "Identifiability", "identifiability"]
__all__ += ["hessian_product", "gauss_newton_product"]

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


@public
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


@public
def dot_product_test(
    rollout: Rollout, inputs: Iterable[str] | None = None, seed: int = 0, **values: InputValue
) -> float:
    """Relative difference of <w, J v> and <J^T w, v> for random v in all inputs and random w in all frames.

    Further outputs of the rollout are tried each by itself, since they have other units; the largest difference counts.
    Round-off alone (1e-13 in f64, 1e-5 in f32) if `vjp` is the transpose of the tangent.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> scene = ds.Scene(mesh, ds.StableNeoHookean(E=1e5, nu=0.3), terms=[ds.Gravity()], precision="f64")
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


@dataclass(repr=False)
class GradientReport:
    """The rows of `check_gradients` and notes on how they were found; `passed` if all are right; `str()` is the table."""

    rows: list[GradientCheck] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """Whether every row did."""
        return all(row.passed for row in self.rows)

    def __str__(self) -> str:
        wide = max([22, *(len(r.input) for r in self.rows)])
        lines = [
            f"{'input':{wide}s} {'analytic':>16s} {'differences':>16s} {'rel. error':>11s} {'resolution':>11s} "
            f"{'Taylor rate':>12s}  verdict"
        ]
        for r in self.rows:
            rate = "linear" if np.isinf(r.taylor_rate) else "-" if np.isnan(r.taylor_rate) else f"{r.taylor_rate:.3f}"
            resolution = f"{r.resolution:.1e}" if r.resolution else "exact"
            lines.append(
                f"{r.input:{wide}s} {r.analytic: 16.8e} {r.differences: 16.8e} {r.relative_error:11.1e} {resolution:>11s} "
                f"{rate:>12s}  {r.verdict}"
            )
        lines += [f"{r.input}: {r.advice}" for r in self.rows if r.advice]
        return "\n".join(lines + self.notes)

    __repr__ = __str__


class _Pulled:
    """Gradients of a loss by a rollout's own `vjp`, solved to a tight tolerance meanwhile, and how far off they may be."""

    def __init__(self, rollout: Rollout, loss: Loss, stack: ExitStack):
        self.rollout, self.loss = rollout, loss
        self.frames, self.own = self._at({})
        self.gradients, self._scattered = self.own, None
        self.asked = self.tolerance = getattr(rollout.solver, "tolerance", None)
        for k in range(0 if self.asked is None else 3):
            tight = TIGHT[rollout.scene.precision] * 100.0**k
            if tight < self.asked:
                with suppress(NotConverged), ExitStack() as trial:
                    trial.enter_context(_solved_to(rollout, tight))
                    self.frames, self.gradients = self._at({})
                    self.tolerance = tight
                    stack.push(trial.pop_all())
                    break
        self._loose = None  # (gradients, tolerance) of a solve that is looser
        if self.tolerance != self.asked:
            self._loose = self.own, self.asked
        elif self.asked is not None:
            tolerance = min(100 * self.asked, 0.1)
            with _solved_to(rollout, tolerance):
                self._loose = self._at({})[1], tolerance

    def _at(self, values: dict) -> tuple[Frames, dict]:
        frames = self.rollout.forward(**values)
        return frames, pull_back(self.rollout, frames, self.loss)

    def along(self, gradients: dict, name: str, direction: np.ndarray) -> float:
        """Derivative by an input along a direction of it."""
        return float((gradients[name] * direction).sum())

    def unsolved(self, name: str, direction: np.ndarray) -> float:
        """What the solver's tolerance may leave of a derivative: what a looser one changes, by the root of their ratio."""
        if self._loose is None:
            return 0.0
        change = self.along(self._loose[0], name, direction) - self.along(self.gradients, name, direction)
        return abs(change) * (self.tolerance / self._loose[1]) ** 0.5

    def scatter(self, name: str, direction: np.ndarray) -> float:
        """What rounding makes of a derivative: twice its largest change in two runs whose numbers, other than places, which
        would strain the body, differ by one unit in the last place."""
        if self._scattered is None:
            rng, self._scattered = np.random.default_rng(0), []
            eps = np.finfo(runtime.NUMPY[self.rollout.scene.precision]).eps
            numbers = {n: x for n, x in self.rollout.values.items() if not n.endswith(("_positions", "_motion"))}
            for _ in range(2):
                with suppress(*FAILURES):
                    near = {n: x * (1 + eps * rng.choice([-1, 1], x.shape)) for n, x in numbers.items()}
                    self._scattered.append(self._at(near)[1])
        here = self.along(self.gradients, name, direction)
        return 2 * max((abs(self.along(g, name, direction) - here) for g in self._scattered), default=0.0)


@contextmanager
def _solved_to(rollout: Rollout, tolerance: float):
    """The same Rollout, so with whatever its `vjp` is, solved to another tolerance meanwhile."""
    kept = rollout.sweep
    rollout.sweep = rollout.on(rollout.solver.for_scene(rollout.scene, tolerance=tolerance)).sweep
    try:
        yield
    finally:
        rollout.sweep = kept


@public
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
    >>> scene = ds.Scene(mesh, ds.StableNeoHookean(E=1e5, nu=0.3), terms=[ds.Gravity()], precision="f64")
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
            direction, x = _random_direction(rollout, name, rng), exact.rollout.values[name]
            analytic, slope = (p.along(p.gradients, name, direction) for p in (own, exact))

            def along(t: float, name=name, x=x, direction=direction) -> float:
                return float(loss(exact.rollout.forward(**{name: x + t * direction}))[0])

            left = own.unsolved(name, direction) + (exact.unsolved(name, direction) if single else 0.0)
            scatter = partial(own.scatter, name, direction)
            judged = Judgement(CentralDifferences(along, 1.0, start, FAILURES), analytic, tolerance, left, scatter)
            judged.judge(single)
            rate, zero = judged.differences.taylor_rate(slope), judged.is_zero
            resolution = 0.0 if zero else judged.resolution
            values = name, analytic, judged.differences.value, judged.relative_error, resolution, rate
            report.rows.append(GradientCheck(*values, judged.verdict, judged.advice(rollout, own.tolerance)))
        report.notes += _note(own, report.rows)
    if verbose:
        print(report)
    return report


def _note(own: _Pulled, rows: list[GradientCheck]) -> list[str]:
    """What the tolerance that the user asked for leaves of the gradients."""
    if own.gradients is own.own or not rows:
        return []
    sizes = {r.input: max(float(np.linalg.norm(own.gradients[r.input])), 1e-300) for r in rows}
    off = {name: float(np.linalg.norm(own.own[name] - own.gradients[name])) / size for name, size in sizes.items()}
    worst = max(off, key=off.get)
    return [
        f"Solved to a tolerance of {own.tolerance:.0e} for this check. At the solver's own, {own.asked:.0e}, gradients "
        f"differ from these by up to {off[worst]:.1e} ({worst})."
    ]


class Judgement:
    """The verdict on a derivative that is claimed, beside differences: `verdict`, `resolution`, `relative_error`, `advice`.

    left: what a solver's tolerance may leave of the derivative. scatter: returns what rounding makes of it; asked for at
    once where `judge` is told to, and else where the derivative does not seem right.
    """

    def __init__(
        self,
        differences: CentralDifferences,
        analytic: float,
        tolerance: float,
        left: float = 0.0,
        scatter: Callable[[], float] = lambda: 0.0,
    ):
        self.differences, self.analytic, self.tolerance, self.left = differences, analytic, tolerance, left
        self.scatter, self._scatter, self.verdict = 0.0, scatter, NOT_RESOLVED

    @property
    def scale(self) -> float:
        """What errors are relative to: the larger of both."""
        return max(abs(self.analytic), abs(self.differences.value))

    @property
    def error(self) -> float:
        """Their distance."""
        return abs(self.analytic - self.differences.value)

    @property
    def relative_error(self) -> float:
        return self.error / self.scale if self.scale > 0 else 0.0

    @property
    def uncertainty(self) -> float:
        """How far off both may be together."""
        return self.differences.uncertainty + self.left + self.scatter

    @property
    def resolution(self) -> float:
        """The smallest relative error that is seen: never less than one that is there and not called right."""
        seen = self.tolerance + 4 * self.uncertainty / self.scale if self.scale > 0 else np.inf
        return max(seen, self.relative_error) if self.verdict == NOT_RESOLVED else seen

    @property
    def is_zero(self) -> bool:
        """Whether the derivative is zero, and differences are beside what the loss changes by, if it changes at all."""
        of = self.differences
        most = max((abs(of.known[s] - of.known[0.0]) / h for h in of.steps for s in (h, -h)), default=0.0)
        near = abs(of.value) + self.uncertainty <= self.tolerance * most or most == 0
        return self.analytic == 0 and bool(of.steps) and near

    @property
    def is_right(self) -> bool:
        """Whether the derivative is near the differences, and these are known well enough to say so."""
        near = self.error <= self.tolerance * self.scale + self.uncertainty
        resolved = self.tolerance * self.scale + 4 * self.uncertainty <= max(COARSE, 10 * self.tolerance) * self.scale
        return self.is_zero or bool(near and resolved and self.scale > 0)

    def judge(self, scatters: bool = False) -> str:
        """Find the verdict: with three steps where these are enough, and else with as many as tell more."""
        of, enough = self.differences, 2 * min(self.tolerance, 1e-6)
        of.begin()
        self.scatter = self._scatter() if scatters else 0.0
        if not self.is_zero and not (self.is_right and of.uncertainty <= enough * self.scale):
            of.improve(enough * self.scale)
            if not self.is_right:
                self.scatter = self._scatter()
        off = not self.is_right and of.settles_off(
            self.analytic, self.tolerance * self.scale + 3 * (self.left + self.scatter)
        )
        if self.is_right:
            self.verdict = RIGHT
        elif off and self.error > self.tolerance * self.scale + self.uncertainty:
            self.verdict = WRONG
        return self.verdict

    def advice(self, rollout: Rollout, tolerance: float | None) -> str:
        """Why the derivative is not called right, and what to change; tolerance: to which the rollout was solved."""
        of = self.differences
        if self.verdict == RIGHT:
            return ""
        if not of.steps:
            return f"no run near the start succeeds ({of.failure}): move the start away from that"
        span = f"steps of {of.steps[0]:.0e} to {of.steps[-1]:.0e} of its size"
        known = self.uncertainty / max(self.scale, 1e-300)
        if self.verdict == WRONG:
            return f"off by {self.relative_error:.1e}, where differences by {span} are known to {known:.1e}"
        fewer = f", or take fewer than its {rollout.steps} steps" if rollout.steps > 1 else ""
        parts = dict(gradient=self.scatter, solver=self.left, loss=of.rounding, kinks=of.spread + of.jump)
        worst = max(parts, key=parts.get)
        if worst == "gradient":
            single = rollout.scene.precision == "f32"
            remedy = 'make the scene with precision="f64"' if single else "watch an output that depends on it more"
            return f"rounding makes the gradient scatter by {self.scatter:.1e}: {remedy}{fewer}"
        if worst == "solver":
            return (
                f"a tolerance of {tolerance:.0e} may leave {self.left:.1e} of the derivative: pass a smaller one, and more "
                "max_iterations if the solver does not get there"
            )
        if worst == "kinks":
            return (
                f"differences by {span} agree to no better than {known:.1e} (kinks of contact or friction, or a chaotic "
                f"run): start where nothing touches{fewer}"
            )
        hides = "rounding hides it, so watch an output that depends on it more"
        if of.noise > 1e5 * np.finfo(np.float64).eps * max(map(abs, of.known.values())):
            hides = (
                f"inputs that differ by {of.close:.0e} lead to other states (buckling, chaotic contact), so follow one of "
                "them by smaller steps, more load steps"
            )
        changes = f"the loss scatters by {of.noise:.1e} and changes by {abs(of.value):.1e} with the input's size"
        return f"{changes}: {hides}{fewer}"


@dataclass(repr=False)
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

    __repr__ = __str__


@public
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


@public
def hessian_product(rollout: Rollout, loss: Loss, direction: dict, epsilon: float = 1e-5, **values: InputValue) -> dict:
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


@public
def gauss_newton_product(rollout: Rollout, frames: Frames, direction: dict, weight: ArrayLike = 1.0) -> dict:
    """J^T (weight J d): the Gauss-Newton Hessian of 1/2 |sqrt(weight) (positions - target)|^2 times a direction; exact.

    One tangent run and one reverse sweep; positive semi-definite, so CG works on it.
    """
    dx, _ = rollout.jvp(frames, **direction)
    gradients = rollout.vjp(frames, weight * dx)
    return {name: gradients[name] for name in direction}
