"""PyTorch interface: a rollout as one autograd node, and the seeds' DifferentiableSolver and DifferentiableSimulator.

No physics lives here: forward is a run of a Rollout's sweep, backward pulls back through it (torch_bridge/).
"""

import math
from collections.abc import Iterable
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import Unpack

from diffsim_ti import runtime
from diffsim_ti.common import deprecated
from diffsim_ti.common.answers import answered
from diffsim_ti.common.origin import middle_far_part, warn_of_rounding
from diffsim_ti.common.public import Public, check_options
from diffsim_ti.common.warn import warn
from diffsim_ti.diff_physics import DifferentiableBarrierContact, TorchMaterial, refuse_state
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.monitor import stability
from diffsim_ti.rollout import Rollout
from diffsim_ti.scene import Scene
from diffsim_ti.solvers import SemiImplicitSolver, Solver, StaticSolver
from diffsim_ti.solvers.solver import SolverOptions
from diffsim_ti.solvers.substeps import Chosen, Substeps, checked
from diffsim_ti.terms import Drag, ExternalForce, Gravity, Obstacle, SelfContact, Term
from diffsim_ti.terms.obstacles import barrier
from diffsim_ti.terms.obstacles.obstacle import PER_AREA
from diffsim_ti.torch_bridge.autograd import torch, uncompiled
from diffsim_ti.torch_bridge.rollout_node import TorchFrames, rollout_frames
from diffsim_ti.torch_bridge.simulator import TorchSimulator
from diffsim_ti.torch_bridge.tensors import DTYPES, checked_device

__all__ = ["DifferentiableSimulator", "DifferentiableSolver", "TorchFrames", "TorchSimulator", "rollout_frames"]


@answered
class DifferentiableSolver(metaclass=Public):
    """How a DifferentiableSimulator steps: any solver with inertia, symplectic Euler unless said otherwise.

    dt [s]; gravity [m/s^2]: a number along y, 3 numbers, or a tensor of either (with gradient); damping: the share of
    velocity kept over one dt, whatever the substeps, default 1 (none).
    method: a solver class of the core: SemiImplicitSolver, VelocityVerletSolver, ImplicitEulerSolver,
    ImplicitMidpointSolver or BDF2Solver; options: further arguments of that class, such as tolerance=1e-9.
    substeps: for explicit methods "auto", what stability and contact ask for at the start, or the least number: the
    simulator raises it to that and says so once. The count only grows. Implicit methods take a number as it is, "auto" for
    one; their gradients are as exact as `tolerance`.

    BDF2Solver looks back two steps, but each `step()` and each `rollout()` starts afresh: `step()` refuses it, and
    `rollout(n)` takes its first step by backward Euler. Equilibria (StaticSolver) have no steps: use `rollout_frames`.
    """

    def __init__(
        self,
        dt: float = 0.01,
        gravity: float | ArrayLike | torch.Tensor = -9.8,
        damping: float = 1.0,
        substeps: Substeps = "auto",
        method: type[Solver] = SemiImplicitSolver,
        **options: Unpack[SolverOptions],
    ):
        if not (math.isfinite(dt) and dt > 0):
            raise ValueError(f"dt must be > 0 [s], got {dt}")
        if not 0 < damping <= 1:
            raise ValueError(f"damping is the share of velocity kept over one dt and must lie in (0, 1], got {damping}")
        if not (isinstance(method, type) and issubclass(method, Solver)):
            raise ValueError(f"method must be a solver class such as ImplicitEulerSolver, got {method!r}")
        if issubclass(method, StaticSolver):
            raise ValueError(
                "method: StaticSolver has no steps; use rollout_frames(Rollout(StaticSolver(scene), 1), ...)"
            )
        check_options(type(self).__name__, method, options)
        self.method, self.options = method, options
        self.dt, self.gravity, self.damping = float(dt), gravity, float(damping)
        self.substeps = checked(substeps, method.explicit)

    def gravity_vector(self, like: torch.Tensor) -> torch.Tensor:
        """Gravity as a vector of 3, with its graph."""
        g = torch.as_tensor(self.gravity, dtype=like.dtype, device=like.device)
        if g.ndim == 0:
            zero = torch.zeros_like(g)
            g = torch.stack([zero, g, zero])
        if g.shape != (3,):
            raise ValueError(f"gravity must be a number (along y) or 3 numbers, got shape {tuple(g.shape)}")
        return g


@answered
class DifferentiableSimulator(metaclass=Public):
    """Steps a soft body through torch's graph: positions and velocities are tensors with gradients to all that went in.

    material: DifferentiableMaterial, SpatiallyVaryingMaterial or another TorchMaterial (diff_physics); density [kg/m^3]:
    a number or a tensor, scalar or per tetrahedron; fixed_vertices: set name, indices or mask; contact: "ground", the floor
    that torch-diffsim's documents have, False for none, or a DifferentiableBarrierContact, whose numbers may be tensors with
    gradient; terms: further core terms, whose numbers may be tensors with gradient, too, as in `Sphere(radius=tensor)`.

    This is the adapter for code that follows those documents; `Scene`, `Simulator` and `Rollout`, in torch through
    `rollout_frames`, say the same and more.
    "ground" is a barrier (stiffness 1e4, width 0.01) at y = 0 where the body starts at least one width above it,
    otherwise one width below its lowest vertex; it is fixed at the start. `describe()` says which.
    device: where tensors live. "cuda" also starts Taichi on the card; RuntimeError if it runs elsewhere already.
    The precision follows the material's dtype. Raises Divergence if the run outgrows its substeps; the state is then as
    it was before that step.

    >>> import diffsim_ti as ds
    >>> import torch
    >>> from diffsim_ti.diff_physics import DifferentiableMaterial
    >>> from diffsim_ti.diff_simulator import DifferentiableSimulator, DifferentiableSolver
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2).translated((0, 1, 0))
    >>> material = DifferentiableMaterial(torch.tensor(1e5, dtype=torch.float64), 0.3)
    >>> simulator = DifferentiableSimulator(mesh, material, DifferentiableSolver(dt=0.01, damping=1.0), contact=False)
    >>> simulator.step()
    >>> print(f"{simulator.velocities[0, 1].item():.4f} m/s")
    -0.0980 m/s
    """

    kept_rollouts = 8  # one for each length and way of saving that is in use

    def __init__(
        self,
        mesh: TetrahedralMesh,
        material: TorchMaterial,
        solver: DifferentiableSolver,
        density: float | torch.Tensor = 1000.0,
        fixed_vertices: str | ArrayLike | None = None,
        contact: DifferentiableBarrierContact | Literal["ground", False] = "ground",
        terms: Iterable[Term] | None = None,
        device: str | torch.device = "cpu",
    ):
        self.mesh, self.material, self.solver, self.device = mesh, material, solver, checked_device(device)
        self.density, self.fixed_vertices = density, fixed_vertices
        remedy = "each step and rollout starts afresh; take rollout_frames(Rollout(solver, steps), ...) for a whole run"
        refuse_state(material.core(mesh).law("f64"), "DifferentiableSimulator", remedy)
        self._terms = list(terms or [])
        if contact is None:
            deprecated.warn("DifferentiableSimulator(contact=None)", 'contact="ground"')
            contact = "ground"
        if isinstance(contact, str) and contact == "ground":
            lowest, width = float(mesh.vertices[:, 1].min()), 0.01
            ground = 0.0 if lowest >= width else lowest - width
            contact = DifferentiableBarrierContact(1e4, width, ground_height=ground)
        if contact is not False and not isinstance(contact, DifferentiableBarrierContact):
            raise ValueError(f'contact must be "ground", False or a DifferentiableBarrierContact, got {contact!r}')
        self._contact: DifferentiableBarrierContact | None = contact or None
        self._substeps, self._rollouts, self._scenes = solver.substeps, {}, {}
        self._ratio = self._last = self._rest = None
        self.reset()

    def __getstate__(self) -> dict:
        """For pickle and copy.deepcopy: the state leaves its graph; what Taichi holds is built again."""
        state = self.__dict__ | dict(_rollouts={}, _scenes={}, _last=None)
        return state | dict(_displacements=self._displacements.detach(), _velocities=self._velocities.detach())

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the material's tensors, in which states are given."""
        return next(iter(self.material.tensors(self.mesh).values())).dtype

    @property
    def positions(self) -> torch.Tensor:
        """Positions [m], shape (num_vertices, 3), in the graph."""
        return self._at_rest() + self._displacements

    @property
    def velocities(self) -> torch.Tensor:
        """Velocities [m/s], shape (num_vertices, 3), in the graph."""
        return self._velocities

    @uncompiled
    def reset(self, positions: torch.Tensor | None = None, velocities: torch.Tensor | None = None) -> None:
        """Back to the start, or to given positions [m] and velocities [m/s], tensors of shape (num_vertices, 3)."""
        self._follow_dtype(self.dtype)
        self._displacements, self._velocities = torch.zeros_like(self._rest), torch.zeros_like(self._rest)
        self._steps = 0  # done since
        if positions is not None:
            self._displacements = self._from_rest(positions)
        if velocities is not None:
            self._velocities = self._checked("velocities", velocities, self._rest.shape)
        self._choose_substeps()

    def set_fixed_vertices(self, vertex_indices: str | ArrayLike | None) -> None:
        """Fix other vertices from now on, where they are: a vertex set's name, indices or a mask; None fixes none."""
        if vertex_indices is not None:
            self.mesh.vertex_indices(vertex_indices)  # refuses what is none
        self.fixed_vertices, self._rollouts, self._scenes = vertex_indices, {}, {}

    @property
    def time(self) -> float:
        """Simulated time since the start or a reset [s]."""
        return self._steps * self.solver.dt

    def detach(self) -> None:
        """Cut the graph here and keep the motion: gradients of later losses stop at the present state (truncated
        backpropagation through time)."""
        self._displacements, self._velocities = self._displacements.detach(), self._velocities.detach()

    @uncompiled
    def step(self, external_forces: torch.Tensor | None = None) -> None:
        """Advance by dt; external_forces [N], shape (num_vertices, 3), with gradient."""
        if getattr(self.solver.method, "multistep", False):
            raise ValueError(
                f"step() starts afresh each time, which makes {self.solver.method.__name__}, a two-step method, backward "
                "Euler: use rollout(n), or method=ImplicitEulerSolver"
            )
        self._advance(1, external_forces)

    @uncompiled
    def rollout(
        self,
        num_steps: int,
        checkpoint_every: int | None = None,
        save_every: int | None = None,
        external_forces: torch.Tensor | None = None,
    ) -> TorchFrames:
        """num_steps steps as one autograd node; the frames (the start, then every save_every-th step, default the last).

        checkpoint_every: keep a state every so many steps and compute the rest again in the reverse sweep.
        external_forces [N]: (num_vertices, 3) for all steps, or (num_steps, num_vertices, 3), with gradient.
        """
        return self._advance(num_steps, external_forces, checkpoint_every, save_every)

    @property
    def last_rollout(self) -> Rollout:
        """The core's Rollout that ran last, for `verify`: its scene has the numbers that the simulator was made with."""
        if self._last is None:
            raise RuntimeError("nothing ran yet: call step() or rollout() first")
        return self._last

    def describe(self) -> str:
        """What is simulated, and how."""
        parts = [self._rollout(1, False, None, None).solver.describe(), self._scene(False).describe()]
        return "\n".join([*parts, f"computed on {runtime.arch_name()}, tensors on {self.device}"])

    def _checked(self, name: str, value, *shapes, like: torch.Tensor | None = None) -> torch.Tensor:
        """A floating point tensor of one of these shapes, brought to the dtype and device of `_rest`, or of another one, in
        the graph."""
        value = value if isinstance(value, torch.Tensor) else torch.as_tensor(value)
        if tuple(value.shape) not in [tuple(shape) for shape in shapes]:
            expected = " or ".join(str(tuple(shape)) for shape in shapes)
            raise ValueError(f"{name}: expected shape {expected}, got {tuple(value.shape)}")
        if not value.is_floating_point():
            raise ValueError(f"{name}: expected a floating point tensor such as {self._rest.dtype}, got {value.dtype}")
        return value.to(self._rest if like is None else like)

    def _inputs(self) -> dict[str, torch.Tensor]:
        """What a run takes besides state and forces, in the precision of the material, which may have been moved since."""
        inputs = dict(self.material.tensors(self.mesh))
        self._follow_dtype(next(iter(inputs.values())).dtype)
        inputs["gravity"] = self.solver.gravity_vector(self._rest)
        inputs["density"] = torch.as_tensor(self.density, dtype=self._rest.dtype, device=self.device)
        return inputs | (self._contact.tensors(self._rest) if self._contact else {})

    def _at_rest(self) -> torch.Tensor:
        """The mesh's vertices, in float64 where that would cost digits: far from the origin (origin.py)."""
        if self.dtype == torch.float32 and middle_far_part(self.mesh.vertices).any():
            return torch.tensor(np.array(self.mesh.vertices), device=self.device)
        return self._rest

    def _from_rest(self, positions: torch.Tensor) -> torch.Tensor:
        """Displacements of given positions, in the precision of `_rest`."""
        warn_of_rounding("positions", positions, self.mesh, "give them in float64")
        at_rest = self._at_rest()
        return (self._checked("positions", positions, at_rest.shape, like=at_rest) - at_rest).to(self._rest)

    def _follow_dtype(self, dtype: torch.dtype) -> None:
        """Take on a precision."""
        if dtype not in DTYPES.values():
            raise ValueError(f"the material's parameters must be float32 or float64, got {dtype}")
        if self._rest is not None and self._rest.dtype == dtype:
            return
        self._rollouts, self._scenes = {}, {}
        self._rest = torch.tensor(np.array(self.mesh.vertices), dtype=dtype, device=self.device)
        if hasattr(self, "_displacements"):
            self._displacements, self._velocities = (x.to(self._rest) for x in (self._displacements, self._velocities))

    def _advance(self, steps, external_forces, checkpoint_every=None, save_every=None) -> TorchFrames:
        inputs = self._inputs()
        tensors = {"initial_displacements": self._displacements, "initial_velocities": self._velocities} | inputs
        if external_forces is not None:
            shape = tuple(self._rest.shape)
            tensors["external_forces"] = self._checked("external_forces", external_forces, shape, (steps, *shape))
        rollout = self._rollout(steps, external_forces is not None, checkpoint_every, save_every)
        rollout.sweep.first_step = self._steps
        frames, self._last = rollout_frames(rollout, **tensors), rollout
        self._steps += steps
        self._displacements, self._velocities = frames.displacements[-1], frames.velocities[-1]
        return frames

    def _scene(self, with_forces: bool) -> Scene:
        if with_forces not in self._scenes:
            numbers = {name: x.detach().double().cpu().numpy() for name, x in self._inputs().items()}
            terms = [Gravity(numbers["gravity"]), *([self._contact.term()] if self._contact else []), *self._terms]
            if self.solver.damping < 1:
                terms.append(Drag(-math.log(self.solver.damping) / self.solver.dt))
            if with_forces:
                terms.append(ExternalForce(np.zeros((self.mesh.num_vertices, 3))))
            precision = next(name for name, dtype in DTYPES.items() if dtype == self.dtype)
            law, density = self.material.core(self.mesh), numbers["density"]
            self._scenes[with_forces] = Scene(self.mesh, law, density, terms, self.fixed_vertices, precision=precision)
        return self._scenes[with_forces]

    def _rollout(self, steps: int, with_forces: bool, checkpoint_every, save_every) -> Rollout:
        key = (steps, with_forces, checkpoint_every, save_every)
        if key not in self._rollouts:
            self.material.check_steps()
            solver = self._core_solver(self._scene(with_forces), self._substeps)
            if len(self._rollouts) >= self.kept_rollouts:
                self._rollouts.pop(next(iter(self._rollouts)))
            self._rollouts[key] = Rollout(solver, steps, save_every, checkpoint_every)
        return self._rollouts[key]

    def _core_solver(self, scene: Scene, substeps: int) -> Solver:
        options = dict(dt=self.solver.dt, substeps=substeps) | self.solver.options
        if self.solver.method.explicit:
            options["check_start"] = False  # the count is chosen at reset; a run that outgrows it raises
        return self.solver.method(scene, **options)

    def _contact_rigidity(self, scene: Scene, values: dict) -> float:
        """Stiffness over mass [1/s^2] of barriers that may act on a vertex: the stiffest, or, where they are forces, all."""
        derived, stiffest = scene.inputs.derive(values), []
        mass = np.where(derived.mass > 0, derived.mass, np.inf)
        for term in scene.terms:
            if isinstance(term, Obstacle | SelfContact):
                for plain, name in scene.input_names(term).items():
                    if plain in ("barrier_stiffness", "self_contact_stiffness"):
                        stiffest.append(float(values[name]) / mass.min())
                    elif plain == PER_AREA:
                        stiffest.append(float((values[name] * derived.surface / mass).max()))
        together = sum if self.solver.options.get("contact") == "force" else max
        return together(stiffest) if stiffest else 0.0

    def _choose_substeps(self) -> None:
        """What stability and contact ask for at the present numbers; the count only grows, so that losses stay smooth."""
        if not self.solver.method.explicit:
            return
        scene = self._scene(False)
        tensors = self._inputs() | {name: torch.as_tensor(x) for name, x in scene.input_tensors().items()}
        numbers = {name: x.detach().double().cpu().numpy() for name, x in tensors.items()}
        values = scene.inputs.values | scene.inputs.check(numbers)
        bound = stability.element_limit(scene, values).dt
        if self._ratio is None:
            solver = self._core_solver(scene, 1)
            self._ratio = solver.stable_dt(tight=True).dt / stability.element_limit(scene).dt
        omega2 = (2 / (self._ratio * bound)) ** 2
        omega2 += self._contact_rigidity(scene, values) * barrier.REFERENCE_CURVATURE
        needed = math.ceil(self.solver.dt * math.sqrt(omega2) / 2 / 0.8)
        if needed > self._substeps:
            if not isinstance(self._substeps, Chosen):
                warn(
                    f"dt = {self.solver.dt:g} s is divided into {needed} substeps (asked for at least "
                    f"{self.solver.substeps}), which stability and contact ask for"
                )
            self._substeps, self._rollouts = type(self._substeps)(needed), {}
