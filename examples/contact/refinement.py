"""What is felt of an obstacle as the mesh is refined: stiffness per area against the same stiffness at every vertex.

The gap under a cube at rest, the force of one that is pressed down, the way of a sliding cube. The stiffness of a
vertex is what makes it much the same on the mesh with 25 vertices in a face.

    python examples/contact/refinement.py
"""

import numpy as np

import diffsim_ti as ds
from diffsim_ti.terms.obstacles.barrier import slope_at

SIZE, WIDTH, PER_AREA = 0.2, 0.01, 1e6  # of the bodies [m], of the barriers [m], [N/m^3]
PER_VERTEX = PER_AREA * SIZE**2 / 25  # [N/m]
RESOLUTIONS = (2, 3, 5, 9)
KINDS = {"stiffness_per_area": PER_AREA, "stiffness": PER_VERTEX}


def block(resolution: int, height: float) -> ds.TetrahedralMesh:
    """A cube whose bottom is at a height [m]."""
    return ds.TetrahedralMesh.create_cube(resolution=resolution, size=SIZE).translated((0, height, 0))


def gap_at_rest(resolution: int, kind: dict) -> float:
    """The smallest gap [m] under a cube that rests on a floor."""
    terms = [ds.Gravity(), ds.Drag(40.0), ds.Ground(width=WIDTH, **kind)]
    scene = ds.Scene(block(resolution, 0.008), ds.StableNeoHookean(1e6, 0.3), terms=terms, precision="f64")
    simulator = ds.Simulator(ds.ImplicitEulerSolver(scene, dt=0.02))
    simulator.run(50)
    return float(simulator.positions[:, 1].min())


def force_of_a_press(resolution: int, kind: dict) -> float:
    """The force [N] on a floor of a cube whose top is pushed down by 10 mm."""
    body, floor = block(resolution, WIDTH), ds.Ground(width=WIDTH, **kind)
    way = dict(fixed=body.vertices[:, 1] > SIZE, motion=lambda t: [0, -0.01 * t, 0])
    scene = ds.Scene(body, ds.StableNeoHookean(1e5, 0.0), terms=[floor], precision="f64", **way)
    simulator = ds.Simulator(ds.StaticSolver(scene, dt=1.0, load_steps=2))
    simulator.run(1)
    share = np.minimum(floor.gap(simulator.positions) / WIDTH, 1.0)
    (k,) = kind.values()
    on_each = scene.inputs.derive(scene.inputs.values).surface  # [m^2]
    if "stiffness" in kind:
        on_each = on_each > 0
    return float(-(k * on_each * WIDTH * np.array([slope_at(s) for s in share])).sum())


def way_of_sliding(resolution: int, kind: dict) -> float:
    """How far [m] a cube slides that is pushed off at .7 m/s, with friction .3: by Coulomb's law v^2 / (2 mu g)."""
    floor = ds.Ground(width=WIDTH, friction=0.3, friction_speed=1e-3, **kind)
    body, law = block(resolution, 0.0077), ds.StableNeoHookean(1e6, 0.3)
    scene = ds.Scene(body, law, terms=[ds.Gravity(), floor], initial_velocities=(0.7, 0, 0), precision="f64")
    simulator = ds.Simulator(ds.ImplicitEulerSolver(scene, dt=2e-3))
    simulator.run(150)
    return float((simulator.positions - body.vertices)[:, 0].mean())


ROWS = {
    "gap under a cube at rest": (gap_at_rest, 1e3, "mm"),
    "force of a cube that is pressed": (force_of_a_press, 1.0, "N"),
    "way of a cube that slides": (way_of_sliding, 1e3, "mm"),
}


def main() -> dict:
    """{(what, kind): values by mesh}, printed as a table."""
    found = {}
    print("| vertices in a face | " + " | ".join(str(r * r) for r in RESOLUTIONS) + " |")
    print("| --- |" + " ---: |" * len(RESOLUTIONS))
    for what, (measure, scale, unit) in ROWS.items():
        for name, value in KINDS.items():
            numbers = [measure(r, {name: value}) for r in RESOLUTIONS]
            found[what, name] = numbers
            row = " | ".join(f"{scale * x:.4g}" for x in numbers)
            print(f"| {what} [{unit}], `{name}={value:g}` | {row} |", flush=True)
    return found


if __name__ == "__main__":
    ds.init(precision="f64")
    main()
