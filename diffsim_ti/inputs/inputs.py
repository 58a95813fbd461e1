"""The inputs of a scene: names, values, and what kernels read of them, with derivatives both ways."""

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import numbers
from diffsim_ti.common.names import no_such
from diffsim_ti.common.origin import FAR, ROUNDING, far_part, warn_of_rounding
from diffsim_ti.common.rows import Rows
from diffsim_ti.differentiation.arrays import Node, made
from diffsim_ti.inputs import links
from diffsim_ti.inputs.chain import Chain, Link
from diffsim_ti.inputs.consistent_mass import ElementMasses
from diffsim_ti.inputs.description import POSITIVE, Input, frozen, length, length_per_step, speed
from diffsim_ti.inputs.poses import PoseColumns, PosedMotion
from diffsim_ti.inputs.rest_shape import RestShape, StressPoints
from diffsim_ti.inputs.rigid_start import Displacement, RigidVelocity
from diffsim_ti.inputs.surface_areas import SurfaceAreas

if TYPE_CHECKING:
    from diffsim_ti.scene import Scene


class Derived:
    """What kernels read; also used for tangents and adjoints of the same numbers. None: the scene has no such thing.

    Beside these it has the arrays that interactions have of their own (mechanics/interaction.py), by their names.
    """

    displacement: np.ndarray  # (num_vertices, 3) [m]
    velocity: np.ndarray  # (num_vertices, 3) [m/s]
    coefficients: np.ndarray  # (K,), (num_tetrahedra, K) or (num_tetrahedra, points, K)
    mass: np.ndarray  # (num_vertices,) [kg]
    parameters: np.ndarray  # the numbers of all terms, one after the other
    rest: np.ndarray  # (num_vertices, 3) [m]
    gradients: np.ndarray  # (num_tetrahedra, 3, 3), rows grad N_1..3 [1/m]; of ten nodes (num_tetrahedra, 4, 3, 3)
    volumes: np.ndarray  # (num_tetrahedra,) [m^3]; of ten nodes (num_tetrahedra, 4)
    surface: np.ndarray | None  # (num_vertices,) of the surface, 0 within [m^2]
    forces: np.ndarray | None  # (1 or steps, k, 3), or (1 or steps, 2 k, 3) as each step begins and ends [N]
    motion: np.ndarray | None  # (steps + 1, num_held, 3) [m]
    path: np.ndarray | None  # paths of obstacles (inputs/poses.py), (steps + 1, columns, 3)
    element_masses: np.ndarray | None  # consistent, of ten nodes, (num_tetrahedra, 10, 10) [kg]
    growths: np.ndarray | None  # as each step begins and ends, (1 or steps, 2, 1 or num_tetrahedra) [-]

    def __init__(self, **parts: np.ndarray | None):
        vars(self).update(parts)

    def add(self, other: "Derived", factor: float = 1.0) -> None:
        """Add what another has that is not zero, times a factor."""
        for name, more in other.parts().items():
            if more is not None and more.any():
                own = getattr(self, name)
                setattr(self, name, factor * more if own is None else own + factor * more)

    def parts(self) -> dict[str, np.ndarray | None]:
        """{name: array}"""
        return dict(vars(self))

    def mapped(self, function) -> "Derived":
        """With function(array) in the place of each; None stays."""
        return Derived(**{name: None if part is None else function(part) for name, part in vars(self).items()})

    def replaced(self, **parts: np.ndarray | None) -> "Derived":
        """With others in the place of some."""
        return Derived(**vars(self) | parts)

    def zeros(self, but=()) -> "Derived":
        """The same shapes, all zero; None for those in `but`."""
        parts = vars(self).items()
        return Derived(**{n: None if part is None or n in but else np.zeros(part.shape) for n, part in parts})


class DerivedNode(Node):
    """One whose arrays record what is done to them (differentiation/arrays.py); parents: as of a `Node`."""

    def __init__(self, value: Derived, *parents: tuple):
        super().__init__(value, parents, value.zeros)
        self._arrays = WeakValueDictionary()  # those that are in use: adjoints of rows of one add up in one array

    def __getattr__(self, name: str):
        def pull(seed):
            return lambda into: setattr(into, name, seed if getattr(into, name) is None else getattr(into, name) + seed)

        value, known = getattr(self.value, name), self._arrays.get(name)
        if value is None or known is not None:
            return known
        out = self._arrays[name] = made(value, (self, lambda change: getattr(change, name), pull))
        return out


# the names of the arrays of every scene
READ = tuple(Derived.__annotations__)


class Inputs:
    """The numbers of a scene that a gradient can be asked for: names, values, what kernels make of them.

    `values`: dict of float64 arrays, read-only. Names: initial_positions, initial_velocities, the material's own inputs,
    density, rest_positions, and those of the terms. prescribed_motion and paths of obstacles join per run, sampled at its
    steps. `described`: {name: Input}, those too. Going through it gives the names; printed it is a table of names, shapes,
    units and, of single numbers, values.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3)).inputs
    initial_positions   (8, 3)  m
    initial_velocities  (8, 3)  m/s
    youngs_modulus      ()      Pa      100000
    poissons_ratio      ()      -       0.3
    density             ()      kg/m^3  1000
    rest_positions      (8, 3)  m
    """

    def __init__(
        self,
        scene: "Scene",
        density: ArrayLike,
        initial_positions: ArrayLike | None,
        initial_velocities: ArrayLike | None,
    ):
        self.scene, self.mesh = scene, scene.mesh
        self.length = float(np.ptp(self.mesh.vertices, 0).max())
        self.sizes = {"vertices": self.mesh.num_vertices, "tetrahedra": self.mesh.num_tetrahedra}
        last = {i.plain: i for i in self._at_last()}
        self.described = {i.plain: i for i in self._of_body(density, initial_positions, initial_velocities)}
        self._names = []  # {a term's own name: its name here}, for each term in the order of the scene's list
        for term in scene.terms:
            self._names.append({})
            sizes = term.sizes(self.mesh)
            for i in term.described:
                name = self._names[-1][i.plain] = _free_name(term, i, self.described.keys() | last.keys())
                self.described[name] = i.known(sizes)
        own = (name for x in scene.interactions for name in x.derived)
        self.read = tuple(dict.fromkeys((*READ, *scene.own_numbers, *own)))  # the names of the arrays that kernels read
        self.described |= last
        self.values = self.check({name: i.value for name, i in self.described.items() if i.value is not None})
        named = dict(zip(scene.terms, self._names))
        self._per_step = [name for name, i in self.described.items() if i.is_per_step]
        # obstacles first: scenes that differ in what else acts on them share the kernels that obstacles are in
        terms = sorted(scene.ordered_terms, key=lambda term: not term.acts_on_surface)
        self.parameters = Rows({term: term.num_numbers for term in terms})
        self.paths = [named[term][term.path_name] for term in scene.moving]  # names, in the order of kernels' columns
        self.away = self._away()
        self.keyed = [(named[term][term.plain], term) for term in scene.ordered_terms if term.keyed]
        self.chain = Chain(self._links(named), self.described)

    def __iter__(self) -> Iterator[str]:
        return iter(self.described)

    def __repr__(self) -> str:
        rows = []
        for name, i in self.described.items():
            value = self.values.get(name)
            shape = value.shape if value is not None else i.shapes[0]
            words = f"({', '.join(map(str, shape))})"
            number = f"{float(value):g}" if value is not None and value.size == 1 else ""
            rows.append((name, words, i.unit or "-", number))
        wide = [max(len(row[k]) for row in rows) for k in range(3)]
        return "\n".join("  ".join([*(x.ljust(n) for x, n in zip(row, wide)), row[3]]).rstrip() for row in rows)

    def _of_body(self, density, positions, velocities) -> list[Input]:
        """What every scene has: its start, its material's numbers, its density."""
        n, X = self.mesh.num_vertices, self.mesh.vertices
        velocities = np.zeros(3) if velocities is None else velocities
        velocities = numbers("initial_velocities", velocities)
        if velocities.shape not in ((), (3,), (n, 3)):
            raise ValueError(f"initial_velocities: expected 3 numbers [m/s] or shape {(n, 3)}, got {velocities.shape}")
        velocities = np.broadcast_to(velocities, (n, 3))
        places, per_tetrahedron = (("vertices", 3),), ((), ("tetrahedra",))
        return [
            Input("initial_positions", X if positions is None else positions, places, "m", change=length, axes="xyz"),
            Input("initial_velocities", velocities, places, "m/s", change=speed),
            *self.scene.material.described(self.mesh),
            Input("density", density, per_tetrahedron, "kg/m^3", POSITIVE),
        ]

    def _at_last(self) -> list[Input]:
        """What stands at the end of the list: the rest shape, whose gradient costs extra, and the prescribed motion."""
        out = [Input("rest_positions", self.mesh.vertices, (("vertices", 3),), "m", change=length, axes="xyz")]
        for support, pose in self.scene.posed_supports:
            shape = ("steps + 1", pose.width)
            out.append(Input(support.pose, None, (shape,), "m, rad", change=length_per_step))
            out.append(Input(support.about, pose.about, ((3,),), "m", change=length, axes="xyz"))
        if self.scene.translates:
            shape = ("steps + 1", len(self.scene.held), 3)
            out.append(Input("prescribed_motion", None, (shape,), "m", change=length))
        return out

    def _away(self) -> dict:
        """{moving obstacle: how far its path takes it from where it was made, if that is far} [m] (origin.py)."""
        known = self.scene.precision == "f32"
        places = [(t, row) for t, row in self.scene.places(0.0).items() if t.path is not None]
        return {t: far_part(row[:3], self.length) if known and t.says_places else np.zeros(3) for t, row in places}

    def _origin(self, term) -> np.ndarray:
        """What the places of a term are measured from on the device [m]."""
        origin = self.scene.origin - self.away.get(term, 0.0)
        if origin.any() and term.acts_on_surface and not term.says_places:
            size = float(np.abs(origin).max())
            raise ValueError(
                f"{type(term).__name__} and the body lie {size:.3g} m from the origin, where float32 resolves "
                f"{ROUNDING * size:.2g} m, and none of its inputs says that it is a place: say so of those that are, "
                'Input(..., axes="xyz"), of a height axes="y"; or pass precision="f64", or move everything to within '
                f"{FAR} body lengths of the origin"
            )
        return origin

    def start_links(self) -> tuple[Link, Link]:
        """Of displacements and velocities, as the scene can have them."""
        scene, rigid = self.scene, self.scene.reduced.rigid
        free = lambda v: scene.reduced.of(scene.supports.free(v))  # noqa: E731
        return Displacement(scene.reduced.of, rigid), RigidVelocity(free, rigid) if rigid else links.FreeVelocity(free)

    def _links(self, named: dict) -> list[Link]:
        """Those of the body, of its material, of the terms, and what joins the terms' numbers and paths."""
        mesh, scene, places = self.mesh, self.scene, {}
        shift = np.zeros(max(self.parameters.total, 1))
        factors = scene.mass_scaling.factors if scene.mass_scaling else None
        out = [RestShape(mesh), *self.start_links(), links.LumpedMass(mesh, factors)]
        out += [ElementMasses(mesh.elements)] if scene.consistent else []
        out += scene.material.links()
        if any(term.acts_on_surface for term in scene.terms):
            out.append(SurfaceAreas(mesh))
        all_own = {term: f"parameters of term {k}" for k, term in enumerate(scene.ordered_terms)}
        kind_of = {term: x for x in scene.interactions for term in x.terms}
        for term, own in all_own.items():
            names, rows, kind = named[term], self.parameters.of(term), kind_of.get(term)
            links_of = kind.links_of(term, names, own, scene.consistent) if kind else term.links(names, own)
            out += links_of
            as_they_are = not any(own in link.writes for link in links_of)
            places |= _placed(term, named[term], rows) if as_they_are else {own: rows}
            if as_they_are and rows.stop > rows.start:
                origin = self._origin(term)
                shift[rows] = term.shift(origin)
                for link in term.nearer(origin, self.length, names, own) if scene.precision == "f32" else ():
                    out.append(link)
                    places[link.writes[0]] = places.pop(link.reads[0])
        out += [link for x in scene.interactions for link in x.links(all_own)]
        out.append(links.Placed(places, "parameters", shift))
        if self.paths:
            out.append(PoseColumns(self.paths, "path", self.away.values()))
        if scene.posed_supports:
            out.append(PosedMotion([support for support, _ in scene.posed_supports], len(scene.held), scene.translates))
        elif scene.motion is not None:
            out.append(links.Same("prescribed_motion", "motion"))
        return out

    @property
    def makes_rows(self) -> bool:
        """Whether what changes from step to step is made of inputs together."""
        return any(x.makes_rows for x in self.scene.interactions)

    @property
    def change_in_time(self) -> bool:
        """Whether something of it does, as the scene is given."""
        return any(
            name not in self.values or self.values[name].ndim == len(rule)
            for name in self._per_step
            for rule in self.described[name].shapes
            if "steps" in rule or "steps + 1" in rule
        )

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.values)

    def names_of(self, k: int) -> dict[str, str]:
        """{own name: name here} of the inputs of term k of the scene's list."""
        return dict(self._names[k])

    def no_input(self, name: str, owner: str, names: Iterable[str]) -> str:
        """What to say of a name that no input of `owner` has; a term that has a name gives its inputs others."""
        own = [(of[name], term.name) for of, term in zip(self._names, self.scene.terms) if term.name and name in of]
        if not own:
            return no_such("input", name, names, owner)
        others = " or ".join(f"{new!r}, for a term has the name {word!r}" for new, word in own)
        return f"no input named {name!r}; {owner} has {', '.join(names)}: {name!r} is here called {others}"

    def at_times(self, times: ArrayLike) -> dict[str, np.ndarray]:
        """The values of a run, with those that are sampled at its times [s]."""
        scene = self.scene
        rows = {"prescribed_motion": scene.motion_rows(times)} if scene.translates else {}
        rows |= {support.pose: pose.rows(support.pose, times) for support, pose in scene.posed_supports}
        rows |= scene.path_rows(times) | {name: term.rows(times) for name, term in self.keyed}
        return self.values | {name: frozen(value) for name, value in rows.items()}

    def at_step(self, step: int, dt: float, values: dict | None = None) -> dict[str, np.ndarray]:
        """The values of a run of one step of dt [s], that of number `step`, with some of them replaced; where loads are made
        together, of what is given for each step that step's row."""
        given = values or {}
        out = self.at_times([step * dt, (step + 1) * dt]) | given
        for name in self._per_step:
            if name in given:
                continue
            rules = [rule for rule in self.described[name].shapes if len(rule) == out[name].ndim]
            if any("steps" in rule for rule in rules) and self.makes_rows:
                if step >= len(out[name]):
                    raise ValueError(f"{name} is given for {len(out[name])} steps, this is step {step}")
                out[name] = out[name][step : step + 1]
        return out

    def check(self, values: dict) -> dict[str, np.ndarray]:
        """Float64 arrays of the right shapes, or ValueError naming expected and got."""
        unknown = [name for name in values if name not in self.described]
        if unknown:
            raise ValueError(self.no_input(unknown[0], "this scene", self.described))
        return {name: self.described[name].checked(name, value, self.sizes) for name, value in values.items()}

    def warn_if_coarse(self, name: str, given) -> None:
        """Where a value for a run, as it was given, is places in float32 that are too coarse for the mesh."""
        if self.described[name].axes:
            warn_of_rounding(name, given, self.mesh, "give it in float64")

    def check_steps(self, values: dict, steps: int) -> None:
        """Raise ValueError unless what is given per step has the rows that a run of so many steps reads."""
        for name in self._per_step:
            if name in values:
                self.described[name].check_steps(name, values[name].shape, steps)

    def derive(self, values: dict) -> Derived:
        """What kernels read; arrays that may be kept and handed out again: do not write into them."""
        known = self.chain.value(values)
        return Derived(**{name: known.get(name) for name in self.read})

    def derive_each(self, values: dict, changed: list[dict]) -> list[Derived]:
        """The same for values that differ in some inputs, `changed`, which are the same ones in each."""
        known = self.chain.value(values)
        first = Derived(**{name: known.get(name) for name in self.read})
        changes = (self.chain.again(known, own) for own in changed)
        return [first.replaced(**{name: new[name] for name in self.read if name in new}) for new in changes]

    @property
    def stress_points(self) -> StressPoints:
        """Of the mesh's own rest shape."""
        return StressPoints.of(self.mesh, self.derive(self.values))

    def derive_jvp(self, values: dict, tangents: dict) -> Derived:
        """Change of what kernels read for changes `tangents` of some inputs."""
        changed = self.chain.jvp(values, tangents)
        return self.derive(values).zeros().replaced(**{name: changed[name] for name in self.read if name in changed})

    def derive_vjp(self, values: dict, adj: Derived, wanted: Iterable[str]) -> dict[str, np.ndarray]:
        """Adjoints of the wanted inputs for adjoints of what kernels read; those of coefficients come per tetrahedron."""
        return self.chain.vjp(values, adj.parts(), wanted)


def _free_name(term, described: Input, taken) -> str:
    """Name of a term's input: that of the term, a dot, the argument's; of a term without one the plain name, or with _2."""
    if term.name is not None:
        return f"{term.name}.{described.name}"
    candidate, number = described.plain, 2
    while candidate in taken:
        candidate, number = f"{described.plain}_{number}", number + 1
    return candidate


def _placed(term, names: dict[str, str], rows: slice) -> dict[str, slice]:
    """{name of an input: where its numbers stand} of a term whose kernels take them as they are."""
    out, at = {}, rows.start
    if rows.stop > rows.start:
        for name, value in term.values.items():
            out[names[name]] = slice(at, at + value.size)
            at += value.size
    if at != rows.stop:
        raise ValueError(
            f"{term!r}: kernels take {rows.stop - rows.start} numbers and its inputs have {at - rows.start}; give it links"
        )
    return out
