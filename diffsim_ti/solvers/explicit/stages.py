"""The stages of an explicit step: one list that forward, tangent and reverse go through."""

from contextlib import nullcontext

from diffsim_ti.mechanics.stage import Passes, Stage
from diffsim_ti.mechanics.surfaces.contact_stage import PairContact
from diffsim_ti.mechanics.surfaces.nearby_contact import NearbyContact


class KickDrift(Stage):
    """What one launch does (kernels.py), for as many passes as it takes: tetrahedra and interactions, vertices, reduced
    sets."""

    in_kicks = True

    def do(self, at: Passes):
        return self._launch(at, "step", at.ws.arrays.features())

    def tangent(self, at: Passes):
        return self._launch(at, "step_jvp", at.run.features, "tangent", rate_dot=at.run.rate_dot)

    def adjoint(self, at: Passes):
        more = dict(halt=at.halt, kick=int(at.kick), steps=at.run.steps, num_parts=at.run.num_parts)
        return self._launch(at, "step_vjp", at.run.features, "adjoint", **more)

    @staticmethod
    def _launch(at: Passes, name: str, features, record: str = "", **more):
        """record: what the kernel calls the changes or adjoints of a run."""
        if at.launch is None:
            ws, run = at.ws, at.run
            own = {record: (run, run.numbers, run.frames, run.impulses)} if record else {}
            states = at.history, ws.frames, ws.watch, ws.contact
            at.launch = ws.bound(getattr(ws.kernels(features), name), state=states, **own, table=ws.table)
        at.launch(**at.numbers, base=at.base, stride=at.stride, **more)
        return nullcontext()


def stages_of(ws) -> list[Stage]:
    """Those that the scene of a workspace has, the outermost first (mechanics/stage.py)."""
    contact = _contact_of(ws.pairs, ws.solver.contact_damping, ws.scene.reduced.bodies)
    every = contact, ws.volumes, ws.relations, ws.chambers, ws.projected, ws.joint_stage, KickDrift()
    return [stage for stage in every if stage]


def _contact_of(pairs, damping: float, bodies) -> Stage | None:
    """That of pairs."""
    make = lambda: PairContact(pairs, damping, bodies)  # noqa: E731
    if not pairs:
        return None
    return NearbyContact(make) if pairs.nearby and pairs.nearby.many else make()
