"""Makes the meshes of assets/tetmesh/ with Gmsh: `pip install gmsh`, then `python assets/make_meshes.py`.

Lengths in metres, y up, every body stands on y = 0. The shapes are our own. The same versions of Gmsh give the same
files; those in the repository come from Gmsh 4.15.2. Name a mesh to make only that one.

    bunny0.msh          sitting rabbit, 0.25 m tall, looking along +x; vertex sets feet, ears
    beam.msh            1 x 0.2 x 0.2 m beam along x; vertex sets clamped (x = 0), tip (x = 1)
    gripper_finger.msh  fin-ray finger, 0.12 m tall; vertex sets base (y = 0), pad (the contact face x = 0)
    lattice.msh         struts on a 2 x 3 x 2 grid of 10 mm cells, 3.4 mm thick below, 1.7 mm above; sets bottom, top
"""

import sys
from pathlib import Path

import gmsh
import numpy as np

from diffsim_ti import TetrahedralMesh

HERE = Path(__file__).parent / "tetmesh"


def start(size: float) -> None:
    """An empty Gmsh model with one target edge length [m], on one thread so that runs repeat."""
    gmsh.initialize(["", "-v", "2"])
    gmsh.option.setNumber("General.NumThreads", 1)
    gmsh.option.setNumber("Mesh.MeshSizeMin", 0.5 * size)
    gmsh.option.setNumber("Mesh.MeshSizeMax", size)
    gmsh.option.setNumber("Mesh.MshFileVersion", 2.2)
    gmsh.option.setNumber("Mesh.Binary", 1)


def fill(optimize: bool = True) -> None:
    """Tetrahedra inside of the model's surfaces."""
    gmsh.model.mesh.generate(3)
    if optimize:
        gmsh.model.mesh.optimize("Netgen")
        gmsh.model.mesh.optimize("")
    gmsh.model.mesh.renumberNodes()


def group(name: str, low, high) -> None:
    """A named physical group of the surfaces that lie within the box from low to high."""
    faces = [tag for _, tag in gmsh.model.getEntitiesInBoundingBox(*low, *high, dim=2)]
    gmsh.model.addPhysicalGroup(2, faces, name=name)


def finish(name: str) -> None:
    """Write the volume and the named groups."""
    gmsh.model.addPhysicalGroup(3, [tag for _, tag in gmsh.model.getEntities(3)])
    gmsh.write(str(HERE / name))
    gmsh.finalize()


def beam() -> None:
    start(0.06)
    gmsh.model.occ.addBox(0, 0, 0, 1, 0.2, 0.2)
    gmsh.model.occ.synchronize()
    group("clamped", (-1e-3, -1, -1), (1e-3, 1, 1))
    group("tip", (1 - 1e-3, -1, -1), (1 + 1e-3, 1, 1))
    fill()
    finish("beam.msh")


def gripper_finger() -> None:
    """A triangle standing on its base with slanted ribs between its two walls, extruded along z."""
    height, foot, tip, wall, depth, ribs = 0.12, 0.045, 0.010, 0.0035, 0.020, 5
    start(0.0035)
    occ = gmsh.model.occ

    def back(y):  # the slanted wall's outer face
        return foot + (tip - foot) * y / height

    def prism(corners):
        points = [occ.addPoint(x, y, 0) for x, y in corners]
        lines = [occ.addLine(points[k - 1], points[k]) for k in range(len(points))]
        face = occ.addPlaneSurface([occ.addCurveLoop(lines)])
        return [e for e in occ.extrude([(2, face)], 0, 0, depth) if e[0] == 3]

    body = prism([(0, 0), (foot, 0), (tip, height), (0, height)])
    levels = np.linspace(0.008, height - 0.012, ribs + 1)
    slant = 0.006  # ribs rise towards the pad
    holes = []
    for low, high in zip(levels, levels[1:] - 0.0030, strict=False):
        inner = (wall, low + slant), (back(low) - wall, low), (back(high) - wall, high), (wall, high + slant)
        holes += prism(inner)
    occ.cut(body, holes)
    occ.synchronize()
    group("base", (-1, -1e-6, -1), (1, 1e-6, 1))
    group("pad", (-1e-6, -1, -1), (1e-6, 1, 1))
    fill()
    finish("gripper_finger.msh")


def lattice() -> None:
    """Square struts along the edges of a grid, flush at cubic nodes; vertical ones taper between the layers."""
    cell, counts = 0.010, (3, 4, 3)
    thickness = np.linspace(0.0034, 0.0017, counts[1])
    start(0.0019)
    occ = gmsh.model.occ
    height = cell * np.arange(counts[1]) + thickness[0] / 2  # of the layers' middle planes

    def block(x, y, z, dx, dy, dz):
        return 3, occ.addBox(x - dx / 2, y - dy / 2, z - dz / 2, dx, dy, dz)

    def square(x, y, z, t):
        corners = [occ.addPoint(x + a * t / 2, y, z + b * t / 2) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        return occ.addWire([occ.addLine(corners[k - 1], corners[k]) for k in range(4)])

    parts = []
    width, depth = cell * (counts[0] - 1), cell * (counts[2] - 1)
    for y, t in zip(height, thickness, strict=True):
        parts += [block(width / 2, y, cell * k, width + t, t, t) for k in range(counts[2])]
        parts += [block(cell * i, y, depth / 2, t, t, depth + t) for i in range(counts[0])]
    for j in range(counts[1] - 1):
        ends = [(height[j] + thickness[j] / 2, thickness[j]), (height[j + 1] - thickness[j + 1] / 2, thickness[j + 1])]
        for i in range(counts[0]):
            for k in range(counts[2]):
                wires = [square(cell * i, y, cell * k, t) for y, t in ends]
                parts += occ.addThruSections(wires, makeSolid=True, makeRuled=True)
    occ.fuse(parts[:1], parts[1:])
    occ.synchronize()
    top = height[-1] + thickness[-1] / 2
    group("bottom", (-1, -1e-6, -1), (1, 1e-6, 1))
    group("top", (-1, top - 1e-6, -1), (1, top + 1e-6, 1))
    fill()
    finish("lattice.msh")


# Parts of the bunny in units of its height: centre, radii, tilt about z and about x [degrees]. z > 0 ones are mirrored.
BODY = [
    ((-0.06, 0.30, 0), (0.29, 0.27, 0.22), 0, 0),  # trunk
    ((0.13, 0.33, 0), (0.17, 0.24, 0.16), 0, 0),  # chest
    ((0.24, 0.60, 0), (0.17, 0.145, 0.135), 0, 0),  # head
    ((0.365, 0.565, 0), (0.085, 0.07, 0.075), 0, 0),  # muzzle
    ((-0.355, 0.19, 0), (0.10, 0.095, 0.095), 0, 0),  # tail
    ((-0.10, 0.20, 0.17), (0.20, 0.19, 0.10), 0, 0),  # haunch
    ((0.02, 0.05, 0.19), (0.18, 0.055, 0.07), 0, 0),  # hind foot
    ((0.21, 0.19, 0.085), (0.065, 0.20, 0.06), 0, 0),  # foreleg
    ((0.27, 0.045, 0.095), (0.095, 0.05, 0.06), 0, 0),  # forepaw
    ((0.30, 0.60, 0.085), (0.075, 0.06, 0.06), 0, 0),  # cheek
]
EARS = [((0.10, 0.85, 0.092), (0.055, 0.21, 0.075), 16, 12)]
BLEND = 0.05  # radius of the fillets


def ellipsoid(p: np.ndarray, centre, radii, about_z: float, about_x: float) -> np.ndarray:
    """Nearly the distance to an ellipsoid, negative inside."""
    a, b = np.radians([about_z, about_x])
    Z = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    X = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    q = (p - centre) @ (X @ Z)
    k0, k1 = np.linalg.norm(q / radii, axis=-1), np.linalg.norm(q / np.square(radii), axis=-1)
    return k0 * (k0 - 1) / np.maximum(k1, 1e-9)


def smooth_union(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """min(a, b) with a fillet where they meet."""
    h = np.maximum(BLEND - np.abs(a - b), 0) / BLEND
    return np.minimum(a, b) - h**2 * BLEND / 4


def distance(p: np.ndarray, parts) -> np.ndarray:
    """Signed distance to the parts, mirrored at z = 0, with fillets."""
    folded = p * [1, 1, 0] + np.abs(p) * [0, 0, 1]
    out = ellipsoid(folded, *parts[0])
    for part in parts[1:]:
        out = smooth_union(out, ellipsoid(folded, *part))
    return out


def gradient(p: np.ndarray, parts, step: float = 1e-5) -> np.ndarray:
    return np.stack([distance(p + d, parts) - distance(p - d, parts) for d in step * np.eye(3)], -1) / (2 * step)


def surface_net(parts, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Even triangles of edge about `size` on distance = 0: one vertex per grid cell that the surface crosses, one quad
    per grid edge that it crosses; then vertices move to their neighbours' mean and back onto the surface, in turns."""
    axes = [size * np.arange(low // size, high // size + 1) for low, high in ((-0.6, 0.6), (-0.2, 1.2), (-0.4, 0.4))]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    inside = distance(grid, parts) < 0
    cell = np.arange(inside.size).reshape(inside.shape)
    quads = []
    for axis in range(3):
        crossed = np.argwhere(np.diff(inside, axis=axis))  # the grid edge from here along the axis
        u, v = np.eye(3, dtype=int)[(axis + 1) % 3], np.eye(3, dtype=int)[(axis + 2) % 3]
        around = np.stack([cell[tuple((crossed - d).T)] for d in (0 * u, u, u + v, v)], 1)
        leaving = inside[tuple(crossed.T)]
        quads.append(np.where(leaving[:, None], around, around[:, ::-1]))
    used, quads = np.unique(np.concatenate(quads), return_inverse=True)
    quads = quads.reshape(-1, 4)
    points = grid.reshape(-1, 3)[used] + size / 2
    links = np.unique(np.sort(np.concatenate([quads[:, [k, (k + 1) % 4]] for k in range(4)]), 1), axis=0)
    links = np.concatenate([links, links[:, ::-1]])
    for turn in range(30):
        if turn > 0:
            mean = np.stack([np.bincount(links[:, 0], points[links[:, 1], k]) for k in range(3)], 1)
            points = 0.5 * (points + mean / np.bincount(links[:, 0])[:, None])
        for _ in range(3):
            g = gradient(points, parts)
            points = points - (distance(points, parts) / np.maximum((g**2).sum(1), 0.25))[:, None] * g
    diagonals = [np.linalg.norm(points[quads[:, k]] - points[quads[:, k + 2]], axis=1) for k in (0, 1)]
    split = np.where((diagonals[0] <= diagonals[1])[:, None], quads, np.roll(quads, -1, 1))
    return points, np.concatenate([split[:, [0, 1, 2]], split[:, [0, 2, 3]]])


def bunny(height: float = 0.25, size: float = 0.042) -> None:
    """The parts' smooth union, filled by Gmsh; `size` is in units of the height (some others make its paws touch)."""
    points, triangles = surface_net(BODY + EARS, size)
    start(2 * size)
    surface = gmsh.model.addDiscreteEntity(2)
    gmsh.model.mesh.addNodes(2, surface, np.arange(len(points)) + 1, points.ravel())
    gmsh.model.mesh.addElementsByType(surface, 2, [], triangles.ravel() + 1)
    gmsh.model.geo.addVolume([gmsh.model.geo.addSurfaceLoop([surface])])
    gmsh.model.geo.synchronize()
    fill()
    nodes, coordinates, _ = gmsh.model.mesh.getNodes()
    row = np.zeros(int(nodes.max()) + 1, np.int64)
    row[nodes] = np.arange(len(nodes))
    tetrahedra = row[gmsh.model.mesh.getElementsByType(4)[1]].reshape(-1, 4)
    gmsh.finalize()
    points = coordinates.reshape(-1, 3)
    ears = (distance(points, EARS) < 0.005) & (points[:, 1] > 0.75)
    points[:, 1] -= points[:, 1].min()
    points *= height / points[:, 1].max()
    feet = points[:, 1] < 0.06 * height
    mesh = TetrahedralMesh(points, tetrahedra, vertex_sets={"feet": feet, "ears": ears})
    mesh.save(HERE / "bunny0.msh")


if __name__ == "__main__":
    HERE.mkdir(exist_ok=True)
    for make in (bunny, beam, gripper_finger, lattice):
        if len(sys.argv) == 1 or make.__name__ in sys.argv[1:]:
            make()
    for file in sorted(HERE.glob("*.msh")):
        print(f"{file.name}, {file.stat().st_size / 1000:.0f} kB\n{TetrahedralMesh.from_file(file).describe()}\n")
