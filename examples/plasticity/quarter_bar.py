"""A quarter of a round bar of ten-node tetrahedra, whose curved elements follow the circle."""

import numpy as np

import diffsim_ti as ds


def quarter_bar(radius: float, length: float, across: int, along: int, finer: float = 1.0, order: int = 2):
    """The quarter x, y >= 0 of a bar from z = 0 to z = length, of `across` cells along its radius and `along` cells along
    its length, which become finer towards z = 0 with `finer` above 1. Sets xmin and ymin: the planes of symmetry; zmin and
    zmax: the ends; edge: of zmin, what lies on the circle."""
    box = ds.TetrahedralMesh.create_box((across + 1, across + 1, along + 1))
    box = box.quadratic() if order == 2 else box
    s, t, z = box.vertices.T
    # a square to a disc, without a kink
    place = np.stack([radius * s * np.sqrt(1 - t**2 / 2), radius * t * np.sqrt(1 - s**2 / 2), length * z**finer], 1)
    sets = {name: box.vertex_indices(name) for name in ("xmin", "ymin", "zmin", "zmax")}
    round_about = np.abs(np.hypot(place[:, 0], place[:, 1]) - radius) < 1e-9 * radius
    sets["edge"] = np.flatnonzero(round_about & (z == 0))
    return ds.TetrahedralMesh(place, box.elements, vertex_sets=sets)
