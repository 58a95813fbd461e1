"""Preconditioners for c M + d2E/du2: block Jacobi here, multigrid in multigrid.py.

Block Jacobi is a function of the present state alone, multigrid of that and of what goes with the states of a run
(`Following`), so that a run that is started again from a checkpoint takes the same steps.
"""

from functools import cached_property
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.inputs.rigid_start import nearest_rotation
from diffsim_ti.mechanics.energy.assembled import assemble
from diffsim_ti.mechanics.supports.free import Free, FreeBodies, FreeDirections, mask_of
from diffsim_ti.runtime import kernels_of
from diffsim_ti.solvers.implicit.cg_kernels import CGKernels
from diffsim_ti.solvers.implicit.device_cg import DeviceCG
from diffsim_ti.solvers.implicit.factorised import Effort


class Preconditioner:
    """What is known of a preconditioner of a potential's Hessian; `begin` forgets it, so that passes do not depend on those
    before them: the products spent; given_up, whether it was too slow; unfit, whether it was not positive definite;
    has_warned, whether that was said."""

    spent, given_up, unfit, has_warned = 0, False, False, False
    quick = 1  # products with multigrid take so many times as long
    rounds = None  # of Newton's method with it (rounds.py)
    couples = False  # whether `follow` brings contact of surfaces in each round

    def begin(self) -> None:
        self.spent, self.given_up, self.unfit = 0, False, False

    def learn(self, residual: float, iterations: int) -> None:
        """What a linear solve took, to a relative residual."""

    def follow(self, u: np.ndarray, met: bool = False) -> None:
        """What `update` makes anew now and then, before what it does each time."""

    def update(self, u: np.ndarray, met: bool = False) -> None:
        """Adapt to the displacement at which the potential is placed; met: whether its contact blocks are there."""

    def updating(self) -> tuple[list, object]:
        """(what `update` does, as [(kernel, records, numbers)] of `Repeated`; whose `hard` is not zero where a vertex needs
        the host all the same); nothing where that is needed anyway."""
        return [], None

    @property
    def effort(self) -> Effort:
        """Of the factorisation that takes its place."""
        return Effort.of(self.potential.arrays.mesh)

    @property
    def patience(self) -> int:
        """Products in which it has to be enough."""
        return self.quick * self.effort.patience


class BlockJacobi(Preconditioner):
    """The inverse 3x3 diagonal blocks; blocks that are not positive definite take |eigenvalues|.

    size: of the diagonal at rest [N/m], to which what is all but zero is raised.
    """

    quick = 3
    _launch = None

    def __init__(self, potential, mass: np.ndarray, free: Free, size: np.ndarray | float, parallel: bool = True):
        self.potential, self.mass, self.free, self.least = potential, mass, free, 1e-6 * (size + mass)
        self.solver = DeviceCG(potential, None, free, parallel)

    def update(self, u: np.ndarray, met: bool = False) -> None:
        if self._is_found_on_device():
            return
        D = self.potential.blocks() + self.mass[:, :, None] * np.eye(3)
        if isinstance(self.free, FreeDirections):
            D = self.free.around(D)
            D[self.free.partly_fixed] += (
                self.free.sliding_supports * (size_of(D[self.free.partly_fixed]) / 3)[:, None, None]
            )
        self._inverse = self._inverted(0.5 * (D + np.swapaxes(D, 1, 2)))
        if isinstance(self.free, FreeDirections):
            self._inverse = self.free.around(self._inverse)
        if not isinstance(self.free, FreeBodies):
            self.solver.put_inverse(self._inverse)

    @cached_property
    def _on_device(self) -> tuple | None:
        """(kernel, records) that invert the blocks that the device has found; None where the host has a part in them."""
        a, p, solver, n = self.potential.arrays, self.potential, self.solver, len(self.mass)
        if not isinstance(self.free, np.ndarray) or a.points > 1 or a.patches is not None or p.hosts:
            return None
        kernels = kernels_of(CGKernels, a.precision, solver.precision, solver.parallel and not a.by_scene, False, False)
        kind = runtime.PRECISIONS[solver.precision]
        body = SimpleNamespace(hard=runtime.array(ti.i32, n), mass=runtime.array(kind, n), least=runtime.array(kind, n))
        runtime.fill(body.mass, self.mass[:, 0])
        runtime.fill(body.least, np.broadcast_to(self.least, (n, 1))[:, 0])
        return kernels.invert, dict(cg=solver, body=body, out=p.block_arrays)

    def _is_found_on_device(self) -> bool:
        """Whether the inverse is there; not where a block is not positive definite."""
        if self._on_device is None:
            return False
        kernel, records = self._on_device
        self._launch, self._inverse = self._launch or kernel.bind(**records), None
        self.potential.find_blocks()
        self._launch(nodes=len(self.mass))
        return not np.count_nonzero(runtime.look(records["body"].hard))

    def updating(self) -> tuple[list, object]:
        if self._on_device is None:
            return [], None
        (invert, records), p, pairs = self._on_device, self.potential, self.potential.pairs
        own = [(p.of_one.blocks, dict(scene=p.arrays, pass_=p, at=p, out=p.block_arrays), None)]
        own += pairs.adding_blocks(p.u, p.block_arrays.blocks) if pairs else []
        return [*own, (invert, records, None)], records["body"]

    def _inverted(self, D: np.ndarray) -> np.ndarray:
        least = np.broadcast_to(self.least, (len(D), 1))
        try:
            np.linalg.cholesky(D - least[:, :, None] * np.eye(3))
            return np.linalg.inv(D) * mask_of(self.free)[:, :, None]
        except np.linalg.LinAlgError:  # some are not positive definite
            values, vectors = np.linalg.eigh(D)
        values = np.maximum(np.abs(values), least)
        inverse = np.divide(mask_of(self.free), values, out=np.zeros_like(values), where=values > 0)
        return np.matmul(vectors * inverse[:, None, :], np.swapaxes(vectors, 1, 2))

    def __call__(self, r: np.ndarray) -> np.ndarray:
        if self._inverse is None:
            self._inverse = np.moveaxis(runtime.fetch(self.solver.inverse), 0, 2).astype(np.float64)
        return np.einsum("ijk,ik->ij", self._inverse, r)


class BodyBlocks(BlockJacobi):
    """The same, and the inverse of d2E/dq2 of each set that moves by few numbers q: of the stress of the body at rest, with
    inertia, contact and host forces as they are; where its basis is of each component turned with it, as in multigrid.py.
    Of sets that do not deform q are shifts and turns (mechanics/reduced/rigid_sets.py), whose part of the body at rest turns
    with them, too. What ties glue takes the blocks of its vertices."""

    def __init__(self, potential, mass: np.ndarray, free: Free, size: np.ndarray, parallel: bool = True):
        super().__init__(potential, mass, free, size, parallel)
        with potential.at_rest():
            potential.blocks()
            K = assemble(potential, np.zeros((len(mass), 1)), np.ones((len(mass), 1)))[0].tocsr()
            soft = [(body, body.fields()) for body in free.reduced.bodies if body.kind not in ("rigid", "tie")]
            stiff = [(own, own.fields()) for own in free.rigid.sets]
            self._at_rest = [(body, _reduced(K, body.vertices, fields)) for body, fields in soft]
            self._rigid_at_rest = [(own, _reduced(K, own.vertices, fields)) for own, fields in stiff]

    @property
    def patience(self) -> int:
        """Where there are only ties the factorisation takes its place, else nothing does."""
        return super().patience if self.free.elimination is not None else 10**9

    def update(self, u: np.ndarray, met: bool = False) -> None:
        super().update(u)
        contact, rest, self._bodies = self.potential.contact_blocks(), self.potential.arrays.values.rest, []
        self._rigid = [(own, self._inverse_of(own, G, contact)) for own, G in self._rigid_at_rest]
        for body, G in self._at_rest:
            own, n = body.vertices, body.count
            if body.per_component:
                R, m = nearest_rotation(body.apart(rest + u).T @ body.apart(rest)), n // 3
                G = np.einsum("ia,jakb,lb->jikl", R, G.reshape(m, 3, m, 3), R, optimize=True).reshape(n, n)
            self._bodies.append((body, self._inverse_with(G, own, body.fields(), contact)))

    def _inverse_with(
        self, G: np.ndarray, own: np.ndarray, fields: np.ndarray, contact: np.ndarray | None
    ) -> np.ndarray:
        """Of G with inertia and contact of the vertices, without what is negative."""
        blocks = self.mass[own, :, None] * np.eye(3) + (0.0 if contact is None else contact[own])
        G = G + np.tensordot(fields, np.matmul(blocks, fields), ((0, 1), (0, 1)))
        values, vectors = np.linalg.eigh(0.5 * (G + G.T))
        values = np.maximum(np.abs(values), 1e-12 * np.abs(values).max() + self.least[own].min())
        return (vectors / values) @ vectors.T

    def _inverse_of(self, own, G: np.ndarray, contact: np.ndarray | None) -> np.ndarray:
        """Of a set that does not deform."""
        R = own.rotation()
        G = np.einsum("ia,jakb,lb->jikl", R, G.reshape(2, 3, 2, 3), R).reshape(6, 6)
        G[3:, 3:] += own.stiffness_of_turns()
        return self._inverse_with(G, own.vertices, own.fields(), contact)

    def __call__(self, r: np.ndarray) -> np.ndarray:
        out = super().__call__(r)
        for body, inverse in self._bodies:
            q = body.numbers(r)
            out[body.vertices] = body.motion((inverse @ q.ravel()).reshape(q.shape))
        for body in self.free.reduced.bodies:
            if body.kind == "tie":  # of what its vertices do each by itself, what they can do together
                out[body.vertices] = body.motion(body.numbers(out))
        for own, inverse in self._rigid:
            fields = own.fields()
            out[own.vertices] = fields @ (inverse @ np.tensordot(fields, r[own.vertices], ((0, 1), (0, 1))))
        return out


def _reduced(K, vertices: np.ndarray, fields: np.ndarray) -> np.ndarray:
    """B^T K B, shape (count, count), for fields B of some vertices, shape (k, 3, count)."""
    rows = (3 * vertices[:, None] + np.arange(3)).ravel()
    B = fields.reshape(len(rows), -1)
    G = B.T @ (K[rows][:, rows] @ B)
    return 0.5 * (G + G.T)


def size_of(blocks: np.ndarray) -> np.ndarray:
    """Sum of the sizes of the diagonal of each block."""
    return np.abs(np.diagonal(blocks, axis1=1, axis2=2)).sum(1)
