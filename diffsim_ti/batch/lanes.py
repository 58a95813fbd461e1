"""Numbers of many scenes in lanes: how they are packed, and the arrays of a batch's states on the device."""

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.runtime import LANES
from diffsim_ti.state.history import copy_slot


def num_blocks(num_scenes: int) -> int:
    """Blocks of eight that hold so many scenes."""
    return -(-num_scenes // LANES)


def pack(per_scene: np.ndarray) -> np.ndarray:
    """(scenes, ..., n) as (..., blocks n, 8); the last block is filled up with copies of the last scene."""
    blocks = num_blocks(len(per_scene))
    short = blocks * LANES - len(per_scene)
    if short:
        per_scene = np.concatenate([per_scene, np.repeat(per_scene[-1:], short, 0)])
    *slots, n = per_scene.shape[1:]
    parted = per_scene.reshape(blocks, LANES, *slots, n)
    return np.moveaxis(parted, (0, 1), (-3, -1)).reshape(*slots, blocks * n, LANES)


def unpack(lanes: np.ndarray, num_scenes: int) -> np.ndarray:
    """The inverse, in the precision of `lanes`."""
    *slots, rows, _ = lanes.shape
    blocks = num_blocks(num_scenes)
    parted = lanes.reshape(*slots, blocks, rows // blocks, LANES)
    return np.moveaxis(parted, (-3, -1), (0, 1)).reshape(blocks * LANES, *slots, rows // blocks)[:num_scenes]


def in_slots(arrays: list[np.ndarray]) -> np.ndarray:
    """(rows, k, 3) of each scene as (scenes, rows, 3 k); one row serves all where others have more."""
    rows = max(len(x) for x in arrays)
    return np.stack([np.broadcast_to(x, (rows, *x.shape[1:])).reshape(rows, -1) for x in arrays])


def vectors(array, num_scenes: int) -> np.ndarray:
    """What an array of vectors of scenes holds: (scenes, slots, n, 3) in its own precision."""
    out = unpack(runtime.fetch(array), num_scenes)
    return out.reshape(*out.shape[:-1], -1, 3)


class LanesHistory:
    """States of a batch in `num_slots` slots, forces and what vertices met with them if recorded, and the law's states."""

    def __init__(self, workspace, num_slots: int, record: bool = False):
        lanes, n, self.num_slots = workspace.lanes, 3 * workspace.num_rows, num_slots
        self.u, self.v = (runtime.array(lanes, num_slots, n) for _ in range(2))
        self.f = runtime.array(lanes, *((num_slots, n) if record else (1, 1)))
        self.z = runtime.array(lanes, num_slots, workspace.law_rows) if workspace.law_rows else None
        calm = record and workspace.some_special
        self.calm = runtime.array(ti.i32, num_slots * workspace.num_rows if calm else 1)

    def copy(self, slot: int, target: "LanesHistory", to: int) -> None:
        for name in ("u", "v") if self.z is None else ("u", "v", "z"):
            copy_slot(getattr(self, name), slot, getattr(target, name), to)
