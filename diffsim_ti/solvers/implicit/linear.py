"""Linear systems of the implicit solvers: A x = b with A = c M + d2E/du2 on the free vertices, by products alone."""

import math

import numpy as np

from diffsim_ti.common.errors import NotConverged
from diffsim_ti.common.warn import warn
from diffsim_ti.inputs import ConsistentMass, diagonal_of
from diffsim_ti.mechanics.host_force import NONE, HostForces
from diffsim_ti.mechanics.supports.free import Free, FreeDirections, linear_of
from diffsim_ti.solvers.implicit.factorised import Factorised
from diffsim_ti.solvers.implicit.preconditioners import BlockJacobi, Preconditioner


class Operator:
    """w -> c m w + d2E/du2 w at the potential's displacement, less what forces without an energy change; rows of fixed
    vertices are zero. Sets that do not deform move as w says, and turn the forces on them (mechanics/reduced/rigid_sets.py).

    mass: c m, shape (num_vertices, 1) [N/m]; free: what vertices may do (free.py); others: host forces without an energy;
    transposed: of these and such sets.
    """

    def __init__(self, potential, mass: np.ndarray, free: Free, others: HostForces = NONE, transposed: bool = False):
        self.potential, self.mass, self.free = potential, mass, free
        self.products, self.correction = 0, None
        self.others, self.transposed, self._tangent = others, transposed, None
        self.rigid, self._linear = potential.rigid, linear_of(free)
        self._factors = None  # (correction, what `factorised` found with it)

    @property
    def symmetric(self) -> bool:
        return self.others.symmetric and (not self.rigid or self.rigid.symmetric)

    def on_device(self) -> tuple | None:
        """(diagonal mass, SciPy matrix or None, whether contact is convex): what joins the potential's Hessian there; None
        where a product needs the host."""
        potential, parts = self.potential, []
        plain = isinstance(self.free, np.ndarray) or type(self.free) is FreeDirections
        if not plain or self.others or potential.joints:
            return None
        if isinstance(self.mass, ConsistentMass):
            parts.append(self.mass.blocks())
        if self.correction is not None:
            parts.append(self.correction.matrix())
        if potential.hosts:
            matrices = [] if self.correction is not None else potential.hosts.matrices(potential.held_at)
            if len(matrices) < len(potential.hosts):
                return None
            parts += [matrix for matrix, _ in matrices]
        mass = np.zeros((len(potential.held_at), 1)) if isinstance(self.mass, ConsistentMass) else self.mass
        return mass, sum(parts[1:], parts[0]) if parts else None, self.correction is not None

    def factorised(self) -> Factorised | None:
        """What factorised.py makes of it, found once."""
        if self._factors is None or self._factors[0] is not self.correction:
            self._factors = self.correction, Factorised.of(self)
        return self._factors[1]

    @property
    def saddle_is_known(self) -> bool:
        """Whether a factorisation has found few directions of negative curvature, and turned these round."""
        found = self._factors and self._factors[1]
        return bool(found) and 0 < found.negative <= 10

    def __call__(self, w: np.ndarray) -> np.ndarray:
        self.products += 1
        if not self.rigid:
            return self.of_places(w) * self.free
        turned = self.rigid.stiffness(w, self.transposed, convex=self.correction is not None)
        if self.transposed:
            return self.rigid.motion_vjp(self.of_places(w) * self._linear) + turned
        return self.of_places(self.rigid.motion(w)) * self.free + turned

    def of_places(self, w: np.ndarray) -> np.ndarray:
        """For a change w of places, of all vertices."""
        y = self.mass * w + self.potential.product(w, convex=self.correction is not None)
        if self.correction is not None:
            y += self.correction(w)
        if self.others:
            if self._tangent is None:
                self._tangent = self.others.tangent(self.potential.held_at, self.transposed)
            y -= self._tangent(w * self._linear)
        return y


def _in_turn(operator, preconditioner, most: int):
    """(preconditioner, products that it may take) one after the other, until a solve succeeds: that of the pass, as many as
    the time of a factorisation allows, in all rounds of an equilibrium twice as many; the factorisation, in all rounds
    from then on; where there is none, the first again, or block Jacobi where that is not positive definite."""
    if not isinstance(preconditioner, Preconditioner):
        yield preconditioner, most
        return
    patience, spent = preconditioner.patience, preconditioner.spent
    # steps with inertia take few rounds, which are to stay as they are
    if not preconditioner.given_up and (spent <= 2 * patience or np.any(diagonal_of(operator.mass))):
        yield preconditioner, min(most, patience)
        preconditioner.given_up = True
    effort = preconditioner.effort
    other, name = operator.factorised() if effort.fits else None, type(preconditioner).__name__
    instead = "its sparse factorisation takes their place, which may take minutes"
    if other is None:
        other, instead = preconditioner, "there is no room for a factorisation, so they go on"
        if preconditioner.unfit:
            other = BlockJacobi(operator.potential, diagonal_of(operator.mass), operator.free, 0.0)
            other.update(operator.potential.held_at)
    if preconditioner.unfit:
        _say(preconditioner, f"{name} is not positive definite in this state: {type(other).__name__} takes its place")
    elif effort.unknowns > effort.large:
        words = f"conjugate gradients or GMRES take more than {preconditioner.patience} products of a Hessian of"
        _say(preconditioner, f"{words} {effort.unknowns} unknowns: {instead}")
    yield other, most


def _count(preconditioner, residual: float, products: int) -> None:
    if isinstance(preconditioner, Preconditioner):
        preconditioner.spent += products
        preconditioner.learn(residual, products)


def _say(preconditioner, message: str) -> None:
    """Once of each preconditioner."""
    if not preconditioner.has_warned:
        preconditioner.has_warned = True
        warn(message)


def conjugate_gradients(operator, b, preconditioner, tolerance: float, max_iterations: int, eps: float):
    """(x, relative residual, iterations, p): |b - A x| <= tolerance |b| unless stopped before.

    Stops at a direction p of negative curvature (else None) with the x before it or, if it is the first direction, with
    the preconditioned b: a direction of descent. Nocedal, Wright, Numerical Optimization, alg. 7.1. A preconditioner that is
    too slow or not positive definite is replaced (`_in_turn`).
    """
    for own, most in _in_turn(operator, preconditioner, max_iterations):
        found = _conjugate_gradients(operator, b, own, tolerance, most, eps)
        _count(own, *found[1:3])
        if found[1] <= tolerance or found[3] is not None:
            break
        if own is preconditioner and not np.isfinite(found[1]):
            preconditioner.unfit = True
    return found


def _conjugate_gradients(operator, b, preconditioner, tolerance: float, max_iterations: int, eps: float):
    """The same with one preconditioner; an infinite residual if that is not positive definite, r . z <= 0."""
    solver = getattr(preconditioner, "solver", None)
    on_device = operator.on_device() if solver is not None else None
    if on_device:
        found = solver(*on_device, b, tolerance, max_iterations, eps)
        operator.products += found[2]
        return found
    x, r = np.zeros_like(b), b.copy()
    size = np.linalg.norm(b)
    if size == 0:
        return x, 0.0, 0, None
    z = preconditioner(r)
    p, rz = z, float((r * z).sum())
    for k in range(1, max_iterations + 1):
        if not rz > 0:
            return x, np.inf, k, None
        Ap = operator(p)
        curvature = float((p * Ap).sum())
        if not curvature > 10 * eps * np.linalg.norm(p) * np.linalg.norm(Ap):
            if not np.isfinite(curvature):
                raise FloatingPointError("the stiffness of this state is not finite")
            return (x if k > 1 else z), np.linalg.norm(r) / size, k, p
        alpha = rz / curvature
        x += alpha * p
        r -= alpha * Ap
        if np.linalg.norm(r) <= tolerance * size:
            return x, np.linalg.norm(r) / size, k, None
        z = preconditioner(r)
        rz, old = float((r * z).sum()), rz
        p = z + (rz / old) * p
    return x, np.linalg.norm(r) / size, max_iterations, None


def gmres(operator, b, preconditioner, tolerance: float, max_iterations: int, restart: int = 80):
    """(x, relative residual, iterations) of A x = b for any A: GMRES, preconditioned from the right, started again every so
    many products, and where rounding has left more than it knows of, until that helps no more. A preconditioner that is too
    slow is replaced (`_in_turn`).
    Saad, Schultz 1986, doi:10.1137/0907058.
    """
    for own, most in _in_turn(operator, preconditioner, max_iterations):
        found = _gmres(operator, b, own, tolerance, most, restart)
        _count(own, *found[1:3])
        if found[1] <= tolerance:
            break
    return found


def _gmres(operator, b, preconditioner, tolerance: float, max_iterations: int, restart: int):
    """The same with one preconditioner."""
    x, r, size, count = np.zeros_like(b), b, np.linalg.norm(b), 0
    residual = 1.0 if size > 0 else 0.0
    while residual > tolerance and count < max_iterations:
        V, Z = (np.empty((16, b.size)) for _ in range(2))  # rows: the basis, and it preconditioned
        H, turns, left = np.zeros((restart + 1, restart)), [], np.linalg.norm(r)
        rhs = np.eye(1, restart + 1)[0] * left
        V[0] = r.ravel() / left
        for k in range(restart):
            if k + 1 == len(V):  # room for twice as many
                V, Z = (np.concatenate([basis, np.empty_like(basis[: restart - k])]) for basis in (V, Z))
            z = preconditioner(V[k].reshape(b.shape))
            w, count = operator(z).ravel(), count + 1
            Z[k], whole = z.ravel(), np.linalg.norm(w)
            for _ in range(2):  # twice is enough
                h = V[: k + 1] @ w
                H[: k + 1, k] += h
                w = w - h @ V[: k + 1]
            H[k + 1, k] = np.linalg.norm(w)
            left *= _turn_last(H[: k + 2, k].tolist(), turns)
            if not np.isfinite(left):
                raise FloatingPointError("the stiffness of this state is not finite")
            spanned = H[k + 1, k] <= 1e-12 * whole  # all that these directions lead to
            if left <= tolerance * size or spanned or count >= max_iterations:
                break
            V[k + 1] = w / H[k + 1, k]
        y, *_ = np.linalg.lstsq(H[: k + 2, : k + 1], rhs[: k + 2], rcond=None)
        x = x + (y @ Z[: k + 1]).reshape(b.shape)
        r = b - operator(x)
        before, residual = residual, np.linalg.norm(r) / size
        if residual > 0.9 * before:  # it stands
            break
    return x, residual, count


def _turn_last(column: list, turns: list) -> float:
    """Turn the last column of a Hessenberg matrix by the Givens rotations (c, s) of those before it, and note its own, which
    leaves it without a last number: |s|, by which that makes the least residual smaller."""
    for i, (c, s) in enumerate(turns):
        column[i], column[i + 1] = c * column[i] + s * column[i + 1], c * column[i + 1] - s * column[i]
    a, b = column[-2:]
    size = math.hypot(a, b)
    turns.append((a / size, b / size) if size else (0.0, 1.0))
    return abs(turns[-1][1])


def solve(operator, b, preconditioner, tolerance: float, eps: float, max_iterations: int) -> np.ndarray:
    """x with |b - A x| <= tolerance |b|, whether A is symmetric or not. Raises NotConverged."""
    if operator.symmetric:
        return solve_symmetric(operator, b, preconditioner, tolerance, eps, max_iterations)
    x, residual, count = gmres(operator, b, preconditioner, tolerance, max_iterations)
    if residual > max(tolerance, 1000 * eps):  # products of A have rounding of their own
        raise not_solved(residual, tolerance, count)
    return x


def not_solved(residual: float, tolerance: float, count: int) -> NotConverged:
    """What a linear solve that stopped early says."""
    return NotConverged(
        f"a linear solve stopped at a relative residual of {residual:.2g} (asked for {tolerance:g}) after {count} "
        "iterations: the state may be at a limit point; loosen the tolerance or take smaller steps",
        [residual],
    )


def solve_symmetric(operator, b, preconditioner, tolerance: float, eps: float, max_iterations: int) -> np.ndarray:
    """x with |b - A x| <= tolerance |b| for a symmetric, possibly indefinite A: CG, and MINRES where CG cannot go on.

    Raises NotConverged.
    """
    x, residual, count, negative = conjugate_gradients(operator, b, preconditioner, tolerance, max_iterations, eps)
    if negative is not None:
        from scipy.sparse.linalg import LinearOperator, minres

        n = b.size
        A = LinearOperator((n, n), lambda w: operator(w.reshape(-1, 3)).ravel(), dtype=np.float64)
        for own, most in _in_turn(operator, preconditioner, max_iterations):
            M = LinearOperator((n, n), lambda w: own(w.reshape(-1, 3)).ravel(), dtype=np.float64)
            x = np.zeros_like(b)
            for _ in range(5):  # MINRES measures in the preconditioner's norm: go on until the plain one is small
                r = b - operator(x)
                residual = np.linalg.norm(r) / np.linalg.norm(b)
                if residual <= tolerance:
                    break
                step, _ = minres(A, r.ravel(), M=M, rtol=0.1 * tolerance, maxiter=most)
                x += step.reshape(b.shape)
            if residual <= tolerance:
                break
    if residual > tolerance:
        raise not_solved(residual, tolerance, count)
    return x
