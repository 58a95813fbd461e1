"""Patches of at most eight neighbouring tetrahedra, over which the change of volume is averaged."""

from weakref import WeakKeyDictionary

import numpy as np

from diffsim_ti.mesh.sets import components

SIZE = 8
_known = WeakKeyDictionary()  # meshes do not change


def volume_patches(mesh) -> np.ndarray:
    """Patch of each tetrahedron, numbered from 0, shape (num_tetrahedra,); found once for a mesh.

    Centroids are bisected across the longest extent until at most eight are left, so that patches are compact. A patch
    hangs together (its tetrahedra share vertices), and never mixes members of a tetrahedron set with others. A tetrahedron
    of ten nodes is a patch by itself.
    """
    if mesh.order == 2:
        return np.arange(mesh.num_tetrahedra)
    if mesh not in _known:
        _known[mesh] = _find_patches(mesh)
    return _known[mesh]


def _find_patches(mesh) -> np.ndarray:
    tets, centroids = mesh.tetrahedra, mesh.vertices[mesh.tetrahedra].mean(1)
    kinds = np.zeros((mesh.num_tetrahedra, len(mesh.tetrahedron_sets)), bool)
    for k, members in enumerate(mesh.tetrahedron_sets.values()):
        kinds[members, k] = True
    _, regions = np.unique(kinds, axis=0, return_inverse=True)
    regions = _pieces(regions.ravel(), tets)
    waiting = np.split(np.argsort(regions, kind="stable"), np.cumsum(np.bincount(regions))[:-1])
    patches, count = np.empty(mesh.num_tetrahedra, np.int64), 0
    while waiting:
        group = waiting.pop()
        if len(group) <= SIZE:
            patches[group] = count
            count += 1
            continue
        where = centroids[group]
        axis = np.argmax(np.ptp(where, axis=0))
        half = min(SIZE * max(1, round(len(group) / (2 * SIZE))), len(group) - 1)
        by_place = group[np.argsort(where[:, axis], kind="stable")]
        waiting += [by_place[:half], by_place[half:]]
    return _pieces(patches, tets)


def _pieces(labels: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """Labels again, so that tetrahedra of one label hang together by shared vertices."""
    m = len(tets)
    corners, place = np.unique(labels[:, None] * (tets.max() + 1) + tets, return_inverse=True)
    label = components(np.repeat(np.arange(m), 4), m + place.ravel(), m + len(corners))
    return np.unique(label[:m], return_inverse=True)[1]


def in_eights(patches: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(order, place): patch p fills rows 8 p .. 8 p + 7 with its tetrahedra `order`, and repeats its first in rows left
    over; tetrahedron e stands in row place[e]."""
    by_patch, sizes = np.argsort(patches, kind="stable"), np.bincount(patches)
    first = np.cumsum(sizes) - sizes
    rank = np.empty(len(patches), np.int64)
    rank[by_patch] = np.arange(len(patches)) - np.repeat(first, sizes)
    place = SIZE * patches + rank
    order = np.repeat(by_patch[first], SIZE)
    order[place] = np.arange(len(patches))
    return order, place
