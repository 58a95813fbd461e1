"""Friction between surfaces as a stage of explicit passes: its arrays, and what is kept of recorded passes."""

from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.surfaces.buffers import whole
from diffsim_ti.mechanics.surfaces.friction_kernels import FrictionKernels
from diffsim_ti.runtime import kernels_of
from diffsim_ti.terms.self_contact import SelfContact


class PairFriction:
    """Of the pairs of a scene (surface_pairs.py) some of whose contacts have friction.

    A pass begins with `measure`, after `pairs.forces`, and ends with `slide`.
    takes_pending: whether `slide_vjp` gathers what corners still hold of the adjoints.
    """

    takes_pending = True

    def __init__(self, pairs):
        self.pairs, a = pairs, pairs.a
        self.a, self.num_surface = a, len(a.mesh.surface_vertices)
        labels, rows = np.zeros(self.num_surface, int), np.full((1, 1), -1)
        if pairs.term and pairs.term.has_friction:
            labels, rows = pairs.term.labels(a.mesh)
        self.num_rows, partly_fixed = int(rows.max()) + 1, bool(len(a.supports.partly_fixed))
        row_of = rows.ravel()
        if pairs.contacts:
            self.num_rows, row_of = len(pairs.contacts.mu), np.concatenate([row_of, pairs.contacts.row_of])
        self.kernels = kernels_of(FrictionKernels, a.precision, pairs.first, pairs.parallel, partly_fixed, len(rows))
        n = self.num_surface
        self.own = SimpleNamespace(
            any=runtime.array(ti.i32, 1), in_friction=runtime.array(ti.i32, n), load=runtime.array(a.fp, n)
        )
        runtime.fill(self.own.in_friction, 0)
        self.own.label, self.own.row_of = runtime.upload(labels, ti.i32), runtime.upload(row_of, ti.i32)
        self.kept_u = self.kept_v = runtime.array(a.vector, 1, 1)
        self.adjoints = None
        self._sliding_supports = (
            dict(sliding_slot=a.sliding_slot, sliding_supports=a.sliding_supports) if partly_fixed else {}
        )

    def make_room(self) -> None:
        """Arrays of a new list."""
        self.take("weights", "pressing")

    def take(self, *names: str, scalar: bool = False) -> None:
        """Arrays of all pairs of the list, by name."""
        for name in names:
            dtype = self.a.fp if scalar else self.pairs.kernels.vec4
            setattr(self.own, name, self.pairs.list.buffers.take(f"{name} of friction", dtype, self.pairs.list.count))

    def run(self, kernel, at: dict, **numbers) -> None:
        self.pairs.run(kernel, at | self._sliding_supports, self.own, **numbers)

    def _state(self, history) -> dict:
        return dict(u=history.u, v=history.v, inverse_mass=self.a.inverse_mass, kept_u=self.kept_u, kept_v=self.kept_v)

    @staticmethod
    def pass_numbers(plan) -> dict:
        """Length of a pass, and the displacement by a change of velocity after it."""
        return dict(h=plan.h, ratio=plan.alpha / plan.decay)

    def keep(self, num_slots: int) -> None:
        """Room for what the passes to so many slots led to."""
        if self.kept_u.shape[0] < num_slots or self.kept_u.shape[1] < self.num_surface:
            self.kept_u, self.kept_v = (runtime.array(self.a.vector, num_slots, self.num_surface) for _ in range(2))
            self.pairs.unbind()

    def measure(self, u, slot: int) -> None:
        """A pass begins at u[slot], where `pairs.forces` were computed."""
        if not self.pairs.list.count:
            runtime.fill(self.own.any, 0)
            return
        self.run(self.kernels.measure, dict(u=u), slot=slot)

    def slide(self, history, slot: int, plan, recording: bool) -> None:
        """The pass led to a slot."""
        host = runtime.view(self.own.any)
        if plan.alpha > 0 and (recording or host is None or host[0]):
            keep = slot if recording else -1
            self.run(self.kernels.slide, self._state(history), slot=slot, keep=keep, **self.pass_numbers(plan))

    @contextmanager
    def alone(self, history, slot: int):
        """A recorded pass to a slot without friction; then the record is what it was."""
        self._swap(history, slot)
        yield
        self._swap(history, slot)

    def _swap(self, history, slot: int) -> None:
        self.run(self.kernels.swap, self._state(history), slot=slot, keep=slot)

    def _begin(self, history, slot: int) -> None:
        """Measure again where a recorded pass began."""
        self.pairs.ensure(history.u, slot)
        self.pairs.forces(history.u, slot, self.a.corner)
        self.measure(history.u, slot)

    # ---- tangent -----------------------------------------------------------------------------------------------------

    def begin_jvp(self, history, slot: int, u_dot, numbers) -> None:
        """What presses changes with u_dot[0] and `numbers`, a Tangent."""
        self._begin(history, slot)
        self.changes(history.u, slot, u_dot, numbers)

    def changes(self, u, slot: int, u_dot, numbers) -> None:
        self.take("weights_dot", "pressing_dot")
        if not hasattr(self.own, "load_dot"):
            self.own.load_dot = runtime.array(self.a.fp, self.num_surface)
        at = dict(u=u, w=u_dot, rest_dot=numbers.rest, parameters_dot=numbers.parameters)
        if self.pairs.contacts:
            parameters = runtime.fetch(numbers.parameters)[: len(self.a.values.parameters)].astype(np.float64)
            self.pairs.contacts.load_change(self.a.values.parameters, parameters)
            at |= dict(numbers_dot=self.pairs.contacts.numbers_dot)
        self.run(self.kernels.measure_jvp, at, slot=slot)

    def slide_jvp(self, history, slot: int, plan, rate_dot: float, u_dot, v_dot, numbers) -> None:
        """Adds to the changes of the state that the pass to a slot led to, without friction there (`alone`)."""
        at = dict(du=u_dot, dv=v_dot, mass_dot=numbers.mass, parameters_dot=numbers.parameters)
        own = dict(ratio_dot=rate_dot * ratio_by_rate(plan), **self.pass_numbers(plan))
        self.run(self.kernels.slide_jvp, self._state(history) | at, slot=slot, keep=slot, **own)

    # ---- adjoint -----------------------------------------------------------------------------------------------------

    def clear_sums(self) -> None:
        """Begin a reverse sweep."""
        if self.adjoints is None:
            n, a = self.num_surface, self.a
            own = {name: runtime.array(a.fp, n) for name in ("by_rate", "by_mass", "by_speed")}
            own |= dict(by_mu=runtime.array(a.fp, n * self.num_rows), by_place=runtime.array(a.vector, n))
            self.adjoints, self.own.load_adj = own, runtime.array(a.fp, n)
            self.own.pulled = runtime.array(a.vector, n)
        for array in self.adjoints.values():
            runtime.fill(array, 0)

    def slide_vjp(self, history, slot: int, plan, adjoint) -> None:
        """From the adjoints of the state after the pass from a slot to that before the stage; with `alone`.

        adjoint: has u, v and the corners that still hold a part of them. `by_place` has then to be added.
        """
        self._begin(history, slot)
        self.take("weights_adj", "pressing_adj")
        self.take("mu_adj", scalar=True)
        at = self._state(history) | self.adjoints | dict(place=history.u, u_adj=adjoint.u, v_adj=adjoint.v)
        at |= dict(start=self.a.start, corners=self.a.corner_of)
        at |= dict(corner_adj=adjoint.corner, rate_corner=adjoint.rate_corner)
        own = dict(begin=slot, rates=int(adjoint.rate_corner.shape[0] > 1))
        own |= dict(num_rows=self.num_rows, ratio_by_rate=ratio_by_rate(plan))
        self.run(self.kernels.slide_vjp, at, slot=slot + 1, keep=slot + 1, **own, **self.pass_numbers(plan))

    def _pull_back(self, u, slot: int, felt: np.ndarray, w_adj: np.ndarray, pressing_adj: np.ndarray) -> np.ndarray:
        """Adjoint of u[slot] at surface vertices for those of the weights and of (n, mu N) of some pairs; adds those of the
        numbers and of the rest shape."""
        self.take("weights_adj", "pressing_adj")
        self.take("mu_adj", scalar=True)
        for array, data in ((self.own.weights_adj, w_adj), (self.own.pressing_adj, pressing_adj)):
            every = np.zeros((array.shape[0], 4))
            every[felt] = data
            runtime.fill(array, every)
        runtime.fill(self.own.load_adj, 0)
        at = dict(place=u, by_place=self.adjoints["by_place"], by_mu=self.adjoints["by_mu"])
        self.run(self.kernels.measure_vjp, at, slot=slot, begin=slot, num_rows=self.num_rows)
        return runtime.fetch(self.adjoints["by_place"])

    def add_place(self, adjoint) -> None:
        """Add the adjoint of the displacement where the pass began."""
        u = runtime.fetch(adjoint.u)
        u[0, self.a.mesh.surface_vertices] += runtime.fetch(self.adjoints["by_place"])
        runtime.fill(adjoint.u, u)

    @property
    def speeds_at(self) -> np.ndarray:
        """Where the friction speed of each contact stands among the parameters."""
        if self.pairs.contacts:
            return self.pairs.contacts.rows[:, 2]
        return np.array([self.pairs.first + SelfContact.index.friction_speed])

    def collect(self, out: np.ndarray) -> None:
        """Adds the adjoints of friction speeds and coefficients to those of all parameters, float64."""
        by_mu = whole(self.adjoints["by_mu"]).astype(np.float64).reshape(-1, self.num_rows).sum(0)
        by_speed = whole(self.adjoints["by_speed"]).astype(np.float64)[: self.num_surface]
        contacts, first = self.pairs.contacts, self.pairs.first + SelfContact.index.friction
        out[contacts.mu if contacts else slice(first, first + self.num_rows)] += by_mu
        owner = contacts.surface.owner if contacts else np.zeros(self.num_surface, int)
        np.add.at(out, self.speeds_at[owner], by_speed)

    def collect_pass(self) -> tuple[np.ndarray, float]:
        """Adjoints of the masses and of the drag rate by the stage, float64."""
        mass = np.zeros(self.a.num_vertices)
        mass[self.a.mesh.surface_vertices] = whole(self.adjoints["by_mass"])
        return mass, float(whole(self.adjoints["by_rate"]).astype(np.float64).sum())


def ratio_by_rate(plan) -> float:
    """Derivative of the displacement by a change of velocity after a pass, alpha / decay, by the drag rate."""
    return (plan.alpha_by_rate * plan.decay - plan.alpha * plan.decay_by_rate) / plan.decay**2
