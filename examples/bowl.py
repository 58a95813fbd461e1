"""Twenty soft blocks fall into a bowl: contact of all bodies with each other, and what it costs.

The same fall is run with and without self-contact (without it the blocks fall through each other), and the time of a substep
is compared. A frame that is refused, because surfaces might cross or the step is unstable, is run again with half the substep.

    python examples/bowl.py [--quick] [--cells 10] [--frames 40]
"""

import argparse
import time

import numpy as np

import diffsim_ti as ds

SIDE, RADIUS, FRAME, SUBSTEPS = 0.1, 0.5, 0.01, 100  # of a block and of the bowl [m]; of a frame [s]
PLACES = [(x, y, z) for y in (-0.26, -0.075, 0.11) for x in (-0.18, 0.0, 0.18) for z in (-0.18, 0.0, 0.18)]


def make_blocks(count: int, cells: int) -> ds.TetrahedralMesh:
    """`count` cubes in three layers, each turned at random."""
    block = ds.TetrahedralMesh.create_cube(cells + 1, SIDE).translated(-0.5 * SIDE * np.ones(3))
    order = np.argsort([10 * y + np.hypot(x, z) for x, y, z in PLACES])
    rng = np.random.default_rng(0)
    return ds.TetrahedralMesh.joined(
        block.rotated(rng.normal(size=3), rng.uniform(0, np.pi)).translated(PLACES[k]) for k in order[:count]
    )


def fall(mesh, cells: int, frames: int, contact: bool) -> dict:
    """Seconds per substep of the fall, overall and in its last quarter, and how near surfaces came."""
    width = 0.3 * SIDE / cells
    terms = [ds.Gravity(), ds.Drag(1.0), ds.Sphere(radius=RADIUS, inside=True, stiffness=400.0, width=2 * width)]
    if contact:
        terms.append(ds.SelfContact(stiffness=400.0, width=width))
    start = np.tile([0.0, -0.5, 0.0], (mesh.num_vertices, 1))
    scene = ds.Scene(mesh, ds.StableNeoHookean(3e4, 0.3), density=1000.0, terms=terms, initial_velocities=start,
                     precision="f32")  # fmt: skip
    simulator = ds.Simulator(ds.SemiImplicitSolver(scene, dt=FRAME, substeps=SUBSTEPS))
    simulator.step()  # compiles
    simulator.reset()
    costs, gap, substeps = [], np.inf, SUBSTEPS
    for frame in range(frames):
        done = False
        while not done:
            begin = time.perf_counter()
            simulator.set_substeps(substeps)
            try:
                simulator.step()
                done = True
            except FloatingPointError as error:
                substeps *= 2
                if substeps > 64 * SUBSTEPS:
                    raise
                print(f"frame {frame + 1} again with {substeps} substeps: {error}")
        costs.append((time.perf_counter() - begin) / substeps)
        substeps = max(SUBSTEPS, substeps // 2)
        said = f"frame {frame + 1}: {1e3 * costs[-1]:.2f} ms a substep"
        if contact:
            gap = min(gap, simulator.smallest_gap())
            said += f", {simulator.workspace.pairs.list.count} pairs, smallest gap so far {1e3 * gap:.3g} mm"
        print(said, flush=True)
    if contact:
        simulator.check_surfaces()
    radius = float(np.linalg.norm(simulator.positions, axis=1).max())
    return {"per_substep": np.mean(costs), "late": np.mean(costs[3 * frames // 4 :]), "gap": gap, "radius": radius}


def main(count: int = 20, cells: int = 10, frames: int = 40) -> dict:
    """Returns what `fall` does with contact, and `ratio`, `late_ratio`: costs of a substep with and without."""
    mesh = make_blocks(count, cells)
    print(f"{count} blocks, {mesh.num_tetrahedra} tetrahedra, {len(mesh.surface_triangles)} surface triangles")
    touching, free = (fall(mesh, cells, frames, contact) for contact in (True, False))
    out = touching | {"ratio": touching["per_substep"] / free["per_substep"], "late_ratio": touching["late"] / free["late"]}
    print(f"no surface passed through another, smallest gap {1e3 * out['gap']:.3g} mm; a substep costs {out['ratio']:.2f} "
          f"times that without contact ({out['late_ratio']:.2f} in the last quarter)")  # fmt: skip
    return out


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="four coarse blocks, a short fall")
    parser.add_argument("--cells", type=int, default=10, help="cells along an edge of a block")
    parser.add_argument("--frames", type=int, default=40, help="frames of 0.01 s")
    parser.add_argument("--arch", default="cpu")
    options = parser.parse_args()
    ds.init(options.arch)
    main(4, 3, 24) if options.quick else main(20, options.cells, options.frames)
