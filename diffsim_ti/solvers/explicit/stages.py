"""The stages of an explicit step, each with its tangent and adjoint: one list that forward, tangent and reverse run."""

from collections.abc import Callable
from contextlib import nullcontext
from typing import NamedTuple

from diffsim_ti.mechanics.chambers.gases import ChambersAdjoint, ChambersTangent
from diffsim_ti.mechanics.chambers.held_volume_derivatives import HeldAdjoint, HeldTangent
from diffsim_ti.mechanics.obstacles.felt_derivatives import FeltAdjoint, FeltTangent
from diffsim_ti.mechanics.stage import Passes, Stage
from diffsim_ti.mechanics.surfaces.stages import (
    SurfaceForces,
    SurfaceForcesAdjoint,
    SurfaceForcesTangent,
    SurfaceFriction,
    SurfaceFrictionAdjoint,
    SurfaceFrictionTangent,
)


class KickDrift(Stage):
    """What one launch does, for as many passes as it takes: tetrahedra and interactions, vertices, reduced sets.

    name: of the kernel (kernels.py); record: what it calls the changes or adjoints of a run, "" forward; more: numbers.
    """

    in_kicks = True

    def __init__(self, name: str, record: str = "", **more):
        self.name, self.record, self.more = name, record, more

    def prepare(self, at: Passes) -> None:
        ws, run = at.ws, at.run
        own = {self.record: (run, run.numbers, run.frames)} if self.record else {}
        kernels = ws.kernels(run.features if self.record else ws.arrays.features())
        own |= dict(state=(at.history, ws.frames, ws.watch, ws.contact), table=ws.table)
        at.launch = ws.bound(getattr(kernels, self.name), **own)

    def do(self, at: Passes):
        own = dict(base=at.base, stride=at.stride, num_passes=at.num_passes, halt=at.halt, kick=int(at.kick))
        at.launch(**at.numbers, **own, **self.more)
        return nullcontext()


class Stages(NamedTuple):
    """A stage of a run, and what makes those of its tangent and of its adjoint for a run of these."""

    value: Stage
    tangent: Callable[..., Stage]
    adjoint: Callable[..., Stage]


def stages_of(ws) -> list[Stages]:
    """Those that the scene of a workspace has, the outermost first (mechanics/stage.py)."""
    friction = ws.pairs and ws.pairs.friction
    every = (
        Stages(ws.pairs and SurfaceForces(ws), SurfaceForcesTangent, SurfaceForcesAdjoint),
        Stages(ws.volumes, HeldTangent, HeldAdjoint),
        Stages(friction and SurfaceFriction(friction), SurfaceFrictionTangent, SurfaceFrictionAdjoint),
        Stages(ws.chambers, ChambersTangent, ChambersAdjoint),
        Stages(ws.faces, FeltTangent, FeltAdjoint),
        Stages(
            KickDrift("step"),
            lambda _, run: KickDrift("step_jvp", "tangent", rate_dot=run.rate_dot),
            lambda _, run: KickDrift("step_vjp", "adjoint", steps=run.steps, num_parts=run.num_parts),
        ),
    )
    return [stages for stages in every if stages.value]
