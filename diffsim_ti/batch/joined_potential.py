"""The potential energy of all scenes of a batch with its kernels and preconditioners, and what obstacles let pass."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.batch.joined_cg import JoinedCG, pieces_of
from diffsim_ti.batch.joined_scene import of_scenes
from diffsim_ti.mechanics.energy.kernels import PotentialKernels
from diffsim_ti.mechanics.energy.potential import Potential
from diffsim_ti.mechanics.obstacles.collision_detection import CollisionDetection
from diffsim_ti.mechanics.obstacles.obstacle_collisions import ObstacleCollisions
from diffsim_ti.mechanics.obstacles.obstacle_shares import ObstacleShares
from diffsim_ti.mechanics.obstacles.obstacles import ObstaclePotential
from diffsim_ti.mechanics.obstacles.swept import SweptKernels
from diffsim_ti.runtime import Bundle, Kernel, Piecewise, at, kernels_of, let, traced
from diffsim_ti.runtime.piecewise import Piece
from diffsim_ti.solvers.implicit.preconditioned import Preconditioners
from diffsim_ti.state.obstacle_poses import Moment

A = ti.template()
BY_SCENE = "energy", "forces", "contact_blocks"  # kernels that leave out scenes which rest


class ReadsScenes:
    """Kernels that read which scene a vertex belongs to."""

    def _kernel(self, name, body, *more, **arrays):
        kernel = super()._kernel(name, body, *more, **arrays)
        own = kernel.arrays | dict(scene=kernel.arrays["scene"] | dict(scene_of="ints"))
        return Kernel(name, body, self.precision, own, {n: kernel.kinds[n] for n in kernel.numbers})


class SeesOneScene(ReadsScenes):
    """Functions of obstacles at vertex i, which see the numbers of its scene."""

    @traced
    def seen_at(self, i, scene, *more):
        """The scene of vertex i, and of other records the numbers of that."""
        vertices = scene.scene_of.shape[0] - 1
        b, count = let(at(scene.scene_of, i)), let(at(scene.scene_of, vertices))
        return [self._own(record, b, count) for record in (scene, *more)]

    @traced
    def _own(self, record, b, count):
        there = {name: x for name, x in vars(record).items() if name in ("parameters", "poses", "places", "drifts")}
        own = {name: Piece(x, let(b * (x.shape[0] // count))) for name, x in there.items()}
        return Bundle(**vars(record) | own)


def of_one(name: str, vertex: int, first: int):
    """A function of `one`, for which the records from the argument `first` on, two, are those of a vertex's scene."""

    @traced
    def call(self, *given):
        own = self.seen_at(given[vertex], *given[first : first + 2])
        return getattr(self.one, name)(*given[:first], *own, *given[first + 2 :])

    return call


@dataclass(frozen=True)
class ObstaclesOfScenes(SeesOneScene, ObstaclePotential):
    @cached_property
    def one(self) -> ObstaclePotential:
        return ObstaclePotential(self.features, self.precision)

    total_energy, total_force = of_one("total_energy", 0, 2), of_one("total_force", 0, 2)
    total_product, add_vjp = of_one("total_product", 0, 3), of_one("add_vjp", 0, 4)


@dataclass(frozen=True)
class JoinedKernels(ReadsScenes, PotentialKernels):
    """skip: 1 of a scene whose products are not wanted."""

    @cached_property
    def obstacles(self) -> ObstaclesOfScenes:
        return ObstaclesOfScenes(self.features, self.law.precision)

    @property
    def precision(self) -> str:
        return self.law.precision

    @ti.func
    def is_wanted(self, at: A, plan: A):
        return at.skip[0] == 0

    @cached_property
    def wanted(self) -> Kernel:
        """Whether a scene is, for `Piecewise`."""
        return Kernel("wanted", self.is_wanted, self.law.precision, dict(at=dict(skip="ints")), {})

    @ti.func
    def products(self, scene: A, pass_: A, at: A, out: A, plan: A):
        items = plan.num_items // at.skip.shape[0]
        ti.loop_config(serialize=not self.parallel)
        for e in range(plan.num_items):
            if at.skip[e // items] == 0:
                self.element.stiffness(e, scene, at, 0, scene.corner)
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            if at.skip[scene.scene_of[i]] == 0:
                f = self.element.gather(i, scene, scene.corner)
                if self.meets_obstacles(i, scene):
                    f += self.obstacles.total_product(i, at.u[0, i], at.w[0, i], scene, pass_, plan, True)
                out.y[0, i] = f

    @cached_property
    def product(self) -> Kernel:
        own = dict(at=dict(u="vectors2", w="vectors2", skip="ints"), out=dict(y="vectors2"))
        return self._kernel("product", self.products, **own)


@dataclass(frozen=True)
class SweptOfScenes(SeesOneScene, SweptKernels):
    @cached_property
    def one(self) -> SweptKernels:
        return SweptKernels(self.features, self.precision, self.parallel)

    share_of_one, gap = of_one("share_of_one", 2, 3), of_one("gap", 2, 4)


@dataclass(frozen=True)
class SharesOfScenes(SeesOneScene, ObstacleShares):
    """What each obstacle of its scene does to a vertex."""


class JoinedPotential(Potential):
    """Energies are those of each scene; scenes with a 1 in `skip` are left out."""

    kernels_kind = JoinedKernels

    def __init__(self, arrays, *more):
        super().__init__(arrays, *more)
        self.poses = runtime.array(arrays.vector, arrays.num_scenes * arrays.poses.size)
        self.skip = runtime.array(ti.i32, arrays.num_scenes)

    def launch(self, name, lanes=True, **records):
        if name == "contact_blocks" and self.hosts:  # who add to those of all scenes
            runtime.fill(self.skip, 0)
        if name not in BY_SCENE or not self.arrays.by_scene:
            return super().launch(name, lanes, **records)
        if name not in self._launches:
            parts = [
                (self.kernels.wanted, self._records, None),
                (getattr(self.of_one, name), self._records | records, None),
            ]
            self._launches[name] = self.repeated(f"{name}_of_scenes", [parts], False, lanes and self.arrays.in_vectors)
        self._launches[name](1, **self.sizes())

    @property
    def of_one(self) -> PotentialKernels:
        a = self.arrays
        if not a.by_scene:
            return self.kernels
        return kernels_of(PotentialKernels, a.law, a.features().of_state(), False, a.in_lanes)

    def repeated(self, name, groups, parallel, vectorized=True):
        a = self.arrays
        if not a.by_scene:
            return super().repeated(name, groups, parallel, vectorized)
        return Piecewise(name, groups, a.num_scenes, pieces_of(a.features().uniform), vectorized)

    def only(self, scenes: np.ndarray) -> None:
        """Let what follows be of some scenes, a mask; of others what was found before stays."""
        runtime.fill(self.skip, ~scenes)

    def energies_beside(self):
        own = [part.energies(self.held_at) for part in self.hosts]
        return np.concatenate([np.zeros((self.arrays.num_scenes, 0)), *own], 1)

    def product(self, w, convex=False):
        runtime.fill(self.skip, 0)
        return super().product(w, convex)


class JoinedDetection(CollisionDetection):
    kernels_kind = SweptOfScenes
    of_one = property(lambda self: kernels_of(SweptKernels, self.a.features().of_state(), self.a.precision, False))

    def __init__(self, arrays, parallel: bool):
        super().__init__(arrays, parallel)
        rows = arrays.num_scenes * (arrays.poses.size // 3)
        self.way.places, self.way.drifts = (runtime.array(arrays.vector, rows) for _ in range(2))

    def _lowest(self, most: float) -> np.ndarray:
        scenes = self.a.num_scenes
        return of_scenes(runtime.fetch(self.found.found).astype(np.float64), scenes).min(1, initial=most)

    def shares(self, u, step, places, drifts=0.0, most: float = 1.0, kept: float = 0.1) -> np.ndarray:
        """`share` of each scene."""
        if not self.terms or not (np.any(step) or np.any(drifts)):
            return np.full(self.a.num_scenes, most)
        self.share(u, step, places, drifts, most, kept)
        return self._lowest(most)

    def are_apart(self, u, places) -> np.ndarray:
        """Whether no vertex of a scene is in an obstacle."""
        if not self.terms:
            return np.ones(self.a.num_scenes, bool)
        self.nearest(u, places)
        return self._lowest(1e-30) >= 1e-30


class JoinedCollisions(ObstacleCollisions):
    """Of all scenes, whose rows stand one after the other."""

    detection_kind = JoinedDetection

    def _paths(self, path) -> np.ndarray | list:
        count = self.ws.arrays.num_scenes
        return [None] * count if path is None else of_scenes(path, count, axis=1)

    def begin(self, j, stage):
        poses, moment = self.ws.arrays.poses, self.moment(j, stage)
        paths = self._paths(self.ws.arrays.rows["path"])
        for path in paths:
            poses.check(path, moment)
        self.rows = np.concatenate([poses.value(path, moment) for path in paths])
        self.at_stage, self.before = self.rows[::3].copy(), self.rows[1::3].copy()

    def vjp(self, rows_adj, j, stage, path_adj):
        moment, count = self.moment(j, stage), self.ws.arrays.num_scenes
        paths, own = self._paths(self.ws.arrays.rows["path"]), self._paths(path_adj)
        for path, rows, adjoint in zip(paths, of_scenes(rows_adj, count), own):
            self.ws.arrays.poses.vjp(path, rows, moment, adjoint)

    def drift(self, before, after) -> np.ndarray:
        """How obstacles of all scenes go from places to others."""
        count, poses = self.ws.arrays.num_scenes, self.ws.arrays.poses
        if not len(before):
            return after - before
        return np.concatenate([poses.drift(*own) for own in zip(of_scenes(before, count), of_scenes(after, count))])

    def moved(self, places, drift, shares: np.ndarray) -> np.ndarray:
        """Where obstacles are when each scene has done a share of the drift."""
        each = zip(of_scenes(places, len(shares)), of_scenes(drift, len(shares)), shares)
        return np.concatenate([self.ws.arrays.poses.moved(*own) for own in each])

    def at_end(self, j):
        arrays, moment = self.ws.arrays, self.end_of(j)
        return np.concatenate([arrays.poses.value(path, moment)[::3] for path in self._paths(arrays.rows["path"])])

    def past(self, u, step, most: float = 1.0) -> np.ndarray:
        """How far along a step each scene meets no obstacle."""
        return self.detection.shares(u, step, self.rows[::3], most=most)

    def check_end(self, j, u_star, u_next):
        drift = self.drift(self.rows[::3], self.at_end(j))
        self.ws.leave(self.detection.shares(u_star, u_next - u_star, self.rows[::3], drift) < 1)

    def check_apart(self):
        arrays, schedule = self.ws.arrays, self.ws.solver.schedule
        begin = Moment(schedule, 0, schedule.begin(0), schedule.begin(0))
        places = np.concatenate([arrays.poses.value(path, begin)[::3] for path in self._paths(arrays.rows["path"])])
        u = runtime.fetch_row(self.ws.state.u, 0)
        self.ws.leave(~self.detection.are_apart(u, places) | ~np.isfinite(of_scenes(u, arrays.num_scenes).sum((1, 2))))


class JoinedPreconditioners(Preconditioners):
    """As those of one scene, whose linear systems are solved together."""

    def make(self, kind, how, mass):
        made = super().make(kind, how, mass)
        made.solver = JoinedCG(made.potential, getattr(made, "cycle", None), made.free, self.ws.parallel)
        return made
