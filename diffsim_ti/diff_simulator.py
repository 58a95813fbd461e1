"""PyTorch face: a rollout as one autograd node, and the seeds' DifferentiableSolver and DifferentiableSimulator.

No physics lives here: forward calls `Rollout.forward`, backward calls `Rollout.vjp`.
"""

import math
import warnings
from typing import NamedTuple

import numpy as np
import torch

from diffsim_ti import stability
from diffsim_ti.rollout import Rollout
from diffsim_ti.scene import Scene
from diffsim_ti.solvers import SemiImplicitSolver
from diffsim_ti.terms import Drag, ExternalForce, Gravity, Ground, barrier

DTYPES = {"f32": torch.float32, "f64": torch.float64}


class TorchFrames(NamedTuple):
    """Saved states as tensors of shape (frames, num_vertices, 3): positions [m], velocities [m/s], displacements [m]."""

    positions: torch.Tensor
    velocities: torch.Tensor
    displacements: torch.Tensor


class _RolloutFunction(torch.autograd.Function):
    """Inputs of a rollout -> displacements and velocities of its frames."""

    @staticmethod
    def forward(ctx, rollout: Rollout, names: tuple, *tensors):
        values = {}
        for name, tensor in zip(names, tensors):
            value = tensor.detach().to("cpu", torch.float64).numpy()
            if name == "initial_displacements":
                name, value = "initial_positions", rollout.values["rest_positions"] + value
            values[name] = value
        frames = rollout.forward(**values)
        ctx.rollout, ctx.names, ctx.frames = rollout, names, frames
        ctx.kinds = [(tensor.dtype, tensor.device) for tensor in tensors]
        device = tensors[0].device if tensors else "cpu"
        return tuple(torch.from_numpy(x).to(device) for x in (frames.displacements, frames.velocities))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, by_displacements, by_velocities):
        adjoints = (g.detach().to("cpu", torch.float64).numpy() for g in (by_displacements, by_velocities))
        gradients = ctx.rollout.vjp(ctx.frames, *adjoints)
        out = [None, None]
        for name, (dtype, device), needed in zip(ctx.names, ctx.kinds, ctx.needs_input_grad[2:]):
            name = "initial_positions" if name == "initial_displacements" else name
            out.append(torch.from_numpy(np.array(gradients[name])).to(device, dtype) if needed else None)
        return tuple(out)


def rollout_frames(rollout: Rollout, **tensors: torch.Tensor) -> TorchFrames:
    """Functional face: run a Rollout with some inputs given as tensors; one autograd node, gradients to all of them.

    Names are those of `rollout.inputs`, or "initial_displacements" instead of "initial_positions" (which keeps its digits
    in float32). Two runs before one backward are right. Second derivatives are refused (see `verify.hessian_product`).
    """
    displacements, velocities = _RolloutFunction.apply(rollout, tuple(tensors), *tensors.values())
    rest = torch.from_numpy(np.array(rollout.values["rest_positions"])).to(displacements)
    return TorchFrames(rest + displacements, velocities, displacements)


class DifferentiableSolver:
    """How a DifferentiableSimulator steps: symplectic Euler with the seeds' numbers.

    dt [s]; gravity [m/s^2]: a number along y, 3 numbers, or a tensor of either (with gradient); damping: the share of
    velocity kept over one dt, whatever the substeps, default 1 (none); substeps: the least number. The simulator raises
    it to what stability and contact ask for, says so once, and keeps the count.
    """

    def __init__(self, dt: float = 0.01, gravity=-9.8, damping: float = 1.0, substeps: int = 1):
        if not (math.isfinite(dt) and dt > 0):
            raise ValueError(f"dt must be > 0 [s], got {dt}")
        if not 0 < damping <= 1:
            raise ValueError(f"damping is the share of velocity kept over one dt and must lie in (0, 1], got {damping}")
        self.dt, self.gravity, self.damping, self.substeps = float(dt), gravity, float(damping), int(substeps)

    def gravity_vector(self, like: torch.Tensor) -> torch.Tensor:
        """Gravity as a vector of 3, with its graph."""
        g = torch.as_tensor(self.gravity, dtype=like.dtype, device=like.device)
        if g.ndim == 0:
            zero = torch.zeros_like(g)
            g = torch.stack([zero, g, zero])
        if g.shape != (3,):
            raise ValueError(f"gravity must be a number (along y) or 3 numbers, got shape {tuple(g.shape)}")
        return g


class DifferentiableSimulator:
    """Steps a soft body through torch's graph: positions and velocities are tensors with gradients to all that went in.

    material: DifferentiableMaterial or SpatiallyVaryingMaterial (diff_physics); density [kg/m^3]: a number or a tensor,
    scalar or per tetrahedron; fixed_vertices: set name, indices or mask; contact: None for the seeds' ground, False for
    none, or a DifferentiableBarrierContact; terms: further core terms.

    The seeds' ground is a barrier (stiffness 1e4, width 0.01) at y = 0 where the body starts at least one width above it,
    otherwise one width below its lowest vertex; it is fixed at the start. `describe()` says which.
    The precision follows the material's dtype. Raises Divergence if the run outgrows its substeps.
    """

    def __init__(self, mesh, material, solver: DifferentiableSolver, density=1000.0, fixed_vertices=None, contact=None,
                 terms=None, device="cpu"):  # fmt: skip
        self.mesh, self.material, self.solver, self.device = mesh, material, solver, torch.device(device)
        self.density, self.fixed_vertices = density, fixed_vertices
        self._terms = list(terms or [])
        self._ground = self._choose_ground(contact)
        self._substeps, self._rollouts, self._scenes = solver.substeps, {}, {}
        self._ratio: float | None = None
        self.reset()

    def _choose_ground(self, contact) -> Ground | None:
        if contact is False:
            return None
        if contact is not None:
            return contact.term()
        lowest, width = float(self.mesh.vertices[:, 1].min()), 0.01
        return Ground(0.0 if lowest >= width else lowest - width, 1e4, width)

    @property
    def dtype(self) -> torch.dtype:
        return next(iter(self.material.tensors(self.mesh).values())).dtype

    @property
    def positions(self) -> torch.Tensor:
        """Positions [m], shape (num_vertices, 3), in the graph."""
        return self._rest + self._displacements

    @property
    def velocities(self) -> torch.Tensor:
        """Velocities [m/s], shape (num_vertices, 3), in the graph."""
        return self._velocities

    def reset(self, positions: torch.Tensor | None = None, velocities: torch.Tensor | None = None) -> None:
        """Back to the start, or to given positions [m] and velocities [m/s], tensors of shape (num_vertices, 3)."""
        precision = {v: k for k, v in DTYPES.items()}.get(self.dtype)
        if precision is None:
            raise ValueError(f"the material's parameters must be float32 or float64, got {self.dtype}")
        if getattr(self, "_precision", None) != precision:
            self._precision, self._rollouts, self._scenes = precision, {}, {}
        kind = dict(dtype=self.dtype, device=self.device)
        self._rest = torch.tensor(np.array(self.mesh.vertices), **kind)
        shape = tuple(self._rest.shape)
        for name, value in (("positions", positions), ("velocities", velocities)):
            if value is not None and tuple(value.shape) != shape:
                raise ValueError(f"{name}: expected shape {shape}, got {tuple(value.shape)}")
        self._displacements = torch.zeros_like(self._rest) if positions is None else positions.to(**kind) - self._rest
        self._velocities = torch.zeros_like(self._rest) if velocities is None else velocities.to(**kind)
        self._choose_substeps()

    def step(self, external_forces: torch.Tensor | None = None) -> None:
        """Advance by dt; external_forces [N], shape (num_vertices, 3), with gradient."""
        self._advance(1, external_forces)

    def rollout(self, num_steps: int, checkpoint_every: int | None = None, save_every: int | None = None) -> TorchFrames:
        """num_steps steps as one autograd node; the frames (the start, then every save_every-th step, default the last)."""
        return self._advance(num_steps, None, checkpoint_every, save_every)

    def describe(self) -> str:
        """What is simulated, and how."""
        return self._rollout(1, False, None, None).solver.describe() + "\n" + self._scene(False).describe()

    def _advance(self, steps, external_forces, checkpoint_every=None, save_every=None) -> TorchFrames:
        rollout = self._rollout(steps, external_forces is not None, checkpoint_every, save_every)
        tensors = {"initial_displacements": self._displacements, "initial_velocities": self._velocities}
        tensors |= self.material.tensors(self.mesh)
        tensors["density"] = torch.as_tensor(self.density, dtype=self.dtype)
        tensors["gravity"] = self.solver.gravity_vector(self._rest)
        if external_forces is not None:
            if tuple(external_forces.shape) != tuple(self._rest.shape):
                expected = tuple(self._rest.shape)
                raise ValueError(f"external_forces: expected shape {expected}, got {tuple(external_forces.shape)}")
            tensors["external_forces"] = external_forces
        frames = rollout_frames(rollout, **tensors)
        self._displacements, self._velocities = frames.displacements[-1], frames.velocities[-1]
        return frames

    def _scene(self, with_forces: bool) -> Scene:
        if with_forces not in self._scenes:
            terms = [Gravity(self.solver.gravity_vector(self._rest).detach().double().cpu().numpy()), *self._terms]
            if self.solver.damping < 1:
                terms.append(Drag(-math.log(self.solver.damping) / self.solver.dt))
            if self._ground is not None:
                terms.append(self._ground)
            if with_forces:
                terms.append(ExternalForce(np.zeros((self.mesh.num_vertices, 3))))
            self._scenes[with_forces] = Scene(
                self.mesh, self.material.core(self.mesh), torch.as_tensor(self.density).detach().double().cpu().numpy(),
                terms, self.fixed_vertices, precision=self._precision,
            )  # fmt: skip
        return self._scenes[with_forces]

    def _rollout(self, steps: int, with_forces: bool, checkpoint_every, save_every) -> Rollout:
        key = (steps, with_forces, checkpoint_every, save_every)
        if key not in self._rollouts:
            solver = SemiImplicitSolver(self._scene(with_forces), dt=self.solver.dt, substeps=self._substeps,
                                        allow_unstable=True)  # fmt: skip
            solver.allow_unstable = False  # the count was chosen below; outgrowing it raises
            self._rollouts[key] = Rollout(solver, steps, save_every, checkpoint_every)
        return self._rollouts[key]

    def _choose_substeps(self) -> None:
        """What stability and contact ask for at the present moduli; the count only grows, so that losses stay smooth."""
        scene = self._scene(False)
        numbers = {k: v.detach().double().cpu().numpy() for k, v in self.material.tensors(self.mesh).items()}
        density = torch.as_tensor(self.density).detach().double().cpu().numpy()
        values = scene.inputs.check(scene.inputs.values | numbers | {"density": density})
        bound = stability.element_limit(scene, values).dt
        if self._ratio is None:
            solver = SemiImplicitSolver(scene, dt=self.solver.dt, allow_unstable=True)
            self._ratio = solver.stable_dt(tight=True).dt / stability.element_limit(scene).dt
        omega2 = (2 / (self._ratio * bound)) ** 2
        if self._ground is not None:
            stiffness = float(self._ground.values["barrier_stiffness"])
            mass = scene.inputs.derive(values).mass
            omega2 += stiffness * barrier.reference_curvature() / mass[mass > 0].min()
        needed = math.ceil(self.solver.dt * math.sqrt(omega2) / 2 / 0.8)
        if needed > self._substeps:
            warnings.warn(
                f"dt = {self.solver.dt:g} s is divided into {needed} substeps (asked for at least {self.solver.substeps}), "
                "which stability and contact ask for",
                stacklevel=4,
            )
            self._substeps, self._rollouts = needed, {}
