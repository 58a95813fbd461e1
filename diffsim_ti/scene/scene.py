"""Scene: what is simulated, and nothing about how."""

from collections.abc import Iterable, Mapping
from copy import copy
from typing import Literal, TypedDict

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import Unpack

from diffsim_ti import runtime
from diffsim_ti.common.checked import as_numbers, instance, listed, number, numbers
from diffsim_ti.common.copies import MadeAgain
from diffsim_ti.common.origin import middle_far_part, warn_of_coarse_places
from diffsim_ti.inputs import ConsistentMass, Inputs
from diffsim_ti.materials.grown import grown
from diffsim_ti.materials.material import Material
from diffsim_ti.materials.moduli import youngs_poisson
from diffsim_ti.materials.patch_law import PatchLaw
from diffsim_ti.mechanics.energy.assembled import body_stiffness
from diffsim_ti.mechanics.interaction import Interaction
from diffsim_ti.mechanics.interactions import NUMBERS, interactions_of
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.sets import values_of_sets
from diffsim_ti.scene.locking import LOCKING_RATIO, warn_if_locking
from diffsim_ti.terms import Chamber, Drag, Gravity, Growth, MultiPointConstraint, Obstacle, SelfContact, Term, Tie
from diffsim_ti.terms.glued import Glued
from diffsim_ti.terms.mass_scaling import MassScaling
from diffsim_ti.terms.obstacles.obstacle import PER_AREA
from diffsim_ti.terms.over_time import Motion
from diffsim_ti.terms.pose import Pose, sampled_path
from diffsim_ti.terms.reduced import Reduced
from diffsim_ti.terms.supports import Fixed, Supports

__all__ = ["LOCKING_RATIO", "Scene"]


def _kind(term) -> tuple:
    """What kernels go through terms by: obstacles last, each kind's together, so that the order of a list means nothing."""
    return term.acts_on_surface, type(term).__qualname__, type(term).__module__, term.variant


def _with_companions(terms: Iterable) -> tuple:
    """Terms and what comes with them, each once."""
    out = list(terms)
    out += [part for term in out for part in getattr(term, "companions", ()) if not any(part is other for other in out)]
    return tuple(out)


def _density(given: ArrayLike | Mapping[str, float] | None, mesh: TetrahedralMesh, material: Material) -> ArrayLike:
    """One number or one per tetrahedron, from those of sets too; the material's where none is given."""
    if given is None:
        return material.density
    if not isinstance(given, Mapping):
        return given
    if not given:
        raise ValueError('density: the dict is empty; name tetrahedron sets, or give a number for "default"')
    for name, value in given.items():
        number(f"density[{name!r}]", value, unit="kg/m^3")
    return values_of_sets("density", given, mesh)


class SceneArguments(TypedDict, total=False):
    """What `Scene` takes, by name: what `Scene.replace` and `Rollout.with_scene` replace."""

    mesh: TetrahedralMesh
    material: Material
    density: ArrayLike | Mapping[str, float] | None
    terms: Term | Iterable[Term]
    fixed: Fixed | None
    motion: Motion | Pose | Mapping[str, Motion | Pose] | None
    initial_positions: ArrayLike | None
    initial_velocities: ArrayLike | None
    precision: Literal["f32", "f64"] | None
    volume: Literal["tetrahedra", "patches"]
    mass_scaling: float | None
    reduced: Mapping[str, str | ArrayLike] | None


class Scene(MadeAgain):
    """A body, its material and what acts on it. Frozen: build another scene instead of changing one.

    mesh: TetrahedralMesh, the rest shape.
    material: a law with its numbers (materials/).
    density [kg/m^3]: one number, one per tetrahedron, or {tetrahedron set: number}, such as bodies by name; default that of
        the material, which is 1000 of laws without a density of their own. Vertices carry the lumped mass sum rho V / 4.
        Ten-node tetrahedra have consistent masses and weight, lumped ones (HRZ) in explicit steps.
    terms: loads, contacts, damping (terms/); gravity, drag, a rotating frame and self-contact at most once. What is not
        listed costs nothing. Their order means nothing but that of obstacles of one kind, whose forces and frictions act
        one after the other. Names of terms, each another (Ground(name="floor")), begin the names of their inputs:
        "floor.stiffness".
    fixed: vertices that do not move freely: a vertex set's name, indices, a Boolean mask or a list of set names. Or
        {name of a vertex or surface set: in which directions it is fixed}: axes such as "x" or "xyz", a direction (3
        numbers) or several, or "normal" of a flat surface set; so are rollers and symmetry planes made.
    motion: displacement of the fixed vertices from where they start: a function of time [s] that returns 3 numbers or shape
        (num_held, 3) [m], or keyframes (times, displacements) between which it is linear; of what is held in some
        directions, only those count. Or a `Pose`, which turns them; or, where `fixed` names sets, {name: such a motion}.
    initial_positions [m], initial_velocities [m/s]: shape (num_vertices, 3) or 3 numbers (velocities); default at rest.
        Fixed vertices stay at initial_positions whatever rest_positions a run takes; `Rollout.forward(shape=...)` moves
        both.
    precision: "f32", "f64" or None for the default that `diffsim_ti.init` set.
    volume: where a change of volume is resisted: in each of the "tetrahedra", which lock as Poisson's ratio nears 0.5, or
        on average over "patches" of up to eight, which lock much less (patched_tetrahedron.py).
    mass_scaling: the share of the mass, such as 0.01, that may be added to the vertices that limit explicit steps
        (mass_scaling.py): bad tetrahedra then do not rule. Gravity acts on it, so that free fall stays as it is; weight and
        reactions grow by the share. By which factors vertices are heavier is found for the numbers given here, and kept
        whatever values a run takes; gradients by density and rest shape are those of such masses. `describe()` says how
        much was added. Implicit steps and static solves add none.
    reduced: {name of a tetrahedron or vertex set: "affine"}: its vertices move by twelve numbers, x = X + A X + t, in every
        solver. "rigid": by six, turned and moved, in every solver. Or a basis, in every solver: weights of a
        `designs.Cage`, the shapes of `modes`. Of a start only the admissible motions of a set count (reduced.py).

    Raises ValueError with rule, value and remedy for what no solver takes, and runs no kernel. What one kind of solver does
    not support its constructor refuses, and what an output does not, that of `Rollout`. Warns where tetrahedra lock, above
    Poisson's ratio 0.45.

    >>> import diffsim_ti as ds
    >>> mesh, material = ds.TetrahedralMesh.create_cube(resolution=2), ds.StableNeoHookean(E=1e5, nu=0.3)
    >>> scene = ds.Scene(mesh, material, density=1200.0, terms=[ds.Gravity(), ds.Drag(2.0)], fixed="ymin", precision="f64")
    >>> list(scene.inputs.described)[2:]
    ['youngs_modulus', 'poissons_ratio', 'density', 'gravity', 'drag_rate', 'rest_positions']
    >>> print(f"{scene.mass_matrix().diagonal().sum() / 3:.1f} kg")
    1200.0 kg
    """

    def __init__(
        self,
        mesh: TetrahedralMesh,
        material: Material,
        density: ArrayLike | Mapping[str, float] | None = None,
        terms: Term | Iterable[Term] = (),
        fixed: Fixed | None = None,
        motion: Motion | Pose | Mapping[str, Motion | Pose] | None = None,
        initial_positions: ArrayLike | None = None,
        initial_velocities: ArrayLike | None = None,
        precision: Literal["f32", "f64"] | None = None,
        volume: Literal["tetrahedra", "patches"] = "tetrahedra",
        mass_scaling: float | None = None,
        reduced: Mapping[str, str | ArrayLike] | None = None,
    ):
        self.arguments = {name: value for name, value in locals().items() if name != "self"}
        self.mesh = instance("Scene", "mesh", mesh, TetrahedralMesh, "a TetrahedralMesh")
        self.material = instance(
            "Scene", "material", material, Material, "a material such as StableNeoHookean(1e5, 0.3)"
        )
        self.precision = runtime.check_precision(precision)
        if volume not in ("tetrahedra", "patches"):
            raise ValueError(f'volume must be "tetrahedra" or, against locking, "patches", got {volume!r}')
        self.volume = volume
        density = _density(density, mesh, self.material)
        self.terms = _with_companions(
            [terms] if isinstance(terms, Term) else listed("terms", terms, "terms such as Gravity()")
        )
        self.supports = Supports(mesh, fixed)
        self.fixed, self.held = self.supports.fixed, self.supports.vertices  # in all directions; in some
        self.motion, (self.posed_supports, self.translates) = motion, self.supports.parts_of(motion)
        ties = tuple(term for term in self.terms if isinstance(term, Tie))
        glued = (Glued.of(mesh, ties, self.supports, self.supports.moved(motion)),) if ties else ()
        self.reduced = Reduced(mesh, reduced, self.held, glued)
        self._check_terms()
        self._given = self.arguments["terms"] = self.terms
        settled = (t.settled(self, density, initial_positions, initial_velocities) for t in self.terms)
        self.terms = tuple(copy(t) for t in settled)  # one that is listed twice is two
        self.ordered_terms = tuple(sorted(self.terms, key=_kind))
        self.moving = tuple(t for t in self.ordered_terms if t.path is not None)
        if self.term(Growth):
            self.material = grown(self.material, volume)
        self.law  # noqa: B018 - refuses what its volume does not support
        self.interactions = interactions_of(self)
        self.origin = middle_far_part(mesh.vertices) if self.precision == "f32" else np.zeros(3)  # origin.py
        self.mass_scaling = None if mass_scaling is None else MassScaling.of(self, density, mass_scaling)
        self.inputs = Inputs(self, density, initial_positions, initial_velocities)
        self._check_start()
        warn_of_coarse_places(self)
        if volume == "tetrahedra":
            warn_if_locking(self)

    @property
    def law(self):
        """The law that kernels are compiled for."""
        law = self.material.law(self.precision)
        return PatchLaw(self.precision, law) if self.volume == "patches" else law

    def _twin(self) -> "Scene":
        out = Scene.__new__(Scene)
        vars(out).update(vars(self))
        return out

    consistent = False  # whether masses and weight are consistent
    own_numbers = tuple(NUMBERS)  # arrays of `Derived` that known kinds of interactions have of their own

    def with_consistent_mass(self) -> "Scene":
        """The scene as static solves, implicit steps and modes have it: ten-node tetrahedra with consistent masses and
        weight, and no mass that was added for the sake of an explicit step."""
        if (self.mesh.order == 1 or self.consistent) and self.mass_scaling is None:
            return self
        out, given = self._twin(), self.arguments
        out.consistent, out.mass_scaling = self.mesh.order > 1, None
        density = _density(given["density"], self.mesh, self.material)
        out.inputs = Inputs(out, density, given["initial_positions"], given["initial_velocities"])
        return out

    def with_values(self, values: Mapping[str, ArrayLike]) -> "Scene":
        """The scene with other numbers of inputs, for what is asked of it once; `replace` goes back to its own."""
        if not values:
            return self
        out = self._twin()
        out.inputs = copy(self.inputs)
        out.inputs.values = self.inputs.values | self.inputs.check(values)
        return out

    def with_each(self, values: Mapping[str, ArrayLike] | None) -> list["Scene"]:
        """The scenes of a `Batch`, whose inputs `values` have the axis of scenes in front; this one alone without any."""
        if values is None:
            return [self]
        instance("scenes", "values", values, Mapping, 'inputs by name, {"youngs_modulus": [1e4, 2e4]}')
        if not values:
            return [self]
        own = {name: as_numbers(name, x) for name, x in values.items()}
        lengths = {name: len(x) if x.ndim else 0 for name, x in own.items()}
        if min(lengths.values()) == 0 or len(set(lengths.values())) > 1:
            said = ", ".join(f"{name} {x.shape}" for name, x in own.items())
            raise ValueError(f"values: expected arrays with one axis of scenes in front, got shapes {said}")
        count = next(iter(lengths.values()))
        return [self.with_values({name: x[b] for name, x in own.items()}) for b in range(count)]

    def replace(self, **changes: Unpack[SceneArguments]) -> "Scene":
        """A scene with some arguments replaced."""
        return Scene(**self.arguments | changes)

    def _check_terms(self) -> None:
        for term in self.terms:
            if not isinstance(term, Term):
                raise ValueError(f"terms must be diffsim_ti terms such as Gravity(), got {term!r}")
            term.check(self.mesh)
        for kind in (Gravity, Drag, SelfContact):
            if sum(isinstance(t, kind) for t in self.terms) > 1:
                raise ValueError(f"a scene takes one {kind.__name__}, got several; add their numbers instead")
        named = [t for t in self.terms if t.name is not None]
        for k, term in enumerate(named):
            for other in (t for t in named[:k] if t.name == term.name):
                raise ValueError(f"two terms have the name {term.name!r}: {other!r} and {term!r}; give each its own")
        if self.motion is not None and len(self.held) == 0:
            raise ValueError("motion moves the fixed vertices, but none is fixed; pass fixed=...")
        if self.motion is not None:
            self.motion_rows([0.0])

    def _check_start(self) -> None:
        surface, positions = self.mesh.surface_vertices, self.inputs.values["initial_positions"]
        places = self.places(0.0)
        for term in self.terms:
            term.check_start(positions, surface, *([places[term]] if term in places else []))

    def largest_poissons_ratio(self) -> float:
        """Poisson's ratio of small strains, the largest of all tetrahedra, whatever numbers the law is given by."""
        values = self.inputs.values
        mu, lam = self.material.lame({name: values[name] for name in self.material.inputs})
        return float(np.max(youngs_poisson(mu, lam)[1]))

    def input_names(self, term: Term) -> dict[str, str]:
        """{plain name of a term's input: its name in this scene}, paths included: a second obstacle's end in _2, those of
        a term with a name begin with it."""
        for terms in (self.terms, self._given):
            if term in terms:
                return self.inputs.names_of(terms.index(term))
        raise ValueError(f"this scene does not list {term!r}; it has {', '.join(map(repr, self.terms)) or 'no terms'}")

    def input_tensors(self) -> dict[str, object]:
        """{name of an input: tensor} of the terms' numbers that were given as tensors; their graphs stay with them."""
        return {
            self.inputs.names_of(k)[plain]: tensor
            for k, term in enumerate(self._given)
            for plain, tensor in term.tensors.items()
        }

    def motion_rows(self, times: ArrayLike) -> np.ndarray:
        """Displacement of the fixed vertices from their start, without that of poses, shape (len(times), num_held, 3)
        [m]."""
        return self.supports.rows(self.motion, times)

    def path_rows(self, times: ArrayLike) -> dict[str, np.ndarray]:
        """Path of each moving obstacle at each time [s], by input name, shape (len(times), 3, 6 or 7) [m]."""
        names = self.inputs.paths
        return {name: sampled_path(name, t.path, times) for name, t in zip(names, self.moving)}

    def places(self, time: float) -> dict[Term, np.ndarray]:
        """Displacement or pose of each moving obstacle at a time [s], shape (3,), (6,) or (7,) [m]; of those that a robot
        moves that at the start."""
        led = {term: term.led for term in self.ordered_terms if term.led is not None}
        return led | {term: sampled_path(term.path_name, term.path, [time])[0] for term in self.moving}

    # ---- its terms, by kinds and by names ----------------------------------------------------------------------------

    def interaction(self, kind: type[Interaction]) -> Interaction | None:
        """What acts on the body of one kind, all terms of it together, or None."""
        return next((x for x in self.interactions if isinstance(x, kind)), None)

    @property
    def obstacles(self) -> tuple[Term, ...]:
        """The terms that act on the surface by distance, in the order of frames' contact forces."""
        return tuple(t for t in self.ordered_terms if t.acts_on_surface)

    def place_of(self, obstacle: Term | str) -> int:
        """Place in `obstacles` of one that is given by its name, or as the scene lists it."""
        return self.place_among(self.obstacles, obstacle, "obstacle")

    def term(self, kind: type) -> Term | None:
        """The scene's first term of a kind, or None."""
        return next((t for t in self.terms if isinstance(t, kind)), None)

    def terms_of(self, *kinds: type) -> tuple[Term, ...]:
        """Its terms of each of some kinds, in the order in which kernels go through them."""
        return tuple(t for kind in kinds for t in self.ordered_terms if isinstance(t, kind))

    @property
    def holds_volumes(self) -> bool:
        """Whether some chamber holds a given volume."""
        return any(t.holds for t in self.terms_of(Chamber))

    @property
    def has_multipliers(self) -> bool:
        """Whether implicit steps find Lagrange multipliers: of volumes, or of relations that are held exactly."""
        return self.holds_volumes or any(t.is_exact for t in self.terms_of(MultiPointConstraint))

    def place_among(self, own: tuple[Term, ...], asked: Term | str, kind: str) -> int:
        """Place among some of its terms of one that is given by its name, or as the scene lists it."""
        for k, term in enumerate(own):
            if asked is term or asked is self._given[self.terms.index(term)] or asked == (term.name or term):
                return k
        known = ", ".join(repr(t.name or t) for t in own) or "none"
        raise ValueError(f"this scene has no {kind} {asked!r}; it has {known}: give them a name=")

    def chamber_volume(self, chamber: Term | str, positions: ArrayLike | None = None) -> float:
        """Volume [m^3] of a chamber, given by its name or as the scene lists it, at positions [m], default at rest."""
        own, rest = self.terms_of(Chamber), self.mesh.vertices
        u = None if positions is None else np.asarray(positions, np.float64) - rest
        return own[self.place_among(own, chamber, "chamber")].enclosure.volume(rest + self.checked_displacements(u))

    def checked_displacements(self, displacements: ArrayLike | None) -> np.ndarray:
        """Displacements from the rest shape [m], shape (num_vertices, 3); None: zero."""
        shape = self.mesh.vertices.shape
        u = np.zeros(shape) if displacements is None else numbers("displacements [m]", displacements)
        if u.shape != shape or not np.all(np.isfinite(u)):
            raise ValueError(f"displacements: expected finite numbers [m] of shape {shape}, got shape {u.shape}")
        return u

    # ---- matrices ----------------------------------------------------------------------------------------------------

    def stiffness_matrix(self, displacements: ArrayLike | None = None):
        """K = d2E/du2 [N/m] of the body's stress, springs, cables and elastic foundations at displacements [m] from the rest
        shape, default none, shape (num_vertices, 3), as a SciPy CSR matrix of all 3 num_vertices unknowns, x, y, z of vertex
        0 first, in float64.

        Fixed vertices have their rows: strike them out. Tensions and lengths over time are those of time 0; a tension T adds
        T / |d| across its segments d. What obstacles, self-contact and pressures add is not in it.
        Raises ValueError for shapes that do not fit, or a law that reads more than the displacement gradient.
        Zienkiewicz, Taylor, The Finite Element Method, vol. 2, 5th ed., 2000, sec. 10.3.
        """
        if self.law.in_steps().reads != ("H",) or self.law.state_names:
            raise ValueError(
                f"{type(self.law).__name__} is more than an energy of the displacement gradient: it has no K"
            )
        scene = self if self.precision == "f64" else self.replace(precision="f64")
        return body_stiffness(scene, self.checked_displacements(displacements))

    def mass_matrix(self):
        """M [kg] as a SciPy CSR matrix of all 3 num_vertices unknowns, in float64: lumped and diagonal of linear tetrahedra,
        without what `mass_scaling` adds for explicit steps; consistent of ten-node tetrahedra, as implicit steps have it."""
        from scipy.sparse import diags, eye, kron

        inputs = self.with_consistent_mass().inputs
        derived = inputs.derive(inputs.values)
        if derived.element_masses is None:
            return diags(np.repeat(derived.mass, 3)).tocsr()
        return kron(ConsistentMass.of(self.mesh, derived.element_masses).matrix, eye(3)).tocsr()

    def describe(self) -> str:
        """What is simulated, in a few lines."""
        mass, terms = self.inputs.derive(self.inputs.values).mass.sum(), ", ".join(map(repr, self.terms)) or "none"
        patches, partly = ", volume averaged over patches" * (self.volume == "patches"), len(self.supports.partly_fixed)
        lines = [f"{self.mesh!r}", f"{self.material!r}{patches}", f"mass {mass:.6g} kg, precision {self.precision}"]
        lines += [f"terms: {terms}", *([str(self.mass_scaling)] if self.mass_scaling else [])]
        fixed = f"fixed vertices: {len(self.fixed)}" + (f", in some directions {partly}" if partly else "")
        lines.append(fixed + (", moving" if self.motion is not None else ""))
        lines += [f"moving by few numbers: {self.reduced.describe()}"] if self.reduced else []
        for t in (t for t in self.terms if isinstance(t, Obstacle) and t.chooses_stiffness):
            said = f"stiffness per area {float(t.values[PER_AREA]):.4g} N/m^3 of {type(t).__name__}"
            lines.append(f"chosen from weight and speed: {said}")
        by_pairs = ", ".join(type(t).__name__ for t in self.terms if t.primitives is not None)
        lines += [f"by pairs, also between vertices: {by_pairs}"] if by_pairs else []
        inputs = ", ".join(f"{name}{i.in_brackets}" for name, i in self.inputs.described.items())
        return "\n".join([*lines, f"inputs: {inputs}"])

    def __repr__(self) -> str:
        return f"Scene({self.mesh!r}, {self.material!r}, terms=[{', '.join(map(repr, self.terms))}])"
