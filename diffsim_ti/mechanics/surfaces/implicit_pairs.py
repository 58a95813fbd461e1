"""Contact of a surface with itself in implicit solvers: Hessian, and how far a step may go."""

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.stress.projection import summed
from diffsim_ti.mechanics.surfaces.buffers import Parts, whole
from diffsim_ti.mechanics.surfaces.hessian_kernels import HessianKernels
from diffsim_ti.mechanics.surfaces.lagged_friction import LaggedFriction
from diffsim_ti.mechanics.surfaces.listed_pair import SAFE
from diffsim_ti.mechanics.surfaces.surface_pairs import SurfacePairs, Tunnelling
from diffsim_ti.runtime import kernels_of


class ImplicitPairs(SurfacePairs):
    """Pairs of a scene in Newton's method, where displacements come in tries, not in passes.

    After `place`, the list, the planes, the energies and the last corners of `arrays.corner` are those of that place.
    Lists of (kernel, records, numbers) are for rounds of Newton's method (solvers/implicit/rounds.py), too, and hold good
    until `version` is another; numbers follow the list.
    """

    friction_kind = LaggedFriction
    longest_march = 200  # lists made along one step
    least_slack = 0.5  # lists are then seldom made anew within a pass
    blocked: np.ndarray | None = None  # corners of the pair that stopped the last march
    _ahead: np.ndarray | float = 0.0  # how far vertices are expected to go in a pass [m]
    asks = False  # whether the host has to look at the way of a step
    # how many times its diagonal blocks a matrix is at most: the square of a sum over so many corners of a pair
    overlap = 4

    def __init__(self, arrays, parallel: bool):
        super().__init__(arrays, parallel)
        self.hessian = kernels_of(HessianKernels, arrays.precision, self.first, parallel)
        self.forces_kernel = self.hessian.place
        self.step = runtime.array(self.kernels.vec4, 1, arrays.num_vertices)
        self.next = runtime.array(self.kernels.vec4, 1, arrays.num_vertices)
        self.sizes |= dict(slot=0, exact=0, most=1.0, anew=0, **self.sizes_of_motion)

    @property
    def inner(self) -> "ImplicitPairs":
        """What has the list (curved_pairs.py)."""
        return self

    @property
    def version(self) -> tuple:
        """Of the arrays."""
        return self.list, self.list.buffers.renewals

    @property
    def num_energies(self) -> int:
        """Of `energy`: those of pairs, and of friction behind them."""
        return self.list.count + (self.friction.count if self.friction else 0)

    def build(self, u, slot: int, wanted=0.0, needed=0.0) -> None:
        super().build(u, slot, wanted, needed)
        count, take = self.list.count, self.list.buffers.take
        self.acting, self.share = take("acting", ti.i32, 4 * count), take("shares", self.kernels.fp, count)
        self.nearest, self.inverse = (take(name, self.kernels.vec4, count) for name in ("nearest", "inverses"))
        self.sizes["lost"] = 0.5 * self.least_width
        self.make_room()

    def make_room(self) -> None:
        """For the energies of friction."""
        self.energy = self.list.buffers.take("energies", self.kernels.fp, self.num_energies)

    def begin(self, u: np.ndarray, ahead: np.ndarray | None = None) -> None:
        """A new pass from u: from here on all is a function of u, and of how far `ahead` [m] it is expected to go, whatever
        came before; None: as before."""
        self.fresh = False
        if ahead is not None:
            self._ahead = 1.5 * self.travel(ahead[self.mesh.surface_vertices])
        runtime.fill(self.next, u[None])
        self.build(self.next, 0, wanted=self._ahead)

    def place(self, u) -> None:
        """Go to the displacements u[0]."""
        if self.friction:
            self.friction.settle()
        self.reach(u)
        self.launch(self.placing(u))

    def reach(self, u) -> None:
        """Have a list that holds at u[0]."""
        self.ensure(u, 0)

    def placing(self, u) -> Parts:
        """What finds energies and forces of contact and friction at u[0], where the list holds."""
        own = [self.prepared(self.hessian.place, dict(u=u, out=self.a.corner))]
        return own + (self.friction.measuring(u) if self.friction else [])

    def energies(self) -> np.ndarray:
        """Of each pair, and of each pair's friction [J]."""
        return runtime.fetch(self.energy)[: self.num_energies].astype(np.float64)

    def holding(self, u, w) -> Parts:
        """What finds whether the list holds at u[0], else flags[0] is 1; and whether planes keep all pairs apart on the step
        w[0] from where `place` has been, else flags[2] is 1."""
        return [self.prepared(self.motion.holds, dict(u=u)), self.prepared(self.hessian.clear, dict(w=w))]

    def turning(self, u, w) -> Parts:
        """What finds which friction a step w[0] from u[0] turns round."""
        return self.friction.turning(u, w) if self.friction else []

    def multiplying(self, u, w, convex: bool) -> Parts:
        """Change of the forces of contact and friction for changes w[0] of the positions, to the last corners of
        `arrays.corner`; convex: the convex part of contact alone."""
        kernel = self.hessian.convex_products if convex else self.hessian.products
        friction = self.friction.multiplying(w) if self.friction else []
        return [self.prepared(kernel, dict(u=u, w=w, out=self.a.corner)), *friction]

    def adding_blocks(self, u, out) -> Parts:
        """What adds the diagonal blocks of the Hessian's convex part and of friction's to rows 0..2 of `out`
        (mechanics/energy/kernels.py); where sizes say `anew`, puts them there."""
        friction = self.friction.adding_blocks(out) if self.friction else []
        return [self.prepared(self.hessian.blocks, dict(u=u, out=out)), *friction]

    def stiffness(self, u) -> tuple:
        """(Hessian of the convex part and of friction at u[0], where `place` has been, as a SciPy matrix of blocks [N/m];
        its diagonal blocks, as `adding_blocks` adds them)."""
        from scipy.sparse import bsr_matrix

        self.run(self.hessian.roots, dict(u=u))
        count, n = self.list.count, self.a.num_vertices
        c = whole(self.corner)[: 4 * count].reshape(-1, 4, 4)[..., :3].astype(np.float64)
        acts = np.flatnonzero(c.any((1, 2)))
        corners = [whole(self.list.pairs)[: 4 * count].reshape(-1, 4)[acts].astype(np.int64)]
        blocks = [c[acts][:, :, None, :, None] * c[acts][:, None, :, None, :]]
        if self.friction:
            corners.append(self.friction.corners.astype(np.int64))
            blocks.append(self.friction.stiffness())
        corners = np.concatenate(corners)
        places = (corners[:, :, None] * n + corners[:, None, :]).ravel()
        places, blocks = summed(places, np.concatenate(blocks).reshape(-1, 9))
        rows, columns, diagonal = places // n, places % n, np.zeros((n, 3, 3))
        diagonal[rows[rows == columns]] = blocks[rows == columns]
        start = np.searchsorted(rows, np.arange(n + 1))
        return bsr_matrix((blocks, columns, start), shape=(3 * n, 3 * n)), diagonal

    def safe_share(self, u: np.ndarray, step: np.ndarray, most: float = 1.0, placed: bool = False) -> float:
        """A share of the step, at most `most`, up to which no two primitives meet during the motion; close to the
        largest such share only where they are about to meet. Marches along the step, with a new list at each halt,
        unless the present one holds on all of it, or up to where two of it meet. placed: `place` was last at u."""
        travel = self.travel(step[self.mesh.surface_vertices])
        if not travel.any():
            return most
        runtime.fill(self.step, step[None])
        share, self.blocked, holds = 0.0, None, self._holds(u + most * step)
        here = self._holds(u)
        holds = holds and here
        placed = placed and holds
        if holds:  # `next` is at u
            if not placed:
                self.forces(self.next, 0, self.a.corner, exact=True)
            self.run(self.hessian.clear, dict(w=self.step), most=most)
            if not runtime.look(self.flags)[2]:
                return most
            placed = True
        for _ in range(self.longest_march):
            unlisted, old = np.inf, here and not holds
            if not holds:
                if not old:
                    runtime.fill(self.next, (u + share * step)[None])
                    self.build(self.next, 0, wanted=(most - share) * travel)
                gone = runtime.fetch_row(self.next, 0)[self.mesh.surface_vertices] - runtime.fetch(self.built)
                reach = runtime.fetch(self.list.slack)[:, :2].astype(np.float64) + 0.5 * SAFE * self.least_width
                reach -= self.travel(gone)
                unlisted = np.divide(reach, travel, out=np.full_like(travel, np.inf), where=travel > 0).min()
            if not placed:
                self.forces(self.next, 0, self.a.corner, exact=True)
            shares, placed, here = self._shares(most - share), False, False
            listed = shares.min(initial=np.inf)
            if old and not listed < unlisted:  # else a new one, whose slacks are no shorter, would say the same
                continue
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
        self.run(self.hessian.shares, dict(u=self.next, w=self.step), slot=0, most=most)
        return runtime.fetch(self.share)[: self.list.count].astype(np.float64)

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
