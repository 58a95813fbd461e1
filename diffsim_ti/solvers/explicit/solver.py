"""What the explicit solvers share: a chain of kick-drift passes (kick_drift.py), forward, tangent and reverse."""

from abc import abstractmethod
from dataclasses import dataclass

from diffsim_ti import runtime
from diffsim_ti.inputs import Derived
from diffsim_ti.solvers.explicit.kick_drift import kick_drift_kernels
from diffsim_ti.solvers.solver import Solver
from diffsim_ti.state.workspace import Workspace


@dataclass(frozen=True)
class Weights:
    """Numbers of a pass (kick_drift.py) and their derivatives by the drag rate."""

    lag0: int
    lag1: int
    pre: float
    post: float
    alpha: float
    decay: float
    alpha_by_rate: float = 0.0
    decay_by_rate: float = 0.0


class ExplicitSolver(Solver):
    """Explicit steps: each costs one force evaluation, and dt may not exceed 2 / omega_max."""

    explicit = True
    # tetrahedra up to which one thread beats two (measured): starting two costs 20 us per loop, and Taichi cuts loops
    # into pieces of at least 512 items, which are blocks of eight where the law works in lanes
    serial_limit = 3_000
    serial_limit_in_lanes = 10_000

    @abstractmethod
    def groups(self, first: int, last: int, num_passes: int, rate: float) -> list[tuple[int, int, Weights]]:
        """Passes first .. last - 1 as runs (first, count, weights) of equal weights."""

    @abstractmethod
    def num_passes(self, steps: int) -> int:
        """Passes that `steps` steps take."""

    def workspace(self, derived: Derived) -> "ExplicitWorkspace":
        """Arrays and bound launches for runs of this solver."""
        return ExplicitWorkspace(self, derived)

    def adjoint(self, workspace, density: bool, shape: bool):
        """The reverse sweep of a run."""
        from diffsim_ti.solvers.explicit.adjoint import ExplicitAdjoint

        return ExplicitAdjoint(workspace, density, shape)

    def tangent(self, workspace, dots: Derived):
        """The tangent of a run."""
        from diffsim_ti.solvers.explicit.adjoint import ExplicitTangent

        return ExplicitTangent(workspace, dots)


class ExplicitWorkspace(Workspace):
    """A run of an explicit solver: one launch for many passes, or one per pass on all threads."""

    work_per_launch = 4_000_000  # tetrahedra x passes in one launch: a tenth of a second, so that Ctrl-C is heard

    def _launch(self, name: str, kernel, *arrays) -> runtime.Launch:
        if name not in self._launches:
            self._launches[name] = runtime.Launch(kernel, *arrays, vectorized=self.arrays.in_lanes)
        return self._launches[name]

    def advance(self, first: int, last: int, num_passes: int, save_every: int = 0, base: int | None = None) -> None:
        """Passes first .. last - 1 from the current state; or recorded: slot j - base holds the state before pass j."""
        a, recording = self.arrays, base is not None
        history = self.record if recording else self.state
        kernels = kick_drift_kernels(a.law, a.features(), self.parallel, a.in_lanes)
        launch = self._launch(
            f"step {recording}",
            kernels.step,
            *a.topology(),
            a.force_slot,
            a.motion_slot,
            a.forces,
            a.motion,
            a.anchor,
            a.path,
            a.corner,
            history.u,
            history.v,
            history.f,
            *self.frames,
            self.watch.array,
        )
        stride, substeps, inverse_dt = int(recording), self.solver.substeps, 1 / self.solver.dt
        pairs, base = self.pairs, base or 0
        if pairs:
            pairs.ensure(history.u, (first - base) * stride)
        chunk = 1 if self.parallel or pairs else max(1, self.work_per_launch // a.num_tetrahedra)
        for start, count, w in self.solver.groups(first, last, num_passes, self.rate):
            for j in range(start, start + count, chunk):
                if pairs:
                    pairs.forces(history.u, (j - base) * stride, a.corner)
                launch(
                    a.num_items,
                    a.num_vertices,
                    j,
                    min(chunk, start + count - j),
                    base,
                    stride,
                    substeps,
                    save_every,
                    w.lag0,
                    w.lag1,
                    w.pre,
                    w.post,
                    w.alpha,
                    w.decay,
                    inverse_dt,
                    self.solver.substep,
                )
                if pairs:
                    pairs.check_pass(history.u, (j + 1 - base) * stride, self.solver.substep)
