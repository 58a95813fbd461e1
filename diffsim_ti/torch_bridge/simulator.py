"""Control loops in torch's graph: one step after the other, of one scene or of a batch."""

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.batch import Batch
from diffsim_ti.common.checked import instance, whole
from diffsim_ti.common.public import Public
from diffsim_ti.inputs.step_values import StepValues
from diffsim_ti.outputs import Output
from diffsim_ti.rollout import Rollout
from diffsim_ti.solvers.solver import Solver
from diffsim_ti.terms import Robot
from diffsim_ti.torch_bridge.autograd import refuse_state, torch, uncompiled
from diffsim_ti.torch_bridge.rollout_node import rollout_frames
from diffsim_ti.torch_bridge.tensors import DTYPES

MOTION = "prescribed_motion"


class TorchSimulator(metaclass=Public):
    """Steps of a solver as nodes of torch's graph: a `Simulator` whose states are tensors.

    scenes: None for one scene, or how many of a `Batch`, whose states and, where they are given so, inputs have that axis
    in front. values: {name of an input: tensor or array} that hold in all steps, such as youngs_modulus or density, or until
    a step is given others; not of the start, of the rest shape or of what the scene has over time.
    outputs: what `outputs` has after each step, besides.

    positions, displacements [m] and velocities [m/s], shape (num_vertices, 3) or (scenes, num_vertices, 3), lead back to all
    tensors that steps were given, and to the start (`reset`). Each step is a run of one step, whose adjoint runs it again.
    Substeps that were left to the solver are settled by the first step.
    Raises ValueError for solvers and laws that remember more than a state, and for a motion by a `Pose`.

    >>> import diffsim_ti as ds
    >>> import torch
    >>> from diffsim_ti.diff_simulator import TorchSimulator
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> pull = ds.ExternalForce(torch.zeros(1, 3), vertices=[7], name="pull")
    >>> scene = ds.Scene(mesh, ds.StableNeoHookean(E=1e5, nu=0.3), terms=[pull], fixed="zmin", precision="f64")
    >>> simulator = TorchSimulator(ds.SemiImplicitSolver(scene, dt=0.01))
    >>> gain = torch.tensor(-50.0, dtype=torch.float64, requires_grad=True)
    >>> for _ in range(5):
    ...     simulator.step(**{"pull.forces": gain * (simulator.positions[7:8] - 1.1)})
    >>> simulator.positions[7].sum().backward()
    >>> print(f"{gain.grad:.1e}")
    -1.7e-06
    """

    def __init__(
        self,
        solver: Solver,
        scenes: int | None = None,
        values: Mapping | None = None,
        outputs: Output | Iterable[Output] = (),
    ):
        instance("TorchSimulator", "solver", solver, Solver, "a solver such as SemiImplicitSolver(scene)")
        self.scene, self.values, self.scenes = solver.scene, dict(values or {}), scenes
        afresh = "each step starts afresh; take rollout_frames(Rollout(solver, steps), ...) for a whole run"
        refuse_state(self.scene.law, "TorchSimulator", afresh)
        if getattr(solver, "multistep", False):
            raise ValueError(
                f"TorchSimulator: {type(solver).__name__} looks back two steps, and {afresh}, or ImplicitEulerSolver"
            )
        if self.scene.terms_of(Robot):
            raise ValueError(f"TorchSimulator: its states have no joints of robots: {afresh}")
        if self.scene.posed_supports:
            raise ValueError("TorchSimulator: a motion by a Pose counts from the start of a run; give displacements")
        self._run = Rollout(solver, 1, outputs=outputs)
        if scenes is not None:
            self._run = Batch(solver, 1, whole("scenes", scenes, 1), outputs=outputs)
        self._step_values = StepValues(self.scene.inputs, solver.dt, _joined, scenes)
        inputs, known = self.scene.inputs.at_step(0, solver.dt, {}), self.scene.inputs.values
        for name in self.values:
            remedy = "pass it to step" if name in inputs and inputs[name] is not known.get(name) else ""
            remedy = "pass it to reset" if name.startswith("initial_") else remedy
            if remedy := "make the scene with it" if name in ("rest_positions", "shape") else remedy:
                raise ValueError(f"TorchSimulator: values are numbers that hold in all steps, got {name}: {remedy}")
        for name, output in self._run.outputs.items():
            if output.cumulative:
                raise ValueError(f"TorchSimulator: {name} counts from the start of a run, and {afresh}")
        self.reset()

    @property
    def solver(self) -> Solver:
        """The solver, with the substeps that steps take."""
        return self._run.solver

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.step_count * self.solver.dt

    @property
    def step_inputs(self) -> tuple[str, ...]:
        """Names of the inputs that `step` takes."""
        return self._step_values.names

    @uncompiled
    def reset(self, positions: "torch.Tensor | None" = None, velocities: "torch.Tensor | None" = None) -> None:
        """Back to the start of the scene, or to given positions [m] and velocities [m/s], with their graphs."""
        self.step_count, self._set, self.outputs = 0, {}, {}
        known, dtype = self.scene.inputs.values, DTYPES[self.scene.precision]
        rest = torch.from_numpy(np.array(known["rest_positions"]))
        start, moving = (_tensor(known[f"initial_{name}"]) for name in ("positions", "velocities"))
        self.displacements = ((start if positions is None else positions).double() - rest).to(dtype)
        self.velocities = (moving if velocities is None else velocities).to(dtype)
        if self.scenes is not None:
            whole_shape = (self.scenes, *rest.shape)
            self.displacements, self.velocities = (x.expand(whole_shape) for x in (self.displacements, self.velocities))
        self._rest, self._begun = rest if self.scene.origin.any() else rest.to(dtype), self.displacements

    @property
    def positions(self) -> "torch.Tensor":
        """Positions [m], in the graph."""
        return self._rest + self.displacements

    def detach(self) -> None:
        """Cut the graph here and keep the motion: gradients of later losses stop at the present state."""
        self.displacements, self.velocities = self.displacements.detach(), self.velocities.detach()

    @uncompiled
    def step(self, **values: torch.Tensor | ArrayLike) -> None:
        """Advance by solver.dt, with values of inputs that can change in time as `Simulator.step` takes them, tensors or
        arrays; of a batch one for all scenes, or with the axis of scenes in front."""
        inputs, step = self.scene.inputs, self.step_count
        given = self._step_values.next(step, values, self._set)
        now = inputs.at_step(step, self.solver.dt, {n: x for n, x in given.items() if not isinstance(x, torch.Tensor)})
        timed = {name: now[name] for name in self._step_values.names if name in now} | given
        if MOTION in timed:  # counts from where a run begins
            held = self.scene.held
            timed[MOTION] = _tensor(timed[MOTION]) - (self.displacements - self._begun)[..., None, held, :].double()
        own = {name: x for name, x in timed.items() if name not in inputs.values or x is not inputs.values[name]}
        start = dict(initial_displacements=self.displacements, initial_velocities=self.velocities)
        frames = rollout_frames(self._run, **self.values | start | own)
        end = (slice(None), -1) if self.scenes is not None else -1
        self._set, self.step_count = given, step + 1
        self.displacements, self.velocities = frames["displacements"][end], frames["velocities"][end]
        names = (self._run if self.scenes is None else self._run.one).computed
        self.outputs = {name: frames[name][end] for name in names}


def _tensor(x) -> torch.Tensor:
    return x if isinstance(x, torch.Tensor) else torch.from_numpy(np.array(x))


def _joined(parts: list, axis: int) -> torch.Tensor:
    """Arrays or tensors, stacked."""
    tensors = [_tensor(x) for x in parts]
    like = next((x for x, given in zip(tensors, parts) if isinstance(given, torch.Tensor)), tensors[0])
    return torch.stack([x.to(like) for x in tensors], axis)
