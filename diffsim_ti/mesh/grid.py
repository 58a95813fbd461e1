"""Boxes cut into tetrahedra on a regular grid."""

from itertools import permutations

import numpy as np

from diffsim_ti.common.checked import numbers, shape_of, shown

# Cell corner (a, b, c) in {0, 1}^3. Kuhn: one tetrahedron per order of walking x, y, z from (0,0,0) to (1,1,1); all
# share that diagonal. Five: a regular tetrahedron on four alternate corners and one at each other corner.
_KUHN = [[tuple(int(axis in walk[:step]) for axis in range(3)) for step in range(4)] for walk in permutations(range(3))]
_FIVE = [
    [(0, 0, 0), (1, 1, 0), (1, 0, 1), (0, 1, 1)],
    [(1, 0, 0), (0, 0, 0), (1, 1, 0), (1, 0, 1)],
    [(0, 1, 0), (0, 0, 0), (1, 1, 0), (0, 1, 1)],
    [(0, 0, 1), (0, 0, 0), (1, 0, 1), (0, 1, 1)],
    [(1, 1, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1)],
]
_FIVE_MIRRORED = [[(1 - a, b, c) for a, b, c in corners] for corners in _FIVE]
PATTERNS = ("kuhn", "five")
MOST = 10**8  # vertices, of which each has some 1 kB of a scene


def _positive(cell: list) -> np.ndarray:
    """Corners (k, 4, 3) with the middle two swapped where the volume would be negative."""
    corners = np.array(cell)
    det = np.linalg.det((corners[:, 1:] - corners[:, :1]).astype(float))
    corners[det < 0] = corners[det < 0][:, [0, 2, 1, 3]]
    return corners


def box(resolution, size, pattern: str, origin) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Vertices, tetrahedra and the six sides of a box; arguments as in `TetrahedralMesh.create_box`."""
    shape = shape_of("resolution", resolution)
    counts = np.broadcast_to(np.asarray(resolution), (3,)) if shape in ((), (1,), (3,)) else np.zeros(3)
    if counts.dtype.kind not in "iu" or counts.min() < 2:
        raise ValueError(f"resolution counts vertices a side, as 1 or 3 integers of at least 2; got {resolution!r}")
    lengths, start = numbers("size", size), numbers("origin", origin)
    for what, given in (("size", lengths), ("origin", start)):
        if given.shape not in ((), (3,)) or not np.all(np.isfinite(given)):
            raise ValueError(f"{what} must be finite [m], as 1 or 3 numbers; got {shown(given)}")
    lengths, start = (np.broadcast_to(given, (3,)) for given in (lengths, start))
    if not np.all(lengths > 0):
        raise ValueError(f"size must be positive and finite [m], as 1 or 3 numbers; got {size!r}")
    if pattern not in PATTERNS:
        raise ValueError(f"pattern must be one of {', '.join(PATTERNS)}; got {pattern!r}")
    nx, ny, nz = (int(n) for n in counts)
    if nx * ny * nz > MOST:
        raise ValueError(f"resolution {resolution!r} makes {nx * ny * nz:.3g} vertices; take at most {MOST:.0e}")
    axes = [o + length * (np.arange(n) / (n - 1)) for o, length, n in zip(start, lengths, (nx, ny, nz))]
    vertices = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    i, j, k = (part.reshape(-1, 1, 1) for part in np.indices((nx - 1, ny - 1, nz - 1)))
    if pattern == "kuhn":
        a, b, c = np.moveaxis(_positive(_KUHN), -1, 0)
    else:
        odd = ((i + j + k) % 2 == 1)[..., None]
        a, b, c = np.moveaxis(np.where(odd, _positive(_FIVE_MIRRORED), _positive(_FIVE)), -1, 0)
    tetrahedra = (((i + a) * ny + (j + b)) * nz + (k + c)).reshape(-1, 4)
    grid = np.arange(nx * ny * nz).reshape(nx, ny, nz)
    sides = {}
    for axis, name in enumerate("xyz"):
        sides[f"{name}min"], sides[f"{name}max"] = (np.take(grid, end, axis).ravel() for end in (0, -1))
    return vertices, tetrahedra, sides
