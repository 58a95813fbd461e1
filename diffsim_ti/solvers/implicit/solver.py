"""What the implicit solvers share. A pass solves one equation for the place u* where forces are taken:

    x = a0 u + a1 u-,  y = b0 v + b1 v-         where inertia starts from: the present state and the one before
    u* = x + gamma v*,  v* = y + gamma a(u*)    the equation, in one unknown
    u' = c0 u* + (1 - c0) u,  v' = e0 v* + e1 y

Backward Euler: x = u, y = v, gamma = h, u' = u*, v' = v*. Implicit midpoint: the same with gamma = h / 2, then the end is as
far beyond the middle as the start was before it. BDF2: x and y extrapolate from two states. Damping by a rate multiplies the
velocities by exp(-c h) in a stage of its own. Statics: no inertia, u* is where forces vanish.
"""

import weakref
from abc import abstractmethod
from dataclasses import dataclass

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.contact.implicit_pairs import ImplicitPairs
from diffsim_ti.solvers.implicit.linear import NotConverged
from diffsim_ti.solvers.implicit.newton import Newton
from diffsim_ti.solvers.implicit.potential import Potential
from diffsim_ti.solvers.implicit.preconditioners import BlockJacobi, Multigrid
from diffsim_ti.solvers.solver import Solver
from diffsim_ti.state.arrays import History, copy_slot
from diffsim_ti.state.energy_watch import EnergyWatch
from diffsim_ti.state.workspace import Workspace


@dataclass(frozen=True)
class Stage:
    """Numbers of a pass, and the derivatives of b0, b1, e0, e1 by the drag rate."""

    gamma: float
    a0: float = 1.0
    a1: float = 0.0
    b0: float = 1.0
    b1: float = 0.0
    c0: float = 1.0
    e0: float = 1.0
    e1: float = 0.0
    by_rate: tuple = (0.0, 0.0, 0.0, 0.0)
    static: bool = False

    @property
    def inertia(self) -> float:
        """c of the incremental potential [1/s^2]."""
        return 0.0 if self.static else 1 / self.gamma**2


class ImplicitSolver(Solver):
    """Implicit steps: each is a minimum of an incremental potential, found by Newton's method (newton.py).

    tolerance: relative residual of the equation of motion; gradients are as exact as the solve.
    max_iterations: Newton rounds per substep, after which NotConverged is raised and the state stays as it was.
    """

    serial_limit, serial_limit_in_lanes = 3_000, 10_000  # as for the explicit solvers
    last_frame_is_state = True
    multistep = False
    may_gain_energy = False  # whether long steps can add energy, so that it must be watched

    def __init__(
        self,
        scene,
        dt: float = 0.01,
        substeps: int = 1,
        tolerance: float = 1e-6,
        max_iterations: int = 50,
        parallel: bool | None = None,
        preconditioner: str = "auto",
    ):
        if preconditioner not in ("auto", "block_jacobi", "multigrid"):
            raise ValueError(f"preconditioner must be auto, block_jacobi or multigrid, got {preconditioner!r}")
        self.preconditioner = preconditioner
        if not 0 < tolerance < 1:
            raise ValueError(f"tolerance must lie between 0 and 1, got {tolerance}")
        if int(max_iterations) != max_iterations or max_iterations < 1:
            raise ValueError(f"max_iterations must be a whole number >= 1, got {max_iterations}")
        self.tolerance, self.max_iterations = float(tolerance), int(max_iterations)
        super().__init__(scene, dt, substeps, parallel)

    def twin(self, scene) -> "ImplicitSolver":
        own = (self.dt, self.substeps, self.tolerance, self.max_iterations, self.parallel, self.preconditioner)
        return type(self)(scene, *own)

    def num_passes(self, steps: int) -> int:
        return steps * self.substeps

    @abstractmethod
    def stage(self, rate: float, fresh: bool) -> Stage:
        """The numbers of a pass; `fresh`: there is no state before the present one."""

    def workspace(self, derived) -> "ImplicitWorkspace":
        return ImplicitWorkspace(self, derived)

    def adjoint(self, workspace, density: bool, shape: bool):
        from diffsim_ti.solvers.implicit.adjoint import ImplicitAdjoint

        return ImplicitAdjoint(workspace, density, shape)

    def tangent(self, workspace, dots):
        from diffsim_ti.solvers.implicit.adjoint import ImplicitTangent

        return ImplicitTangent(workspace, dots)

    def describe(self) -> str:
        return (
            f"{type(self).__name__}: dt {self.dt:g} s, {self.substeps} substeps, relative tolerance {self.tolerance:g}"
        )


class PairHistory(History):
    """States with the one before each, for two-step solvers; fresh[k]: slot k has none."""

    def __init__(self, arrays, num_slots: int, record: bool):
        super().__init__(arrays, num_slots, record=False)
        self.before = History(arrays, 1 if record else num_slots, record=False)
        self.fresh = [True] * num_slots


class ImplicitWorkspace(Workspace):
    """A run of an implicit solver. Vectors of vertices are worked on in float64 on the host, tetrahedra on the device."""

    pairs_kind = ImplicitPairs

    def __init__(self, solver, derived):
        self.potential, self._length = None, solver.substep
        self.energy_watch = EnergyWatch(self) if solver.may_gain_energy else None
        super().__init__(solver, derived)

    def history(self, num_slots, record=False):
        kind = PairHistory if self.solver.multistep else History
        return kind(self.arrays, num_slots, record and self.solver.multistep)

    def load(self, derived) -> None:
        self._launches.clear()
        super().load(derived)
        if not self._launches.get("potential"):
            self.potential = Potential(self.arrays, self.scene.mesh.tetrahedra, self.parallel, self.pairs)
            self._launches["potential"] = True
        a = self.arrays
        self.mass = derived.mass[:, None]
        self.free = (runtime.fetch(a.inverse_mass)[:, None] > 0).astype(np.float64)
        eps = np.finfo(runtime.NUMPY[self.scene.precision]).eps
        tolerance, rounds = self.solver.tolerance, self.solver.max_iterations
        me = weakref.proxy(self)  # no circle: a dropped run gives its memory back at once
        gaps, preconditioner = (lambda u: me._gaps(u)), (lambda mass: me.preconditioner(mass))
        self.newton = Newton(self.potential, self.free, gaps, preconditioner, tolerance, rounds, eps)
        self._preconditioners = {}

    def restart(self) -> None:
        super().restart()
        self._begin_anew()
        if self.energy_watch:
            self.energy_watch.clear()

    def forget(self) -> None:
        """The state was set from outside: there is none before it."""
        super().forget()
        self._begin_anew()

    def _begin_anew(self) -> None:
        if self.solver.multistep:
            self.state.fresh[0] = True

    def save(self, target, slot) -> None:
        super().save(target, slot)
        if self.solver.multistep and not (target is self.record and slot > 0):  # its slots follow one another
            self._copy_before(self.state, 0, target, slot)

    def restore(self, source, slot) -> None:
        super().restore(source, slot)
        if self.solver.multistep:
            if source is self.record and slot > 0:  # its slots follow one another
                copy_slot(source.u, slot - 1, self.state.before.u, 0)
                copy_slot(source.v, slot - 1, self.state.before.v, 0)
                self.state.fresh[0] = False
            else:
                self._copy_before(source, slot, self.state, 0)

    @staticmethod
    def _copy_before(source, s, target, t) -> None:
        copy_slot(source.before.u, s, target.before.u, min(t, target.before.num_slots - 1))
        copy_slot(source.before.v, s, target.before.v, min(t, target.before.num_slots - 1))
        target.fresh[t] = source.fresh[s]

    # ---- a pass -----------------------------------------------------------------------------------------------------

    def advance(self, first: int, last: int, num_passes: int, save_every: int = 0, base: int | None = None) -> None:
        """Passes first .. last - 1 from the current state; or recorded: slot j - base holds the state before pass j."""
        if base is not None:
            self.restore(self.record, first - base)
        if self.solver.substep != self._length:
            self._length = self.solver.substep
            self._begin_anew()
        for j in range(first, last):
            if save_every and j % save_every == 0:
                self.save_frame(j // save_every)
            u, v, before = self.read(self.state, 0)
            try:
                u_next, v_next = self._pass(j, u, v, before)
            except NotConverged as error:
                step = j // self.solver.substeps
                raise NotConverged(
                    f"step {step}, t = {step * self.solver.dt:.6g} s: {error}", error.residuals
                ) from None
            if self.solver.multistep:
                copy_slot(self.state.u, 0, self.state.before.u, 0)
                copy_slot(self.state.v, 0, self.state.before.v, 0)
                self.state.fresh[0] = False
            runtime.fill(self.state.u, u_next[None])
            runtime.fill(self.state.v, v_next[None])
            if base is not None:
                copy_slot(self.state.u, 0, self.record.u, j + 1 - base)
                copy_slot(self.state.v, 0, self.record.v, j + 1 - base)
                if self.solver.multistep:
                    self.record.fresh[j + 1 - base] = False

    def preconditioner(self, mass: np.ndarray) -> tuple:
        """(preconditioner for c M + K with mass = c m, size of the diagonal of that at rest [N/m])."""
        key = float(mass.sum())
        if key not in self._preconditioners:
            held = self.potential.held_at
            self.potential.place(np.zeros_like(held))
            blocks, contact = self.potential.blocks(), self.potential.contact_blocks()
            size = np.abs(blocks if contact is None else blocks - contact).sum((1, 2))[:, None]
            self.potential.place(held)
            kind = Multigrid if self._wants_multigrid(size, mass) else BlockJacobi
            if len(self._preconditioners) > 2:
                self._preconditioners.pop(next(iter(self._preconditioners)))
            self._preconditioners[key] = kind(self.potential, mass, self.free, size), size + mass
        return self._preconditioners[key]

    def _wants_multigrid(self, size: np.ndarray, mass: np.ndarray) -> bool:
        if self.solver.preconditioner != "auto":
            return self.solver.preconditioner == "multigrid"
        ratio = np.max(size[mass > 0] / mass[mass > 0], initial=0.0) if mass.any() else np.inf
        return len(size) > 1000 and ratio > 1000

    def read(self, history, slot: int) -> tuple:
        """(u, v, (u-, v-) or None) of a slot, in float64."""
        get = runtime.fetch_row
        before = None
        if self.solver.multistep and not history.fresh[slot]:
            if history is self.record and slot > 0:
                before = get(history.u, slot - 1), get(history.v, slot - 1)
            else:
                at = min(slot, history.before.num_slots - 1)
                before = get(history.before.u, at), get(history.before.v, at)
        return get(history.u, slot), get(history.v, slot), before

    def inertial(self, stage: Stage, u, v, before) -> tuple:
        """(x, y): where inertia starts from."""
        if before is None:
            return stage.a0 * u, stage.b0 * v
        return stage.a0 * u + stage.a1 * before[0], stage.b0 * v + stage.b1 * before[1]

    def _pass(self, j, u, v, before):
        stage = self.solver.stage(self.rate, before is None)
        x, y = self.inertial(stage, u, v, before)
        place, speed = self.prescribed(j)
        fixed = self.arrays.fixed
        mass, loads = stage.inertia * self.mass, self.loads(j, stage)
        inertial = x + stage.gamma * y
        if not stage.static:  # dead loads act like a shift of where inertia leads: free flight is then exact
            inertial = inertial + np.divide(loads, mass, out=np.zeros_like(loads), where=mass > 0)
            loads = np.zeros_like(loads)
        start = u if stage.static else u + self.free * (inertial - u)
        if len(fixed) and place is not None:
            middle = u[fixed] + (place - u[fixed]) / stage.c0
            start = start.copy()
            start[fixed] = middle
        self.begin(j, stage, u, x)
        start = self._admissible(start, u)
        u_star = self.newton.solve(start, mass, inertial, loads, leave_saddles=stage.static)
        v_star = (u_star - x) / stage.gamma
        u_next = stage.c0 * u_star + (1 - stage.c0) * u
        if self.pairs and stage.c0 != 1:
            self.pairs.check_end(u_star, u_next)
        v_next = stage.e0 * v_star + stage.e1 * y
        if len(fixed):
            u_next[fixed], v_next[fixed] = (u[fixed], v[fixed]) if place is None else (place, speed)
        if self.energy_watch:
            self.energy_watch.note(u, u_star, u_next, v_next)
        return u_next, np.zeros_like(v) if stage.static else v_next

    def _admissible(self, start, u):
        """The start of Newton's method: where inertia leads, or less far where that would turn something inside out."""
        held = start * (1 - self.free) + u * self.free
        longest = self._safe_share(u, held, start)
        _, _, J0 = self._looked_at(held)
        gaps0 = self._gaps(held)
        for fraction in (longest, 0.5 * longest, 0.25 * longest):
            at = held + fraction * (start - held)
            _, _, J = self._looked_at(at)
            if not (np.any((J0 > 0) & ~(J > 0)) or np.any((gaps0 > 0) & ~(self._gaps(at) > 0))):
                return at
        return held

    def _safe_share(self, u, held, start) -> float:
        """How far from `held` towards `start` no surfaces meet; prescribed vertices have to get where they are held."""
        if not self.pairs:
            return 1.0
        if not self.pairs.way_is_free(u, held - u):
            raise NotConverged("prescribed motion drives surfaces through each other: take smaller steps", [])
        return self.pairs.safe_share(held, start - held)

    def _looked_at(self, u):
        self.potential.place(u)
        return self.potential.energy()

    def _gaps(self, u: np.ndarray) -> np.ndarray:
        """Distance of the surface vertices to each obstacle [m], one after the other."""
        a = self.arrays
        if not a.contacts:
            return np.zeros(0)
        surface = self.scene.mesh.surface_vertices
        at = a.values.rest[surface] + u[surface]
        return np.concatenate([term.gap(at, self._walls[3 * k]) for k, term in enumerate(a.contacts)])

    def begin(self, j: int, stage: Stage, u: np.ndarray, x: np.ndarray) -> None:
        """Tell the potential where obstacles are in pass j and where friction is measured from."""
        self._walls = self.walls(self.arrays.values.path, j, stage)
        self.potential.begin(u, x, 1 / stage.gamma, self._walls)

    def walls(self, path: np.ndarray | None, j: int, stage: Stage) -> np.ndarray:
        """Three rows for each obstacle: displacement where forces are taken, displacement before, velocity."""
        twins = self.arrays.features().contacts
        out = np.zeros((3 * len(twins), 3))
        if path is not None:
            path = runtime.fetch(self.arrays.path).astype(np.float64) if path is self.arrays.values.path else path
            r, s = divmod(j, self.solver.substeps)
            change = path[r + 1] - path[r]
            before = path[r] + s / self.solver.substeps * change
            for k, c in enumerate(twins):
                if c.path >= 0:
                    to_stage = 1 / (self.solver.substeps * stage.c0)
                    at_stage, speed = before + to_stage * change, change / self.solver.dt
                    out[3 * k : 3 * k + 3] = at_stage[c.path], before[c.path], speed[c.path]
        return out

    def walls_vjp(self, walls_adj: np.ndarray, j: int, stage: Stage, path_adj: np.ndarray) -> None:
        """Add the adjoints of the rows of paths for those of `walls`."""
        r, s = divmod(j, self.solver.substeps)
        share = s / self.solver.substeps
        at_stage = share + 1 / (self.solver.substeps * stage.c0)
        for k, c in enumerate(self.arrays.features().contacts):
            if c.path >= 0:
                by_stage, by_before, by_speed = walls_adj[3 * k : 3 * k + 3]
                path_adj[r, c.path] += (1 - at_stage) * by_stage + (1 - share) * by_before - by_speed / self.solver.dt
                path_adj[r + 1, c.path] += at_stage * by_stage + share * by_before + by_speed / self.solver.dt

    def prescribed(self, j: int) -> tuple:
        """(displacement [m], velocity [m/s]) of the fixed vertices after pass j; None where they are held."""
        motion = self.arrays.values.motion
        if motion is None:
            return None, None
        motion = runtime.fetch(self.arrays.motion).astype(np.float64)
        r, s = divmod(j, self.solver.substeps)
        change = motion[r + 1] - motion[r]
        anchor = runtime.fetch(self.arrays.anchor).astype(np.float64)
        return anchor + motion[r] + (s + 1) / self.solver.substeps * change, change / self.solver.dt

    def loads(self, j: int, stage: Stage) -> np.ndarray:
        """Dead loads on each vertex [N]: weight and external forces; statics lay them on in substeps."""
        values, features = self.arrays.values, self.arrays.features()
        out = np.zeros_like(values.displacement)
        if features.gravity >= 0:
            out += self.mass * values.parameters[features.gravity :][:3]
        if values.forces is not None:
            rows = runtime.fetch(self.arrays.forces).astype(np.float64)
            at = self.force_vertices()
            out[at] += rows[j // self.solver.substeps if len(rows) > 1 else 0]
        return out * self.load_share(j, stage)

    def load_share(self, j: int, stage: Stage) -> float:
        """Share of the loads in pass j."""
        if not stage.static:
            return 1.0
        return min(1.0, (j + 1) / self.solver.substeps)

    def force_vertices(self) -> np.ndarray:
        """Vertices that external forces act on."""
        from diffsim_ti.terms import ExternalForce

        return self.scene.term(ExternalForce).indices(self.scene.mesh)
