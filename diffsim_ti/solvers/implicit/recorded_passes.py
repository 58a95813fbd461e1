"""A recorded pass of an implicit run, with everything that its equation names."""

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.mechanics.supports.free import cleaned
from diffsim_ti.solvers.implicit.linear import Operator, solve
from diffsim_ti.solvers.implicit.multigrid import Following


class RecordedPasses:
    """What tangent and reverse sweep share: a recorded pass with everything that its equation names."""

    joints = None  # derivatives of those of robots (mechanics/joints/sweeps.py)
    transposed = False  # whether equations are solved with the transposed operator

    def __init__(self, workspace):
        self.ws = workspace
        self.eps = np.finfo(runtime.NUMPY[workspace.scene.precision]).eps
        self.tolerance = max(workspace.solver.tolerance, 20 * self.eps)

    def open(self, j: int, base: int) -> None:
        """Take pass j from the record, its first slot being the state before pass `base`."""
        ws = self.ws
        self.u, self.v, self.before = ws.read(ws.record, j - base)
        self.u_next = runtime.fetch_row(ws.record.u, j - base + 1)
        self.stage = stage = ws.solver.stage(ws.rate, self.before is None, j)
        self.x, self.y = ws.inertial(stage, self.u, self.v, self.before)
        self.u_star = self.u_next if stage.c0 == 1 else (self.u_next - (1 - stage.c0) * self.u) / stage.c0
        self.mass = ws.inertia_of(stage)
        if self.joints:
            self.joints.open(j - base)
            ws.joints.problem = ws.problem(j, stage, self.x, self.y)
        if ws.strains:
            ws.strains.hold(stage, self.u, self.before)
        ws.begin(j, stage, self.u, self.x)
        if self.joints:
            self.joints.hold()
        ws.rigid.begin(self.u, stage.c0)
        ws.potential.hold(ws.record, j - base)
        ws.potential.place(self.u_star)
        self.gamma = np.inf if stage.static else stage.gamma  # of velocities that host forces read
        self.operator = Operator(ws.potential, self.mass, ws.free, ws.newton.others, self.transposed)
        ws.take_multipliers(j, ws.potential.held_at)
        if ws.rigid:  # forces on them turn with them
            ws.newton.residual_of(ws.problem(j, stage, self.x, self.y))
        self._preconditioner, ws.preconditioner.following = None, ws.record.beside[j - base + 1] or Following()

    def solve(self, b: np.ndarray) -> np.ndarray:
        """A^-1 b, or A^-T b, on the free vertices, zero elsewhere; of sets that do not deform their motion, or of A^-T, what
        act on them."""
        rigid, transposed = self.ws.rigid, self.transposed
        b = rigid.motion_vjp(b * self.ws.linear) if transposed else b * self.ws.free
        if not np.count_nonzero(b):
            return b
        if self._preconditioner is None:
            self._preconditioner, _ = self.ws.preconditioner(self.mass)
            self._preconditioner.update(self.u_star)
        x = solve(self.operator, b, self._preconditioner, self.tolerance, self.eps, 20 * len(b))
        x = cleaned(self.ws.free, x)
        return x if transposed else rigid.motion(x)

    def weight(self, share: float) -> np.ndarray:
        """dR/dm of each vertex [m/s^2]: gravity less the acceleration."""
        a = self.ws.arrays
        return share * a.gravity_of(a.values) - self.acceleration

    @property
    def acceleration(self) -> np.ndarray:
        return self.stage.inertia * (self.u_star - self.x - self.stage.gamma * self.y)

    @property
    def v_star(self) -> np.ndarray:
        return (self.u_star - self.x) / self.stage.gamma
