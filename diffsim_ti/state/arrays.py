"""The numbers of one scene on the device, and the states of one run."""

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.elements.tetrahedron import LANES
from diffsim_ti.inputs import Derived
from diffsim_ti.mesh.patches import in_eights, volume_patches
from diffsim_ti.solvers.explicit.kick_drift import Features
from diffsim_ti.terms import Drag, ExternalForce, Gravity, SelfContact


def vertex_corners(tetrahedra: np.ndarray, num_vertices: int) -> tuple[np.ndarray, np.ndarray]:
    """Compressed rows: the corners c = 4 e + a that meet at vertex i are corner_of[start[i] : start[i + 1]]."""
    corner_of = np.argsort(tetrahedra.ravel(), kind="stable")
    counts = np.bincount(tetrahedra.ravel(), minlength=num_vertices)
    return np.concatenate([[0], np.cumsum(counts)]), corner_of


def with_own_corner(start: np.ndarray, corner_of: np.ndarray, vertices: np.ndarray, first: int) -> tuple:
    """The same rows with one corner more, first + k, at the end of that of vertices[k]."""
    longer = np.insert(corner_of, start[vertices + 1], first + np.arange(len(vertices)))
    return start + np.searchsorted(vertices, np.arange(len(start))), longer


def slots(indices: np.ndarray, num_vertices: int) -> np.ndarray:
    """Place of each vertex in a list of vertices, -1 where it is not listed."""
    out = np.full(num_vertices, -1)
    out[indices] = np.arange(len(indices))
    return out


def to_blocks(per_tetrahedron: np.ndarray, order: np.ndarray) -> np.ndarray:
    """(num_tetrahedra, rows) as (num_blocks * rows, LANES); order: the tetrahedron in each lane."""
    rows = per_tetrahedron.reshape(len(per_tetrahedron), -1)[order]
    return np.swapaxes(rows.reshape(len(order) // LANES, LANES, -1), 1, 2).reshape(-1, LANES)


def from_blocks(blocks: np.ndarray, place, rows: int) -> np.ndarray:
    """The inverse: (num_tetrahedra, rows) in float64; place: where each tetrahedron stands, among all lanes."""
    return np.swapaxes(blocks.reshape(-1, rows, LANES), 1, 2).reshape(-1, rows)[place].astype(np.float64)


class SceneArrays:
    """What the kernels read of a scene: its topology, once, and the numbers derived from its inputs, per load."""

    def __init__(self, scene):
        mesh, precision = scene.mesh, scene.precision
        fp = runtime.PRECISIONS[precision]
        self.fp, self.vector, self.lanes = fp, ti.types.vector(4, fp), ti.types.vector(LANES, fp)
        self.law = scene.law
        self._place_tetrahedra(scene)
        self.num_coefficients, self.num_blocks = len(self.law.coefficient_names), len(self.order) // LANES
        self.in_lanes = self.law.lanes and runtime.runs_on_cpu()
        self.num_items = self.num_blocks if self.in_lanes else self.num_places
        self.num_vertices, self.num_tetrahedra = mesh.num_vertices, mesh.num_tetrahedra
        self.contacts = tuple(t for t in scene.ordered_terms if t.acts_on_surface)
        self.fixed = scene.fixed
        self.tets = runtime.upload(to_blocks(mesh.tetrahedra, self.order).ravel(), ti.i32)
        self.mesh, self.precision, self.self_contact = mesh, precision, scene.term(SelfContact)
        self.first_contact_corner, num_corners = 4 * LANES * self.num_blocks, 4 * LANES * self.num_blocks
        start, corner_of = vertex_corners(mesh.tetrahedra, mesh.num_vertices)
        if self.patches is not None:
            corner_of = 4 * self.place[corner_of // 4] + corner_of % 4
        if self.self_contact:  # each surface vertex gathers one corner more, after those of its tetrahedra
            self.parameters_of_self_contact = scene.inputs.parameters.of(self.self_contact)
            start, corner_of = with_own_corner(start, corner_of, mesh.surface_vertices, num_corners)
            num_corners += len(mesh.surface_vertices)
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
        rows = scene.inputs.parameters
        self._features = dict(
            contacts=self._twins(scene),
            moving=len(scene.moving),
            gravity=rows.first(scene.term(Gravity)),
            drag=rows.first(scene.term(Drag)),
            forces=external is not None,
            motion=scene.motion is not None,
            num_parameters=rows.total,
        )
        self.offsets = runtime.array(
            self.vector, len(self.contacts)
        )  # where obstacles are when one looks between passes
        self.values: Derived | None = None
        self.corner = runtime.array(self.vector, num_corners)

    def _place_tetrahedra(self, scene) -> None:
        """`order`: the tetrahedron in each lane; `place`: the lane of each; `num_places`: lanes to go through."""
        m = scene.mesh.num_tetrahedra
        self.patches = volume_patches(scene.mesh) if scene.volume == "patches" else None
        if self.patches is not None:
            self.order, self.place = in_eights(self.patches)
            self.num_places = len(self.order)
            self._alone = np.zeros(self.num_places)  # 1 where a lane is no repetition
            self._alone[self.place] = 1
            return
        self.order = np.zeros(-(-m // LANES) * LANES, np.int64)  # the last block is filled up with tetrahedron 0
        self.order[:m] = np.arange(m)
        self.place, self.num_places = slice(m), m

    def _twins(self, scene) -> tuple:
        """Compile-time twins of the contacts; their tables stand behind the parameters, one after the other."""
        columns, twins, at = {term: k for k, term in enumerate(scene.moving)}, [], max(scene.inputs.parameters.total, 1)
        self.tables = np.concatenate([np.zeros(0), *(t.table for t in self.contacts)])
        for term in self.contacts:
            own = dict(path=columns[term]) if term in columns else {}
            rows = scene.inputs.parameters.of(term)
            twin = term.kernel(scene.precision, rows.start, **own | (dict(table=at) if term.table.size else {}))
            if slice(twin.first, twin.first + twin.size) != rows:  # it would read, and add to, another term's rows
                raise AssertionError(
                    f"the kernel of {term!r} has {twin.size} numbers, its term {rows.stop - rows.start}"
                )
            twins.append(twin)
            at += term.table.size
        return tuple(twins)

    def features(self, density: bool = False, shape: bool = False) -> Features:
        """What kernels must contain for the values that are loaded."""
        forces = self.values.forces
        return Features(
            **self._features,
            forces_per_step=forces is not None and len(forces) > 1,
            uniform=self.values.coefficients.ndim == 1,
            density=density,
            shape=shape,
        )

    def load(self, values: Derived) -> bool:
        """Bring values to the device; True if array shapes or kernels changed, so that launches must be bound anew."""
        old, before = self.values, None if self.values is None else self.features()
        self.values = values
        moved = before != self.features()
        inverse_mass = np.divide(1.0, values.mass, out=np.zeros_like(values.mass), where=values.mass > 0)
        inverse_mass[self.fixed] = 0
        sources = {
            "gradients": (to_blocks(values.gradients, self.order), self.lanes),
            "volumes": (self.volume_blocks(values.volumes), self.lanes),
            "coefficients": (self.coefficient_blocks(values.coefficients), self.lanes),
            "inverse_mass": (inverse_mass, self.fp),
            "parameters": (np.concatenate([values.parameters, self.tables]), self.fp),
            "rest": (values.rest if self.contacts or self.self_contact else np.zeros((1, 3)), self.vector),
            "forces": (np.zeros((1, 1, 3)) if values.forces is None else values.forces, self.vector),
            "motion": (np.zeros((1, 1, 3)) if values.motion is None else values.motion, self.vector),
            "path": (np.zeros((1, 1, 3)) if values.path is None else values.path, self.vector),
            "anchor": (np.zeros((1, 3)) if values.motion is None else values.displacement[self.fixed], self.vector),
        }
        for name, (data, dtype) in sources.items():
            current = getattr(self, name, None)
            if current is None or tuple(current.shape) != data.shape[: len(current.shape)]:
                setattr(self, name, runtime.upload(data, dtype))
                moved = True
            elif old is None or getattr(old, name, None) is not getattr(values, name, data):
                runtime.fill(current, data)
        return moved

    def place_obstacles(self, row: int, share: float = 0.0) -> None:
        """Put what looks at a state between passes where the obstacles are: `share` of a step beyond row `row` of paths."""
        features = self.features()
        if features.moving:
            rows, places = runtime.fetch(self.path).astype(np.float64), np.zeros((len(features.contacts), 3))
            row, after = min(row, len(rows) - 1), min(row + 1, len(rows) - 1)
            for k, contact in enumerate(features.contacts):
                if contact.path >= 0:
                    places[k] = (1 - share) * rows[row, contact.path] + share * rows[after, contact.path]
            runtime.fill(self.offsets, places)

    def coefficient_blocks(self, coefficients: np.ndarray) -> np.ndarray:
        """Blocks of coefficients, shape (K,) or (num_tetrahedra, K); a single block serves all if they are uniform."""
        return to_blocks(np.atleast_2d(coefficients), np.zeros(LANES, int) if coefficients.ndim == 1 else self.order)

    def volume_blocks(self, volumes: np.ndarray) -> np.ndarray:
        """Blocks of volumes; repetitions in a patch have none."""
        blocks = to_blocks(volumes, self.order)
        return blocks if self.patches is None else blocks * self._alone.reshape(-1, LANES)

    def topology(self) -> tuple:
        """Arguments that every pass starts with."""
        return (
            self.tets,
            self.gradients,
            self.volumes,
            self.coefficients,
            self.start,
            self.corner_of,
            self.inverse_mass,
            self.parameters,
            self.rest,
            self.surface,
        )


class History:
    """States of a run: u, v (and forces f if recorded) in `slots` slots."""

    def __init__(self, arrays: SceneArrays, num_slots: int, record: bool):
        n = arrays.num_vertices
        self.num_slots = num_slots
        self.u = runtime.array(arrays.vector, num_slots, n)
        self.v = runtime.array(arrays.vector, num_slots, n)
        self.f = runtime.array(arrays.vector, num_slots, n) if record else runtime.array(arrays.vector, 1, 1)


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
