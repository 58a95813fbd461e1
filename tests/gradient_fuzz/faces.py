"""The other faces of a rollout: Taichi's tape, torch's functional face, the torch simulator with parameters of its own."""

import numpy as np
import taichi as ti

import diffsim_ti as ds

from .differences import derivative
from .structures import CELL, EXPLICIT

RIGHT = "right"


def tape(it) -> str:
    """Under `ti.ad.Tape`, fields of two inputs: the same bits."""
    rollout = it.configuration.rollout()
    fp = ti.f64 if it.configuration.structure.precision == "f64" else ti.f32
    loss = ti.field(fp, shape=(), needs_grad=True)
    shape = it.w.shape[:2]
    w, z = (ti.Vector.field(3, fp, shape=shape) for _ in range(2))
    names = it.configuration.rng(7).permutation([n for n in rollout.inputs if rollout.values[n].ndim < 3])[:2]
    fields = {str(name): rollout.field(str(name)) for name in names}
    x, v = rollout.positions, rollout.velocities
    w.from_numpy(it.w.astype(np.float64 if fp == ti.f64 else np.float32))
    z.from_numpy(it.z.astype(np.float64 if fp == ti.f64 else np.float32))

    @ti.kernel
    def weigh():
        for k, i in ti.ndrange(shape[0], shape[1]):
            loss[None] += w[k, i].dot(x[k, i]) + z[k, i].dot(v[k, i])

    with ti.ad.Tape(loss):
        rollout.run()
        weigh()
    for name, expected in it.gradients.items():
        if not np.array_equal(rollout.gradients[name], expected):
            return f"{name}: gradients differ by {np.abs(rollout.gradients[name] - expected).max():.3g}"
    for name, f in fields.items():
        if not np.allclose(f.grad.to_numpy(), it.gradients[name], rtol=1e-6, atol=0):
            return f"field({name!r}).grad differs"
    return RIGHT


def torch_frames(it) -> str:
    """`rollout_frames` with some inputs as tensors, two backwards, a run in between; second derivatives are refused."""
    import torch

    from diffsim_ti.diff_simulator import rollout_frames

    rollout, rng = it.configuration.rollout(), it.configuration.rng(8)
    names = [str(n) for n in rng.permutation(list(rollout.inputs))[: rng.integers(1, 6)]]
    tensors = {n: torch.tensor(rollout.values[n], dtype=torch.float64, requires_grad=True) for n in names}
    if "initial_positions" in tensors and "rest_positions" not in tensors and rng.random() < 0.5:
        start = rollout.values["initial_positions"] - rollout.values["rest_positions"]
        tensors.pop("initial_positions")
        tensors["initial_displacements"] = torch.tensor(start, requires_grad=True)
    frames = rollout_frames(rollout, **tensors)
    w, z = (torch.from_numpy(x).to(frames.positions) for x in (it.w, it.z))
    loss = (w * frames.positions).sum() + (z * frames.velocities).sum()
    first = torch.autograd.grad(loss, list(tensors.values()), retain_graph=True)
    rollout_frames(rollout, density=torch.tensor(1.2 * rollout.values["density"]))
    second = torch.autograd.grad(loss, list(tensors.values()), retain_graph=True)
    for name, a, b in zip(tensors, first, second):
        expected = it.gradients["initial_positions" if name == "initial_displacements" else name]
        if not torch.equal(a, b):
            return f"{name}: the second backward differs"
        if np.abs(a.numpy() - expected).max(initial=0.0) > 1e-12 * np.abs(expected).max(initial=0.0):
            return f"{name}: off by {np.abs(a.numpy() - expected).max():.3g} of {np.abs(expected).max():.3g}"
    by = torch.autograd.grad(loss, list(tensors.values()), create_graph=True)
    try:
        torch.autograd.grad(sum(g.sum() for g in by), list(tensors.values()))
    except RuntimeError:
        return RIGHT
    return "second derivatives were not refused"


def torch_simulator(it) -> str:
    """DifferentiableSimulator: parameters of material, contact, gravity, density and start against differences."""
    configuration, kind = it.configuration, it.configuration.structure
    if not kind.torch or kind.static:
        return RIGHT
    import torch

    from diffsim_ti.diff_physics import DifferentiableBarrierContact, DifferentiableMaterial, SpatiallyVaryingMaterial
    from diffsim_ti.diff_simulator import DifferentiableSimulator, DifferentiableSolver

    rng, mesh, dt = configuration.rng(9), configuration.scene.mesh, configuration.solver.dt
    leaf = lambda x: torch.tensor(np.array(x), dtype=torch.float64, requires_grad=True)  # noqa: E731
    start, terms = it.rollout.values["initial_positions"], [t for t in configuration.terms if not _core(t)]
    low, width = start[:, 1].min(), 0.3 * CELL
    leaves = dict(
        kappa=leaf(20.0),
        d_hat=leaf(width),
        ground_height=leaf(low - 0.5 * width),
        gravity=leaf([1.0, -9.0, 0.5]),
        density=leaf(900.0),
        positions=leaf(start),
        velocities=leaf(it.rollout.values["initial_velocities"]),
    )
    if rng.random() < 0.5:
        material = DifferentiableMaterial(E=leaf(3e4).detach(), nu=leaf(0.3).detach(), law=kind.law)
    else:
        material = SpatiallyVaryingMaterial(mesh.num_tetrahedra, 3e4, 0.3, law=kind.law).double()
    leaves |= dict(material.named_parameters())
    contact = DifferentiableBarrierContact(leaves["kappa"], leaves["d_hat"], ground_height=leaves["ground_height"])
    options = dict(tolerance=1e-11) if kind.solver not in EXPLICIT else {}
    solver = DifferentiableSolver(dt, leaves["gravity"], 0.97, configuration.solver.substeps, kind.solver, **options)
    fixed = configuration.scene.fixed if len(configuration.scene.fixed) else None
    simulator = DifferentiableSimulator(mesh, material, solver, leaves["density"], fixed, contact, terms)

    def run():
        simulator.reset(leaves["positions"], leaves["velocities"])
        frames = simulator.rollout(configuration.steps, save_every=configuration.options["save_every"])
        return frames.displacements, frames.velocities

    w, z = torch.from_numpy(it.w), torch.from_numpy(it.z)
    u, v = run()
    gradients = torch.autograd.grad((w * u).sum() + (z * v).sum(), list(leaves.values()), retain_graph=True)
    again = torch.autograd.grad((w * u).sum() + (z * v).sum(), list(leaves.values()))
    if any(not torch.equal(a, b) for a, b in zip(gradients, again)):
        return "the second backward differs"
    for (name, parameter), gradient in zip(leaves.items(), gradients):
        said = _compare(name, parameter, gradient.numpy(), run, w, z, rng, 1e-6 if kind.explicit else 1e-5)
        if said != RIGHT and simulator.last_rollout.forward().contact_resolution.resolved:
            return said
    return RIGHT


def _core(term) -> bool:
    """Whether the torch simulator brings a term of this kind itself, or the test leaves it out."""
    return isinstance(term, (ds.Gravity, ds.Drag, ds.ExternalForce))


def _compare(name, parameter, gradient, run, w, z, rng, gate) -> str:
    import torch

    value = parameter.detach().clone()
    size = 0.01 * CELL if name in ("positions", "ground_height") else 0.05 * float(value.abs().max())
    direction = torch.from_numpy(np.array(size * rng.standard_normal(tuple(value.shape))))

    def change(h: float) -> float:
        ends = []
        for sign in (1, -1):
            with torch.no_grad():
                parameter.copy_(value + sign * h * direction)
                ends.append(run())
                parameter.copy_(value)
        return float((w * (ends[0][0] - ends[1][0])).sum() + (z * (ends[0][1] - ends[1][1])).sum())

    reverse = float((gradient * direction.numpy()).sum())
    typical = np.linalg.norm(gradient * direction.numpy())
    found, error = derivative(change, 0.1 * gate * typical, 1e-13, reverse)
    if abs(found - reverse) <= gate * max(abs(found), abs(reverse), typical) + 3 * error:
        return RIGHT
    return f"torch parameter {name}: {reverse} for {found} +- {error:.1g}"
