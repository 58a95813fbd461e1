"""Volumes that explicit passes hold: a stage after all else in a pass.

A pass led from places x to y* with velocities v*. Each chamber's pressure p has pushed its walls since x as they were there:

    y = y* + sum_k s_k d_k,    v' = v* + r sum_k s_k d_k,    d_k = P M^-1 dV_k/dx (x),    V_k(y) = target_k

s = alpha (pre + post) p and r = decay / alpha in the words of kick_drift.py, P what vertices may do. What a frame shows of a
velocity between two kicks is made tangent to the volumes there: v + sum_k q_k d_k with dV_k/dx . v' = the target's rate.
So velocity Verlet is SHAKE, with the velocities of RATTLE.
Leimkuhler, Reich 2004, Simulating Hamiltonian Dynamics, 7.2, doi:10.1017/CBO9780511614118.
"""

import numpy as np

from diffsim_ti.differentiation.arrays import made, value_of, with_slopes
from diffsim_ti.mechanics.chambers.pressures import rows_of
from diffsim_ti.mechanics.corrections import Correction
from diffsim_ti.mechanics.stage import Passes
from diffsim_ti.terms import Chamber, FilledChamber


class VolumeLost(FloatingPointError):
    """No pressure leads to the volume that a chamber is to hold."""


class ChamberRecord:
    """What a tangent or a reverse sweep knows of the pressures of frames: that of a frame is that of the pass that leads to
    it."""

    def __init__(self, solver, held: list[int]):
        self.solver, self.held = solver, held  # places of these chambers among the scene's
        self.adjoints: np.ndarray | None = None  # by the frames' chamber pressures, None: zero
        self._changes: dict[int, np.ndarray] = {}

    def _frame(self, j: int, save_every: int) -> int:
        """The frame that the state after pass j is, or -1."""
        return int(self.solver.schedule.shown(j + 1, save_every))

    def adjoint(self, j: int, save_every: int) -> np.ndarray:
        """By the pressures of constrained volumes after pass j."""
        frame = self._frame(j, save_every)
        return np.zeros(len(self.held)) if self.adjoints is None or frame < 0 else self.adjoints[frame, self.held]

    def note(self, j: int, save_every: int, change: np.ndarray) -> None:
        """Change of those after pass j."""
        frame = self._frame(j, save_every)
        if frame >= 0:
            self._changes[frame] = change

    def changes(self, num_frames: int) -> np.ndarray:
        """Of the frames, shape (frames, chambers)."""
        out = np.zeros((num_frames, len(self.solver.scene.terms_of(Chamber))))
        for frame, change in self._changes.items():
            out[frame, self.held] = change
        return out


def along(G: np.ndarray, x: np.ndarray) -> np.ndarray:
    """G_k . x; of arrays that record, too."""
    A, X = value_of(G), value_of(x)
    by_G = (G, lambda dG: _dots(dG, X), lambda w: w[:, None, None] * X)
    return made(_dots(A, X), by_G, (x, lambda dx: _dots(A, dx), lambda w: np.tensordot(w, A, 1)))


def _dots(G: np.ndarray, x: np.ndarray) -> np.ndarray:
    return G.reshape(len(G), -1) @ x.ravel()


def spread(s: np.ndarray, d: np.ndarray) -> np.ndarray:
    """sum_k s_k d_k; of arrays that record, too."""
    S, D = value_of(s), value_of(d)
    by_s = (s, lambda ds: np.tensordot(ds, D, 1), lambda w: _dots(D, w))
    return made(np.tensordot(S, D, 1), by_s, (d, lambda dd: np.tensordot(S, dd, 1), lambda w: S[:, None, None] * w))


def _root(s: np.ndarray, K: np.ndarray, left: np.ndarray) -> np.ndarray:
    """s, for which what is left is zero, and changes by -K with s."""
    return made(s, (left, lambda change: np.linalg.solve(K, change), lambda w: np.linalg.solve(K.T, w)))


def slopes(G: np.ndarray, d: np.ndarray) -> np.ndarray:
    """G_k . d_l."""
    return np.tensordot(G, d, ([1, 2], [1, 2]))


class VolumeConstraints(Correction):
    """Those of a run's scene; `last`: pressures [Pa] of the last pass, `of_frames` those of frames."""

    reads = ("parameters", "follower")  # the second has the rows in which targets are

    def __init__(self, workspace):
        scene = workspace.scene
        filled, chambers = scene.terms_of(FilledChamber), scene.terms_of(Chamber)
        self.places, self.num_chambers = [chambers.index(chamber) for chamber in filled], len(chambers)
        self.columns = [rows.start for rows in rows_of(scene, filled)]  # of their targets among the numbers of loads
        closed = [chamber.enclosure for chamber in filled]
        super().__init__(workspace, np.unique(np.concatenate([enclosure.triangles.ravel() for enclosure in closed])))
        self.enclosures = [enclosure.of_nodes(self.nodes) for enclosure in closed]
        self.last, self.of_frames = np.zeros(len(self.places)), {}

    def spread(self, pressures: np.ndarray) -> np.ndarray:
        """Among those of all chambers, of which others have none here."""
        out = np.zeros(self.num_chambers)
        out[self.places] = pressures
        return out

    def of_all(self, num_frames: int) -> np.ndarray:
        """Of the frames of the last run, shape (frames, chambers); the first has none."""
        none = np.zeros(len(self.places))
        return np.stack([self.spread(self.of_frames.get(k, none)) for k in range(num_frames)])

    # ---- what is held ------------------------------------------------------------------------------------------------

    def positions(self, of, u: np.ndarray) -> np.ndarray:
        """What V depends on, at displacements u."""
        return of.rest + u

    def volumes(self, of, x: np.ndarray, G: np.ndarray | None = None) -> np.ndarray:
        """V of each; G: plain gradients, where x records."""
        volumes = np.array([enclosure.volume(value_of(x)) for enclosure in self.enclosures])
        return made(volumes, (x, lambda dx: _dots(G, dx), lambda w: np.tensordot(w, G, 1)))

    def gradients(self, of, x: np.ndarray) -> np.ndarray:
        """dV/dx, shape (chambers, n, 3)."""
        at = value_of(x)
        turned = lambda dx: np.stack([enclosure.gradient_jvp(at, dx) for enclosure in self.enclosures])  # noqa: E731
        pull = lambda w: sum(enclosure.gradient_jvp(at, by) for enclosure, by in zip(self.enclosures, w))  # noqa: E731
        return made(np.stack([enclosure.gradient(at) for enclosure in self.enclosures]), (x, turned, pull))

    def targets(self, of, j: int) -> np.ndarray:
        """Volumes after pass j."""
        schedule = self.ws.solver.schedule
        return schedule.pressure(getattr(of, self.reads[1]), j, schedule.end(j))[self.columns]

    def rates(self, of, j: int) -> np.ndarray:
        """Their rate in the step in which pass j begins to show a frame, the step before [m^3/s]."""
        schedule, rows = self.ws.solver.schedule, getattr(of, self.reads[1])
        begin, end, _ = rows[schedule.load_row(rows, j - 1)].T
        return ((end - begin) / schedule.step_length(j - 1))[self.columns]

    def meet(self, of, y: np.ndarray, d: np.ndarray, targets: np.ndarray) -> np.ndarray | None:
        """s that leads from y to the targets, or None."""
        s, near = np.zeros(len(targets)), False
        for _ in range(20):
            at = y + spread(s, d)
            left = targets - self.volumes(of, at)
            try:
                s = s + np.linalg.solve(slopes(self.gradients(of, at), d), left)
            except np.linalg.LinAlgError:
                return None
            if near:
                return s if np.all(np.isfinite(s)) else None
            near = bool(np.all(np.abs(left) <= 1e-9 * np.abs(targets)))  # the next one ends at round-off
        return None

    # ---- in passes ---------------------------------------------------------------------------------------------------

    def _ways(self, of, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(dV/dx where a pass begins, d), found once of the numbers of a pass."""
        if hasattr(of, "ways"):
            return of.ways
        g = self.gradients(of, self.positions(of, u))
        G, inverse = value_of(g), 1 / value_of(of.mass)[:, None]
        eased = lambda by: np.stack([self.freed(inverse * own) for own in by])  # noqa: E731
        d = eased(G)
        by_mass = (lambda dm: -d * (dm[:, None] * inverse), lambda w: -(d * w).sum((0, 2)) * inverse[:, 0])
        of.ways = g, made(d, (g, eased, lambda w: inverse * np.stack(list(map(self.freed, w)))), (of.mass, *by_mass))
        return of.ways

    def ends(self, of, at, u, y, v, found=None):
        now, (_, d) = at.now, self._ways(of, u)
        if not now.alpha > 0:  # the kick that ends a run
            return y, self.shown(of, at, u, v)[0] if now.pre > 0 else v, None
        x, targets, s = self.positions(of, y), self.targets(of, at.j), found
        if s is None:
            s = self.meet(of, x, d, targets)
            if s is None:
                raise self._lost(at, self.volumes(of, x), targets)
        else:
            met = x + spread(s, d)
            G = value_of(self.gradients(of, value_of(met)))
            s = _root(s, slopes(G, value_of(d)), targets - self.volumes(of, met, G))
        way = spread(s, d)
        by_rate = (now.decay_by_rate * now.alpha - now.decay * now.alpha_by_rate) / now.alpha**2
        return y + way, v + self._by_rate(of, now.decay / now.alpha, by_rate) * way, s

    def _by_rate(self, of, value: float, slope: float):
        """A number that changes with the drag rate."""
        drag = self.ws.arrays.features().drag
        return with_slopes(value, (of.parameters[drag], lambda: slope)) if drag >= 0 else value

    def shown(self, of, at, u, v, found=None):
        (g, d), q = self._ways(of, u), found
        if q is None:
            (G, D, V), rates = map(value_of, (g, d, v)), self.rates(of, at.j)
            K = slopes(G, D)
            q = np.linalg.solve(K, value_of(rates) - _dots(G, V))
            q = _root(q, K, rates - along(g, v + spread(q, d)))
        return v + spread(q, d), q

    # ---- pressures ---------------------------------------------------------------------------------------------------

    def note(self, at: Passes, found):
        if found is not None:
            self.last = found / (at.now.alpha * (at.now.pre + at.now.post))
            counted = int(self.ws.solver.schedule.shown(at.j + 1, at.save_every))
            if counted >= 0:
                self.of_frames[counted] = self.last

    def record_of(self, run):
        run.chamber_record = ChamberRecord(self.ws.solver, self.places)
        return run.chamber_record

    def seen(self, of, at, found):
        now = at.now
        return found / (self._by_rate(of, now.alpha, now.alpha_by_rate) * (now.pre + now.post))

    def _lost(self, at: Passes, V: np.ndarray, wanted: np.ndarray) -> Exception:
        k = int(np.argmax(np.abs(V / wanted - 1)))
        lost = VolumeLost(
            f"FilledChamber: no pressure leads in one substep from the volume {V[k]:.6g} m^3 to {wanted[k]:.6g} m^3; "
            "let it change over time by keyframes, take smaller steps, or an implicit solver"
        )
        return self.ws.dated(lost, at.j, at.num_passes)
