"""Faces of a run of an explicit solver that feel obstacles between their corners."""

from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.contact.buffers import whole
from diffsim_ti.mesh import geometry
from diffsim_ti.potential.face_lattice import BENT, face_rows
from diffsim_ti.solvers.explicit.face_kernels import face_kernels
from diffsim_ti.state.arrays import copy_slot
from diffsim_ti.terms.obstacles.barrier import beta


def feels_faces(scene) -> bool:
    """Whether a scene has an obstacle that could reach into a face of the body between its corners.

    A ball of radius R that touches a face, whose longest edge is L, is nearer to it than its corners say by L^2 / 6 R at
    most. Where that is less than what points within faces feel in full, BENT widths (potential/face_lattice.py), corners
    speak for the face. L is that at rest, a fifth longer.
    """
    x = scene.mesh.vertices[scene.mesh.surface_triangles]
    longest = 1.2 * np.linalg.norm(x - np.roll(x, 1, axis=1), axis=2).max(initial=0)
    obstacles = (t for t in scene.terms if t.acts_on_surface and "barrier_width" in t.values)
    return any(longest**2 > 6 * t.least_radius() * BENT * float(t.values["barrier_width"]) for t in obstacles)


class FeltFaces:
    """Their arrays, and what kernels (face_kernels.py) do with them, at a slot of a run's states."""

    def __init__(self, workspace):
        self.ws, a = workspace, workspace.arrays
        self.a, self.mesh, fp = a, a.mesh, a.fp
        faces, surface = self.mesh.surface_triangles, self.mesh.surface_vertices
        self.num_faces, self.num_surface = len(faces), len(surface)
        own = np.searchsorted(surface, faces.ravel())
        entries = np.argsort(own, kind="stable")
        start = np.searchsorted(own[entries], np.arange(len(surface) + 1))
        *_, parts, reach, weight = face_rows(self.mesh, a.contacts)  # a row for each corner of a face
        first = np.argsort(np.argsort(faces.ravel(), kind="stable"))[::3]
        ints = dict(corners=faces.ravel(), own=own, start=start, entries=entries, vertices=surface, parts=parts[first])
        for name, data in ints.items():
            setattr(self, name, runtime.upload(data.ravel(), ti.i32))
        self.reach, self.weight = (runtime.upload(x[first].ravel(), fp) for x in (reach, weight))
        self.share, self.before = (runtime.array(a.vector, 3 * len(faces)) for _ in range(2))
        self.whole, self.seed = (runtime.array(a.vector, len(surface)) for _ in range(2))
        self.least, self.offsets = runtime.array(fp, len(faces) * len(a.contacts)), a.offsets
        self.done, self.work = (
            runtime.array(fp, len(faces)) for _ in range(2)
        )  # by moving obstacles, see EnergyBalance
        runtime.fill(self.work, 0)
        self.energy, self.w = runtime.array(fp, len(faces)), runtime.array(a.vector, 1, a.num_vertices)

    def _run(self, name: str, plan: dict, slot: int, features=None, between=False, u=None, **records) -> None:
        a, ws = self.a, self.ws
        features = a.features() if features is None else features
        kernel = getattr(face_kernels(features, a.precision, ws.parallel), name)
        state = SimpleNamespace(u=ws.state.u) if u is None else SimpleNamespace(u=u)
        key = ("faces", kernel, id(state.u), *(id(x) for x in records.values()))

        def bind():
            return kernel.bind(scene=a, faces=self, state=state, table=ws.table, **records), records

        sizes = dict(num_vertices=a.num_vertices, num_faces=self.num_faces, num_surface=self.num_surface)
        own = sizes | dict(first_out=a.first_face_corner, slot=slot, between=int(between), h=ws.solver.substep)
        ws.kept(key, bind)[0](**own | {name: plan.get(name, 0) for name in ("first", "window")})

    # ---- in passes ---------------------------------------------------------------------------------------------------

    def forces(self, u, slot: int, plan: dict, **where) -> None:
        """Forces at u[slot], where pass plan["first"] begins, to the last corners of the scene."""
        self._run("forces", plan, slot, u=u, **where)

    def look(self, u, slot: int, plan: dict) -> None:
        """After the pass, which led to u[slot]: note what faces did in it."""
        self._run("looks", plan, slot, u=u, watch=self.ws.watch)

    def jvp(self, u, slot: int, plan: dict, features, tangent) -> None:
        """Change of the forces for the change of the state, and of all else, to the same corners."""
        self.forces(u, slot, plan)
        self._run("jvp", plan, slot, features, u=u, tangent=tangent)

    # ---- between passes ----------------------------------------------------------------------------------------------

    def energies(self) -> np.ndarray:
        """Energy [J] of points within each face, in the current state."""
        self.forces(self.ws.state.u, 0, {}, between=True)
        return runtime.fetch(self.energy).astype(np.float64)

    def load_of(self, vertices) -> float:
        """The largest x = h^2 D / m (face_kernels.py) of vertices in the current state."""
        self.forces(self.ws.state.u, 0, {}, between=True)
        i = np.array(vertices)
        D = whole(self.whole)[np.searchsorted(self.mesh.surface_vertices, i), 3]
        return float((D * runtime.fetch(self.a.inverse_mass)[i]).max()) * self.ws.solver.substep**2

    def stiffening(self, vertices, contact: int, speeds: np.ndarray) -> float:
        """How many times stiffer a barrier must be to stop a face of that speed [m/s] at a fiftieth of the width.

        Twice what takes up the kinetic energy of its corners and what it holds in the current state; at least 4.
        """
        self.forces(self.ws.state.u, 0, {}, between=True)
        f = int(np.flatnonzero((self.mesh.surface_triangles == np.array(vertices)).all(1))[0])
        width = float(self.a.contacts[contact].values["barrier_width"])
        near = runtime.fetch(self.least)[f * len(self.a.contacts) + contact] / width
        held = float(runtime.fetch(self.energy)[f])
        moving = 0.5 * float((self.a.values.mass[list(vertices)] * speeds**2).sum())
        most = held * float(beta(0.02) / max(beta(np.clip(near, 1e-3, 1)), 1e-9))
        return float(np.clip(2 * (held + moving) / max(most, 1e-300), 4.0, 1e4))

    def product(self, w) -> None:
        """Products with the stiffness that passes take, for w[0] (face_kernels.py), to the last corners of the scene."""
        copy_slot(w, 0, self.w, 0)
        self.forces(self.ws.state.u, 0, {}, between=True)
        self._run("products", {}, 0, between=True, at=self)


class FeltAdjoint:
    """What adjoints of a run have of faces: sums over the passes, by faces and surface vertices."""

    def __init__(self, adjoint, faces: FeltFaces):
        a, features = faces.a, adjoint.features
        self.faces, self.adjoint, self.features = faces, (adjoint, adjoint.numbers), features
        self.path = runtime.array(a.vector, a.path.shape[0], features.moving)
        self.sums = runtime.array(a.fp, features.num_parameters, faces.num_faces)
        self.felt = runtime.array(a.vector, 2 * features.moving, faces.num_faces if features.moving else 1)
        self.rest_adj, self.by_areas = runtime.array(a.vector, faces.num_surface), runtime.array(a.fp, faces.num_faces)

    def clear(self) -> None:
        for x in (self.sums, self.felt, self.path, self.rest_adj, self.by_areas):
            runtime.fill(x, 0)

    def reverse(self, u, slot: int, plan: dict) -> None:
        """Go back through the forces at u[slot] of pass plan["first"]."""
        self.faces.forces(u, slot, plan)
        self.faces._run("vjp", plan, slot, self.features, u=u, adjoint=self.adjoint, own=self)

    def collect(self, out) -> None:
        """Add the adjoints of parameters and rest positions to a `Derived`."""
        count = self.features.num_parameters
        out.parameters[:count] += runtime.fetch(self.sums).astype(np.float64).sum(1)[:count]
        out.rest[self.faces.mesh.surface_vertices] += runtime.fetch(self.rest_adj)
        if self.features.moving:
            out.path += runtime.fetch(self.path)
        rest, faces = self.faces.a.values.rest, self.faces.mesh.surface_triangles
        by_areas = runtime.fetch(self.by_areas).astype(np.float64)
        by_areas /= np.linalg.norm(geometry.triangle_normals(rest, faces), axis=1)
        out.rest += geometry.triangle_areas_vjp(rest, faces, by_areas)
