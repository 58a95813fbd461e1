"""Contact of points within faces (faces.py) in a potential energy, as arrays of float64."""

import weakref
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.obstacles.face_kernels import face_kernels
from diffsim_ti.mechanics.obstacles.face_lattice import around_vertices, face_rows, nodes_of_faces, shortened


class FaceContact:
    """What points within faces add to a potential, at its displacement."""

    @staticmethod
    def is_active(arrays) -> bool:
        """Whether the scene has obstacles that could reach into a face between its corners."""
        return any(arrays.features().reaches(group) for group in arrays.features().groups)

    def __init__(self, potential, parallel: bool):
        self.p, self.a = weakref.proxy(potential), potential.arrays  # which holds this: no circle
        a, (*rows, reach, weight) = self.a, face_rows(self.a)
        self.face_start, self.face_next, self.face_parts = (runtime.upload(x.ravel(), ti.i32) for x in rows)
        self.face_reach, self.face_weight = (runtime.upload(x.ravel(), a.fp) for x in (reach, weight))
        self.reach, self._triangles = reach, around_vertices(nodes_of_faces(a), a.mesh.num_vertices)[1]
        self.kernels, self.parallel = face_kernels(a.features(), a.precision, parallel), parallel
        self._out = SimpleNamespace(
            contact=runtime.array(a.fp, a.num_vertices),
            y=runtime.array(a.vector, 1, a.num_vertices),
            blocks=runtime.array(a.vector, 3, a.num_vertices),
        )
        self._launches = {}

    def begin(self, distances: np.ndarray) -> None:
        """A run starts with these distances [m] of the triangles of the surface to what is nearest."""
        runtime.fill(self.face_reach, shortened(self.reach, distances[self._triangles]).ravel())

    def bind(self, kernel, **records):
        """A kernel of faces.py at the potential's displacement, with more arrays than its own; returns y, a copy."""
        own = dict(scene=self.a, pass_=(SimpleNamespace(poses=self.p.poses), self), out=self._out)
        launch = kernel.bind(**own | dict(at=SimpleNamespace(u=self.p.u, w=self.p.w)) | records)

        def run() -> np.ndarray:
            launch(num_vertices=self.a.num_vertices)
            return runtime.fetch(self._out.y)[0].astype(np.float64)

        return run

    def _run(self, name: str, **records) -> np.ndarray:
        if name not in self._launches:
            self._launches[name] = self.bind(getattr(self.kernels, name), **records)
        return self._launches[name]()

    def energies(self) -> np.ndarray:
        """Energy [J], by vertices."""
        self._run("energy")
        return runtime.fetch(self._out.contact).astype(np.float64)

    def energies_at(self, u, poses) -> np.ndarray:
        """The same of displacements u[0], obstacles being at `poses` (obstacles.py), arrays on the device."""
        at, place = SimpleNamespace(u=u, w=self.p.w), (SimpleNamespace(poses=poses), self)
        key = "energy", id(u), id(poses)  # which the launch keeps
        if key not in self._launches:
            self._launches[key] = self.bind(self.kernels.energy, at=at, pass_=place)
        self._launches[key]()
        return runtime.fetch(self._out.contact).astype(np.float64)

    def forces(self) -> np.ndarray:
        """Forces [N]."""
        return self._run("forces")

    def product(self) -> np.ndarray:
        """df/du w for the potential's w."""
        return self._run("product")

    def blocks(self) -> np.ndarray:
        """3x3 diagonal blocks of d2E/du2 [N/m], shape (num_vertices, 3, 3)."""
        self._run("blocks")
        return np.swapaxes(runtime.fetch(self._out.blocks).astype(np.float64), 0, 1)
