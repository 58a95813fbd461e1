"""n steps of a solver as one differentiable operation."""

from diffsim_ti.rollout.rollout import Frames, Rollout

__all__ = ["Frames", "Rollout"]
