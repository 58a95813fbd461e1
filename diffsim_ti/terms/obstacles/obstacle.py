"""What all obstacles share: a barrier of the distance, friction, a path, and every derivative of these."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import taichi as ti

from diffsim_ti.differentiation import Graph
from diffsim_ti.inputs import NOT_NEGATIVE, Input
from diffsim_ti.inputs.description import length_per_step
from diffsim_ti.materials.calculus.tensor import sum_of
from diffsim_ti.runtime import assign, at, let, traced
from diffsim_ti.terms.described import positive
from diffsim_ti.terms.gravity import Gravity
from diffsim_ti.terms.motion import Motion, sampled
from diffsim_ti.terms.obstacles import barrier, friction
from diffsim_ti.terms.obstacles.shapes import Triangles
from diffsim_ti.terms.obstacles.stiffness import barrier_stiffness
from diffsim_ti.terms.term import Term, VertexForce


class Obstacle(Term):
    """A body that does not deform, felt by surface vertices through the barrier of their distance d [m] to it.

    Energy per vertex b(d) = -stiffness (d - width)^2 log(d / width) for d < width, exactly zero beyond, and its
    second-order Taylor polynomial below width / 1000 (barrier.py), so that a vertex that got past is pushed out.

    stiffness [N/m]: None lets the scene choose it from mass, wave speed, weight and impact (stiffness.py).
    width [m]: how far the obstacle is felt.
    friction [-]: Coulomb's coefficient (friction.py); 0 compiles none. friction_speed [m/s]: the speed below which
    friction is smoothed, and with which a vertex that is held may creep.
    path: the obstacle's displacement over time [m], a function of time [s] that returns 3 numbers, or keyframes
    (times, displacements) between which it is linear. It is sampled at the steps and linear within each.

    Inputs with gradient: the shape's own numbers, "barrier_stiffness", "barrier_width", with friction also "friction" and
    "friction_speed", with a path "<shape>_path", shape (steps + 1, 3). A second obstacle's names end in _2; those of one
    with a name begin with it and go on as the argument: "floor.stiffness", "floor.path".
    In explicit steps frictions on one vertex act one after the other: kinds in a fixed order, obstacles of one kind as the
    scene lists them. Swapping two there, at 90 degrees to each other, moved a body by 7e-4 of the way that it went in 32 ms
    with substeps of 2 ms, and a gradient by up to 12 % (that of friction_speed); half of both with 1 ms. Elsewhere, and in
    implicit steps, swapping changes round-off alone.
    Raises ValueError for numbers out of range, or a body that starts on or in the obstacle.
    Li et al. 2020, Incremental Potential Contact, doi:10.1145/3386569.3392425.
    """

    acts_on_surface = True
    twin: type  # the compile-time twin of the shape

    def __init__(
        self,
        shape: Sequence[Input] | dict,
        stiffness: float | None = None,
        width: float = 0.01,
        friction: float = 0.0,
        friction_speed: float = 1e-3,
        path: Motion | None = None,
        name: str | None = None,
    ):
        if isinstance(shape, dict):  # {name: value}, with nothing more to say of them
            shape = [Input(plain, value) for plain, value in shape.items()]
        k, speed = 1.0 if stiffness is None else stiffness, positive("friction_speed", friction_speed, "m/s")
        felt = positive("stiffness", k, "N/m", "barrier_stiffness"), positive("width", width, "m", "barrier_width")
        friction_of = Input("friction", friction, ((),), range=NOT_NEGATIVE), speed
        for described in friction_of:  # also of what is smooth
            described.check_given(type(self).__name__)
        rough = friction_of if friction_of[0].value > 0 else ()
        rows = [Input("path", None, (("steps + 1", 3),), "m", change=length_per_step, plain=self.path_name)]
        super().__init__(*shape, *felt, *rough, *(rows if path is not None else []), name=name)
        self.chooses_stiffness, self.path = stiffness is None, path

    @property
    def path_name(self) -> str:
        """Plain name of the input that moves the obstacle."""
        kind = type(self).__name__
        return "".join("_" * (k > 0 and c.isupper()) + c.lower() for k, c in enumerate(kind)) + "_path"

    @property
    def has_friction(self) -> bool:
        return "friction" in self.values

    def settled(self, scene, density, initial_positions, initial_velocities) -> "Obstacle":
        """With the stiffness that the fall from the start, or the start's velocity, asks for."""
        if not self.chooses_stiffness:
            return self
        gravity = scene.term(Gravity)
        g = float(np.linalg.norm(gravity.values["gravity"])) if gravity else 0.0
        positions = scene.mesh.vertices if initial_positions is None else np.asarray(initial_positions, np.float64)
        place = np.zeros(3) if self.path is None else sampled(self.path_name, self.path, [0.0], 1)[0, 0]
        fall = max(float(self.gap(positions, place).min()), 0.0)
        start = 0.0 if initial_velocities is None else np.linalg.norm(np.atleast_2d(initial_velocities), axis=1).max()
        speed, width = float(np.sqrt(start**2 + 2 * g * fall)), float(self.values["barrier_width"])
        stiffness = barrier_stiffness(scene.mesh, scene.material, float(np.mean(density)), g, speed, width)
        if not stiffness > 0:
            raise ValueError(
                f"{type(self).__name__}: without gravity and velocity nothing says how stiff the barrier must be; pass "
                "stiffness [N/m]"
            )
        return self.with_input("barrier_stiffness", value=stiffness)

    def distance(self, positions: np.ndarray) -> np.ndarray:
        """Distance [m] of each position, shape (k, 3), to the obstacle as it was made; negative inside."""
        raise NotImplementedError

    def gap(self, positions: np.ndarray, offset=(0.0, 0.0, 0.0)) -> np.ndarray:
        """Distance [m] of each position, the obstacle being displaced by `offset` [m]."""
        return self.distance(np.asarray(positions, np.float64) - offset)

    def check_start(self, positions: np.ndarray, surface: np.ndarray, offset=(0.0, 0.0, 0.0)) -> None:
        gap = self.gap(positions[surface], offset)
        if gap.size and gap.min() <= 0:
            self._refuse(gap, surface)

    def _refuse(self, gap: np.ndarray, surface: np.ndarray) -> None:
        inside = np.flatnonzero(gap <= 0)
        deepest = inside[np.argsort(gap[inside], kind="stable")][:5]
        named = ", ".join(f"vertex {surface[k]} by {-gap[k]:.3g} m" for k in deepest)
        raise ValueError(
            f"the body starts on or in {self!r}: {named} ({len(inside)} vertices); move the body or the obstacle"
        )

    def surface(self, size: float) -> Triangles | None:
        """(points [m], shape (k, 3), triangles that face outwards) to draw, where the obstacle was made; None: not drawn.

        size [m]: that of the body, for an obstacle that has no end.
        """
        return None

    def floor_height(self) -> float | None:
        """Height y [m] of the floor that the obstacle is, where it was made; None if it is no floor."""
        return None

    @property
    def variant(self) -> tuple:
        return self.has_friction, self.path is not None

    def kernel(self, precision: str) -> "ObstacleForce":
        return self.twin(precision, self.has_friction)


@dataclass(frozen=True)
class ObstacleForce(VertexForce):
    """Compile-time twin of an obstacle: `count` numbers of its shape, then stiffness, width [, friction, friction_speed].

    A shape writes one function, `distance_and_normal`, in numbers of a graph; everything else follows from it. Positions
    are relative to the obstacle: callers take its displacement from X.
    """

    friction: bool = False

    count = 0
    watched = True

    @property
    def size(self) -> int:
        return self.count + (4 if self.friction else 2)

    @traced
    def distance_and_normal(self, g, p, X, u) -> tuple:
        """(d, n) of the point X + u; p are the shape's numbers; n is the gradient of d, a list of three."""

    # ---- recording --------------------------------------------------------------------------------------------------

    @traced
    def record(self, parameters, first, X, u):
        """(graph, all numbers, components of u, d, n) at a point."""
        g = Graph(self.fp, parameters)
        p = [g.leaf(at(parameters, first + k)) for k in range(self.size)]
        rest, moved = ([g.leaf(at(vector, d)) for d in range(3)] for vector in (X, u))
        d, n = self.distance_and_normal(g, p[: self.count], rest, moved)
        return g, p, moved, d, n

    @traced
    def _push(self, g, p, d):
        """Size N of the barrier's force."""
        stiffness, width = p[self.count], p[self.count + 1]
        s, fp = d / width, self.fp
        slope = g.function(barrier.slope(s.value, fp), (s, lambda: barrier.curvature(s.value, fp)))
        return g.number(0) - stiffness * width * slope

    @traced
    def _record_force(self, parameters, first, X, u):
        g, p, moved, d, n = self.record(parameters, first, X, u)
        push = self._push(g, p, d)
        return g, p, moved, [push * k for k in n]

    @traced
    def _vector(self, numbers):
        return let(ti.types.vector(4, self.fp)(*numbers, ti.cast(0, self.fp)))

    # ---- distance ---------------------------------------------------------------------------------------------------

    @traced
    def gap(self, parameters, first, X, u):
        """Distance d [m]."""
        return self.record(parameters, first, X, u)[3].value

    @ti.func
    def width(self, parameters: ti.template(), first):
        """How far the obstacle is felt [m]."""
        return parameters[first + self.count + 1]

    @ti.func
    def touches(self, parameters: ti.template(), first, X, u):
        """Whether the barrier is felt."""
        return self.gap(parameters, first, X, u) < self.width(parameters, first)

    @traced
    def approach(self, parameters, first, X, u, move):
        """Change of the distance for a small move, n . move [m]."""
        n = self.record(parameters, first, X, u)[4]
        return let(sum_of(n[d].value * at(move, d) for d in range(3)))

    @ti.func
    def rigidity(self, parameters: ti.template(), first, X, u):
        """b''(d) [N/m]"""
        s = self.gap(parameters, first, X, u) / self.width(parameters, first)
        return parameters[first + self.count] * barrier.curvature(s, self.fp)

    # ---- the barrier's force ----------------------------------------------------------------------------------------

    @ti.func
    def energy(self, parameters: ti.template(), first, X, u):
        width = self.width(parameters, first)
        s = self.gap(parameters, first, X, u) / width
        return parameters[first + self.count] * width * width * barrier.value(s, self.fp)

    @ti.func
    def force(self, parameters: ti.template(), first, X, u, v):
        f = 0 * u
        if self.touches(parameters, first, X, u):
            f = self._force(parameters, first, X, u)
        return f

    @ti.func
    def force_jvp(self, parameters: ti.template(), first, X, u, v, du, dv):
        df = 0 * u
        if self.touches(parameters, first, X, u):
            df = self._force_jvp(parameters, first, X, u, du)
        return df

    @ti.func
    def force_vjp(self, parameters: ti.template(), first, X, u, v, w):
        return self.force_jvp(parameters, first, X, u, v, w, w), 0 * w  # a force with a potential

    @ti.func
    def parameter_derivatives(self, parameters: ti.template(), first, X, u, v):
        by = self._zeros(u)
        if self.touches(parameters, first, X, u):
            self._parameter_derivatives(parameters, first, X, u, by)
        return by

    @traced
    def _force(self, parameters, first, X, u):
        return self._vector([k.value for k in self._record_force(parameters, first, X, u)[3]])

    @traced
    def _force_jvp(self, parameters, first, X, u, du):
        g, _, moved, f = self._record_force(parameters, first, X, u)
        return self._vector(g.forward([(x, at(du, d)) for d, x in enumerate(moved)], f))

    @traced
    def _zeros(self, u):
        return [let(u * ti.cast(0, self.fp)) for _ in range(self.size)]

    @traced
    def _parameter_derivatives(self, parameters, first, X, u, by):
        g, p, _, f = self._record_force(parameters, first, X, u)
        rows = [g.reverse([(f[d], g.one())], p) for d in range(3)]
        for m, target in enumerate(by):
            assign(target, self._vector([row[m] for row in rows]))

    # ---- friction as a stage of explicit passes ----------------------------------------------------------------------

    @traced
    def _record_slide(self, parameters, first, X, u, v, wall, h_over_m):
        g, p, moved, d, n = self.record(parameters, first, X, u)
        before, mu, eps = [g.leaf(at(v, d)) for d in range(3)], p[self.count + 2], p[self.count + 3]
        ratio, wall = g.leaf(h_over_m), [g.leaf(at(wall, d)) for d in range(3)]
        after = friction.slide(g, n, self._push(g, p, d), before, wall, mu, ratio, eps)
        return g, p, moved, before, wall, ratio, after

    @traced
    def slide(self, parameters, first, X, u, v, wall, h_over_m):
        """Velocity after friction in the time h on a vertex of mass m that touches; `wall`: the obstacle's velocity."""
        return self._vector([k.value for k in self._record_slide(parameters, first, X, u, v, wall, h_over_m)[-1]])

    @traced
    def slide_jvp(self, parameters, first, X, u, v, wall, h_over_m, parameters_dot, du, dv, dwall, dh_over_m):
        """Its change."""
        g, p, moved, before, walls, ratio, after = self._record_slide(parameters, first, X, u, v, wall, h_over_m)
        dots = [(ratio, dh_over_m)] + [(q, at(parameters_dot, first + k)) for k, q in enumerate(p)]
        for leaves, change in ((moved, du), (before, dv), (walls, dwall)):
            dots += [(leaf, at(change, d)) for d, leaf in enumerate(leaves)]
        return self._vector(g.forward(dots, after))

    @traced
    def slide_vjp(self, parameters, first, X, u, v, wall, h_over_m, w):
        """(adjoints of u, v, wall as vectors, of h_over_m, and of the obstacle's numbers, a tuple) for the adjoint w."""
        g, p, moved, before, walls, ratio, after = self._record_slide(parameters, first, X, u, v, wall, h_over_m)
        adjoints = g.reverse([(k, let(at(w, d))) for d, k in enumerate(after)], [*moved, *before, *walls, ratio, *p])
        vectors = [self._vector(adjoints[k : k + 3]) for k in (0, 3, 6)]
        return (*vectors, adjoints[9], tuple(adjoints[10:]))

    # ---- friction as a force of implicit passes, at the velocity v, with N and n at the displacement u ----------------

    @traced
    def _record_rub(self, parameters, first, X, u, v, wall):
        g, p, moved, d, n = self.record(parameters, first, X, u)
        speed, wall = ([g.leaf(at(vector, d)) for d in range(3)] for vector in (v, wall))
        return g, p, moved, speed, wall, n, self._push(g, p, d)

    @traced
    def dissipation(self, parameters, first, X, u, v, wall):
        """Potential of friction by the velocity [W]."""
        g, p, _, speed, wall, n, push = self._record_rub(parameters, first, X, u, v, wall)
        return friction.dissipation(g, n, push, speed, wall, p[self.count + 2], p[self.count + 3]).value

    @traced
    def _rubbed(self, parameters, first, X, u, v, wall):
        g, p, moved, speed, wall, n, push = self._record_rub(parameters, first, X, u, v, wall)
        return g, p, moved, speed, wall, friction.rub(g, n, push, speed, wall, p[self.count + 2], p[self.count + 3])

    @traced
    def rub(self, parameters, first, X, u, v, wall):
        """Force of friction [N]; `wall`: the obstacle's velocity."""
        return self._vector([k.value for k in self._rubbed(parameters, first, X, u, v, wall)[-1]])

    @traced
    def rub_product(self, parameters, first, X, u, v, wall, dv):
        """Its change for a change of the velocity alone."""
        g, _, _, speed, _, f = self._rubbed(parameters, first, X, u, v, wall)
        return self._vector(g.forward([(x, at(dv, d)) for d, x in enumerate(speed)], f))

    @traced
    def rub_jvp(self, parameters, first, X, u, v, wall, parameters_dot, du, dv, dwall):
        """Its change for changes of everything."""
        g, p, moved, speed, walls, f = self._rubbed(parameters, first, X, u, v, wall)
        dots = [(q, at(parameters_dot, first + k)) for k, q in enumerate(p)]
        for leaves, change in ((moved, du), (speed, dv), (walls, dwall)):
            dots += [(leaf, at(change, d)) for d, leaf in enumerate(leaves)]
        return self._vector(g.forward(dots, f))

    @traced
    def rub_vjp(self, parameters, first, X, u, v, wall, w):
        """(adjoints of u, v, wall as vectors, and of the obstacle's numbers, a tuple) for the adjoint w of the force."""
        g, p, moved, speed, walls, f = self._rubbed(parameters, first, X, u, v, wall)
        adjoints = g.reverse([(k, let(at(w, d))) for d, k in enumerate(f)], [*moved, *speed, *walls, *p])
        return (*(self._vector(adjoints[k : k + 3]) for k in (0, 3, 6)), tuple(adjoints[9:]))
