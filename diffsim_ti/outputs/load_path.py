"""Equilibria beyond what a load can reach by growing: paths through limit points, and where they buckle, with gradients."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from diffsim_ti.common.brief import brief_fields
from diffsim_ti.common.checked import number, shown
from diffsim_ti.common.errors import NotConverged
from diffsim_ti.common.public import Public, public
from diffsim_ti.differentiation.arrays import Recorded, forward, reverse
from diffsim_ti.inputs import DerivedNode
from diffsim_ti.inputs.description import InputValue
from diffsim_ti.mechanics.chambers.pressures import ChamberPressure
from diffsim_ti.mechanics.energy.assembled import assemble
from diffsim_ti.mechanics.energy.potential import Potential
from diffsim_ti.outputs.forces_at_frames import AppliedLoads, BodyForces, at_end
from diffsim_ti.outputs.modes import FOURTH_ORDER, Tangent, free_directions
from diffsim_ti.scene import Scene
from diffsim_ti.solvers import StaticSolver
from diffsim_ti.terms import Robot, SelfContact


class Equilibria:
    """R(u, s) = T^T f(u, s) = 0, f: all forces on vertices [N] where the inputs named in `load` are s times their values.

    u = T q + h(s): T is a basis of what supports and ties leave free, h what is held or moved.
    """

    def __init__(self, scene: Scene, load: Sequence[str]):
        self.scene, self.load = scene, load
        self.body, self.loads = BodyForces(scene), AppliedLoads(scene)
        self.own = scene.inputs.at_times([0.0, 1.0])
        self._load(1.0)
        self.potential = Potential(self.body.arrays, scene.mesh.tetrahedra, False)
        self.T = free_directions(scene)
        for tie in scene.reduced.bodies:
            T = (tie.matrix @ self.T).tocsc()
            self.T = T[:, np.diff(T.indptr) > 0]
        projectors = np.broadcast_to(np.eye(3), (scene.mesh.num_vertices, 3, 3)).copy()
        projectors[scene.held] -= scene.supports.held
        self.loads.hosts.restrict(projectors, self.derived.rest)
        self.symmetric = self.loads.hosts.symmetric

    def _load(self, s: float) -> None:
        self.now = self.own | {name: s * self.own[name] for name in self.load}
        self.derived = self.body.load(self.now)
        at, self.h = self.scene.held, np.zeros_like(self.derived.displacement)
        self.h[at] = self._held(self.derived)

    def _held(self, of) -> np.ndarray:
        """Displacements of what is held, or their change."""
        place = of.displacement[self.scene.held]
        return np.einsum("kij,kj->ki", self.scene.supports.held, place if of.motion is None else place + of.motion[1])

    def place(self, u: np.ndarray, s: float) -> None:
        """Go to a displacement [m], whose held part becomes that of the load factor s."""
        self._load(s)
        at, self.u = self.scene.held, np.array(u)
        self.u[at] += self.h[at] - np.einsum("kij,kj->ki", self.scene.supports.held, u[at])
        self.x = self.derived.rest + self.u
        self.body.place(self.u, np.zeros_like(self.u))
        self.potential.place(self.u)

    def field(self, q: np.ndarray) -> np.ndarray:
        """T q, shape (num_vertices, 3)."""
        return (self.T @ q).reshape(-1, 3)

    def residual(self) -> tuple[np.ndarray, float]:
        """(R, size of the forces that meet at vertices)"""
        applied, sizes = self.loads.forces(self.derived, self.x, 1), self.potential.forces()[1]
        size = np.sqrt((sizes**2).sum() + (applied**2).sum())
        return self.T.T @ (self.body.forces() + applied).ravel(), size

    @property
    def upright(self) -> bool:
        return bool(np.all(self.potential.energy()[1] > 0))

    def by_factor(self) -> tuple[np.ndarray, np.ndarray]:
        """(dR/ds, dh/ds)"""
        moved = self.scene.inputs.derive_jvp(self.now, {name: self.own[name] for name in self.load})
        du = np.zeros_like(self.u)
        du[self.scene.held] = self._held(moved)
        of, u, f = self._forces()
        return self.T.T @ forward(f, [(of, moved), (u, du)]).ravel(), du

    def _forces(self) -> tuple[DerivedNode, Recorded, Recorded]:
        """(what kernels read, u, f of them), which record."""
        of, u, none = DerivedNode(self.derived), Recorded(self.u), np.zeros((1, *self.u.shape))
        return of, u, self.body.at_frames(of, u[None], none, none)[0] + self.loads.forces(of, of.rest + u, 1)

    def factorised(self) -> "Tangent":
        """Of -dR/dq."""
        from scipy.sparse import csr_matrix

        self.potential.blocks()
        n, more = len(self.u), []
        for force in self.loads.hosts.take(self.derived, at_end(1)):
            matrix = force.matrix(self.u)
            if matrix is None:
                raise ValueError(f"load_path: the matrix of {type(force).__name__} is not known: write its `matrix`")
            more.append(matrix)
            if isinstance(force, ChamberPressure):  # whose pressures change with their volumes
                for a, b in force.tangent(self.u).pairs:
                    more.append(-csr_matrix(a.reshape(-1, 1)) @ csr_matrix(b.reshape(1, -1)))
        A = self.T.T @ assemble(self.potential, np.zeros((n, 1)), np.ones((n, 1)), more)[0] @ self.T
        return Tangent((0.5 * (A + A.T) if self.symmetric else A).tocsc())

    def vjp(self, w: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Gradients of w . f, w of shape (num_vertices, 3), by all inputs, and by u."""
        of, u, f = self._forces()
        adj, by_state = reverse(f, w, [of, u])
        adj.displacement = np.zeros_like(w)
        held = adj.displacement[self.scene.held] = np.einsum(
            "kij,kj->ki", self.scene.supports.held, by_state[self.scene.held]
        )
        if self.derived.motion is not None:
            adj.motion = np.zeros_like(self.derived.motion)
            adj.motion[1] = held
        return self.scene.inputs.derive_vjp(self.now, adj, tuple(self.now)), by_state

    def along(self, gradients: dict[str, np.ndarray]) -> float:
        """The derivative by s."""
        return sum(float((self.own[name] * gradients[name]).sum()) for name in self.load)


@dataclass(frozen=True)
class _Point:
    u: np.ndarray
    s: float
    A: Tangent
    rounds: int


@dataclass(eq=False, repr=False)
class CriticalPoint(metaclass=Public):
    """Where the stiffness of a path of equilibria is singular. kind: "limit", where the factor turns round, a maximum or a
    minimum; or "branch", where another path crosses: a buckling load.

    factor: of the load; displacements [m], shape (num_vertices, 3); mode: the motion that meets no resistance, of the same
    shape and length one; negative: how many eigenvalues of the stiffness are negative beyond it.
    """

    kind: str
    factor: float
    displacements: np.ndarray
    mode: np.ndarray
    negative: int
    _null: tuple[np.ndarray, np.ndarray] = field(init=False, repr=False)
    _equilibria: Equilibria = field(init=False, repr=False)

    __repr__ = brief_fields

    def gradients(self) -> dict[str, np.ndarray]:
        """Derivatives of the factor by every input of the scene.

        At a limit point with the mode w of the transposed stiffness, and forces f,

            ds/dtheta = -(w . df/dtheta) / (w . df/ds)

        At a branch point of a symmetric stiffness K the eigenvalue g = mode . K mode stays zero along the path that is
        followed, ds/dtheta = -(dg/dtheta) / (dg/ds), total derivatives; of several that are zero together, as of equal
        columns, that of `mode`. Of what breaks its symmetry there is none: the factor falls with the power 2/3, or 1/2, of
        an imperfection.
        Wu 1995, Sensitivity of critical loads; Koiter 1945, On the stability of elastic equilibrium.
        """
        e, w = self._equilibria, self._equilibria.field(self._null[1])
        e.place(self.displacements, self.factor)
        found = e.vjp(w)[0] if self.kind == "limit" else self._of_branch(e, w)
        along = e.along(found)
        inner = {name: self.factor if name in e.load else 1.0 for name in found}
        return {name: -inner[name] / along * by for name, by in found.items()}

    def _of_branch(self, e: Equilibria, w: np.ndarray) -> dict[str, np.ndarray]:
        """dg/dtheta, but for a factor: of w . df/du mode as it stands, and by the path's u."""
        step, found, by_u = 2e-3 * float(np.ptp(e.derived.rest)) / np.abs(self.mode).max(), {}, 0.0
        step = min(
            step, 2e-3 / max(np.abs(e.scene.inputs.stress_points.displacement_gradients(self.mode)).max(), 1e-300)
        )
        for shift, weight in FOURTH_ORDER:
            e.place(self.displacements + shift * step * self.mode, self.factor)
            own, by = e.vjp(w)
            found = {name: found.get(name, 0.0) + weight / step * x for name, x in own.items()}
            by_u = by_u + weight / step * by
        e.place(self.displacements, self.factor)
        v, left = self._null
        by_q = e.T.T @ by_u.ravel()
        p = e.factorised().solve(by_q - v * (v @ by_q), True)
        own, _ = e.vjp(e.field(p - left * (left @ p)))
        return {name: x + own[name] for name, x in found.items()}


@dataclass(eq=False, repr=False)
class LoadPath(metaclass=Public):
    """Equilibria along a path. factors: of the load, shape (k,); displacements [m], (k, num_vertices, 3); negative: how
    many eigenvalues of the stiffness are negative at each, 0 where it is stable under the load, shape (k,); critical: the
    `CriticalPoint`s that were passed, in their order."""

    factors: np.ndarray
    displacements: np.ndarray
    negative: np.ndarray
    critical: list[CriticalPoint]

    __repr__ = brief_fields


@public
def load_path(
    scene: Scene,
    load: str | Sequence[str],
    steps: int = 40,
    step: float = 0.1,
    until: Callable[[float, np.ndarray], bool] | None = None,
    branch: CriticalPoint | None = None,
    tolerance: float = 1e-9,
    **values: InputValue,
) -> LoadPath:
    """Follow static equilibria while a load grows and, beyond limit points, falls again: through snap-through, and the
    greatest pressure of a balloon. Pseudo-arc-length continuation: each point is the solution of

        R(u, s) = 0,    t . (u - u_k) = length,    t: the path's direction at u_k

    by Newton's method with sparse factorisations; lengths follow how fast that converges. Where the number of negative
    eigenvalues of the stiffness changes between two points the point where it is singular is found to rounding.

    load: name of the input that the factor s multiplies, such as "pressure", "traction", "gravity" or "prescribed_motion",
        or several; all else stays as in the scene. s = 1 is the scene's own load; what is given over time counts as it is
        at 1 s. "gas_pressure" is the amount of gas in a chamber, whose outside= is then 0 or among the loads.
    steps: points that follow the first; step: the first change of the factor; until: a function of (factor,
        displacements) that says True where the path ends sooner.
    branch: a branch point, from which the path that crosses there is followed in the direction of its mode (a column beyond
        its buckling load); else s = 0. tolerance: of |R| over the size of the forces that meet at the vertices.
    values: of the scene's inputs, instead of its own, such as youngs_modulus=2e5 or rest_positions=X.

    Raises ValueError for obstacles, self-contact, filled chambers, reduced sets, laws with a state or rates, and names that
    are no input; NotConverged where no step of the path, however short, converges.
    Riks 1979, doi:10.1016/0020-7683(79)90081-7; Crisfield 1981, doi:10.1016/0045-7949(81)90108-5.
    """
    scene = _checked(scene).with_values(values)
    load = [load] if isinstance(load, str) else list(load)
    known = scene.inputs.at_times([0.0, 1.0])
    for name in load:
        if name not in known:
            raise ValueError(scene.inputs.no_input(name, "the scene", known))
    if not any(np.any(known[name]) for name in load):
        raise ValueError(f"load_path: {shown(load)} is zero in the scene: give it the value that the factor multiplies")
    if isinstance(steps, bool) or not isinstance(steps, int | np.integer) or steps < 1:
        raise ValueError(f"load_path: steps must be a whole number above zero, got {shown(steps)}")
    for name, value in (("step", step), ("tolerance", tolerance)):
        if not number(name, value) > 0:
            raise ValueError(f"load_path: {name} must be above zero, got {shown(value)}")
    if branch and (values or load != list(branch._equilibria.load) or scene.mesh is not branch._equilibria.scene.mesh):
        raise ValueError(
            "load_path: a branch is followed with the scene, load and values of the path that it was found on"
        )
    follower = _Follower(branch._equilibria if branch else Equilibria(scene, load), tolerance)
    return follower.path(steps, step, until, branch)


def _checked(scene: Scene) -> Scene:
    """The scene in float64 with consistent masses. Raises ValueError for what paths do not support."""
    if not isinstance(scene, Scene):
        raise ValueError(f"load_path: scene must be a Scene, got {shown(scene)}")
    scene = scene if scene.precision == "f64" else scene.replace(precision="f64")
    law = scene.law.in_steps()
    if scene.holds_volumes:
        raise ValueError(
            "load_path does not support FilledChamber: let its volume grow over the steps of a StaticSolver, which follows "
            "it beyond the greatest pressure, or press by Pressure"
        )
    others = (*scene.obstacles, *scene.terms_of(SelfContact, Robot))
    if others:
        raise ValueError(
            f"load_path does not support {type(others[0]).__name__}: leave it out, or follow the motion by "
            "ImplicitEulerSolver with Drag"
        )
    if any(body.kind != "tie" for body in scene.reduced.bodies):
        raise ValueError("load_path does not support sets that are reduced=; leave it out")
    if law.reads != ("H",) or scene.law.state_names:
        raise ValueError(f"load_path: {scene.law.title} is more than an energy of the displacement gradient")
    StaticSolver(scene)  # refuses what has no equilibrium
    return scene.with_consistent_mass()


class _Follower:
    shortest, most_rounds, usual_rounds = 1e-6, 12, 4  # of the first length; Newton's rounds of a point

    def __init__(self, equilibria: Equilibria, tolerance: float):
        self.e, self.tolerance = equilibria, tolerance

    def _solve(self, u, s, t, aim: float) -> _Point:
        """The equilibrium near (u, s) with t . u = aim; at this s, if t is None. Raises NotConverged."""
        e, done = self.e, []
        for k in range(self.most_rounds):
            e.place(u, s)
            u = e.u
            R, size = e.residual()
            done.append(np.linalg.norm(R) / size if size > 0 else 0.0)
            if not np.isfinite(done[-1]) or not e.upright:
                break
            A = e.factorised()
            f, way = e.by_factor()
            off = 0.0 if t is None else float((t * u).sum()) - aim
            da = e.field(A.solve(R))
            if done[-1] <= self.tolerance and abs(off) <= 1e-6 * abs(aim) + 1e-12:
                return _Point(u, s, A, k)
            change = 0.0
            if t is not None:
                db = e.field(A.solve(f)) + way
                change = -(off + float((t * da).sum())) / float((t * db).sum())
                da = da + change * db
            u, s = u + da, s + change
        raise NotConverged("load_path: no equilibrium was found", done)

    def _tangent(self, point: _Point, before: np.ndarray | None) -> tuple[np.ndarray, float]:
        """(t, ds/dl): the path's direction, of length one in u, on from `before`."""
        self.e.place(point.u, point.s)
        f, way = self.e.by_factor()
        t = self.e.field(point.A.solve(f)) + way
        length = np.linalg.norm(t) * (1 if before is None or (t * before).sum() > 0 else -1)
        return t / length, 1 / length

    def path(self, steps: int, step: float, until, start: CriticalPoint | None) -> LoadPath:
        if start is None:
            here = self._solve(np.zeros_like(self.e.h), 0.0, None, 0.0)
            t, rate = self._tangent(here, None)
            length = step / rate
        else:
            self.e.place(start.displacements, start.factor)
            here = _Point(start.displacements, start.factor, self.e.factorised(), 0)
            t, rate = start.mode / np.linalg.norm(start.mode), 0.0
            length = step * np.linalg.norm(self.e.h - self.e.u) or step * float(np.ptp(self.e.derived.rest))
        points, critical, least = [here], [], self.shortest * length
        while len(points) <= steps and not (until and len(points) > 1 and until(here.s, here.u)):
            try:
                there = self._at(here, t, rate, length)
                onwards = self._tangent(there, t)
                changed = there.A.negative != here.A.negative and not (start and len(points) == 1)
                met = self._critical(here, t, rate, length, there) if changed else []
            except NotConverged as error:
                length *= 0.5
                if length < least:
                    said = f"load_path: the path ends at a factor of {here.s:.6g}: no step from there converges"
                    raise NotConverged(f"{said}, however short", error.residuals) from None
                continue
            along = float((onwards[0] * t).sum())
            if along < 0.5 and length > least and start is None:  # too far round a bend
                length *= 0.5
                continue
            critical += met
            points.append(there)
            here, (t, rate), start = there, onwards, None
            length *= np.clip(np.sqrt(self.usual_rounds / max(there.rounds, 1)), 0.5, 1.0 if along < 0.9 else 2.0)
        return LoadPath(
            np.array([p.s for p in points]),
            np.array([p.u for p in points]),
            np.array([p.A.negative for p in points]),
            critical,
        )

    def _at(self, point: _Point, t, rate, length) -> _Point:
        return self._solve(point.u + length * t, point.s + length * rate, t, float((t * point.u).sum()) + length)

    def _critical(self, here: _Point, t, rate, length, there: _Point) -> list[CriticalPoint]:
        """Those on the way from `here` to `there`."""
        from scipy.optimize import brentq

        found, begin, count, known = [], 0.0, here.A.negative, {length: there}

        def gap(way: float) -> float:
            point = known[way] = known.get(way) or self._at(here, t, rate, way)
            return abs(point.A.null()[2]) * (1 if point.A.negative == count else -1)

        known[0.0] = here
        while count != there.A.negative:
            at = brentq(gap, begin, length, xtol=1e-9 * length, rtol=1e-12)
            point = known[at] if at in known else self._at(here, t, rate, at)
            v, w, _ = point.A.null()
            beyond = min((way for way in known if way > at and known[way].A.negative != count), default=length)
            count, begin = known[beyond].A.negative, beyond
            self.e.place(point.u, point.s)
            f, _ = self.e.by_factor()
            kind = "limit" if abs(w @ f) > 1e-5 * np.linalg.norm(f) else "branch"
            v, w = v * np.sign(v @ (self.e.T.T @ t.ravel()) or 1.0), w * np.sign(w @ v)
            found.append(CriticalPoint(kind, point.s, point.u, self.e.field(v), count))
            found[-1]._null, found[-1]._equilibria = (v, w), self.e
        return found
