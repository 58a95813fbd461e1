"""Linear relations between displacements, g = sum c . u - value = 0: held exactly, in implicit steps and statics by
multipliers as volumes are (chambers/multipliers.py), in explicit steps by a stage; or, with a stiffness, by a penalty in
implicit steps and statics, E = sum of stiffness / 2 g^2."""

import numpy as np

from diffsim_ti.differentiation.arrays import summed_at, value_of
from diffsim_ti.inputs.loads import PressureRows
from diffsim_ti.mechanics.chambers.pressures import PrescribedVolume
from diffsim_ti.mechanics.chambers.volume_constraints import VolumeConstraints, along, slopes
from diffsim_ti.mechanics.corrections import Correction
from diffsim_ti.mechanics.host_force import HostForce
from diffsim_ti.mechanics.interaction import Interaction
from diffsim_ti.mechanics.pressure.follower_pressure import pressures_at
from diffsim_ti.terms.multi_point_constraint import MultiPointConstraint
from diffsim_ti.terms.robots.robot import Robot


def rows_of(coefficients: list[np.ndarray], vertices: list[np.ndarray], num_vertices: int):
    """Relations as rows of a SciPy CSR matrix."""
    from scipy.sparse import csr_matrix

    columns = [(3 * at[:, None] + np.arange(3)).ravel() for at in vertices]
    start = np.cumsum([0, *map(len, columns)])
    entries = np.concatenate([c.ravel() for c in coefficients]), np.concatenate(columns), start
    return csr_matrix(entries, (len(columns), 3 * num_vertices))


class ConstraintForce(HostForce):
    """Of each relation its vertices, shape (k,), and where its coefficients and stiffness stand among the parameters.

    A relation with a stiffness pushes with p = -stiffness g, f_j = p c_j; one without with what holds it (multipliers.py).
    laws: of the latter, whose numbers are `held`.
    """

    has_energy = symmetric = True

    def __init__(self, vertices: list[np.ndarray], rows: list[slice]):
        self.vertices, self.rows = vertices, rows
        self.held = [k for k, (at, row) in enumerate(zip(vertices, rows)) if row.stop - row.start == 3 * len(at)]
        self.laws = [PrescribedVolume() for _ in self.held]

    def take(self, values, instant):
        numbers = [values.parameters[row] for row in self.rows]
        self.c = [x[: 3 * len(at)].reshape(-1, 3) for x, at in zip(numbers, self.vertices)]
        self.given = [x[-1] for x in numbers]
        if values.relations is None:  # of no step
            return super().take(values, instant)
        self.value = instant.load * pressures_at(values.relations, instant)
        for law, k in zip(self.laws, self.held):
            law.target = float(value_of(self.value)[k])
        return super().take(values, instant)

    def stiffest(self, values, schedule):
        """Explicit steps hold relations without a stiffness."""
        super().stiffest(values, schedule)
        self.given = [0.0 for _ in self.given]
        return self

    @property
    def k(self) -> list[float]:
        """-dp/dg [N/m]."""
        out = list(self.given)
        for law, k in zip(self.laws, self.held):
            out[k] = law.gamma
        return out

    def _along(self, u) -> list:
        return [(c * u[at]).sum() for c, at in zip(self.c, self.vertices)]

    def _spread(self, amounts, shape) -> np.ndarray:
        out = np.zeros(shape)
        for amount, c, at in zip(amounts, self.c, self.vertices):
            np.add.at(out, at, amount * c)
        return out

    def forces(self, u):
        along = self._along(u)
        pushes = [-k * (x - value) for k, x, value in zip(self.given, along, self.value)]
        for law, k in zip(self.laws, self.held):  # in derivatives the target has the slope gamma
            pushes[k] = law.pressure(along[k]) + law.gamma * (self.value[k] - law.target)
        parts = np.concatenate([p * c for p, c in zip(pushes, self.c)])
        return summed_at(np.concatenate(self.vertices), parts, len(u))

    def energies(self, u):
        along = self._along(u)
        out = np.array([0.5 * k * (x - value) ** 2 for k, x, value in zip(self.given, along, self.value)])
        for law, k in zip(self.laws, self.held):
            gone = along[k] - law.volume
            out[k] = gone * (0.5 * law.gamma * gone - law.multiplier)
        return out

    def product(self, u, w, convex=False):
        return self._spread([k * x for k, x in zip(self.k, self._along(w))], u.shape)

    def blocks(self, u):
        out = np.zeros((len(u), 3, 3))
        for c, k, at in zip(self.c, self.k, self.vertices):
            np.add.at(out, at, k * c[:, :, None] * c[:, None])
        return out

    def matrix(self, u):
        C = rows_of(self.c, self.vertices, len(u))
        return C.T @ C.multiply(np.array(self.k)[:, None]).tocsr()

    def resisted(self):
        which = np.repeat(np.arange(len(self.c)), [len(at) for at in self.vertices])
        return which, np.concatenate(self.vertices), np.concatenate(self.c)

    def turning(self, u, w):
        return 0.0

    # ---- of relations that are held, as of volumes (multipliers.py) -----------------------------------------------------

    def volumes_at(self, u):
        along = self._along(u)
        return [along[k] for k in self.held]

    def gradients(self, u):
        return [self._spread(np.arange(len(self.c)) == k, u.shape) for k in self.held]

    def missing(self, u):
        along = self._along(u)
        return np.stack([self.value[k] - along[k] for k in self.held])


class Constraints(Interaction):
    name, kinds, works, apart, in_kernels = "relations", (MultiPointConstraint,), "constraints", True, False
    derived = dict(relations="vectors2")  # values as each step begins and ends, and 0, (1 or steps, relations, 3)

    def check_solver(self, solver):
        exact = [term for term in self.terms if solver.explicit or term.is_exact]
        if not exact:
            return
        coefficients = [term.described[1].value for term in exact]
        indices, free = [term.indices(self.mesh) for term in exact], self.scene.supports.freedom(self.mesh.num_vertices)
        for robot in self.scene.terms_of(Robot):
            for _, vertices in robot.holds:
                free[vertices] = 0.0
        held = [c - np.einsum("kij,kj->ki", free[at], c) for c, at in zip(coefficients, indices)]
        C = rows_of(coefficients, indices, self.mesh.num_vertices)
        size = np.sqrt(np.asarray(C.power(2).sum(1)))
        if max(np.abs(x).max() for x in held) > 1e-12 * size.max():
            raise ValueError(
                "MultiPointConstraint: what is held exactly names no vertices that links of robots hold, or along "
                "directions in which they are fixed: leave them out and take c . u of them off the value, or with an "
                "implicit or static solver give it a stiffness="
            )
        left = C.toarray().reshape(len(exact), -1, 3)
        for body in self.scene.reduced.bodies:  # what vertices that are glued, or in sets, can do of them
            for row in left:
                row[body.vertices] = body.motion(body.numbers(row))
        left = left.reshape(len(exact), -1) / size
        if np.linalg.matrix_rank(left @ left.T, tol=1e-9) < len(exact):
            raise ValueError(
                "MultiPointConstraint: relations that are held exactly follow from each other: leave one out"
            )

    def links(self, own):
        return [PressureRows([row for t in self.terms for row in t.rows_in_time(own[t])], "relations")]

    def host(self):
        rows = [self.scene.inputs.parameters.of(term) for term in self.terms]
        return ConstraintForce([term.indices(self.mesh) for term in self.terms], rows)


class HeldRelations(VolumeConstraints):
    """Explicit passes hold relations as they hold volumes (volume_constraints.py), sum c . u in the place of V."""

    reads = ("parameters", "relations")

    def __init__(self, workspace):
        scene = workspace.scene
        terms = scene.terms_of(MultiPointConstraint)
        indices = [term.indices(scene.mesh) for term in terms]
        Correction.__init__(self, workspace, np.unique(np.concatenate(indices)))
        self.columns = list(range(len(terms)))
        self._own_numbers = [scene.inputs.parameters.of(term) for term in terms]
        self._at = [np.searchsorted(self.nodes, own) for own in indices]

    def positions(self, of, u):
        return u

    def gradients(self, of, x):
        """c, of all relations and vertices, found once of the numbers of a pass."""
        if not hasattr(of, "c"):
            given = [of.parameters[own][: 3 * len(at)] for at, own in zip(self._at, self._own_numbers)]
            of.c = np.stack([summed_at(at, c.reshape(-1, 3), len(self.nodes)) for at, c in zip(self._at, given)])
        return of.c

    def volumes(self, of, x, G=None):
        return along(self.gradients(of, x), x)

    def meet(self, of, y, d, targets):
        g = self.gradients(of, y)
        return np.linalg.solve(slopes(g, d), targets - along(g, y))

    def note(self, at, found):
        """Frames do not show it."""

    def record_of(self, run):
        return None
