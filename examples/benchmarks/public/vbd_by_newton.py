"""A job of vbd_beam.py by Newton's solver by vertex block descent, in its environment: python vbd_by_newton.py JOB ANSWER

JOB (.npz): vertices, tetrahedra, mu, lam (of each tetrahedron), density, fixed, gravity, dt, steps, keep_every, damping,
iterations (a list: one run of each). ANSWER (.npz): positions_0, seconds_0 ...: the kept states of a run, and the seconds
that it had taken until then, without compiling.
"""

import json
import sys
import time

import newton
import numpy as np
import warp as wp

wp.config.quiet = True


def model_of(job):
    builder = newton.ModelBuilder()
    builder.add_soft_mesh(
        pos=wp.vec3(0.0, 0.0, 0.0),
        rot=wp.quat_identity(),
        vel=wp.vec3(0.0, 0.0, 0.0),
        scale=1.0,
        vertices=[wp.vec3(*map(float, x)) for x in job["vertices"]],
        indices=job["tetrahedra"].ravel().tolist(),
        density=float(job["density"]),
        k_mu=job["mu"],
        k_lambda=job["lam"],
        k_damp=float(job["damping"]),
        add_surface_mesh_edges=False,
    )
    builder.color()
    model = builder.finalize(device="cpu")
    model.set_gravity((0.0, 0.0, float(job["gravity"])))
    flags = model.particle_flags.numpy()
    flags[job["fixed"]] &= ~int(newton.ParticleFlags.ACTIVE)
    model.particle_flags = wp.array(flags, device="cpu")
    return model


def run(job, iterations: int, steps: int):
    """(kept positions, seconds until each)"""
    model = model_of(job)
    solver = newton.solvers.SolverVBD(
        model, iterations=iterations, particle_enable_self_contact=False, particle_enable_tile_solve=False
    )
    now, after, control, contacts = model.state(), model.state(), model.control(), model.contacts()
    solver.step(now, after, control, contacts, float(job["dt"]))  # compiles
    now, positions, seconds, spent = model.state(), [], [], 0.0
    for step in range(1, steps + 1):
        begin = time.perf_counter()
        now.clear_forces()
        solver.step(now, after, control, contacts, float(job["dt"]))
        spent += time.perf_counter() - begin
        now, after = after, now
        if step % int(job["keep_every"]) == 0:
            positions.append(now.particle_q.numpy().copy())
            seconds.append(spent)
    return np.array(positions), np.array(seconds)


job = dict(np.load(sys.argv[1]))
answer = {}
for k, iterations in enumerate(job["iterations"]):
    answer[f"positions_{k}"], answer[f"seconds_{k}"] = run(job, int(iterations), int(job["steps"]))
np.savez(sys.argv[2], **answer)
print(json.dumps(dict(newton=newton.__version__, warp=wp.config.version)))
