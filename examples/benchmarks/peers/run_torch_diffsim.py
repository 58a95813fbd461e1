"""Jobs on torch-diffsim's own classes: its plain simulator, or for gradients and floors its differentiable one.

Its floor y = 0 cannot be switched off: without a floor in the job the body is lifted above it. Its differentiable floor is
a cubic penalty; with a floor in the job that one is made as deep as the job's barrier is at nine tenths of the width.
"""

import math

import numpy as np
import torch
from diffsim import (
    DifferentiableMaterial,
    DifferentiableSimulator,
    DifferentiableSolver,
    SemiImplicitSolver,
    Simulator,
    StableNeoHookean,
    TetrahedralMesh,
)
from diffsim.diff_physics import DifferentiableBarrierContact
from job import answer_all, timed

GRAPH_LIMIT = 3e6  # tetrahedra x substeps whose graph fits the memory; beyond, its checkpointed rollout is asked
CHUNK = 10  # substeps between checkpoints


def simulator_of(job):
    """(simulator, lift): the body above the floor, at its start."""
    lift = np.zeros(3) if job.ground.size else np.array([0.0, 1.0 - job.vertices[:, 1].min(), 0.0])
    mesh = TetrahedralMesh(job.vertices + lift, job.tetrahedra)
    chunk = math.gcd(job.substeps, CHUNK) if checkpointed(job) else job.substeps
    options = dict(dt=chunk * job.h, gravity=job.gravity, damping=job.keep, substeps=chunk)
    if job.differentiates or job.ground.size:
        simulator = DifferentiableSimulator(
            mesh,
            DifferentiableMaterial(float(job.E), float(job.nu)),
            DifferentiableSolver(**options),
            density=job.density,
        )
        if job.ground.size:
            stiffness, width = job.ground
            energy = -0.81 * stiffness * width**2 * math.log(0.1)
            simulator.solver.contact_handler = DifferentiableBarrierContact(3 * energy / (0.9 * width) ** 3, width)
    else:
        simulator = Simulator(
            mesh, StableNeoHookean(float(job.E), float(job.nu)), SemiImplicitSolver(**options), density=job.density
        )
    if job.fixed.size:
        simulator.set_fixed_vertices(job.fixed.tolist())
    return simulator, torch.tensor(lift, dtype=simulator.positions.dtype), job.substeps // chunk


def checkpointed(job) -> bool:
    return job.differentiates and len(job.tetrahedra) * job.substeps * job.frames > GRAPH_LIMIT


def work(job):
    torch.set_default_device(job.device)
    simulator, lift, steps = simulator_of(job)
    dtype = simulator.positions.dtype
    start, speed = (torch.tensor(a, dtype=dtype) for a in (job.start, job.velocities))

    def run():
        simulator.positions, simulator.velocities = start + lift, speed.clone()
        if job.differentiates:
            simulator.positions.requires_grad_(True)
            simulator.material.E.grad = None
        first, seen = simulator.positions, [simulator.positions]
        if checkpointed(job):
            seen = [x for x, _ in simulator.rollout(steps * job.frames, 1)[::steps]]
        else:
            for _ in range(job.frames):
                simulator.step()
                seen.append(simulator.positions)
        positions = np.stack([(x.detach() - lift).cpu().numpy() for x in seen])
        if not job.differentiates:
            return positions, {}
        adjoints = [torch.tensor(a, dtype=dtype) for a in job.adjoints(positions)]
        torch.autograd.backward(seen[1:], adjoints[1:])
        return positions, dict(
            youngs_modulus=float(simulator.material.E.grad), initial_positions=first.grad.double().cpu().numpy()
        )

    seconds, (positions, gradients) = timed(run, job.repeats, compiles=False)
    return seconds, positions, gradients


if __name__ == "__main__":
    answer_all(work)
