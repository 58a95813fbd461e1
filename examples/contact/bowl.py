"""Twenty soft blocks fall into a bowl: contact of all bodies with each other, and what it costs.

The same fall is run with and without self-contact (without it the blocks fall through each other), frame by frame, and the
time of a substep is compared. A frame that is refused, because surfaces might cross or the step is unstable, is run again
with half the substep.

    python examples/contact/bowl.py [--quick] [--cells 10] [--frames 40] [--film output/bowl.gif]
"""

import argparse
import time

import numpy as np

import diffsim_ti as ds
from diffsim_ti.film import save_film
from diffsim_ti.obstacles import bowl

SIDE, RADIUS, FRAME, SUBSTEPS = 0.1, 0.5, 0.01, 180  # of a block and of the bowl [m]; of a frame [s]
PLACES = [(x, y, z) for y in (-0.26, -0.075, 0.11) for x in (-0.18, 0.0, 0.18) for z in (-0.18, 0.0, 0.18)]


def make_blocks(count: int, cells: int) -> ds.TetrahedralMesh:
    """`count` cubes in three layers, each turned at random."""
    block = ds.TetrahedralMesh.create_cube(cells + 1, SIDE).translated(-0.5 * SIDE * np.ones(3))
    order = np.argsort([10 * y + np.hypot(x, z) for x, y, z in PLACES])
    rng = np.random.default_rng(0)
    return ds.TetrahedralMesh.joined(
        block.rotated(rng.normal(size=3), rng.uniform(0, np.pi)).translated(PLACES[k]) for k in order[:count]
    )


def make_fall(mesh, cells: int, contact: bool) -> ds.Simulator:
    """The blocks above the bowl, moving downwards."""
    width = 0.3 * SIDE / cells
    terms = [ds.Gravity(), ds.Drag(1.0), ds.Sphere(radius=RADIUS, inside=True, stiffness=400.0, width=2 * width)]
    if contact:
        terms.append(ds.SelfContact(stiffness=400.0, width=width))
    start = np.tile([0.0, -0.5, 0.0], (mesh.num_vertices, 1))
    scene = ds.Scene(
        mesh, ds.StableNeoHookean(1e5, 0.3), density=1000.0, terms=terms, initial_velocities=start, precision="f32"
    )
    simulator = ds.Simulator(ds.SemiImplicitSolver(scene, dt=FRAME, substeps=SUBSTEPS))
    simulator.step()  # compiles
    simulator.reset()
    return simulator


def advance(simulator: ds.Simulator) -> float:
    """One frame, with as many substeps as it takes; returns the seconds of a substep."""
    substeps = max(SUBSTEPS, simulator.solver.substeps // 2)
    while True:
        simulator.set_substeps(substeps)
        begin = time.perf_counter()
        try:
            simulator.step()
            return (time.perf_counter() - begin) / substeps
        except FloatingPointError as error:
            substeps *= 2
            if substeps > 64 * SUBSTEPS:
                raise
            print(f"again with {substeps} substeps: {error}")


def main(count: int = 20, cells: int = 10, frames: int = 40, film: str | None = None) -> dict:
    """Returns the smallest gap and the largest distance from the bowl's centre [m], and what a substep costs with contact
    relative to one without, in the whole fall (`ratio`) and in its last quarter (`late_ratio`)."""
    mesh = make_blocks(count, cells)
    print(f"{count} blocks, {mesh.num_tetrahedra} tetrahedra, {len(mesh.surface_triangles)} surface triangles")
    simulator, free = (make_fall(mesh, cells, contact) for contact in (True, False))
    costs, gap, places = [], np.inf, [simulator.positions]
    for frame in range(frames):
        costs.append((advance(simulator), advance(free)))
        gap = min(gap, simulator.smallest_gap())
        if film and frame % 2:
            places.append(simulator.positions)
        touching, alone = (1e3 * cost for cost in costs[-1])
        print(
            f"frame {frame + 1}: a substep takes {touching:.2f} ms, without contact {alone:.2f} ms; smallest gap so far "
            f"{1e3 * gap:.3g} mm",
            flush=True,
        )
    simulator.check_surfaces()
    if film:
        colours = np.tile(np.repeat(np.arange(count), mesh.num_vertices // count), (len(places), 1))
        save_film(
            film,
            mesh,
            places,
            colours,
            12.5,
            (400, 300),
            elevation=35,
            obstacles=[[bowl(np.zeros(3), RADIUS)]] * len(places),
            box=[[-0.4, -0.45, -0.4], [0.4, 0.0, 0.4]],
            title=lambda k: f"{count} soft blocks, t = {2 * FRAME * k:.2f} s",
        )
    costs, late = np.sum(costs, 0), np.sum(costs[3 * frames // 4 :], 0)
    out = {
        "gap": gap,
        "radius": float(np.linalg.norm(simulator.positions, axis=1).max()),
        "ratio": costs[0] / costs[1],
        "late_ratio": late[0] / late[1],
    }
    print(
        f"no surface passed through another, smallest gap {1e3 * gap:.3g} mm; a substep costs {out['ratio']:.2f} times "
        f"that without contact ({out['late_ratio']:.2f} in the last quarter)"
    )
    return out


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="four coarse blocks, a short fall")
    parser.add_argument("--cells", type=int, default=10, help="cells along an edge of a block")
    parser.add_argument("--frames", type=int, default=40, help="frames of 0.01 s")
    parser.add_argument("--arch", default="cpu")
    parser.add_argument("--film", help="where a film of the fall goes, four times slower than it is: .gif or .mp4")
    options = parser.parse_args()
    ds.init(options.arch)
    main(4, 3, 24, options.film) if options.quick else main(20, options.cells, options.frames, options.film)
