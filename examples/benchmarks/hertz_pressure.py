"""What a tactile pad reads where a ball presses on it: Hertz's pressure on three meshes.

A quarter of an elastic block, of a side of eight radii of the contact, is pressed by a rigid sphere of radius R. With the
force F on its base, the radius a of the contact and its pressure are, by Hertz (Johnson 1985, Contact Mechanics,
ch. 4, doi:10.1017/CBO9781139171731),

    a^3 = 3 F R / (4 E*),    p = 3 F / (2 pi a^2) (1 - r^2 / a^2)^(1/2),    E* = E / (1 - nu^2)

`TactilePad` reads pressure on a grid, vertices give `ContactTraction`; both are compared where r < 0.8 a, as shares of the
pressure there. Both are means over the faces around a vertex, and so fall short where the pressure is curved, by 3
to 4 (h / a)^2 at 0.8 a for a face of size h: 3 % takes twelve cells in a radius.

    python examples/benchmarks/hertz_pressure.py [cells in a radius ...]
"""

import sys
import time
import warnings

import numpy as np

import diffsim_ti as ds

RADIUS, DEPTH, E, NU = 50e-3, 0.5e-3, 1e6, 0.3
EXPECTED = (RADIUS * DEPTH) ** 0.5  # of the contact [m]


def graded(cells: int, fine: float, ratio: float = 1.35) -> np.ndarray:
    """Places from 0 to about 8 radii: even ones to `fine` radii, `cells` in each, and then farther and farther apart."""
    places = list(np.arange(0, fine + 1e-9, 1 / cells))
    while places[-1] < 8:
        places.append(places[-1] + ratio * (places[-1] - places[-2] if len(places) > 1 else 1 / cells / ratio))
    return EXPECTED * np.array(places)


def block(cells: int) -> ds.TetrahedralMesh:
    """x, z >= 0 and y <= 0; a set "pad" of the top where the sphere is."""
    x, y = graded(cells, 1.3), graded(cells, 0.5)
    box = ds.TetrahedralMesh.create_box((len(x), len(y), len(x)), (1, 1, 1), "five")
    at = np.rint(box.vertices * [len(x) - 1, len(y) - 1, len(x) - 1]).astype(int)
    places = np.stack([x[at[:, 0]], -y[::-1][at[:, 1]], x[at[:, 2]]], 1)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*slivers")  # of the flat cells beside the contact
        mesh = ds.TetrahedralMesh(places, box.tetrahedra, vertex_sets=box.vertex_sets)
    corners = mesh.vertices[mesh.surface_triangles]
    pad = (corners[:, :, 1] > -1e-9).all(1) & (corners[:, :, [0, 2]].max((1, 2)) < 1.3 * EXPECTED)
    return mesh.with_surface_set("pad", pad)


def press(cells: int, share: float = 0.8) -> dict:
    """Largest errors of both readings within a share of a, and of the resultant against the base's reaction."""
    start, mesh, width = time.process_time(), block(cells), 0.02 * DEPTH
    ball = ds.Sphere(
        (0, RADIUS + width, 0), RADIUS, stiffness_per_area=1e5 / width, width=width, path=lambda t: [0, -DEPTH * t, 0]
    )
    fixed = {"ymin": "xyz", "xmin": "x", "zmin": "z"}
    scene = ds.Scene(mesh, ds.LinearElastic(E, NU), terms=[ball], fixed=fixed, precision="f64")
    pad, traction = ds.TactilePad(ball, "pad", (24, 24)), ds.ContactTraction(ball)
    outputs = [pad, traction, ds.ContactForce(ball), ds.Reaction("ymin")]
    solver = ds.StaticSolver(scene, load_steps=4, tolerance=1e-9)
    rollout = ds.Rollout(solver, 1, save_every=1, outputs=outputs, gradients=[])
    frames = rollout.forward()
    force = -4 * frames["contact_force"][-1, 1]
    a = (0.75 * force * RADIUS * (1 - NU**2) / E) ** (1 / 3)
    peak = 1.5 * force / (np.pi * a**2)

    def errors(pressure, r):
        own = r < share * a
        return float(np.abs(pressure[own] / (peak * np.sqrt(1 - (r[own] / a) ** 2)) - 1).max())

    top = mesh.vertices[:, 1] > -1e-9
    places = rollout.outputs["tactile_pad"].places
    of_grid = errors(frames["tactile_pad"][-1, ..., 0], np.hypot(places[..., 0], places[..., 2]))
    at_vertices = errors(-frames["contact_traction"][-1, top, 1], np.hypot(*mesh.vertices[top][:, [0, 2]].T))
    reaction = float(abs(frames["reaction"][-1, 1] * 4 / force - 1))
    seconds = time.process_time() - start
    return dict(
        cells=cells, tetrahedra=mesh.num_tetrahedra, force=force, radius=a / EXPECTED, pad=of_grid, vertices=at_vertices,
        resultant=reaction, seconds=seconds,
    )  # fmt: skip


def main(cells=(12, 14, 16)) -> list[dict]:
    ds.init(precision="f64")
    print(" cells  tetrahedra  force [N]  a / Hertz     pad  vertices  resultant     s")
    found = []
    for count in cells:
        found.append(row := press(count))
        print(
            f"{count:6}{row['tetrahedra']:12}{row['force']:11.3f}{row['radius']:11.3f}{100 * row['pad']:7.1f}%"
            f"{100 * row['vertices']:9.1f}%{row['resultant']:11.0e}{row['seconds']:6.0f}",
            flush=True,
        )
    return found


if __name__ == "__main__":
    main([int(x) for x in sys.argv[1:]] or (12, 14, 16))
