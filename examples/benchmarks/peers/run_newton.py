"""Jobs on the soft bodies of Newton, the library that Warp's own simulator became: its semi-implicit solver, its collision
pipeline and its ground plane, differentiated by Warp's tape as in its example of a soft body. On the CPU.

The plane is a penalty as stiff as the job's barrier, without damping, with friction 0.3; the law is Smith's without the
change of moduli.
"""

import newton
import numpy as np
import warp as wp
from job import answer_all, timed

wp.config.quiet = True


def model_of(job):
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y)
    builder.default_particle_radius = 0.0
    builder.add_soft_mesh(
        pos=wp.vec3(0.0, 0.0, 0.0),
        rot=wp.quat_identity(),
        vel=wp.vec3(0.0, 0.0, 0.0),
        scale=1.0,
        vertices=[wp.vec3(*map(float, x)) for x in job.vertices],
        indices=job.tetrahedra.ravel().tolist(),
        density=float(job.density),
        k_mu=float(job.mu),
        k_lambda=float(job.lam),
        k_damp=0.0,
        tri_ke=0.0,
        tri_ka=0.0,
        tri_kd=0.0,
        add_surface_mesh_edges=False,
    )
    stiffness = float(job.ground[0]) if job.ground.size else 0.0
    contact = dict(ke=stiffness, kd=0.0, kf=100.0, mu=0.3)
    if stiffness:
        builder.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(**contact))
    model = builder.finalize(device="cpu", requires_grad=True)
    for name, value in contact.items():
        setattr(model, f"soft_contact_{name}", value)
    model.set_gravity((0.0, float(job.gravity), 0.0))
    flags = model.particle_flags.numpy()
    flags[job.fixed] &= ~int(newton.ParticleFlags.ACTIVE)
    model.particle_flags = wp.array(flags, device="cpu")
    return model, stiffness


def work(job):
    one, job = len(job.vertices), job.in_one()
    model, stiffness = model_of(job)
    solver = newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False)
    control, steps = model.control(), job.frames * job.substeps
    states = [model.state() for _ in range(steps + 1)]
    pipeline = newton.CollisionPipeline(model, broad_phase="explicit", soft_contact_gap=0.001, requires_grad=True)

    def forward():
        states[0].particle_q.assign(job.start.astype(np.float32))
        states[0].particle_qd.assign(job.velocities.astype(np.float32))
        for now, after in zip(states, states[1:]):
            now.clear_forces()
            contacts = None
            if stiffness:
                contacts = pipeline.contacts()
                pipeline.collide(now, contacts)
            solver.step(now, after, control, contacts, float(job.h))
        return np.stack([state.particle_q.numpy() for state in states[:: job.substeps]])

    def both():
        tape = wp.Tape()
        with tape:
            positions = forward()
        adjoints = job.adjoints(positions).astype(np.float32)
        tape.backward(
            grads={
                states[j * job.substeps].particle_q: wp.array(adjoints[j], dtype=wp.vec3, device="cpu")
                for j in range(1, job.frames + 1)
            }
        )
        by_mu, by_lam = model.tet_materials.grad.numpy().astype(float).sum(0)[:2]
        by_start = states[0].particle_q.grad.numpy().astype(float)
        tape.zero()
        return positions, dict(youngs_modulus=job.by_youngs_modulus(by_mu, by_lam), initial_positions=by_start[:one])

    run = both if job.differentiates else lambda: (forward(), {})
    seconds, (positions, gradients) = timed(run, job.repeats, compiles=job.repeats > 1)
    return seconds, positions[:, :one], gradients


if __name__ == "__main__":
    answer_all(work)
