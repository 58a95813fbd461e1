"""Friction where points within faces push, a stage of explicit passes after theirs (explicit_face_kernels.py), on the host.

In a pass obstacle o has pushed the nodes a of a face with impulses I_a, whose sum P = |P| n. So they share its push by
w_a = I_a . n / |P|, sum w_a = 1, and slide on the obstacle with t, what lies across n of sum w_a v_a less the obstacle's
velocity at sum w_a x_a, x the places where the pass began. Friction gives the nodes the impulses w_a r,

    r = -L f(s / eps) t / |t|,  L = mu |P|,    s + c f(s / eps) = |t|,  c = sum_a |w_a| S_a / m_a,  S_i = sum |w_a| L

the last sum over all that slides on vertex i; f(y) = 2 y - y^2 for y < 1, 1 beyond. It is the stage of surfaces that
slide on each other, and takes energy as that does, as the obstacles see it, whatever the step
(surfaces/friction_kernels.py).
"""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np

from diffsim_ti.common import rotations
from diffsim_ti.state.obstacle_poses import Moment
from diffsim_ti.terms.obstacles.friction import ARRAYS, slip

TINY = 1e-300


@dataclass
class FaceFrictionPass:
    """Friction in a pass, rows for each face and obstacle; `gained` is what vertices gain of it [m/s]."""

    now: SimpleNamespace  # numbers of the pass
    moment: Moment
    poses: np.ndarray
    face: np.ndarray
    obstacle: np.ndarray
    corners: np.ndarray  # places among the surface's vertices, (k, nodes)
    impulses: np.ndarray  # I_a, (k, nodes, 3)
    v: np.ndarray  # of the surface's vertices before it
    x: np.ndarray
    gained: np.ndarray | None = None

    @property
    def ratio(self) -> float:
        """The displacement by a change of velocity after a pass."""
        return self.now.alpha / self.now.decay


class FaceFriction:
    """Of the obstacles of a scene that are rough."""

    def __init__(self, workspace, surface: np.ndarray):
        a = workspace.arrays
        self.ws, self.a, self.surface, self.obstacles = workspace, a, surface, []
        for g in a.features().groups:
            if g.force.friction and a.features().reaches(g):
                self.obstacles += [(g.number + k, g.first + k * g.size, g.force.index) for k in range(g.count)]
        self.number = np.array([o for o, _, _ in self.obstacles], int)
        self.at_mu = np.array([first + index.friction for _, first, index in self.obstacles], int)
        self.at_eps = np.array([first + index.friction_speed for _, first, index in self.obstacles], int)
        self.free = a.supports.freedom(a.num_vertices)[surface]

    def _about(self, k: int) -> slice:
        """Where the point that the k-th of them turns about stands in the parameters."""
        _, first, index = self.obstacles[k]
        return slice(first + index.about, first + index.about + 3)

    def __bool__(self) -> bool:
        return bool(self.obstacles)

    def begin(self, impulses, v, x, corners, j: int, num_passes: int) -> FaceFrictionPass | None:
        """Friction after pass j, None if there is none; impulses [N s]: (faces, obstacles, nodes, 3)."""
        now, schedule = self.ws.numbers_of(j, num_passes), self.ws.solver.schedule
        own = impulses[:, self.number]
        face, which = np.nonzero(np.linalg.norm(own.sum(2), axis=-1) > TINY)
        if not len(face) or not now.alpha > 0 or not np.all(np.isfinite(own)):
            return None
        moment = Moment(schedule, j, schedule.begin(j), schedule.begin(j))
        poses = self.a.poses.value(self.a.rows["path"], moment)
        return FaceFrictionPass(now, moment, poses, face, which, corners[face], own[face, which], v, x)

    # ---- parts of the formula ----------------------------------------------------------------------------------------

    @property
    def inverse(self) -> np.ndarray:
        return self.a.inverse_of(self.a.values.mass)[self.surface, None]

    def freed(self, x: np.ndarray) -> np.ndarray:
        """What vertices may do of vectors."""
        return np.einsum("nij,nj->ni", self.free, x)

    def _gather(self, rub: FaceFrictionPass, at_nodes: np.ndarray) -> np.ndarray:
        """Sums for the surface's vertices."""
        out = np.zeros((len(self.surface), *at_nodes.shape[2:]))
        np.add.at(out, rub.corners, at_nodes)
        return out

    def _turning(self, rub: FaceFrictionPass, y: np.ndarray):
        """Of each obstacle (its place here, its own rows, first row of its pose or None, arms r, J, R r), R the turn in the
        pass and J its Jacobian by the angular velocity, per length of the pass."""
        for k, o in enumerate(self.number):
            own = np.flatnonzero(rub.obstacle == k)
            if o not in self.a.poses.place_of:
                yield k, own, None, None, None, None
                continue
            pose, h = 3 * self.a.poses.place_of[o], rub.now.h
            turn = h * rub.poses[pose + 2]
            r = y[own] - self.a.origin - rub.poses[3 * o] - self.a.values.parameters[self._about(k)]
            yield k, own, pose, r, rotations.left_jacobian(turn), rotations.turned(rotations.quaternion(turn), r)

    def _obstacle_velocity(self, rub: FaceFrictionPass, y: np.ndarray) -> np.ndarray:
        """Velocity of the obstacles at points y, on the chord of the pass (turned.py)."""
        out = rub.poses[3 * self.number[rub.obstacle] + 2]
        for _, own, pose, r, _, turned in self._turning(rub, y):
            if pose is not None:
                out[own] += (turned - r) / rub.now.h
        return out

    def _obstacle_velocity_jvp(self, rub: FaceFrictionPass, y, dy, dposes, parameters_dot) -> np.ndarray:
        out = dposes[3 * self.number[rub.obstacle] + 2]
        for k, own, pose, _, J, turned in self._turning(rub, y):
            if pose is not None:
                dr = dy[own] - dposes[3 * self.number[k]] - parameters_dot[self._about(k)]
                turn = rotations.quaternion(rub.now.h * rub.poses[pose + 2])
                out[own] += (rotations.turned(turn, dr) - dr) / rub.now.h + np.cross(J @ dposes[pose + 2], turned)
        return out

    def _obstacle_velocity_vjp(self, rub: FaceFrictionPass, y, by, poses_adj, parameters_adj) -> np.ndarray:
        """Adjoint of y for that of the velocities; adds those of the obstacle poses and of points that they turn about."""
        out = np.zeros_like(y)
        for k, own, pose, _, J, turned in self._turning(rub, y):
            poses_adj[3 * self.number[k] + 2] += by[own].sum(0)
            if pose is not None:
                back = rotations.quaternion(-rub.now.h * rub.poses[pose + 2])
                out[own] = (rotations.turned(back, by[own]) - by[own]) / rub.now.h
                poses_adj[pose + 2] += J.T @ np.cross(turned, by[own]).sum(0)
                poses_adj[3 * self.number[k]] -= out[own].sum(0)
                parameters_adj[self._about(k)] -= out[own].sum(0)
        return out

    def _known(self, rub: FaceFrictionPass) -> SimpleNamespace:
        """All that the formula names."""
        p, I = self.a.values.parameters, rub.impulses
        mu, eps = p[self.at_mu][rub.obstacle], p[self.at_eps][rub.obstacle]
        P = I.sum(1)
        size = np.linalg.norm(P, axis=1)
        n = P / size[:, None]
        w = np.einsum("kad,kd->ka", I, n) / size[:, None]
        v, x = rub.v[rub.corners], rub.x[rub.corners]
        at = np.einsum("ka,kad->kd", w, x)
        v_obstacle = self._obstacle_velocity(rub, at)
        relative = np.einsum("ka,kad->kd", w, v) - v_obstacle
        t = relative - n * _dot(n, relative)
        speed, L, inverse = np.linalg.norm(t, axis=1), mu * size, self.inverse
        S = self._gather(rub, (np.abs(w) * L[:, None])[..., None])
        lightness = inverse[rub.corners, 0]
        c = (np.abs(w) * S[rub.corners, 0] * lightness).sum(1)
        kappa, f, y, B = slip(speed, c, eps, TINY, ARRAYS)
        r = -(L * kappa)[:, None] * t
        of_push = dict(mu=mu, size=size, n=n, w=w, L=L, at=at)
        of_motion = dict(v=v, x=x, v_obstacle=v_obstacle, relative=relative, t=t, speed=speed)
        of_law = dict(S=S, inverse=inverse, lightness=lightness, kappa=kappa, f=f, y=y, B=B, r=r)
        return SimpleNamespace(**of_push, **of_motion, **of_law)

    def slide(self, rub: FaceFrictionPass) -> float:
        """Find what vertices gain; returns the work of moving obstacles on the body [J]."""
        k = self._known(rub)
        rub.gained = k.inverse * self.freed(self._gather(rub, k.w[:, :, None] * k.r[:, None]))
        return float((k.r * k.v_obstacle).sum())

    def impulses(self, rub: FaceFrictionPass) -> np.ndarray:
        """Of each rough obstacle on each surface vertex [N s], shape (obstacles, surface, 3)."""
        k = self._known(rub)
        return self._of_obstacles(rub, k.w[:, :, None] * k.r[:, None])

    def _of_obstacles(self, rub: FaceFrictionPass, at_nodes: np.ndarray) -> np.ndarray:
        out = np.zeros((len(self.number), len(self.surface), 3))
        np.add.at(out, (rub.obstacle[:, None], rub.corners), at_nodes)
        return out

    # ---- derivatives -------------------------------------------------------------------------------------------------

    def jvp(
        self, rub: FaceFrictionPass, dI, dv, dx, inverse_dot, parameters_dot, dposes
    ) -> tuple[np.ndarray, np.ndarray]:
        """(change of what vertices gain, of the impulses of each obstacle) for changes of everything.

        dI: (faces, obstacles, nodes, 3); dv, dx, inverse_dot: of the surface's vertices; dposes: rows as poses are.
        """
        k = self._known(rub)
        dI = dI[:, self.number][rub.face, rub.obstacle]
        d_mu, d_eps = (parameters_dot[at][rub.obstacle] for at in (self.at_mu, self.at_eps))
        dP = dI.sum(1)
        d_size = (k.n * dP).sum(1)
        dn = (dP - k.n * d_size[:, None]) / k.size[:, None]
        along = np.einsum("kad,kd->ka", dI, k.n) + np.einsum("kad,kd->ka", rub.impulses, dn)
        dw = (along - k.w * d_size[:, None]) / k.size[:, None]
        dy = np.einsum("ka,kad->kd", dw, k.x) + np.einsum("ka,kad->kd", k.w, dx[rub.corners])
        dv_obstacle = self._obstacle_velocity_jvp(rub, k.at, dy, dposes, parameters_dot)
        d_relative = np.einsum("ka,kad->kd", dw, k.v) + np.einsum("ka,kad->kd", k.w, dv[rub.corners]) - dv_obstacle
        dt = d_relative - k.n * _dot(k.n, d_relative) - dn * _dot(k.n, k.relative) - k.n * _dot(dn, k.relative)
        dL, sign = d_mu * k.size + k.mu * d_size, np.sign(k.w)
        dS = self._gather(rub, (sign * dw * k.L[:, None] + np.abs(k.w) * dL[:, None])[..., None])
        of_S = k.S[rub.corners, 0]
        dc = (sign * dw * of_S * k.lightness + np.abs(k.w) * dS[rub.corners, 0] * k.lightness).sum(1)
        dc += (np.abs(k.w) * of_S * inverse_dot[rub.corners, 0]).sum(1)
        e = k.t / np.maximum(k.speed, TINY)[:, None]
        d_speed = (e * dt).sum(1)
        df = k.B * (d_speed - k.f * dc - k.y * d_eps)
        dr = -(dL * k.kappa)[:, None] * k.t
        dr -= k.L[:, None] * ((df - k.kappa * d_speed)[:, None] * e + k.kappa[:, None] * dt)
        at_nodes = dw[:, :, None] * k.r[:, None] + k.w[:, :, None] * dr[:, None]
        pushed = self._gather(rub, k.w[:, :, None] * k.r[:, None])
        change = k.inverse * self.freed(self._gather(rub, at_nodes)) + inverse_dot * self.freed(pushed)
        return change, self._of_obstacles(rub, at_nodes)

    def vjp(self, rub: FaceFrictionPass, gained_adj: np.ndarray, impulses_adj: np.ndarray | None) -> SimpleNamespace:
        """Adjoints, by name, for that of what vertices gain and of the impulses of each obstacle: impulses (faces rows as
        `rub` has them), v, x and inverse of the surface's vertices, parameters, poses."""
        k, N = self._known(rub), np.abs
        g = self.freed(k.inverse * gained_adj)[rub.corners]  # of the impulses at nodes
        if impulses_adj is not None:
            g = g + impulses_adj[rub.obstacle[:, None], rub.corners]
        pushed = self._gather(rub, k.w[:, :, None] * k.r[:, None])
        by_inverse = (gained_adj * self.freed(pushed)).sum(1, keepdims=True)
        r_adj = np.einsum("ka,kad->kd", k.w, g)
        w_adj = np.einsum("kad,kd->ka", g, k.r)
        e, sign = k.t / np.maximum(k.speed, TINY)[:, None], np.sign(k.w)
        by_f = -k.L * (e * r_adj).sum(1)
        L_adj = -k.kappa * (k.t * r_adj).sum(1)
        t_adj = -(k.L * k.kappa)[:, None] * r_adj + (by_f * (k.B - k.kappa))[:, None] * e
        c_adj, eps_adj = -by_f * k.B * k.f, -by_f * k.B * k.y
        # c = sum |w| S / m
        of_S = k.S[rub.corners, 0]
        w_adj += c_adj[:, None] * sign * of_S * k.lightness
        S_adj = self._gather(rub, (c_adj[:, None] * N(k.w) * k.lightness)[..., None])
        by_inverse += self._gather(rub, (c_adj[:, None] * N(k.w) * of_S)[..., None])
        at = S_adj[rub.corners, 0]
        w_adj += at * sign * k.L[:, None]
        L_adj += (at * N(k.w)).sum(1)
        mu_adj, size_adj = L_adj * k.size, L_adj * k.mu
        # t, and the relative velocity
        relative_adj = t_adj - k.n * _dot(k.n, t_adj)
        n_adj = -t_adj * _dot(k.n, k.relative) - k.relative * _dot(k.n, t_adj)
        w_adj += np.einsum("kad,kd->ka", k.v, relative_adj)
        v_adj = self._gather(rub, k.w[:, :, None] * relative_adj[:, None])
        poses_adj, parameters = np.zeros_like(rub.poses), np.zeros_like(self.a.values.parameters)
        y_adj = self._obstacle_velocity_vjp(rub, k.at, -relative_adj, poses_adj, parameters)
        w_adj += np.einsum("kad,kd->ka", k.x, y_adj)
        x_adj = self._gather(rub, k.w[:, :, None] * y_adj[:, None])
        # w = I . n / |P|
        size_adj -= (w_adj * k.w).sum(1) / k.size
        w_adj = w_adj / k.size[:, None]
        I_adj = w_adj[:, :, None] * k.n[:, None]
        n_adj += np.einsum("ka,kad->kd", w_adj, rub.impulses)
        P_adj = k.n * size_adj[:, None] + (n_adj - k.n * _dot(k.n, n_adj)) / k.size[:, None]
        np.add.at(parameters, self.at_mu[rub.obstacle], mu_adj)
        np.add.at(parameters, self.at_eps[rub.obstacle], eps_adj)
        return SimpleNamespace(
            impulses=I_adj + P_adj[:, None],
            v=v_adj,
            x=x_adj,
            inverse=by_inverse,
            parameters=parameters,
            poses=poses_adj,
        )


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (a * b).sum(1, keepdims=True)
