"""Energy that steps add: of explicit ones against what is done on the body from outside, of others where they are too
long."""

import weakref
from dataclasses import dataclass
from operator import is_

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.common.copies import CarriesMore
from diffsim_ti.inputs import kinetic_energy
from diffsim_ti.mechanics.host_force import Instant
from diffsim_ti.mechanics.workspace import Workspace
from diffsim_ti.monitor import quantities
from diffsim_ti.state.history import History
from diffsim_ti.terms import Growth


@dataclass
class Window:
    """Where a balance began: the pass, the changes from outside and the substep [s] of then, the level [J] there (None:
    not looked at yet, the state is kept), where obstacles were, and the passes since."""

    first: int
    num_passes: int
    changes: int
    substep: float
    level: float | None
    poses: np.ndarray | None = None
    passes: int = 0


class Gains:
    """Energy that steps have `gained`, and the most that was `moving`: kinetic, of strains and of contacts [J]."""

    gained = moving = 0.0

    @property
    def share(self) -> float:
        """The one over the other."""
        return self.gained / self.moving if self.moving > 0 else 0.0


class EnergyBalance(Gains):
    """Follows T + V less the work of what is outside, as it is at checks, every few hundred passes.

    T is the kinetic energy of free vertices, V that of strains, with what plastic flow has dissipated, weight, contacts,
    and of cables and muscles that pull steadily. Both swap within an oscillation, by a quarter of (omega h)^2, which is no
    gain. So the velocity v- of half a substep before u is taken together with u:

        T(v-) + V(u) + h/2 v- . f(u)         or, with v of the same time as u,    T(v) + V(u) - h^2/8 f(u)^2 / m

    stays the same, to round-off, of every linear motion below omega h = 2, and falls by what friction and a contact stage
    take. Passes note the work of loads, of prescribed motion and of moving obstacles, and what drag takes
    (solvers/explicit/kick_drift.py), but for drag that acts alone, which can hide a gain. So whatever rises beyond the
    lowest level is the steps' own.
    Laws that read a rate, or remember other things than plastic flow, may take or do work of their own, and nothing notes
    that of forces without an energy which act vertex by vertex, such as those of a rotating frame: runs with these are not
    watched.
    Hairer, Lubich, Wanner 2003, Geometric numerical integration illustrated by the Stoermer-Verlet method,
    doi:10.1017/S0962492902000144, 4.1 and 5.
    """

    usual = 800  # passes from check to check at least; a check costs about as much as six of them
    first = 20  # where cables and muscles set a body in motion; twice as many from check to check
    small, seldom = 1000, 2.5  # tetrahedra below which it costs more than that, and comes up to so much more seldom

    def __init__(self, workspace: Workspace):
        self.ws = weakref.proxy(workspace)  # which holds this: no circle
        self._start: History | None = None
        share = self.small / max(workspace.arrays.num_tetrahedra, 1)
        self.every = int(self.usual * min(max(share, 1), self.seldom))
        self.clear()

    @staticmethod
    def knows(law) -> bool:
        """Whether the forces of a law are those of its energy alone, of plastic ones with what they have dissipated."""
        return law.reads == ("H",) and (law.plastic or not law.state_names)

    def clear(self) -> None:
        """Forget what was seen."""
        self.window: Window | None = None
        self.steady, self._rows = True, None  # whether cables pull as they did at first, and with what (their rows)
        self._soon = self.first if self.ws.arrays.features().pulled else np.inf
        self.gained = self.moving = 0.0
        self._risen, self._lowest = 0.0, 0.0  # the level against that of the first check

    def before(self, first: int, num_passes: int) -> None:
        """Passes from `first` on come next; whatever was done to the state since the last ones is outside the balance."""
        ws, window = self.ws, self.window
        if not self._pulls_stay():
            window = None
        if window and (window.changes, window.substep) == (ws.changes, ws.substep):
            return
        if self._start is None:
            self._start = ws.history(1)
        ws.save(self._start, 0)
        self._begin(first, num_passes, None)

    def _pulls_stay(self) -> bool:
        """Whether cables pull with what they pulled with at first: once that changes they are loads, until `clear`."""
        a, known = self.ws.arrays, self._rows
        pulling = [x for x in a.interactions if x.is_load and x.pulls]
        rows = [a.rows[name] for x in pulling for name in x.derived if name in a.rows_of_steps]
        if not self.steady or (known is not None and all(map(is_, rows, known))):
            return True
        self.steady = all(x.pulls_steadily(a.now) for x in pulling)
        self.steady = self.steady and (known is None or all(map(np.array_equal, rows, known)))
        self._rows = rows
        return self.steady

    def _begin(self, first: int, num_passes: int, level: float | None) -> None:
        if self.ws.arrays.features().driven:
            runtime.fill(self.ws.contact.work, 0)
        for stage in self._working:
            stage.work = 0.0
        self.window = Window(first, num_passes, self.ws.changes, self.ws.substep, level)
        if level is None and self.ws.arrays.features().moving:
            self.ws.place_obstacles(first)
            self.window.poses = runtime.fetch(self.ws.arrays.offsets)

    def after(self, now: int, num_passes: int, count: int, may_check: bool) -> None:
        """`count` passes are done, up to pass `now`, by the run alone; may_check: here, if there were enough."""
        window = self.window
        window.passes, window.changes = window.passes + count, self.ws.changes
        if may_check and window.passes >= min(self.every, self._soon):
            self._check(now, num_passes)
            self._soon *= 2
            window.changes = self.ws.changes

    @np.errstate(all="ignore")  # of a run that blows up
    def _check(self, now: int, num_passes: int) -> None:
        window, features = self.window, self.ws.arrays.features()
        work = self._noted_work() if features.driven else 0.0
        work += sum(stage.work for stage in self._working)
        if window.level is None:
            window.level = self._level_at_start(window)
        level = self._level(now, num_passes)
        if window.level is not None and np.isfinite(level):
            self._risen += level - work - window.level
            self._lowest = min(self._lowest, self._risen)
            self.gained = max(self.gained, self._risen - self._lowest)
        self._begin(now, num_passes, level)

    @property
    def _working(self) -> list:
        """Stages that count the work which they let others do."""
        return [stage for stage in self.ws.stages if hasattr(stage, "work")]

    def _noted_work(self) -> float:
        """By passes, of loads, walls and what holds the body [J]."""
        accounts = runtime.fetch(self.ws.contact.work).reshape(-1, self.ws.arrays.num_vertices).astype(np.float64)
        return float(accounts[-1 if self.steady else 0].sum())

    def _level_at_start(self, window: Window) -> float | None:
        """The level of the state that was kept; None where forces there cannot be had any more."""
        ws, features = self.ws, self.ws.arrays.features()
        if ws.pairs or (features.moving and features.pressing):
            return None
        here = ws.history(1)
        ws.save(here, 0)
        ws.restore(self._start, 0)
        level = self._level(window.first, window.num_passes, window.poses)
        ws.restore(here, 0)
        return level

    def _level(self, now: int, num_passes: int, poses: np.ndarray | None = None) -> float:
        """The level [J] of the current state, which is that before pass `now`."""
        ws, a = self.ws, self.ws.arrays
        values, h = a.values, ws.substep
        if poses is None:
            ws.place_obstacles(now)
        else:
            runtime.fill(a.offsets, poses)
        u, v = (runtime.fetch(x)[0].astype(np.float64) for x in (ws.state.u, ws.state.v))
        free = runtime.fetch(a.inverse_mass) > 0
        mass, features = values.mass[:, None] * free[:, None], a.features()
        weight = mass * a.gravity_of(values)
        kinetic = 0.5 * float((mass * a.supports.free(v) ** 2).sum())
        stored = quantities.elastic_energy(ws) + sum(quantities.stored_energies(ws).values())
        if features.groups:  # a stage does not act on fixed vertices
            stored += float((quantities.barrier_energies(ws) * (free if features.num_staged else 1)).sum())
        if ws.pairs:
            stored += ws.pairs.look(ws.state.u)[0]
        self.moving = max(self.moving, kinetic + stored)
        j = min(now, num_passes - 1)
        if features.pulled and self.steady:
            hosts = ws.hosts.take(a.now, Instant(ws.solver.schedule))
            stored += hosts.load_energy(runtime.fetch_row(ws.state.u, 0))
        forces = ws.forces_at(j, num_passes) - ws.loads_at(j, num_passes, pulls=not self.steady) + weight
        if a.bodies:  # without what holds them together
            forces = a.bodies.pulled(forces, u)
        if ws.projected:
            forces = ws.projected.pulled(forces)
        if ws.solver.lags(now, num_passes):
            swapped = 0.5 * h * float((v * forces).sum())
        else:
            inverse = np.divide(1.0, mass, out=np.zeros_like(mass), where=mass > 0)
            swapped = -0.125 * h * h * float((inverse * a.supports.free(forces) ** 2).sum())
        return kinetic + stored + swapped - float((weight * (values.rest + u)).sum())


class EnergyGained(CarriesMore, UserWarning):
    """Steps have added energy to the motion. Carries `gained` [J], `share` of the energy that moves, `step`, `time` [s] and
    the `substep` [s] that is advised."""

    def __init__(self, message: str, gained: float, share: float, step: int, time: float, substep: float):
        super().__init__(message)
        self.gained, self.share, self.step, self.time, self.substep = gained, share, step, time, substep


class EnergyWatch(Gains):
    """Sums what implicit midpoint and BDF2 steps add to the energy, against the largest energy that moved so far.

    Between u and u' = 2 u* - u the forces f(u*) = -dE/du do the work f(u*) . (u' - u), and kinetic energy changes by just
    that; the energy of strains and contacts changes by E(u') - E(u). The step has added

        E(u') - E(u) + f(u*) . (u' - u)

    which is of third order in u' - u, and none for a quadratic E. Loads, drag and prescribed motion do not enter it. Where
    obstacles go from w by w* to w', E(u) and E(u') are taken with them at w and w', and what they do on the body in the
    middle, dE/dw (w' - w), is none of the step's.
    BDF2 does not keep kinetic energy either, so that of free vertices is added, less the work m (v* - y) / gamma . (u' - u)
    of what accelerates them (solvers/implicit/solver.py). It gives back within a bounce a part of what it has just taken,
    and loses on the whole: only a net gain counts.
    Simo, Tarnow 1992, The discrete energy-momentum method, doi:10.1007/BF00913408.
    """

    def __init__(self, workspace: Workspace):
        self.ws = weakref.proxy(workspace)  # which holds this: no circle
        self.clear()

    def clear(self) -> None:
        """Forget what was seen."""
        self.gained = self.moving = 0.0
        self.begin()

    def begin(self) -> None:
        """Follow the drift from the present state on."""
        self._begun = self.gained

    def take(self) -> float:
        """What steps have added [J] since the last call, or `begin`; below zero where they took some."""
        added = self.gained - self._begun
        self.begin()
        return added

    def note(self, u, u_star, u_next, v_next, places: tuple, kinetic: float = 0.0) -> None:
        """A step went from u by u_star to u_next, obstacles from places[0] by places[1] to places[2] (displacements [m],
        shape (num_obstacles, 3)); contacts are as in its pass. kinetic: what it has added to that energy [J]."""
        potential, energies = self.ws.potential, []
        drift = self.ws.arrays.poses.drift(places[0], places[2])
        # what viscosity and friction take is no gain, and none of a step's making
        with potential.without_viscosity(), potential.without_friction():
            for displacement, place in ((u, places[0]), (u_next, places[2])):
                self.ws.collisions.put(place)
                potential.place(displacement)
                energies.append(potential.energy()[0])
            self.ws.collisions.put(places[1])
            potential.place(u_star)
            work = float((potential.forces()[0] * (u_next - u)).sum())
            work -= self._work_of_obstacles(u_star, places[1], drift)
        self.gained += energies[1] - energies[0] + work + kinetic
        self.moving = max(self.moving, kinetic_energy(self.ws.mass, v_next) + energies[1])

    def _work_of_obstacles(self, u_star: np.ndarray, places: np.ndarray, drift: np.ndarray) -> float:
        """dE/dw (w' - w) [J], by differences over a hundredth of the smallest gap."""
        if not drift.any():
            return 0.0
        detection = self.ws.collisions.detection
        near = detection.nearest(u_star, places, detection.widest)
        gap = detection.narrowest if near is None else min(near.value, detection.narrowest)
        share, energies = min(0.5, 0.01 * gap / np.abs(drift).max()), []
        for sign in (1, -1):
            self.ws.collisions.put(self.ws.arrays.poses.moved(places, drift, sign * share))
            self.ws.potential.place(u_star)
            energies.append(self.ws.potential.energy()[0])
        self.ws.collisions.put(places)
        return (energies[0] - energies[1]) / (2 * share)


class OwnWork:
    """Follows what explicit steps add to the energy of a run by themselves, apart from all that is done to it: the
    drift of a scheme [J].

    Kinetic energy T changes by the work W of the body's own forces, strains, weight and springs, and by that of all else:
    loads, supports, friction, drag, contact stages. The own forces have an energy V, and dV + W, which vanishes as steps
    become short, is the scheme's own. What is left of a change of the whole energy was done from outside, or taken.
    """

    def __init__(self, workspace: Workspace):
        self.ws = weakref.proxy(workspace)  # which holds this: no circle
        self.begin()

    @staticmethod
    def serves(workspace: Workspace) -> bool:
        """Whether the forces of a scene are those of an energy that does not change with time, at each vertex by itself."""
        scene, law = workspace.scene, workspace.arrays.law
        energetic = law.reads == ("H",) and not law.state_names and not scene.term(Growth)
        return energetic and not (scene.reduced or workspace.arrays.features().pressing or workspace.has_unnoted_work)

    def begin(self) -> None:
        """From the present state on."""
        runtime.fill(self.ws.contact.own_work, 0)
        self._energy = self._own_energy()

    def take(self) -> float:
        """The drift [J] since the last call, or `begin`."""
        before, work = self._energy, float(runtime.fetch(self.ws.contact.own_work).astype(np.float64).sum())
        self.begin()
        return self._energy - before + work

    def _own_energy(self) -> float:
        """V [J]; the weight of fixed vertices is carried by what holds them."""
        ws, a = self.ws, self.ws.arrays
        out = quantities.elastic_energy(ws) + sum(quantities.stored_energies(ws).values())
        mass = a.values.mass * (runtime.fetch(a.inverse_mass) > 0)
        u = runtime.fetch_row(ws.state.u, 0).astype(np.float64)
        return out - float((mass[:, None] * a.gravity_of(a.values) * (a.values.rest + u)).sum())
