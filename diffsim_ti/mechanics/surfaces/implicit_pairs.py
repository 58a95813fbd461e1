"""Contact of a surface with itself in implicit solvers: Hessian, and how far a step may go."""

from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.surfaces.buffers import put, whole
from diffsim_ti.mechanics.surfaces.hessian_kernels import HessianKernels
from diffsim_ti.mechanics.surfaces.lagged_friction import LaggedFriction
from diffsim_ti.mechanics.surfaces.listed_pair import MARGIN, SAFE
from diffsim_ti.mechanics.surfaces.surface_pairs import SurfacePairs, Tunnelling
from diffsim_ti.runtime import kernels_of


class ImplicitPairs(SurfacePairs):
    """Pairs of a scene in Newton's method, where displacements come in tries, not in passes.

    After `place`, the list, the planes, the energies and the last corners of `arrays.corner` are those of that place.
    Products and diagonals go over the pairs alone that are nearer there than their width, in order: a list has many more.
    """

    friction_kind = LaggedFriction
    longest_march = 200  # lists made along one step
    blocked: np.ndarray | None = None  # corners of the pair that stopped the last march
    _ahead: np.ndarray | float = 0.0  # how far vertices are expected to go in a pass [m]
    _holds_on_way = False  # whether the list holds on all of the last step that was asked for its safe share

    def __init__(self, arrays, parallel: bool):
        super().__init__(arrays, parallel)
        self.hessian = kernels_of(HessianKernels, arrays.precision, self.first, parallel)
        self.step = runtime.array(self.kernels.vec4, 1, arrays.num_vertices)
        self.next = runtime.array(self.kernels.vec4, 1, arrays.num_vertices)
        self._places, self._acting = runtime.fetch(self.list.place), None

    def begin(self, u: np.ndarray, ahead: np.ndarray | None = None) -> None:
        """A new pass from u: from here on all is a function of u, and of how far `ahead` [m] it is expected to go, whatever
        came before; None: as before."""
        self.fresh = False
        if ahead is not None:
            self._ahead = 1.5 * self.travel(ahead[self.mesh.surface_vertices])
        runtime.fill(self.next, u[None])
        self.build(self.next, 0, wanted=self._ahead)

    def place(self, u, on_way: bool = False) -> None:
        """Go to the displacements u[0]; on_way: of the last step that was asked for its safe share."""
        if not (on_way and self._holds_on_way):
            self.ensure(u, 0)
        self.forces(u, 0, self.a.corner)
        self._acting = None
        if self.friction:
            self.friction.leave()

    def _of_acting(self) -> tuple[SimpleNamespace, dict]:
        """What takes the place of the list in kernels, with their numbers: the pairs that act where `place` has been."""
        if self._acting is None:
            k, count = self.list, self.list.count
            gaps, at_rest = (whole(x)[:count, 3] for x in (self.plane, self.rest_plane))
            widest = self.contacts.widths.max() if self.kinematic else self.width
            own = np.flatnonzero(gaps <= MARGIN * np.minimum(widest, 0.5 * at_rest))
            corners, num_vt = whole(k.pairs)[: 4 * count].reshape(-1, 4)[own], int(np.searchsorted(own, k.num_vt))
            meets = self._places[corners.ravel()]
            counts = np.bincount(meets, minlength=k.num_surface)
            parts = dict(
                pairs=(ti.i32, corners.ravel()),
                row=(ti.i32, np.concatenate([[0], np.cumsum(counts)])),
                corner_of=(ti.i32, np.argsort(meets, kind="stable")),
                scale=(self.kernels.fp, whole(k.scale)[own[num_vt:] - k.num_vt]),
                plane=(self.kernels.vec4, whole(self.plane)[own]),
                rest_plane=(self.kernels.vec4, whole(self.rest_plane)[own]),
            )
            if self.kinematic:
                parts["area"] = self.kernels.fp, whole(k.area)[own]
            arrays = {name: k.buffers.take(f"acting {name}", kind, len(x)) for name, (kind, x) in parts.items()}
            for name, (_, x) in parts.items():
                put(arrays[name], x)
            self._acting = SimpleNamespace(**arrays), dict(num_vt=num_vt, num_pairs=len(own))
        return self._acting

    def _of_those_acting(self, kernel, at: dict, **numbers) -> tuple:
        """A kernel of pairs on those that act."""
        acting, sizes = self._of_acting()
        return self.prepared(kernel, at, acting, slot=0, **numbers, **sizes)

    def energies(self) -> np.ndarray:
        """Energy of each pair [J]."""
        return runtime.fetch(self.energy)[: self.list.count].astype(np.float64)

    def multiplying(self, u, w, convex: bool) -> list[tuple]:
        """Change of the forces of contact and friction for changes w[0] of the positions, to the last corners of
        `arrays.corner`, as [(kernel, records, numbers)]; convex: the convex part of contact alone."""
        kernel, at, numbers = self.hessian.products, dict(u=u, w=w, out=self.a.corner), {}
        if not convex:
            kernel, (at, numbers) = self.kernels.products, self._of_product(u, w, self.a.corner, has_planes=True)
        friction = self.friction.multiplying(u, w, self.a.corner) if self.friction else []
        return [self._of_those_acting(kernel, at, **numbers), *friction]

    def add_blocks(self, u, out) -> None:
        """Add the diagonal blocks of the Hessian's convex part to rows 0..2 of `out` (mechanics/energy/kernels.py)."""
        self.launch([self._of_those_acting(self.hessian.blocks, dict(u=u, out=out))])

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
        self._holds_on_way = holds = holds and here
        placed = placed and holds
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
