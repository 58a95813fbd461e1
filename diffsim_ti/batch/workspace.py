"""A run of many scenes side by side: their numbers and states on the device, and the launches that take them on."""

from collections.abc import Callable, Iterator
from functools import partial
from operator import is_
from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.batch.block_views import SHARED
from diffsim_ti.batch.free_vertices import NEAR, SPECIAL
from diffsim_ti.batch.innermost_kernels import InnermostKernels, innermost_kernels
from diffsim_ti.batch.kernels import BatchKernels
from diffsim_ti.batch.layouts import Innermost, Lanes, growths_placed, in_slots, placed
from diffsim_ti.inputs import Derived
from diffsim_ti.mechanics.obstacles.contact_stage import ROWS
from diffsim_ti.mechanics.obstacles.impulse_record import check_staged
from diffsim_ti.runtime.slots import copy_slot
from diffsim_ti.state.arrays import SceneArrays
from diffsim_ti.state.pass_table import FLOATS, INTS, PassTable
from diffsim_ti.state.solve_report import SolveReport


class BatchHistory:
    """States of a batch in `num_slots` slots, forces and what vertices met with them if recorded, and the law's states."""

    def __init__(self, workspace, num_slots: int, record: bool = False):
        layout, n, self.num_slots = workspace.layout, workspace.arrays.num_vertices, num_slots
        self.u, self.v = (layout.vectors(num_slots, n) for _ in range(2))
        self.f = layout.vectors(num_slots, n) if record else runtime.array(layout.vector, 1, 1)
        self.z = layout.numbers(num_slots, workspace.law_rows) if workspace.law_rows else None
        calm = record and layout.in_lanes and workspace.some_special
        self.calm = runtime.array(ti.i32, num_slots * n * layout.num_blocks if calm else 1)

    def copy(self, slot: int, target: "BatchHistory", to: int) -> None:
        for name in ("u", "v") if self.z is None else ("u", "v", "z"):
            copy_slot(getattr(self, name), slot, getattr(target, name), to)


class BatchImpulses:
    """As ImpulseRecord, of all scenes: what obstacles gave vertices in each frame [N s], or changes or adjoints of it."""

    def __init__(self, workspace):
        a, self._layout = workspace.arrays, workspace.layout
        self._shape = workspace.frames.frames_u.shape[0], len(a.obstacles), 2
        self.impulse = self._layout.vectors(int(np.prod(self._shape)), a.num_vertices)
        self.clear()

    def clear(self) -> None:
        runtime.fill(self.impulse, 0)

    def put(self, impulses: np.ndarray) -> None:
        """Set them; shape as `collect` gives."""
        rows = impulses.reshape(len(impulses), -1, *impulses.shape[-2:])
        runtime.fill(self.impulse, self._layout.pack_vectors(rows))

    def collect(self) -> np.ndarray:
        """Shape (scenes, frames, obstacles, 2: by push and by friction, num_vertices, 3), float64."""
        rows = self._layout.unpack_vectors(self.impulse).astype(np.float64)
        return rows.reshape(len(rows), *self._shape, *rows.shape[2:])


class ScenesTable(PassTable):
    """Tables of passes; where scenes have drag of their own, `floats` are numbers of scenes."""

    def __init__(self, fp, own: bool, layout: Lanes | Innermost):
        super().__init__(fp)
        self.own, self._layout, self._numbers = own, layout, None
        if own:
            self.floats = layout.numbers(self.size * len(FLOATS))

    def show_scenes(self, window: int, run: tuple, rates: tuple, make: Callable) -> None:
        """As `show`, for the drag rates of all scenes [1/s]."""
        if not self.own:
            self.show(window, (*run, rates[0]), lambda first, last: make(first, last, rates[0]))
        elif self._numbers != (window, run, rates):
            self._numbers = window, run, rates
            tables = [make(window, min(window + self.size, run[0]), rate) for rate in rates]
            ints = np.zeros(self.size * len(INTS))
            ints[: tables[0][0].size] = tables[0][0].ravel()
            floats = np.zeros((len(rates), self.size * len(FLOATS)))
            for row, (_, numbers) in zip(floats, tables):
                row[: numbers.size] = numbers.ravel()
            runtime.fill(self.ints, ints)
            runtime.fill(self.floats, self._layout.pack(floats))


class BatchWorkspace:
    """Scenes of one mesh, law and list of terms, side by side in a layout; numbers may differ from scene to scene."""

    first_step, impulses = 0, None

    def __init__(self, solver, derived: list[Derived]):
        self.solver, self.scene, self.report = solver, solver.scene, SolveReport()
        self.num_scenes, self.arrays = len(derived), SceneArrays(self.scene, solver.stages_contact, True)
        self.layout = (Lanes if runtime.runs_on_cpu() else Innermost)(self.scene.precision, self.num_scenes)
        self.fp, self.substep = self.arrays.fp, solver.substep
        self.in_parallel = 1 if self.layout.in_lanes else solver.passes_per_launch()
        self.numbers, self.frames, self.record, self._launches, self._made_of = None, None, None, {}, {}
        self.load(derived, start=False)
        self.state = BatchHistory(self, 1)
        contacts, n = len(self.arrays.contacts), self.arrays.num_vertices
        self.met = SimpleNamespace(
            seen=self.layout.numbers(3 * contacts, n if contacts else 1),
            stage=runtime.array(self.arrays.vector, *self.layout.scratch(ROWS * contacts, n if contacts else 1)),
            work=runtime.array(self.fp, self.layout.scratch(1, n)[1]),
        )
        self.restart()

    # ---- the scenes' numbers -----------------------------------------------------------------------------------------

    def load(self, derived: list[Derived], start: bool = True) -> None:
        """Bring the scenes' numbers to the device and, with `start`, set their start."""
        a, self.derived = self.arrays, derived
        first = derived[0]
        if any(d.coefficients.ndim == 3 for d in derived):
            raise ValueError(
                "a Batch takes numbers at points where its scene has them: give them to the material first"
            )
        if any(d.coefficients.ndim != first.coefficients.ndim for d in derived):
            m = a.num_tetrahedra
            whole = [np.broadcast_to(d.coefficients, (m, d.coefficients.shape[-1])) for d in derived]
            derived = [d.replaced(coefficients=own) for d, own in zip(derived, whole)]
        given = [name for name in ("forces", *a.rows_of_steps) if getattr(first, name) is not None]
        first = derived[0].replaced(**{name: max((getattr(d, name) for d in derived), key=len) for name in given})
        a.load(first)
        own = {name for name in ("gradients", "volumes", "rest", "surface") if _differ(derived, name)}
        own |= {"gradients", "volumes"} if own & {"gradients", "volumes"} else set()
        own |= {"inverse_mass"} if _differ(derived, "mass") else set()
        self.rates = tuple(self._rate(d) for d in derived)
        own |= {"table"} if len(set(self.rates)) > 1 else set()
        self.own = frozenset(own)
        sources = self._sources(derived)
        if self.numbers is None:
            self.numbers = SimpleNamespace(corner=self.room_for_corners())
            runtime.fill(self.numbers.corner, 0)
        for name, (parts, make) in sources.items():
            before = self._made_of.get(name)
            if before is not None and len(before) == len(parts) and all(map(is_, before, parts)):
                continue  # they are there
            data, dtype = make()
            self._made_of[name] = parts
            current = getattr(self.numbers, name, None)
            if current is None or runtime.full_shape(current) != self._shape(data, dtype):
                setattr(self.numbers, name, runtime.upload(data, dtype))
                self._launches.clear()
            else:
                runtime.fill(current, data)
        if getattr(self, "table", None) is None or self.table.own != ("table" in own):
            self.table = ScenesTable(self.fp, "table" in own, self.layout)
            self._launches.clear()
        if start:
            self.restart()

    @staticmethod
    def _shape(data: np.ndarray, dtype) -> tuple:
        if isinstance(dtype, type(ti.f32)):
            return data.shape
        return (*data.shape[:-1], *dtype.get_shape())

    def _rate(self, derived: Derived) -> float:
        at = self.arrays.features().drag
        return float(derived.parameters[at]) if at >= 0 else 0.0

    def _sources(self, derived: list[Derived]) -> dict:
        """{name: (arrays, what makes (data, element type) of them)} of what kernels read of the scenes."""
        a, own, first, layout = self.arrays, self.own, derived[0], self.layout
        each = lambda name: tuple(getattr(d, name) for d in derived)  # noqa: E731
        coefficients, parameters = each("coefficients"), each("parameters")
        with_tables = lambda: [np.concatenate([x, a.tables]) for x in parameters]  # noqa: E731
        out = dict(
            tets=((), lambda: (placed(a, "elements", a.mesh.elements).ravel(), ti.i32)),
            coefficients=(
                coefficients,
                lambda: self._packed([placed(a, "coefficients", x) for x in coefficients], "scalars"),
            ),
            parameters=(parameters, lambda: self._packed(with_tables(), "scalars")),
        )
        if layout.in_lanes:
            out["special"] = (first.surface,), lambda: (self._special(), ti.i32)
            out["vertex_of_corner"] = (), lambda: (self._vertex_of_corner(), ti.i32)
        self.num_parameters = len(parameters[0]) + len(a.tables)
        for name, kind in SHARED.items():
            known = each("mass" if name == "inverse_mass" else name)
            out[name] = (name in own, *known), partial(self._of_scenes, name, kind, known)
        none, moves = np.zeros((1, 3)), first.motion is not None
        starts = each("displacement") if moves else (None,)
        anchors = lambda: [none if x is None else x[a.held] for x in starts]  # noqa: E731
        out["anchor"] = starts, lambda: self._packed(anchors() if moves else [none] * self.num_scenes, "vectors")
        self.counts = {}
        for name in ("forces", "motion", "path", *a.rows_of_steps):
            rows = [_NONE if x is None else x for x in each(name)]
            out[name], self.counts[name] = (tuple(rows), partial(self._in_slots, rows)), rows[0].shape[1]
        for name in (name for name in a.own if name not in a.rows_of_steps):
            own = each(name)
            out[name], self.counts[name] = (own, partial(self._packed, own, "vectors")), len(own[0])
        growths = each("growths")
        out["growths"] = growths, lambda: (self.layout.pack(growths_placed(a, growths)), self.layout.number)
        self.num_step_rows = a.num_step_rows(derived)
        return out

    def _vertex_of_corner(self) -> np.ndarray:
        """The vertex at which each corner is."""
        start, corner_of = runtime.fetch(self.arrays.start), runtime.fetch(self.arrays.corner_of)
        out = np.zeros(self.arrays.corner.shape[0], np.int32)
        out[corner_of] = np.repeat(np.arange(len(start) - 1), np.diff(start))
        return out

    def _of_scenes(self, name: str, kind: str, arrays: tuple) -> tuple:
        """(data, element type) of numbers that scenes share or not."""
        arrays = [np.zeros(1) if x is None else x for x in (arrays if name in self.own else arrays[:1])]
        if name == "inverse_mass":
            arrays = [self.arrays.inverse_of(x) for x in arrays]
        if name == "rest":
            arrays = [x - self.arrays.origin for x in arrays]
        arrays = [placed(self.arrays, name, x) for x in arrays]
        if name in self.own:
            return self._packed(arrays, kind)
        return (arrays[0].ravel(), self.fp) if kind == "scalars" else (arrays[0], self.arrays.vector)

    def _in_slots(self, rows: list[np.ndarray]) -> tuple:
        return self.layout.pack_vectors(in_slots(rows)), self.layout.vector

    def _packed(self, arrays: list[np.ndarray], kind: str) -> tuple:
        """(data, element type) of what each scene has: vectors, or else numbers."""
        whole, layout = np.stack(arrays), self.layout
        if kind == "vectors":
            return layout.pack_vectors(whole), layout.vector
        return layout.pack(whole.reshape(len(whole), -1)), layout.number

    def _special(self) -> np.ndarray:
        a, features = self.arrays, self.arrays.features()
        out = np.zeros(a.num_vertices, np.int32)
        if features.groups:
            free = runtime.kernels_of(BatchKernels, a.law, features, frozenset()).free
            out[self.derived[0].surface > 0] = NEAR if free.lane_groups else SPECIAL
        if features.motion:
            out[a.held] = SPECIAL
        if features.partly_fixed:
            out[self.scene.supports.partly_fixed] = SPECIAL
        for x in a.interactions:
            if not x.kernel(a.values, a.precision, False).at_corners:
                out[x.acts_at] = SPECIAL
        return out

    @property
    def some_special(self) -> bool:
        return self.kernels(self.arrays.features()).free.some_special

    def kernels(self, features) -> BatchKernels | InnermostKernels:
        law = self.arrays.law
        if self.layout.in_lanes:
            return runtime.kernels_of(BatchKernels, law, features, self.own)
        return innermost_kernels(law, features, self.own, self.in_parallel > 1)

    @property
    def law_rows(self) -> int:
        """How many numbers of its tetrahedra the law of a scene remembers."""
        a = self.arrays
        return len(a.law.state_names) * a.points * a.num_places

    def initial_states(self) -> np.ndarray:
        law = self.arrays.law
        initial = law.initial_state or (0.0,) * len(law.state_names)
        rows = np.tile(initial, self.law_rows // len(initial))
        return self.layout.pack(np.broadcast_to(rows, (self.num_scenes, 1, len(rows))))

    def room_for_corners(self):
        """For forces that tetrahedra hand to vertices: at these, or, where threads share scenes, at their own corners."""
        a = self.arrays
        return self.layout.vectors(a.num_vertices if self.layout.in_lanes else a.corner.shape[0])

    # ---- states ------------------------------------------------------------------------------------------------------

    def history(self, num_slots: int) -> BatchHistory:
        return BatchHistory(self, num_slots)

    def restart(self) -> None:
        """Set the states to the start."""
        for target, name in ((self.state.u, "displacement"), (self.state.v, "velocity")):
            starts = np.stack([getattr(d, name) for d in self.derived])
            runtime.fill(target, self.layout.pack_vectors(starts[:, None]))
        if self.state.z is not None:
            runtime.fill(self.state.z, self.initial_states())
        self.parts: list[tuple[np.ndarray, float]] = []  # what was seen in passes of other lengths, and these [s]
        self._clear_seen()

    def _clear_seen(self) -> None:
        seen = np.zeros(runtime.full_shape(self.met.seen))
        seen[::3] = np.inf
        runtime.fill(self.met.seen, seen)

    def close(self, h: float) -> None:
        """Passes of length h [s] are over: keep what was seen in them apart from what is seen next."""
        rows = self.seen()
        if np.isfinite(rows[:, ::3]).any():
            self.parts.append((rows, h))
            self._clear_seen()

    def make_frames(self, count: int) -> None:
        self.frames = self.room_for_frames(count)
        self._launches.clear()

    def room_for_frames(self, count: int) -> SimpleNamespace:
        u, v = (self.layout.vectors(count, self.arrays.num_vertices) for _ in range(2))
        return SimpleNamespace(frames_u=u, frames_v=v)

    def record_contacts(self, wanted: frozenset) -> None:
        check_staged(self.arrays.features())
        self.arrays.record_contacts()
        self._launches.clear()
        self.impulses = BatchImpulses(self)
        self.met.impulse = self.impulses.impulse

    def forget_contacts(self) -> None:
        self.impulses.clear()

    def contact_forces(self, frame_time: np.ndarray) -> np.ndarray:
        return self.impulses.collect() / frame_time

    def make_record(self, num_slots: int) -> BatchHistory:
        if self.record is None or self.record.num_slots < num_slots:
            self.record = BatchHistory(self, num_slots, record=True)
            self._launches.clear()
        return self.record

    def restore_to_record(self) -> None:
        self.save(self.record, 0)

    def save(self, target: BatchHistory, slot: int) -> None:
        self.state.copy(0, target, slot)

    def restore(self, source: BatchHistory, slot: int) -> None:
        source.copy(slot, self.state, 0)

    def save_frame(self, frame: int) -> None:
        copy_slot(self.state.u, 0, self.frames.frames_u, frame)
        copy_slot(self.state.v, 0, self.frames.frames_v, frame)

    def seen(self) -> np.ndarray:
        """What each scene's contacts did: (scenes, 3 contacts, vertices), as in state/watch.py."""
        if not self.arrays.contacts:
            return np.zeros((self.num_scenes, 0, 0))
        return self.layout.unpack(self.met.seen)

    def smallest_gaps(self) -> np.ndarray:
        """Of each scene, to any obstacle so far, (scenes,) [m]."""
        host = runtime.view(self.met.seen)
        if host is not None:
            return self.seen()[:, ::3].min((1, 2))
        gaps = runtime.array(self.fp, self.num_scenes)
        _smallest_gaps(self.met.seen, gaps)
        return runtime.fetch(gaps)

    # ---- launches ----------------------------------------------------------------------------------------------------

    def bound(self, kernel, **records) -> Callable:
        parts = [part for record in records.values() for part in (record if type(record) is tuple else (record,))]
        key = (kernel, *map(id, parts))
        if key not in self._launches:
            records |= dict(table=self.table) if "table" in kernel.arrays else {}
            scene = (self.numbers, self.arrays)  # what is topology alone
            self._launches[key] = kernel.bind(self.layout.in_lanes, scene=scene, **records), parts
        return self._launches[key][0]

    def launches(self, first: int, last: int, num_passes: int, save_every: int, backwards: bool = False) -> Iterator:
        """Numbers of the launches that passes first .. last - 1 take, for each of which their table is shown."""
        a, solver, schedule = self.arrays, self.solver, self.solver.schedule
        sizes = dict(num_tetrahedra=a.num_places, num_vertices=a.num_vertices)
        sizes |= self.layout.counts(a.num_places, a.num_vertices)
        sizes |= dict(num_loaded=self.counts["forces"], num_held=self.counts["motion"])
        sizes |= dict(num_parameters=self.num_parameters, num_passes_shown=self.table.size)
        sizes |= {f"len_{name}": self.counts[name] for name in a.own}
        sizes |= a.counts
        sizes |= dict(contact_damping=solver.contact_damping)
        run, turn = (num_passes, self.num_step_rows, save_every, schedule), -1 if backwards else 1
        most = (
            max(1, 16_000_000 // (a.num_tetrahedra * self.layout.width)) if self.layout.in_lanes else self.in_parallel
        )
        for window, begin, end in self.table.windows(first, last)[::turn]:
            self.table.show_scenes(window, run, self.rates, lambda f, l, rate: solver.pass_table(f, l, *run[:3], rate))
            chunk = -(-(end - begin) // -(-(end - begin) // most))  # launches of one size
            stops = [*range(end, begin, -chunk), begin][::-1] if backwards else [*range(begin, end, chunk), end]
            for start, stop in list(zip(stops, stops[1:]))[::turn]:
                yield sizes | dict(window=window, first=start, count=stop - start, times=chunk)

    def advance(self, first: int, last: int, num_passes: int, save_every: int = 0, base: int | None = None) -> None:
        """Passes first .. last - 1 from the current states; or recorded: slot j - base holds those before pass j."""
        recording = base is not None
        history, stride, base = self.record if recording else self.state, int(recording), base or 0
        launch = self.bound(self.kernels(self.arrays.features()).step, state=(history, self.frames, self.met))
        for numbers in self.launches(first, last, num_passes, save_every):
            launch(**numbers, base=base, stride=stride)


_NONE = np.zeros((1, 1, 3))  # rows of what a scene has not


@runtime.untaped
@runtime.kernel
def _smallest_gaps(seen: ti.types.ndarray(ndim=2), gaps: ti.types.ndarray(ndim=1)):
    """Rows 0, 3, 6, ... of what contacts did, scenes innermost."""
    for b in range(gaps.shape[0]):
        least = seen[0, b]
        for row in range(seen.shape[0] // 3):
            for i in range(seen.shape[1] // gaps.shape[0]):
                least = ti.min(least, seen[3 * row, i * gaps.shape[0] + b])
        gaps[b] = least


def _differ(derived: list[Derived], name: str) -> bool:
    """Whether scenes have this of their own."""
    one = getattr(derived[0], name)
    return any(getattr(d, name) is not one for d in derived[1:])
