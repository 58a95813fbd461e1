"""Forces at the states that frames show, with derivatives, for outputs: of loads, and of the body's own stress."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.differentiation.arrays import jointly, summed_at, value_of
from diffsim_ti.inputs import Derived
from diffsim_ti.mechanics.chambers.multipliers import HeldPressure
from diffsim_ti.mechanics.host_force import HostForces, Instant
from diffsim_ti.mechanics.interactions import host_forces
from diffsim_ti.mechanics.loads.interaction import DeadLoads
from diffsim_ti.mechanics.stress.patched_tetrahedron import ElementKernels
from diffsim_ti.runtime import A, Kernel, as_kernel
from diffsim_ti.state.arrays import SceneArrays
from diffsim_ti.state.numbers import ADJOINT, SCENE, TANGENT, Adjoint, Tangent, with_state
from diffsim_ti.state.schedule import EqualSteps
from diffsim_ti.terms import Chamber, Gravity, Growth

STEPS = EqualSteps(1.0, 1)  # a pass for each step
STATE = dict(u="vectors2", v="vectors2")
CORNERS = dict(corner="vectors", rate_corner="vectors")


def at_end(step: int, begins: bool = False) -> Instant:
    """That of a frame after so many steps."""
    return Instant(STEPS, max(step - 1, 0), float(step > 0 and not begins))


class AppliedLoads:
    """Forces [N], shape (num_vertices, 3): weight, dead loads and those of interactions, after so many steps: those of the
    last of these as it ends; with `begins`, as it begins.

    moving: with those that read velocities v [m/s], which `forces` is then to be told.
    held: the pressures [Pa] of the scene's chambers in a frame, of which those are taken that hold a volume.
    """

    def __init__(self, scene, weight: bool = True, moving: bool = False):
        self.elements, self.num_chambers = scene.mesh.elements, len(scene.terms_of(Chamber))
        self.hosts = HostForces(force for force in host_forces(scene) if moving or not force.reads_velocities)
        self.filled = self.hosts.only(HeldPressure)
        gravity = scene.term(Gravity) if weight else None
        self.gravity = None if gravity is None else scene.inputs.parameters.of(gravity)
        self.dead = scene.interaction(DeadLoads)

    @property
    def any(self) -> bool:
        """Whether there is one."""
        return bool(self.hosts) or self.gravity is not None or self.dead is not None

    @staticmethod
    def _row(step: int, rows: np.ndarray) -> np.ndarray:
        return rows[min(max(step - 1, 0), len(rows) - 1)]

    def _dead(self, step: int, rows: np.ndarray, begins: bool) -> np.ndarray:
        """Of rows of loads, or of their adjoints, those that a frame shows (inputs/loads.py), as a view."""
        row = self._row(step, rows)
        return row[1 if step and not begins else 0 :: 2] if self.dead.keyed else row

    def _masses(self, derived: Derived) -> np.ndarray:
        """What gravity acts on, shape (num_vertices,), or its change."""
        if derived.element_masses is None:
            return derived.mass
        return summed_at(self.elements, derived.element_masses.sum(2), len(derived.mass))

    def _hosts(self, derived: Derived, x, step: int, begins: bool, held, v) -> HostForces:
        """As they are in a frame."""
        instant = at_end(step, begins)
        if v is not None:
            instant = replace(instant, origin=x - derived.rest - v, gamma=1.0)
        hosts = self.hosts.take(derived, instant)
        if self.filled and held is not None:
            for law, k in zip(self.filled.laws, self.filled.places):
                law.multiplier = float(held[k])  # without a penalty, gamma: the pressure whatever the volume
        return hosts

    def _unit_forces(self, x: np.ndarray) -> list:
        """(place of a chamber that holds a volume, forces of 1 Pa in it) of each."""
        places = self.filled.places if self.filled else []
        return [(place, self.filled.unit_forces(x - self.filled.rest, k)) for k, place in enumerate(places)]

    def forces(self, derived: Derived, x: np.ndarray, step: int, begins: bool = False, held=None, v=None) -> np.ndarray:
        """At places x [m] after so many steps; of arrays that record, too."""
        of, at, shown, found = value_of(derived), value_of(x), (value_of(held), value_of(v)), []
        out, u = np.zeros(at.shape), at - of.rest
        if self.gravity is not None:
            out = out + self._masses(derived)[:, None] * derived.parameters[self.gravity][:3]
        if self.dead:
            out = out + summed_at(self.dead.acts_at, self._dead(step, derived.forces, begins), len(at))

        def push(moved, dx, dv, dheld):
            moved = of.zeros() if moved is None else moved
            changes = (np.zeros(at.shape) if change is None else change for change in (dx, dv))
            du, dv = (change - rest for change, rest in zip(changes, (moved.rest, 0.0)))
            df = self._hosts(of, at, step, begins, *shown).jvp(u, du, dv, moved)
            return df if dheld is None else df + sum(dheld[k] * push for k, push in self._unit_forces(at))

        def by_numbers(w):
            def add(into):
                found[:] = self._hosts(of, at, step, begins, *shown).vjp(u, w, into)
                into.rest = into.rest - found[0]

            return add

        def by_held(w):
            by = np.zeros(self.num_chambers)  # zero of gases
            for k, push in self._unit_forces(at):
                by[k] = float((push * w).sum())
            return by

        parents = (derived, by_numbers), (x, lambda _: found[0]), (v, lambda _: found[1]), (held, by_held)
        return out + jointly(self._hosts(of, at, step, begins, *shown).forces(u), push, *parents)


@dataclass(frozen=True)
class BodyForceKernels(ElementKernels):
    """At the displacement and velocity in slot 0 of `at`."""

    def _kernel(self, name: str, body, **arrays) -> Kernel:
        own = (
            dict(scene=SCENE, at=with_state(STATE, self.law), out=CORNERS | dict(y="vectors2", y_rate="vectors2"))
            | arrays
        )
        return Kernel(name, body, self.law.precision, own, dict(num_items="int", num_vertices="int"))

    @as_kernel("body_forces")
    def forces(self, scene: A, at: A, out: A, plan: A):
        for e in range(plan.num_items):
            self.element.forces(e, scene, at, 0, out.corner)
        for i in range(plan.num_vertices):
            out.y[0, i] = self.element.gather(i, scene, out.corner)

    @as_kernel("body_forces_jvp", change=lambda self: with_state(STATE, self.law), tangent=TANGENT)
    def jvp(self, scene: A, at: A, out: A, change: A, tangent: A, plan: A):
        for e in range(plan.num_items):
            self.element.forces_jvp(e, scene, at, 0, change, out.corner, tangent)
        for i in range(plan.num_vertices):
            out.y[0, i] = self.element.gather(i, scene, out.corner)

    @as_kernel(
        "body_forces_vjp",
        seed=dict(w="vectors2"),
        adjoint=lambda self: with_state(ADJOINT | dict(rate_corner="vectors"), self.law),
    )
    def vjp(self, scene: A, at: A, out: A, seed: A, adjoint: A, plan: A):
        for e in range(plan.num_items):
            self.element.forces_vjp(e, scene, at, 0, seed.w, out.corner, adjoint, True)
        for i in range(plan.num_vertices):
            out.y[0, i] = self.element.gather(i, scene, out.corner)
            if ti.static(self.element.reads_rates):
                out.y_rate[0, i] = self.element.gather(i, scene, out.rate_corner)


class BodyForces:
    """Forces -dE/du [N] of stress, shape (num_vertices, 3), at the states that frames show, for outputs of any law."""

    def __init__(self, scene):
        if scene.term(Growth):
            raise ValueError(
                "forces of the body at frames do not support Growth over time; take Grown(material, growth)"
            )
        self.scene, self.arrays = scene, SceneArrays(scene)
        a = self.arrays
        self.at, self.change, self.out = (
            SimpleNamespace(**{name: runtime.array(a.vector, 1, a.num_vertices) for name in names})
            for names in (("u", "v", "w"), ("u", "v"), ("y", "y_rate"))
        )
        self.at.z, self.change.z, self.out.z = (a.law_states(1) for _ in range(3))
        self.out.corner, self.out.rate_corner = (runtime.array(a.vector, *a.corner.shape) for _ in range(2))

    def load(self, values: dict) -> Derived:
        """The numbers of a run; what kernels read of them."""
        return self.take(self.scene.inputs.derive(values))

    def take(self, derived: Derived) -> Derived:
        """The same, of what kernels read."""
        self.arrays.load(derived)
        a = self.arrays
        self.kernels = runtime.kernels_of(BodyForceKernels, a.law, a.features().of_elements(), True, a.in_lanes)
        return derived

    def at_frames(self, derived: Derived, u: np.ndarray, v: np.ndarray, z: np.ndarray) -> np.ndarray:
        """f at the states of frames, shape (frames, num_vertices, 3): displacements, velocities, what the law remembers; of
        arrays that record, too."""
        of, states, found = self.take(value_of(derived)), [value_of(x) for x in (u, v, z)], []

        def each(*more):
            for state, *others in zip(zip(*states), *more):
                self.place(*state)
                yield others

        def push(moved, *changes):
            changes = [np.zeros(x.shape) if dx is None else dx for x, dx in zip(states, changes)]
            records = dict(change=self.change, tangent=Tangent(self.arrays, of.zeros() if moved is None else moved))
            out = []
            for change in each(*changes):
                self._put(self.change, *change)
                out.append(self._run("jvp", **records))
            return np.stack(out)

        def by_numbers(w):
            adjoint = Adjoint(self.arrays, self.arrays.features(True, True))
            adjoint.clear()
            found[:] = zip(*[self._pull(own, adjoint) for (own,) in each(w)])
            adj = adjoint.collect()
            adj.element_masses = None
            return lambda into: into.add(adj)

        parents = [(x, lambda _, k=k: np.stack(found[k]).reshape(states[k].shape)) for k, x in enumerate((u, v, z))]
        return jointly(np.stack([self.forces() for _ in each()]), push, (derived, by_numbers), *parents)

    def _run(self, name: str, **records) -> np.ndarray:
        a = self.arrays
        launch = getattr(self.kernels, name).bind(a.in_vectors, scene=a, at=self.at, out=self.out, **records)
        launch(num_items=a.num_items, num_vertices=a.num_vertices)
        return runtime.fetch_row(self.out.y, 0)

    def place(self, u: np.ndarray, v: np.ndarray, law_state: np.ndarray | None = None) -> None:
        """Go to a displacement [m] and a velocity [m/s], and to what the law remembers."""
        self._put(self.at, u, v, law_state)

    def _put(self, record, u: np.ndarray, v: np.ndarray, z: np.ndarray | None) -> None:
        if record.z is not None:
            runtime.fill(record.z, self.arrays.to_blocks(z)[None])
        runtime.fill(record.u, u[None])
        runtime.fill(record.v, v[None])

    def forces(self) -> np.ndarray:
        """f there."""
        return self._run("forces")

    def _pull(self, w: np.ndarray, adjoint: Adjoint) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """(adjoint of u, of v, of what the law remembers) for that of f; adds those of coefficients, grad N and V."""
        runtime.fill(self.at.w, w[None])
        if self.out.z is not None:
            runtime.fill(self.out.z, 0)
        runtime.fill(self.out.y_rate, 0)
        by_u = self._run("vjp", seed=self.at, adjoint=(adjoint, self.out))
        by_z = None if self.out.z is None else self.arrays.law_state_of(runtime.fetch(self.out.z)[0])
        return by_u, runtime.fetch_row(self.out.y_rate, 0), by_z
