"""Contact of faces with obstacles between their corners, in a run of an explicit solver."""

from contextlib import contextmanager

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.obstacles.explicit_face_kernels import face_kernels
from diffsim_ti.mechanics.obstacles.face_derivatives import face_derivatives
from diffsim_ti.mechanics.obstacles.face_friction import FaceFriction
from diffsim_ti.mechanics.obstacles.face_lattice import BENT, lattices, nodes_of_faces, shortened
from diffsim_ti.mechanics.stage import Passes, Stage
from diffsim_ti.mesh.curved_triangles import are_treated_as_curved
from diffsim_ti.runtime.slots import VertexRows, copy_slot
from diffsim_ti.terms.obstacles.barrier import beta

TRAVEL, LOAD = 0.2, 0.2


def has_face_contact(scene, bend: float = 0.0) -> bool:
    """Whether a scene has an obstacle that could reach into a face of the body between its corners; bend: how far faces have
    bent in a run [m] (state/bending.py).

    A ball of radius R that touches a face, whose longest edge is L, is nearer to it than its corners say by L^2 / 6 R at
    most. Where that is less than what points within faces feel in full, BENT widths (face_lattice.py), corners
    stand for the face. L is that at rest, a fifth longer. Curved faces are felt as are_treated_as_curved says.
    """
    x = scene.mesh.vertices[scene.mesh.surface_triangles]
    longest = 1.2 * np.linalg.norm(x - np.roll(x, 1, axis=1), axis=2).max(initial=0)
    obstacles = [t for t in scene.terms if t.acts_on_surface and "barrier_width" in t.values]
    by_distance = [t for t in obstacles if not t.by_pairs]
    return are_treated_as_curved(scene.mesh, obstacles, bend) or any(
        longest**2 > 6 * t.least_radius() * BENT * float(t.values["barrier_width"]) for t in by_distance
    )


class FaceContactPoints(Stage):
    """Their arrays, and what kernels (explicit_face_kernels.py) do with them, at a slot of a run's states.

    A pass is gone in a power of two of parts, `most_parts` at most: in each no face goes farther than TRAVEL widths, and
    d^2 D / m is LOAD at most.
    """

    most_parts = 1024

    def __init__(self, workspace):
        self.ws, a = workspace, workspace.arrays
        self.a, self.mesh, fp = a, a.mesh, a.fp
        faces, surface = nodes_of_faces(a), self.mesh.surface_vertices
        self.num_faces, self.num_surface = len(faces), len(surface)
        own = np.searchsorted(surface, faces.ravel())
        entries = np.argsort(own, kind="stable")
        start = np.searchsorted(own[entries], np.arange(len(surface) + 1))
        parts, reach, weight = lattices(a)
        self.full_reach, self.is_shortened = reach, False
        ints = dict(corners=faces, own=own, start=start, entries=entries, vertices=surface, parts=parts)
        for name, data in ints.items():
            setattr(self, name, runtime.upload(data.ravel(), ti.i32))
        self.reach, self.weight = (runtime.upload(x.ravel(), fp) for x in (reach, weight))
        self.share, self.begin = runtime.array(a.vector, faces.size), runtime.array(a.vector, 1, a.num_vertices)
        self.whole, self.shift = (runtime.array(a.vector, len(surface)) for _ in range(2))
        self.least, self.offsets = runtime.array(fp, len(faces) * len(a.contacts)), a.offsets
        # by each obstacle in a pass, more than 0 if at all
        self.pushed = runtime.array(fp, len(faces) * len(a.contacts))
        self.near, self.load = runtime.array(ti.i32, len(faces)), runtime.array(fp, len(surface))
        # of each face: energy; work of moving obstacles in a pass, and in all (EnergyBalance); how many widths it moves
        self.energy, self.done, self.work, self.need = (runtime.array(fp, len(faces)) for _ in range(4))
        runtime.fill(self.work, 0)
        self.row, self.place = runtime.array(a.vector, 1, a.num_vertices), None
        self._make_room(1)
        self.friction, self.rub = FaceFriction(workspace, surface), None  # friction of the last pass
        rows = faces.size * len(a.contacts) if self.friction else 0
        self.impulse, self.rows = runtime.array(a.vector, rows or 1), VertexRows(a, surface)
        self.corners_of = own.reshape(faces.shape)
        self.work_of_friction = 0.0
        # of recorded passes in which faces came near, by slots: (parts, state without their contact, pushes, what rubbed)
        self.kept = {}
        self.pushes = None  # in the last pass: whether each obstacle pushed on faces around each vertex
        self.saturated = False  # whether the last pass would have taken more parts than there may be

    def _make_room(self, n: int) -> None:
        """For n parts of a pass."""
        if self.place is None or self.place.shape[0] < n:
            self.place = runtime.array(self.a.vector, n, self.num_surface)
            self.speed = runtime.array(self.a.vector, n + 1, self.num_surface)
            self.taken = runtime.array(self.a.fp, n, self.num_surface)

    def run(self, name: str, plan: dict, state, slot: int, n=1, k=0, features=None, between=False, **records) -> None:
        a, ws = self.a, self.ws
        kernels = face_kernels if features is None else face_derivatives
        features = a.features() if features is None else features
        kernel = getattr(kernels(features, a.precision, ws.parallel), name)
        # bound again with the scene's, or with more room for parts
        launches = ws.kept(("faces", id(self.place)), lambda: (self.place, {}))[1]
        parts = [part for record in records.values() for part in (record if type(record) is tuple else (record,))]
        key = (kernel, id(state.u), *map(id, parts))
        if key not in launches:
            own = dict(scene=a, faces=self, state=state, table=ws.table)
            launches[key] = kernel.bind(**own, **records), state, records
        sizes = dict(num_vertices=a.num_vertices, num_faces=self.num_faces, num_surface=self.num_surface)
        own = sizes | dict(
            slot=slot, between=int(between), h=float(ws.solver.schedule.length(plan.get("first", 0))), n=n, k=k
        )
        numbers = ("first", "window", "steps", "num_parts")
        launches[key][0](**own | {name: plan.get(name, 0) for name in numbers if name in kernel.numbers})

    def run_parts(self, name: str, plan: dict, state, slot: int, n: int, back=False, **records) -> None:
        """All parts: in one launch, or on all threads one after the other."""
        order = (range(n)[::-1] if back else range(n)) if self.ws.parallel else [0]
        for k in order:
            self.run(name, plan, state, slot, n, k, **records)

    def starts(self, distances: np.ndarray) -> None:
        """A run starts with these distances [m] of the triangles to what is nearest."""
        reach = shortened(self.full_reach, distances)
        self.is_shortened = bool((reach < self.full_reach).any())
        runtime.fill(self.reach, reach.ravel())

    # ---- in passes ---------------------------------------------------------------------------------------------------

    @contextmanager
    def do(self, at: Passes):
        self.before_pass(at.history, at.slot)
        yield
        self._after(at)

    def before_pass(self, history, slot: int) -> None:
        """A pass begins at a slot."""
        copy_slot(history.u, slot, self.begin, 0)

    def _after(self, at: Passes) -> None:
        """The rest of the pass is done: integrate it again where faces come near, and note what they did."""
        history, slot, plan, recording = at.history, at.end, at.numbers, at.stride > 0
        asked = self.ws.impulses is not None
        self.kept.pop(slot, None)
        self.rub = None
        self.run("approaches", plan, history, slot)
        n = self._fewest_parts()
        while n:
            self.go(history, slot, plan, n)
            load = float(_seen(self.load).max())
            if not load > LOAD or n >= self.most_parts:
                break
            more = np.sqrt(load / LOAD) if np.isfinite(load) else 2.0
            n = min(self.most_parts, n * _power_of_two(max(min(more, 64.0), 1.01)))
        if n:
            self.saturated = n >= self.most_parts
            self.pushes = self._who_pushes() if asked else None
            u, v = (runtime.fetch_row(x, slot) if recording or asked else None for x in (history.u, history.v))
            self.run("ends", plan, history, slot, n, watch=self.ws.watch)
            pushed = runtime.fetch_row(history.v, slot) - v if asked else None
            self._slide(history, slot, plan, at.num_passes)
            if recording:
                self.kept[slot] = n, (u, v), self.pushes, self.rub
            if asked:
                self.ws.impulses.add(plan, pushed, self.pushes)
                self.ws.impulses.add_friction(plan, self.impulses_of_friction())

    def _slide(self, history, slot: int, plan: dict, num_passes: int) -> None:
        """Friction of what was pushed."""
        if not self.friction:
            return
        u, v = self.rows.get(history.u, slot), self.rows.get(history.v, slot)
        x = self.rows.get(self.begin, 0) + self.a.values.rest[self.rows.nodes]
        self.rub = self.friction.begin(self.impulses(self.impulse), v, x, self.corners_of, plan["first"], num_passes)
        if self.rub is not None:
            self.work_of_friction += self.friction.slide(self.rub)
            self.rows.put(history.v, slot, v + self.rub.gained)
            self.rows.put(history.u, slot, u + self.rub.ratio * self.rub.gained)

    def impulses(self, array) -> np.ndarray:
        """Of obstacles on the nodes of faces, or changes of them, shape (faces, obstacles, nodes, 3)."""
        return runtime.fetch(array).astype(np.float64).reshape(self.num_faces, len(self.a.contacts), -1, 3)

    def impulses_of_friction(self) -> np.ndarray | None:
        """Of each obstacle with friction on surface vertices in the last pass [N s]; None where there was no friction."""
        return None if self.rub is None else self.friction.impulses(self.rub)

    def clear_work(self) -> None:
        """Of moving obstacles, to be counted again."""
        runtime.fill(self.work, 0)
        self.work_of_friction = 0.0

    def all_work(self) -> float:
        """Of moving obstacles on the body [J]."""
        return float(runtime.fetch(self.work).astype(np.float64).sum()) + self.work_of_friction

    def _who_pushes(self) -> np.ndarray:
        """Whether each obstacle pushes on faces around each vertex, shape (obstacles, num_vertices)."""
        out = np.zeros((len(self.a.contacts), self.a.num_vertices), bool)
        for own, pushed in zip(out, _seen(self.pushed).reshape(-1, len(out)).T):
            own[self.mesh.surface_triangles[pushed > 0].ravel()] = True
        return out

    def _fewest_parts(self) -> int:
        """How many parts the motions of faces ask for; 0 if none comes near."""
        if not _seen(self.near).any():
            return 0
        need = float(_seen(self.need).max())
        return min(self.most_parts, _power_of_two(need / TRAVEL)) if np.isfinite(need) else 1

    def go(self, history, slot: int, plan: dict, n: int) -> None:
        self._make_room(n)
        self.run("begins", plan, history, slot, n)
        self.run_parts("parts_of_pass", plan, history, slot, n)

    def alone(self, at: Passes) -> "Alone | None":
        """The recorded pass without contact within faces, if there was some."""
        return Alone(self, at.history, at.end) if at.end in self.kept else None

    # ---- between passes ----------------------------------------------------------------------------------------------

    def _forces(self) -> None:
        self.run("forces", {}, self.ws.state, 0, between=True)

    def energies(self) -> np.ndarray:
        """Energy [J] of points within each face, in the current state."""
        self._forces()
        return runtime.fetch(self.energy).astype(np.float64)

    def stiffening(self, vertices, contact: int, speeds: np.ndarray) -> float:
        """How many times stiffer a barrier must be to stop a face of that speed [m/s] at a fiftieth of the width.

        Twice what takes up the kinetic energy of its corners and what it holds in the current state; at least 4.
        """
        self._forces()
        f = int(np.flatnonzero((self.mesh.surface_triangles == np.array(vertices)).all(1))[0])
        width = float(self.a.contacts[contact].values["barrier_width"])
        near = runtime.fetch(self.least)[f * len(self.a.contacts) + contact] / width
        held = float(runtime.fetch(self.energy)[f])
        moving = 0.5 * float((self.a.values.mass[list(vertices)] * speeds**2).sum())
        most = held * float(beta(0.02) / max(beta(np.clip(near, 1e-3, 1)), 1e-9))
        return float(np.clip(2 * (held + moving) / max(most, 1e-300), 4.0, 1e4))


class Alone:
    """A recorded pass, computed again without contact within faces and then with it; `with` leaves the record as it was."""

    def __init__(self, faces: FaceContactPoints, history, slot: int):
        self.faces, self.history, self.slot = faces, history, slot
        self.n, self._state, self.pushes, self.rub = faces.kept[slot]

    def __enter__(self) -> "Alone":
        self._whole = [runtime.fetch_row(x, self.slot) for x in (self.history.u, self.history.v)]
        self._put(self._state)
        return self

    def __exit__(self, *_) -> None:
        self._put(self._whole)

    def _put(self, state) -> None:
        for target, data in zip((self.history.u, self.history.v), state):
            runtime.fill(self.faces.row, data[None])
            copy_slot(self.faces.row, 0, target, self.slot)

    @property
    def speed(self) -> np.ndarray:
        """The velocity that the pushes of faces have added in the pass."""
        out = self._whole[1] - self._state[1]
        if self.rub is not None:
            out[self.faces.rows.nodes] -= self.rub.gained
        return out

    def go(self, plan: dict) -> None:
        """Its parts again, from where the pass begins, the slot before."""
        faces = self.faces
        faces.before_pass(self.history, self.slot - 1)
        faces.run("approaches", plan, self.history, self.slot)
        faces.go(self.history, self.slot, plan, self.n)


def _seen(array) -> np.ndarray:
    host = runtime.view(array)
    return runtime.fetch(array) if host is None else host


def _power_of_two(x: float) -> int:
    """The least that is not below x >= 0."""
    return 1 << max(0, int(np.ceil(np.log2(max(x, 1.0)))))
