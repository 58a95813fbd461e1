"""The potential energy of a displacement on the device, with its derivatives, as arrays of float64."""

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.solvers.implicit.patch_coupling import PatchCoupling
from diffsim_ti.solvers.implicit.potential_kernels import potential_kernels
from diffsim_ti.state.arrays import from_blocks


class Potential:
    """Elastic and contact energy E(u) of a scene; displacements and results are NumPy arrays, shape (num_vertices, 3).

    Everything after `place(u)` is at that displacement, which has the precision of the scene.
    """

    def __init__(self, arrays, tetrahedra: np.ndarray, parallel: bool, pairs=None):
        self.arrays, self.tetrahedra, self.pairs = arrays, tetrahedra, pairs
        a = arrays
        self.kernels = potential_kernels(a.law, a.features(), parallel, a.in_lanes)
        n, m = a.num_vertices, a.num_places
        self.u, self.w, self.y = (runtime.array(a.vector, 1, n) for _ in range(3))
        twins = a.features().contacts
        self.rubs = any(c.friction for c in twins)
        self.lag = runtime.array(a.vector, 2, n if self.rubs else 1)
        self.walls = runtime.array(a.vector, 3 * len(twins))
        self.per_gamma = 1.0
        self._size, self._contact = runtime.array(a.fp, n), runtime.array(a.fp, n)
        self._elastic, self._J = runtime.array(a.fp, m), runtime.array(a.fp, m)
        self._tangent, self._out, self._contact_blocks, self._pressure, self._coupling = None, None, None, None, None
        self.held_at = np.zeros((n, 3))
        sizes, common = (a.num_items, a.num_vertices), self.common()
        bind = lambda kernel, *more: self._bind(kernel, common, more, sizes)  # noqa: E731
        self._forces = bind(self.kernels.forces, a.corner, self.u, self.y, self._size)
        self._product = bind(self.kernels.product, a.corner, self.u, self.w, self.y)
        numbers = (a.tets, a.gradients, a.volumes, a.coefficients, a.parameters, a.rest, a.surface)
        more = (self.walls, self.lag, self.u, self._elastic, self._J, self._contact)
        self._energy = self._bind(self.kernels.energy, numbers, more, (m, n), False)

    def _bind(self, kernel, arrays, more, sizes, lanes=True):
        launch = runtime.Launch(kernel, *arrays, *more, vectorized=lanes and self.arrays.in_lanes)
        return lambda: launch(*sizes, self.per_gamma)

    def common(self) -> tuple:
        """Arguments that every kernel of tetrahedra and contact starts with."""
        return (*self.arrays.topology(), self.walls, self.lag)

    def begin(self, u: np.ndarray, x: np.ndarray, per_gamma: float, walls: np.ndarray) -> None:
        """What contact sees of a pass: its first displacement, x and 1 / gamma, and the obstacles (potential_kernels.py)."""
        self.per_gamma = per_gamma
        if self.rubs:
            runtime.fill(self.lag, np.stack([u, x]))
        if len(walls):
            runtime.fill(self.walls, walls)
        if self.pairs:
            self.pairs.begin(u)

    def place(self, u: np.ndarray) -> np.ndarray:
        """Go to displacement u [m]; returns it as the device holds it."""
        runtime.fill(self.u, u[None])
        self.held_at = runtime.fetch(self.u)[0].astype(np.float64)
        if self.pairs:
            self.pairs.place(self.u)
        return self.held_at

    def energy(self) -> tuple[float, float, np.ndarray]:
        """(energy [J], the sum of its absolute parts, J of each tetrahedron)."""
        self._energy()
        elastic, contact, J = (runtime.fetch(x).astype(np.float64) for x in (self._elastic, self._contact, self._J))
        if self.pairs:
            contact = np.concatenate([contact, self.pairs.energies()])
        return elastic.sum() + contact.sum(), np.abs(elastic).sum() + np.abs(contact).sum(), J

    def forces(self) -> tuple[np.ndarray, np.ndarray]:
        """(forces -dE/du [N], sum of the sizes of the forces that meet at each vertex)."""
        if self.pairs:
            self.pairs.forces(self.u, 0, self.arrays.corner)
        self._forces()
        return runtime.fetch(self.y)[0].astype(np.float64), runtime.fetch(self._size).astype(np.float64)

    def product(self, w: np.ndarray, convex: bool = False) -> np.ndarray:
        """d2E/du2 w [N]; `convex`: of contact between surfaces, only its convex part."""
        scale = np.abs(w).max() or 1.0  # f32 keeps its digits whatever the units
        runtime.fill(self.w, (w / scale)[None])
        if self.pairs:
            self.pairs.hessian_product(self.u, self.w, convex)
        self._product()
        return runtime.fetch(self.y)[0].astype(np.float64) * -scale

    def blocks(self) -> np.ndarray:
        """3x3 diagonal blocks of d2E/du2 [N/m], shape (num_vertices, 3, 3)."""
        a = self.arrays
        if self._tangent is None:
            self._tangent = runtime.array(a.lanes, 81 * a.num_blocks)
            self._columns = tuple(runtime.array(a.vector, *a.corner.shape) for _ in range(3))
            self._out = runtime.array(a.vector, 3, a.num_vertices) if self._out is None else self._out
            more = (*self._columns, self._tangent, self.u, self._out)
            self._blocks = self._bind(self.kernels.blocks, self.common(), more, (a.num_items, a.num_vertices))
        self._blocks()
        if self.pairs:
            self.pairs.add_blocks(self.u, self._out)
        blocks = np.swapaxes(runtime.fetch(self._out).astype(np.float64), 0, 1)
        return blocks if a.patches is None else blocks + self.coupling.diagonal(self.patch_gradients())

    @property
    def coupling(self) -> PatchCoupling:
        """What patches add to d2E/du2, by the numbers that are loaded."""
        if self._coupling is None or self._coupling[0] is not self.arrays.values:
            self._coupling = self.arrays.values, PatchCoupling(self.arrays, self.tetrahedra)
        return self._coupling[1]

    def patch_gradients(self) -> np.ndarray:
        """g of `coupling` at the present displacement."""
        a = self.arrays
        if self._pressure is None:
            self._pressure = self._bind(
                self.kernels.pressure_forces,
                (a.tets, a.gradients, a.volumes, a.coefficients),
                (self.u, a.corner),
                (a.num_items,),
            )
        self._pressure()
        return self.coupling.rows(runtime.fetch(a.corner)[: a.first_contact_corner].astype(np.float64))

    def tangents(self) -> np.ndarray:
        """d2psi/dF2 [Pa] of each tetrahedron, its patch's pressure held, where `blocks` was last called, shape
        (num_tetrahedra, 9, 9)."""
        return from_blocks(runtime.fetch(self._tangent), self.arrays.place, 81).reshape(-1, 9, 9)

    def contact_blocks(self) -> np.ndarray | None:
        """The part of contact in `blocks`; None without contacts."""
        if not (self.arrays.contacts or self.pairs):
            return None
        if self._contact_blocks is None:
            a = self.arrays
            self._out = runtime.array(a.vector, 3, a.num_vertices) if self._out is None else self._out
            arrays = (a.parameters, a.rest, a.surface, self.walls, self.lag, self.u, self._out)
            self._contact_blocks = self._bind(self.kernels.contact_blocks, arrays, (), (a.num_vertices,), False)
        self._contact_blocks()
        if self.pairs:
            self.pairs.add_blocks(self.u, self._out)
        return np.swapaxes(runtime.fetch(self._out).astype(np.float64), 0, 1)
