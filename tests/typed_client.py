"""A client of the public interface that mypy and basedpyright check in CI: `mypy --strict tests/typed_client.py`."""

import numpy as np
from typing_extensions import assert_type

import diffsim_ti as ds


def fall() -> float:
    """The height of a cube after a fall, and what one reads off on the way."""
    ds.init(precision="f64", threads=2)
    mesh = ds.TetrahedralMesh.create_cube(resolution=3, size=0.5)
    assert_type(mesh.num_vertices, int)
    assert_type(mesh.vertices, np.ndarray)
    material = ds.StableNeoHookean(youngs_modulus=1e5, poissons_ratio=0.3)
    terms = [ds.Gravity(), ds.Drag(1.0), ds.Ground(height=-0.1)]
    scene = ds.Scene(mesh, material, density=1e3, terms=terms, fixed="xmin", precision="f64")
    limit: float = ds.stable_dt(scene)
    solver = ds.VelocityVerletSolver(scene, dt=0.01, substeps=max(1, round(0.02 / limit)))
    simulator = ds.Simulator(solver)
    simulator.step()
    simulator.run(2)
    simulator.set_state(positions=mesh.vertices, velocities=np.zeros((mesh.num_vertices, 3)))
    energy = simulator.compute_energy()
    parts: dict[str, float] = energy.parts
    rollout = ds.Rollout(solver, steps=4, save_every=2, outputs=[ds.Stress(), ds.Reaction("xmin")], gradients="all")
    frames = rollout.forward(youngs_modulus=1.1e5)
    assert_type(frames, ds.Frames)
    gradients = rollout.vjp(frames, positions=np.ones(frames.positions.shape))
    number: np.ndarray = gradients["youngs_modulus"]
    report = ds.check_gradients(rollout)
    passed: bool = report.passed
    found = ds.modes(scene, 3)
    assert_type(found, ds.Modes)
    try:
        ds.Rollout(ds.BDF2Solver(scene, dt=0.01, tolerance=1e-6), 2).forward()
    except (ds.Divergence, ds.NotConverged) as error:
        print(str(error))
    return float(simulator.positions[:, 1].mean()) + sum(parts.values()) + float(number.sum()) + passed


if __name__ == "__main__":
    print(fall())
