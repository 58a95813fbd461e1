"""How the numbers of many scenes lie on the device: eight scenes in the lanes of vectors on CPUs, scenes innermost on GPUs.

Either way `numbers` are some that each scene has of its own, and `vectors` three-vectors, of vertices say; both may have
slots in front. On the host they are (scenes, ..., k) and (scenes, ..., k, 3).
"""

from dataclasses import dataclass

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.runtime import LANES, PRECISIONS, number_type, vector_type

SPREAD = 1024  # items of a loop at least, for Taichi keeps fewer on one thread
APART = 16  # numbers between what threads note, so that they do not wait for each other's cache lines


def in_slots(arrays: list[np.ndarray]) -> np.ndarray:
    """(rows, k, 3) of each scene as (scenes, rows, k, 3); one row serves all where others have more."""
    first = arrays[0]
    if all(x is first for x in arrays):
        return np.broadcast_to(first, (len(arrays), *first.shape))
    rows = max(len(x) for x in arrays)
    if all(len(x) == rows for x in arrays):
        return np.stack(arrays)
    return np.stack([np.broadcast_to(x, (rows, *x.shape[1:])) for x in arrays])


@dataclass(frozen=True)
class Lanes:
    """Eight scenes make a block: element b k + i of an array of lanes holds number i of the scenes 8 b .. 8 b + 7, of which
    each has k. A vector is three such numbers. The last block is filled up with copies of the last scene."""

    precision: str
    num_scenes: int

    in_lanes = True
    # kinds of arrays (runtime.array_types)
    KINDS = dict(numbers="blocks", numbers2="blocks2", vectors="blocks", vectors2="blocks2")

    @property
    def number(self):
        """Type of an element that holds numbers."""
        return ti.types.vector(LANES, PRECISIONS[self.precision])

    vector = number

    @property
    def num_blocks(self) -> int:
        return -(-self.num_scenes // LANES)

    @property
    def width(self) -> int:
        """Scenes with those that fill up the last block."""
        return LANES * self.num_blocks

    def numbers(self, *shape: int):
        """Room for (..., k) numbers of each scene."""
        *slots, count = shape
        return runtime.array(self.number, *slots, self.num_blocks * count)

    def vectors(self, *shape: int):
        """Room for (..., k) vectors of each scene."""
        *slots, count = shape
        return self.numbers(*slots, 3 * count)

    def pack(self, per_scene: np.ndarray) -> np.ndarray:
        """(scenes, ..., k) as the device has them."""
        blocks, short = self.num_blocks, self.width - len(per_scene)
        if short:
            per_scene = np.concatenate([per_scene, np.repeat(per_scene[-1:], short, 0)])
        *slots, n = per_scene.shape[1:]
        parted = per_scene.reshape(blocks, LANES, *slots, n)
        return np.moveaxis(parted, (0, 1), (-3, -1)).reshape(*slots, blocks * n, LANES)

    def pack_vectors(self, per_scene: np.ndarray) -> np.ndarray:
        """(scenes, ..., k, 3) as the device has them."""
        return self.pack(per_scene.reshape(*per_scene.shape[:-2], -1))

    def unpack(self, array) -> np.ndarray:
        """What an array of numbers holds: (scenes, ..., k) in its precision."""
        lanes, blocks = runtime.fetch(array), self.num_blocks
        *slots, rows, _ = lanes.shape
        parted = lanes.reshape(*slots, blocks, rows // blocks, LANES)
        return np.moveaxis(parted, (-3, -1), (0, 1)).reshape(self.width, *slots, rows // blocks)[: self.num_scenes]

    def unpack_vectors(self, array) -> np.ndarray:
        """What an array of vectors holds: (scenes, ..., k, 3) in its precision."""
        out = self.unpack(array)
        return out[..., : out.shape[-1] // 3 * 3].reshape(*out.shape[:-1], -1, 3)  # an array of none holds one number

    def scratch(self, rows: int, num_vertices: int) -> tuple[int, int]:
        """(rows, columns) of what is noted of a vertex while it is worked on: a column for each block (views.Scratch)."""
        return rows, APART * self.num_blocks

    def counts(self, num_tetrahedra: int, num_vertices: int) -> dict:
        """Numbers that kernels take."""
        return dict(num_blocks=self.num_blocks, spread=max(1, -(-SPREAD // self.num_blocks)))


@dataclass(frozen=True)
class Innermost:
    """Number i of scene b is element i B + b of an array, for B scenes: neighbouring threads work on neighbouring scenes,
    and read and write neighbouring numbers."""

    precision: str
    num_scenes: int

    in_lanes = False
    KINDS = dict(numbers="scalars", numbers2="scalars2", vectors="vectors", vectors2="vectors2")

    number, vector = number_type, vector_type

    @property
    def width(self) -> int:
        return self.num_scenes

    def numbers(self, *shape: int):
        *slots, count = shape
        return runtime.array(self.number, *slots, self.num_scenes * count)

    def vectors(self, *shape: int):
        *slots, count = shape
        return runtime.array(self.vector, *slots, self.num_scenes * count)

    def pack(self, per_scene: np.ndarray) -> np.ndarray:
        moved = np.moveaxis(per_scene, 0, -1)
        return moved.reshape(*moved.shape[:-2], -1)

    def pack_vectors(self, per_scene: np.ndarray) -> np.ndarray:
        moved = np.moveaxis(per_scene, 0, -2)
        return moved.reshape(*moved.shape[:-3], -1, 3)

    def unpack(self, array) -> np.ndarray:
        flat = runtime.fetch(array)
        return np.moveaxis(flat.reshape(*flat.shape[:-1], -1, self.num_scenes), -1, 0)

    def unpack_vectors(self, array) -> np.ndarray:
        flat = runtime.fetch(array)
        return np.moveaxis(flat.reshape(*flat.shape[:-2], -1, self.num_scenes, 3), -2, 0)

    def scratch(self, rows: int, num_vertices: int) -> tuple[int, int]:
        return rows, num_vertices * self.num_scenes

    def counts(self, num_tetrahedra: int, num_vertices: int) -> dict:
        B = self.num_scenes
        return dict(num_scenes=B, num_items=num_tetrahedra * B, num_rows=num_vertices * B)
