"""Vertices that move by a basis in explicit passes, those that ties glue among them: a stage after the kick and drift.

With B the basis of what they can do and M their masses, where a pass has led each vertex by itself goes to the nearest place
that they can have, and so do velocities:

    u' = P u*,    v' = P v*,    P = B G^-1 B^T M,    G = B^T M B

That is the pass of the equations of motion in the numbers q of B, G q'' = B^T f: forces of constraint do no work, momentum
is kept where B has the rigid motions, and the largest frequency is at most that of vertices by themselves. Frames show
P (v + pre a). Derivatives by masses are dP x = S dM (x - P x) with S = B G^-1 B^T. Each pass takes products with B, which is
dense.
"""

import weakref
from contextlib import contextmanager, nullcontext

import numpy as np

from diffsim_ti.common.blas_threads import one_blas_thread
from diffsim_ti.inputs import Derived
from diffsim_ti.mechanics.stage import Passes, Stage
from diffsim_ti.runtime.slots import VertexRows
from diffsim_ti.terms.reduced import Together


class Projection:
    """P and S of one set, for vectors of its vertices, shape (k, 3)."""

    def __init__(self, body: Together, mass: np.ndarray):
        self.B, self.mass = body.basis, mass[:, None]
        weights = mass if body.per_component else np.repeat(mass, 3)
        self.left = np.linalg.solve(self.B.T @ (weights[:, None] * self.B), self.B.T).T  # B G^-1

    def S(self, y: np.ndarray) -> np.ndarray:
        return (self.left @ (self.B.T @ y.reshape(len(self.B), -1))).reshape(y.shape)

    def P(self, x: np.ndarray) -> np.ndarray:
        return self.S(self.mass * x)

    def transposed(self, y: np.ndarray) -> np.ndarray:
        return self.mass * self.S(y)


class ProjectedSets(Stage):
    """Those of a run's scene; `work` [J] that the stage adds to what passes note of loads."""

    def __init__(self, workspace):
        self.ws, bodies = weakref.proxy(workspace), workspace.scene.reduced.by_basis
        self.bodies, self._first = bodies, np.cumsum([0, *(len(body.vertices) for body in bodies)])
        self.nodes = np.concatenate([body.vertices for body in bodies])
        self._own, self._known = VertexRows(workspace.arrays, self.nodes), (None, ())
        self.rows, self.put = self._own.get, self._own.put
        self.kept, self.work = {}, 0.0  # of recorded passes, by the slot they led to: u*, v*

    @property
    def mass(self) -> np.ndarray:
        return self.ws.arrays.values.mass[self.nodes]

    @one_blas_thread
    def each(self, name: str, x: np.ndarray) -> np.ndarray:
        """ "P", "S" or "transposed" of vectors of all sets' vertices, shape (n, 3)."""
        values = self.ws.arrays.values
        parts = [slice(*ends) for ends in zip(self._first, self._first[1:])]
        if self._known[0] is not values:
            self._known = values, [Projection(body, self.mass[own]) for body, own in zip(self.bodies, parts)]
        return np.concatenate([getattr(p, name)(x[own]) for p, own in zip(self._known[1], parts)])

    def pulled(self, forces: np.ndarray) -> np.ndarray:
        """Forces [N] on all vertices with those that hold the sets together."""
        out = np.array(forces)
        out[self.nodes] = self.each("transposed", out[self.nodes])
        return out

    def frame(self, at: Passes) -> int:
        """The frame whose velocity a pass shows between its kicks, or -1."""
        return int(self.ws.solver.schedule.shown(at.j, at.save_every)) if at.now.pre > 0 and at.save_every else -1

    def shown(self, at: Passes) -> np.ndarray:
        """v + pre a of a recorded pass."""
        arrays, history = self.ws.arrays, at.history
        a = self.rows(history.f, at.slot) / self.mass[:, None] + arrays.gravity_of(arrays.values)
        return self.rows(history.v, at.slot) + at.now.pre * a

    def alone(self, at: Passes):
        """A recorded pass without the stage; then the record is what it was."""
        kept = self.kept.get(at.end)
        return nullcontext() if kept is None else self._own.replaced(at.history, at.end, *kept)

    @contextmanager
    def do(self, at: Passes):
        before = self.rows(at.history.v, at.slot)
        yield
        history, slot, now = at.history, at.end, at.now
        u, v = self.rows(history.u, slot), self.rows(history.v, slot)
        if at.stride:
            self.kept[slot] = u, v
        v_next = self.each("P", v)
        self.put(history.u, slot, self.each("P", u))
        self.put(history.v, slot, v_next)
        change, after, whole = (v_next - v) / now.decay, v / now.decay, now.pre + now.post
        uneven = (now.pre - now.post) * (after - before) / whole
        self.work += 0.5 * float((self.mass[:, None] * change * (before + after + change + uneven)).sum())
        frame = self.frame(at)
        if frame >= 0:
            shown = self.ws.frames.frames_v
            self.put(shown, frame, self.each("P", self.rows(shown, frame)))


class ProjectedTangent(Stage):
    """Of a run, which holds the changes of the state and of frames."""

    def __init__(self, sets: ProjectedSets, run):
        self.sets, self.mass = sets, run.tangent.mass[sets.nodes, None]

    def _change(self, x: np.ndarray, dx: np.ndarray) -> np.ndarray:
        """Of P x."""
        each = self.sets.each
        return each("P", dx) + each("S", self.mass * (x - each("P", x)))

    @contextmanager
    def tangent(self, at: Passes):
        sets, run = self.sets, at.run
        with sets.alone(at):
            yield
        for own, x in zip((run.u, run.v), sets.kept[at.end]):
            sets.put(own, 0, self._change(x, sets.rows(own, 0)))
        frame = sets.frame(at)
        if frame >= 0:
            own = run.frames.frames_v
            sets.put(own, frame, self._change(sets.shown(at), sets.rows(own, frame)))


class ProjectedAdjoint(Stage):
    """Of a run, which holds the adjoints of the state and of frames.

    Where a sweep stops at the state that a pass shows, between its kicks, that state is P (v + pre a), and what follows is a
    function of it; the kick before it is gone back through by itself.
    """

    in_kicks = True

    def __init__(self, sets: ProjectedSets, run):
        self.sets = sets

    def clear(self) -> None:
        self.by_mass = np.zeros(len(self.sets.nodes))

    def _back(self, array, slot: int, x: np.ndarray, share: float = 1.0) -> None:
        """From the adjoint of P x to that of x, of which a share is not what the state shows."""
        sets = self.sets
        adjoint = sets.rows(array, slot)
        self.by_mass += share * (sets.each("S", adjoint) * (x - sets.each("P", x))).sum(1)
        sets.put(array, slot, sets.each("transposed", adjoint))

    @contextmanager
    def adjoint(self, at: Passes):
        sets, run, now = self.sets, at.run, at.now
        if at.kick:
            self._back(run.v, 0, sets.shown(at))
            yield
            return
        run.complete()
        halts = at.j == at.halt
        share = now.post / (now.pre + now.post) if halts else 1.0
        for own, x in zip((run.u, run.v), sets.kept[at.end]):
            self._back(own, 0, x, share)
        frame = sets.frame(at)
        if frame >= 0 and not halts:
            self._back(run.frames.frames_v, frame, sets.shown(at))
        with sets.alone(at):
            yield

    def collect(self, out: Derived) -> None:
        by_mass = np.zeros(len(out.displacement))
        by_mass[self.sets.nodes] = self.by_mass
        out.mass = out.mass + by_mass
