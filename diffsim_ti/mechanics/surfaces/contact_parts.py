"""Contact of near pairs in a part of an explicit pass, in float64: what the contact stage of pairs repeats. Forward it is
done by part_kernels.py; here are the same formulas for NumPy's arrays, which record for tangents and adjoints.

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
from functools import cached_property
from types import SimpleNamespace

import numpy as np

from diffsim_ti.differentiation.arrays import (
    Recorded,
    cross,
    forward_of_all,
    linear,
    made,
    reverse_of_all,
    summed_at,
    times,
    value_of,
    with_slopes,
)
from diffsim_ti.mechanics.surfaces import host_geometry as geometry
from diffsim_ti.mechanics.surfaces.host_geometry import TINY, by_rows, dot
from diffsim_ti.mechanics.surfaces.part_kernels import WALL
from diffsim_ti.terms.obstacles.friction import ARRAYS, slip

DENSE, SMALL = 1000, 2**18  # unknowns of what is factored as a dense matrix; products that its making may then take
# what of their numbers has derivatives
READ = "x", "motion", "rest", "inverse", "alpha", "wall", "stiffness", "width", "radius", "mu", "speed"


def total(x: np.ndarray) -> float:
    """The sum, with the same bits whatever zeros stand among the numbers: those of nodes that no pair reads."""
    return x[x != 0].sum()


def scaled(a, x):
    """a x of a number a, whose adjoint is such a sum."""
    A, X = value_of(a), value_of(x)
    by_a = (a, lambda da: da * X, lambda seed: total(seed * X))
    return made(A * X, by_a, (x, lambda dx: A * dx, lambda seed: A * seed))


def arrays_of(of) -> list:
    """What parts read that has derivatives."""
    return [getattr(of, name) for name in READ] + [x for own in of.sets for x in vars(own).values()]


def with_arrays(of, arrays: list) -> SimpleNamespace:
    """The same with other arrays, or changes or adjoints of them."""
    more = iter(arrays[len(READ) :])
    sets = [type(own)(*(next(more) for _ in vars(own))) for own in of.sets]
    return SimpleNamespace(**vars(of) | dict(zip(READ, arrays)) | dict(sets=sets))


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

    def points(self, nodes):
        return nodes if self.C is None else times(self.C, nodes)

    def freed(self, x):
        free = lambda x: np.einsum("nij,nj->ni", self.free, x)  # noqa: E731
        return x if self.free is None else linear(x, free, free)

    def lightened(self, of, x):
        """Products of inverse masses with vectors of the nodes."""
        out = by_rows(of.inverse, x)
        for near, own in zip(self.sets, of.sets):
            out = out + summed_at(near.at, own.lightened(x[near.at]), len(out))
        return out

    def lightened_sizes(self, of, x):
        """The same of numbers, by bounds of inverse masses."""
        out = of.inverse * x
        for near, own in zip(self.sets, of.sets):
            at = near.at[: len(near.here)]
            out = out + summed_at(at, own.sizes @ x[at], len(out))
        return out

    def twist(self, part, of, at) -> list:
        """(node of the sum, nodes, how far they are from where the mobility of a rigid set is taken)"""
        sets = [(x.twist, x.at[: len(x.here)]) for x in self.sets if x.twist is not None]
        moved = at.X + part.theta * at.f - of.x - 0.5 * of.motion if sets else None
        return [(node, own, moved[own]) for node, own in sets]

    def gathered(self, nodes: np.ndarray) -> np.ndarray:
        """Vectors of the corners, (pairs, 4, 3), from those of nodes."""
        return self.points(nodes)[self.corners]

    def scattered(self, at_corners: np.ndarray) -> np.ndarray:
        """Sums at the points of vectors of corners."""
        return summed_at(self.corners, at_corners, self.num_points)

    def relative(self, points):
        """Of corners 1 to 3 relative to corner 0."""

        def back(seed):
            return self.scattered(np.concatenate([-seed.sum(1, keepdims=True), seed], 1))

        return linear(points, lambda x: x[self.corners[:, 1:]] - x[self.corners[:, :1]], back)

    def at_pairs(self, w, nodes):
        """B x, vectors of the pairs."""
        W, X = value_of(w), self.gathered(value_of(nodes))
        weigh = lambda w, x: np.einsum("pk,pkd->pd", w, x)  # noqa: E731
        by_w = (w, lambda dw: weigh(dw, X), lambda seed: np.einsum("pd,pkd->pk", seed, X))
        by_nodes = (nodes, lambda dx: weigh(W, self.gathered(dx)), lambda seed: self.at_nodes(W, seed))
        return made(weigh(W, X), by_w, by_nodes)

    def at_nodes(self, w, x):
        """B^T x, sums at the nodes of vectors of the pairs."""
        W, X = value_of(w), value_of(x)

        def add(w, x):
            points = self.scattered(w[:, :, None] * x[:, None])
            return points if self.C is None else self.C.T @ points

        by_w = (w, lambda dw: add(dw, X), lambda seed: np.einsum("pd,pkd->pk", X, self.gathered(seed)))
        return made(add(W, X), by_w, (x, lambda dx: add(W, dx), lambda seed: self.at_pairs(W, seed)))

    @cached_property
    def pattern(self) -> tuple:
        """(rows of B's entries, their columns, the matrix that makes them of the weights)"""
        from scipy.sparse import csr_matrix

        (start, index, weight), points = self.rows, self.corners.ravel()
        counts = np.diff(start)[points]
        corner = np.repeat(np.arange(len(points)), counts)
        each = np.arange(len(corner)) + np.repeat(start[points] - np.cumsum(counts) + counts, counts)
        entries, place = np.unique(corner // 4 * self.num_nodes + index[each], return_inverse=True)
        matrix = csr_matrix((weight[each], (place, corner)), (len(entries), len(points)))
        return *np.divmod(entries, self.num_nodes), matrix

    def entries(self, w):
        """Those of B."""
        return times(self.pattern[2], w.reshape(-1))

    @property
    def num_nodes(self) -> int:
        return self.num_points if self.C is None else self.C.shape[1]

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


@dataclass
class PartSolver(NearPairs):
    """Takes parts of a pass; `of`, its numbers, has x, motion (nodes, 3): displacements of nodes, and how they move without
    contact; rest (points, 3); inverse (nodes,): 1 / mass, 0 of sets, which have Factors in `sets`; stiffness,
    width, radius, mu, speed (pairs,); wall; h, alpha; contacts: which pairs are of each whose impulses are asked for."""

    def look(self, part: Part, of) -> SimpleNamespace:
        """Where pairs are, and how they would go."""
        at = SimpleNamespace()
        at.h, at.alpha = part.share * of.h, part.share * of.alpha
        at.f = part.share * of.motion + scaled(at.alpha, part.b)
        at.X = of.x + part.begin * of.motion + part.e
        y = self.relative(of.rest + self.points(at.X + part.theta * at.f))
        at.w, r = geometry.nearest(y, self.edges)
        d = np.sqrt(dot(r, r))
        at.n = by_rows(1 / d, r)
        at.m = geometry.fading(y, self.edges, self.scale)
        d, moved = d - of.radius, dot(at.n, self.at_pairs(at.w, at.f))
        at.begin, at.free = d - part.theta * moved, d + (1 - part.theta) * moved
        at.give = at.alpha * (0.5 * (1 + part.c) * at.h)  # from P to displacements
        return at

    def pushes(self, part: Part, of, at, y):
        """(P, -dP / dy)"""
        k, wall, s, t = of.stiffness, of.wall / at.h**2, at.begin / of.width, y / of.width
        p, by_s, by_t = geometry.push(value_of(s), value_of(t), part.c)
        end = value_of(t) / WALL
        q, by_q = -geometry.slope(end), -geometry.curvature(end) / WALL
        by_y = value_of(at.m) * (value_of(k) * by_t + value_of(wall) * by_q)
        p, q = with_slopes(p, (s, lambda: by_s), (t, lambda: by_t)), with_slopes(q, (t, lambda: by_q))
        return at.m * of.width * (k * p + wall * q), -by_y

    def displaced(self, of, at, x):
        """Displacements by pushes along the normals."""
        return scaled(at.give, self.lightened(of, self.freed(self.at_nodes(at.w, by_rows(x, at.n)))))

    def answer(self, of, at, K: np.ndarray):
        """The map (K^-1 + A Q A^T)^-1 of vectors of the pairs, where K > 0; A: how distances change with what nodes may do,
        Q: displacements by forces on the nodes."""
        from scipy.linalg import cho_factor, cho_solve
        from scipy.sparse import csr_matrix, identity
        from scipy.sparse.linalg import splu

        some = np.flatnonzero(K > 0)
        if not some.size:
            return np.zeros_like
        root, (row, node, _) = np.sqrt(K[some]), self.pattern
        chosen = K[row] > 0
        row, node, data = row[chosen], node[chosen], self.entries(at.w)[chosen]
        along = at.n[row] if self.free is None else np.einsum("pi,pij->pj", at.n[row], self.free[node])
        data = (np.sqrt(K[row]) * data)[:, None] * along
        # bits do not depend on what other nodes there are
        read = np.unique(np.concatenate([node, *(x.at for x in self.sets)]))
        columns = lambda nodes: (3 * np.searchsorted(read, nodes)[:, None] + np.arange(3)).ravel()  # noqa: E731
        shape = columns(node), 3 * np.searchsorted(row, [*some, len(K)])
        A = csr_matrix((data.ravel(), *shape), (some.size, 3 * len(read)))
        lighter, kind = csr_matrix(((of.inverse[node][:, None] * data).ravel(), *shape), A.shape), csr_matrix
        if some.size**2 * A.shape[1] <= SMALL:
            A, lighter, kind = A.toarray(), lighter.toarray(), np.asarray
        H = lighter @ A.T
        for x, own in zip(self.sets, of.sets):
            N, inverse = own.of_components(len(x.at))
            N = A[:, columns(x.at)] @ kind(N)
            H = H + N @ kind(inverse) @ N.T
        H = H * at.give
        if some.size <= DENSE:
            H = H if kind is np.asarray else H.toarray()
            H[np.diag_indices(some.size)] += 1
            factors = cho_factor(H, lower=True, overwrite_a=True, check_finite=False)
            act = lambda x: cho_solve(factors, x, check_finite=False)  # noqa: E731
        else:
            H = (H + identity(some.size)).tocsc()
            act = splu(H, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=dict(SymmetricMode=True)).solve

        def product(x):
            out = np.zeros_like(x)
            out[some] = root * act(root * x[some])
            return out

        return product

    def followed(self, pushed, K: np.ndarray, of, at):
        """P, on which the ends of the pairs depend, from what it would be at ends that did not."""
        if not isinstance(pushed, Recorded):
            return pushed
        of = with_arrays(of, [value_of(x) for x in arrays_of(of)])
        at = SimpleNamespace(**{name: value_of(x) for name, x in vars(at).items()})
        answer = self.answer(of, at, K)
        led = lambda x: dot(at.n, self.at_pairs(at.w, self.displaced(of, at, x)))  # noqa: E731
        return made(pushed.value, (pushed, lambda dx: dx - answer(led(dx)), lambda seed: seed - led(answer(seed))))

    def take(self, part: Part, of, at) -> tuple:
        """(e, b) after the part, for its P: at.P and others are noted."""
        end = at.free + dot(at.n, self.at_pairs(at.w, self.displaced(of, at, part.P)))
        at.P = self.followed(*self.pushes(part, of, at, end), of, at)
        at.push = at.h * by_rows(at.P, at.n)
        at.given = self.at_nodes(at.w, at.push)
        delta = self.lightened(of, self.freed(at.given))
        b, drift = part.b + delta, part.b + 0.5 * (1 + part.c) * delta
        if of.rough:
            at.impulse = self._friction(part, of, at)
            rubbed = self.at_nodes(at.w, at.impulse)
            at.friction = self.lightened(of, self.freed(rubbed))
            b, drift, at.given = b + at.friction, drift + at.friction, at.given + rubbed
        e = part.e + scaled(at.alpha, drift)
        for node, own, moved in self.twist(part, of, at):
            e = e + summed_at(np.array([node]), cross(moved, at.given[own]).sum(0)[None], len(e))
        return e, b

    def impulses(self, at, own: np.ndarray, of) -> tuple:
        """What some pairs gave the nodes in a part that was taken [N s], by push and by friction."""
        own = own.astype(float)
        pushed = self.at_nodes(at.w, by_rows(own, at.push))
        return pushed, self.at_nodes(at.w, by_rows(own, at.impulse)) if of.rough else 0 * pushed

    def _friction(self, part: Part, of, at):
        """Impulses of the pairs by friction [N s]."""
        at.V, load = scaled(1 / of.alpha, of.motion) + part.b, of.mu * at.P
        v = self.at_pairs(at.w, at.V)
        (row, column, _), sizes = self.pattern, np.abs(self.entries(at.w))
        met = self.lightened_sizes(of, summed_at(column, sizes * load[row], len(of.inverse)))
        bound = at.h * summed_at(row, sizes * met[column], len(self.corners))
        return by_rows(-at.h * load, slowed(v - by_rows(dot(at.n, v), at.n), bound, of.speed))

    # ---- tangent and adjoint -------------------------------------------------------------------------------------------

    def recorded(self, part: Part, of) -> tuple[list, list]:
        """(e and b before the part, and `arrays_of`; those after it, and impulses of each of the `contacts` of `of`)"""
        read = [Recorded(np.asarray(x, float)) for x in (part.e, part.b, *arrays_of(of))]
        part, of = replace(part, e=read[0], b=read[1]), with_arrays(of, read[2:])
        at = self.look(part, of)
        after = self.take(part, of, at)
        return read, [*after, *(x for own in of.contacts for x in self.impulses(at, own, of))]

    def change(self, part: Part, of, changes: list) -> list:
        """Changes of what is after it for those of what is before it."""
        read, after = self.recorded(part, of)
        return forward_of_all(after, zip(read, changes))

    def back(self, part: Part, of, adjoints: list, adj: list) -> list:
        """Adjoints of e and b before the part for those of what is after it; adds those of `arrays_of` to `adj`."""
        read, after = self.recorded(part, of)
        by_e, by_b, *found = reverse_of_all(zip(after, adjoints), read)
        for sum_of, more in zip(adj, found):
            if more is not None:
                sum_of += more
        return [by_e, by_b]


def slowed(t, c, eps):
    """f(s / eps) t / |t|"""
    T = value_of(t)
    speed = np.sqrt(dot(T, T))
    kappa, share, ratio, slope = slip(speed, value_of(c), value_of(eps), ARRAYS)
    e = by_rows(1 / np.maximum(speed, TINY), T)
    by_t = lambda x: by_rows(kappa, x) + by_rows((slope - kappa) * dot(e, x), e)  # noqa: E731
    by_c = (c, lambda dc: by_rows(-slope * share * dc, e), lambda seed: -slope * share * dot(e, seed))
    by_eps = (eps, lambda d: by_rows(-slope * ratio * d, e), lambda seed: -slope * ratio * dot(e, seed))
    return made(by_rows(kappa, T), (t, by_t, by_t), by_c, by_eps)
