"""Link of loads at a remote point: from force and moment to forces on the vertices of a surface."""

import numpy as np

from diffsim_ti.inputs.chain import Link


class RemoteForces(Link):
    """f_i = a_i (F / A + omega x r_i),    J omega = M + (p - c) x F,    J = sum a_i (|r_i|^2 - r_i r_i^T),

    shape (2, rows, k, 3), of (F, M) over time, (2, rows, 6), rest positions and areas a_i of k vertices, A = sum a_i, r_i
    from their centre c. p: the point; None: c. For all of a, r and (F, M) both derivatives.
    """

    def __init__(self, load: str, areas: str, vertices: np.ndarray, point: np.ndarray | None, writes: str):
        self.reads, self.writes = (load, "rest", areas), (writes,)
        self.vertices, self.point = vertices, point

    def _parts(self, load, X, a):
        F, M = load[..., :3], load[..., 3:]
        A = a.sum()
        c = a @ X[self.vertices] / A
        r, arm = X[self.vertices] - c, np.zeros(3) if self.point is None else self.point - c
        J = (a * (r**2).sum(1)).sum() * np.eye(3) - (r.T * a) @ r
        omega = np.linalg.solve(J, (M + np.cross(arm, F))[..., None])[..., 0]
        return F, A, r, arm, J, omega, F[..., None, :] / A + np.cross(omega[..., None, :], r)

    def value(self, load, X, a):
        return (a[:, None] * self._parts(load, X, a)[-1],)

    def jvp(self, x, dx):
        (load, X, a), (dload, dX, da) = x, dx
        F, A, r, arm, J, omega, per_area = self._parts(load, X, a)
        dF, dM, dA = dload[..., :3], dload[..., 3:], da.sum()
        dc = (da @ r + a @ dX[self.vertices]) / A
        dr = dX[self.vertices] - dc
        cross = (r.T * a) @ dr
        dJ = (da * (r**2).sum(1) + 2 * a * (r * dr).sum(1)).sum() * np.eye(3) - (r.T * da) @ r - cross - cross.T
        dT = dM + np.cross(arm, dF) - (0.0 if self.point is None else np.cross(dc, F))
        domega = np.linalg.solve(J, (dT - omega @ dJ)[..., None])[..., 0]
        change = dF[..., None, :] / A - F[..., None, :] * dA / A**2
        change = change + np.cross(domega[..., None, :], r) + np.cross(omega[..., None, :], dr)
        return (da[:, None] * per_area + a[:, None] * change,)

    def vjp(self, x, y_adj):
        load, X, a = x
        F, A, r, arm, J, omega, per_area = self._parts(load, X, a)
        w = y_adj[0]
        aw = a[:, None] * w
        t = np.linalg.solve(J, np.cross(r, aw).sum(-2)[..., None])[..., 0]  # adjoint of J omega
        by_load = np.concatenate([aw.sum(-2) / A + np.cross(t, arm), t], -1)
        by_a = (w * per_area).sum((0, 1, 3)) - (aw * F[..., None, :]).sum() / A**2
        tr, wr, tw = t @ r.T, omega @ r.T, (t * omega).sum(-1)[..., None]
        by_a += (tr * wr - tw * (r**2).sum(1)).sum((0, 1))
        by_r = np.cross(aw, omega[..., None, :]).sum((0, 1)) - 2 * a[:, None] * r * tw.sum()
        by_r += a[:, None] * ((wr[..., None] * t[..., None, :]) + tr[..., None] * omega[..., None, :]).sum((0, 1))
        by_c = -by_r.sum(0) - (0.0 if self.point is None else np.cross(F, t).sum((0, 1)))
        by_X = np.zeros_like(X)
        by_X[self.vertices] = by_r + a[:, None] * by_c / A
        return by_load, by_X, by_a + r @ by_c / A
