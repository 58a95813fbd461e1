"""Volumes that explicit passes hold: a stage after all else in a pass, and its derivatives.

A pass led from places x to y* with velocities v*. Each chamber's pressure p has pushed its walls since x as they were there:

    y = y* + sum_k s_k d_k,    v' = v* + r sum_k s_k d_k,    d_k = P M^-1 dV_k/dx (x),    V_k(y) = target_k

s = alpha (pre + post) p and r = decay / alpha in the words of kick_drift.py, P what vertices may do. What a frame shows of a
velocity between two kicks is made tangent to the volumes there: v + sum_k q_k d_k with dV_k/dx . v' = the target's rate.
So velocity Verlet is SHAKE, with the velocities of RATTLE.
Leimkuhler, Reich 2004, Simulating Hamiltonian Dynamics, 7.2, doi:10.1017/CBO9780511614118.
"""

import weakref
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from diffsim_ti.inputs import Derived
from diffsim_ti.mechanics.chambers.pressures import rows_of
from diffsim_ti.mechanics.stage import Passes, Stage
from diffsim_ti.mesh.enclosure import Enclosure
from diffsim_ti.runtime.slots import VertexRows
from diffsim_ti.terms import Chamber, FilledChamber


class VolumeLost(FloatingPointError):
    """No pressure leads to the volume that a chamber is to hold."""


@dataclass
class ChamberWalls:
    """Of chambers where a pass begins: places x, shape (n, 3), 1 / m, shape (n, 1), what they may do, shape (n, 3, 3)."""

    enclosures: list[Enclosure]
    x: np.ndarray
    inverse: np.ndarray
    free: np.ndarray

    def freed(self, x: np.ndarray) -> np.ndarray:
        """What they may do of vectors."""
        return np.einsum("nij,nj->ni", self.free, x)

    def gradients(self, y: np.ndarray) -> np.ndarray:
        """dV/dx at y, shape (chambers, n, 3)."""
        return np.stack([enclosure.gradient(y) for enclosure in self.enclosures])

    def turned(self, dx: np.ndarray) -> np.ndarray:
        """Changes of dV/dx at x."""
        return np.stack([enclosure.gradient_jvp(self.x, dx) for enclosure in self.enclosures])

    @cached_property
    def g(self) -> np.ndarray:
        """dV/dx where the pass begins."""
        return self.gradients(self.x)

    @cached_property
    def d(self) -> np.ndarray:
        """Displacements by the pressures."""
        return np.stack([self.freed(self.inverse * g) for g in self.g])

    def meet(self, y: np.ndarray, targets: np.ndarray) -> np.ndarray | None:
        """s that leads from y to the targets, or None."""
        s, near = np.zeros(len(targets)), False
        for _ in range(20):
            at = y + np.tensordot(s, self.d, 1)
            left = targets - [enclosure.volume(at) for enclosure in self.enclosures]
            try:
                s = s + np.linalg.solve(slopes(self.gradients(at), self.d), left)
            except np.linalg.LinAlgError:
                return None
            if near:
                return s if np.all(np.isfinite(s)) else None
            near = bool(np.all(np.abs(left) <= 1e-9 * np.abs(targets)))  # the next one ends at round-off
        return None

    def pushed_jvp(self, s: np.ndarray, dx: np.ndarray, dinverse: np.ndarray) -> np.ndarray:
        """Change of sum_k s_k d_k for that of x and of 1 / m."""
        turned = self.turned(dx)
        return sum(s_k * self.freed(dinverse * g + self.inverse * h) for s_k, g, h in zip(s, self.g, turned))

    def pushed_vjp(self, s: np.ndarray, adjoint: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Its adjoint: of x and of 1 / m, shape (n, 1)."""
        w = self.freed(adjoint)
        by_inverse = sum(s_k * (g * w).sum(1, keepdims=True) for s_k, g in zip(s, self.g))
        return self.turned_vjp(s, self.inverse * w), by_inverse

    def turned_vjp(self, weights: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Adjoint of x, for the weighted sum of dV/dx . w."""
        return sum(by * enclosure.gradient_jvp(self.x, w) for by, enclosure in zip(weights, self.enclosures))

    def moved(self, y: np.ndarray) -> np.ndarray | float:
        """Changes of V at y for those of numbers of its own."""
        return 0.0

    def moved_vjp(self, weights: np.ndarray, y: np.ndarray) -> None:
        """Add the adjoints of these numbers for the weighted sum of V."""


def slopes(G: np.ndarray, d: np.ndarray) -> np.ndarray:
    """G_k . d_l."""
    return np.tensordot(G, d, ([1, 2], [1, 2]))


def along(G: np.ndarray, x: np.ndarray) -> np.ndarray:
    """G_k . x."""
    return np.tensordot(G, x, ([1, 2], [0, 1]))


class VolumeConstraints(Stage):
    """Those of a run's scene; `pressures` [Pa] of the last pass and of frames, `work` [J] on the body so far."""

    def __init__(self, workspace):
        self.ws, scene = weakref.proxy(workspace), workspace.scene
        filled, chambers = scene.terms_of(FilledChamber), scene.terms_of(Chamber)
        self.places, self.num_chambers = [chambers.index(chamber) for chamber in filled], len(chambers)
        self.columns = [rows.start for rows in rows_of(scene, filled)]  # of their targets among the numbers of loads
        closed = [chamber.enclosure for chamber in filled]
        self._hold(workspace, np.unique(np.concatenate([enclosure.triangles.ravel() for enclosure in closed])))
        self.enclosures = [enclosure.of_nodes(self.nodes) for enclosure in closed]

    numbers = "follower"  # rows of `Derived` in which targets are
    is_shown = True  # whether frames say what holds

    def _hold(self, workspace, nodes: np.ndarray) -> None:
        scene, self.nodes = workspace.scene, nodes
        self.free = scene.supports.freedom(scene.mesh.num_vertices)[self.nodes]
        self._own = VertexRows(workspace.arrays, self.nodes)
        self.rows, self.put = self._own.get, self._own.put
        self.kept = {}  # of recorded passes, by the slot they led to: places and velocities before the stage, and s
        self.last, self.of_frames, self.work = np.zeros(len(self.places)), {}, 0.0

    def spread(self, pressures: np.ndarray) -> np.ndarray:
        """Among those of all chambers, of which others have none here."""
        out = np.zeros(self.num_chambers)
        out[self.places] = pressures
        return out

    def of_all(self, num_frames: int) -> np.ndarray:
        """Of the frames of the last run, shape (frames, chambers); the first has none."""
        none = np.zeros(len(self.places))
        return np.stack([self.spread(self.of_frames.get(k, none)) for k in range(num_frames)])

    @property
    def rest(self) -> np.ndarray:
        return self.of_rest(self.ws.arrays.values.rest)

    def of_rest(self, x: np.ndarray) -> np.ndarray:
        """What V counts of rest positions of all vertices, or of their change."""
        return x[self.nodes]

    def take_change(self, change: Derived) -> None:
        """A tangent begins, of these changes of numbers."""

    def clear_adjoint(self) -> None:
        """A reverse sweep begins."""

    def collect(self, out: Derived, by_rest: np.ndarray) -> None:
        """Add the adjoints of numbers of its own, and that of what is counted of the rest shape."""
        rest = np.zeros_like(out.displacement)
        rest[self.nodes] = by_rest
        out.rest = out.rest + rest

    def walls(self, u: np.ndarray) -> ChamberWalls:
        """At displacements of theirs."""
        return ChamberWalls(self.enclosures, self.rest + u, 1 / self.ws.arrays.values.mass[self.nodes, None], self.free)

    # ---- what is asked for -------------------------------------------------------------------------------------------

    def targets(self, rows: np.ndarray, j: int) -> np.ndarray:
        """Volumes after pass j, or their change."""
        schedule = self.ws.solver.schedule
        return schedule.pressure(rows, j, schedule.end(j))[self.columns]

    def rates(self, rows: np.ndarray, j: int) -> np.ndarray:
        """Their rate in the step in which pass j begins to show a frame, the step before [m^3/s], or its change."""
        schedule = self.ws.solver.schedule
        begin, end, _ = rows[schedule.load_row(rows, j - 1)].T
        return ((end - begin) / schedule.step_length(j - 1))[self.columns]

    def frame(self, j: int, save_every: int, now) -> int:
        """The frame whose velocity pass j shows between its kicks, or -1."""
        return int(self.ws.solver.schedule.shown(j, save_every)) if now.pre > 0 else -1

    # ---- in passes ---------------------------------------------------------------------------------------------------

    @contextmanager
    def do(self, at: Passes):
        u, before = self.rows(at.history.u, at.slot), self.rows(at.history.v, at.slot)
        yield
        self._after(at, u, before)

    def _after(self, at: Passes, u: np.ndarray, before: np.ndarray) -> None:
        """The rest of a pass, which began with displacements u and velocities `before`, is done."""
        history, slot, j, now, given = at.history, at.end, at.j, at.now, self.ws.arrays.rows[self.numbers]
        walls, self.kept[slot] = self.walls(u), None
        u_next, v_next = self.rows(history.u, slot), self.rows(history.v, slot)
        if not np.all(np.isfinite(u_next)):  # the guard of the run will say so
            return
        if now.alpha > 0:
            s = walls.meet(self.rest + u_next, self.targets(given, j))
            if s is None:
                raise self._lost(j, at.num_passes, u_next, given)
            way, self.last = np.tensordot(s, walls.d, 1), s / (now.alpha * (now.pre + now.post))
            self.put(history.u, slot, u_next + way)
            self.put(history.v, slot, v_next + now.decay / now.alpha * way)
            if at.stride:
                self.kept[slot] = u_next, v_next, s
            self._count_work(now, before, v_next / now.decay, way / now.alpha, walls)
            counted = int(self.ws.solver.schedule.shown(j + 1, at.save_every))
            if counted >= 0:
                self.of_frames[counted] = self.last
        frame = self.frame(j, at.save_every, now)
        if frame >= 0:
            shown = self.rows(self.ws.frames.frames_v, frame)
            self.put(self.ws.frames.frames_v, frame, shown + self.tangent_part(walls, shown, self.rates(given, j))[0])
        if not now.alpha > 0 and now.pre > 0:  # the kick that ends a run
            change, _ = self.tangent_part(walls, v_next, self.rates(given, j))
            self.put(history.v, slot, v_next + change)
            self._count_work(now, before, v_next, change, walls)

    @staticmethod
    def tangent_part(walls: ChamberWalls, v: np.ndarray, rates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(what makes v tangent, q)."""
        q = np.linalg.solve(slopes(walls.g, walls.d), rates - along(walls.g, v))
        return np.tensordot(q, walls.d, 1), q

    def _count_work(self, now, before: np.ndarray, after: np.ndarray, change: np.ndarray, walls: ChamberWalls) -> None:
        """As `work_of_pass` (outside_work.py) has it of loads."""
        whole, mass = now.pre + now.post, 1 / walls.inverse
        uneven = (now.pre - now.post) * (after - before)  # (pre^2 - post^2) times the body's own acceleration
        self.work += 0.5 * float((mass * change * (before + after + change + uneven / whole)).sum())

    def _lost(self, j: int, num_passes: int, u: np.ndarray, given: np.ndarray) -> Exception:
        V = [enclosure.volume(self.rest + u) for enclosure in self.enclosures]
        wanted = self.targets(given, j)
        k = int(np.argmax(np.abs(V / wanted - 1)))
        lost = VolumeLost(
            f"FilledChamber: no pressure leads in one substep from the volume {V[k]:.6g} m^3 to {wanted[k]:.6g} m^3; "
            "let it change over time by keyframes, take smaller steps, or an implicit solver"
        )
        return self.ws.dated(lost, j, num_passes)

    def alone(self, history, slot: int):
        """A recorded pass to a slot without the stage; then the record is what it was."""
        kept = self.kept.get(slot)
        return nullcontext() if kept is None else self._own.replaced(history, slot, *kept[:2])
