"""n steps of a solver as one differentiable operation."""

from diffsim_ti.outputs.output import Frames
from diffsim_ti.rollout.rollout import Rollout

__all__ = ["Frames", "Rollout"]
