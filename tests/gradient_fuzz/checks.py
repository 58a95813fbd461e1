"""The same gradient by other ways: again, by other schedules, for fewer inputs, clipped and truncated by definition."""

import numpy as np

import diffsim_ti as ds
from diffsim_ti import verify
from diffsim_ti.terms.over_time import GivenOverTime

from . import faces
from .at_once import scenes_at_once
from .structures import CELL

RIGHT = "right"


def differs(found: dict, expected: dict, gate: float, names=None, floors=None) -> str:
    """Where two sets of gradients differ by more than a share of their size, 0 for the same bits; "right" if nowhere.

    floors: sizes below which a gradient is rounding.
    """
    said, floors = [], floors or {}
    for name in expected if names is None else names:
        a, b = (np.asarray(x[name], np.float64) for x in (found, expected))
        off, size = np.abs(a - b).max(initial=0.0), np.abs(b).max(initial=0.0)
        if a.shape != b.shape or not off <= gate * max(size, floors.get(name, 0.0)):
            said.append(f"{name}: off by {off:.3g} of {size:.3g}")
    return "; ".join(said) or RIGHT


def repeats(it) -> str:
    """Twice in a row, and after a run of other numbers: the same bits."""
    again = it.rollout.vjp(it.frames, it.w, it.z)
    first = differs(again, it.gradients, 0)
    it.rollout.forward(density=1.1 * it.rollout.values["density"])
    later = differs(it.rollout.vjp(it.frames, it.w, it.z), it.gradients, 0)
    return first if first != RIGHT else later


def schedules(it) -> str:
    """States every few steps, or a budget: the same bits."""
    rng, steps = it.configuration.rng(3), it.configuration.steps
    state = (
        4 * it.configuration.scene.mesh.num_vertices * (8 if it.configuration.structure.precision == "f64" else 4) / 1e6
    )
    options = dict(memory=float(state * rng.integers(14, 30)))
    if rng.random() < 0.5:
        options = dict(checkpoint_every=int(rng.integers(1, steps + 1)))
    other = it.configuration.rollout(**options)
    frames = other.forward()
    if np.any(frames.displacements != it.frames.displacements):
        return f"frames differ with {options}"
    said = differs(other.vjp(frames, it.w, it.z), it.gradients, 0)
    return said if said == RIGHT else f"{options}: {said}"


def subset(it) -> str:
    """Fewer inputs, which may need other kernels: the same gradients, to rounding."""
    rng = it.configuration.rng(4)
    names = [str(n) for n in rng.permutation(list(it.rollout.inputs))[: rng.integers(1, 4)]]
    other = it.configuration.rollout(gradients=names)
    found = other.vjp(other.forward(), it.w, it.z)
    if set(found) != set(names):
        return f"asked for {names}, got {list(found)}"
    return differs(found, it.gradients, 1e-12 if it.configuration.structure.precision == "f64" else 1e-5, names)


def products(it) -> str:
    """Gauss-Newton's product is J^T J; the Hessian's is symmetric."""
    rng, kind = it.configuration.rng(5), it.configuration.structure
    names = [n for n in it.rollout.inputs if np.any(it.gradients[n])]
    a, b = ({str(n): it.directions[n]} for n in rng.permutation(names)[:2])
    both = {n: np.zeros_like(it.directions[n]) for n in (*a, *b)}
    dot_gate, gate = it.gates
    dx, dy = (it.rollout.jvp(it.frames, **d)[0] for d in (a, b))
    product = verify.gauss_newton_product(it.rollout, it.frames, both | b)
    ours, size = sum(float((product[n] * d).sum()) for n, d in a.items()), np.linalg.norm(dx) * np.linalg.norm(dy)
    if abs(ours - float((dx * dy).sum())) > dot_gate * size:
        return f"gauss_newton_product of {list(both)}: {ours} for {float((dx * dy).sum())}"
    if kind.precision == "f32" or not kind.explicit:
        return RIGHT

    def loss(frames):  # quadratic in positions
        return 0.0, self_weight(it, frames), it.z

    rough = any(placed.kind.friction for placed in it.configuration.placed)  # C1: differences meet its kinks
    one, other = (verify.hessian_product(it.rollout, loss, both | d, epsilon=1e-4) for d in (a, b))
    left = sum(float((one[n] * d).sum()) for n, d in b.items())
    right = sum(float((other[n] * d).sum()) for n, d in a.items())
    size = max(abs(left), abs(right), 1e-3 * np.linalg.norm(it.w) * np.linalg.norm(dx) * np.linalg.norm(dy) / CELL)
    if abs(left - right) > (1e-3 if rough else 1e-4) * size:
        return f"hessian_product of {list(both)} is not symmetric: {left} and {right}"
    return RIGHT


def self_weight(it, frames):
    return it.w + (frames.positions - it.frames.positions) / CELL**2


# ---- clip and truncate ---------------------------------------------------------------------------------------------------


class Chain:
    """The run as single steps, or as a part of it, each a rollout of its own from the state before."""

    def __init__(self, it):
        self.it, self.configuration = it, it.configuration
        self.states = it.configuration.rollout(save_every=1).forward()
        self.values, scene = it.rollout.values, self.configuration.scene
        self.keyed, self.per_step = (
            set(),
            {n for n in ("external_forces",) if n in self.values and self.values[n].ndim == 3},
        )
        for term in scene.terms:
            if isinstance(term, GivenOverTime):
                name = scene.input_names(term)[term.plain]
                if term.keyed:
                    self.keyed.add(name)
                elif self.values[name].ndim > len(term.shape):
                    self.per_step.add(name)

    def part(self, first: int, steps: int, save_every: int):
        """(rollout, frames) of some steps from the state before step `first`."""
        rollout = self.configuration.part(first, steps, save_every=save_every, gradients="all")
        values = dict(
            initial_positions=self.states.positions[first].astype(np.float64),
            initial_velocities=self.states.velocities[first].astype(np.float64),
        )
        for name, rows in self.rows(first, steps).items():
            values[name] = self.values[name][rows] - (self.values[name][first] if name == "prescribed_motion" else 0)
        return rollout, rollout.forward(**values)

    def rows(self, first: int, steps: int) -> dict[str, slice]:
        """Which rows of inputs that are given over time a part reads."""
        out = {}
        for name in self.values:
            if name in self.per_step:
                out[name] = slice(first, first + steps)
            elif name in self.keyed or name == "prescribed_motion" or name.rstrip("_0123456789").endswith("_path"):
                out[name] = slice(first, first + steps + 1)
        return out

    def add(self, total: dict, part: dict, first: int, steps: int) -> None:
        rows = self.rows(first, steps)
        for name in total:
            if name in rows:
                total[name][rows[name]] += part[name]
            elif name not in ("initial_positions", "initial_velocities"):
                total[name] += part[name]

    def zeros(self) -> dict:
        return {name: np.zeros(value.shape) for name, value in self.values.items()}

    def gate(self) -> float:
        kind = self.configuration.structure
        return 2e-3 if kind.precision == "f32" else 1e-9 if kind.explicit else 1e-6

    def comparable(self) -> bool:
        """Whether a step depends on the state before it alone."""
        kind, solver = self.configuration.structure, self.configuration.solver
        shared = kind.solver is ds.VelocityVerletSolver and self.per_step
        # a start has no velocity in what is held, which friction, viscosity and a mass matrix with couplings would see
        couples = kind.order == 2 and not kind.explicit
        sees_held = kind.rollers or couples or self.configuration.scene.law.reads != ("H",)
        if kind.motion and sees_held:
            return False
        if self.configuration.scene.law.state_names:  # which a start has not
            return False
        # frames show velocities between two kicks as relations between places correct them, in which contact acts, too
        related = self.configuration.placed and self.configuration.scene.terms_of(ds.MultiPointConstraint)
        if related and kind.solver is ds.VelocityVerletSolver:
            return False
        return kind.solver is not ds.BDF2Solver and not shared and not (kind.static and solver.substeps > 1)


def clip(it) -> str:
    """Against single steps whose adjoint is scaled back between them."""
    chain, configuration = Chain(it), it.configuration
    if not chain.comparable() or configuration.structure.static or configuration.structure.motion:
        return RIGHT  # a prescribed vertex is no state
    if configuration.scene.reduced.rigid:
        return RIGHT  # whose adjoints are those of its vertices, of which a start takes a part
    steps, save = configuration.steps, configuration.options["save_every"]

    def sweep(limit: float) -> tuple[dict, list]:
        total, norms = chain.zeros(), []
        p, q = it.w[-1], it.z[-1]
        for k in range(steps - 1, -1, -1):
            rollout, frames = chain.part(k, 1, 1)
            zero = np.zeros_like(p)
            part = rollout.vjp(frames, np.stack([zero, p]), np.stack([zero, q]))
            chain.add(total, part, k, 1)
            total["rest_positions"] += part["initial_positions"]  # what moves is the displacement
            p, q = part["initial_positions"], part["initial_velocities"]
            if k % save == 0:
                p, q = p + it.w[k // save], q + it.z[k // save]
                scene = configuration.scene  # what is held has no velocity, what is reduced no other motions
                p, q = scene.reduced.of(p), scene.reduced.of(scene.supports.free(q))
            norms.append(float(np.hypot(np.linalg.norm(p), np.linalg.norm(q))))
            share = min(1.0, limit / norms[-1]) if norms[-1] > 0 else 1.0
            p, q = share * p, share * q
        total["rest_positions"] += it.w.sum(0) - it.w[-1] - p
        return total | dict(initial_positions=p, initial_velocities=q), norms

    _, norms = sweep(np.inf)
    limit = 0.5 * float(np.median(norms))
    expected, clipped = sweep(limit)
    rollout = configuration.rollout(clip=limit, health=True)
    found = rollout.vjp(rollout.forward(), it.w, it.z)
    seen = [float(np.hypot(h["norm_position"], h["norm_velocity"])) for h in rollout.health]
    if not np.allclose(seen, clipped, rtol=10 * chain.gate()):
        return f"norms {np.array(seen)} for {np.array(clipped)}"
    return differs(found, expected, 10 * chain.gate(), [n for n in expected if n != "rest_positions"], it.floors)


def truncate(it) -> str:
    """Against two chained rollouts of which only the second is differentiated; rows of later steps as in the full sweep."""
    chain, configuration = Chain(it), it.configuration
    steps, save = configuration.steps, configuration.options["save_every"]
    cut = save * int(configuration.rng(6).integers(0, steps // save))
    rollout = configuration.rollout(truncate=steps - cut)
    found = rollout.vjp(rollout.forward(), it.w, it.z)
    if cut == 0:
        return differs(found, it.gradients, 0)
    if any(np.any(found[name]) for name in ("initial_positions", "initial_velocities")):
        return "gradients by the start are not zero"
    for name, rows in chain.rows(cut, steps - cut).items():
        # the kick at the cut takes half of the force of the step before it
        shared = int(name in chain.per_step and configuration.structure.solver is ds.VelocityVerletSolver)
        if np.any(found[name][: rows.start - shared]):
            return f"{name}: rows before the cut are not zero"
        if np.any(found[name][rows.start + 1 :] != it.gradients[name][rows.start + 1 :]):
            return f"{name}: rows after the cut are not those of the full sweep"
    if not chain.comparable():
        return RIGHT
    part, frames = chain.part(cut, steps - cut, save)
    w, z = (np.concatenate([np.zeros_like(x[:1]), x[cut // save + 1 :]]) for x in (it.w, it.z))
    own = part.vjp(frames, w, z)
    expected = chain.zeros()
    chain.add(expected, own, cut, steps - cut)
    return differs(found, expected, chain.gate(), [n for n in expected if n != "rest_positions"], it.floors)


ALWAYS = (repeats, schedules)
IN_TURN = (faces.tape, faces.torch_frames, truncate, clip, subset, products, scenes_at_once, faces.torch_simulator)


def run_checks(it) -> dict[str, str]:
    """The cheap ones always, one of the others in turn."""
    return {check.__name__: check(it) for check in (*ALWAYS, IN_TURN[it.configuration.seed % len(IN_TURN)])}
