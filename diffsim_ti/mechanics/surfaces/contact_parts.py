"""Contact of near pairs in a part of an explicit pass, in float64: what the contact stage of pairs repeats. Forward it is
done by part_kernels.py; here are the same formulas for NumPy's arrays, their tangents, by complex numbers, and adjoints.

In a part of length h nodes of mass m would move by f = alpha v, points x = C X with them (curved_pairs.py; C = 1 where faces
are flat). Pair p presses along its normal n_p with its weights w_p, B = w C, from a distance d_p to

    y_p = d_p + n_p . B z,    z = f + alpha (1 + c) / 2 delta,    delta = (h / m) sum_p P_p B_p^T n_p,

P the push of secant.py: one convex problem for all pairs, so that there is one z. Then the velocity gains delta, and what
friction takes with the normal forces P, and nodes drift by alpha (v + (1 + c) / 2 delta + friction).
Impulses of a pair sum up to zero, so that momentum is kept to round-off. Angular momentum is, too, with normals and weights
taken where f has gone the share (1 - c) / 2, for X + that share of f is where delta acts; they are taken at the beginning
where c = 1.

A pair that presses with P slides with the velocity t = T B v across its normal, T = I - n n^T. Friction gives it the impulse

    r = -h mu P f(s / eps) t / |t|,   s + c f(s / eps) = |t|,   c = h sum_i (|B_i| / m_i) S_i,   S_i = sum |B_i| mu P

over nodes i, the last sum over all pairs, with bounds of the blocks of the inverse mass where a set has a matrix
(sets_in_contact.py); f is that of terms/obstacles/friction.py. c / (h mu P) is a bound W of the inverse
mass that the pair meets while all others have friction, too: by Cauchy and Schwarz |sum_p r_p B_p|^2 / m is at most
sum_p W_p |r_p|^2. With r_p = -(1 - s / |t|) t / W_p all frictions together change the kinetic energy by no more than

    sum_p (r_p . t_p + W_p |r_p|^2 / 2) = -sum_p (|t|^2 - s^2) / 2 W_p <= 0

for any h, P, mu and eps, and no node depends on the order of the pairs. Where a patch slides as a whole W is no bound but
the value, and s the speed of sliding at the end: it creeps no faster than eps.

Beneath WALL of its width a pair meets a second barrier of stiffness (mean mass) / h^2, whose push is of the end alone and
stops what comes at a width in h: as stiff as the part resolves, and without effect on what is as far apart as contact should
be. So surfaces stay apart whatever the stiffness, and what it cannot hold is lost as in an inelastic impact.
"""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np

from diffsim_ti.mechanics.surfaces import host_geometry as geometry
from diffsim_ti.mechanics.surfaces.host_geometry import TINY, dot
from diffsim_ti.mechanics.surfaces.part_kernels import WALL
from diffsim_ti.terms.obstacles.friction import ARRAYS, slip

DENSE = 1000  # unknowns up to which a dense matrix is factored


def total(x: np.ndarray) -> float:
    """The sum, with the same bits whatever zeros stand among the numbers: those of nodes that no pair reads."""
    return x[x != 0].sum()


@dataclass
class NearPairs:
    """What does not change in a pass: corners (pairs, 4) among the points, which are of edges, their scale (proximity.py);
    C (points, nodes) or None, what nodes may do (nodes, 3, 3) or None; of sets that move by few numbers the nodes that are
    their vertices, and those that stand for their numbers (SetInContact)."""

    corners: np.ndarray
    edges: np.ndarray
    scale: np.ndarray
    num_points: int
    C: object
    free: np.ndarray | None
    sets: list[SimpleNamespace]  # at: nodes, the vertices first, `here` of the set; twist: a node, or None

    def of_own_nodes(self) -> tuple["NearPairs", np.ndarray]:
        """The same without nodes that no pair reads, where sets are; which nodes are kept."""
        read, sets = np.unique(self.C[np.unique(self.corners)].indices), []
        for x in self.sets:
            vertices, numbers = x.at[: len(x.here)], x.at[len(x.here) :]
            here = np.isin(vertices, read)
            if here.any():
                sets.append(vars(x) | dict(here=x.here[here], at=np.append(vertices[here], numbers)))
        kept = np.unique(np.concatenate([read, *(x["at"] for x in sets)]))
        for x in sets:
            x |= dict(at=np.searchsorted(kept, x["at"]), twist=x["twist"] and int(np.searchsorted(kept, x["twist"])))
        free = None if self.free is None else self.free[kept]
        return replace(self, C=self.C[:, kept].tocsr(), free=free, sets=[SimpleNamespace(**x) for x in sets]), kept

    def points(self, nodes: np.ndarray) -> np.ndarray:
        return nodes if self.C is None else self.C @ nodes

    def nodes(self, points: np.ndarray) -> np.ndarray:
        return points if self.C is None else self.C.T @ points

    def freed(self, x: np.ndarray) -> np.ndarray:
        return x if self.free is None else np.einsum("nij,nj->ni", self.free, x)

    def lightened(self, of, x: np.ndarray) -> np.ndarray:
        """Products of inverse masses with vectors of the nodes."""
        out = (of.inverse * x.T).T
        for near, own in zip(self.sets, of.sets):
            out[near.at] = own.lightened(x[near.at])
        return out

    def lightened_vjp(self, of, adj, a: np.ndarray, x: np.ndarray) -> None:
        """Add the adjoints of inverse masses in a . lightened(x)."""
        adj.inverse += dot(a, x)
        for near, own, by in zip(self.sets, of.sets, adj.sets):
            own.lightened_vjp(by, a[near.at], x[near.at])

    def lightened_sizes(self, of, x: np.ndarray) -> np.ndarray:
        """The same of numbers, by bounds of inverse masses."""
        out = of.inverse * x
        for near, own in zip(self.sets, of.sets):
            at = near.at[: len(near.here)]
            out[at] = own.sizes @ x[at]
        return out

    def lightened_sizes_vjp(self, of, adj, a: np.ndarray, x: np.ndarray) -> None:
        adj.inverse += a * x
        for near, by in zip(self.sets, adj.sets):
            at = near.at[: len(near.here)]
            by.sizes += np.outer(a[at], x[at])

    def twist(self, part, of, at) -> list:
        """(node of the sum, nodes, how far they are from where the mobility of a rigid set is taken)"""
        sets = [(x.twist, x.at[: len(x.here)]) for x in self.sets if x.twist is not None]
        moved = at.X + part.theta * at.f - of.x - 0.5 * of.motion if sets else None
        return [(node, own, moved[own]) for node, own in sets]

    def relative(self, points: np.ndarray) -> np.ndarray:
        """Of corners 1 to 3 relative to corner 0."""
        at = points[self.corners]
        return at[:, 1:] - at[:, :1]

    def scattered(self, at_corners: np.ndarray) -> np.ndarray:
        """Sums at the points of vectors of corners, (pairs, 4, 3)."""
        out = np.zeros((self.num_points, 3))
        np.add.at(out, self.corners, at_corners)
        return out

    def weighed(self, w: np.ndarray):
        """B, (pairs, nodes), CSR."""
        from scipy.sparse import csr_matrix

        count = len(self.corners)
        out = csr_matrix((w.ravel(), self.corners.ravel(), 4 * np.arange(count + 1)), (count, self.num_points))
        return out if self.C is None else (out @ self.C).tocsr()

    @property
    def rows(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """C by rows: where each begins, columns, entries."""
        n, C = self.num_points, self.C
        return (np.arange(n + 1), np.arange(n), np.ones(n)) if C is None else (C.indptr, C.indices, C.data)


@dataclass
class Part:
    """Part `begin` .. `begin + share` of a pass; c: its damping; e, b: what contact has added to displacements and
    velocities before it; P: with what the pairs press [N]."""

    begin: float
    share: float
    c: float
    e: np.ndarray
    b: np.ndarray
    P: np.ndarray | None = None

    @property
    def theta(self) -> float:
        """The share of the free motion after which normals are taken."""
        return 0.5 * (1 - self.c)


class PartSolver:
    """Takes parts of a pass; `of`, its numbers, has x, motion (nodes, 3): displacements of nodes, and how they move without
    contact; rest (points, 3); inverse (nodes,): 1 / mass, 0 of sets, which have Factors in `sets`; stiffness,
    width, radius, mu, speed (pairs,); wall; h, alpha; seeds: adjoints of `impulses`, (which pairs, of push, of friction)."""

    def __init__(self, near: NearPairs):
        self.near = near

    # ---- forward -------------------------------------------------------------------------------------------------------

    def look(self, part: Part, of) -> SimpleNamespace:
        """Where pairs are, and how they would go."""
        near, at = self.near, SimpleNamespace()
        at.h, at.alpha = part.share * of.h, part.share * of.alpha
        at.f = part.share * of.motion + at.alpha * part.b
        at.X = of.x + part.begin * of.motion + part.e
        at.points = of.rest + near.points(at.X + part.theta * at.f)
        at.y = near.relative(at.points)
        at.w, at.r, at.g = geometry.nearest(at.y, near.edges)
        at.d = np.sqrt(dot(at.r, at.r))
        at.n = at.r / at.d[:, None]
        at.m = geometry.fading(at.y, near.edges, near.scale)
        at.B = near.weighed(at.w)
        at.moved = at.B @ at.f
        at.begin = at.d - of.radius - part.theta * dot(at.n, at.moved)
        at.free = at.d - of.radius + (1 - part.theta) * dot(at.n, at.moved)
        at.give = at.alpha * 0.5 * (1 + part.c) * at.h  # from P to displacements
        return at

    def pushes(self, part: Part, of, at, y):
        """(P, its derivatives by d, y, width, and of width times the wall)"""
        s, t, w = at.begin / of.width, y / of.width, of.width
        p, by_s, by_t = geometry.push(s, t, part.c)
        wall = of.wall / at.h**2
        q, by_q = -geometry.slope(t / WALL), -geometry.curvature(t / WALL) / WALL
        k = of.stiffness
        P = at.m * w * (k * p + wall * q)
        by_width = at.m * (k * (p - s * by_s - t * by_t) + wall * (q - t * by_q))
        return P, at.m * k * by_s, at.m * (k * by_t + wall * by_q), by_width, p, q

    def along_normals(self, at):
        """A, (pairs, 3 nodes), CSR: how distances change with what nodes may do."""
        from scipy.sparse import csr_matrix

        B, near = at.B, self.near
        row = np.repeat(np.arange(B.shape[0]), np.diff(B.indptr))
        along = at.n[row] if near.free is None else np.einsum("pi,pij->pj", at.n[row], near.free[B.indices])
        columns = 3 * B.indices[:, None] + np.arange(3)
        return csr_matrix(
            ((B.data[:, None] * along).ravel(), columns.ravel(), 3 * B.indptr), (B.shape[0], 3 * B.shape[1])
        )

    def displaced(self, of, at, pushed: np.ndarray) -> np.ndarray:
        """Q: displacements by forces on the nodes."""
        return at.give * self.near.lightened(of, pushed)

    def answer(self, of, at, A, K: np.ndarray):
        """The map (K^-1 + A Q A^T)^-1 of vectors of the pairs, where K > 0."""
        from scipy.linalg import cho_factor, cho_solve
        from scipy.sparse import csr_matrix, diags
        from scipy.sparse.linalg import splu

        some, near = np.flatnonzero(K > 0), self.near
        if not some.size:
            return np.zeros_like
        root = np.sqrt(K[some])
        A = diags(root) @ A[some]
        H = A @ diags(np.repeat(of.inverse, 3)) @ A.T
        for x, own in zip(near.sets, of.sets):
            N, inverse = own.of_components(len(x.at))
            N = A[:, (3 * x.at[:, None] + np.arange(3)).ravel()] @ csr_matrix(N)
            H = H + N @ csr_matrix(inverse) @ N.T
        H = H * at.give
        if some.size <= DENSE:
            H = H.toarray()
            H[np.diag_indices(some.size)] += 1
            factors = cho_factor(H, lower=True, overwrite_a=True, check_finite=False)
            act = lambda x: cho_solve(factors, x, check_finite=False)  # noqa: E731
        else:
            H = (H + diags(np.ones(some.size))).tocsc()
            act = splu(H, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=dict(SymmetricMode=True)).solve

        def product(x):
            out = np.zeros_like(x)
            out[some] = root * act(root * x[some])
            return out

        return product

    def take(self, part: Part, of, at) -> tuple[np.ndarray, np.ndarray]:
        """(e, b) after the part, for its P: at.P and others are noted. Of complex numbers P follows what it is of."""
        near = self.near
        if np.iscomplexobj(at.free) or np.iscomplexobj(of.stiffness):
            self._follow(part, of, at)
        else:
            at.zeta = self.displaced(of, at, near.freed(at.B.T @ (part.P[:, None] * at.n)))
            at.end = at.free + dot(at.n, at.B @ at.zeta)
            at.P = self.pushes(part, of, at, at.end)[0]
        at.pressed = at.B.T @ (at.P[:, None] * at.n)
        at.delta = at.h * near.lightened(of, near.freed(at.pressed))
        at.friction = self._friction(part, of, at) if of.rough else 0 * at.delta
        blend = 0.5 * (1 + part.c)
        at.w_drift = part.b + blend * at.delta + at.friction
        e, at.given = part.e + at.alpha * at.w_drift, at.h * at.pressed
        if of.rough:
            at.given = at.given + at.friction_sum
        for node, own, moved in near.twist(part, of, at):
            e[node] += np.cross(moved, at.given[own]).sum(0)
        return e, part.b + at.delta + at.friction

    def impulses(self, at, own: np.ndarray, of) -> tuple[np.ndarray, np.ndarray]:
        """What some pairs gave the nodes in a part that was taken [N s], by push and by friction."""
        B = at.B[np.flatnonzero(own)]
        pushed = at.h * (B.T @ (at.P[own, None] * at.n[own]))
        by_friction = B.T @ at.impulse[own] if of.rough else 0 * pushed
        return pushed, by_friction

    def _follow(self, part: Part, of, at) -> None:
        real = SimpleNamespace(**{k: x.real if isinstance(x, np.ndarray) else x for k, x in vars(at).items()})
        real.B, real.h, real.alpha, real.give = at.B.real, at.h, np.real(at.alpha), np.real(at.give)
        own = SimpleNamespace(**{k: np.real(x) for k, x in vars(of).items() if k != "sets"})
        own.sets = [x.real for x in of.sets]
        A = self.along_normals(real)
        base = self.displaced(own, real, (A.T @ part.P).reshape(-1, 3))

        def residual(zeta):
            at.end = at.free + dot(at.n, at.B @ zeta)
            at.P = self.pushes(part, of, at, at.end)[0]
            return zeta - self.displaced(of, at, self.near.freed(at.B.T @ (at.P[:, None] * at.n)))

        K = -self.pushes(part, own, real, real.free + A @ base.ravel())[2]
        # the change of zeta that keeps the residual, whose imaginary part is wanted
        r = residual(base).imag
        pushed = (A.T @ self.answer(own, real, A, K)(A @ r.ravel())).reshape(-1, 3)
        at.zeta = base - 1j * (r - self.displaced(own, real, pushed))
        residual(at.zeta)

    def _friction(self, part: Part, of, at) -> np.ndarray:
        """What friction adds to velocities."""
        near = self.near
        at.V = of.motion / of.alpha + part.b
        at.v = at.B @ at.V
        across = dot(at.n, at.v)
        at.t = at.v - across[:, None] * at.n
        at.s = np.sqrt(dot(at.t, at.t))
        at.load = of.mu * at.P
        at.sizes = at.B.copy()
        at.sizes.data = np.where(at.B.data.real < 0, -at.B.data, at.B.data)
        at.S = at.sizes.T @ at.load
        at.bound = at.h * (at.sizes @ near.lightened_sizes(of, at.S))
        at.kappa, at.share_of_mu, at.ratio, at.slip = slip(at.s, at.bound, of.speed, ARRAYS)
        at.impulse = (-at.h * at.load * at.kappa)[:, None] * at.t
        at.friction_sum = at.B.T @ at.impulse
        return near.lightened(of, near.freed(at.friction_sum))

    # ---- adjoint -------------------------------------------------------------------------------------------------------

    def back(self, part: Part, of, e_adj: np.ndarray, b_adj: np.ndarray, adj) -> tuple[np.ndarray, np.ndarray]:
        """(adjoints of e, b before the part) for those after it; adds those of what `of` holds to `adj`."""
        near, at = self.near, self.look(part, of)
        self.take(part, of, at)
        blend = 0.5 * (1 + part.c)
        by_alpha = total(e_adj * at.w_drift)
        e_prev, b_prev = e_adj.copy(), b_adj + at.alpha * e_adj
        delta_adj, friction_adj = b_adj + at.alpha * blend * e_adj, b_adj + at.alpha * e_adj
        by = SimpleNamespace(
            w=np.zeros_like(at.w), n=np.zeros_like(at.n), d=0 * at.d, P=0 * at.d, m=0 * at.d, motion=0 * at.X
        )
        at_corners = lambda nodes: near.points(nodes)[near.corners]  # noqa: E731
        seeds, by_moved = list(of.seeds), 0 * at.X
        for node, own, moved in near.twist(part, of, at):
            q = 0 * at.X
            q[own], by_moved[own] = np.cross(e_adj[node], moved), np.cross(at.given[own], e_adj[node])
            seeds.append((np.ones(len(at.d)), q, q))
        if of.rough:
            b_prev += self._friction_vjp(of, at, friction_adj, seeds, by, adj, at_corners)
        # delta
        freed = near.freed(delta_adj)
        pulled = at.h * near.lightened(of, freed)
        Bq = at.B @ pulled
        by.P += dot(at.n, Bq)
        by.n += at.P[:, None] * Bq
        by.w += at.P[:, None] * np.einsum("pd,pkd->pk", at.n, at_corners(pulled))
        near.lightened_vjp(of, adj, at.h * freed, at.pressed)
        for own, pushed, _ in seeds:
            q = at.h * pushed
            Bq = own[:, None] * (at.B @ q)
            by.P += dot(at.n, Bq)
            by.n += at.P[:, None] * Bq
            by.w += (own * at.P)[:, None] * np.einsum("pd,pkd->pk", at.n, at_corners(q))
        # P at the solution
        _, by_begin, by_y, by_width, p, q = self.pushes(part, of, at, at.end)
        A = self.along_normals(at)
        pushed = -(A.T @ self.answer(of, at, A, -by_y)(by.P)).reshape(-1, 3)
        nu = self.displaced(of, at, pushed)
        Bnu = at.B @ nu
        of_nu = dot(nu, at.pressed)
        near.lightened_vjp(of, adj, at.give * pushed, at.pressed)
        by_alpha += total(of_nu) / at.alpha
        by.n += at.P[:, None] * Bnu
        by.w += at.P[:, None] * np.einsum("pd,pkd->pk", at.n, at_corners(nu))
        by.P += dot(at.n, Bnu)
        y_adj, s_adj = by_y * by.P, by_begin * by.P
        wall = of.wall / at.h**2
        adj.stiffness += at.m * of.width * p * by.P
        adj.width += by_width * by.P
        adj.wall += (at.m * of.width * q * by.P).sum() / at.h**2
        by.m += of.width * (of.stiffness * p + wall * q) * by.P
        # y = d + n . B ((1 - theta) f + zeta), begin = d - theta n . B f
        by.d += y_adj + s_adj
        adj.radius -= y_adj + s_adj
        along = y_adj[:, None] * ((1 - part.theta) * at.moved + at.B @ at.zeta)
        by.n += along - (s_adj * part.theta)[:, None] * at.moved
        lever = (1 - part.theta) * at.f + at.zeta
        by.w += y_adj[:, None] * np.einsum("pd,pkd->pk", at.n, at_corners(lever))
        by.w -= (part.theta * s_adj)[:, None] * np.einsum("pd,pkd->pk", at.n, at_corners(at.f))
        f_adj = at.B.T @ (((1 - part.theta) * y_adj - part.theta * s_adj)[:, None] * at.n)
        # the pairs' geometry
        r_adj = (by.n - dot(at.n, by.n)[:, None] * at.n) / at.d[:, None] + by.d[:, None] * at.n
        y_of = geometry.nearest_vjp(at.y, near.edges, at.w, at.r, at.g, by.w, r_adj)
        y_of += geometry.fading_vjp(at.y, near.edges, near.scale, by.m)
        by_points = near.scattered(np.concatenate([-y_of.sum(1, keepdims=True), y_of], 1))
        X_adj = near.nodes(by_points) + by_moved
        adj.rest += by_points
        f_adj += part.theta * X_adj
        adj.x += X_adj - by_moved
        adj.motion += -0.5 * by_moved
        adj.motion += part.begin * X_adj + part.share * f_adj + by.motion
        by_alpha += total(f_adj * part.b)
        adj.alpha += part.share * by_alpha
        return e_prev + X_adj, b_prev + at.alpha * f_adj

    def _friction_vjp(self, of, at, friction_adj, seeds, by, adj, at_corners) -> np.ndarray:
        """Adjoint of b by friction."""
        near = self.near
        freed = near.freed(friction_adj)
        pulled = near.lightened(of, freed)
        near.lightened_vjp(of, adj, freed, at.friction_sum)
        r_adj = at.B @ pulled
        by.w += np.einsum("pd,pkd->pk", at.impulse, at_corners(pulled))
        for own, _, q in seeds:
            r_adj = r_adj + own[:, None] * (at.B @ q)
            by.w += own[:, None] * np.einsum("pd,pkd->pk", at.impulse, at_corners(q))
        e = at.t / np.maximum(at.s, TINY)[:, None]
        L = at.h * at.load
        G = -L * dot(e, r_adj)
        by_load, by_bound = -at.h * at.kappa * dot(at.t, r_adj), -G * at.slip * at.share_of_mu
        adj.speed -= G * at.slip * at.ratio
        t_adj = (-L * at.kappa)[:, None] * r_adj + (G * (at.slip - at.kappa))[:, None] * e
        across = dot(at.n, t_adj)
        v_adj = t_adj - across[:, None] * at.n
        by.n += -dot(at.n, at.v)[:, None] * t_adj - across[:, None] * at.v
        by.w += np.einsum("pd,pkd->pk", v_adj, at_corners(at.V))
        V_adj = at.B.T @ v_adj
        # the bound
        back = at.sizes.T @ by_bound
        S_adj = at.h * near.lightened_sizes(of, back)
        near.lightened_sizes_vjp(of, adj, at.h * back, at.S)
        by_load += at.sizes @ S_adj
        row = np.repeat(np.arange(at.B.shape[0]), np.diff(at.B.indptr))
        column = at.B.indices
        met = near.lightened_sizes(of, at.S)
        of_entries = at.h * by_bound[row] * met[column] + at.load[row] * S_adj[column]
        entries = at.B.copy()
        entries.data = np.sign(at.B.data) * of_entries
        by.w += self._at_corners_of(entries)
        by.P += of.mu * by_load
        adj.mu += at.P * by_load
        by.motion += V_adj / of.alpha
        adj.alpha -= total(V_adj * of.motion) / of.alpha**2
        return V_adj

    def _at_corners_of(self, entries) -> np.ndarray:
        """Adjoint of the corners' weights for that of B's entries."""
        near = self.near
        if near.C is not None:
            entries = (entries @ near.C.T).tocsr()
        row = np.arange(len(near.corners))
        return np.stack([np.asarray(entries[row, near.corners[:, k]]).ravel() for k in range(4)], 1)
