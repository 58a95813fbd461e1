"""Sets that do not deform, in implicit passes: their places, what they may do from there, and what turning changes.

The end of a pass u' = c0 u* + (1 - c0) u is rigid, x' = R D + mean, D the rest positions without their mean. With y* and y'
the places of the vertices without their mean at u* and at u', forces and torques balance where u* is,

    sum F = 0,    sum y* x F = 0,        du* = t + omega x y'

Forces that keep the shape do no work in a turn about u*. Where u* is the end (c0 = 1) both spaces are the same, and the
Hessian of the incremental potential on the rigid motions is symmetric. The midpoint rule (c0 = 2) has two: its forces of
constraint pull as the middle of the step is stretched, so that they keep angular momentum and do no work.
Gonzalez 1999, Mechanical systems subject to holonomic constraints, doi:10.1016/S0167-2789(99)00054-8.

Newton's method goes along du*, then to the nearest place whose end is rigid. Its matrix has, besides that of all vertices
between both spaces, what turning y* changes of the torque of the forces that the shape resists.

A vector of all vertices w stands for t = mean w and omega = J^-1 sum y* x w, J = sum |y*|^2 - y* y*^T: of residuals it is
their resultant, of directions the motion t + omega x y'.
"""

import numpy as np

from diffsim_ti.common.rotations import skew
from diffsim_ti.inputs.rigid_start import axial, inertia, nearest_rotation
from diffsim_ti.terms.reduced import Reduced, Together


def torque(y: np.ndarray, F: np.ndarray) -> np.ndarray:
    """sum y x F"""
    return axial(F.T @ y)


def crossed(omega: np.ndarray, y: np.ndarray) -> np.ndarray:
    """omega x y of each row."""
    return y @ skew(omega).T


class RigidSet:
    """One of them, in a pass."""

    def __init__(self, body: Together, rest: np.ndarray):
        self.vertices, self.D = body.vertices, body.apart(rest)
        self.C = np.zeros((3, 3))
        self._size = float(np.sqrt((self.D**2).sum()))  # of a turn

    def nearest(self, u: np.ndarray) -> np.ndarray:
        """The rigid displacement nearest to u, both of the set's vertices; what is only shifted stays to the bit."""
        if not np.ptp(u, 0).any():
            return u
        R = nearest_rotation(self._apart(u).T @ self.D)
        return u.mean(0) + self.D @ (R.T - np.eye(3))

    def place(self, u: np.ndarray, end: np.ndarray) -> None:
        """Stand at u* with the end of the pass there."""
        self.y, self.y_end = self._apart(u), self._apart(end)
        self.inverse = np.linalg.inv(inertia(self.y))

    def take_forces(self, F: np.ndarray, symmetric: bool) -> None:
        """Take the forces that are out of balance, which turning changes: C omega is what comes to their torque, less."""
        self.F = F
        C = (self.y_end * F).sum() * np.eye(3) - self.y_end.T @ F
        self.C = 0.5 * (C + C.T) if symmetric else C

    def omega(self, w: np.ndarray) -> np.ndarray:
        """J^-1 sum y* x w."""
        return self.inverse @ torque(self.y, w)

    def resultant(self, t: np.ndarray, turning: np.ndarray) -> np.ndarray:
        """The vector of vertices that stands for t and omega = J^-1 turning."""
        return t + crossed(self.inverse @ turning, self.y)

    @property
    def convex(self) -> np.ndarray:
        """C without negative eigenvalues."""
        values, vectors = np.linalg.eigh(0.5 * (self.C + self.C.T))
        return (vectors * np.maximum(values, 0)) @ vectors.T

    def fields(self) -> np.ndarray:
        """Displacements, of size 1, of its shifts and turns from where it stands, shape (k, 3, 6)."""
        turns = np.cross(np.eye(3), self.y[:, None]) / self._size
        return np.swapaxes(np.concatenate([np.tile(np.eye(3), (len(turns), 1, 1)) / len(turns) ** 0.5, turns], 1), 1, 2)

    def stiffness_of_turns(self) -> np.ndarray:
        """What turning changes of resultants, less, for those turns, shape (3, 3)."""
        return 0.5 * (self.C + self.C.T) / self._size**2

    def rotation(self) -> np.ndarray:
        """From rest to the end of the pass."""
        return nearest_rotation(self.y_end.T @ self.D)

    def _apart(self, u: np.ndarray) -> np.ndarray:
        return self.D + (u - u.mean(0))


class RigidSets:
    """Those of a scene. Vectors are of all vertices of the mesh, shape (num_vertices, 3)."""

    def __init__(self, reduced: Reduced, rest: np.ndarray):
        self.sets = [RigidSet(body, rest) for body in reduced.rigid]
        self.rounding = np.zeros((len(rest), 1))  # of the places of vertices [m], by that of the turn of their set
        for own in self.sets:
            self.rounding[own.vertices, 0] = np.finfo(float).eps * np.linalg.norm(own.D, axis=1)
        self.begin(np.zeros_like(rest), 1.0)

    def __bool__(self) -> bool:
        return bool(self.sets)

    @property
    def symmetric(self) -> bool:
        """Whether forces are taken at the end of a pass."""
        return self.c0 == 1

    def begin(self, u: np.ndarray, c0: float) -> None:
        """A pass from displacements u, of a stage with c0."""
        self.before, self.c0 = u, c0
        self.place(u)

    def _each(self, x: np.ndarray, change) -> np.ndarray:
        """x with the part of each set replaced by change(set, part)."""
        if not self.sets:
            return x
        out = np.array(x)
        for own in self.sets:
            out[own.vertices] = change(own, x[own.vertices])
        return out

    # ---- places --------------------------------------------------------------------------------------------------------

    def end(self, u: np.ndarray) -> np.ndarray:
        """u with the sets at the rigid places that are nearest."""
        return self._each(u, RigidSet.nearest)

    def nearest(self, u: np.ndarray) -> np.ndarray:
        """The same of u*, whose ends are rigid."""

        def middle(own, part):
            before = self.before[own.vertices]
            return (own.nearest(self.c0 * part + (1 - self.c0) * before) + (self.c0 - 1) * before) / self.c0

        return self._each(u, middle)

    def place(self, u: np.ndarray) -> None:
        """Stand at u*."""
        for own in self.sets:
            at = own.vertices
            own.place(u[at], self.c0 * u[at] + (1 - self.c0) * self.before[at])

    def take_forces(self, forces: np.ndarray) -> None:
        """Take the forces that are out of balance there, with those that the shape resists."""
        for own in self.sets:
            own.take_forces(forces[own.vertices], self.symmetric)

    # ---- what they may do ----------------------------------------------------------------------------------------------

    def resultants(self, x: np.ndarray) -> np.ndarray:
        """Resultants of forces on the sets, a projection."""
        return self._each(x, lambda own, w: own.resultant(w.mean(0), torque(own.y, w)))

    def motion(self, w: np.ndarray) -> np.ndarray:
        """The motion that w stands for."""
        return self._each(w, lambda own, part: part.mean(0) + crossed(own.omega(part), own.y_end))

    def motion_vjp(self, d: np.ndarray) -> np.ndarray:
        """Its transpose."""
        return self._each(d, lambda own, part: own.resultant(part.mean(0), torque(own.y_end, part)))

    def stiffness(self, w: np.ndarray, transposed: bool = False, convex: bool = False) -> np.ndarray:
        """What turning changes of resultants, less, for the motion that w stands for; zero elsewhere."""
        out = np.zeros_like(w)
        for own in self.sets:
            C = own.convex if convex else own.C.T if transposed else own.C
            out[own.vertices] = own.resultant(np.zeros(3), C @ own.omega(w[own.vertices]))
        return out

    # ---- derivatives ---------------------------------------------------------------------------------------------------

    def turned(self, d: np.ndarray) -> np.ndarray:
        """Resultants of the forces out of balance for a change d of places."""
        out = np.zeros_like(d)
        for own in self.sets:
            part = d[own.vertices]
            out[own.vertices] = own.resultant(np.zeros(3), torque(part - part.mean(0), own.F))
        return out

    def turned_vjp(self, w: np.ndarray) -> np.ndarray:
        """Its transpose."""
        out = np.zeros_like(w)
        for own in self.sets:
            by = -crossed(own.omega(w[own.vertices]), own.F)
            out[own.vertices] = by - by.mean(0)
        return out

    def held_jvp(self, held: np.ndarray, du: np.ndarray, dX: np.ndarray) -> np.ndarray:
        """Change of u*, less motions of the sets, for those of the displacement before and of the rest positions."""

        def change(own, _):
            at = own.vertices
            dD = dX[at] - dX[at].mean(0)
            return (1 - 1 / self.c0) * du[at] + dD @ (own.rotation().T - np.eye(3)) / self.c0

        return self._each(held, change)

    def held_vjp(self, star_adj: np.ndarray, u_adj: np.ndarray, rest_adj: np.ndarray) -> None:
        """Add its adjoints to those of the displacement before and of the rest positions."""
        for own in self.sets:
            at = own.vertices
            u_adj[at] += (1 - 1 / self.c0) * star_adj[at]
            by_D = star_adj[at] @ (own.rotation() - np.eye(3)) / self.c0
            rest_adj[at] += by_D - by_D.mean(0)
