"""How an obstacle acts as the mesh is refined: stiffness per area against the same stiffness at every vertex.

The gap under a cube at rest, the force of one that is pressed down, the way of a slab that slides. The stiffness of a
vertex is what makes it much the same on the mesh with 25 vertices in a face.

    python examples/contact/refinement.py
"""

import numpy as np
from scipy.optimize import brentq

import diffsim_ti as ds
from diffsim_ti.terms.obstacles.barrier import slope_at

SIZE, WIDTH, PER_AREA = 0.2, 0.01, 1e6  # of the bodies [m], of the barriers [m], [N/m^3]
PER_VERTEX = PER_AREA * SIZE**2 / 25  # [N/m]
SPEED, FRICTION = 0.7, 0.3  # of what slides [m/s]: by Coulomb's law it goes v^2 / (2 mu g) = 83.25 mm
RESOLUTIONS = (2, 3, 5, 9)
KINDS = {"stiffness_per_area": PER_AREA, "stiffness": PER_VERTEX}


def block(resolution: int, height: float) -> ds.TetrahedralMesh:
    """A cube whose bottom is at a height [m]."""
    return ds.TetrahedralMesh.create_cube(resolution=resolution, size=SIZE).translated((0, height, 0))


def slab(resolution: int) -> ds.TetrahedralMesh:
    """A quarter as high as it is long, with the same vertices in its bottom as the cube."""
    cells = (resolution, max(2, resolution // 4 + 1), resolution)
    return ds.TetrahedralMesh.create_box(cells, size=(SIZE, SIZE / 4, SIZE))


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


def way_of_sliding(resolution: int, kind: dict, body: ds.TetrahedralMesh | None = None, **options) -> np.ndarray:
    """How far [m] a slab on a floor with friction 0.3 has gone, at every millisecond after it is pushed off at 0.7 m/s.

    Of its centre of mass. The slab is flat, so that friction does not tip it, and lies where the barrier carries it.
    """
    (k,) = kind.values()
    body = slab(resolution) if body is None else body
    height = float(np.ptp(body.vertices[:, 1]))
    on_all = k * (SIZE**2 if "stiffness_per_area" in kind else resolution**2)  # [N/m]
    weight = 1000.0 * SIZE**2 * height * 9.81
    share = brentq(lambda s: -on_all * WIDTH * slope_at(s) - weight, 0.01, 1 - 1e-9)
    floor = ds.Ground(width=WIDTH, friction=FRICTION, friction_speed=1e-3, **kind)
    law, terms = ds.StableNeoHookean(1e6, 0.3), [ds.Gravity(), floor]
    body = body.translated((0, share * WIDTH, 0))
    scene = ds.Scene(body, law, terms=terms, initial_velocities=(SPEED, 0, 0), precision="f64")
    solver = ds.VelocityVerletSolver(scene, dt=1e-4, **options)
    frames = ds.Rollout(solver, 3000, save_every=10).forward()
    mass = scene.inputs.derive(scene.inputs.values).mass
    return (frames.positions - body.vertices)[..., 0] @ (mass / mass.sum())


ROWS = {
    "gap under a cube at rest": (gap_at_rest, 1e3, "mm"),
    "force of a cube that is pressed": (force_of_a_press, 1.0, "N"),
    "way of a slab that slides": (lambda *what: way_of_sliding(*what)[-1], 1e3, "mm"),
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
