"""Contact of a surface with itself in implicit solvers: Hessian, and how far a step may go."""

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.mechanics.surfaces.hessian_kernels import HessianKernels
from diffsim_ti.mechanics.surfaces.lagged_friction import LaggedFriction
from diffsim_ti.mechanics.surfaces.listed_pair import SAFE
from diffsim_ti.mechanics.surfaces.surface_pairs import SurfacePairs, Tunnelling
from diffsim_ti.runtime import kernels_of


class ImplicitPairs(SurfacePairs):
    """Pairs of a scene in Newton's method, where displacements come in tries, not in passes.

    After `place`, the list, the planes, the energies and the last corners of `arrays.corner` are those of that place.
    """

    friction_kind = LaggedFriction
    longest_march = 200  # lists made along one step
    blocked: np.ndarray | None = None  # corners of the pair that stopped the last march

    def __init__(self, arrays, parallel: bool):
        super().__init__(arrays, parallel)
        self.hessian = kernels_of(HessianKernels, arrays.precision, self.first, parallel)
        self.step = runtime.array(self.kernels.vec4, 1, arrays.num_vertices)
        self.next = runtime.array(self.kernels.vec4, 1, arrays.num_vertices)

    def begin(self, u: np.ndarray) -> None:
        """A new pass from u: from here on all is a function of u, whatever came before."""
        self.fresh = False
        runtime.fill(self.next, u[None])
        self.build(self.next, 0)

    def place(self, u) -> None:
        """Go to the displacements u[0]."""
        self.ensure(u, 0)
        self.forces(u, 0, self.a.corner)
        if self.friction:
            self.friction.leave()

    def energies(self) -> np.ndarray:
        """Energy of each pair [J]."""
        return runtime.fetch(self.energy)[: self.list.count].astype(np.float64)

    def hessian_product(self, u, w, convex: bool) -> None:
        """Change of the forces of contact and friction for changes w[0] of the positions, to the last corners of
        `arrays.corner`."""
        if convex:
            self.run(self.hessian.products, dict(u=u, w=w, out=self.a.corner), slot=0)
        else:
            self.product(u, 0, w, self.a.corner, has_planes=True)
        if self.friction:
            self.friction.add_product(u, w, self.a.corner)

    def add_blocks(self, u, out) -> None:
        """Add the diagonal blocks of the Hessian's convex part to rows 0..2 of `out` (mechanics/energy/kernels.py)."""
        self.run(self.hessian.blocks, dict(u=u, out=out), slot=0)

    def safe_share(self, u: np.ndarray, step: np.ndarray, most: float = 1.0) -> float:
        """A share of the step, at most `most`, up to which no two primitives meet during the motion; close to the
        largest such share only where they are about to meet. Marches along the step, with a new list at each halt,
        unless the present one holds on all of it."""
        travel = self.travel(step[self.mesh.surface_vertices])
        if not travel.any():
            return most
        runtime.fill(self.step, step[None])
        share, self.blocked, holds = 0.0, None, self._holds(u + most * step) and self._holds(u)
        for _ in range(self.longest_march):
            unlisted = np.inf
            if not holds:
                runtime.fill(self.next, (u + share * step)[None])
                self.build(self.next, 0, wanted=(most - share) * travel)
                reach = runtime.fetch(self.list.slack)[:, :2].astype(np.float64) + 0.5 * SAFE * self.least_width
                unlisted = np.divide(reach, travel, out=np.full_like(travel, np.inf), where=travel > 0).min()
            self.forces(self.next, 0, self.a.corner, exact=True)
            shares = self._shares(most - share)
            listed = shares.min(initial=np.inf)
            share += min(listed, unlisted)
            if share >= most:
                return most
            if listed < unlisted:
                self.blocked = runtime.fetch(self.list.pairs)[4 * int(shares.argmin()) :][:4]
                return share
        return share

    def _holds(self, u: np.ndarray) -> bool:
        """Whether the list holds at u, to where `next` goes."""
        runtime.fill(self.next, u[None])
        return self.holds(self.next, 0)

    def _shares(self, most: float) -> np.ndarray:
        """Of the step from `next` on, of each pair, where `forces` were exact."""
        out = self.list.buffers.take("shares", self.kernels.fp, self.list.count)
        self.run(self.hessian.shares, dict(u=self.next, w=self.step, out=out), slot=0, most=most)
        return runtime.fetch(out)[: self.list.count].astype(np.float64)

    def is_collision_free(self, u: np.ndarray, step: np.ndarray) -> bool:
        """Whether no two primitives meet on the motion from u to u + step; narrow gaps may pass for closed."""
        for _ in range(self.longest_march):
            share = self.safe_share(u, step)
            if share == 1 or share < 1e-3:
                return share == 1
            u, step = u + share * step, (1 - share) * step
        return False

    def check_end(self, u: np.ndarray, u_next: np.ndarray) -> None:
        """Raise Tunnelling unless nothing collides on the motion from u to u_next."""
        if not self.is_collision_free(u, u_next - u):
            self.fresh = False
            raise Tunnelling(
                "beyond the middle of a step, where its forces were taken, surfaces may have gone through each other: take "
                "a shorter step, or a solver whose steps end where forces are taken, ImplicitEulerSolver or BDF2Solver"
            )
