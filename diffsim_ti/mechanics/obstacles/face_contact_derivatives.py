"""Changes and adjoints of what faces do in recorded explicit passes (face_contact_points.py): pushes, and then friction."""

from contextlib import contextmanager

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.inputs import Derived
from diffsim_ti.mechanics.obstacles.face_contact_points import Alone, FaceContactPoints
from diffsim_ti.mechanics.stage import Passes, Stage
from diffsim_ti.mechanics.surfaces.pair_friction import ratio_by_rate
from diffsim_ti.mesh import geometry
from diffsim_ti.runtime.slots import VertexRows


class FaceChanges(Stage):
    """Changes, or adjoints, of what faces do in recorded passes."""

    def __init__(self, faces: FaceContactPoints, run):
        a, self.faces, self.features = faces.a, faces, run.features
        self.shift_dot, self.speed_dot, self.seed, self.begin_dot = (
            runtime.array(a.vector, faces.num_surface) for _ in range(4)
        )
        self.impulse_dot, self.rows = runtime.array(a.vector, *faces.impulse.shape), VertexRows(a, faces.rows.nodes)

    def _run(self, name: str, alone: Alone, plan: dict, **records) -> None:
        self.faces.run(name, plan, alone.history, alone.slot, alone.n, features=self.features, own=self, **records)

    def _run_parts(self, name: str, alone: Alone, plan: dict, back=False, **records) -> None:
        own = dict(features=self.features, own=self) | records
        self.faces.run_parts(name, plan, alone.history, alone.slot, alone.n, back, **own)


class FaceContactTangent(FaceChanges):
    """The tangent of passes; run: what holds the changes of the state and of all else."""

    @contextmanager
    def tangent(self, at: Passes):
        alone, run = self.faces.alone(at), at.run
        if alone is None:
            yield
            return
        with alone:
            self._run("begin_jvp", alone, at.numbers, tangent=run)
            yield
            before = runtime.fetch_row(run.v, 0) if run.impulses else None
            self._push(alone, at)
            if run.impulses:
                change = runtime.fetch_row(run.v, 0) - before
                run.impulses.add_jvp(at.numbers, alone.speed, change, run.tangent.mass, alone.pushes)
            of_friction = self._slide(alone, run)
            if run.impulses:
                run.impulses.add_friction(at.numbers, of_friction)

    def _push(self, alone: Alone, at: Passes) -> None:
        alone.go(at.numbers)
        if self.faces.friction:
            runtime.fill(self.impulse_dot, 0)
        self._run_parts("jvp", alone, at.numbers, tangent=(at.run, at.run.numbers))

    def _slide(self, alone: Alone, run) -> np.ndarray | None:
        """Then friction; the changes of the impulses of each obstacle with friction, where one does."""
        rub, faces, nodes = alone.rub, self.faces, self.rows.nodes
        if rub is None:
            return None
        a, change, u, v = faces.a, run.tangent, self.rows.get(run.u, 0), self.rows.get(run.v, 0)
        dx = runtime.fetch(self.begin_dot).astype(np.float64) + change.rest[nodes]
        inverse_dot = -(faces.friction.inverse**2) * change.mass[nodes, None]
        poses = a.poses.jvp(a.rows["path"], change.path, rub.moment)
        impulses = faces.impulses(self.impulse_dot)
        gained, each = faces.friction.jvp(rub, impulses, v, dx, inverse_dot, change.parameters, poses)
        self.rows.put(run.v, 0, v + gained)
        by_rate = run.rate_dot * ratio_by_rate(rub.now) * rub.gained
        self.rows.put(run.u, 0, u + rub.ratio * gained + by_rate)
        return each


class FaceContactAdjoint(FaceChanges):
    """The adjoint of passes: sums over them, by faces and surface vertices."""

    def __init__(self, faces: FaceContactPoints, run):
        super().__init__(faces, run)
        a, features = faces.a, run.features
        self.path, self.num_parts = run.path, run.num_parts
        self.sums = runtime.array(a.fp, features.num_parameters, faces.num_faces)
        self.path_adjoint = runtime.array(a.vector, 2 * features.moving, faces.num_faces if features.moving else 1)
        self.rest_adj, self.by_areas = runtime.array(a.vector, faces.num_surface), runtime.array(a.fp, faces.num_faces)

    def clear(self) -> None:
        for x in (self.sums, self.path_adjoint, self.rest_adj, self.by_areas):
            runtime.fill(x, 0)
        values = self.faces.a.values
        self.parameters, self.by_rate, self.by_mass = np.zeros_like(values.parameters), 0.0, np.zeros_like(values.mass)
        self.path_adj = None if values.path is None else np.zeros_like(values.path)
        self.inverse, self.rest = np.zeros((self.faces.num_surface, 1)), np.zeros((self.faces.num_surface, 3))

    @contextmanager
    def adjoint(self, at: Passes):
        alone, run = self.faces.alone(at), at.run
        if alone is None:
            yield
            return
        with alone:
            run.complete()
            self._slide(alone, run, run.impulses.seed_friction(at.numbers) if run.impulses else None)
            by_speed = run.impulses.seed(at.numbers, alone.pushes) if run.impulses else None
            if by_speed is None:
                self._push(alone, at)
            else:
                runtime.fill(run.v, runtime.fetch(run.v) + by_speed)
                self._push(alone, at)
                runtime.fill(run.v, runtime.fetch(run.v) - by_speed)
                self.by_mass += run.impulses.by_mass(at.numbers, alone.speed, alone.pushes)
            yield
            self._run("begin_vjp", alone, at.numbers, adjoint=run)

    def _slide(self, alone: Alone, run, impulses_adj: np.ndarray | None) -> None:
        """Go back through friction, the very last thing; impulses_adj: of those of each obstacle with friction."""
        rub, faces, self._by_x = alone.rub, self.faces, None
        if rub is None:
            if faces.friction:
                runtime.fill(self.impulse_dot, 0)
            return
        p, q = self.rows.get(run.u, 0), self.rows.get(run.v, 0)
        by = faces.friction.vjp(rub, q + rub.ratio * p, impulses_adj)
        self.by_rate += ratio_by_rate(rub.now) * float((p * rub.gained).sum())
        self.rows.put(run.v, 0, q + by.v)
        felt = np.zeros((faces.num_faces, len(faces.a.contacts), *by.impulses.shape[1:]))
        np.add.at(felt, (rub.face, faces.friction.number[rub.obstacle]), by.impulses)
        runtime.fill(self.impulse_dot, felt.reshape(-1, 3))
        self.parameters += by.parameters
        self.inverse += by.inverse
        self.rest += by.x
        self._by_x = by.x
        if self.path_adj is not None:
            faces.a.poses.vjp(faces.a.rows["path"], by.poses, rub.moment, self.path_adj)

    def _push(self, alone: Alone, at: Passes) -> None:
        alone.go(at.numbers)
        plan = at.numbers | dict(steps=1, num_parts=self.num_parts)
        self._run_parts("vjp", alone, plan, back=True, adjoint=(at.run, at.run.numbers), out=self)
        if self._by_x is not None:
            runtime.fill(self.begin_dot, runtime.fetch(self.begin_dot) + self._by_x)

    def collect(self, out: Derived) -> None:
        """Add the adjoints of parameters, masses, paths and rest positions to a `Derived`."""
        nodes, mass = self.rows.nodes, self.by_mass.copy()
        mass[nodes] += -(self.inverse * self.faces.friction.inverse**2)[:, 0]
        out.mass = out.mass + mass
        out.parameters[: len(self.parameters)] += self.parameters
        out.rest[nodes] += self.rest
        if self.features.drag >= 0:
            out.parameters[self.features.drag] += self.by_rate
        if self.path_adj is not None:
            out.path += self.path_adj
        count = self.features.num_parameters
        out.parameters[:count] += runtime.fetch(self.sums).astype(np.float64).sum(1)[:count]
        out.rest[self.faces.mesh.surface_vertices] += runtime.fetch(self.rest_adj)
        rest, faces = self.faces.a.values.rest, self.faces.mesh.surface_triangles
        by_areas = runtime.fetch(self.by_areas).astype(np.float64)
        by_areas /= np.linalg.norm(geometry.triangle_normals(rest, faces), axis=1)
        out.rest += geometry.triangle_areas_vjp(rest, faces, by_areas)
