"""What acts on a body beside its own stress and contact: each kind of force is said once, and all solvers read it here.

An `Interaction` holds all terms of its kind in a scene: how their inputs become numbers that kernels read, which vertices
they act on, where adjoints go and how these come back to the scene's numbers. Its `kernel` is what kernels are compiled
for, and equal ones share compiled kernels. Inputs, explicit steps, their tangents and adjoints, and batches loop over the
interactions of a scene (mechanics/interactions.py lists the kinds). Implicit steps, statics, bounds of the stable step and
outputs loop over their host forms (host_force.py), which `host` gives. So a new force is a folder of its own and nothing
elsewhere.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import taichi as ti

from diffsim_ti.inputs import Derived, Link
from diffsim_ti.mechanics.host_force import HostForce
from diffsim_ti.runtime import A, cross, number_type, traced, vector_type

if TYPE_CHECKING:
    from diffsim_ti.scene import Scene
    from diffsim_ti.terms import Term


@dataclass(frozen=True)
class ForceKernel:
    """Taichi functions of one kind of force in a pass. Vectors have four components, the last zero. Taichi's compiler fails
    for x -= y and -x of vectors: write x = x - y and ti.cast(-1, self.fp) * x.

    arrays: {array of the scene that they read: kind}, as in `runtime.array_types`, without numbers that inputs change;
    derived: the same of these, arrays of `Derived`; adjoints: {array that they add to: kind}.
    """

    precision: str

    name: ClassVar[str]  # of its counts
    arrays: ClassVar[dict[str, str]] = {}
    derived: ClassVar[dict[str, str]] = {}
    adjoints: ClassVar[dict[str, str]] = {}
    is_load: ClassVar[bool] = True  # whether it does work on the body from outside
    pulls: ClassVar[bool] = False  # whether this may be counted as energy of the body's own as well
    reads_rates: ClassVar[bool] = False  # whether forces at corners are of velocities too
    reads_rest: ClassVar[bool] = False
    at_corners: ClassVar[bool] = True
    asks_for_steps: ClassVar[bool] = False  # whether it reads numbers over time
    apart: ClassVar[bool] = False  # whether launches of their own compute them before each pass

    fp, vector, cross = number_type, vector_type, staticmethod(cross)

    @traced
    def sizes(self, plan) -> dict:
        """{array of vectors of which each scene of a batch has its own: how many one of its rows has}; kernels of batches
        know the length of a row of each of `derived` as len_<name>."""
        return {name: getattr(plan, f"len_{name}") for name in self.derived}


@dataclass(frozen=True)
class ItemForce(ForceKernel):
    """Forces of items such as triangles or springs: item k writes to corners of its own, from corner `first` of the kind on,
    and vertices gather these with the corners of tetrahedra. s: the slot of the state before the pass, whose numbers are
    `now`."""

    @property
    def counts(self) -> tuple[str, ...]:
        """Names of the whole numbers that kernels take: how many items, and the first of their corners."""
        return f"num_{self.name}", f"first_{self.name}"

    @traced
    def count(self, plan):
        """How many items there are."""
        return getattr(plan, f"num_{self.name}")

    @traced
    def first(self, plan):
        return getattr(plan, f"first_{self.name}")

    def alone(self) -> "ItemForce":
        """For batches, in which items go one by one."""
        return self

    @ti.func
    def forces(self, k, now: A, scene: A, state: A, s, plan: A):
        """Writes forces [N] to scene.corner."""

    @ti.func
    def forces_jvp(self, k, now: A, scene: A, state: A, s, tangent: A, plan: A):
        """Writes their change to scene.corner."""

    @ti.func
    def forces_vjp(self, k, now: A, scene: A, state: A, s, adjoint: A, plan: A):
        """Writes products of the transposed derivatives with adjoint.w to adjoint.corner, of those by velocities to
        adjoint.rate_corner, and adds the adjoints of numbers."""


@ti.func
def edges(corners: A, t, x: A, rest: A, s):
    """x_1 - x_0 and x_2 - x_0 of the corners of triangle t, of rest + x in slot s."""
    i, j, k = corners[3 * t], corners[3 * t + 1], corners[3 * t + 2]
    return (rest[j] - rest[i]) + (x[s, j] - x[s, i]), (rest[k] - rest[i]) + (x[s, k] - x[s, i])


@ti.func
def store_alike(force, corner: A, first, t):
    """The same force for all corners of triangle t."""
    for a in ti.static(range(3)):
        corner[first + 3 * t + a] = force


@dataclass(frozen=True)
class VertexwiseForce(ForceKernel):
    """Forces at each vertex i by its own displacement u and velocity v."""

    is_load, at_corners = False, False

    @ti.func
    def force(self, i, u, v, now: A, scene: A):
        """[N]"""

    @ti.func
    def force_jvp(self, i, u, v, du, dv, now: A, scene: A, tangent: A):
        """Its change."""

    @ti.func
    def force_vjp(self, i, u, v, w, now: A, scene: A, adjoint: A):
        """(adjoint of u, adjoint of v) for the adjoint w of the force; adds the adjoints of numbers."""


class Interaction:
    """All terms of one kind in a scene.

    vertices: the vertex of each corner that its items write, shape (corners,); none where it acts vertex by vertex.
    first_load: its corners are loads from here on. count: number of items.
    topology: {array on the device: whole numbers or floats}, what kernels read that no input changes.
    """

    name: ClassVar[str]  # of its counts in kernels: num_<name> items, whose corners begin at first_<name>
    kinds: ClassVar[tuple[type, ...]] = ()  # classes of its terms
    derived: ClassVar[dict[str, str]] = {}  # {array of `Derived`: kind}: "vectors2", rows of steps, or "vectors"
    works: str = ""  # in words, by what it may do work on the body, or take energy from it
    is_load = True  # whether it is a load that is given, maybe over time
    apart: ClassVar[bool] = False  # whether launches of their own, before or after each pass, compute it
    vertices: np.ndarray = np.zeros(0, np.int64)
    first_load = count = 0
    pulls = False  # whether its loads may be counted as energy of the body's own as well
    in_kernels = True  # whether explicit steps take it by its kernel; else a stage of theirs knows its terms
    on_host = True  # whether it has a host form; else implicit steps know its numbers
    no_equilibrium: ClassVar[str] = ""  # why statics refuse it

    def __init__(self, scene: "Scene", terms: "tuple[Term, ...]"):
        self.scene, self.mesh, self.terms = scene, scene.mesh, terms

    acts_at: "np.ndarray | slice" = slice(None)  # vertices, of what acts vertex by vertex

    @property
    def topology(self) -> dict[str, np.ndarray]:
        return {}

    @property
    def counts(self) -> dict[str, int]:
        """More whole numbers that kernels take."""
        return {}

    def links_of(self, term: "Term", names: dict[str, str], own: str, consistent: bool) -> list[Link]:
        """Those of one of its terms, as `Term.links`; consistent: whether masses are."""
        return term.links(names, own)

    def links(self, own: "dict[Term, str]") -> list[Link]:
        """What joins the numbers of its terms to the arrays of `derived`; own: {term: beginning of the names of its own}."""
        return []

    @property
    def makes_rows(self) -> bool:
        """Whether a run of one step asks its links for the rows of that step."""
        return self.is_load and "vectors2" in self.derived.values()

    def features(self, values: Derived, in_steps: bool) -> dict[str, bool]:
        """Fields of `Features`, where kernels have something else of it than `kernel`; in_steps: of implicit ones."""
        return {}

    def kernel(self, values: Derived, precision: str, shape: bool) -> ForceKernel:
        """What kernels are compiled for, at the values of a run; shape: whether adjoints of the rest shape are wanted."""
        raise NotImplementedError

    def host(self) -> HostForce:
        """Its host form, for implicit steps and statics, stable steps, energies and outputs."""
        raise ValueError(f"{type(self).__name__} has no `host`, which all solvers ask for: write it (host_force.py)")

    def check_solver(self, solver) -> None:
        """Raise ValueError where a solver does not support it."""

    def adjoints(self, values: Derived, shape: bool) -> dict[str, tuple[int, ...]]:
        """{array of vectors that adjoints are added to: its shape}"""
        return {}

    def collect(self, found: dict[str, np.ndarray], out: Derived, shape: bool) -> None:
        """Add to `out` what these arrays hold, vectors of three numbers in float64; in batches all have one axis of scenes
        in front."""

    def pulls_steadily(self, values: Derived) -> bool:
        """Of loads that pull: whether they do so in all steps alike."""
        return True

    def added_omega2(self, values: dict[str, np.ndarray], derived: Derived) -> float:
        """What it adds to the body's largest omega^2 [1/s^2] at most, beside the sums of rows of its host form; at values of
        inputs that are the stiffest of all steps, which need not have others over time."""
        return 0.0


def add_at(target: np.ndarray, places: np.ndarray, rows: np.ndarray) -> None:
    """target[..., places, :] += rows, of places that may repeat."""
    np.add.at(target, (..., places, slice(None)), rows)
