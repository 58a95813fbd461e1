"""Kernels of the potential energy of a displacement: elasticity of all tetrahedra, obstacles at surface vertices."""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.materials.calculus.tensor import Tensor, sum_of
from diffsim_ti.mechanics.obstacles.obstacles import ObstaclePotential
from diffsim_ti.mechanics.stress.patched_tetrahedron import ElementKernels, functions_of
from diffsim_ti.runtime import A, Bundle, Kernel, as_kernel, assign, kernels_of, let, traced
from diffsim_ti.runtime import at as entry
from diffsim_ti.state.features import Features
from diffsim_ti.state.numbers import ADJOINT, SCENE, TANGENT, needed, with_frozen, with_pass

PASS = dict(poses="vectors", lag="vectors2")  # what contact sees of a pass (obstacles.py)
NUMBERS = dict(num_items="int", num_tetrahedra="int", num_vertices="int", per_gamma="float")


@dataclass(frozen=True)
class PotentialKernels(ElementKernels):
    """Energy, forces, products of their derivatives, block diagonal: at displacement `at.u`, in the pass `pass_`."""

    @property
    def fp(self):
        return self.law.fp

    @cached_property
    def single(self):
        """The element without lanes."""
        return functions_of(self.law, self.features, False)

    @cached_property
    def obstacles(self) -> ObstaclePotential:
        return ObstaclePotential(self.features, self.law.precision)

    def _kernel(self, name: str, body, reads_law: bool = True, **arrays) -> Kernel:
        own = dict(scene=needed(SCENE, self.features), pass_=PASS if self.features.groups else {}) | arrays
        if reads_law:
            own |= dict(at=with_pass(arrays["at"], self.law))
        return Kernel(name, body, self.law.precision, own, NUMBERS)

    @ti.func
    def meets_obstacles(self, i, scene: A):
        """Whether vertex i can touch obstacles."""
        meets_obstacles = False
        if ti.static(len(self.features.groups) > 0):
            meets_obstacles = scene.surface[i] > 0
        return meets_obstacles

    # ---- energy ------------------------------------------------------------------------------------------------------

    @ti.func
    def volume_ratio(self, H):
        return (H.matrix() + ti.Matrix.identity(self.fp, 3)).determinant()

    @traced
    def elastic_energies(self, e, scene, at, out):
        def see(q, H, numbers):
            k = e * len(self.single.points) + q
            psi = self.law.energy_density(H, numbers)
            assign(entry(out.elastic, k), psi * self.single.volume_of(e, scene.volumes, q))
            assign(entry(out.J, k), self.volume_ratio(H))

        self.single.each_seen(e, scene, at, 0, see)

    @as_kernel("energy", at=dict(u="vectors2"), out=dict(elastic="scalars", J="scalars", contact="scalars"))
    def energy(self, scene: A, pass_: A, at: A, out: A, plan: A):
        """Energy [J] and volume ratio of each point, energy of contact and friction [J] of each vertex."""
        ti.loop_config(serialize=not self.parallel)
        for e in range(plan.num_tetrahedra):
            self.elastic_energies(e, scene, at, out)
        self.contact_energies(scene, pass_, at, out, plan, True)

    @ti.func
    def contact_energies(self, scene: A, pass_: A, at: A, out: A, plan: A, friction: A):
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            value = ti.cast(0, self.fp)
            if self.meets_obstacles(i, scene):
                value = self.obstacles.total_energy(i, at.u[0, i], scene, pass_, plan, friction)
            out.contact[i] = value

    @as_kernel("barrier_energy", reads_law=False, at=dict(u="vectors2"), out=dict(contact="scalars"))
    def barrier_energy(self, scene: A, pass_: A, at: A, out: A, plan: A):
        """Energy of the barriers [J] of each vertex."""
        self.contact_energies(scene, pass_, at, out, plan, False)

    # ---- forces ------------------------------------------------------------------------------------------------------

    @ti.func
    def length(self, v):
        return ti.sqrt(v.norm_sqr())  # `norm` adds a float64 zero

    @as_kernel("forces", at=dict(u="vectors2"), out=dict(y="vectors2", size="scalars"))
    def forces(self, scene: A, pass_: A, at: A, out: A, plan: A):
        """Forces, and the sum of the sizes of what meets at a vertex, against which a rest is measured."""
        ti.loop_config(serialize=not self.parallel)
        for e in range(plan.num_items):
            self.element.forces(e, scene, at, 0, scene.corner)
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            pushed, total = self.obstacles.vector(0), self.obstacles.vector(0)
            if self.meets_obstacles(i, scene):
                pushed = self.obstacles.total_force(i, at.u[0, i], scene, pass_, plan)
            norm = self.length(pushed)
            for c in range(scene.start[i], scene.start[i + 1]):
                part = scene.corner[scene.corner_of[c]]
                total += part
                norm += self.length(part)
            out.y[0, i] = total + pushed
            out.size[i] = norm

    # ---- products with the stiffness ---------------------------------------------------------------------------------

    @ti.func
    def multiply(self, scene: A, pass_: A, at: A, out: A, plan: A, friction: A):
        ti.loop_config(serialize=not self.parallel)
        for e in range(plan.num_items):
            self.element.stiffness(e, scene, at, 0, scene.corner)
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            f = self.element.gather(i, scene, scene.corner)
            if self.meets_obstacles(i, scene):
                f += self.obstacles.total_product(i, at.u[0, i], at.w[0, i], scene, pass_, plan, friction)
            out.y[0, i] = f

    @ti.func
    def products(self, scene: A, pass_: A, at: A, out: A, plan: A):
        self.multiply(scene, pass_, at, out, plan, True)

    @cached_property
    def product(self) -> Kernel:
        """y = df/du w"""
        return self._kernel("product", self.products, at=dict(u="vectors2", w="vectors2"), out=dict(y="vectors2"))

    @as_kernel("stiffness", at=dict(u="vectors2", w="vectors2"), out=dict(y="vectors2"))
    def stiffness(self, scene: A, pass_: A, at: A, out: A, plan: A):
        """y = df/du w without friction: what bounds an explicit step."""
        self.multiply(scene, pass_, at, out, plan, False)

    # ---- block diagonal ----------------------------------------------------------------------------------------------

    @traced
    def tangent_column(self, e, scene, at, c, tangent):
        """Column c of d2psi/dF2 at each point q, nine numbers, to rows 81 q + 9 c .. 81 q + 9 c + 8 of its block."""
        el = self.element
        dH = Tensor(el.items.broadcast(ti.cast(c == k, self.fp)) for k in range(9))

        def see(q, H, numbers):
            dP = self.law.stress_differential(H, dH, numbers)
            el.items.put(tangent, 81 * len(el.points), e, 81 * q + 9 * c, dP.numbers)

        el.each_seen(e, scene, at, 0, see)

    @traced
    def corner_column(self, e, scene, d, tangent, corners, first):
        """Column d of the 3x3 block of -df_a/du_a of each corner a, a displacement e_d of it; corners from `first` on."""
        el = self.element
        B, volume = el.gradients_of(e, scene.gradients), el.volume_of(e, scene.volumes)
        zero = ti.cast(0, self.fp)
        N = [[let(sum_of(B[a, j] for a in range(3)) * ti.cast(-1, self.fp)) for j in range(3)]]
        N += [[B[a, j] for j in range(3)] for a in range(3)]
        C = [el.items.numbers(tangent, 9 * (3 * d + k), 9, 81, e) for k in range(3)]
        forces = []
        for a in range(4):
            dP = [let(sum_of(C[k][m] * N[a][k] for k in range(3)) * volume) for m in range(9)]
            forces.append([let(sum_of(dP[3 * i + j] * N[a][j] for j in range(3))) for i in range(3)])
        el.items.store(corners, e, forces, zero, first=first)

    @ti.func
    def contact_column(self, i, d, at: A, scene: A, pass_: A, plan: A):
        """Column d of df/du of obstacles at vertex i."""
        f = self.obstacles.vector(0)
        if self.meets_obstacles(i, scene):
            unit = self.obstacles.vector(0)
            for m in ti.static(range(3)):
                unit[m] = ti.select(d == m, ti.cast(1, self.fp), ti.cast(0, self.fp))
            f = self.obstacles.total_product(i, at.u[0, i], unit, scene, pass_, plan, True)
        return f

    @as_kernel("blocks", at=dict(u="vectors2"), out=dict(corners="vectors", tangent="blocks", blocks="vectors2"))
    def blocks(self, scene: A, pass_: A, at: A, out: A, plan: A):
        """d2psi/dF2 of each point, and the 3x3 diagonal blocks of -df/du, by columns; of ten nodes the tetrahedra's part is
        left to the host."""
        ti.loop_config(serialize=not self.parallel)
        for e in range(plan.num_items):
            for c in range(9):
                self.tangent_column(e, scene, at, c, out.tangent)
            if ti.static(self.features.order == 1):
                for d in range(3):
                    self.corner_column(e, scene, d, out.tangent, out.corners, d * (out.corners.shape[0] // 3))
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            for d in range(3):
                f = self.obstacles.vector(0)
                if ti.static(self.features.order == 1):
                    for c in range(scene.start[i], scene.start[i + 1]):
                        f += out.corners[d * (out.corners.shape[0] // 3) + scene.corner_of[c]]
                out.blocks[d, i] = f - self.contact_column(i, d, at, scene, pass_, plan)

    @as_kernel("contact_blocks", at=dict(u="vectors2"), out=dict(blocks="vectors2"))
    def contact_blocks(self, scene: A, pass_: A, at: A, out: A, plan: A):
        """The part of obstacles in `blocks`."""
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            for d in range(3):
                out.blocks[d, i] = 0 - self.contact_column(i, d, at, scene, pass_, plan)

    # ---- patches -----------------------------------------------------------------------------------------------------

    @as_kernel("pressure_forces", at=dict(u="vectors2"), out={})
    def pressure_forces(self, scene: A, pass_: A, at: A, out: A, plan: A):
        """Corner forces of a unit pressure in every patch."""
        ti.loop_config(serialize=not self.parallel)
        for e in range(plan.num_items):
            self.element.pressure_forces(e, scene, at, 0, scene.corner)

    # ---- derivatives by everything -----------------------------------------------------------------------------------

    @traced
    def change(self, at, tangent) -> Bundle:
        """What forces see of a change: w of the displacement, z of the law's state, `held` of what it holds in a pass."""
        own = {name: getattr(tangent, name) for name in ("z", "held") if hasattr(tangent, name)}
        return Bundle(u=at.w, **own)

    @as_kernel(
        "jvp",
        at=dict(u="vectors2", w="vectors2"),
        out=dict(y="vectors2"),
        tangent=lambda self: with_frozen(TANGENT | PASS, self.law),
    )
    def jvp(self, scene: A, pass_: A, at: A, out: A, tangent: A, plan: A):
        """Change y of the forces for changes w of the displacement and of everything else that they depend on."""
        ti.loop_config(serialize=not self.parallel)
        for e in range(plan.num_items):
            self.element.forces_jvp(e, scene, at, 0, self.change(at, tangent), scene.corner, tangent)
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            f = self.element.gather(i, scene, scene.corner)
            if self.meets_obstacles(i, scene):
                f = self.obstacles.add_jvp(i, f, at.u[0, i], at.w[0, i], scene, pass_, tangent, plan)
            out.y[0, i] = f

    @as_kernel(
        "vjp",
        at=dict(u="vectors2", w="vectors2"),
        out=dict(y="vectors2"),
        adjoint=lambda self: with_frozen(ADJOINT | dict(lag="vectors2", poses="vectors2"), self.law),
    )
    def vjp(self, scene: A, pass_: A, at: A, out: A, adjoint: A, plan: A):
        """y = df/du w (it is symmetric) and adjoints of the pass; adds the adjoints of all else that forces depend on."""
        ti.loop_config(serialize=not self.parallel)
        for e in range(plan.num_items):
            self.element.forces_vjp(e, scene, at, 0, at.w, scene.corner, adjoint, self.features.shape)
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            f = self.element.gather(i, scene, scene.corner)
            if self.meets_obstacles(i, scene):
                f = self.obstacles.add_vjp(i, f, at.u[0, i], at.w[0, i], scene, pass_, adjoint, plan)
            out.y[0, i] = f


def potential_kernels(law, features: Features, parallel: bool, lanes: bool) -> PotentialKernels:
    """Kernels for a law and a scene's features."""
    return kernels_of(PotentialKernels, law, features.of_state(), parallel, lanes)
