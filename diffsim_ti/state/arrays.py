"""The numbers of one scene on the device, and the states of one run."""

from dataclasses import replace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.inputs import Derived, poses
from diffsim_ti.mesh.patches import in_eights, volume_patches
from diffsim_ti.runtime import LANES
from diffsim_ti.state.bodies import BodyArrays
from diffsim_ti.state.corners import clear_from, slots, vertex_corners, with_more_corners, with_own_corner
from diffsim_ti.state.features import Features, grouped
from diffsim_ti.state.numbers import PARTS, on_device
from diffsim_ti.state.obstacle_poses import Moment, ObstaclePoses
from diffsim_ti.state.schedule import Schedule
from diffsim_ti.terms import Drag, Gravity, Obstacle, SelfContact


class SceneArrays:
    """What the kernels read of a scene: its topology, once, and its numbers (state/numbers.py), per load."""

    def __init__(
        self, scene, stages_contact: bool = False, presses: bool = False, in_steps: bool = False, bend: float = 0.0
    ):
        mesh, precision = scene.mesh, scene.precision
        fp = runtime.PRECISIONS[precision]
        self.fp, self.vector, self.lanes = fp, ti.types.vector(4, fp), ti.types.vector(LANES, fp)
        self.in_steps = in_steps
        self.law = scene.law.in_steps() if in_steps else scene.law  # as implicit passes take it
        self.nodes, self.points = mesh.reference.num_nodes, mesh.reference.num_points  # of each element
        self._order_tetrahedra(scene)
        self.num_coefficients, self.num_blocks = len(self.law.coefficient_names), len(self.order) // LANES
        self.in_lanes = self.law.lanes and runtime.runs_on_cpu()
        self.in_vectors = self.law.lanes and runtime.moves_vectors()
        self.num_items = self.num_blocks if self.in_lanes else self.num_places
        self.num_vertices, self.num_tetrahedra = mesh.num_vertices, mesh.num_tetrahedra
        self.contacts = tuple(t for t in scene.ordered_terms if t.acts_on_surface)
        self.fixed, self.held, self.supports = scene.fixed, scene.held, scene.supports
        self.interactions = tuple(x for x in scene.interactions if x.in_kernels) if presses else ()
        self._all = scene.interactions
        self.own = {name: kind for x in self._all for name, kind in x.derived.items()}  # their numbers
        self.mesh, self.precision, self.self_contact = mesh, precision, scene.term(SelfContact)
        self._upload_topology(scene, presses)
        self._rows = rows = scene.inputs.parameters
        self.obstacles = self._counterparts(scene)
        self.bend = bend
        self._features = dict(
            order=mesh.order,
            groups=grouped(self.obstacles),
            stages=stages_contact,
            moving=sum(poses.columns_of(term.path_width) for term in scene.moving),
            gravity=rows.first(scene.term(Gravity)),
            drag=rows.first(scene.term(Drag)),
            motion=scene.motion is not None,
            partly_fixed=bool(len(scene.supports.partly_fixed)),
            num_parameters=rows.total,
            reduced=presses and bool(scene.reduced.by_few),
            rigid=presses and bool(scene.reduced.rigid),
        )
        self.with_stress = scene.reduced.with_stress(mesh.elements, scene.volume)
        self.bodies = BodyArrays(scene, fp, self.vector) if self._features["reduced"] else None
        vars(self).update(self.bodies.arrays if self.bodies else {})
        self.origin, away = scene.origin, [scene.inputs.away.get(term, np.zeros(3)) for term in self.contacts]
        # as they are evaluated between passes
        self.poses = ObstaclePoses(self.obstacles, np.reshape(away, (-1, 3)))
        self.offsets = runtime.array(self.vector, self.poses.size)
        self.values: Derived | None = None
        self._whole: Derived | None = None  # the same, unless a load of them was interrupted
        self._known_features: dict[tuple[bool, bool], Features] = {}  # for these values
        self.rows: dict[str, np.ndarray | None] = {}  # numbers as the device has them, of steps too

    num_scenes, by_scene = 1, False  # whose bodies are pieces of the mesh (batch/joined_scene.py)

    @property
    def vertices_of_one(self) -> int:
        """Vertices of a scene."""
        return self.num_vertices // self.num_scenes

    def _order_tetrahedra(self, scene) -> None:
        """`order`: the tetrahedron in each lane; `place`: the lane of each; `num_places`: lanes to go through."""
        m = scene.mesh.num_tetrahedra
        self.patches = volume_patches(scene.mesh) if scene.volume == "patches" else None
        if self.patches is not None and scene.mesh.order == 1:
            self.order, self.place = in_eights(self.patches)
            self.num_places = len(self.order)
            self.alone = np.zeros(self.num_places)  # 1 where a lane is no repetition
            self.alone[self.place] = 1
            return
        self.order = np.zeros(-(-m // LANES) * LANES, np.int64)  # the last block is filled up with tetrahedron 0
        self.order[:m] = np.arange(m)
        self.place, self.num_places = slice(m), m

    def _upload_topology(self, scene, presses) -> None:
        mesh, n = self.mesh, self.num_vertices
        self.tets = runtime.upload(self.to_blocks(mesh.elements).ravel(), ti.i32)
        self.first_contact_corner = num_corners = self.nodes * LANES * self.num_blocks
        start, corner_of = vertex_corners(mesh.elements, n)
        if not isinstance(self.place, slice):
            corner_of = self.nodes * self.place[corner_of // self.nodes] + corner_of % self.nodes
            corner_of = corner_of[np.lexsort((corner_of, np.repeat(np.arange(n), np.diff(start))))]
        self.parameters_of_self_contact = slice(0, 0)
        if self.self_contact:
            self.parameters_of_self_contact = scene.inputs.parameters.of(self.self_contact)
        if not presses and (self.self_contact or any(term.primitives is not None for term in self.contacts)):
            # each surface vertex gathers one corner more, after those of its tetrahedra
            start, corner_of = with_own_corner(start, corner_of, mesh.surface_vertices, num_corners)
            num_corners += len(mesh.surface_vertices)
        self.first_corner = num_corners  # of interactions
        self.counts, first_load, first_push = {}, None, None
        self.force_slot = self.motion_slot = runtime.array(ti.i32, 1)
        for x in self._all if presses else ():
            corners = len(x.vertices)
            self.counts |= {f"num_{x.name}": x.count, f"first_{x.name}": num_corners, **x.counts}
            for name, data in x.topology.items():
                setattr(self, name, runtime.upload(data, self.fp if data.dtype.kind == "f" else ti.i32))
            if x.first_load < corners:
                first_load = num_corners + x.first_load if first_load is None else first_load
                first_push = num_corners if first_push is None and not x.pulls else first_push
            if corners:
                start, corner_of = with_more_corners(start, corner_of, x.vertices, num_corners)
            num_corners += corners
        ends = [num_corners if first is None else first for first in (first_load, first_push)]
        self.counts |= dict(zip(("first_load", "first_push"), ends))
        self.start, self.corner_of = runtime.upload(start, ti.i32), runtime.upload(corner_of, ti.i32)
        self.corner = runtime.array(self.vector, num_corners)
        if scene.motion is not None:
            self.motion_slot = runtime.upload(slots(scene.held, n), ti.i32)
        if len(scene.supports.partly_fixed):
            self.sliding_slot = runtime.upload(slots(scene.supports.partly_fixed, n), ti.i32)
            self.sliding_supports = runtime.upload(scene.supports.sliding_supports.reshape(-1, 3), self.vector)

    def _counterparts(self, scene) -> list[tuple]:
        """(device counterpart, first parameter, column of the path or -1) of the obstacles; their tables stand behind the
        parameters, one after the other."""
        widths = [poses.columns_of(term.path_width) for term in scene.moving]
        columns, out = dict(zip(scene.moving, np.cumsum([0, *widths]).tolist())), []
        at = max(scene.inputs.parameters.total, 1)
        self.tables = np.concatenate([np.zeros(0), *(t.table for t in self.contacts)])
        for term in self.contacts:
            rows = scene.inputs.parameters.of(term)
            counterpart = term.kernel(scene.precision, **(dict(table=at) if term.table.size else {}))
            if isinstance(term, Obstacle):
                kind = dict(per_area=term.per_area, turns=term.turns)
                counterpart = replace(counterpart, **kind)
            if (
                counterpart.size + term.num_extra != rows.stop - rows.start
            ):  # it would read, and add to, another term's rows
                raise AssertionError(
                    f"the kernel of {term!r} has {counterpart.size} numbers, its term {rows.stop - rows.start}"
                )
            out.append((counterpart, rows.start, columns.get(term, -1)))
            at += term.table.size
        return out

    def gravity_of(self, values: Derived) -> np.ndarray:
        """Gravity [m/s^2] among numbers that kernels read, or their changes; zero where there is none."""
        at = self._features["gravity"]
        return values.parameters[at : at + 3] if at >= 0 else np.zeros(3)

    def record_contacts(self) -> None:
        """Kernels are to note what contact stages do."""
        self._features["recorded"], self._known_features = True, {}

    def count_own_work(self) -> None:
        """Kernels are to count the work of the body's own forces."""
        self._features["balanced"], self._known_features = True, {}

    def features(self, density: bool = False, shape: bool = False) -> Features:
        """What kernels must contain for the values that are loaded."""
        if (density, shape) not in self._known_features:
            self._known_features[density, shape] = self._make_features(density, shape)
        return self._known_features[density, shape]

    def _make_features(self, density: bool, shape: bool) -> Features:
        said = {}
        for x in self._all:
            said |= x.features(self.values, self.in_steps)
        return Features(
            **self._features,
            **said,
            interactions=tuple(x.kernel(self.values, self.precision, shape) for x in self.interactions),
            uniform=self.values.coefficients.ndim == 1,
            by_points=self.values.coefficients.ndim == 3,
            density=density,
            shape=shape,
        )

    def load(self, values: Derived) -> bool:
        """Bring values to the device; True if array shapes or kernels changed, so that launches must be bound again."""
        old, self._whole = self._whole, None
        before = old and self.features()
        self.values, self._known_features = values, {}
        self.rows = values.parts()
        moved = before != self.features()
        sources = {name: on_device(self, name, values) for name in (*PARTS, *self.own) if name != "mass"}
        if any(term.num_extra for term in self.contacts):
            numbers = [values.parameters[self._rows.of(term)] for term in self.contacts]
            self.tables = np.concatenate([t.table_at(x) for t, x in zip(self.contacts, numbers)])
        sources["parameters"] = np.concatenate([values.parameters, self.tables]), self.fp
        if not (self.contacts or self.self_contact or any(x.reads_rest for x in self.features().interactions)):
            sources["rest"] = np.zeros((1, 3)), self.vector
        else:
            sources["rest"] = values.rest - self.origin, self.vector
        sources["inverse_mass"] = self.inverse_of(values.mass), self.fp
        for name, (data, dtype) in sources.items():
            current = getattr(self, name, None)
            if current is None or tuple(current.shape) != data.shape[: len(current.shape)]:
                setattr(self, name, runtime.upload(data, dtype))
                moved = True
            elif old is None or getattr(old, name, None) is not getattr(values, name, data):
                runtime.fill(current, data)
        if self.bodies:
            self.bodies.load(values, sources["inverse_mass"][0])
        self._whole = values
        return moved

    def clear_corners_of_loads(self) -> None:
        """No forces at corners of interactions, where tetrahedra alone are to be gathered."""
        if self.corner.shape[0] > self.first_corner:
            clear_from(self.corner, self.first_corner)

    @property
    def rows_of_steps(self) -> tuple[str, ...]:
        """Those of the interactions' own numbers that are rows of steps."""
        return tuple(name for name, kind in self.own.items() if kind == "vectors2")

    def num_step_rows(self, derived: list[Derived]) -> int:
        """How many rows what is given by steps has: places at their ends, or loads where kernels ask for steps."""
        first = derived[0]
        out = max((len(x) for x in (first.path, first.motion) if x is not None), default=1)
        if out == 1 and self.features().asks_for_steps:
            given = (getattr(d, name) for d in derived for name in ("forces", "growths", *self.rows_of_steps))
            return max(1 + len(x) for x in given if x is not None)
        return out

    @property
    def now(self) -> Derived:
        """What is loaded, with the rows of the steps to come."""
        return Derived(**self.rows)

    def load_rows(self, **rows: np.ndarray) -> None:
        """Other rows of what is given by steps, by name: those of the steps to come."""
        for name, data in rows.items():
            runtime.fill(getattr(self, name), self.growth_blocks(data) if name == "growths" else data)
            self.rows[name] = data

    @property
    def width_of_pairs(self) -> float:
        """The least width of what acts by pairs [m]; infinite without."""
        widths = [float(x.values["barrier_width"]) for x in self.contacts if x.primitives is not None]
        widths += [float(self.self_contact.values["self_contact_width"])] if self.self_contact else []
        return min(widths, default=np.inf)

    # ---- the stiffness of obstacles ----------------------------------------------------------------------------------

    def area_of(self, obstacle: int, vertices) -> float:
        """What the stiffness of an obstacle is multiplied by: the vertices' mean area [m^2], or 1 where it is theirs."""
        per_area = self.obstacles[obstacle][0].per_area
        return float(self.values.surface[list(vertices)].mean()) if per_area else 1.0

    def stiffness_of(self, obstacle: int, vertices) -> float:
        """Stiffness [N/m] of an obstacle's barrier at vertices, on average."""
        counterpart, first, _ = self.obstacles[obstacle]
        return float(self.values.parameters[first + counterpart.index.stiffness]) * self.area_of(obstacle, vertices)

    def stiffer(self, obstacle: int, vertices, stiffness: float) -> str:
        """In words, the number of an obstacle that gives its barrier a stiffness [N/m] at vertices."""
        value, per_area = stiffness / self.area_of(obstacle, vertices), self.obstacles[obstacle][0].per_area
        return f"stiffness_per_area to {value:.3g} N/m^3" if per_area else f"stiffness to {value:.3g} N/m"

    def inverse_of(self, mass: np.ndarray) -> np.ndarray:
        """1 / m of the vertices that move freely, 0 of the others."""
        out = np.divide(1.0, mass, out=np.zeros_like(mass), where=mass > 0)
        out[self.fixed] = 0
        return out

    @property
    def num_contact_rows(self) -> int:
        """Of what contact does to vertices: the obstacles', and one of surfaces on each other."""
        return len(self.obstacles) + bool(self.self_contact)

    def place_obstacles(self, schedule: Schedule, j: int) -> None:
        """Put what evaluates a state between passes where the obstacles are when pass j begins."""
        if self.rows["path"] is not None:
            begin = schedule.begin(j)
            runtime.fill(self.offsets, self.poses.value(self.rows["path"], Moment(schedule, j, begin, begin)))

    # ---- numbers of tetrahedra in blocks -----------------------------------------------------------------------------

    def to_blocks(self, per_tetrahedron: np.ndarray, order: np.ndarray | None = None) -> np.ndarray:
        """(num_tetrahedra, rows) as (num_blocks * rows, LANES); order: the tetrahedron in each lane."""
        order = self.order if order is None else order
        rows = per_tetrahedron.reshape(len(per_tetrahedron), -1)[order]
        return np.swapaxes(rows.reshape(len(order) // LANES, LANES, -1), 1, 2).reshape(-1, LANES)

    def from_blocks(self, blocks: np.ndarray, rows: int, part: slice = slice(None)) -> np.ndarray:
        """The inverse: (num_tetrahedra, rows) in float64, or a part of the tetrahedra."""
        blocks = blocks.reshape(-1, rows, LANES)
        if isinstance(self.place, slice):  # they lie in order
            begin, end, _ = part.indices(self.num_tetrahedra)
            first = begin // LANES
            lanes_first = blocks[first : -(-end // LANES)].swapaxes(1, 2)
            flat = lanes_first.astype(np.float64, order="C").reshape(-1, rows)  # copied once
            return flat[begin - first * LANES : end - first * LANES]
        block, lane = np.divmod(self.place[part], LANES)
        return blocks[block, :, lane].astype(np.float64)

    def at_points(self, numbers: np.ndarray) -> np.ndarray:
        """What kernels write for each point, in float64, shape (num_tetrahedra,), or (num_tetrahedra, points)."""
        if self.points == 1:
            return numbers[self.place].astype(np.float64)
        return numbers.reshape(-1, self.points)[self.place].astype(np.float64)

    def law_states(self, num_slots: int):
        """Room for what the law remembers; None if it has no state."""
        rows = len(self.law.state_names) * self.points * self.num_blocks
        return runtime.array(self.lanes, num_slots, rows) if rows else None

    def frozen_numbers(self):
        """Room for what the law holds in a pass; None if that is nothing."""
        rows = len(self.law.frozen_names) * self.points * self.num_blocks
        return runtime.array(self.lanes, 1, rows) if rows else None

    def initial_state_blocks(self) -> np.ndarray:
        """Blocks of the law's initial state."""
        initial = self.law.initial_state or (0.0,) * len(self.law.state_names)
        return np.repeat(np.tile(initial, self.points * self.num_blocks)[:, None], LANES, 1)

    def law_state_of(self, blocks: np.ndarray) -> np.ndarray:
        """The inverse."""
        shape = self.law_state_shape
        return self.from_blocks(blocks, int(np.prod(shape[1:]))).reshape(shape)

    @property
    def law_state_shape(self) -> tuple[int, ...]:
        points = () if self.points == 1 else (self.points,)
        return (self.num_tetrahedra, *points, len(self.law.state_names))

    def coefficient_blocks(self, coefficients: np.ndarray) -> np.ndarray:
        """Blocks of coefficients, shape (K,), (num_tetrahedra, K) or (num_tetrahedra, points, K); a single block serves all
        if they are uniform."""
        uniform = np.zeros(LANES, int) if coefficients.ndim == 1 else None
        return self.to_blocks(np.atleast_2d(coefficients), uniform)

    @property
    def coefficients_each(self) -> int:
        """How many a tetrahedron has."""
        return self.num_coefficients * (self.points if self.features().by_points else 1)

    def coefficients_from_blocks(self, blocks: np.ndarray) -> np.ndarray:
        """The inverse, for adjoints, which each tetrahedron has its own of."""
        out = self.from_blocks(blocks, self.coefficients_each)
        return out.reshape(-1, self.points, self.num_coefficients) if self.features().by_points else out

    def growth_blocks(self, growth: np.ndarray | None):
        """Blocks of growths (rows, 2, 1 or num_tetrahedra), (rows, 2 blocks, LANES), beginning and end of a step in turn;
        implicit passes have a single row, that of their moment (`hold_growth`)."""
        if growth is None:
            return None
        rows = growth[:1] if self.in_steps else growth
        order = np.zeros(LANES, int) if growth.shape[2] == 1 else self.order
        return np.stack([self.to_blocks(row.T, order) for row in rows])

    def from_growth_blocks(self, blocks: np.ndarray) -> np.ndarray:
        """The inverse, for adjoints, which each tetrahedron has its own of."""
        out = np.stack([self.from_blocks(row, 2).T for row in blocks])
        return out.sum(2, keepdims=True) if self.values.growths.shape[2] == 1 else out

    def hold_growth(self, growth: np.ndarray) -> None:
        """What an implicit pass takes, shape (1 or num_tetrahedra,)."""
        runtime.fill(self.growths, self.growth_blocks(np.stack([growth, growth])[None]))

    def volume_blocks(self, volumes: np.ndarray) -> np.ndarray:
        """Blocks of volumes; repetitions in a patch have none, nor what is rigid."""
        blocks = self.to_blocks(self.with_stress(volumes))
        if isinstance(self.place, slice):
            return blocks
        return blocks * np.repeat(self.alone.reshape(-1, LANES), self.points, axis=0)
