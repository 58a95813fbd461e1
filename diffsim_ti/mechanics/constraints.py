"""Linear relations between displacements, held by a penalty: E = sum of stiffness / 2 g^2, g = sum c . u - value."""

import numpy as np

from diffsim_ti.inputs.loads import PressureRows
from diffsim_ti.mechanics.host_force import HostForce
from diffsim_ti.mechanics.interaction import Interaction
from diffsim_ti.mechanics.pressure.follower_pressure import pressures_at
from diffsim_ti.terms.multi_point_constraint import MultiPointConstraint


class ConstraintForce(HostForce):
    """Of each relation its vertices, shape (k,), and where its coefficients and stiffness stand among the parameters."""

    has_energy = symmetric = True

    def __init__(self, vertices: list[np.ndarray], rows: list[slice]):
        self.vertices, self.rows = vertices, rows

    def take(self, values, instant):
        numbers = [values.parameters[row] for row in self.rows]
        self.c, self.k = [x[:-1].reshape(-1, 3) for x in numbers], [x[-1] for x in numbers]
        self.value = instant.load * pressures_at(values.relations, instant)
        return super().take(values, instant)

    def _gaps(self, u, value) -> list[float]:
        return [float((c * u[at]).sum()) - x for c, at, x in zip(self.c, self.vertices, value)]

    def _spread(self, amounts, shape) -> np.ndarray:
        out = np.zeros(shape)
        for amount, c, at in zip(amounts, self.c, self.vertices):
            np.add.at(out, at, amount * c)
        return out

    def forces(self, u):
        return self._spread([-k * g for k, g in zip(self.k, self._gaps(u, self.value))], u.shape)

    def energies(self, u):
        return np.array([0.5 * k * g**2 for k, g in zip(self.k, self._gaps(u, self.value))])

    def jvp(self, u, du, dv, moved=None):
        none = np.zeros(len(self.k))
        out = self._spread([-k * g for k, g in zip(self.k, self._gaps(du, none))], u.shape)
        if moved is None:
            return out
        dvalue = self.instant.load * pressures_at(moved.relations, self.instant)
        for c, k, at, g, row, dx in zip(self.c, self.k, self.vertices, self._gaps(u, self.value), self.rows, dvalue):
            change = moved.parameters[row]
            dc, dk = change[:-1].reshape(-1, 3), change[-1]
            np.add.at(out, at, -(dk * g + k * (float((dc * u[at]).sum()) - dx)) * c - k * g * dc)
        return out

    def vjp(self, u, w, adj=None):
        none = np.zeros(len(self.k))
        pulled = self._gaps(w, none)
        if adj is not None:
            by_value = []
            for k, at, g, row, p in zip(self.k, self.vertices, self._gaps(u, self.value), self.rows, pulled):
                adj.parameters[row] += np.append(-k * (p * u[at] + g * w[at]), -g * p)
                by_value.append(self.instant.load * k * p)
            at = self.instant
            at.schedule.add_pressure(adj.relations, at.j, at.share, np.array(by_value))
        return self._spread([-k * p for k, p in zip(self.k, pulled)], u.shape), 0.0

    def product(self, u, w, convex=False):
        return self._spread([k * p for k, p in zip(self.k, self._gaps(w, np.zeros(len(self.k))))], u.shape)

    def blocks(self, u):
        out = np.zeros((len(u), 3, 3))
        for c, k, at in zip(self.c, self.k, self.vertices):
            np.add.at(out, at, k * c[:, :, None] * c[:, None])
        return out

    def matrix(self, u):
        from scipy.sparse import csr_matrix

        columns = [(3 * at[:, None] + np.arange(3)).ravel() for at in self.vertices]
        start = np.cumsum([0, *map(len, columns)])
        entries = np.concatenate([c.ravel() for c in self.c]), np.concatenate(columns), start
        C = csr_matrix(entries, (len(self.k), u.size))
        return C.T @ C.multiply(np.array(self.k)[:, None]).tocsr()

    def resisted(self):
        which = np.repeat(np.arange(len(self.k)), [len(at) for at in self.vertices])
        return which, np.concatenate(self.vertices), np.concatenate(self.c)

    def turning(self, u, w):
        return 0.0


class Constraints(Interaction):
    name, kinds, works = "relations", (MultiPointConstraint,), "constraints"
    derived = dict(relations="vectors2")  # values as each step begins and ends, and 0, (1 or steps, relations, 3)

    def links(self, own):
        return [PressureRows([row for t in self.terms for row in t.rows_in_time(own[t])], "relations")]

    def host(self):
        rows = [self.scene.inputs.parameters.of(term) for term in self.terms]
        return ConstraintForce([term.indices(self.mesh) for term in self.terms], rows)
