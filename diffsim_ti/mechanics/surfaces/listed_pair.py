"""A pair of a list in kernels: its corners, what it writes to them, and what a surface vertex sums of all its pairs.

There are no atomics: each pair writes to its four corners, and each surface vertex sums its corners in order. What vertex s
gets is written to `out[first_out + s]`, one more corner for the gather of the tetrahedra's forces.
"""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.mechanics.surfaces.proximity import EDGE_EDGE, VERTEX_TRIANGLE, Pair
from diffsim_ti.runtime import A, Kernel, traced
from diffsim_ti.terms.self_contact import SelfContact

MARGIN = 1.001
MANY = -1
SAFE = 0.9  # share of its gap by which a pair may close on the way of one step
# which corners belong to different primitives
OPPOSITE = (((0, 1), (0, 2), (0, 3)), ((0, 2), (0, 3), (1, 2), (1, 3)))
LIST = dict(pairs="ints", scale="scalars", surface="ints", place="ints", row="ints", corner_of="ints")  # broad_phase.py
SCENE = LIST | dict(rest="vectors", parameters="scalars", corner="vectors", plane="vectors")
SCENE |= dict(rest_plane="vectors", rest_weights="vectors")  # motion_kernels.py
MIXED = dict(owner="ints", at_number="ints", at_row="ints", radius="scalars", area="scalars")  # obstacle_corners.py
NUMBERS = dict.fromkeys(("slot", "num_vt", "num_pairs", "num_surface", "first_out"), "int")


@traced
def first_of(kind, plan):
    """The first pair of a kind, and below the one behind its last: no sums, for which a GPU would take a task each."""
    return 0 if kind == VERTEX_TRIANGLE else plan.num_vt


@traced
def behind(kind, plan):
    return plan.num_vt if kind == VERTEX_TRIANGLE else plan.num_pairs


@ti.func
def three(y):
    """The first three components."""
    return ti.Vector([y[0], y[1], y[2]])


@ti.func
def between(x: A, i, k, slot):
    """x_k - x_i of the vertices' vectors in a slot."""
    return three(x[slot, k] - x[slot, i])


@ti.func
def at_rest(rest: A, i, k):
    """X_k - X_i of the rest shape's vectors."""
    return three(rest[k] - rest[i])


@dataclass(frozen=True)
class ListedPair(Pair):
    """Taichi functions of pair p of a list; those of edges follow those of vertex and triangle.

    first: where the scene's parameters begin with stiffness and width. parallel: loops run on all threads.
    first = MANY: pairs are of several contacts (obstacle_corners.py). `owner` says of each surface vertex the number of its
    contact: 0 of bodies, and so of pairs of them, 1 and on of obstacles. The places of stiffness, width and friction speed
    of contact c among the parameters are at_number[3 c] and on, at_row says those of friction coefficients, radius[c] is
    its radius; the stiffness of each pair is multiplied by its `area`.
    """

    first: int
    parallel: bool

    def _kernel(self, name: str, body, at: dict, scene: dict | None = None, **numbers) -> Kernel:
        """A kernel on the arrays of SCENE and more, and on those it is called `at`."""
        arrays = SCENE | (MIXED if self.mixed else {}) | (scene or {})
        return Kernel(name, body, self.precision, dict(scene=arrays, at=at), NUMBERS | numbers)

    @property
    def mixed(self) -> bool:
        return self.first == MANY

    @ti.func
    def contact_of(self, p, scene: A):
        """Number of the contact of pair p, whose other primitive has number 0."""
        one, two = scene.place[scene.pairs[4 * p]], scene.place[scene.pairs[4 * p + 2]]
        return ti.max(scene.owner[one], scene.owner[two])

    @ti.func
    def corner_of_contact(self, p, scene: A):
        """The corner of pair p whose vertex says its contact, at which adjoints of the contact's numbers are summed."""
        out = 0
        if ti.static(self.mixed):
            out = ti.select(scene.owner[scene.place[scene.pairs[4 * p + 2]]] > 0, 2, 0)
        return out

    @ti.func
    def radius_of(self, p, scene: A):
        out = ti.cast(0, self.fp)
        if ti.static(self.mixed):
            out = scene.radius[self.contact_of(p, scene)]
        return out

    @ti.func
    def of_term(self, p, scene: A, parameters: A):
        """(stiffness, width) of the contact of pair p among all parameters, or a change of these."""
        k, W = ti.cast(0, self.fp), ti.cast(0, self.fp)
        if ti.static(self.mixed):
            number = 3 * self.contact_of(p, scene)
            k, W = scene.area[p] * parameters[scene.at_number[number]], parameters[scene.at_number[number + 1]]
        else:
            k = parameters[self.first + SelfContact.index.stiffness]
            W = parameters[self.first + SelfContact.index.width]
        return k, W

    @ti.func
    def own_share(self, p, scene: A):
        """What pair p has of the scene's width: all, but no more than half of its distance at rest."""
        _, W = self.of_term(p, scene, scene.parameters)
        return ti.min(ti.cast(1, self.fp), ti.cast(0.5, self.fp) * scene.rest_plane[p][3] / W)

    @ti.func
    def numbers(self, p, scene: A):
        """Stiffness and width of pair p (docstring of SelfContact)."""
        share = self.own_share(p, scene)
        k, W = self.of_term(p, scene, scene.parameters)
        return k / share, share * W

    @ti.func
    def width(self, p, scene: A):
        _, width = self.numbers(p, scene)
        return width

    @ti.func
    def numbers_jvp(self, p, scene: A, d_stiffness, d_width, d_rest):
        """Changes of stiffness and width of pair p for those of the scene's and of the pair's distance at rest."""
        share, d_share = self.own_share(p, scene), ti.cast(0, self.fp)
        k, W = self.of_term(p, scene, scene.parameters)
        if share < 1:
            d_share = (ti.cast(0.5, self.fp) * d_rest - share * d_width) / W
        return (d_stiffness - k / share * d_share) / share, share * d_width + W * d_share

    @ti.func
    def numbers_vjp(self, p, scene: A, by_stiffness, by_width):
        """Adjoints of the scene's stiffness and width and of the pair's distance at rest."""
        share, by_share = self.own_share(p, scene), ti.cast(0, self.fp)
        k, W = self.of_term(p, scene, scene.parameters)
        if share < 1:
            by_share = W * by_width - k / (share * share) * by_stiffness
        by_k = by_stiffness / share
        if ti.static(self.mixed):
            by_k *= scene.area[p]
        return by_k, share * (by_width - by_share / W), ti.cast(0.5, self.fp) * by_share / W

    @ti.func
    def is_active(self, p, scene: A):
        """Whether pair p is nearer than the width, by the plane that `forces` left here."""
        return not scene.plane[p][3] > self.width(p, scene)

    @ti.func
    def scale_of(self, kind: A, p, scene: A, plan: A):
        """What |a x b| of a pair of edges is measured by."""
        scale = ti.cast(0, self.fp)
        if ti.static(kind == EDGE_EDGE):
            scale = scene.scale[p - plan.num_vt]
        return scale

    @ti.func
    def entry(self, x, k):
        """x[k], k known when the kernel runs."""
        out = x[0]
        for a in ti.static(range(1, 4)):
            if k == a:
                out = x[a]
        return out

    @ti.func
    def four(self, y):
        return self.vec4(y[0], y[1], y[2], ti.cast(0, self.fp))

    @ti.func
    def changes(self, p, scene: A, x: A, slot):
        """Vectors of corners 1 to 3 of pair p relative to corner 0's."""
        c0, c1, c2, c3 = scene.pairs[4 * p], scene.pairs[4 * p + 1], scene.pairs[4 * p + 2], scene.pairs[4 * p + 3]
        return between(x, c0, c1, slot), between(x, c0, c2, slot), between(x, c0, c3, slot)

    @ti.func
    def changes_at_rest(self, p, scene: A, rest: A):
        """The same of vectors of the rest shape."""
        c0, c1, c2, c3 = scene.pairs[4 * p], scene.pairs[4 * p + 1], scene.pairs[4 * p + 2], scene.pairs[4 * p + 3]
        return at_rest(rest, c0, c1), at_rest(rest, c0, c2), at_rest(rest, c0, c3)

    @ti.func
    def corners(self, p, scene: A, u: A, slot):
        """Positions of corners 1 to 3 of pair p relative to corner 0."""
        y1, y2, y3 = self.changes_at_rest(p, scene, scene.rest)
        u1, u2, u3 = self.changes(p, scene, u, slot)
        return y1 + u1, y2 + u2, y3 + u3

    @ti.func
    def store(self, p, scene: A, g1, g2, g3):
        """Forces, minus the gradient, of the four corners."""
        zero = self.vec3(0)
        scene.corner[4 * p] = self.four(g1 + g2 + g3)
        scene.corner[4 * p + 1] = self.four(zero - g1)
        scene.corner[4 * p + 2] = self.four(zero - g2)
        scene.corner[4 * p + 3] = self.four(zero - g3)

    @ti.func
    def sum_corners(self, scene: A, out: A, plan: A):
        """What the pairs of each surface vertex have stored for it."""
        ti.loop_config(serialize=not self.parallel)
        for s in range(plan.num_surface):
            total = self.vec4(0)
            for k in range(scene.row[s], scene.row[s + 1]):
                total += scene.corner[scene.corner_of[k]]
            out[plan.first_out + s] = total

    @ti.func
    def each_pair(self, act: A, scene: A, at: A, plan: A):
        """act(kind, p, scene, at, plan) of every pair."""
        for kind in ti.static((VERTEX_TRIANGLE, EDGE_EDGE)):
            ti.loop_config(serialize=not self.parallel)
            for p in range(first_of(kind, plan), behind(kind, plan)):
                act(kind, p, scene, at, plan)

    @ti.func
    def all_products(self, scene: A, at: A, plan: A):
        """`product` of every pair, which a subclass has, and their sums by vertex."""
        self.each_pair(self.product, scene, at, plan)
        self.sum_corners(scene, at.out, plan)
