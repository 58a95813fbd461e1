"""Bodies that start in front of obstacles, or in them, nothing moving; a geometric judge says which.

    python tests/battery_of_starts.py --cases 60 --seed 0

Balls, needles, rods, boxes and cylinders before faces, edges and corners of a cube, by random widths, gaps, elements,
precisions and solvers. What does not touch runs on, and stays where it is beyond the width; what is in one is refused.
"""

import argparse

import numpy as np

import diffsim_ti as ds

SOLVERS = ds.VelocityVerletSolver, ds.SemiImplicitSolver, ds.BDF2Solver
KINDS = "sphere", "needle", "rod", "box", "cylinder"
SIZE, SHALLOW = 0.4, 1e-4  # [m]: of the cube, and how deep a start is that may be found after the first step only


def obstacle(kind, at, n, gap, small, **options):
    """Whose nearest point is about `gap` from `at` along n."""
    along = np.cross(n, [1, 0, 0] if abs(n[0]) < 0.9 else [0, 1, 0])
    middle, half = at + n * (gap + small), 0.3 * along / np.linalg.norm(along)
    if kind == "sphere":
        return ds.Sphere(middle, small, **options)
    if kind == "box":
        return ds.Box(middle, (2 * small,) * 3, **options)
    if kind == "needle":
        return ds.Capsule(middle, at + n * (gap + SIZE), small, **options)
    return (ds.Capsule if kind == "rod" else ds.Cylinder)(middle - half, middle + half, small, **options)


def draw(rng):
    """(what it is, arguments of its scene, solver, distance of the surface to the obstacle, width)."""
    kind, cells, order = KINDS[rng.integers(5)], int(rng.integers(2, 5)), int(rng.integers(1, 3))
    mesh = ds.TetrahedralMesh.create_box(cells, SIZE)
    mesh = mesh.quadratic() if order == 2 else mesh
    width, small = 10 ** rng.uniform(-3.5, -1.5), 10 ** rng.uniform(-3.3, -1)
    gap = width * 10 ** rng.uniform(-2, 0.7) * (-1 if rng.random() < 0.15 else 1)
    at, n, axes = rng.uniform(0.02, 0.38, 3), np.zeros(3), rng.permutation(3)[: rng.integers(1, 4)]
    sides = rng.integers(0, 2, len(axes))
    at[axes], n[axes] = SIZE * sides, 2 * sides - 1
    term = obstacle(kind, at, n / np.linalg.norm(n), gap, small, width=width, stiffness_per_area=1e7)
    shares = np.array([[150 - i - j, i, j] for i in range(151) for j in range(151 - i)]) / 150
    points = np.einsum("pa,fai->fpi", shares, mesh.vertices[mesh.surface_triangles]).reshape(-1, 3)
    precision, solver = ("f32", "f64")[rng.integers(2)], SOLVERS[rng.integers(3)]
    said = f"{kind} before {len(axes)} faces, {cells} vertices a side, order {order}, {precision}, {solver.__name__}"
    scene = dict(mesh=mesh, material=ds.StableNeoHookean(1e5, 0.3), terms=[term], fixed="xmin", precision=precision)
    return f"{said}, width {width:.2g}, size {small:.2g}", scene, solver, float(term.distance(points).min()), width


def verdict(scene: dict, solver, distance: float, width: float) -> str:
    """Nothing, or what is wrong."""
    try:
        simulator = ds.Simulator(solver(ds.Scene(**scene), dt=1e-4))
        simulator.run(3)
    except ds.Crossing as error:
        return "" if -SHALLOW < distance <= 0 else f"{distance:.2g} m in front: {error}"
    except ValueError as error:
        return "" if distance < 0.1 * SHALLOW else f"{distance:.2g} m in front: {error}"
    if distance < -1e-6:
        return f"{-distance:.2g} m in the obstacle, and no word"
    moved = distance > 1.4 * width and np.abs(simulator.velocities).max() > 0
    return f"pushed from {distance / width:.2g} widths" if moved else ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    ds.init(precision="f64")
    rng, wrong = np.random.default_rng(options.seed), 0
    for k in range(options.cases):
        said, *case = draw(rng)
        found = verdict(*case)
        wrong += bool(found)
        print(f"{k:4d} {'WRONG ' + found if found else 'right'} ({said}, {case[2]:.2g} m)", flush=True)
    print(f"{wrong} of {options.cases} wrong")
    return int(wrong > 0)


if __name__ == "__main__":
    raise SystemExit(main())
