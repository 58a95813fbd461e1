"""Small bodies that touch obstacles, shared by the tests of contact."""

import numpy as np
from scipy.optimize import brentq

import diffsim_ti as ds

G = 9.81
BASE = np.array([[0, 0, 0], [0.25, 0, 0.45], [0.5, 0, 0]])
APEX = BASE.mean(0) + [0, 0.5, 0]


def tetrahedron(lift: float = 0.0) -> ds.TetrahedralMesh:
    """Three vertices at y = lift, the fourth above their middle."""
    return ds.TetrahedralMesh(np.vstack([BASE, APEX]) + [0, lift, 0], [[0, 1, 2, 3]], fix_orientation=True)


def box_surface(size, origin):
    box = ds.TetrahedralMesh.create_box(2, size=size, origin=origin)
    return box.vertices, box.surface_triangles


def with_options(kind: type, **options) -> type:
    """An explicit solver's class with other defaults."""
    name = kind.__name__ + "".join(f"_{value}" for value in options.values())
    return type(name, (kind,), {"__init__": lambda self, *a, **o: kind.__init__(self, *a, **(options | o))})


EXPLICIT = [ds.SemiImplicitSolver, ds.VelocityVerletSolver]
FORCE = [with_options(kind, contact="force") for kind in EXPLICIT]
KEEPING = [with_options(kind, contact_damping=0.0) for kind in EXPLICIT]
# of the stage's, those of which rest is a state to round-off: drift and push are taken where the solver takes its forces
RESTING = [with_options(kind, contact_damping=c) for kind, c in zip(EXPLICIT, (1.0, 0.0))]


SHAPES = {
    "ground": lambda **o: ds.Ground(0.0, **o),
    "half_space": lambda **o: ds.HalfSpace([0, 0.0, 0], [0.2, 1, 0.1], **o),
    "sphere": lambda **o: ds.Sphere([0.25, -0.8, 0.2], 0.8, **o),
    "bowl": lambda **o: ds.Sphere([0.25, 0.6, 0.2], 0.72, inside=True, **o),
    "capsule": lambda **o: ds.Capsule([-0.3, -0.3, 0.2], [0.6, -0.3, 0.1], 0.3, **o),
    "box": lambda **o: ds.Box([0.2, -0.52, 0.2], [0.5, 1.0, 0.3], [0.1, 0.2, 0.05], **o),
    "cylinder": lambda **o: ds.Cylinder([0.2, -0.6, 0.2], [0.21, -0.02, 0.25], 0.2, **o),
    "mesh": lambda **o: ds.MeshObstacle(*box_surface([0.9, 0.6, 0.8], [-0.1, -0.61, -0.2]), [0.01, 0, 0.02], **o),
}


def slope(s):
    """beta'(s) of the barrier, 1/1000 < s < 1."""
    return -(s - 1) * (2 * np.log(s) + (s - 1) / s)


def resting_gap(force: float, stiffness: float = 1e4, width: float = 0.01) -> float:
    """Where the barrier pushes with this force [N]."""
    return width * brentq(lambda s: -stiffness * width * slope(s) - force, 1e-3, 1 - 1e-12)


def points(mesh, obstacle, mass: float = 1.0, fixed=(3,), terms=(), **options) -> ds.Scene:
    """Vertices of one tetrahedron that do not act on each other, `mass` [kg] each; the apex is held."""
    return ds.Scene(
        mesh,
        ds.LinearElastic(1e-6, 0.0),
        4 * mass / mesh.volume,
        fixed=fixed if isinstance(fixed, dict) else list(fixed),
        terms=[*terms, *np.atleast_1d(obstacle)],
        **options,
    )
