"""Contact of surfaces with themselves, each other and edges of obstacles in explicit steps: its forces, and friction after
the drift."""

from contextlib import contextmanager

import numpy as np

from diffsim_ti.inputs import Derived
from diffsim_ti.mechanics.stage import Passes, Stage
from diffsim_ti.mechanics.surfaces.surface_pairs import SurfacePairs, Tunnelling
from diffsim_ti.state.obstacle_poses import AT_BEGIN, AT_STAGE, Moment


def moment_of(at: Passes) -> Moment:
    """Obstacles at the end of a pass, and where it begins."""
    schedule = at.ws.solver.schedule
    return Moment(schedule, at.j, schedule.end(at.j), schedule.begin(at.j))


class SurfaceForces(Stage):
    """Forces of near pairs before the kick; after the step none of them may have gone through each other."""

    in_kicks = True

    def __init__(self, pairs: SurfacePairs):
        self.pairs, self.a, self.by_path = pairs, pairs.a, None

    def _follow(self, at: Passes, m: int) -> None:
        if self.pairs.obstacles:
            self.pairs.follow(self.a.poses.value(self.a.rows["path"], moment_of(at)), m)

    @contextmanager
    def do(self, at: Passes):
        self._follow(at, AT_BEGIN)
        if at.launch is None:  # the first pass: after each of them `check_pass` keeps the list
            self.pairs.ensure(at.history.u, at.slot)
        self.pairs.forces(at.history.u, at.slot, self.a.corner)
        yield
        if at.kick:
            return
        self._follow(at, AT_STAGE)
        try:
            self.pairs.check_pass(at.history.u, at.end, float(at.ws.solver.schedule.length(at.j)))
        except Tunnelling as error:
            if at.ws.solver.stages_contact and not at.ws.scene.reduced:
                error.args = (f"{error}; or pass SelfContact(stage=True), a stage that no step is too large for",)
            raise at.ws.dated(error, at.j, at.num_passes) from None

    @contextmanager
    def tangent(self, at: Passes):
        pairs, run, place = self.pairs, at.run, (at.history.u, at.slot)
        self._follow(at, AT_BEGIN)
        poses = self.a.poses.jvp(self.a.rows["path"], run.tangent.path, moment_of(at)) if pairs.obstacles else None
        of_obstacles = dict(poses_dot=poses) if pairs.obstacles else {}
        pairs.ensure(*place)
        if pairs.friction:  # which needs the forces, and their corners are those of the product
            pairs.friction.begin_jvp(at.history, at.slot, run.u, run.numbers, **of_obstacles)
        pairs.product(*place, run.u, self.a.corner, run.numbers.rest, run.tangent.parameters, **of_obstacles)
        yield

    @contextmanager
    def adjoint(self, at: Passes):
        self._follow(at, AT_BEGIN)
        yield
        self.pairs.ensure(at.history.u, at.slot)
        self.pairs.vjp(at.history.u, at.slot, at.run.w, at.run.corner)
        if self.by_path is not None:
            by_rows = self.pairs.obstacles.take_rows()
            self.a.poses.vjp(self.a.rows["path"], by_rows, moment_of(at), self.by_path)

    def clear(self) -> None:
        self.pairs.clear_sums()
        moving = self.pairs.obstacles and self.a.rows["path"] is not None
        self.by_path = np.zeros(self.a.rows["path"].shape) if moving else None

    def collect(self, out: Derived) -> None:
        by_parameters, rest = self.pairs.collect()
        out.parameters += by_parameters
        out.rest = rest + out.rest
        if self.by_path is not None:
            out.path += self.by_path


class SurfaceFriction(Stage):
    """Friction of the pairs, on the velocities after the drift."""

    def __init__(self, pairs: SurfacePairs):
        self.friction, self.a = pairs.friction, pairs.a

    @contextmanager
    def do(self, at: Passes):
        if at.stride:
            self.friction.keep(at.history.num_slots)
        self.friction.measure(at.history.u, at.slot)
        yield
        self.friction.slide(at.history, at.end, at.now, recording=at.stride > 0)

    @contextmanager
    def tangent(self, at: Passes):
        now, run = at.now, at.run
        if not now.alpha > 0:
            yield
            return
        with self.friction.alone(at.history, at.end):
            yield
            self.friction.slide_jvp(at.history, at.end, now, run.rate_dot, run.u, run.v, run.numbers)

    @contextmanager
    def adjoint(self, at: Passes):
        now = at.now
        if not now.alpha > 0:
            yield
            return
        if not self.friction.takes_pending:
            at.run.complete()
        with self.friction.alone(at.history, at.end):
            self.friction.slide_vjp(at.history, at.slot, now, at.run)
            yield
        self.friction.add_place(at.run)

    def collect(self, out: Derived) -> None:
        by_mass, by_rate = self.friction.collect_pass()
        out.mass = out.mass + by_mass
        drag = self.a.features().drag
        if drag >= 0:
            out.parameters[drag] += by_rate
