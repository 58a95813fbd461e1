"""Which scenes can be computed side by side, and how their numbers then lie on the device: eight scenes in the lanes of
vectors on CPUs, scenes innermost on GPUs.

Either way `numbers` are some that each scene has of its own, and `vectors` three-vectors, of vertices say; both may have
slots in front. On the host they are (scenes, ..., k) and (scenes, ..., k, 3).
"""

from dataclasses import dataclass

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.interactions import host_forces
from diffsim_ti.runtime import LANES, PRECISIONS, number_type, vector_type
from diffsim_ti.terms import Robot, SelfContact

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


def why_not(solver) -> str | None:
    """What keeps scenes of a solver from being computed side by side, or None if nothing does."""
    scene = solver.scene
    if solver.explicit and runtime.runs_on_cpu() and not scene.law.lanes:
        return f"the law of {type(scene.material).__name__} does not come in lanes"
    terms = dict(self_contact=scene.term(SelfContact), robots=scene.terms_of(Robot))
    terms |= {x.name: True for x in scene.interactions if solver.explicit and x.apart}
    terms |= dict(contact_by_pairs=any(term.primitives is not None for term in scene.terms))
    values = scene.inputs.values
    terms |= dict(numbers_at_points=any(values[x].ndim == 2 for x in scene.material.at_points if x in values))
    terms |= dict(mesh_obstacles=any(term.table.size for term in scene.ordered_terms if term.acts_on_surface))
    if solver.explicit:
        terms |= dict(reduced_sets=scene.reduced)
    else:
        terms |= dict(reduced_sets_or_ties=scene.reduced, volumes_or_relations_that_are_held=scene.has_multipliers)
    if there := [name.replace("_", " ") for name, some in terms.items() if some]:
        return f"it has {' and '.join(there)}"
    return None if solver.explicit else _why_not_joined(solver)


def _why_not_joined(solver) -> str | None:
    """The same of the forces of scenes whose implicit steps are solved together (joined_newton.py)."""
    if solver.loose:
        return f"but for contact {solver.loose}, and each scene closes its contact by itself"
    scene = solver.scene
    values = scene.inputs.derive(scene.inputs.at_times([0.0, solver.dt]))
    hosts, u = host_forces(scene).take(values), values.displacement
    free = scene.supports.freedom(scene.mesh.num_vertices)
    hosts.restrict(free, values.rest)
    w = np.einsum("kij,kj->ki", free, np.random.default_rng(0).standard_normal(u.shape))
    own = [type(x).__name__ for x in hosts if not (x.symmetric and _is_matrix(x, u, w))]
    return f"the Hessian of {' and '.join(own)} is no symmetric sparse matrix" if own else None


def _is_matrix(host, u: np.ndarray, w: np.ndarray) -> bool:
    """Whether the product with w is that of the matrix that a host force knows."""
    matrix, product = host.matrix(u), host.product(u, w)
    return matrix is not None and np.allclose(matrix @ w.ravel(), product.ravel(), 1e-9, 1e-9 * np.abs(product).max())


def placed(arrays, name: str, x: np.ndarray) -> np.ndarray:
    """Numbers `name` of a scene, those of tetrahedra in the order of places: by patches, where there are some, whose
    repetitions have no volume."""
    of_all = name == "coefficients" and x.ndim == 1
    if isinstance(arrays.place, slice) or name not in ("elements", "coefficients", "gradients", "volumes") or of_all:
        return x
    rows = x[arrays.order]
    return rows * arrays.alone.reshape(-1, *[1] * (x.ndim - 1)) if name == "volumes" else rows


def growths_placed(arrays, growths: list[np.ndarray | None]) -> np.ndarray:
    """Growths of scenes, (rows, 2, 1 or num_tetrahedra) each, as (scenes, rows, 2 places): beginning and end of a step of
    each tetrahedron in turn. Zeros of one place where none grows over time."""
    if growths[0] is None:
        return np.zeros((len(growths), 1, 2))
    whole = np.stack([np.broadcast_to(x, (*x.shape[:2], arrays.num_tetrahedra)) for x in growths])
    each = whole if isinstance(arrays.place, slice) else whole[..., arrays.order]
    return np.swapaxes(each, 2, 3).reshape(*whole.shape[:2], -1)
