"""Runs of an implicit solver of all scenes of a batch at once, forward and in reverse."""

from copy import copy

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.batch.joined_newton import JoinedNewton
from diffsim_ti.batch.joined_potential import JoinedCollisions, JoinedPotential, JoinedPreconditioners, SharesOfScenes
from diffsim_ti.batch.joined_scene import JoinedArrays, joined_derived, joined_hosts, joined_scene, of_each, of_scenes
from diffsim_ti.batch.sweep import BatchSweep
from diffsim_ti.differentiation.arrays import add_transposed
from diffsim_ti.inputs import Derived
from diffsim_ti.mechanics.obstacles.approach import Approach
from diffsim_ti.mechanics.supports.free import held_as
from diffsim_ti.solvers.implicit.adjoint import ImplicitAdjoint
from diffsim_ti.solvers.implicit.workspace import ImplicitWorkspace
from diffsim_ti.state.watch import limits


class JoinedWorkspace(ImplicitWorkspace):
    """left: (scenes,), those that are to be run alone, for they left the usual course of a solve (joined_newton.py)."""

    arrays_kind, potential_kind, newton_kind = JoinedArrays, JoinedPotential, JoinedNewton
    collisions_kind, preconditioners_kind, shares_kind = JoinedCollisions, JoinedPreconditioners, SharesOfScenes

    def __init__(self, solver, each: list[Derived]):
        self.num_scenes, self.left = len(each), np.zeros(len(each), bool)
        super().__init__(solver, each)
        self.energy_watch = None

    def load(self, each: list[Derived]) -> None:
        self.each = each
        super().load(joined_derived(each))

    def load_bodies(self, derived: Derived) -> None:
        self.hosts = joined_hosts(self.scene.one, self.num_scenes)
        super().load_bodies(derived)

    def restart(self) -> None:
        self.left[:] = False
        super().restart()

    def leave(self, which: np.ndarray) -> None:
        """Give scenes up."""
        self.left |= which

    def balance(self):
        return None

    def contact_forces(self, frame_time):
        """The scenes are the first axis."""
        return of_scenes(self.impulses.forces, self.num_scenes, axis=3).copy()

    # ---- what passes are told ----------------------------------------------------------------------------------------

    def _host_values(self):
        return of_each(self.each)

    def _add_forces(self, rows, out, j, stage):
        if rows is not None:
            share, keyed, acts_at = self.share_at_stage(j, stage), self.dead_loads.keyed, self.dead_loads.acts_at
            for own, target in zip(of_scenes(rows, self.num_scenes, 1), of_scenes(out, self.num_scenes)):
                target[acts_at] += self.solver.schedule.load(own, j, share, keyed)
        return out

    def add_loads(self, rows_adj, j, stage, by_vertices) -> None:
        share, keyed, acts_at = self.share_at_stage(j, stage), self.dead_loads.keyed, self.dead_loads.acts_at
        for own, by in zip(of_scenes(rows_adj, self.num_scenes, 1), of_scenes(by_vertices, self.num_scenes)):
            add_transposed(own, lambda rows: self.solver.schedule.load(rows, j, share, keyed), by[acts_at])

    # ---- a pass ------------------------------------------------------------------------------------------------------

    def solve_pass(self, j, u, held, starts, problem, stage) -> np.ndarray:
        going, newton = ~self.left, self.newton
        newton.going = going
        self.potential.only(going)
        starts = [held_as(self.free, held, u + self.linear * (start - u)) for start in starts]
        near = self._in_front(u, held, starts, problem)
        newton.going = ~self.left
        best, least = near, np.zeros(self.num_scenes)
        rise_of = newton.rises_from(near, problem) if starts else None
        for start in starts:
            share = newton.spread(self.collisions.past(near, start - near))
            there = near + share * (start - near)
            rise = rise_of([there])[0]
            better = rise < least
            best, least = np.where(newton.spread(better), there, best), np.minimum(rise, least)
        there, solved = newton.solve_all(best, problem, ~self.left, stage.static)
        solved &= newton.upright
        if stage.static and not self.arrays.contacts:
            solved &= newton.rounds <= self.noted.usual  # else a run alone says whether a branch was left
        self.leave(~solved)
        return np.where(newton.spread(self.left), u, there)

    def _led(self, u, held, problem):
        return []  # motions of supports start where bodies are

    def _in_front(self, u, held, starts, problem) -> np.ndarray:
        """As Approach of one scene: `held`, or where bodies stand in front of obstacles that come to them within the pass.
        Scenes of which none is found are given up."""
        collisions, spread = self.collisions, self.newton.spread
        before, after = collisions.before, collisions.at_stage
        step, drift = held - u, collisions.drift(before, after)
        if not (step.any() or drift.any()):
            return held
        free = collisions.detection.shares(u, step, before, drift) == 1
        near, meets = np.where(spread(free), held, u), ~free & ~self.left
        if not meets.any():
            return near
        collisions.put(before)
        self.newton.going = meets
        rise_of = self.newton.rises_from(held, problem)
        for start in starts:
            led = meets & (collisions.detection.shares(u, start - u, before, drift) == 1)
            led &= rise_of([start])[0] <= 0
            near, meets = np.where(spread(led), start, near), meets & ~led
        near = self._in_parts(near, step, before, drift, problem, meets)
        collisions.put(after)
        return near

    def _in_parts(self, place, step, before, drift, problem, meets) -> np.ndarray:
        """Obstacles and held vertices of some scenes come as far as the way is free, bodies make room, and so on."""
        collisions, newton, count = self.collisions, self.newton, self.num_scenes
        done, stuck = np.zeros(count), np.zeros(count, int)
        for _ in range(Approach.most_parts):
            if not meets.any():
                break
            left = np.where(meets, 1 - done, 0.0)
            poses, along = collisions.moved(before, drift, done), newton.spread(left) * step
            ahead = drift * np.repeat(left, len(drift) // count)[:, None]
            share = collisions.detection.shares(place, along, poses, ahead, kept=Approach.kept)
            place, done = place + newton.spread(share) * along, done + share * left
            meets = meets & (share < 1)
            stuck = np.where(share * left < Approach.least, stuck + 1, 0)
            self.leave(meets & (stuck > Approach.patience))
            meets &= ~self.left
            collisions.put(collisions.moved(before, drift, done))
            there, roomy = newton.solve_all(place, problem, meets, False, Approach.rounds)
            self.leave(meets & ~roomy)
            place, meets = np.where(newton.spread(meets), there, place), meets & roomy
        self.leave(meets)
        return place


class Unguarded:
    """Takes the workspace through its passes: implicit steps say themselves what goes wrong."""

    def __init__(self, workspace):
        self.advance = self.advance_again = self._advance
        self.ws = workspace

    def restart(self) -> None:
        """Nothing is kept."""

    def _advance(self, first: int, last: int, num_passes: int, save_every: int = 0, recording: bool = False) -> None:
        if recording:
            self.ws.save(self.ws.record, first)
        self.ws.advance(first, last, num_passes, save_every, 0 if recording else None)


class JoinedAdjoint(ImplicitAdjoint):
    """Adjoints of the runs of all scenes; one linear solve for a pass of all."""

    def start(self, positions_adj, velocities_adj, last_frame_is_input) -> None:
        """positions_adj, velocities_adj: (scenes, frames, n, 3)"""
        joined = (np.moveaxis(x, 0, 1).reshape(x.shape[1], -1, 3) for x in (positions_adj, velocities_adj))
        super().start(*joined, last_frame_is_input)
        self.by_hosts = of_each([d.zeros() for d in self.ws.each])

    def seed_contacts(self, forces_adj, frame_time) -> None:
        if forces_adj is not None:
            joined = np.moveaxis(forces_adj, 0, 3)
            forces_adj = joined.reshape(*joined.shape[:3], -1, 3)
        super().seed_contacts(forces_adj, frame_time)

    def solve(self, b):
        ws, newton = self.ws, self.ws.newton
        b = b * ws.free
        if not b.any():
            return b
        if self._preconditioner is None:
            ws.potential.only(~ws.left)
            self._preconditioner, _ = ws.preconditioner(self.mass)
            self._preconditioner.update(self.u_star)
        newton.mass, going = self.mass, ~ws.left
        mass, more = newton.system()
        tolerances, most = np.full(len(going), self.tolerance), 20 * len(b) // len(going)
        x, solved, *_ = self._preconditioner.solver(mass, more, b, tolerances, going, most, self.eps)
        ws.leave(~solved)
        return x * ws.free

    def _sum(self, x):
        return of_scenes(x, self.ws.num_scenes).sum(1)

    def _sum_of_poses(self, rows):
        return np.concatenate(list(of_scenes(rows, self.ws.num_scenes, axis=1).sum(2)))

    def collect(self) -> Derived:
        """The scenes are the first axis."""
        ws, features, count = self.ws, self.features, self.ws.num_scenes
        found, rows = self.numbers.collect(), features.sums()
        found.displacement, found.velocity = self.p, self.q
        if features.density and self.element_masses is None:
            found.mass = self.mass_adj
        found.element_masses = self.element_masses
        found.rest = self.frames[0].sum(0) + self.rest_adj + (0.0 if found.rest is None else found.rest)
        if self.motion is not None:
            found.displacement[ws.arrays.held] += self.anchor
        out = ws.each[0].mapped(lambda x: np.zeros((count, *x.shape)))
        own = "displacement velocity mass element_masses rest surface gradients volumes coefficients".split()
        for name in own:
            if getattr(found, name) is not None and getattr(out, name) is not None:
                setattr(out, name, of_scenes(getattr(found, name), count))
        of_vertices = runtime.fetch(self.numbers.sums).astype(np.float64)[rows.of("parameters")]
        out.parameters[:, : features.num_parameters] = of_scenes(of_vertices, count, axis=1).sum(2)
        if features.gravity >= 0:
            out.parameters[:, features.gravity :][:, :3] = self.gravity_adj
        if features.drag >= 0:
            out.parameters[:, features.drag] = self.rate
        for name in ("forces", "motion", "path"):
            if getattr(self, name) is not None:
                setattr(out, name, of_scenes(getattr(self, name), count, axis=1).copy())
        if self.growth is not None:
            each = of_scenes(self.growth, count, axis=2)
            out.growths = each.sum(3, keepdims=True) if out.growths.shape[3] == 1 else each
        for b, by_hosts in enumerate(self.by_hosts.each):
            for name, more in by_hosts.parts().items():
                if more is not None and more.any():
                    getattr(out, name)[b] += more
        return out


class JoinedSweep(BatchSweep):
    """Runs of an implicit solver of all scenes at once; `left`: those that are to be run alone."""

    held = property(lambda self: self.num_scenes)  # in vectors of four

    def __init__(self, solver, steps, num_scenes: int, **options):
        super().__init__(solver, steps, num_scenes, **options)
        self.joined = copy(solver)
        self.joined.scene = joined_scene(solver.scene, num_scenes)

    def make_workspace(self, derived):
        return JoinedWorkspace(self.joined, derived)

    def _make_guard(self):
        return Unguarded(self.workspace)

    def make_adjoint(self, density, shape):
        return JoinedAdjoint(self.workspace, density, shape)

    def states(self):
        count = self.num_scenes
        return tuple(of_scenes(runtime.fetch(x), count, axis=1).copy() for x in self.workspace.frames)

    def crossed(self) -> dict:
        return {}

    def resolutions(self):
        ws = self.workspace
        rows = of_scenes(ws.watch.rows(), self.num_scenes, axis=1) if ws.arrays.contacts else [None] * self.num_scenes
        return lambda b: ws.watch.resolution_of(rows[b], ws.each[b], ws.substep, limits(self.solver))

    @property
    def left(self) -> list[int]:
        return np.flatnonzero(self.workspace.left).tolist()
