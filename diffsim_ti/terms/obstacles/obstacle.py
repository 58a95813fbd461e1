"""What all obstacles share: a barrier of the distance, friction, a path, and every derivative of these."""

from collections.abc import Sequence
from copy import copy
from typing import TypedDict

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common import deprecated
from diffsim_ti.common.warn import warn
from diffsim_ti.inputs import NOT_NEGATIVE, Input
from diffsim_ti.inputs.description import length_per_step
from diffsim_ti.mesh.face_points import bow
from diffsim_ti.terms.obstacles.obstacle_force import ObstacleForce
from diffsim_ti.terms.obstacles.primitives import Primitives
from diffsim_ti.terms.obstacles.shapes import Triangles
from diffsim_ti.terms.obstacles.stiffness import approach, over_time, pressed_by, stiffness_of_impact
from diffsim_ti.terms.over_time import Motion
from diffsim_ti.terms.pose import brought_back, carried, path_width, sampled_path
from diffsim_ti.terms.term import Term, chosen_width, place, positive
from diffsim_ti.terms.whole_body import Gravity

PER_AREA = "barrier_stiffness_per_area"  # plain name of the input
STRETCH = 1.2  # of a body's longest edge: how far it may be stretched
BOW = 0.12  # of the width: how much nearer than their corners faces may be to what acts at vertices alone


class ObstacleOptions(TypedDict, total=False):
    """What every obstacle takes besides its shape; `Obstacle` says what it means and what it is where it is left out."""

    stiffness: float | None
    width: float | None
    friction: float
    friction_speed: float
    path: Motion | None
    name: str | None
    stiffness_per_area: float | None
    about: ArrayLike | None
    by_pairs: bool | None


class Obstacle(Term):
    """A body that does not deform, which acts on surface vertices through the barrier of their distance d [m] to it.

    Energy of a vertex b(d) = -k (d - width)^2 log(d / width) for d < width, exactly zero beyond, and its
    second-order Taylor polynomial below width / 1000 (barrier.py), so that a vertex that got past is pushed out.

    stiffness_per_area [N/m^3]: k is that times the share of the surface at rest that the vertex stands for
    (inputs/surface_areas.py): gaps, forces and friction are those of a surface and converge as it is refined. None lets the
    scene choose it, once, from density, wave speed, weight, impact, motions and paths over the first second, loads and
    muscles (stiffness.py). A press, which moves against a body with a pressure p [Pa] (about Young's modulus times the
    strain that it makes), needs p / (1.2 width): it then stands half a width from the surface, where the barrier pushes
    with 1.19 k width. Or
    stiffness [N/m]: k of every vertex alike, however many there are.
    width [m]: the distance at which the barrier begins to act. None: 1 % of the body (of the longest side of the smallest
    one, `mesh.body_size`), which `scene.describe()` says.
    friction [-]: Coulomb's coefficient (friction.py); 0 compiles none. friction_speed [m/s]: the speed below which
    friction is smoothed, and with which a vertex that is held may creep.
    path: the obstacle's displacement over time [m], a function of time [s] that returns 3 numbers, or keyframes
    (times, displacements) between which it is linear. It is sampled at the steps and linear within each. 6 or 7 numbers are
    a pose: a displacement, then a rotation vector [rad] or a quaternion (w, x, y, z) of any length. It takes a point x of
    the obstacle as it was made to c + t + R (x - c), with constant angular velocity between keyframes and within steps.
    Quaternions take the short way; rotation vectors on one axis keep their turns, less than one in a step.
    about [m]: the point c.
    by_pairs: whether it also acts on faces and edges of bodies between their vertices, as bodies act on each other: a ball's
    centre on triangles, at the distance less the radius; of a capsule its axis on edges and its ends on triangles; of a box
    its twelve edges and eight corners; a cylinder as the prism whose edges lie on it, at most 0.12 widths within it. Energy
    of a pair as of a vertex, m b(d) with m of `SelfContact`; the stiffness per area is multiplied by the triangle's area in
    the mesh, or by a third of that of the triangles at the edge. None: it does where it is narrow, that is where a ball of
    its least radius R, which touches a face whose longest edge in the mesh is L, could be nearer to it than to its corners
    by more than 0.12 widths, (1.2 L)^2 > 6 R 0.12 width; a ball or a capsule also where faces are curved. That is decided
    when the scene is built. Mesh obstacles do so with what is sharp of them.
    A face of ten-node tetrahedra counts as the four triangles of its six nodes, and by pairs as many smaller ones as its
    bow asks for; a warning says where it lies farther than half a width from triangles that act at nodes alone.

    Inputs with gradient: the shape's own numbers, "barrier_stiffness_per_area" or "barrier_stiffness", "barrier_width",
    with friction also "friction" and "friction_speed", with a path "<shape>_path", shape (steps + 1, 3), of a pose
    (steps + 1, 6 or 7), and "<shape>_about", shape (3,). A second
    obstacle's names end in _2; those of one with a name begin with it and go on as the argument: "floor.stiffness",
    "floor.path".
    In explicit steps frictions on one vertex act one after the other: kinds in a fixed order, obstacles of one kind as the
    scene lists them. Swapping two there, at 90 degrees to each other, moved a body by 7e-4 of the way that it went in 32 ms
    with substeps of 2 ms, and a gradient by up to 12 % (that of friction_speed); half of both with 1 ms. Elsewhere, and in
    implicit steps, swapping changes round-off alone.
    A shape of one's own says of its inputs which are places, Input(..., axes="xyz"), of a height axes="y" (origin.py).
    Raises ValueError for numbers out of range, both stiffnesses together, or a body that starts on or in the obstacle.
    Li et al. 2020, Incremental Potential Contact, doi:10.1145/3386569.3392425.
    """

    acts_on_surface = True
    counterpart: type  # the device counterpart of the shape
    all_primitives: "Primitives | None" = None  # of the shape

    def __init_subclass__(cls, **options):
        super().__init_subclass__(**options)
        if "twin" in vars(cls):
            deprecated.warn(f"{cls.__name__}.twin", "counterpart")
            cls.counterpart = vars(cls)["twin"]

    def __init__(
        self,
        shape: Sequence[Input] | dict,
        stiffness: float | None = None,
        width: float | None = None,
        friction: float = 0.0,
        friction_speed: float = 1e-3,
        path: Motion | None = None,
        name: str | None = None,
        stiffness_per_area: float | None = None,
        about: ArrayLike | None = None,
        by_pairs: bool | None = None,
    ):
        self.by_pairs = by_pairs
        if by_pairs and self.all_primitives is None:
            raise ValueError(
                f"{type(self).__name__}: by_pairs is for shapes of points and edges, and this one has none: leave it out"
            )
        if isinstance(shape, dict):  # {name: value}, with nothing more to say of them
            shape = [Input(plain, value) for plain, value in shape.items()]
        stiff = self._stiffness(stiffness, stiffness_per_area)
        self.left_to_scene = (PER_AREA,) * self.chooses_stiffness + ("barrier_width",) * (width is None)
        wide = positive("width", 1.0 if width is None else width, "m", "barrier_width")
        speed = positive("friction_speed", friction_speed, "m/s")
        friction_of = Input("friction", friction, ((),), range=NOT_NEGATIVE), speed
        for described in friction_of:  # also of what is smooth
            described.check_value(type(self).__name__)
        rough = friction_of if friction_of[0].value > 0 else ()
        self.path, self.path_width = path, 3 if path is None else path_width(path)
        kind = type(self).__name__
        if about is not None and not self.turns:
            raise ValueError(
                f"{kind}: about is the point that a pose turns it about; pass a path of 6 or 7 numbers, or no about"
            )
        centre = [place("about", (0.0, 0.0, 0.0) if about is None else about, self.about_name)] if self.turns else []
        unit = "m, rad" if self.path_width == 6 else "m, -" if self.turns else "m"
        rows = [
            Input("path", None, (("steps + 1", self.path_width),), unit, change=length_per_step, plain=self.path_name)
        ]
        super().__init__(*shape, stiff, wide, *rough, *centre, *(rows if path is not None else []), name=name)

    def _stiffness(self, of_vertex: float | None, per_area: float | None) -> Input:
        """How stiff the barrier is: per area, or of each vertex."""
        self.per_area, self.chooses_stiffness = of_vertex is None, of_vertex is None and per_area is None
        if not self.per_area:
            if per_area is not None:
                raise ValueError(
                    f"{type(self).__name__}: stiffness [N/m] of each vertex and stiffness_per_area [N/m^3] exclude each "
                    f"other, got {of_vertex} and {per_area}; pass one of them"
                )
            return positive("stiffness", of_vertex, "N/m", "barrier_stiffness")
        return positive("stiffness_per_area", 1.0 if per_area is None else per_area, "N/m^3", PER_AREA)

    @property
    def _kind(self) -> str:
        kind = type(self).__name__
        return "".join("_" * (k > 0 and c.isupper()) + c.lower() for k, c in enumerate(kind))

    @property
    def path_name(self) -> str:
        """Plain name of the input that moves the obstacle."""
        return f"{self._kind}_path"

    @property
    def about_name(self) -> str:
        """Plain name of the point that it turns about."""
        return f"{self._kind}_about"

    @property
    def turns(self) -> bool:
        """Whether its path is a pose."""
        return self.path_width > 3

    @property
    def about(self) -> np.ndarray:
        """The point that it turns about [m], as it was made."""
        return self.values[self.about_name] if self.turns else np.zeros(3)

    @property
    def primitives(self) -> "Primitives | None":
        """By which it acts on faces and edges of bodies; None where by its distance alone."""
        return self.all_primitives if self.by_pairs else None

    @property
    def has_friction(self) -> bool:
        """Whether friction was given: without, none is compiled."""
        return "friction" in self.values

    def settled(self, scene, density, initial_positions, initial_velocities) -> "Obstacle":
        """With the width that the body asks for, and the stiffness per area that the fall from the start, the start's
        velocity, motions over the first second, and what presses on the body ask for."""
        out = copy(self)
        if "barrier_width" in self.left_to_scene:
            out = self.with_input("barrier_width", value=chosen_width(scene.mesh))
        out._decide_on_pairs(scene.mesh)
        if not self.chooses_stiffness:
            return out
        gravity = scene.term(Gravity)
        pull = gravity.values["gravity"] if gravity else np.zeros(3)
        g, axis = float(np.linalg.norm(pull)), int(np.argmax(np.abs(pull) + [0, 1e-300, 0]))
        positions = scene.mesh.vertices if initial_positions is None else np.asarray(initial_positions, np.float64)
        start = np.zeros(3) if self.led is None else self.led
        start = start if self.path is None else sampled_path(self.path_name, self.path, [0.0])[0]
        fall = max(float(self.gap(positions, start).min()), 0.0)
        first = 0.0 if initial_velocities is None else np.linalg.norm(np.atleast_2d(initial_velocities), axis=1).max()
        led = own = 0.0
        if scene.motion is not None:
            moves = over_time(lambda t: scene.supports.rows(scene.motion, t))
            led = approach([self.gap(positions[scene.held] + x, start) for x in moves])
        if self.path is not None:
            rows = over_time(lambda t: sampled_path(self.path_name, self.path, t))
            own = approach([self.gap(positions, row) for row in rows])
        speed, width = float(np.sqrt(first**2 + 2 * g * fall)) + led + own, float(out.values["barrier_width"])
        mean, mesh = float(np.mean(density)), scene.mesh
        pressed = pressed_by(scene.terms, mesh, mean)
        stiffness = stiffness_of_impact(mesh, scene.material, mean, g, speed, width, pressed, axis)
        if not stiffness > 0:
            raise ValueError(
                f"{type(self).__name__}: without gravity, velocity, motion and loads nothing says how stiff the barrier "
                "must be; pass stiffness_per_area [N/m^3]"
            )
        return out.with_input(PER_AREA, value=stiffness)

    def _decide_on_pairs(self, mesh) -> None:
        """Choose whether it acts by pairs where that is left to the scene, its width being known."""
        width, off = float(self.values["barrier_width"]), bow(mesh)
        self.all_primitives = self.primitives_for(mesh, width)
        is_whole = self.all_primitives is not None and self.all_primitives.whole
        is_narrow = longest_edge(mesh) ** 2 > 6 * self.least_radius() * BOW * width
        if self.by_pairs is None:
            self.by_pairs = self.all_primitives is not None and (is_narrow or (is_whole and off > BOW * width))
            if is_narrow and not self.by_pairs:
                warn(
                    f"{self!r} may be narrower than faces of the body, and acts at their vertices alone: give its class "
                    "least_radius, how round it is [m], or all_primitives, its corners and edges, or pass by_pairs=False"
                )
        if off > 0.5 * width and not (self.by_pairs and is_whole):
            warn(
                f"faces of this mesh are curved, and lie up to {off:.3g} m from the triangles of their nodes, where "
                f"{self!r} acts: refine the mesh where it is curved, or take a width of {2 * off:.3g} m or more"
            )

    def primitives_for(self, mesh, width: float) -> "Primitives | None":
        """The corners and edges by which it acts on faces and edges of a body, with a barrier of a width [m]."""
        return self.all_primitives

    def distance(self, positions: np.ndarray) -> np.ndarray:
        """Distance [m] of each position, shape (k, 3), to the obstacle as it was made; negative inside."""
        raise NotImplementedError

    def gap(self, positions: np.ndarray, offset=(0.0, 0.0, 0.0)) -> np.ndarray:
        """Distance [m] of each position, the obstacle being displaced by `offset` [m], or in a pose of 6 or 7 numbers."""
        return self.distance(brought_back(np.asarray(positions, np.float64), np.asarray(offset), self.about))

    def way(self, positions: np.ndarray, before: np.ndarray, after: np.ndarray) -> float:
        """How far it goes between two keyframes of its path, the most at the positions [m]."""
        if not self.turns:
            return float(np.linalg.norm(after - before))
        there = carried(brought_back(positions, before, self.about), after, self.about)
        return float(np.linalg.norm(there - positions, axis=1).max())

    def least_radius(self) -> float:
        """How round the obstacle is at least [m]: 0 where it has edges, infinite where it is flat or hollow."""
        return np.inf if getattr(getattr(self, "counterpart", None), "hollow", False) is True else 0.0

    def check_start(self, positions: np.ndarray, surface: np.ndarray, offset=(0.0, 0.0, 0.0)) -> None:
        gap = self.gap(positions[surface], offset)
        if gap.size and gap.min() <= 0:
            self._refuse(gap, surface)

    def _refuse(self, gap: np.ndarray, surface: np.ndarray) -> None:
        inside = np.flatnonzero(gap <= 0)
        deepest = inside[np.argsort(gap[inside], kind="stable")][:5]
        named = ", ".join(f"vertex {surface[k]} by {0.0 - gap[k]:.3g} m" for k in deepest)
        remedy = "move the body or the obstacle"
        if self.led is not None:
            remedy = "move the body or the robot, or leave the link out of links= of from_urdf"
        raise ValueError(f"the body starts on or in {self!r}: {named} ({len(inside)} vertices); {remedy}")

    def surface(self, size: float) -> Triangles | None:
        """(points [m], shape (k, 3), triangles that face outwards) to draw, where the obstacle was made; None: not drawn.

        size [m]: that of the body, for an obstacle that has no end.
        """
        return None

    def surface_at(self, size: float, time: float, row: np.ndarray | None = None) -> Triangles | None:
        """`surface` where its path has taken it at a time [s], or at a keyframe of its path."""
        shape = self.surface(size)
        if shape is None or (self.path is None and self.led is None):
            return shape
        if row is None:
            row = self.led if self.path is None else sampled_path(self.path_name, self.path, [time])[0]
        return carried(shape[0], row, self.about), shape[1]

    def floor_height(self) -> float | None:
        """Height y [m] of the floor that the obstacle is, where it was made; None if it is no floor."""
        return None

    @property
    def variant(self) -> tuple:
        return self.has_friction, self.path is not None, self.per_area, self.turns

    def kernel(self, precision: str) -> ObstacleForce:
        return self.counterpart(precision, self.has_friction)


def longest_edge(mesh) -> float:
    """The longest that an edge of the body's triangles may be [m]: that of the mesh, stretched."""
    x = mesh.vertices[mesh.surface_triangles]
    return STRETCH * float(np.linalg.norm(x - np.roll(x, 1, axis=1), axis=2).max(initial=0))
