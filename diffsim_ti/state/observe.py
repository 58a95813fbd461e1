"""What can be read off a state: energies, stress, volume ratio."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.elements.patched_tetrahedron import functions_of
from diffsim_ti.runtime import Bundle


@lru_cache(maxsize=None)
def observer_kernels(law, features):
    """Kernels (fields of the tetrahedra, contact energy of the vertices) at a displacement."""
    el = functions_of(law, features.uniform, False)
    t, contacts = el.types, features.contacts

    @ti.kernel
    def tetrahedron_fields(
        tets: t.ints,
        gradients: t.blocks,
        volumes: t.blocks,
        coefficients: t.blocks,
        u: t.vectors2,
        energy: t.scalars,
        von_mises: t.scalars,
        J: t.scalars,
        num_places: ti.i32,
    ):
        scene = Bundle(tets=tets, gradients=gradients, volumes=volumes, coefficients=coefficients)
        for e in range(num_places):
            H, p = el.edges(e, scene, u, 0).dot(el.gradients_of(e, gradients)), el.coefficients_at(e, scene, u, 0)
            F = H.matrix() + ti.Matrix.identity(t.fp, 3)
            det = F.determinant()
            S = law.stress(H, p).matrix() @ F.transpose() / det  # Cauchy
            energy[e] = law.energy_density(H, p)
            J[e] = det
            a, b, c = S[0, 0] - S[1, 1], S[1, 1] - S[2, 2], S[2, 2] - S[0, 0]
            shear = S[0, 1] * S[0, 1] + S[1, 2] * S[1, 2] + S[2, 0] * S[2, 0]
            von_mises[e] = ti.sqrt(ti.cast(0.5, t.fp) * (a * a + b * b + c * c) + 3 * shear)

    @ti.kernel
    def contact_energy(
        rest: t.vectors, offsets: t.vectors, surface: t.ints, parameters: t.scalars, u: t.vectors2, energy: t.scalars
    ):
        for i in range(u.shape[1]):
            energy[i] = 0
            if ti.static(len(contacts) > 0):
                if surface[i] > 0:
                    for k in ti.static(range(len(contacts))):
                        energy[i] += contacts[k].energy(parameters, rest[i] - offsets[k], u[0, i])

    return tetrahedron_fields, contact_energy


class Energy(float):
    """A total energy [J] that knows its parts: kinetic, elastic, gravity (zero at y = 0 for g along y), contact."""

    parts: dict[str, float]

    def __new__(cls, parts: dict[str, float]):
        out = super().__new__(cls, sum(parts.values()))
        out.parts = parts
        return out


@dataclass
class TetrahedronFields:
    """Per tetrahedron: energy density [J/m^3], von Mises stress [Pa], volume ratio J [-]; float64."""

    energy_density: np.ndarray
    von_mises: np.ndarray
    J: np.ndarray


def tetrahedron_fields(workspace) -> TetrahedronFields:
    """Fields of the current state. von Mises is sqrt(3/2 dev S : dev S) of the Cauchy stress S = P F^T / J."""
    a = workspace.arrays
    out = [runtime.array(a.fp, a.num_places) for _ in range(3)]
    kernel = observer_kernels(a.law, a.features())[0]
    kernel(a.tets, a.gradients, a.volumes, a.coefficients, workspace.state.u, *out, a.num_places)
    return TetrahedronFields(*(runtime.fetch(x)[a.place].astype(np.float64) for x in out))


def energy(workspace) -> Energy:
    """Energy of the current state, summed in float64."""
    a, values = workspace.arrays, workspace.arrays.values
    u, v = (runtime.fetch(x)[0].astype(np.float64) for x in (workspace.state.u, workspace.state.v))
    parts = {"kinetic": float(0.5 * (values.mass * (v**2).sum(1)).sum())}
    parts["elastic"] = float((tetrahedron_fields(workspace).energy_density * values.volumes).sum())
    features = a.features()
    if features.gravity >= 0:
        g = values.parameters[features.gravity :][:3]
        parts["gravity"] = float(-(values.mass * ((values.rest + u) @ g)).sum())
    if features.contacts:
        per_vertex = runtime.array(a.fp, a.num_vertices)
        observer_kernels(a.law, features)[1](a.rest, a.offsets, a.surface, a.parameters, workspace.state.u, per_vertex)
        parts["contact"] = float(runtime.fetch(per_vertex).astype(np.float64).sum())
    if workspace.pairs:
        parts["contact"] = parts.get("contact", 0.0) + workspace.pairs.look(workspace.state.u)[0]
    return Energy(parts)
