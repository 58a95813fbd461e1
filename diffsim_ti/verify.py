"""Proofs that a user can run: Taylor test, dot-product test, a table of every gradient, its health, Hessian products."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.differences import TaylorResult, central_difference, taylor_rate, taylor_test
from diffsim_ti.identification import Identifiability, identifiability
from diffsim_ti.inputs import RunSize
from diffsim_ti.rollout import Frames, Rollout

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


@dataclass
class GradientCheck:
    """One row of `check_gradients`: directional derivatives along a random direction, and the Taylor rate."""

    input: str
    analytic: float
    differences: float
    relative_error: float
    taylor_rate: float
    passed: bool


@dataclass
class GradientReport:
    """The rows of `check_gradients`; `passed` if all did; `str()` is the table."""

    rows: list[GradientCheck] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """Whether every row did."""
        return all(row.passed for row in self.rows)

    def __str__(self) -> str:
        lines = [
            f"{'input':22s} {'analytic':>16s} {'differences':>16s} {'rel. error':>11s} {'Taylor rate':>12s}  verdict"
        ]
        for r in self.rows:
            rate = "linear" if np.isinf(r.taylor_rate) else f"{r.taylor_rate:.3f}"
            lines.append(
                f"{r.input:22s} {r.analytic: 16.8e} {r.differences: 16.8e} {r.relative_error:11.1e} {rate:>12s}  "
                f"{'right' if r.passed else 'WRONG'}"
            )
        return "\n".join(lines)


def check_gradients(
    rollout: Rollout,
    loss: Loss | None = None,
    inputs: Iterable[str] | None = None,
    seed: int = 0,
    verbose: bool = True,
    tolerance: float | None = None,
) -> GradientReport:
    """Check the gradient by every input against extrapolated central differences and by its Taylor rate; print the table.

    loss(frames) -> (value, gradient by positions, gradient by velocities or None), and a dict {output: gradient by it}
    where it names further outputs; default `linear_loss`, which names all.
    Differences and Taylor rates are taken in float64, of an f32 scene too: differences in f32 see nothing.
    inputs: names, default all; verbose: whether to print. tolerance: largest relative error, default 1e-6 in f64 (what
    differences resolve on a long run), 1e-3 in f32.
    A row passes if its error is within the tolerance and its Taylor rate reaches 1.9: over four neighbouring steps, each a
    half or a third of the one before, of .1 to 1e-6 of the input's size. Those of the differences come first.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> material = ds.StableNeoHookean(E=1e5, nu=0.3)
    >>> scene = ds.Scene(mesh, material, terms=[ds.Gravity()], precision="f64")
    >>> rollout = ds.Rollout(ds.VelocityVerletSolver(scene, dt=1e-3), steps=10)
    >>> ds.check_gradients(rollout, inputs=["gravity", "initial_velocities"], verbose=False).passed
    True
    """
    single = rollout.scene.precision == "f32"
    double = rollout.with_scene(precision="f64") if single else rollout
    loss = loss or linear_loss(rollout, seed)
    tolerance = tolerance or (1e-3 if single else 1e-6)
    rng = np.random.default_rng(seed + 1)
    frames = rollout.forward()
    gradients = pull_back(rollout, frames, loss)
    start = loss(double.forward() if single else frames)[0]
    report = GradientReport()
    for name in rollout.wanted if inputs is None else inputs:
        direction, x = _random_direction(rollout, name, rng), rollout.values[name]
        known = {0.0: float(start)}

        def along(t, name=name, x=x, direction=direction, known=known):
            t = float(t)
            if t not in known:
                known[t] = float(loss(double.forward(**{name: x + t * direction}))[0])
            return known[t]

        analytic = float((gradients[name] * direction).sum())
        exact = analytic
        if single:
            exact = float((pull_back(double, double.forward(), loss)[name] * direction).sum())
        differences, uncertainty = central_difference(along)
        rate = taylor_rate(along, known, exact)
        scale = max(abs(differences), abs(analytic))
        error = abs(analytic - differences) / scale if scale > 0 else 0.0
        resolved = abs(analytic - differences) <= 10 * uncertainty + tolerance * scale
        report.rows.append(GradientCheck(name, analytic, differences, error, rate, resolved and rate >= 1.9))
    if verbose:
        print(report)
    return report


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
