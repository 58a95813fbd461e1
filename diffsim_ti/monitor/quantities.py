"""What can be read off a state: energies, stress, volume ratio."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.common.brief import brief_fields
from diffsim_ti.inputs import kinetic_energy, ratios_at_corners
from diffsim_ti.mechanics.energy.kernels import potential_kernels
from diffsim_ti.mechanics.host_force import Instant
from diffsim_ti.mechanics.interactions import host_forces
from diffsim_ti.mechanics.stress.patched_tetrahedron import ElementKernels
from diffsim_ti.mechanics.workspace import Workspace
from diffsim_ti.runtime import A, Kernel, as_kernel, assign, kernels_of, traced
from diffsim_ti.runtime import at as entry
from diffsim_ti.state.numbers import SCENE, needed, with_state

FIELDS = dict(energy="scalars", von_mises="scalars", J="scalars")


@dataclass(frozen=True)
class ObserverKernels(ElementKernels):
    """What the tetrahedra show at a displacement."""

    @traced
    def observe_points(self, e, scene, at, out):
        def see(q, H, p):
            self.observe_point(e * len(self.element.points) + q, H, self.law.stress(H, p), out)
            assign(entry(out.energy, e * len(self.element.points) + q), self.law.stored.energy_density(H, p))

        self.element.each_seen(e, scene, at, 0, see)

    @ti.func
    def observe_point(self, k, H: A, P: A, out: A):
        F = H.matrix() + ti.Matrix.identity(self.element.fp, 3)
        det = F.determinant()
        S = P.matrix() @ F.transpose() / det  # Cauchy
        out.J[k] = det
        a, b, c = S[0, 0] - S[1, 1], S[1, 1] - S[2, 2], S[2, 2] - S[0, 0]
        shear = S[0, 1] * S[0, 1] + S[1, 2] * S[1, 2] + S[2, 0] * S[2, 0]
        out.von_mises[k] = ti.sqrt(ti.cast(0.5, self.element.fp) * (a * a + b * b + c * c) + 3 * shear)
        if ti.static(self.features.order == 2):
            for i in ti.static(range(3)):
                out.stress[i, k] = ti.Vector([S[i, 0], S[i, 1], S[i, 2], 0])

    @traced
    def store_points(self, e, scene, at, out):
        def see(q, H, p):
            assign(entry(out.energy, e * len(self.element.points) + q), self.law.energy_density(H, p))

        self.element.each_seen(e, scene, at, 0, see)

    @as_kernel("fields", lambda self: FIELDS | (dict(stress="vectors2") if self.features.order == 2 else {}))
    def fields(self, scene: A, at: A, out: A, plan: A):
        """Energy density [J/m^3], von Mises stress [Pa], J at each point; of ten nodes rows of Cauchy's stress [Pa] too."""
        for e in range(plan.num_places):
            self.observe_points(e, scene, at, out)

    @as_kernel("stored", dict(energy="scalars"))
    def stored(self, scene: A, at: A, out: A, plan: A):
        """Energy density [J/m^3] at each point alone, for what looks often."""
        for e in range(plan.num_places):
            self.store_points(e, scene, at, out)

    def _kernel(self, name: str, body, out: dict) -> Kernel:
        at = with_state(dict(u="vectors2"), self.law)
        own = dict(scene=needed(SCENE, self.features), at=at, out=out)
        return Kernel(name, body, self.law.precision, own, dict(num_places="int"))


def _kernels(arrays) -> ObserverKernels:
    return kernels_of(ObserverKernels, arrays.law, arrays.features().of_elements(), True, False)


class Energy(float):
    """A total energy [J] that knows its parts: kinetic, elastic, gravity (zero at y = 0 for g along y), contact, springs,
    foundations (cables are loads, and have none); of plastic laws also what they have dissipated."""

    parts: dict[str, float]

    def __new__(cls, parts: dict[str, float]):
        out = super().__new__(cls, sum(parts.values()))
        out.parts = parts
        return out


@dataclass(repr=False)
class TetrahedronFields:
    """Per tetrahedron: energy density [J/m^3], von Mises stress [Pa], volume ratio J [-]; float64. Of ten nodes: means over
    the points, the smallest J there and at the corners, and Cauchy's stress [Pa] at the points, shape (num_tetrahedra, 4,
    3, 3)."""

    energy_density: np.ndarray
    von_mises: np.ndarray
    J: np.ndarray
    stress: np.ndarray | None = None

    __repr__ = brief_fields


def tetrahedron_fields(workspace: Workspace) -> TetrahedronFields:
    """Fields of the current state. von Mises is sqrt(3/2 dev S : dev S) of the Cauchy stress S = P F^T / J."""
    a = workspace.arrays

    def bind():
        room = a.points * a.num_places
        out = SimpleNamespace(**{name: runtime.array(a.fp, room) for name in ("energy", "von_mises", "J")})
        out.stress = runtime.array(a.vector, 3, room) if a.points > 1 else None
        return out, _kernels(a).fields.bind(scene=a, at=workspace.state, out=out)

    out, launch = workspace.kept("fields", bind)
    launch(num_places=a.num_places)
    energy, von_mises, J = (a.at_points(runtime.fetch(x)) for x in (out.energy, out.von_mises, out.J))
    stress = None
    if a.points > 1:
        rows = np.stack([runtime.fetch_row(out.stress, i) for i in range(3)], 1)
        stress = rows.reshape(-1, a.points, 3, 3)[a.place].astype(np.float64)
        share = a.values.volumes / a.values.volumes.sum(1, keepdims=True)
        energy, von_mises = (energy * share).sum(1), (von_mises * share).sum(1)
        u = runtime.fetch_row(workspace.state.u, 0).astype(np.float64)
        J = np.minimum(J.min(1), ratios_at_corners(a.mesh.elements, a.values.rest, u).min(1))
    return TetrahedronFields(energy, von_mises, J, stress)


def elastic_energy(workspace: Workspace) -> float:
    """Energy of strains [J] in the current state; of plastic laws their potential, with what they have dissipated."""
    a = workspace.arrays

    def bind():
        out = SimpleNamespace(energy=runtime.array(a.fp, a.points * a.num_places))
        return out, _kernels(a).stored.bind(scene=a, at=workspace.state, out=out)

    out, launch = workspace.kept("stored", bind)
    launch(num_places=a.num_places)
    return float(a.at_points(runtime.fetch(out.energy)).ravel() @ a.values.volumes.ravel())


def barrier_energies(workspace: Workspace) -> np.ndarray:
    """Energy of the obstacles' barriers at each vertex [J], in the current state."""
    a = workspace.arrays

    def bind():
        out = SimpleNamespace(contact=runtime.array(a.fp, a.num_vertices))
        no_friction = runtime.array(a.vector, 2, 1)
        poses = SimpleNamespace(poses=a.offsets, lag=no_friction, pressed=no_friction)
        kernel = potential_kernels(a.law, a.features(), workspace.parallel, a.in_lanes).barrier_energy
        return out, kernel.bind(scene=a, pass_=poses, at=workspace.state, out=out)

    out, launch = workspace.kept("barriers", bind)
    launch(num_items=a.num_items, num_tetrahedra=a.num_places, num_vertices=a.num_vertices, per_gamma=0.0)
    return runtime.fetch(out.contact).astype(np.float64)


def stored_energies(workspace: Workspace) -> dict[str, float]:
    """Energies [J] of forces, such as of springs and foundations, in the current state."""
    hosts = workspace.kept("hosts", lambda: host_forces(workspace.scene).with_energy)
    if not hosts:
        return {}
    u = runtime.fetch_row(workspace.state.u, 0)
    return hosts.take(workspace.arrays.now, Instant(workspace.solver.schedule)).stored(u)


def energy(workspace: Workspace) -> Energy:
    """Energy of the current state, summed in float64."""
    a, values = workspace.arrays, workspace.arrays.values
    u, v = (runtime.fetch(x)[0].astype(np.float64) for x in (workspace.state.u, workspace.state.v))
    parts = {"kinetic": kinetic_energy(workspace.mass, v)}
    volumes = values.volumes if a.points == 1 else values.volumes.sum(1)
    parts["elastic"] = float((tetrahedron_fields(workspace).energy_density * volumes).sum())
    if a.law.plastic:
        parts["dissipated"] = elastic_energy(workspace) - parts["elastic"]
    features = a.features()
    if features.gravity >= 0:
        parts["gravity"] = float(-((values.rest + u) * (workspace.mass * a.gravity_of(values))).sum())
    if features.groups:
        parts["contact"] = float(barrier_energies(workspace).sum())
    if workspace.pairs:
        parts["contact"] = parts.get("contact", 0.0) + workspace.pairs.look(workspace.state.u)[0]
    return Energy(parts | stored_energies(workspace))
