"""Throw a soft, spinning block so that its centre hits a target: Taichi kernels and `ti.ad.Tape`, nothing else.

Gradient descent: the first step is the one that would hit without air, where the centre moves as a stone does; the next take
their length from how the gradient changed (Barzilai, Borwein 1988, doi:10.1093/imanum/8.1.141).

    python examples/control/throw_at_target.py [folder for a picture]
"""

import sys
import time
from pathlib import Path

import numpy as np
import taichi as ti

import diffsim_ti as ds
from diffsim_ti.optimization_picture import OptimizationPicture

DURATION, DT = 0.6, 2e-3  # [s]
TARGET = (2.0, 1.2, -0.5)  # [m]
TOLERANCE = 1e-6  # [m]


@ti.kernel
def throw(velocity: ti.template(), spin: ti.types.vector(3, ti.f64), rest: ti.template(), out: ti.template()):
    """Velocity of each vertex: the throw's, and a given spin about the origin."""
    for i in out:
        out[i] = velocity[None] + spin.cross(rest[i])


@ti.kernel
def find_centre(frames: ti.template(), last: ti.i32, centre: ti.template()):
    for i in range(frames.shape[1]):
        centre[None] += frames[last, i] / frames.shape[1]


@ti.kernel
def measure(centre: ti.template(), target: ti.types.vector(3, ti.f64), loss: ti.template()):
    loss[None] = (centre[None] - target).norm_sqr()


def main(picture_folder: str | None = None) -> dict:
    """Returns the miss [m], the velocity [m/s], how often the run was differentiated, and the seconds it took."""
    mesh = ds.TetrahedralMesh.create_box(4, size=0.3, origin=(-0.15, -0.15, -0.15))
    scene = ds.Scene(
        mesh, ds.SmithNeoHookean(2e4, 0.4), density=200.0, terms=[ds.Gravity(), ds.Drag(0.6)], precision="f64"
    )
    rollout = ds.Rollout(ds.SemiImplicitSolver(scene, dt=DT), round(DURATION / DT))

    velocity, centre = (ti.Vector.field(3, ti.f64, (), needs_grad=True) for _ in range(2))
    loss = ti.field(ti.f64, (), needs_grad=True)
    rest = ti.Vector.field(3, ti.f64, mesh.num_vertices)
    rest.from_numpy(mesh.vertices)
    spin, target = ti.Vector([0.0, 3.0, 8.0]), ti.Vector(TARGET)
    velocity[None] = [1.0, 1.0, 0.0]

    start = time.perf_counter()
    v, last = velocity.to_numpy(), None
    picture = OptimizationPicture(mesh, np.array([TARGET]), loss_label="loss [m²]")
    for iteration in range(1, 31):
        centre[None] = [0.0, 0.0, 0.0]
        with ti.ad.Tape(loss):
            throw(velocity, spin, rest, rollout.field("initial_velocities"))
            rollout.run()
            find_centre(rollout.positions, 1, centre)
            measure(centre, target, loss)
        miss = loss[None] ** 0.5
        picture.add(loss[None], {"velocity [m/s]": v}, rollout.positions.to_numpy()[1])
        print(f"iteration {iteration}: misses by {miss:.3g} m")
        if miss < TOLERANCE:
            break
        gradient, step = velocity.grad.to_numpy(), 1 / (2 * DURATION**2)
        if last is not None:
            dv, change = v - last[0], gradient - last[1]
            step = dv.dot(dv) / dv.dot(change)
        last, v = (v, gradient), v - step * gradient
        velocity.from_numpy(v)
    seconds = time.perf_counter() - start

    if picture_folder:
        picture.save(Path(picture_folder) / "throw_at_target.png")
    print(f"throw with {v.round(4)} m/s: off by {miss:.1e} m after {iteration} iterations, {seconds:.1f} s")
    return {"miss": miss, "velocity": v, "iterations": iteration, "seconds": seconds}


if __name__ == "__main__":
    ds.init(precision="f64")
    main(*sys.argv[1:])
