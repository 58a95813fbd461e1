"""The numbers of one scene on the device, and the states of one run."""

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.inputs import Derived
from diffsim_ti.solvers.kick_drift import Features
from diffsim_ti.terms import Drag, ExternalForce, Gravity


def vertex_corners(tetrahedra: np.ndarray, num_vertices: int) -> tuple[np.ndarray, np.ndarray]:
    """Compressed rows: the corners c = 4 e + a that meet at vertex i are corner_of[start[i] : start[i + 1]]."""
    corner_of = np.argsort(tetrahedra.ravel(), kind="stable")
    counts = np.bincount(tetrahedra.ravel(), minlength=num_vertices)
    return np.concatenate([[0], np.cumsum(counts)]), corner_of


def slots(indices: np.ndarray, num_vertices: int) -> np.ndarray:
    """Place of each vertex in a list of vertices, -1 where it is not listed."""
    out = np.full(num_vertices, -1)
    out[indices] = np.arange(len(indices))
    return out


class SceneArrays:
    """What the kernels read of a scene: its topology, once, and the numbers derived from its inputs, per load."""

    def __init__(self, scene):
        mesh, precision = scene.mesh, scene.precision
        fp = runtime.PRECISIONS[precision]
        self.fp, self.vec3, self.mat3 = fp, ti.types.vector(3, fp), ti.types.matrix(3, 3, fp)
        self.law = scene.material.law(precision)
        self.coefficient = ti.types.vector(len(self.law.coefficient_names), fp)
        self.num_vertices, self.num_tetrahedra = mesh.num_vertices, mesh.num_tetrahedra
        self.contacts = tuple(t for t in scene.terms if t.acts_on_surface)
        self.fixed = scene.fixed
        self.tets = runtime.upload(mesh.tetrahedra, ti.types.vector(4, ti.i32))
        start, corner_of = vertex_corners(mesh.tetrahedra, mesh.num_vertices)
        self.start, self.corner_of = runtime.upload(start, ti.i32), runtime.upload(corner_of, ti.i32)
        none = runtime.array(ti.i32, 1)
        self.surface = none
        if self.contacts:
            surface = np.zeros(mesh.num_vertices, np.int32)
            surface[mesh.surface_vertices] = 1
            self.surface = runtime.upload(surface, ti.i32)
        external = scene.term(ExternalForce)
        self.force_slot = none
        if external:
            self.force_slot = runtime.upload(slots(external.indices(mesh), mesh.num_vertices), ti.i32)
        self.motion_slot = none
        if scene.motion is not None:
            self.motion_slot = runtime.upload(slots(scene.fixed, mesh.num_vertices), ti.i32)
        first = scene.inputs.first_parameter
        gravity, drag = scene.term(Gravity), scene.term(Drag)
        self._features = dict(
            contacts=tuple(t.kernel(precision, first(t)) for t in self.contacts),
            gravity=first(gravity) if gravity else -1, drag=first(drag) if drag else -1,
            forces=external is not None, motion=scene.motion is not None,
        )  # fmt: skip
        self.values: Derived | None = None
        self.corner = runtime.array(self.vec3, 4 * mesh.num_tetrahedra)

    def features(self, density: bool = False, shape: bool = False) -> Features:
        """What kernels must contain for the values that are loaded."""
        forces = self.values.forces
        return Features(
            **self._features, forces_per_step=forces is not None and len(forces) > 1,
            uniform=self.values.coefficients.ndim == 1, density=density, shape=shape,
        )  # fmt: skip

    def load(self, values: Derived) -> bool:
        """Bring values to the device; True if array shapes changed, so that launches must be bound anew."""
        old, self.values = self.values, values
        moved = False
        inverse_mass = np.divide(1.0, values.mass, out=np.zeros_like(values.mass), where=values.mass > 0)
        inverse_mass[self.fixed] = 0
        sources = {
            "gradients": (values.gradients, self.mat3), "volumes": (values.volumes, self.fp),
            "coefficients": (np.atleast_2d(values.coefficients), self.coefficient),
            "inverse_mass": (inverse_mass, self.fp), "parameters": (values.parameters, self.fp),
            "rest": (values.rest if self.contacts else np.zeros((1, 3)), self.vec3),
            "forces": (np.zeros((1, 1, 3)) if values.forces is None else values.forces, self.vec3),
            "motion": (np.zeros((1, 1, 3)) if values.motion is None else values.motion, self.vec3),
            "anchor": (np.zeros((1, 3)) if values.motion is None else values.displacement[self.fixed], self.vec3),
        }  # fmt: skip
        for name, (data, dtype) in sources.items():
            current = getattr(self, name, None)
            if current is None or runtime.full_shape(current) != data.shape:
                setattr(self, name, runtime.upload(data, dtype))
                moved = True
            elif old is None or getattr(old, name, None) is not getattr(values, name, data):
                runtime.fill(current, data)
        return moved

    def topology(self) -> tuple:
        """Arguments that every pass starts with."""
        return (self.tets, self.gradients, self.volumes, self.coefficients, self.start, self.corner_of,
                self.inverse_mass, self.parameters, self.rest, self.surface)  # fmt: skip


class History:
    """States of a run: u, v (and forces f if recorded) in `slots` slots."""

    def __init__(self, arrays: SceneArrays, num_slots: int, record: bool):
        n = arrays.num_vertices
        self.num_slots = num_slots
        self.u = runtime.array(arrays.vec3, num_slots, n)
        self.v = runtime.array(arrays.vec3, num_slots, n)
        self.f = runtime.array(arrays.vec3, num_slots, n) if record else runtime.array(arrays.vec3, 1, 1)


@ti.kernel
def _copy_slot(source: ti.types.ndarray(ndim=2), s: ti.i32, target: ti.types.ndarray(ndim=2), t: ti.i32):
    for i in range(source.shape[1]):
        target[t, i] = source[s, i]


@ti.kernel
def _find_bad(u: ti.types.ndarray(ndim=2), v: ti.types.ndarray(ndim=2), bad: ti.types.ndarray(ti.i32, 1)):
    for i in range(u.shape[1]):
        finite = True
        for d in ti.static(range(3)):
            for value in ti.static((u[0, i][d], v[0, i][d])):
                finite = finite and not (ti.math.isnan(value) or ti.math.isinf(value))
        if not finite:
            ti.atomic_min(bad[0], i)


def copy_slot(source, s: int, target, t: int) -> None:
    """target[t] = source[s]; on the CPU without the cost of a launch."""
    host = runtime.view(target)
    if host is None:
        _copy_slot(source, s, target, t)
    else:
        host[t] = runtime.view(source)[s]


def first_bad_vertex(history: History) -> int | None:
    """The first vertex of slot 0 whose displacement or velocity is not finite, or None."""
    u, v = runtime.view(history.u), runtime.view(history.v)
    if u is not None:
        with np.errstate(all="ignore"):
            if np.isfinite(u[0].sum() + v[0].sum()):
                return None
            bad = np.nonzero(~np.isfinite(u[0].sum(1) + v[0].sum(1)))[0]
        return int(bad[0]) if bad.size else None
    n = history.u.shape[1]
    out = runtime.array(ti.i32, 1)
    runtime.fill(out, n)
    _find_bad(history.u, history.v, out)
    bad = int(runtime.fetch(out)[0])
    return bad if bad < n else None
