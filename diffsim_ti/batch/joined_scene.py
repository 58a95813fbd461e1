"""The scenes of a batch as one body of so many pieces, for implicit steps: scene b has vertices b n .. (b + 1) n - 1.

Numbers of vertices and tetrahedra stand one scene after the other, and so do those of terms and obstacles, of which
kernels and host forms see those of one scene (joined_potential.py; `JoinedHost`).
"""

import warnings
from copy import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.batch.layouts import in_slots
from diffsim_ti.inputs import Derived
from diffsim_ti.mechanics.host_force import HostForce, HostForces
from diffsim_ti.mechanics.interactions import host_forces
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.patches import in_eights, volume_patches
from diffsim_ti.runtime import LANES
from diffsim_ti.state.arrays import SceneArrays
from diffsim_ti.state.obstacle_poses import Moment
from diffsim_ti.terms.reduced import Reduced

OF_STEPS = "forces", "motion", "path"  # rows of vectors, (rows, k, 3)
OF_ALL = "displacement", "velocity", "mass", "rest", "surface", "gradients", "volumes", "element_masses", "parameters"


def joined_scene(scene, count: int):
    """A scene of `count` bodies like that of another scene, whose inputs and terms stay those of one."""
    out, n = object.__new__(type(scene)), scene.mesh.num_vertices
    vars(out).update(vars(scene))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what is to be said of the mesh was said of that of one
        out.mesh = TetrahedralMesh.joined([scene.mesh] * count)
    out.supports = own = copy(scene.supports)
    own.vertices = (own.vertices + n * np.arange(count)[:, None]).ravel()
    own.held, own.wholly = np.tile(own.held, (count, 1, 1)), np.tile(own.wholly, count)
    out.fixed, out.held = own.fixed, own.vertices
    out.reduced, out.one, out.num_scenes = Reduced(out.mesh, None, out.held), scene, count
    return out


def joined_derived(each: list[Derived]) -> Derived:
    """What kernels read of all scenes; of numbers that host forms read none."""
    first, out = each[0], {name: None for name in each[0].parts()}
    for name in OF_ALL:
        if getattr(first, name) is not None:
            out[name] = np.concatenate([getattr(d, name) for d in each])
    m = len(first.gradients)
    rows = [d.coefficients for d in each]
    if first.coefficients.ndim == 1 and all(np.array_equal(x, rows[0]) for x in rows):
        out["coefficients"] = rows[0]
    else:
        out["coefficients"] = np.concatenate([np.broadcast_to(x, (m, x.shape[-1])) for x in rows])
    for name in OF_STEPS:
        if getattr(first, name) is not None:
            out[name] = np.concatenate(list(in_slots([getattr(d, name) for d in each])), axis=1)
    if first.growths is not None:
        out["growths"] = np.concatenate([np.broadcast_to(d.growths, (*d.growths.shape[:2], m)) for d in each], axis=2)
    return Derived(**out)


def of_scenes(joined: np.ndarray, count: int, axis: int = 0) -> np.ndarray:
    """Numbers of all scenes, one after the other along an axis, with the scenes as the first axis; a view."""
    shape = joined.shape
    return np.moveaxis(joined.reshape(*shape[:axis], count, shape[axis] // count, *shape[axis + 1 :]), axis, 0)


class JoinedArrays(SceneArrays):
    """The numbers of all scenes; blocks of eight tetrahedra are of one scene each.

    by_scene: whether a thread takes a scene through kernels of one scene (runtime/piecewise.py), as on the processor; else
    each loop of a kernel goes through all scenes.
    """

    by_scene = property(lambda self: runtime.runs_on_cpu())

    def __init__(self, scene, *more):
        self.num_scenes = scene.num_scenes
        super().__init__(scene, *more)
        of_vertices = np.repeat(np.arange(self.num_scenes), self.vertices_of_one)
        self.scene_of = runtime.upload(np.append(of_vertices, self.num_scenes), ti.i32)  # the last: how many

    def _order_tetrahedra(self, scene) -> None:
        one, count = scene.one.mesh, scene.num_scenes
        m, patches = one.num_tetrahedra, scene.volume == "patches"
        self.patches = None
        if patches:
            of_one = volume_patches(one)
            self.patches = (of_one + (of_one.max() + 1) * np.arange(count)[:, None]).ravel()
        if patches and one.order == 1:
            self.order, self.place = in_eights(self.patches)
        else:
            room = -(-m // LANES) * LANES
            own = np.minimum(np.arange(room), m - 1)
            first = np.arange(count)[:, None]
            self.order, self.place = (own + m * first).ravel(), (np.arange(m) + room * first).ravel()
        self.num_places = len(self.order)
        self.alone = np.zeros(self.num_places)
        self.alone[self.place] = 1

    def gravity_of(self, values) -> np.ndarray:
        """That of each vertex, by its scene."""
        at, each = self._features["gravity"], of_scenes(values.parameters, self.num_scenes)
        return np.repeat(each[:, at : at + 3], self.vertices_of_one, axis=0) if at >= 0 else np.zeros(3)

    def place_obstacles(self, schedule, j) -> None:
        """To where they are in the first scene, for what looks at states between passes."""
        path = self.rows["path"]
        if path is not None:
            begin, own = schedule.begin(j), of_scenes(path, self.num_scenes, axis=1)[0]
            runtime.fill(self.offsets, self.poses.value(own, Moment(schedule, j, begin, begin)))


class JoinedHost(HostForce):
    """Forces of one kind on the bodies of all scenes, whose host forms are `parts`."""

    def __init__(self, parts: list[HostForce]):
        self.parts, self.count = parts, len(parts)
        self.has_energy, self.reads_velocities = parts[0].has_energy, parts[0].reads_velocities

    @property
    def symmetric(self) -> bool:
        return all(part.symmetric for part in self.parts)

    def _each(self, *vectors) -> list[tuple]:
        """(host form, its part of each of some vectors of all vertices) of each scene."""
        return list(zip(self.parts, *(of_scenes(x, self.count) for x in vectors)))

    def restrict(self, free, rest):
        for part, *own in self._each(free, rest):
            part.restrict(*own)

    def take(self, values, instant):
        """values: `each` of the scenes' own."""
        origins = [None] * self.count if instant.origin is None else of_scenes(instant.origin, self.count)
        for part, own, origin in zip(self.parts, values.each, origins):
            part.take(own, replace(instant, origin=origin))
        return self

    def forces(self, u):
        return np.concatenate([part.forces(x) for part, x in self._each(u)])

    def sizes(self, u):
        return np.concatenate([part.sizes(x) for part, x in self._each(u)])

    def energies(self, u):
        """(scenes, parts)"""
        return np.stack([part.energies(x) for part, x in self._each(u)])

    def work(self, u, step):
        """(scenes,)"""
        return np.array([part.work(*own) for part, *own in self._each(u, step)])

    def product(self, u, w, convex=False):
        return np.concatenate([part.product(*own, convex) for part, *own in self._each(u, w)])

    def blocks(self, u):
        return np.concatenate([part.blocks(x) for part, x in self._each(u)])

    def matrix(self, u):
        from scipy.sparse import block_diag

        found = [part.matrix(x) for part, x in self._each(u)]
        return None if found[0] is None else block_diag(found, format="csr")

    def vjp(self, u, w, adj=None):
        """adj: `each` of the scenes' own."""
        each = [None] * self.count if adj is None else adj.each
        found = [part.vjp(*own, a) for (part, *own), a in zip(self._each(u, w), each)]
        return tuple(
            np.concatenate([np.broadcast_to(x, own.shape) for x, own in zip(by, of_scenes(u, self.count))])
            for by in zip(*found)
        )


def joined_hosts(scene, count: int) -> HostForces:
    """Of `count` scenes like one."""
    each = [host_forces(scene) for _ in range(count)]
    return HostForces(JoinedHost(list(parts)) for parts in zip(*each))


def of_each(each: list) -> SimpleNamespace:
    """What the host forces of each scene take."""
    return SimpleNamespace(each=each)
