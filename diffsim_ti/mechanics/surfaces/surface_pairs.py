"""Contact within a run: the list of near pairs, kept while it holds, and the forces of its pairs."""

from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.common.public import Public
from diffsim_ti.mechanics.surfaces.broad_phase import CandidatePairs
from diffsim_ti.mechanics.surfaces.buffers import branches, whole
from diffsim_ti.mechanics.surfaces.listed_pair import MANY
from diffsim_ti.mechanics.surfaces.motion_kernels import BLOCK, MotionKernels
from diffsim_ti.mechanics.surfaces.obstacle_corners import ContactNumbers, SurfaceWithObstacles
from diffsim_ti.mechanics.surfaces.pair_kernels import PairKernels
from diffsim_ti.mesh.geometry import edges_of
from diffsim_ti.mesh.sets import pieces
from diffsim_ti.runtime import kernels_of
from diffsim_ti.terms.self_contact import SelfContact


class Tunnelling(FloatingPointError, metaclass=Public):
    """Surfaces moved so far in one substep that they may have crossed. Of explicit steps it carries stable_dt [s], a substep
    that is short enough."""

    stable_dt: float | None = None
    stiffness: None = None  # no error asks for another one; goes with the next version

    @property
    def enough(self) -> float | None:
        """A substep [s] that is short enough, None where no substep is."""
        return self.stable_dt


class Overlap(ValueError):
    """A state in which surfaces touch or pass through each other, or an obstacle reaches into a face."""

    apart = None  # displacements that static solves begin from instead (solvers/implicit/overlap.py)


class SurfacePairs:
    """Pairs of surface primitives of a scene with a SelfContact term (terms/self_contact.py), or with obstacles that act by
    pairs, whose corners are vertices of the surface too (obstacle_corners.py).

    The list holds all pairs that were within the width and the slacks of their vertices when it was made, and holds good
    until a vertex has used up one of its two slacks: the one towards its own body by moving relative to that body, the one
    towards others by moving relative to the mean of all bodies. Slacks follow the motion since the list before.
    Pairs beyond the width add exact zeros, in a fixed order, so that forces have the same bits whatever the list's age.
    Forces go to the last corners of an array of corners, one for each surface vertex (state/arrays.py).
    """

    friction_kind: type | None = None  # of implicit passes; explicit ones have it in their stage (contact_stage.py)
    typical_slack = 0.5  # share of the width that half of the vertices get at most, so that lists stay short
    fewest_passes, most_passes = 3, 30  # that a list should last, by its slacks, but
    least_slack = 0.1  # they are at least this share of the width, and
    # width + 2 slack at most this share of an edge, of one body (with many neighbours) and of two
    largest_reach = (1.0, 2.0)
    most_edges = 4.0  # mean edges that the width may have
    markers = 16  # vertices whose mean motion is that of a body

    def __init__(self, arrays, parallel: bool):
        self.a, mesh, term = arrays, arrays.mesh, arrays.self_contact
        self.kinematic = mesh if isinstance(mesh, SurfaceWithObstacles) else None
        self.contacts = ContactNumbers(mesh, arrays) if self.kinematic else None
        self.mesh, self.parallel = mesh, parallel
        self.first = MANY if self.kinematic else arrays.parameters_of_self_contact.start
        self.kernels = kernels_of(PairKernels, arrays.precision, self.first, parallel)
        self.forces_kernel = self.kernels.forces
        self.motion = kernels_of(MotionKernels, arrays.precision, self.first, parallel)
        edges = mesh.edges if self.kinematic else edges_of(mesh.surface_triangles)[0]
        lengths = np.linalg.norm(mesh.vertices[edges[:, 1]] - mesh.vertices[edges[:, 0]], axis=1)
        self.edges, self.term = edges, term
        self.body = np.full(mesh.num_vertices, -1)
        body = mesh.pieces() if self.kinematic else pieces(mesh)
        self.body[mesh.surface_vertices] = np.unique(body[mesh.surface_vertices], return_inverse=True)[1]
        surface = mesh.surface_vertices, mesh.surface_triangles, edges, lengths, self.body
        self.list = CandidatePairs(*surface, arrays.precision, parallel, self.kinematic)
        self._launch, n, vector = self.list.launch, len(mesh.surface_vertices), self.kernels.vec4
        self.launch = self._launch.run
        self.before, self.built, self.sums, self.rest_adj = (runtime.array(vector, n) for _ in range(4))
        self.none, self.flags = runtime.array(vector, 1), runtime.array(ti.i32, 3)
        self.sizes = dict(num_surface=n, first_out=arrays.first_contact_corner)  # and more, of the present list
        marked = spread(self.body[mesh.surface_vertices], self.markers)
        self.num_bodies, self.marked = len(marked), runtime.upload(marked.ravel(), ti.i32)
        bodies, blocks = branches(self.num_bodies), -(-n // BLOCK)
        upper = branches(blocks)
        self.sizes_of_motion = dict(body_block=bodies["size"], body_blocks=bodies["number"], blocks=blocks, **upper)
        self.sizes_of_motion |= dict(num_bodies=self.num_bodies, markers=self.markers)
        self.frame = runtime.array(vector, self.num_bodies + 2 + 2 * bodies["number"])
        self.farthest = runtime.array(self.kernels.fp, 1 + blocks + upper["number"])
        self.touched = runtime.array(ti.i32, n)
        self.fresh, self.age, self.builds = False, 0, 0
        self.checked_rest = self._scratch = None
        self.has_friction = len(self.contacts.mu) > 0 if self.kinematic else term.has_friction
        self.friction = self.friction_kind(self) if self.friction_kind and self.has_friction else None

    def _number(self, place: int) -> float:
        return float(self.a.values.parameters[self.a.parameters_of_self_contact.start + place])

    @property
    def width(self) -> float:
        """The width [m] of pairs of bodies; without these the largest."""
        return self._number(SelfContact.index.width) if self.term else float(self.contacts.widths[1:].max())

    @property
    def least_width(self) -> float:
        if not self.kinematic:
            return self.width
        return float(self.contacts.widths[0 if self.term else 1 :].min())

    @property
    def longest_reach(self) -> float:
        """How far from bodies a list may have what is of obstacles [m], unless more is needed."""
        least = self.least_slack * self.width
        slacks = (max(least, 0.5 * (x * self.list.typical - self.width)) for x in self.largest_reach)
        return self.width + 2 * (sum(slacks) + max(float(self.contacts.reach.max()) - self.width, 0.0))

    def load(self, u) -> None:
        """New values, the start at u: raise ValueError if the width is too large."""
        self.fresh = False
        if self.kinematic:
            self.contacts.load(self.a.values.parameters)
        checked = (self.a.values.rest, self.width)
        if self.checked_rest is None or self.checked_rest[0] is not checked[0] or self.checked_rest[1] != checked[1]:
            rest_state = runtime.array(self.kernels.vec4, 1, self.a.num_vertices)
            runtime.fill(rest_state, 0)
            self._check_rest(rest_state)
            self.checked_rest = checked
        self.build(u, 0)

    def _check_rest(self, u) -> None:
        if not self.term:
            return
        largest = self.most_edges * self.list.typical
        if self.width > largest:
            raise ValueError(
                f"self-contact of width {self.width:.3g} m: more than {self.most_edges:g} times the mean edge of the "
                f"surface, so that most of its pairs would be near at rest; take a width below {largest:.3g} m"
            )
        self.build(u, 0)
        plane = whole(self.rest_plane)[: self.list.count]
        if plane.size and not plane[:, 3].min() > 0:
            worst, pairs = plane[:, 3].argmin(), runtime.fetch(self.list.pairs)[: 4 * self.list.count].reshape(-1, 4)
            raise ValueError(
                f"self-contact: {self._name(worst, pairs)} of one body touch at rest, so that no width is left to them; "
                "move them apart in the mesh, or join their vertices"
            )

    def check_apart(self, u) -> None:
        """Raise Overlap if surfaces touch or pass through each other at u[0]."""
        if not self.fresh or self.age:
            self.build(u, 0)
        found = self.list.first_piercing(self.a.rest, u, 0)
        if found:
            edge, triangle = self.part("edge", self.edges[found[0]]), self.mesh.surface_triangles[found[1]]
            raise Overlap(
                f"surfaces pass through each other: {edge} and triangle {_numbers(triangle)}; move the bodies apart"
            )
        gaps, pairs = self._distances(u)
        if gaps.size and not gaps.min() > 0:
            worst = int(gaps.argmin())
            raise Overlap(f"surfaces touch: {self._name(worst, pairs)}; move the bodies apart")

    def forget(self, u) -> None:
        """The state was set from outside."""
        self.age = 0
        self.build(u, 0)

    obstacles = nearby = None  # of pairs with vertices that no node gives (curved_pairs.py)

    def follow(self, rows: np.ndarray, m: int) -> None:
        """Obstacles are where rows of poses say."""

    def prepared(self, kernel, at: dict, *more, **numbers) -> tuple:
        """A kernel of pairs, its records, of the arrays `at` and `more` of the scene, and its numbers."""
        k, a, mine = self.list, self.a, (self.contacts,) if self.kinematic else ()
        scene = *more, k, self, *mine, SimpleNamespace(rest=a.rest, parameters=a.parameters)
        return kernel, dict(scene=scene, at=SimpleNamespace(**at)), self.sizes | numbers if numbers else self.sizes

    def run(self, kernel, at: dict, *more, **numbers) -> None:
        """Launch a kernel of pairs."""
        self.launch([self.prepared(kernel, at, *more, **numbers)])

    # ---- the list ---------------------------------------------------------------------------------------------------

    def build(self, u, slot: int, wanted=0.0, needed=0.0) -> None:
        """The list at u[slot]; slacks follow the motion, or cover `wanted` unless that is long, and `needed`, of shape
        (n, 2) [m]."""
        x = runtime.fetch(u, slot)[self.mesh.surface_vertices]
        if not np.all(np.isfinite(x)):  # the guard of the run will say so
            return
        runtime.fill(self.list.slack, self._slacks(x, wanted, needed))
        self.list.build(self.a.rest, u, slot, self.width)
        count, take = self.list.count, self.list.buffers.take
        self.sizes |= dict(num_vt=self.list.num_vt, num_pairs=count)
        vector, fp = self.kernels.vec4, self.kernels.fp
        self.corner, self.plane = take("forces", vector, 4 * count), take("planes", vector, count)
        self.energy, self.numbers = take("energies", fp, count), take("numbers", vector, count)
        self.rest_plane, self.rest_weights = take("planes at rest", vector, count), take("weights", vector, count)
        if self.friction:
            self.friction.take("weights", "pressing")
        self.run(self.motion.begin, dict(u=u), slot=slot)
        self.fresh, self.age = True, 0
        self.builds += 1

    def _slacks(self, x: np.ndarray, wanted, needed=0.0) -> np.ndarray:
        """Slacks [m] of the surface vertices towards their own body and others, shape (n, 4), for displacements x."""
        slack, least = np.zeros((len(x), 4)), self.least_slack * self.width
        slack[:, :2] = wanted
        if self.kinematic:
            own = self.kinematic.owner
            slack[:, 2] = np.where(own > 0, np.maximum(self.contacts.reach[own] - self.width, 0), 0)
        if self.fresh and self.age:
            overall, last = self.travel(x - runtime.fetch(self.built)), self.travel(x - runtime.fetch(self.before))
            pace = np.maximum(overall / self.age, last)
            pace += pace.mean(0)  # the mean, for what will be hit
            passes = self.typical_slack * self.width / max(float(np.median(pace.max(1))), 1e-300)
            slack[:, :2] = np.maximum(np.clip(passes, self.fewest_passes, self.most_passes) * pace, wanted)
            # the slack before, for what shakes
            slack[:, :2] = np.maximum(slack, 0.9 * whole(self.list.slack))[:, :2]
        for k, largest in enumerate(self.largest_reach):
            slack[:, k] = slack[:, k].clip(least, max(least, 0.5 * (largest * self.list.typical - self.width)))
        slack[:, :2] = np.maximum(slack[:, :2], needed)
        return slack

    def travel(self, move: np.ndarray) -> np.ndarray:
        """Lengths of surface vertices' motions relative to their body's and to the mean of all, shape (n, 2)."""
        frame = move[runtime.fetch(self.marked).reshape(self.num_bodies, -1)].mean(1)
        origins = frame[self.body[self.mesh.surface_vertices]], frame.mean(0)
        return np.stack([np.linalg.norm(move - origin, axis=1) for origin in origins], 1)

    def unbind(self) -> None:
        """Let go of the arrays that forces were computed from."""
        self._launch.clear()

    def holds(self, u, slot: int) -> bool:
        """Whether the list holds at u[slot]."""
        return self.fresh and not self.look_at(self.motion.holds, u, slot)[0]

    def look_at(self, kernel, u, slot: int) -> tuple[bool, bool, bool]:
        """The `flags` of a kernel that follows the motion to u[slot] since the list was made."""
        self.run(kernel, dict(u=u), slot=slot, lost=0.5 * self.least_width, **self.sizes_of_motion)
        flags = runtime.view(self.flags)
        return tuple(bool(x) for x in (runtime.fetch(self.flags) if flags is None else flags))

    def ensure(self, u, slot: int) -> None:
        """Make the list anew if it does not hold at u[slot]."""
        if not self.holds(u, slot):
            self.age = 0  # a jump says nothing of the pace
            self.build(u, slot)

    def _name(self, pair: int, pairs: np.ndarray) -> str:
        c = pairs[pair]
        if pair < self.list.num_vt:
            return f"{self.part('vertex', c[:1])} and triangle {_numbers(c[1:])}"
        if self.kinematic and self.kinematic.name(c[2]):
            return f"edge {_numbers(c[:2])} and {self.part('edge', c[2:])}"
        return f"edges {_numbers(c[:2])} and {_numbers(c[2:])}"

    def part(self, kind: str, corners: np.ndarray) -> str:
        """A vertex or an edge in words."""
        obstacle = self.kinematic.name(corners[0]) if self.kinematic else None
        if obstacle is None:
            return f"{kind} {_numbers(corners) if len(corners) > 1 else corners[0]}"
        return f"an edge of {obstacle!r}" if len(corners) > 1 else f"a point of {obstacle!r}"

    # ---- forces -----------------------------------------------------------------------------------------------------

    def forces(self, u, slot: int, out, exact: bool = False) -> None:
        """Contact forces at u[slot], to the last corners of `out`."""
        self.run(self.forces_kernel, dict(u=u, out=out), slot=slot, exact=int(exact))

    def product(self, u, slot: int, w, out, rest_dot=None, parameters_dot=None, poses_dot=None, only=None) -> None:
        """Change of the contact forces for changes w[0] of the positions (and of the rest shape and all parameters).

        poses_dot: changes of the rows of poses, which only CurvedPairs has; only: of the pairs of one contact.
        """
        at = dict(u=u, w=w, rest_dot=self.none if rest_dot is None else rest_dot, out=out)
        numbers = dict(d_stiffness=0.0, d_width=0.0, by_rest=int(rest_dot is not None))
        if self.kinematic:
            self.contacts.load_change(self.a.values.parameters, parameters_dot)
            at |= dict(numbers_dot=self.contacts.numbers_dot)
            numbers |= dict(only=-1 if only is None else only)
        elif parameters_dot is not None:
            change = parameters_dot[self.a.parameters_of_self_contact][:2]
            numbers |= dict(zip(("d_stiffness", "d_width"), map(float, change)))
        self.run(self.kernels.products, at, slot=slot, **numbers)

    def clear_sums(self) -> None:
        """Begin a reverse sweep."""
        runtime.fill(self.sums, 0)
        runtime.fill(self.rest_adj, 0)
        if self.friction:
            self.friction.clear_sums()

    def vjp(self, u, slot: int, w, out, only: int | None = None) -> None:
        """The product with the adjoint w[0] of the forces; adds the adjoints of stiffness, width and rest shape."""
        self.product(u, slot, w, out, only=only)
        self.run(self.kernels.add_sums, dict(out=out), slot=slot)

    def collect(self) -> tuple[np.ndarray, np.ndarray]:
        """Adjoints of all parameters and of the rest shape, (num_vertices, 3), by the forces and friction; float64."""
        rest, out = np.zeros((self.mesh.num_vertices, 3)), np.zeros_like(self.a.values.parameters)
        rest[self.mesh.surface_vertices] = runtime.fetch(self.rest_adj)
        sums = whole(self.sums).astype(np.float64)
        if self.kinematic:
            self.contacts.collect(self.a.values.parameters, sums[: len(self.mesh.surface_vertices)], out)
        else:
            out[self.a.parameters_of_self_contact][:2] = sums.sum(0)[:2]
        if self.friction:
            self.friction.collect(out)
        return out, rest

    # ---- to look at -------------------------------------------------------------------------------------------------

    def _distances(self, u) -> tuple[np.ndarray, np.ndarray]:
        """Distances [m] and corners of all pairs of the list at u[0]."""
        if self._scratch is None:
            self._scratch = runtime.array(self.kernels.vec4, self.a.first_contact_corner + self.list.num_surface)
        self.forces(u, 0, self._scratch, exact=True)
        pairs = runtime.fetch(self.list.pairs)[: 4 * self.list.count].reshape(-1, 4)
        return whole(self.plane)[: self.list.count, 3].astype(np.float64), pairs

    def look(self, u) -> tuple[float, float]:
        """Contact energy [J] and smallest gap [m] (infinite beyond the list's reach) at u[0]."""
        self.ensure(u, 0)
        gaps, _ = self._distances(u)
        energies = runtime.fetch(self.energy)[: self.list.count].astype(np.float64)
        return float(energies.sum()), float(gaps.min(initial=np.inf))


def spread(body: np.ndarray, count: int) -> np.ndarray:
    """`count` members of each body, evenly spread over their numbers, repeated where there are fewer; (bodies, count)."""
    members = np.argsort(body, kind="stable")
    first = np.searchsorted(body[members], np.arange(body.max() + 2))
    share = (np.arange(count) + 0.5) / count
    return members[(first[:-1, None] + np.diff(first)[:, None] * share).astype(int)]


def _numbers(indices) -> str:
    return "(" + ", ".join(str(int(i)) for i in indices) + ")"
