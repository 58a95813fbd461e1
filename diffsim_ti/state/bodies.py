"""Sets that move by few numbers, as explicit passes have them: who belongs to them, their masses, and derivatives of these.

Of a body's vertices, with masses m and places X that it is measured by (affine: the mesh's; rigid: the rest positions):

    M = sum m,    X_ = sum m X / M,    y = X - X_,    J = sum m y y^T

All that kernels do is sums with m and y, and products with 1 / M and J^-1 (mechanics/reduced/explicit.py). They are float64
in every precision, and of m and X as the device has them: what they are off by would add up over passes.
"""

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.differentiation.arrays import Recorded, forward, linear, reverse_of_all
from diffsim_ti.inputs import Derived

PAIRS = ((0, 0), (1, 1), (2, 2), (1, 2), (2, 0), (0, 1))  # entries of J in their order
NUMBERS = 16  # of each body: M, X_, J^-1, J
SUMS = 7  # adjoints of M and J
SIZE = 4  # of each vertex of a body: adjoints of y and m
# what kernels read of them; reach: of all vertices, an inverse mass [1/kg], of a body's as that of an impulse there at most
BODIES = dict.fromkeys(("body_first", "body_vertex", "body_kind", "body_of"), "ints") | dict(
    body_place="vectors", body_mass="scalars", body_reach="scalars", body_numbers="doubles", body_force="vectors2"
)


class BodyArrays:
    """Of a scene, on the device."""

    def __init__(self, scene, fp, vector):
        self.bodies, self.fp, self.vector, mesh = scene.reduced.by_few, fp, vector, scene.mesh
        members = [body.vertices for body in self.bodies]
        self.first = np.cumsum([0, *map(len, members)])
        self.vertices = np.concatenate(members)
        self.owner = np.repeat(np.arange(len(members)), np.diff(self.first))
        self.rigid = np.array([body.rigid for body in self.bodies])
        self.origin, self._mesh_places = scene.origin, mesh.vertices[self.vertices]
        self._rounded = np.float32 if fp == ti.f32 else np.float64
        owner = np.full(mesh.num_vertices, -1)
        owner[self.vertices] = self.owner
        ints = dict(body_first=self.first, body_vertex=self.vertices, body_kind=self.rigid, body_of=owner)
        self.arrays = {name: runtime.upload(data.astype(np.int32), ti.i32) for name, data in ints.items()}
        self.arrays["body_force"] = runtime.array(vector, 1, mesh.num_vertices)
        self.arrays["body_place"] = runtime.array(vector, len(self.vertices))
        self.arrays["body_mass"] = runtime.array(fp, len(self.vertices))
        self.arrays["body_numbers"] = runtime.array(ti.f64, NUMBERS * len(members))
        self.arrays["body_reach"] = runtime.array(fp, mesh.num_vertices)

    def load(self, values: Derived, inverse_mass: np.ndarray) -> None:
        """Numbers for values of a run."""
        self.mass = values.mass[self.vertices].astype(self._rounded).astype(np.float64)
        places = np.where(self.rigid[self.owner, None], values.rest[self.vertices], self._mesh_places) - self.origin
        self.places = places.astype(self._rounded).astype(np.float64)
        total, centre, self.y, J = self._measured(self.mass, self.places)
        inverse = np.linalg.inv(J)
        rows = [np.column_stack([x[:, a, b] for a, b in PAIRS]) for x in (inverse, J)]
        numbers = np.column_stack([total, centre, *rows])
        reach = np.array(inverse_mass, np.float64)
        reach[self.vertices] = 1 / total[self.owner] + np.einsum("ni,nij,nj->n", self.y, inverse[self.owner], self.y)
        for name, data in dict(place=places, mass=self.mass, numbers=numbers.ravel(), reach=reach).items():
            runtime.fill(self.arrays[f"body_{name}"], data)

    def _sums(self, x: np.ndarray) -> np.ndarray:
        """Of each body."""
        return linear(x, lambda x: np.add.reduceat(x, self.first[:-1], axis=0), lambda seed: seed[self.owner])

    def _measured(self, mass: np.ndarray, places: np.ndarray) -> tuple:
        """(M, X_, y, J); of arrays that record, too."""
        total = self._sums(mass)
        centre = self._sums(mass[:, None] * places) / total[:, None]
        y = places - centre[self.owner]
        return total, centre, y, self._sums(mass[:, None, None] * y[:, :, None] * y[:, None, :])

    def tangent(self, change: Derived) -> dict:
        """{name: array} of changes: of places, and of the numbers."""
        dm, m, X = change.mass[self.vertices], Recorded(self.mass), Recorded(self.places)
        changes = [(m, dm), (X, np.where(self.rigid[self.owner, None], change.rest[self.vertices], 0.0))]
        dtotal, dcentre, dy, dJ = (forward(x, changes) for x in self._measured(m, X))
        row = np.column_stack([dJ[:, a, b] for a, b in PAIRS])
        numbers = np.column_stack([dtotal, dcentre, 0 * row, row])
        return dict(
            body_place=runtime.upload(dy, self.vector),  # of y
            body_mass=runtime.upload(dm, self.fp),
            body_numbers=runtime.upload(numbers.ravel(), ti.f64),
            body_force=runtime.array(self.vector, 1, len(change.mass)),
        )

    def adjoint(self) -> dict:
        """{name: array} of sums, zero."""
        return dict(
            body_adjoints=runtime.array(ti.f64, SIZE * len(self.vertices)),
            body_sums=runtime.array(ti.f64, SUMS * len(self.bodies)),
        )

    def collect(self, adjoints: dict, out: Derived) -> None:
        """Add what the sums say of masses and rest positions."""
        of_vertices = runtime.fetch(adjoints["body_adjoints"]).reshape(-1, SIZE)
        sums = runtime.fetch(adjoints["body_sums"]).reshape(-1, SUMS)
        by_J = np.zeros((len(sums), 3, 3))
        for k, (a, b) in enumerate(PAIRS):
            by_J[:, a, b] = sums[:, 1 + k]
        m, X = Recorded(self.mass), Recorded(self.places)
        total, _, y, J = self._measured(m, X)
        seeds = (m, of_vertices[:, 3]), (total, sums[:, 0]), (y, of_vertices[:, :3]), (J, by_J)
        by_mass, by_place = reverse_of_all(seeds, [m, X])
        mass, rest = np.zeros_like(out.mass), np.zeros_like(out.rest)
        mass[self.vertices] = by_mass
        moved = self.rigid[self.owner]
        rest[self.vertices[moved]] = by_place[moved]
        out.mass, out.rest = out.mass + mass, out.rest + rest

    # ---- on the host, for what is evaluated between passes
    # --------------------------------------------------------------------

    def pulled(self, forces: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Forces [N] on all vertices with those that hold the bodies together, at displacements u."""
        mass = np.ones(len(forces))
        mass[self.vertices] = self.mass
        return mass[:, None] * self.projected(forces / mass[:, None], u, mass)

    def projected(self, x: np.ndarray, u: np.ndarray | None, weights: np.ndarray) -> np.ndarray:
        """The nearest of x, shape (num_vertices, 3), that the bodies can do as a velocity at displacements u, where weights,
        shape (num_vertices,), are the masses by which it is near."""
        out = np.array(x, np.float64)
        for k, body in enumerate(self.bodies):
            at, own = body.vertices, slice(self.first[k], self.first[k + 1])
            m = weights[at][:, None]
            y = self.places[own] + u[at] if body.rigid else self.y[own]
            mean, total = (m * out[at]).sum(0) / m.sum(), m.sum()
            y = y - (m * y).sum(0) / total
            if body.rigid:
                inertia = (m * y * y).sum() * np.eye(3) - y.T @ (m * y)
                out[at] = mean + np.cross(np.linalg.solve(inertia, (m * np.cross(y, out[at])).sum(0)), y)
            else:
                out[at] = mean + y @ np.linalg.solve(y.T @ (m * y), y.T @ (m * out[at]))
        return out
