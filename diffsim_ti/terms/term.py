"""What a term is: a load, a contact or a damping that a scene lists, inlined into the step at compile time."""

from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import taichi as ti
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import present
from diffsim_ti.common.public import Public
from diffsim_ti.inputs import POSITIVE, Input, Link
from diffsim_ti.inputs.description import length
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.runtime import number_type
from diffsim_ti.terms.marks import Mark, Moment

if TYPE_CHECKING:
    from diffsim_ti.scene import Scene


class Term(metaclass=Public):
    """A load, contact or damping: its inputs, in SI units and float64, and how kernels come to read them.

    name: a word that its inputs' names begin with, "floor.stiffness"; without one they have plain names,
    "barrier_stiffness", to which a second such term adds _2.
    A term that the scene does not list leaves no code and no memory behind. What a subclass may write, each optional:
    `links`, where kernels read something else than its inputs as they are; `check`, `settled` and `check_start`, to refuse
    what does not fit and to choose what is left to the scene; `kernel`, the device counterpart of a term that acts by a
    force on each vertex (VertexForce); `drawn`, what pictures, films, the window and series show of it. Gravity, drag and
    external forces are parts of the step itself; `interaction` is the class that says what any other force does.
    """

    acts_on_surface = False
    primitives = None  # by which an obstacle acts on faces and edges of bodies too (terms/obstacles/primitives.py)
    interaction = None  # the kind of interaction (mechanics/interaction.py) that a term of a user brings with it
    path = None  # displacement over time, of an obstacle that moves
    led: np.ndarray | None = None  # of an obstacle that a robot moves, its pose at the start
    companions: "tuple[Term, ...]" = ()  # terms that come with it, such as the links of a robot
    table = np.zeros(0)  # numbers without gradient, laid behind the parameters on the device
    num_extra = 0  # how many of its numbers, the last of them, kernels do not take one by one (VertexForce.corners)
    variant: tuple = ()  # what else than its class decides about the kernels of a term
    left_to_scene: tuple[str, ...] = ()  # plain names of the numbers that the scene chooses (`settled`)
    keyed = False  # whether its input is sampled at the ends of each run's steps (`rows`)
    stiffest = None  # np.max or np.min: which of what it is given over time asks for the shortest steps

    def __init__(self, *inputs: Input, name: str | None = None):
        kind = type(self).__name__
        if name is not None and not (isinstance(name, str) and name.isidentifier()):
            rule = f"name must be a word such as 'floor', got {name!r}"
            raise ValueError(f"{kind}: {rule}: its inputs' names begin with it")
        for described in inputs:
            if described.value is not None:
                described.check_value(kind)
        self.described, self.name = inputs, name

    @property
    def values(self) -> dict[str, np.ndarray]:
        """{plain name of an input: its value}, without those that are sampled per run."""
        return {i.plain: i.value for i in self.described if i.value is not None}

    @property
    def tensors(self) -> dict[str, object]:
        """{plain name of an input: the tensor that it was given as}"""
        return {i.plain: i.given for i in self.described if i.given is not None}

    def with_input(self, plain: str, **changes: object) -> "Term":
        """A copy in which the input of a plain name has another value, shapes ..., fields of `Input`."""
        out = copy(self)
        out.described = tuple(replace(i, **changes) if i.plain == plain else i for i in self.described)
        out.left_to_scene = tuple(name for name in self.left_to_scene if name != plain)
        return out

    @property
    def num_numbers(self) -> int:
        """How many numbers kernels read of it, in the scene's parameter array."""
        return sum(value.size for value in self.values.values())

    def links(self, names: dict[str, str], own: str) -> list[Link]:
        """From its inputs to what kernels read; `names`: {plain name: name in the scene}.

        Where none writes `own`, the `num_numbers` that its kernels take, they take those of its inputs as they are.
        """
        return []

    @property
    def says_places(self) -> bool:
        """Whether some of its inputs, but for the point that it turns about, are said to be places."""
        return any(i.axes and i.name != "about" for i in self.described)

    def shift(self, origin: np.ndarray) -> np.ndarray:
        """What the numbers that kernels take as they are have less where places are measured from `origin` [m]."""
        return np.concatenate([np.zeros(0), *(i.shift(origin) for i in self.described if i.value is not None)])

    def nearer(self, origin: np.ndarray, length: float, names: dict[str, str], own: str) -> list[Link]:
        """Links from places that need not be where they are to places near `origin` [m], by body lengths [m]; each writes
        what kernels take for the first that it reads."""
        return []

    def table_at(self, numbers: np.ndarray) -> np.ndarray:
        """The table, for its numbers as kernels take them."""
        return self.table

    def sizes(self, mesh: TetrahedralMesh) -> dict[str, int]:
        """What words for lengths in the shapes of its inputs mean."""
        return {}

    def check(self, mesh: TetrahedralMesh) -> None:
        """Raise ValueError if the term does not fit the mesh."""

    def settled(
        self,
        scene: "Scene",
        density: ArrayLike,
        initial_positions: ArrayLike | None,
        initial_velocities: ArrayLike | None,
    ) -> "Term":
        """The term with what it leaves to the scene to choose."""
        return self

    def check_start(self, positions: np.ndarray, surface: np.ndarray) -> None:
        """Raise ValueError if the body may not start at `positions` [m], shape (num_vertices, 3)."""

    def drawn(self, moment: Moment) -> list[Mark]:
        """Arrows, lines and points (marks.py) that show the term at a moment, in space [m]; none: nothing is drawn.

        A spring from one vertex to another: `x = moment.positions[[a, b]]; return [Lines("spring", x[None])]`; a load:
        `[arrows("traction [N/m^2]", moment.mesh, moment.positions, vertices, moment.values["traction"])]`. The label stands
        in the picture's key; arrows need their unit in it. An obstacle has a `surface` instead.
        """
        return []

    def kernel(self, precision: str) -> "VertexForce | None":
        """The device counterpart; a term with a table is also given `table`, where it starts in the scene's parameter
        array."""
        return None

    def __repr__(self) -> str:
        named = [] if self.name is None else [f"name={self.name!r}"]
        short = lambda x: f"array{x.shape}" if x.size > 3 else np.array2string(x, separator=", ", precision=6)  # noqa: E731
        left = {name: "chosen by the scene" for name in self.left_to_scene}
        numbers = [f"{name}={left.get(name) or short(value)}" for name, value in self.values.items()]
        return f"{type(self).__name__}({', '.join(named + numbers)})"


def nonempty(term: Term, rows: np.ndarray) -> np.ndarray:
    """What a term acts on. Raises ValueError if that is nothing."""
    if len(rows) == 0:
        raise ValueError(f"{type(term).__name__} acts on nothing: the set is empty; name a set that has members")
    return rows


class OnMesh:
    """The part of a term whose links need the `mesh` of its scene."""

    def settled(self, scene, density, initial_positions, initial_velocities) -> Term:
        """The term with that mesh."""
        out = copy(self)
        out.mesh = scene.mesh
        return out


class OnSurface:
    """The part of a term that acts on a `surface` of the body; None: all of it."""

    def check(self, mesh: TetrahedralMesh) -> None:
        """Raise ValueError for a surface without faces."""
        nonempty(self, self.faces(mesh))

    def faces(self, mesh: TetrahedralMesh) -> np.ndarray:
        """Where it acts, as vertex indices, normals out of the body, shape (k, 3) or (k, 6)."""
        return mesh.faces_of(self.surface)

    def indices(self, mesh: TetrahedralMesh) -> np.ndarray:
        """Vertices of these faces, sorted."""
        return np.unique(self.faces(mesh))


@dataclass(frozen=True)
class VertexForce(metaclass=Public):
    """Device counterpart of a term: Taichi functions of one vertex, at rest position X, displacement u, velocity v.

    Vectors have four components, the last zero. Equal counterparts share compiled kernels, and those of one scene a loop.
    `size` numbers start at `first` in the parameter array.
    """

    precision: str
    size = 0
    # of obstacles only (obstacle.py): is there friction, is stiffness per area, does it turn, is nearness noted?
    friction, per_area, turns, watched = False, False, False, False
    corners = 0  # of an obstacle's shape, places behind its numbers: as many as are nearest to a point

    fp = number_type

    @ti.func
    def energy(self, parameters: ti.template(), first, X, u):
        """Potential energy [J]."""

    @ti.func
    def force(self, parameters: ti.template(), first, X, u, v):
        """Force [N]."""

    @ti.func
    def force_jvp(self, parameters: ti.template(), first, X, u, v, du, dv):
        """Change of the force for changes du, dv."""

    @ti.func
    def force_vjp(self, parameters: ti.template(), first, X, u, v, w):
        """(adjoint of u, adjoint of v) for the adjoint w of the force."""

    @ti.func
    def parameter_derivatives(self, parameters: ti.template(), first, X, u, v):
        """Derivatives of the force by the term's own numbers: a tuple of `size` vectors."""


def positive(argument: str, value: ArrayLike, unit: str, plain: str = "") -> Input:
    """One number > 0, which errors call by its argument."""
    present(argument, value)
    return Input(argument, value, ((),), unit, POSITIVE, plain=plain, label=f"{argument} [{unit}]")


def place(argument: str, value: ArrayLike, plain: str) -> Input:
    """A point of an obstacle's shape: 3 numbers [m]."""
    present(argument, value)
    return Input(argument, value, ((3,),), "m", change=length, plain=plain, axes="xyz")


def extent(argument: str, value: ArrayLike, plain: str) -> Input:
    """A size of an obstacle's shape: one number > 0 [m]."""
    present(argument, value)
    return Input(argument, value, ((),), "m", POSITIVE, plain=plain)


def chosen_width(mesh: TetrahedralMesh) -> float:
    """The width of a barrier whose width is left to the scene [m]: 1 % of the smallest body, with three digits."""
    return float(f"{0.01 * mesh.body_size:.3g}")
