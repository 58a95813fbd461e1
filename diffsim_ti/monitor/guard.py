"""Noticing that a run goes wrong, and saying where, when and why; bodies that chatter as they slide."""

import math
import weakref
from collections.abc import Iterator

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.common.copies import CarriesMore
from diffsim_ti.common.progress import Steady
from diffsim_ti.common.warn import warn
from diffsim_ti.mechanics.surfaces.surface_pairs import Tunnelling
from diffsim_ti.mechanics.workspace import Workspace
from diffsim_ti.mesh.sets import pieces
from diffsim_ti.monitor import quantities, stability
from diffsim_ti.monitor.energy_balance import EnergyGained
from diffsim_ti.terms.obstacles.barrier import beta

SHAKEN, OPEN, NEAR = 0.3, 0.5, 2  # of the sliding speed; of what has touched; widths
VISCOUS = 0.1  # of the stable step


class Divergence(CarriesMore, FloatingPointError):
    """The state is not finite, or the step has become unstable. Carries step, vertex, tetrahedron and stable_dt [s], and
    `enough` [s], a substep that is short enough, or None where no substep is known to be."""

    enough: float | None = None

    def __init__(self, message: str, step: int, vertex: int | None, tetrahedron: int | None, stable_dt: float):
        super().__init__(message)
        self.step, self.vertex, self.tetrahedron, self.stable_dt = step, vertex, tetrahedron, stable_dt


class Crossing(Divergence):
    """A vertex got onto or behind an obstacle. Carries also depth [m], speed [m/s] against the obstacle's, and stiffness
    [N/m].

    stable_dt [s] is a substep that resolves the barrier at this speed, or that is stable in this state where the present
    one is not: the speed is of its own making then.
    stiffness is what stops the vertex, or None where the barrier's own would do, or where none does.
    """

    def __init__(
        self,
        message: str,
        step: int,
        vertex: int,
        stable_dt: float,
        depth: float,
        speed: float,
        stiffness: float | None,
    ):
        super().__init__(message, step, vertex, None, stable_dt)
        self.depth, self.speed, self.stiffness = depth, speed, stiffness
        self.enough = stable_dt if stiffness is None else None


class Chatter:
    """Monitors bodies that slide on obstacles with friction and vibrate in explicit steps, so that friction does not point
    against the sliding, and warns once.

    Steps that damp nothing let the vibrations of a stiff body grow where it rests on an obstacle: contact opens and
    closes in most substeps, vertices move to and fro as fast as the body slides, and it slides too far. A block of 1 MPa
    that stopped from 2 m/s on mu = 0.7 went 5 % too far, one of 10 MPa 0.5 %; with a KelvinVoigt time of a tenth of the
    stable step, -0.15 %.
    """

    def __init__(self, workspace):
        self.ws, self.warned = weakref.proxy(workspace), False
        self.pieces = pieces(workspace.scene.mesh)
        self.fastest = np.zeros(len(workspace.watch.contacts))  # that something slid on each obstacle [m/s]

    @classmethod
    def of(cls, workspace) -> "Chatter | None":
        """For explicit steps and obstacles with friction."""
        rough = any(term.has_friction for term in workspace.watch.contacts)
        return cls(workspace) if workspace.solver.explicit and rough and not workspace.scene.reduced else None

    def check(self, now: int, num_passes: int) -> None:
        """Before pass `now`."""
        ws = self.ws
        ws.place_obstacles(now)
        arrays, touched = ws.arrays, ws.watch.rows()[::3, : ws.arrays.num_vertices]
        x, v = (runtime.fetch_row(a, 0).astype(np.float64) for a in (ws.state.u, ws.state.v))
        x = x + arrays.values.rest
        places = runtime.fetch(arrays.offsets).astype(np.float64)
        for k, term in enumerate(ws.watch.contacts):
            width = float(term.values["barrier_width"])
            own = np.flatnonzero(touched[k] < width)
            if self.warned or not term.has_friction or not own.size or not np.isfinite(v).all():
                continue
            gap = term.gap(x[own], arrays.poses.row_of(k, places))
            slide = float(np.linalg.norm(v[own].mean(0) - ws.velocity_of_obstacle(k, now, own[0])))
            self.fastest[k] = max(self.fastest[k], slide)
            few, near = (gap < width).mean() < OPEN, np.median(gap) < NEAR * width
            if not few or not near or slide < 0.2 * self.fastest[k] or slide < 10 * term.values["friction_speed"]:
                continue
            shake = float(np.sqrt((self._shaking(x, v)[own] ** 2).sum(1).mean()))
            if shake > SHAKEN * slide:
                self._warn(term, shake, slide, now, num_passes)

    def _shaking(self, x: np.ndarray, v: np.ndarray) -> np.ndarray:
        """What is left of velocities without the rigid motion of each piece."""
        out = np.zeros_like(v)
        for number in range(self.pieces.max() + 1):
            own = self.pieces == number
            r, w = x[own] - x[own].mean(0), v[own] - v[own].mean(0)
            inertia = (r**2).sum() * np.eye(3) - r.T @ r
            out[own] = w - np.cross(np.linalg.pinv(inertia) @ np.cross(r, w).sum(0), r)
        return out

    def _warn(self, term, shake: float, slide: float, now: int, num_passes: int) -> None:
        ws, self.warned = self.ws, True
        material, remedy = type(ws.scene.material).__name__, "contact_damping=1"
        if not (ws.scene.law.viscous or ws.scene.law.state_names):
            time = VISCOUS * float(ws.solver.stable_dt().dt)
            damped = f"KelvinVoigt({material}(...), {time:.2g}) as the material"
            remedy = f"{damped}, which damps these vibrations, or {remedy}"
        warn(
            f"{ws.when(ws.step_of(now - 1, num_passes))}: a body that slides on {term!r} at {slide:.3g} m/s vibrates at "
            f"{shake:.3g} m/s, and its contact opens and closes, because these steps have no damping: friction then does "
            f"not oppose the sliding, and sliding distances are a few per cent too long; take {remedy}"
        )


class Guard:
    """Checks a run every so many passes: is the state finite, did a vertex cross an obstacle, is the step still stable?

    Keeps the last good state, from which `_diagnose` finds the exact step. Checks cost 2 to 7 %; where the step is
    within a tenth of the stable one it checks more often, for beyond it a motion soon grows e-fold in ten passes.
    """

    # passes between two checks; near the stable step, or first where "auto" asked for it; first of deformed or pulled starts
    usual, close, first = 400, 50, 10

    def __init__(self, workspace: Workspace):
        self.ws = workspace
        self.good = workspace.history(1)
        self.good_pass = 0
        self._stiffness, self._warned, self._warned_of_gain = None, False, False
        self.chatter = Chatter.of(workspace)
        self.restart()

    def restart(self) -> None:
        """A new run: checks come at the same passes whatever ran before and wherever states are kept; sooner where it starts
        deformed or pulled."""
        solver = self.ws.solver
        if solver.explicit and self.ws.energy_watch:
            self.ws.energy_watch.clear()
        pulled = self.ws.arrays.features().pulled  # which squeezes a calm start
        soon = solver.explicit and (solver.starts_deformed() or pulled)
        usual = self.close if solver.automatic and solver.knows_limit else self.usual
        self._passes, self.every, self.steady = 0, self.first if soon else usual, Steady()
        self._unseen = 0  # passes since sliding bodies were looked at
        self._seen_omega2 = 0.0

    def restart_with_solver(self) -> None:
        """The same where a run may change its substeps, which then do so at the same passes too."""
        if self.ws.solver.automatic:
            self._stiffness = None
            self.restart()

    def mark(self, now: int) -> None:
        """The current state, before pass `now`, is good: keep it."""
        self.ws.save(self.good, 0)
        self.good_pass = now
        self._seen = self.ws.watch.rows() if self.ws.watch.contacts else None

    def advance(self, first: int, last: int, num_passes: int, save_every: int = 0, recording: bool = False) -> None:
        """Passes first .. last - 1, monitored; recording, slot j of the record holds the state before pass j."""
        for begin, end in self._stretches(first, last):
            self._advance(begin, end, num_passes, save_every, recording)

    def advance_again(
        self, first: int, last: int, num_passes: int, save_every: int = 0, recording: bool = False
    ) -> None:
        """The same of a run that was monitored before, and came to its end: it takes the same way again."""
        for begin, end in self._stretches(first, last):
            self._pass(begin, end, num_passes, save_every, recording)

    def _stretches(self, first: int, last: int) -> Iterator[tuple[int, int]]:
        """Parts of passes first .. last - 1 of one length; each is gone through before the next is asked for."""
        schedule = self.ws.solver.schedule
        for begin, end in schedule.stretches(first, last):
            h = float(schedule.length(begin))
            if abs(h - self.ws.substep) > 1e-12 * h:  # lengths that differ by rounding alone are one
                self.ws.substep = h
            yield begin, end
            if schedule.varies:
                self.ws.watch.close(self.ws.substep)

    def _pass(self, first: int, last: int, num_passes: int, save_every: int, recording: bool) -> None:
        """Passes first .. last - 1."""
        if recording:
            self.ws.save(self.ws.record, first)
        self.ws.advance(first, last, num_passes, save_every, 0 if recording else None)
        if recording:
            self.ws.restore(self.ws.record, last)

    def _advance(self, first: int, last: int, num_passes: int, save_every: int, recording: bool) -> None:
        """The same where all have one length."""
        balance = self.ws.energy_watch if self.ws.solver.explicit else None
        schedule, bends = self.ws.solver.schedule, self.ws.bending and np.isfinite(self.ws.bending.of_pairs)
        while first < last:
            end = stop = min(last, first + self.every - self._passes)
            if bends:  # looked at after whole steps alone: what is found does not depend on where segments end
                step = int(schedule.row(first)) + 1
                end = int(schedule.first(step)) if step <= schedule.row(num_passes - 1) else num_passes
                stop = min(stop, end)
            done = self._passes + stop - first
            whole = done >= self.every or stop == num_passes or len(schedule.stretches(stop - 1, stop + 1)) > 1
            if balance:
                balance.before(first, num_passes)
            self.mark(first)
            try:
                self._pass(first, stop, num_passes, save_every, recording)
            except Tunnelling as error:
                raise self._with_stable_step(error) from None
            if self.ws.bending and self.ws.solver.explicit and (stop == end if bends else whole):
                self.ws.bending.check(stop, runtime.fetch_row(self.ws.state.u, 0))
            if self.ws.watch.crossing() is not None and self.ws.solver.explicit:
                self._diagnose_crossing(stop, num_passes)
            if self.ws.first_bad_vertex() is not None:
                self._diagnose(stop, num_passes)
            if balance:
                balance.after(stop, num_passes, stop - first, whole)
            self._passes, self._unseen = done, self._unseen + stop - first
            if whole:  # so that what is said does not depend on where segments end
                self._warn_of_stiff_contact(stop, num_passes)
                self._warn_of_gained_energy(stop, num_passes)
                if self.chatter and self._unseen >= self.usual:  # what shakes soon after an impact is none
                    self._unseen = 0
                    self.chatter.check(stop, num_passes)
            if self._passes >= self.every:
                self._passes = 0
                self._check_step(stop, num_passes)
            first = stop
            if first < last:
                self.steady.log("substep %s of %s", first, num_passes)

    def _warn_of_stiff_contact(self, now: int, num_passes: int) -> None:
        """Once, where a barrier was stiffer than a step can follow: energy may then come from nowhere."""
        solver, watch = self.ws.solver, self.ws.watch
        if self._warned or not solver.explicit or not watch.contacts or solver.stages_contact:
            return
        omega_dt = watch.largest_omega_dt()
        if omega_dt > 2:
            self._warned, step, h = True, self.ws.step_of(now - 1, num_passes), self.ws.substep
            warn(
                f"{self.ws.when(step)}: a contact was stiffer than the substep {h:.3g} s can follow (omega dt = "
                f"{omega_dt:.3g} > 2), so that energy may be gained in it: take substeps of {1.8 * h / omega_dt:.3g} s, or "
                "a softer or wider barrier"
            )

    def _warn_of_gained_energy(self, now: int, num_passes: int) -> None:
        """Once, where steps have added a tenth of the energy that moves."""
        watch, solver = self.ws.energy_watch, self.ws.solver
        if self._warned_of_gain or watch is None or watch.share <= 0.1:
            return
        self._warned_of_gain, step = True, self.ws.step_of(now - 1, num_passes)
        enough = self.ws.substep / (2 if solver.explicit else 4)
        others = "ImplicitEulerSolver, which damps most"
        others = others if getattr(solver, "multistep", False) else f"BDF2Solver or {others}"
        said = (
            f"{self.ws.when(step)}: {type(solver).__name__} has gained {watch.gained:.3g} J, "
            f"{watch.share:.0%} of the energy that moves, from nonlinear motion or contact within its substeps of "
            f"{self.ws.substep:.3g} s: take substeps of {enough:.3g} s, or {others}"
        )
        about = watch.gained, watch.share, step, float(solver.schedule.time(step)), enough
        warn(EnergyGained(said, *about))

    def _check_step(self, now: int, num_passes: int) -> None:
        solver = self.ws.solver
        if solver.allow_unstable or not solver.explicit:
            return
        self.ws.place_obstacles(now)
        if self._stiffness is None:
            self._stiffness = stability.stiffness_of(self.ws)
        omega2 = self._stiffness.lower_bound()
        apart = self._flies_apart()
        stiff = omega2 * self.ws.substep**2  # stable up to 4
        if np.isfinite(omega2) and stiff <= 4 and not apart:
            longer = 4 if stiff < 1 else 2  # the body has to become four times as stiff first
            most = self.close if stiff > 0.9**2 * 4 else self.usual
            rises = stiff > 0.8**2 * 4 or omega2 > 1.1 * self._seen_omega2 > 0
            if solver.automatic and rises:  # which is to be seen in time
                most = min(most, 2 * self.close)
            self.every, self._seen_omega2 = min(longer * self.every, most), omega2
            return
        step, limit = self.ws.step_of(now - 1, num_passes), 2 / np.sqrt(omega2)
        tet = self._stiffness.worst_tetrahedron()
        self.ws.restore(self.good, 0)
        why = (
            "is too long: vertices cross the body within it"
            if apart
            else f"has outgrown the stable step {limit:.4g} s of the present state (tetrahedron {tet}; elements are "
            "squeezed, or vertices press into a contact)"
        )
        enough = self._calm_substep(limit)
        error = Divergence(
            f"{self.ws.when(step)}: the substep {self.ws.substep:.4g} s {why}: take substeps of {enough:.3g} s "
            f"({self._how(enough)}), or pass allow_unstable=True to the solver",
            step,
            None,
            tet,
            float(limit),
        )
        error.enough = enough
        raise error

    def _how(self, enough: float) -> str:
        """In words, how to come to substeps of so many [s]."""
        if not self.ws.solver.automatic:
            return "reduce dt, raise substeps"
        return f"pass substeps={math.ceil((1 - 1e-12) * self.ws.solver.dt / enough)}, or reduce dt"

    def _calm_substep(self, stable: float) -> float:
        """A substep [s] to take where the present one was too long for a state whose stable step is given."""
        return min(0.5 * self.ws.substep, 0.7 * float(stable)) if stable > 0 else 0.5 * self.ws.substep

    def _flies_apart(self) -> bool:
        """Whether vertices cross the body within a substep: no state that a stable step leads to."""
        v = runtime.fetch(self.ws.state.v)[0].astype(np.float64)
        spread = np.abs(v - v.mean(0)).max() * self.ws.substep
        return bool(spread > np.ptp(self.ws.arrays.values.rest, 0).max())

    def _diagnose_crossing(self, bad_by: int, num_passes: int) -> None:
        """Run again to the first pass that crosses, and raise; the state before it is restored."""
        ws = self.ws
        ws.watch.put(self._seen)
        ws.restore(self.good, 0)
        for j in range(self.good_pass, bad_by):
            self.mark(j)
            ws.advance(j, j + 1, num_passes)
            crossing = ws.watch.crossing()
            if crossing is not None:
                break
        ws.restore(self.good, 0)
        ws.watch.put(self._seen)
        k, vertex, depth = crossing
        term, step = ws.watch.contacts[k], self.ws.step_of(j, num_passes)
        speed = float(np.linalg.norm(ws.velocity_of(vertex) - ws.velocity_of_obstacle(k, j, vertex)))
        enough = min(0.1 * float(term.values["barrier_width"]) / max(speed, 1e-300), 0.5 * self.ws.substep)
        stiffness = self._stiffness_needed(k, vertex, speed)
        ws.place_obstacles(j)
        remedy = f"reduce the substep to {enough:.3g} s (a tenth of the barrier's width)"
        if stiffness is not None:
            stiffer = ws.arrays.stiffer(k, [vertex], stiffness)
            remedy = f"the barrier cannot stop it at any step: raise its {stiffer}, or its width"
        stable, _ = self._stable_step()
        if not self.ws.substep <= stable:  # the speed is of the steps' own making
            stiffness, enough = None, self._calm_substep(stable)
            remedy = (
                f"the substep has outgrown the stable step {stable:.3g} s of this state, whose elements are squeezed: "
                f"reduce the substep to {enough:.3g} s"
            )
        through = term.led is not None and vertex in ws.scene.fixed
        if through:
            stiffness, enough = None, self.ws.substep
            remedy = (
                "explicit steps let links through vertices that are fixed: take ImplicitEulerSolver, or keep links away"
            )
        error = Crossing(
            f"{self.ws.when(step)}: vertex {vertex} gets {depth:.3g} m behind {term!r} within a "
            f"substep of {self.ws.substep:.4g} s, at {speed:.4g} m/s: {remedy}; the state before is kept",
            step,
            vertex,
            enough,
            depth,
            speed,
            stiffness,
        )
        error.enough = None if through else error.enough
        raise error

    def _stiffness_needed(self, k: int, vertex: int, speed: float) -> float | None:
        """Stiffness [N/m] whose barrier, alone, stops the vertex at a fiftieth of the width; None if the present one can.

        The present state counts: kinetic energy and what the barrier already holds, against k w^2 beta(1 / 1000).
        """
        arrays = self.ws.arrays
        force, first, _ = arrays.obstacles[k]
        stiffness, width = arrays.stiffness_of(k, [vertex]), float(arrays.values.parameters[first + force.index.width])
        self.ws.place_obstacles(self.good_pass)
        offset = arrays.poses.row_of(k, runtime.fetch(arrays.offsets).astype(np.float64))
        position = arrays.values.rest[vertex] + runtime.fetch(self.ws.state.u)[0, vertex]
        gap = float(self.ws.watch.contacts[k].gap(position[None], offset)[0])
        held = stiffness * width**2 * beta(np.clip(gap / width, 1e-3, 1))
        energy = float(0.5 * arrays.values.mass[vertex] * speed**2 + held)
        return energy / float(width**2 * beta(0.02)) if energy > stiffness * width**2 * beta(1e-3) else None

    def _diagnose(self, bad_by: int, num_passes: int) -> None:
        """Run again from the last good state, pass by pass, and raise at the first bad one; that state is restored."""
        ws = self.ws
        ws.restore(self.good, 0)
        for j in range(self.good_pass, bad_by):
            self.mark(j)
            ws.advance(j, j + 1, num_passes)
            vertex = ws.first_bad_vertex()
            if vertex is not None:
                break
        bad = "velocity" if not np.all(np.isfinite(ws.velocity_of(vertex))) else "displacement"
        ws.restore(self.good, 0)
        J = quantities.tetrahedron_fields(ws).J
        around = np.nonzero((ws.scene.mesh.elements == vertex).any(1))[0]
        J_around = np.where(np.isfinite(J[around]), J[around], -np.inf)
        tet = int(around[J_around.argmin()]) if around.size else 0
        stable, state = self._stable_step()
        step = self.ws.step_of(j, num_passes)
        enough = None if self.ws.substep <= stable else self._calm_substep(stable)
        why = (
            f"the substep {self.ws.substep:.4g} s exceeds the stable step {stable:.4g} s {state}: take substeps of "
            f"{enough:.3g} s ({self._how(enough)}, or use an implicit solver)"
            if not self.ws.substep <= stable
            else f"the stable step {state} is {stable:.4g} s, so check forces, contacts, inputs and inverted tetrahedra"
        )
        bodies = ws.arrays.bodies
        if bodies is not None and vertex in bodies.vertices[bodies.rigid[bodies.owner]]:
            why += "; a rigid set turns by a radian in a substep at the most"
        error = Divergence(
            f"{self.ws.when(step)}: {bad} of vertex {vertex} is not finite; smallest J around it "
            f"= {J_around.min():.3g} in tetrahedron {tet}; {why}; the last good state is kept",
            step,
            vertex,
            tet,
            stable,
        )
        error.enough = enough
        raise error

    def _with_stable_step(self, error: Tunnelling) -> Tunnelling:
        """The same error, which advises a stable substep where the present one has outgrown the state that it was raised
        in."""
        stable = self._stable_step()[0] if self.ws.solver.explicit else np.inf
        if not self.ws.substep <= stable:
            said, error.stable_dt = str(error).rpartition(": take substeps of")[0], self._calm_substep(stable)
            error.args = (
                f"{said}; the substep has outgrown the stable step {stable:.3g} s of this state, whose elements are "
                f"squeezed: take substeps of {error.stable_dt:.3g} s",
            )
        return error

    def _stable_step(self) -> tuple[float, str]:
        """The stable step of the last good state or, where that one is too far gone, of the start."""
        start = self.ws.solver.stable_dt(tight=True).dt
        try:
            here = stability.lanczos_limit(self.ws).dt
        except Exception:  # the last good state may be too wild for Lanczos; the report matters more
            here = float("nan")
        return (here, "of the last good state") if here > 1e-6 * start else (start, "of the start")
