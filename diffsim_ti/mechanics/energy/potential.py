"""The potential energy of a displacement on the device, with its derivatives, as arrays of float64."""

from contextlib import contextmanager, nullcontext
from functools import cached_property
from types import SimpleNamespace

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.inputs import StressPoints
from diffsim_ti.mechanics.energy.kernels import PotentialKernels
from diffsim_ti.mechanics.host_force import NONE
from diffsim_ti.mechanics.reduced.rigid_sets import RigidSets
from diffsim_ti.mechanics.stress.patched_tetrahedron import PatchCoupling
from diffsim_ti.runtime import Repeated, kernels_of, runs_on_cpu
from diffsim_ti.runtime.slots import copy_slot
from diffsim_ti.state.obstacle_poses import AT_BEGIN, AT_STAGE


@contextmanager
def replaced(array, numbers):
    """Other numbers in an array of the device, for a while."""
    kept = runtime.fetch(array)
    runtime.fill(array, numbers)
    try:
        yield
    finally:
        runtime.fill(array, kept)


class Potential:
    """Elastic and contact energy E(u) of a scene; displacements and results are NumPy arrays, shape (num_vertices, 3).

    Everything after `place(u)` is at that displacement, which has the precision of the scene.
    """

    def __init__(self, arrays, tetrahedra: np.ndarray, parallel: bool, pairs=None):
        self.arrays, self.tetrahedra, self.pairs, a = arrays, tetrahedra, pairs, arrays
        self.kernels = self.kernels_for(a.features(), parallel)
        n, m = a.num_vertices, a.num_places
        self.u, self.w, self.y = (runtime.array(a.vector, 1, n) for _ in range(3))  # displacement, direction, result
        self.has_friction = bool(a.features().rough)
        self.lag = runtime.array(a.vector, 2, n if self.has_friction else 1)  # as obstacles.py says, like the poses
        self.poses = runtime.array(a.vector, a.poses.size)
        self.per_gamma, self.held_at = 1.0, np.zeros((n, 3))
        self.size, self.contact = runtime.array(a.fp, n), runtime.array(a.fp, n)
        self.elastic, self.J = runtime.array(a.fp, a.points * m), runtime.array(a.fp, a.points * m)
        self._launches, self._coupling = {}, None  # made when first needed
        self._points = None
        self.z = arrays.law_states(1)  # the state of the law, held during a pass
        self.held = arrays.frozen_numbers()  # what the law measures rates from in a pass
        # [1/s], of changes in a pass; zero in static solves
        self.rate = runtime.array(a.fp, 1) if a.law.viscous else None
        self.hosts = NONE  # host forces that have an energy: set by whom a time is known
        self.joints = None  # of robots (mechanics/joints/joints.py): set by whom passes are known
        self.rigid: RigidSets | None = None  # sets that do not deform: set by whom passes are known

    kernels_kind = PotentialKernels

    def kernels_for(self, features, parallel: bool) -> PotentialKernels:
        """Those of a scene with such features."""
        return kernels_of(self.kernels_kind, self.arrays.law, features.of_state(), parallel, self.arrays.in_lanes)

    @property
    def surface_friction(self):
        """Friction of surfaces on each other (mechanics/surfaces/lagged_friction.py); None without."""
        return self.pairs.friction if self.pairs else None

    @property
    def _records(self) -> dict:
        return dict(scene=self.arrays, pass_=self, at=self, out=self)

    def launch(self, name: str, lanes: bool = True, **records) -> None:
        """Run a kernel at the present displacement; records: more arrays than the potential's own."""
        if name not in self._launches:
            own = self._records | records
            self._launches[name] = getattr(self.kernels, name).bind(lanes and self.arrays.in_vectors, **own)
        self._launches[name](**self.sizes())

    def sizes(self) -> dict:
        """The numbers that every kernel takes."""
        a = self.arrays
        sizes = dict(num_items=a.num_items, num_tetrahedra=a.num_places, num_vertices=a.num_vertices)
        sizes["per_gamma"] = self.per_gamma
        return sizes

    def begin(
        self, u: np.ndarray, x: np.ndarray, per_gamma: float, poses: np.ndarray, ahead=None, presses=True
    ) -> None:
        """What contact sees of a pass: its first displacement, x and 1 / gamma, and the obstacles (obstacles.py); ahead: the
        step [m] that it is expected to make; presses: whether surfaces press on each other there, for friction."""
        self.per_gamma = per_gamma
        if self.has_friction:
            runtime.fill(self.lag, np.stack([u, x]))
        if len(poses):
            runtime.fill(self.poses, poses)
        if self.joints:
            self.joints.u_n = u
        if self.pairs:
            self.pairs.follow(poses, AT_BEGIN)
            self.pairs.begin(u, np.zeros_like(u) if ahead is None else ahead)
        if self.surface_friction:
            self.surface_friction.begin(u, x, per_gamma, presses)
        if self.pairs:
            self.pairs.follow(poses, AT_STAGE)

    def place(self, u: np.ndarray) -> np.ndarray:
        """Go to displacement u [m]; returns it as the device holds it."""
        runtime.fill(self.u, u[None])
        return self.arrive()

    def arrive(self, pairs: bool = True) -> np.ndarray:
        """The same of a displacement that is on the device; pairs: theirs, too."""
        self.held_at = runtime.fetch_row(self.u, 0)
        if self.pairs and pairs:
            self.pairs.place(self.u)
        if self.rigid:
            self.rigid.place(self.held_at)
        if self.joints:
            self.joints.settle(self.held_at)
        return self.held_at

    def only(self, bodies: np.ndarray) -> None:
        """Of a batch, let what follows be of some bodies (batch/joined_potential.py)."""

    def hold(self, history, slot: int) -> None:
        """Hold the state that the law has in a slot."""
        if self.z is not None:
            copy_slot(history.z, slot, self.z, 0)

    @contextmanager
    def at_rest(self):
        """At rest, and then back to where it was."""
        growths = self.arrays.growths if self.arrays.values.growths is not None else None
        u, kept = self.held_at, [(x, runtime.fetch(x)) for x in (self.z, self.held, growths) if x is not None]
        try:
            with self.joints.still() if self.joints else nullcontext():
                self.place(np.zeros_like(u))
                if self.z is not None:
                    runtime.fill(self.z, self.arrays.initial_state_blocks())
                for array in (self.held, growths):  # of this pass, which others are not to depend on
                    if array is not None:
                        runtime.fill(array, 0)
                yield
        finally:
            self.place(u)
            for array, numbers in kept:
                runtime.fill(array, numbers)

    def without_viscosity(self):
        """What the law stores alone."""
        return nullcontext() if self.rate is None else replaced(self.rate, 0)

    @contextmanager
    def without_friction(self):
        """What has a potential in the state alone, for friction has one in a pass."""
        a = self.arrays
        rough = [first + force.index.friction for force, first, _ in a.obstacles if force.friction]
        if not (rough or self.surface_friction):
            yield
            return
        smooth = runtime.fetch(a.parameters).copy()
        smooth[rough] = 0
        friction = self.surface_friction.without() if self.surface_friction else nullcontext()
        with replaced(a.parameters, smooth), friction:
            yield

    def energy(self) -> tuple[float, np.ndarray]:
        """(energy [J], J at each point)."""
        self.launch("energy", lanes=False)
        elastic, contact, J = (runtime.fetch(x).astype(np.float64) for x in (self.elastic, self.contact, self.J))
        of_pairs = self.pairs.energies() if self.pairs else np.zeros(0)
        return elastic.sum() + np.concatenate([contact, of_pairs, self.energies_beside()]).sum(), J

    def energies_beside(self) -> np.ndarray:
        """Those from the host and of joints [J]."""
        of_joints = self.joints.energies() if self.joints else np.zeros(0)
        return np.concatenate([self.hosts.energies(self.held_at), of_joints])

    def forces(self) -> tuple[np.ndarray, np.ndarray]:
        """(forces -dE/du [N], sum of the sizes of the forces that meet at each vertex)."""
        if self.pairs:
            self.pairs.launch(self.pairs.placing(self.u))
        self.launch("forces")
        forces, sizes = runtime.fetch_row(self.y, 0), runtime.fetch(self.size).astype(np.float64)
        return forces + self.hosts.forces(self.held_at), sizes + self.hosts.sizes(self.held_at)

    def product(self, w: np.ndarray, convex: bool = False) -> np.ndarray:
        """d2E/du2 w [N]; `convex`: of contact between surfaces, only its convex part."""
        y = self.product_of_body(w, convex)
        return y - self.joints.product(w) if self.joints else y

    def product_of_body(self, w: np.ndarray, convex: bool = False) -> np.ndarray:
        """The same while joints of robots stay where they are."""
        scale = np.abs(w).max() or 1.0  # f32 keeps its digits whatever the units
        runtime.fill(self.w, (w / scale)[None])
        self.multiply(convex)
        y = runtime.fetch(self.y)[0].astype(np.float64) * -scale
        return y + self.hosts.product(self.held_at, w, convex) if self.hosts else y

    def multiply(self, convex: bool = False) -> None:
        """y = -d2E/du2 w on the device, without host forces."""
        if self.pairs:
            self.pairs.launch(self.pairs.multiplying(self.u, self.w, convex))
        self.launch("product")

    def multiplying(self, convex: bool = False) -> list[tuple]:
        """`multiply` where the potential stands, as [(kernel, records, numbers)]; the last takes `sizes`."""
        own = self.pairs.multiplying(self.u, self.w, convex) if self.pairs else []
        return [*own, (self.of_one.product, self._records, None)]

    @property
    def of_one(self) -> PotentialKernels:
        """Those that `repeated` takes; of a batch they are of one body."""
        return self.kernels

    def repeated(self, name: str, groups: list[list], parallel: bool, vectorized: bool = True) -> Repeated:
        """Kernels that see the body, as one."""
        return Repeated(name, groups, parallel, vectorized and runs_on_cpu())

    def find_blocks(self) -> None:
        """`blocks` on the device, without host forces, ten nodes and patches."""
        self.launch("blocks", out=self.block_arrays)
        if self.pairs:
            self.pairs.launch(self.pairs.adding_blocks(self.u, self.block_arrays.blocks))

    def blocks(self) -> np.ndarray:
        """3x3 diagonal blocks of d2E/du2 [N/m], shape (num_vertices, 3, 3)."""
        a = self.arrays
        self.find_blocks()
        blocks = np.swapaxes(runtime.fetch(self.block_arrays.blocks).astype(np.float64), 0, 1)
        blocks = blocks + self.hosts.blocks(self.held_at)
        if a.points > 1:
            blocks = blocks + self._element_blocks()
        return blocks if a.patches is None else blocks + self.coupling.diagonal(self.patch_gradients())

    def _element_blocks(self) -> np.ndarray:
        """The part of tetrahedra of ten nodes in `blocks`: sum V grad N_a . d2psi/dF2 . grad N_a."""
        nodes, N, volumes = self.stress_points
        C = self.tangents().reshape(-1, 3, 3, 3, 3)
        out = np.zeros((self.arrays.num_vertices, 3, 3))
        for a in range(nodes.shape[1]):
            own = np.einsum("pijkl,pj,pl,p->pik", C, N[:, a], N[:, a], volumes, optimize=True)
            np.add.at(out, nodes[:, a], own)
        return out

    @property
    def stress_points(self) -> StressPoints:
        """Of the rest shape that is loaded; without volumes where there is no stress."""
        a = self.arrays
        if self._points is None or self._points[0] is not a.values:
            points = StressPoints.of(a.mesh, a.values)
            self._points = a.values, StressPoints(points.nodes, points.gradients, a.with_stress(points.volumes))
        return self._points[1]

    @cached_property
    def block_arrays(self) -> SimpleNamespace:
        a = self.arrays
        corners = runtime.array(a.vector, 3 * a.corner.shape[0])
        room = 81 * a.points * a.num_blocks
        tangent, blocks = runtime.array(a.lanes, room), runtime.array(a.vector, 3, a.num_vertices)
        return SimpleNamespace(tangent=tangent, blocks=blocks, corners=corners)

    @cached_property
    def barriers(self) -> SimpleNamespace:
        return SimpleNamespace(blocks=runtime.array(self.arrays.vector, 3, self.arrays.num_vertices))

    @property
    def coupling(self) -> PatchCoupling:
        """What patches add to d2E/du2, by the numbers that are loaded."""
        if self._coupling is None or self._coupling[0] is not self.arrays.values:
            self._coupling = self.arrays.values, PatchCoupling(self.arrays)
        return self._coupling[1]

    def patch_gradients(self) -> np.ndarray:
        """g of `coupling` at the present displacement."""
        a = self.arrays
        self.launch("pressure_forces")
        return self.coupling.rows(runtime.fetch(a.corner)[: a.first_contact_corner].astype(np.float64))

    def tangents(self) -> np.ndarray:
        """d2psi/dF2 [Pa] at each point, its patch's pressure frozen, where `blocks` was last called, shape (points, 9,
        9)."""
        a = self.arrays
        return a.from_blocks(runtime.fetch(self.block_arrays.tangent), 81 * a.points).reshape(-1, 9, 9)

    def tangent_chunks(self, size: int):
        """(slice, `tangents` of it) for so many tetrahedra after the other, which caches hold."""
        a, source = self.arrays, runtime.view(self.block_arrays.tangent)
        source = runtime.fetch(self.block_arrays.tangent) if source is None else source
        for begin in range(0, a.num_tetrahedra, size):
            part = slice(begin, min(begin + size, a.num_tetrahedra))
            yield part, a.from_blocks(source, 81 * a.points, part).reshape(-1, 9, 9)

    def contact_product(self, w: np.ndarray) -> np.ndarray:
        """The part of contact and of host forces in `product`; of obstacles at vertices by their blocks."""
        a, y = self.arrays, np.zeros_like(w)
        runtime.fill(self.w, w[None])
        if a.contacts:
            y += np.einsum("kij,kj->ki", self.obstacle_blocks(), w)
        if self.pairs:
            self.pairs.launch(self.pairs.multiplying(self.u, self.w, False))
            y[a.mesh.surface_vertices] -= runtime.fetch(a.corner)[a.first_contact_corner :][
                : len(a.mesh.surface_vertices)
            ]
        return y + self.hosts.product(self.held_at, w) if self.hosts else y

    def contact_blocks(self) -> np.ndarray | None:
        """The part of contact and of host forces in `blocks`; None without."""
        on_host = self.hosts.blocks(self.held_at) if self.hosts else None
        if not (self.arrays.contacts or self.pairs):
            return on_host
        self._find_contact_blocks()
        blocks = np.swapaxes(runtime.fetch(self.barriers.blocks).astype(np.float64), 0, 1)
        return blocks if on_host is None else blocks + on_host

    def put_contact_blocks(self) -> None:
        """All of them, on the device."""
        self._find_contact_blocks()
        if self.hosts:
            blocks = np.swapaxes(self.hosts.blocks(self.held_at), 0, 1)
            runtime.fill(self.barriers.blocks, runtime.fetch(self.barriers.blocks) + blocks)

    def _find_contact_blocks(self) -> None:
        """Those of obstacles at vertices and of pairs."""
        self.launch("contact_blocks", lanes=False, out=self.barriers)
        if self.pairs:
            self.pairs.launch(self.pairs.adding_blocks(self.u, self.barriers.blocks))

    def obstacle_blocks(self, met: bool = False) -> np.ndarray:
        """The part of obstacles at vertices in `blocks`; met: whether `put_contact_blocks` was called here."""
        if not met or self.pairs or self.hosts:
            self.launch("contact_blocks", lanes=False, out=self.barriers)
        return np.swapaxes(runtime.fetch(self.barriers.blocks).astype(np.float64), 0, 1)
