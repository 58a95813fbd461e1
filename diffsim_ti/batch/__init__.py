"""Many scenes in a batch."""

from diffsim_ti.batch.batch import Batch, BatchFrames

__all__ = ["Batch", "BatchFrames"]
