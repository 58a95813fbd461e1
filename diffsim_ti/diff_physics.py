"""PyTorch interface: learnable materials, smooth contact, implicit differentiation, checkpointed rollouts."""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.public import Public, public
from diffsim_ti.materials import Material, StableNeoHookean, moduli
from diffsim_ti.materials.evaluate import evaluate
from diffsim_ti.torch_bridge.autograd import first_order_only, refuse_state, torch
from diffsim_ti.torch_bridge.barrier_contact import DifferentiableBarrierContact
from diffsim_ti.torch_bridge.implicit_differentiation import ImplicitDifferentiation, conjugate_gradient
from diffsim_ti.torch_bridge.step_sizes import bounded, refuse_steps

if TYPE_CHECKING:
    from diffsim_ti.diff_simulator import DifferentiableSimulator

__all__ = ["TorchMaterial", "DifferentiableMaterial", "SpatiallyVaryingMaterial", "DifferentiableBarrierContact"]
__all__ += ["ImplicitDifferentiation", "conjugate_gradient", "CheckpointedRollout", "smooth_step", "log_barrier"]


TINY = 1e-30  # instead of Adam's eps
NU_RANGE = -0.9, 0.49  # what an optimiser may try


class _EnergyDensity(torch.autograd.Function):
    """psi(F, coefficients) of a Taichi law."""

    @staticmethod
    def forward(ctx, law, F, coefficients):
        psi, P, by = evaluate(law, *(x.detach().cpu().double().numpy() for x in (F, coefficients)))
        ctx.save_for_backward(*(torch.from_numpy(x).to(F) for x in (P, by)))
        ctx.uniform, ctx.tensors = coefficients.ndim == 1, (F, coefficients)
        return torch.from_numpy(psi).to(F)

    @staticmethod
    @first_order_only("the energy's stress differential lives in the core (materials)")
    def backward(ctx, grad):
        P, by = ctx.saved_tensors
        by_coefficients = grad[:, None] * by
        return None, grad[:, None, None] * P, by_coefficients.sum(0) if ctx.uniform else by_coefficients


class TorchMaterial(torch.nn.Module, metaclass=Public):
    """What learnable materials share: E and nu as tensors, and the one law that exists in Taichi.

    A subclass gives `E` [Pa] and `nu` [-], attributes or properties that are tensors of shape () or (num_tetrahedra,): from
    parameters, or from a network. `material` names the core's law.
    """

    material = StableNeoHookean

    @property
    def mu(self) -> torch.Tensor:
        """Shear modulus E / (2 (1 + nu)) [Pa], in the graph."""
        return moduli.lame(self.E, self.nu)[0]

    @property
    def lam(self) -> torch.Tensor:
        """First Lame parameter E nu / ((1 + nu)(1 - 2 nu)) [Pa], in the graph."""
        return moduli.lame(self.E, self.nu)[1]

    def energy_density(self, F: torch.Tensor) -> torch.Tensor:
        """Energy density [J/m^3], shape (m,), of deformation gradients F, shape (m, 3, 3); gradients to F, E and nu.

        Second derivatives are refused with an error; the core has stress differentials.
        """
        if F.ndim != 3 or F.shape[1:] != (3, 3):
            raise ValueError(f"F: expected shape (m, 3, 3), got {tuple(F.shape)}")
        material = self.material(*(x.detach().double().cpu().numpy() for x in (self.E, self.nu)))
        refuse_state(material.law("f64"), "energy_density(F)", "ask Simulator.compute_energy(), which has the state")
        lame = torch.stack(torch.broadcast_tensors(self.mu, self.lam), -1)
        coefficients = lame @ torch.as_tensor(np.array(material.from_lame), dtype=lame.dtype, device=lame.device).T
        if coefficients.ndim == 2 and len(coefficients) != len(F):
            raise ValueError(f"F: expected {len(coefficients)} matrices, one per tetrahedron, got {len(F)}")
        law = material.law("f64" if F.dtype == torch.float64 else "f32")
        return _EnergyDensity.apply(law, F, coefficients.to(F.dtype))

    def tensors(self, mesh) -> dict[str, torch.Tensor]:
        """The material's inputs on a mesh, in the graph."""
        return {"youngs_modulus": self.E, "poissons_ratio": self.nu}

    def rooms(self) -> dict[str, tuple[torch.nn.Parameter, float]]:
        """{name: (parameter, how far a single step may move it at most, in its unit)}; none where it is not known."""
        return {}

    def check_steps(self) -> None:
        """Raise ValueError, naming `parameter_groups`, where an optimiser of these parameters would leave their ranges.

        Those of Adam's kind count, which move a number by lr whatever its gradient.
        """
        refuse_steps(self.rooms())

    def parameter_groups(self, relative: float = 0.05) -> list[dict]:
        """Groups for torch, `Adam(material.parameter_groups(relative=0.05))`: each number has a step of its own size.

        lr of a group is `relative` times the number's size (the mean of its magnitudes), and `relative` itself for
        logarithms. eps is 0, since gradients by pascals are far below Adam's 1e-8. For optimisers that normalise gradients.
        Kingma, Ba, Adam, 2015, arXiv:1412.6980.
        """
        if not 0 < relative < 1:
            raise ValueError(f"relative: a share between 0 and 1, got {relative}")
        groups = []
        for name, parameter in self.named_parameters():
            if parameter.requires_grad:
                size = 1.0 if name.startswith("log_") else float(parameter.detach().abs().mean()) or 1.0
                groups.append(dict(params=[parameter], lr=relative * size, eps=TINY, name=name))
        return groups

    def core(self, mesh):
        """The core's material on a mesh, at the present values."""
        return self.material(*(x.detach().double().cpu().numpy() for x in self.tensors(mesh).values()))


def _one_of(name: str, *given, default=None):
    """The single value that is not None among spellings of a name, or the default."""
    values = [value for value in given if value is not None]
    if not values and default is not None:
        return default
    if len(values) != 1:
        raise ValueError(f"{name}: give exactly one of its spellings, got {len(values)}")
    return values[0]


class DifferentiableMaterial(TorchMaterial):
    """Stable neo-Hookean material with learnable Young's modulus E [Pa] and Poisson's ratio nu [-].

    psi = mu/2 (I_C - 3) - mu log J + lam/2 (J - 1)^2; E and nu scalar or one per tetrahedron; both are Parameters.
    `DifferentiableMaterial(1e5, 0.4)`, `(E=..., nu=...)` or `(youngs_modulus=..., poissons_ratio=...)`; law: another
    core material class, such as SmithNeoHookean.

    A gradient by E in pascals is tiny: 4e-11 in the seeds' identification block, far below Adam's eps of 1e-8, so that
    Adam's lr of 5e3 moves E by 20 Pa a step. Optimise log E with a scaled loss over all frames, or use LBFGS
    (examples/identify/identify_torch.py); or `Adam(material.parameter_groups(relative=0.05))`.

    What an optimiser moves out of nu_range (default -0.9 to 0.49, or to the nu given) is taken at the bound, with a warning,
    and keeps the gradient that leads back. An optimiser whose lr exceeds what E or nu can move is refused before the first
    run.

    >>> import torch
    >>> from diffsim_ti.diff_physics import DifferentiableMaterial
    >>> material = DifferentiableMaterial(E=1e5, nu=0.25)
    >>> print(f"{material.mu.item():.0f} {material.lam.item():.0f}")  # E / 2.5
    40000 40000
    >>> material.mu.backward()
    >>> print(f"{material.E.grad.item():.1f}")  # 1 / (2 (1 + nu))
    0.4
    """

    def __init__(
        self,
        youngs_modulus: ArrayLike | None = None,
        poissons_ratio: ArrayLike | None = None,
        requires_grad: bool = True,
        *,
        E: ArrayLike | None = None,
        nu: ArrayLike | None = None,
        law: type[Material] = StableNeoHookean,
        nu_range: tuple[float, float] | None = None,
    ):
        super().__init__()
        self.material = law
        E = _one_of("Young's modulus (E, youngs_modulus)", youngs_modulus, E)
        nu = _one_of("Poisson's ratio (nu, poissons_ratio)", poissons_ratio, nu)
        given = [x.dtype for x in (E, nu) if isinstance(x, torch.Tensor) and x.is_floating_point()]
        dtype = max(given, key=lambda d: torch.finfo(d).bits, default=torch.get_default_dtype())
        for name, value in (("E", E), ("nu", nu)):
            value = torch.as_tensor(value, dtype=dtype).detach().clone()
            self.register_parameter(name, torch.nn.Parameter(value, requires_grad=requires_grad))
        law(self.E.detach().double().cpu().numpy(), self.nu.detach().double().cpu().numpy())  # checks the numbers
        given = float(self.nu.detach().min()), float(self.nu.detach().max())
        low, high = (min(NU_RANGE[0], given[0]), max(NU_RANGE[1], given[1])) if nu_range is None else nu_range
        if not -1 < low <= given[0] <= given[1] <= high < 0.5:
            raise ValueError(f"nu_range must lie in (-1, 0.5) and contain nu, got {nu_range} and {given}")
        self.nu_range = float(low), float(high)

    def tensors(self, mesh) -> dict[str, torch.Tensor]:
        """E as it is, and nu within nu_range, in the graph."""
        return {"youngs_modulus": self.E, "poissons_ratio": bounded(self.nu, *self.nu_range, name="Poisson's ratio")}

    def rooms(self) -> dict[str, tuple[torch.nn.Parameter, float]]:
        return {"E": (self.E, float(self.E.detach().min())), "nu": (self.nu, self.nu_range[1] - self.nu_range[0])}


class SpatiallyVaryingMaterial(TorchMaterial):
    """Stiffness that varies over the body, in one of two parametrisations.

    `SpatiallyVaryingMaterial(num_elements, base_youngs, base_poisson)`: Parameters log_E and nu, one per tetrahedron.
    `SpatiallyVaryingMaterial(base_E=, base_nu=, grid_resolution=, E_range=, requires_grad=)`: one Parameter of control
    values in Pa on a regular grid over the mesh's bounding box, trilinear at the tetrahedra's centroids and held in
    E_range, with the gradient that leads back into it; nu is a buffer. E is then `youngs_modulus(mesh)`.
    """

    def __init__(
        self,
        num_elements: int | None = None,
        base_youngs: float | None = None,
        base_poisson: float | None = None,
        *,
        base_E: float | None = None,
        base_nu: float | None = None,
        grid_resolution: Sequence[int] | None = None,
        E_range: tuple[float, float] | None = None,
        requires_grad: bool = True,
        law: type[Material] = StableNeoHookean,
    ):
        super().__init__()
        self.material = law
        E = float(_one_of("base_youngs, base_E", base_youngs, base_E, default=1e5))
        nu = float(_one_of("base_poisson, base_nu", base_poisson, base_nu, default=0.4))
        law(E, nu)
        self.nu_range = min(NU_RANGE[0], nu - 1e-6), max(NU_RANGE[1], nu + 1e-6)  # nu is stored in float32
        if (num_elements is None) == (grid_resolution is None):
            raise ValueError(
                "give num_elements (a value per tetrahedron) or grid_resolution (values on a grid), not both"
            )
        self.grid_resolution = None if grid_resolution is None else tuple(int(r) for r in grid_resolution)
        if self.grid_resolution is None:
            self.log_E = torch.nn.Parameter(torch.full((num_elements,), math.log(E)), requires_grad=requires_grad)
            self.nu = torch.nn.Parameter(torch.full((num_elements,), nu), requires_grad=requires_grad)
        else:
            if len(self.grid_resolution) != 3 or min(self.grid_resolution) < 2:
                raise ValueError(f"grid_resolution: 3 numbers >= 2, got {grid_resolution}")
            low, high = (0.1 * E, 10 * E) if E_range is None else E_range
            if not 0 < low <= E <= high:
                raise ValueError(f"E_range must be positive and contain base_E = {E:g}, got {E_range}")
            self.E_range = (float(low), float(high))
            self.control = torch.nn.Parameter(torch.full(self.grid_resolution, E), requires_grad=requires_grad)
            self.register_buffer("nu", torch.tensor(nu))

    @property
    def E(self) -> torch.Tensor:
        """Young's modulus per tetrahedron [Pa], in the graph; RuntimeError on a grid, whose values need a mesh."""
        if self.grid_resolution is not None:
            raise RuntimeError("the grid's values need a mesh: call youngs_modulus(mesh)")
        return torch.exp(self.log_E)

    def youngs_modulus(self, mesh) -> torch.Tensor:
        """Young's modulus per tetrahedron of a mesh [Pa], in the graph."""
        if self.grid_resolution is not None:
            weights, corners = _trilinear(mesh, self.grid_resolution)
            values = self.control.reshape(-1)[torch.from_numpy(corners).to(self.control.device)]
            return bounded((torch.from_numpy(weights).to(self.control) * values).sum(1), *self.E_range)
        if len(self.log_E) != mesh.num_tetrahedra:
            given = len(self.log_E)
            raise ValueError(f"num_elements: the mesh has {mesh.num_tetrahedra} tetrahedra, the material {given}")
        return self.E

    def tensors(self, mesh) -> dict[str, torch.Tensor]:
        return {"youngs_modulus": self.youngs_modulus(mesh), "poissons_ratio": bounded(self.nu, *self.nu_range)}

    def rooms(self) -> dict[str, tuple[torch.nn.Parameter, float]]:
        if self.grid_resolution is not None:
            return {"control": (self.control, self.E_range[1] - self.E_range[0])}
        return {"log_E": (self.log_E, math.log(1e3)), "nu": (self.nu, self.nu_range[1] - self.nu_range[0])}


@lru_cache(maxsize=4)
def _trilinear(mesh, resolution: tuple) -> tuple[np.ndarray, np.ndarray]:
    """Weights and indices (num_tetrahedra, 8) of the points of a grid over the mesh's bounding box around each centroid."""
    low, high = mesh.bounding_box
    size = np.array(resolution)
    at = (mesh.centroids - low) / (high - low) * (size - 1)
    cell = np.clip(np.floor(at).astype(int), 0, size - 2)
    part = at - cell
    weights, corners = [], []
    for corner in np.ndindex(2, 2, 2):
        weights.append(np.prod(np.where(corner, part, 1 - part), 1))
        corners.append(np.ravel_multi_index((cell + corner).T, resolution))
    return np.stack(weights, 1), np.stack(corners, 1)


class CheckpointedRollout(metaclass=Public):
    """Long rollouts in little memory, in the seeds' two spellings.

    `CheckpointedRollout.rollout(step_fn, state0, num_steps, checkpoint_every)`: any torch step function; returns all
    states, so only the graph's memory falls. `CheckpointedRollout(simulator, checkpoint_every=10)(num_steps=1000)`: a
    DifferentiableSimulator; keeps the last state and really saves; returns its positions.
    """

    def __init__(self, simulator: "DifferentiableSimulator", checkpoint_every: int = 10):
        self.simulator, self.checkpoint_every = simulator, checkpoint_every

    def __call__(self, num_steps: int) -> torch.Tensor:
        """Positions [m] after num_steps steps, in the graph."""
        self.simulator.rollout(num_steps, checkpoint_every=self.checkpoint_every)
        return self.simulator.positions

    @staticmethod
    def rollout(step_fn, state0, num_steps: int, checkpoint_every: int = 10) -> list:
        """[s_0, ..., s_T] with s_{t+1} = step_fn(s_t); a state is a tensor or a tuple of tensors."""
        from torch.utils.checkpoint import checkpoint

        if num_steps < 0 or checkpoint_every < 1:
            given = f"{num_steps} and {checkpoint_every}"
            raise ValueError(f"num_steps must be >= 0 and checkpoint_every >= 1, got {given}")
        single = isinstance(state0, torch.Tensor)

        def segment(count, *state):
            out = []
            for _ in range(count):
                state = step_fn(state[0] if single else state)
                state = (state,) if single else tuple(state)
                out.extend(state)
            return tuple(out)

        states, state = [state0], (state0,) if single else tuple(state0)
        for done in range(0, num_steps, checkpoint_every):
            count = min(checkpoint_every, num_steps - done)
            flat = checkpoint(segment, count, *state, use_reentrant=False)
            width = len(state)
            groups = [flat[i : i + width] for i in range(0, len(flat), width)]
            states += [group[0] if single else group for group in groups]
            state = groups[-1]
        return states


@public
def smooth_step(x: torch.Tensor, edge: float = 0.0, width: float = 1.0) -> torch.Tensor:
    """Smooth step from 0 to 1 around `edge`: 3 t^2 - 2 t^3 with t = clamp((x - edge) / width + 1/2, 0, 1); C1."""
    t = ((x - edge) / width + 0.5).clamp(0, 1)
    return t * t * (3 - 2 * t)


@public
def log_barrier(x: torch.Tensor, eps: float = 1e-3) -> torch.Tensor:
    """-log(x) for x > eps, continued below by its second-order Taylor polynomial at eps (C2)."""
    safe = x.clamp(min=eps)
    t = torch.minimum(x - eps, torch.zeros_like(x)) / eps
    return -torch.log(safe) - t + t * t / 2
