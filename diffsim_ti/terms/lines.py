"""Springs and cables: line elements between points of the body, and between these and points fixed in space."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import TypeAliasType

from diffsim_ti.common.checked import numbers, present
from diffsim_ti.common.public import Public
from diffsim_ti.inputs import Input, Link
from diffsim_ti.inputs.description import Range, at_least_0, length
from diffsim_ti.inputs.lines import LineRows, Segments
from diffsim_ti.inputs.loads import InTime
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.paths import Paths
from diffsim_ti.terms.marks import Lines, Points
from diffsim_ti.terms.over_time import GivenOverTime, OverTime, amount
from diffsim_ti.terms.term import OnMesh, Term

AT_LEAST_0 = Range(">= 0", at_least_0, in_runs=False)  # differences about 0 step below it


class Anchor(metaclass=Public):
    """A point fixed in space, or several: position [m], shape (3,) or (k, 3). Springs and cables may end there.

    Raises ValueError for other shapes and what is not finite.
    """

    def __init__(self, position: ArrayLike):
        given = position.detach().cpu().numpy() if hasattr(position, "detach") else position
        value = numbers("Anchor: position [m]", given)
        if value.shape[-1:] != (3,) or value.ndim > 2 or not np.all(np.isfinite(value)):
            raise ValueError(f"Anchor: position must be finite, of shape (3,) or (k, 3) [m], got shape {value.shape}")
        self.given, self.position = position, value

    def __repr__(self) -> str:
        return f"Anchor({self.position.tolist()})"


Point = TypeAliasType("Point", int | str | ArrayLike | Anchor)  # vertices, material points as places at rest, anchors


class LineTerm(OnMesh, Term):
    """What runs along paths through points, with one tension each."""

    num_numbers = 0  # what kernels read of it lies in arrays of its own
    one_sided = False  # whether it pulls only
    by_tension = False  # whether it pulls with a tension that is given, however long it is
    of_fibres = False  # whether each line element is a fibre of a tetrahedron, with a tension that is given

    _found: tuple[TetrahedralMesh, Paths] | None = None

    def paths(self, mesh: TetrahedralMesh) -> Paths:
        """Where its line elements run, found once."""
        if self._found is None or self._found[0] is not mesh:
            self._found = mesh, self.found_paths(mesh)
        return self._found[1]

    def found_paths(self, mesh: TetrahedralMesh) -> Paths:
        """Where its line elements run; ValueError for what does not fit the mesh."""
        raise NotImplementedError

    def check(self, mesh: TetrahedralMesh) -> None:
        self.paths(mesh)

    def drawn(self, moment):
        paths, label = self.paths(moment.mesh), self.name or type(self).__name__.lower()
        points = paths.matrix(moment.mesh.num_vertices) @ moment.positions
        marks = []
        if len(paths.anchored):
            plain = next(i.plain for i in self.described if i.name == "anchors")
            points[paths.anchored] = moment.values[plain]
            marks = [Points(f"{label}, anchored", points[paths.anchored])]
        return [Lines(label, np.stack([points[paths.starts], points[paths.starts + 1]], 1)), *marks]

    def links(self, names: dict[str, str], own: str) -> list[Link]:
        paths, segments, made = self.paths(self.mesh), f"{own} segments", {}
        out = [Segments(paths, self.mesh.num_vertices, self._named(names, "anchors"), segments)]
        for part in ("tension", "length"):
            if (name := self._named(names, part)) is not None:
                made[part] = f"{own} {part} in time"
                out.append(InTime(name, made[part], self.ndim, self.keyed))
        return [*out, LineRows(paths, segments, f"{own} rows", self._named(names, "stiffness"), **made)]

    def sizes(self, mesh):
        return {i.name: len(np.atleast_2d(i.value)) for i in self.described if i.name == "anchors"}

    def _named(self, names: dict[str, str], part: str) -> str | None:
        """Name in the scene of what gives a part of it."""
        plain = next((i.plain for i in self.described if i.name == self.parts.get(part, part)), None)
        return None if plain is None else names[plain]

    parts: dict[str, str] = {}  # arguments that have other words than the links'
    ndim = 2  # of tensions and lengths as rows


def _anchors(given: Sequence[Point], plain: str) -> list[Input]:
    """The input of the places of anchors, if there are some."""
    own = [point for point in given if isinstance(point, Anchor)]
    if not own:
        return []
    value = own[0].given if len(own) == 1 else np.concatenate([np.atleast_2d(point.position) for point in own])
    shapes = (("anchors", 3),) if np.ndim(value) == 2 else ((3,), ("anchors", 3))
    return [Input("anchors", value, shapes, "m", change=length, plain=plain, label="anchors", axes="xyz")]


def _points(mesh: TetrahedralMesh, given: Point, kind: str) -> list[tuple]:
    """(vertices, weights) of each point that is given; anchors have none."""
    if isinstance(given, Anchor):
        return [(np.zeros(0, np.int64), np.zeros(0))] * len(np.atleast_2d(given.position))
    if isinstance(given, str):
        return [(np.array([i]), np.ones(1)) for i in mesh.vertex_indices(given)]
    value = np.asarray(given)
    if value.dtype.kind in "iu" and value.ndim <= 1:
        value = np.atleast_1d(value).astype(np.int64)
        if np.any((value < 0) | (value >= mesh.num_vertices)):
            raise ValueError(f"{kind}: vertices must lie in 0 .. {mesh.num_vertices - 1}, got {value.tolist()}")
        return [(np.array([i]), np.ones(1)) for i in value]
    if value.dtype.kind != "f" or value.ndim not in (1, 2) or value.shape[-1] != 3:
        raise ValueError(
            f"{kind}: a point is a vertex (a whole number), a vertex set's name, a place [m] in the body at rest (3 "
            f"floats), or Anchor(place) in space; got {given!r}"
        )
    located = mesh.locate(np.atleast_2d(value))
    kept = np.abs(located.weights) > 1e-9  # of a point on a vertex, edge or face
    weights = np.where(kept, located.weights, 0.0)
    weights /= weights.sum(1, keepdims=True)
    return [(vertices[k], own[k]) for vertices, own, k in zip(located.vertices, weights, kept)]


class Spring(LineTerm):
    """Linear springs between points, each with the force T = k (L - l) along it, also where it is compressed, and the energy
    k (L - l)^2 / 2; several in one term. L: its length, l: without force.

    start, end: vertices (a number, several, or a vertex set's name), material points (places [m] at rest, shape (3,) or
    (k, 3), floats), or `Anchor`s; as many at both ends, or one at one of them for all.
    stiffness [N/m]: one number or one for each. rest_length [m]: l, one or one for each; default: the length at rest.
    tension [N]: instead of it, the pull at that length (below zero: a push), T = tension + k (L - L_rest).
    Forces on points of the body sum to zero with those of the anchors, and so do their moments.
    Inputs with gradient: "spring_stiffness", "spring_rest_length", "spring_tension", "spring_anchors" where given, or
    "<name>.stiffness" and so on. The rest shape counts through lengths at rest.
    Explicit steps have to follow sqrt(k (1 / m_a + 1 / m_b)), which `stable_dt` takes into account.
    Raises ValueError for numbers of points that do not fit, points outside the body, stiffness or length below zero, and
    rest_length together with tension.
    Zienkiewicz, Taylor 2000, The Finite Element Method, vol. 2, 5th ed., sec. 10.2 (bars at large displacements).

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> material = ds.StableNeoHookean(E=1e5, nu=0.3)
    >>> spring = ds.Spring(7, ds.Anchor([1.0, 1.0, 1.5]), stiffness=40.0, rest_length=0.25, name="tie")
    >>> scene = ds.Scene(mesh, material, terms=[spring], fixed="ymin", precision="f64")
    >>> print(mesh.vertices[7], scene.terms[0].values["spring_stiffness"])
    [1. 1. 1.] 40.0
    """

    def __init__(
        self,
        start: Point,
        end: Point,
        stiffness: ArrayLike,
        rest_length: ArrayLike | None = None,
        tension: ArrayLike | None = None,
        name: str | None = None,
    ):
        if rest_length is not None and tension is not None:
            raise ValueError("Spring: rest_length and tension both say how it is stretched at rest; give one of them")
        present("Spring: stiffness", stiffness)
        shapes = (), ("k",)
        inputs = [Input("stiffness", stiffness, shapes, "N/m", AT_LEAST_0, plain="spring_stiffness", label="stiffness")]
        if rest_length is not None:
            words = dict(plain="spring_rest_length", label="rest_length")
            inputs.append(Input("rest_length", rest_length, shapes, "m", AT_LEAST_0, **words))
        if tension is not None:
            inputs.append(Input("tension", tension, shapes, "N", plain="spring_tension", label="tension"))
        super().__init__(*inputs, *_anchors((start, end), "spring_anchors"), name=name)
        self.start, self.end = start, end

    parts = {"length": "rest_length"}

    def sizes(self, mesh):
        return super().sizes(mesh) | {"k": len(self.paths(mesh))}

    def found_paths(self, mesh: TetrahedralMesh) -> Paths:
        start, end = (_points(mesh, points, "Spring") for points in (self.start, self.end))
        count = max(len(start), len(end))
        if count == 0 or any(len(points) not in (1, count) for points in (start, end)):
            raise ValueError(f"Spring: start has {len(start)} points and end {len(end)}; give as many, or one for all")
        if all(isinstance(points, Anchor) for points in (self.start, self.end)):
            raise ValueError("Spring: both ends are anchors, and nothing of the body; give a point of it")
        for i in self.described:
            if i.name != "anchors" and i.value.ndim and len(i.value) != count:
                given = f"{i.name} has {len(i.value)} numbers"
                raise ValueError(f"Spring: {given} for {count} springs; give one or {count}")
        start, end = (points * count if len(points) == 1 else points for points in (start, end))
        return Paths.of([[a, b] for a, b in zip(start, end)])


class Cable(GivenOverTime, LineTerm):
    """A cable (tendon) that slides without friction through points, with one tension T along all of it.

    tension [N]: given, T = tension, whatever its length; or length [m]: that without force, of an elastic cable with
    stiffness k [N/m], T = k max(L - length, 0): slack carries nothing. k = E A / length for a cable of section A.
    Over time: one number, one for each step (shape (steps,)), a function of time [s], or keyframes (times, values), a tuple,
    sampled at the steps and linear within each.
    points: two or more, one after the other: vertices (numbers), material points (3 floats [m] each, at rest), `Anchor`s.
    Each pulls on its point with T towards the next and towards the one before, so that forces sum to zero with those of
    the anchors. In load steps of static solves a prescribed tension grows with the loads, a length does not.
    Inputs with gradient: "cable_tension" or "cable_length", "cable_stiffness", "cable_anchors", or "<name>.tension" and
    so on; of the shape given, (steps + 1,) of what is linear within steps. The gradient by a slack cable's numbers is zero.
    Raises ValueError unless either tension, or length and stiffness are given; for fewer than two points, neighbours that
    coincide at rest, points outside the body, what is not finite or below zero.
    Bern, Banzet, Poranne, Coros 2019, Trajectory Optimization for Cable-Driven Soft Robot Locomotion,
    doi:10.15607/RSS.2019.XV.052.
    """

    one_sided, stiffest = True, staticmethod(np.max)
    ndim = 1

    def __init__(
        self,
        points: Sequence[Point],
        tension: OverTime | None = None,
        length: OverTime | None = None,
        stiffness: float | None = None,
        name: str | None = None,
    ):
        if (tension is None) == (length is None) or (length is None) != (stiffness is None):
            raise ValueError("Cable: give tension [N], or length [m] together with stiffness [N/m]")
        if len(points) < 2:
            raise ValueError(f"Cable: runs through two points at least, got {len(points)}")
        self.by_tension = by_tension = length is None
        argument, given, unit = ("tension", tension, "N") if by_tension else ("length", length, "m")
        self.stiffest = np.max if by_tension else np.min
        inputs = [amount(argument, given, (), unit, f"cable_{argument}")]
        if not by_tension:
            words = dict(plain="cable_stiffness", label="stiffness")
            inputs.append(Input("stiffness", stiffness, ((),), "N/m", AT_LEAST_0, **words))
        super().__init__(*inputs, *_anchors(points, "cable_anchors"), name=name)
        self.points = list(points)
        self._give(given)
        least = self.rows([0.0]) if self.keyed else inputs[0].value
        if np.any(least < 0):
            raise ValueError(f"Cable: {argument} must be >= 0, for it pulls only, got {float(np.min(least)):g}")

    def found_paths(self, mesh: TetrahedralMesh) -> Paths:
        points, places = [], []
        for given in self.points:
            own = _points(mesh, given, "Cable")
            if len(own) != 1:
                raise ValueError(f"Cable: each of its points is one point, got {given!r}, which are {len(own)}")
            vertices, weights = own[0]
            points += own
            places.append(weights @ mesh.vertices[vertices] if len(vertices) else given.position.reshape(3))
        gaps = np.linalg.norm(np.diff(places, axis=0), axis=1)
        if np.any(gaps <= 1e-9 * np.ptp(mesh.vertices, 0).max()):
            k = int(gaps.argmin())
            raise ValueError(f"Cable: points {k} and {k + 1} coincide at rest; leave one of them out")
        return Paths.of([points])
