"""Kernels of points within faces (faces.py), a loop over all vertices each."""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.mechanics.obstacles.faces import FacePoints
from diffsim_ti.runtime import Kernel, kernels_of
from diffsim_ti.state.features import Features
from diffsim_ti.state.numbers import ADJOINT, SCENE, TANGENT, needed

A = ti.template()
PASS = dict(
    poses="vectors", face_start="ints", face_next="ints", face_parts="ints", face_reach="scalars", face_weight="scalars"
)


@dataclass(frozen=True)
class FaceKernels(FacePoints):
    """parallel: loops run on all threads."""

    parallel: bool

    def _kernel(self, name: str, body, **arrays) -> Kernel:
        own = dict(scene=needed(SCENE, self.features), pass_=PASS, at=dict(u="vectors2", w="vectors2")) | arrays
        return Kernel(name, body, self.precision, own, dict(num_vertices="int"))

    @ti.func
    def all_energies(self, scene: A, pass_: A, at: A, out: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            out.contact[i] = self.around("energy", i, scene, pass_, at, at)[0]

    @cached_property
    def energy(self) -> Kernel:
        """Energy [J], each vertex with its share of the points around."""
        return self._kernel("face_energy", self.all_energies, out=dict(contact="scalars"))

    @ti.func
    def all_forces(self, scene: A, pass_: A, at: A, out: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            out.y[0, i] = self.around("force", i, scene, pass_, at, at)

    @cached_property
    def forces(self) -> Kernel:
        return self._kernel("face_forces", self.all_forces, out=dict(y="vectors2"))

    @ti.func
    def all_products(self, scene: A, pass_: A, at: A, out: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            out.y[0, i] = self.around("product", i, scene, pass_, at, at)

    @cached_property
    def product(self) -> Kernel:
        """y = df/du w"""
        return self._kernel("face_product", self.all_products, out=dict(y="vectors2"))

    @ti.func
    def all_blocks(self, scene: A, pass_: A, at: A, out: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            for d in range(3):
                out.blocks[d, i] = 0 - self.around("column", i, scene, pass_, at, d)

    @cached_property
    def blocks(self) -> Kernel:
        """The 3x3 diagonal blocks of -df/du, by columns."""
        return self._kernel("face_blocks", self.all_blocks, out=dict(blocks="vectors2"))

    @ti.func
    def all_jvp(self, scene: A, pass_: A, at: A, out: A, tangent: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            out.y[0, i] = self.around("jvp", i, scene, pass_, at, tangent)

    @cached_property
    def jvp(self) -> Kernel:
        """Change y of the forces for changes w of the displacement and of everything else that they depend on."""
        own = dict(out=dict(y="vectors2"), tangent=TANGENT | dict(poses="vectors"))
        return self._kernel("face_jvp", self.all_jvp, **own)

    @ti.func
    def all_vjp(self, scene: A, pass_: A, at: A, out: A, adjoint: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            out.y[0, i] = self.vector(0)
            for g in ti.static(self.features.groups):
                if ti.static(self.features.reaches(g)):
                    for k in range(g.count):
                        by_u = self.around_one("product", g, k, i, scene, pass_, at, at)
                        self.around_one("numbers", g, k, i, scene, pass_, at, adjoint)
                        self.spread(g, k, i, by_u, scene, pass_, at, adjoint)
                        out.y[0, i] = out.y[0, i] + by_u

    @cached_property
    def vjp(self) -> Kernel:
        """y = df/du w; adds the adjoints of all else that forces depend on."""
        own = dict(out=dict(y="vectors2"), adjoint=ADJOINT | dict(poses="vectors2", face_areas="scalars"))
        return self._kernel("face_vjp", self.all_vjp, **own)


def face_kernels(features: Features, precision: str, parallel: bool) -> FaceKernels:
    """Kernels for a scene's features."""
    return kernels_of(FaceKernels, features.of_state(), precision, parallel)
