"""A material: a law with its numbers."""

from abc import abstractmethod
from collections.abc import Mapping
from copy import copy

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import TypeAliasType

from diffsim_ti.common.answers import answered
from diffsim_ti.common.checked import shape_of
from diffsim_ti.common.names import nearest
from diffsim_ti.common.public import Public
from diffsim_ti.differentiation.arrays import as_array, value_of
from diffsim_ti.inputs import Input, Link
from diffsim_ti.inputs.chain import Recording
from diffsim_ti.materials import moduli
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.refinement import Refinement
from diffsim_ti.mesh.sets import values_of_sets

# one number, an array with one per tetrahedron, or {tetrahedron set: number}
PerTetrahedron = TypeAliasType("PerTetrahedron", ArrayLike | Mapping[str, ArrayLike])
_ALIASES = {"E": "youngs_modulus", "nu": "poissons_ratio"}


@answered
class Material(metaclass=Public):
    """A law and its numbers, in one of these spellings, never two together:

    (E, nu) or youngs_modulus= or E= [Pa], > 0, and poissons_ratio= or nu= [-], in (-1, 0.5): those of small strains,
    mu= > 0 and lam= > -2/3 mu [Pa], the Lame parameters,
    or what `spellings` of a material lists beyond. J_floor [-]: where a logarithm of J is continued (`StableNeoHookean`).

    Each number is one number, an array with one per tetrahedron, or a dict {tetrahedron set: number}, where the key
    "default" serves the tetrahedra in none of the sets named.

    A subclass gives `law` and constant matrices `from_lame` (K x 2) from (mu, lam) to the law's K coefficients and
    `to_lame` (2 x K) back. One with numbers of its own lists them in `spellings`, in the order of the law's
    coefficients; a spelling may begin with (youngs_modulus, poissons_ratio), which become mu and lam. `shapes` names
    the numbers that are vectors, such as {"fibre": (3,)}: one of shape (3,) for all, or (num_tetrahedra, 3). `units`
    says the units of numbers that are not in Pa, such as {"exponent": "-", "viscosity": "Pa s"}. `positive` and
    `not_negative` name those that must be so, with a remedy: {"limit": "30 to 100 for rubber"}. `from_own` is a
    constant matrix from a spelling's numbers, vectors spread out, to the coefficients. `lame` says the moduli of small
    strains (those of the stiffest direction), which the limit of explicit steps and the stiffness of a barrier are
    taken from; its derivatives are found from it, so that it takes NumPy functions that record
    (differentiation/arrays.py), and `as_array` in place of np.asarray.

    Raises ValueError with rule, value and remedy.
    """

    spellings = (("youngs_modulus", "poissons_ratio"), ("mu", "lam"))
    shapes: dict[str, tuple] = {}
    units: dict[str, str] = {}
    positive: dict[str, str] = {}
    not_negative: dict[str, str] = {}
    at_points: tuple[str, ...] = ()  # names of numbers that each point of the stresses of ten nodes may have its own of
    from_lame = np.eye(2)
    to_lame: np.ndarray | None = None
    from_own: np.ndarray | None = None  # None: the coefficients are the numbers themselves
    density = 1000.0  # [kg/m^3], of a Scene that is given none
    valid_to = np.inf  # the stretch to which the law is known; runs beyond it warn

    def __init__(self, *numbers: PerTetrahedron | None, J_floor: float | None = None, **named: PerTetrahedron | None):
        if J_floor is not None and not 0 < J_floor < 1:
            raise ValueError(
                f"J_floor must lie in (0, 1), got {J_floor}: 0.01 continues the energy below 1 % of the volume"
            )
        self.J_floor = None if J_floor is None else float(J_floor)
        self._numbers = self._spell(numbers, {key: number for key, number in named.items() if number is not None})
        self._extra = ""
        self.check({name: _all_values(name, number, self.shape_of(name)) for name, number in self._numbers.items()})

    def _spell(self, numbers: tuple, named: dict) -> dict:
        """{input name: number} in the order of the one spelling that fits."""
        usage = " or ".join(f"({', '.join(names)})" for names in self.spellings)
        most = len(self.spellings[0])
        if len(numbers) > most:
            count = "two numbers go without a name (E, nu)" if most == 2 else f"{most} numbers go without a name"
            raise ValueError(f"{self.name}: at most {count}, got {len(numbers)}; use {usage}")
        given = {name: number for name, number in zip(self.spellings[0], numbers) if number is not None}
        for key, number in named.items():
            name = _ALIASES.get(key, key)
            if not any(name in names for names in self.spellings):
                near = nearest(key, [*(x for names in self.spellings for x in names), *_ALIASES])
                meant = f" or did you mean {near!r}?" if near else ""
                raise ValueError(f"{self.name}: no parameter is called {key!r}; use {usage}{meant}")
            if name in given:
                raise ValueError(f"{self.name}: {name} is given twice; keep one")
            given[name] = number
        for names in self.spellings:
            if set(given) == set(names):
                return {name: given[name] for name in names}
        raise ValueError(f"{self.name}: needs exactly one of {usage}, got ({', '.join(given) or 'nothing'})")

    @property
    def name(self) -> str:
        """The class name."""
        return type(self).__name__

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the numbers, as the user gave them: what a gradient can be asked for."""
        return tuple(self._numbers)

    def shape_of(self, name: str) -> tuple:
        """Shape of a number where it is uniform, () unless it is a vector."""
        return self.shapes.get(name, ())

    def unit_of(self, name: str) -> str:
        """Unit of a number."""
        return self.units.get(name, "-" if name == "poissons_ratio" else "Pa")

    @abstractmethod
    def law(self, precision: str):
        """The compile-time law, "f32" or "f64"; equal laws share compiled kernels."""

    def values(self, mesh: TetrahedralMesh) -> dict[str, np.ndarray]:
        """The numbers in float64: shape () where uniform, else (mesh.num_tetrahedra,); vectors have an axis more.

        Raises ValueError for a wrong length, an unknown or overlapping set, or tetrahedra left out.
        """
        values = {}
        for name, number in self._numbers.items():
            each = (mesh.num_tetrahedra, mesh.reference.num_points) if self._is_at_points(name, number) else None
            values[name] = _on_mesh(name, number, mesh, self.shape_of(name), each)
        self.check(values)
        return values

    def spread(self, refinement: Refinement) -> "Material":
        """The same on a finer mesh, whose tetrahedra have the numbers of those that they lie in."""
        if of_points := [name for name, number in self._numbers.items() if self._is_at_points(name, number)]:
            raise ValueError(
                f"{of_points[0]} is given at points, which a finer mesh has others of: give one per tetrahedron"
            )
        out = copy(self)
        out._numbers = {name: refinement.spread(number) for name, number in self._numbers.items()}
        return out

    def described(self, mesh: TetrahedralMesh) -> list[Input]:
        """The inputs of a body of this material: each number (or vector) is one, or one per tetrahedron."""
        shapes = {name: (self.shape_of(name), ("tetrahedra", *self.shape_of(name))) for name in self.inputs}
        points = (("tetrahedra", mesh.reference.num_points),) if mesh.order == 2 else ()
        shapes |= {name: shapes[name] + points for name in self.at_points if name in shapes}
        return [Input(name, value, shapes[name], self.unit_of(name)) for name, value in self.values(mesh).items()]

    def _is_at_points(self, name: str, number) -> bool:
        return name in self.at_points and not isinstance(number, Mapping) and len(shape_of(name, number)) == 2

    def links(self) -> list[Link]:
        """From the inputs to what the law's kernels read: the links that write "coefficients"."""
        return [Coefficients(self)]

    def check(self, values: dict) -> None:
        """Raise ValueError, naming range, value and remedy, for numbers that no material can have."""
        for name, value in values.items():
            if not np.all(np.isfinite(value)):
                bad = value[~np.isfinite(value)] if np.ndim(value) else value
                got = f"got {np.ravel(bad)[0]} ({np.size(bad)} of {np.size(value)})"
                raise ValueError(f"{name} must be finite, {got}; its unit is {self.unit_of(name)}")
        for names, zero_too in ((self.positive, False), (self.not_negative, True)):
            for name in (name for name in names if name in values):
                check_range(name, values[name], 0, np.inf, zero_too, names[name])
        if "youngs_modulus" in values:
            check_range("youngs_modulus", values["youngs_modulus"], 0, np.inf, False, "a stiffness [Pa]")
            remedy = '0.5 is incompressible; take 0.45, or up to 0.4999 with volume="patches" of the Scene'
            check_range("poissons_ratio", values["poissons_ratio"], -1, 0.5, False, remedy)
        if "mu" in values:
            check_range("mu", values["mu"], 0, np.inf, False, "a stiffness [Pa]")
            lam = values.get("lam")
            if lam is not None and (values["mu"].shape == lam.shape or 1 in (values["mu"].size, lam.size)):
                bulk = moduli.bulk_modulus(values["mu"], values["lam"])
                check_range("bulk modulus lam + 2/3 mu", bulk, 0, np.inf, False, "raise lam")

    def lame(self, values: dict) -> tuple[np.ndarray, np.ndarray]:
        """Small-strain (mu, lam) [Pa], each shape () or (num_tetrahedra,)."""
        self.check({name: value_of(x) for name, x in values.items()})
        if self.to_lame is not None:
            p = self.coefficients(values) @ self.to_lame.T
            return p[..., 0], p[..., 1]
        if self._begins_with_E_and_nu():
            return moduli.lame(*(as_array(values[name]) for name in self.inputs[:2]))
        if {"mu", "lam"} <= {*self.inputs}:
            mu, lam = (as_array(values[name]) for name in ("mu", "lam"))
            return mu + 0 * lam, lam + 0 * mu
        raise NotImplementedError(
            f"{self.name} does not say its moduli of small strains: write lame(self, values), which returns (mu, lam) [Pa]"
        )

    @property
    def isotropic(self) -> "Material":
        """What its viscosity is measured by: itself, or the material that it is made around."""
        return self

    def viscosities(self, values: dict) -> tuple[np.ndarray, np.ndarray] | None:
        """(eta, lam_v) [Pa s], each shape () or (num_tetrahedra,), of a viscous stress 2 eta E_dot + lam_v tr(E_dot) 1; None
        without."""
        return None

    def coefficients(self, values: dict) -> np.ndarray:
        """The law's coefficients [Pa]: shape (K,) if all values are uniform, else (num_tetrahedra, K)."""
        self.check({name: value_of(x) for name, x in values.items()})
        return self._coefficients(values)

    def _coefficients(self, values: dict) -> np.ndarray:
        columns, matrix = self._columns(values, self.inputs), self._matrix()
        if self._begins_with_E_and_nu():
            columns[:2] = moduli.lame(*columns[:2])
        shape = np.broadcast_shapes(*map(np.shape, columns))
        numbers = np.stack([np.broadcast_to(column, shape) for column in columns], -1)
        return numbers if matrix is None else numbers @ matrix.T

    def _begins_with_E_and_nu(self) -> bool:
        return self.inputs[:2] == Material.spellings[0]

    def _matrix(self) -> "np.ndarray | None":
        return self.from_lame if self.inputs in Material.spellings else self.from_own

    def _columns(self, values: dict, names: tuple) -> list:
        """The components of some numbers, one after the other, each of shape () or (num_tetrahedra,)."""
        columns = []
        for name in names:
            value, shape = as_array(values[name]), self.shape_of(name)
            columns += [value[..., k] for k in range(shape[0])] if shape else [value]
        return columns

    def __repr__(self) -> str:
        numbers = ", ".join(f"{name}={_short(number)}" for name, number in self._numbers.items())
        return f"{self.name}({numbers}{self._extra})"


class Coefficients(Recording, Link):
    """A law's coefficients of a material's numbers; adjoints may come per tetrahedron or point, also where all are alike."""

    writes = ("coefficients",)

    def __init__(self, material: Material):
        self.material, self.reads = material, material.inputs

    def value(self, *x):
        return (self.material.coefficients(dict(zip(self.reads, x))),)

    def vjp(self, x, y_adj):
        p, adjoint = value_of(self.recorded(x).y[0]), np.asarray(y_adj[0], np.float64)
        if p.ndim < adjoint.ndim:
            adjoint = adjoint.sum(1) if p.ndim == 2 else adjoint.reshape(-1, adjoint.shape[-1]).sum(0)
        return super().vjp(x, (adjoint if adjoint.shape == p.shape else np.broadcast_to(adjoint, p.shape),))


def number_of_terms(kind: str, each: str, **vectors) -> int:
    """How many numbers two vectors have that need one for each of some terms; ValueError where they differ."""
    firsts = {name: next(iter(x.values())) if isinstance(x, dict) and x else x for name, x in vectors.items()}
    (a, b), names = (shape_of(name, x) for name, x in firsts.items()), " and ".join(vectors)
    if not (a and b and a[-1] == b[-1] and a[-1]):
        raise ValueError(f"{kind}: {names} need one number for each {each}, got shapes {a} and {b}")
    return a[-1]


def check_range(name: str, value, low: float, high: float, low_included: bool, remedy: str) -> None:
    """Raise ValueError unless low < value < high (low <= value if low_included) everywhere; NaN is outside."""
    value = np.asarray(value_of(value))
    bad = ~(((value >= low) if low_included else (value > low)) & (value < high))
    if np.any(bad):
        first = int(np.argmax(np.ravel(bad)))
        where = f" in tetrahedron {first} ({bad.sum()} in all)" if value.ndim else ""
        rule = f"lie in ({low:g}, {high:g})" if np.isfinite(high) else f"be {'>=' if low_included else '>'} {low:g}"
        raise ValueError(f"{name} must {rule}, got {np.ravel(value)[first]:g}{where}: {remedy}")


def _number(name: str, number, shape: tuple) -> np.ndarray:
    try:
        value = np.asarray(number)
        if value.dtype.kind not in "iuf":
            raise TypeError
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be a number, an array of numbers or a dict of numbers, got {number!r}") from None
    if not value.size or value.shape not in (shape, (len(np.atleast_1d(value)), *shape)):
        one = f"{shape[0]} numbers or {shape[0]}" if shape else "one number or one"
        raise ValueError(f"{name} must be {one} per tetrahedron, got an array of shape {value.shape}")
    return value.astype(np.float64)


def _one(name: str, number, shape: tuple) -> np.ndarray:
    """The number of a tetrahedron set."""
    value = _number(name, number, shape)
    if value.shape != shape:
        expected = f"{shape[0]} numbers" if shape else "one number"
        raise ValueError(f"{name} must be {expected}, got shape {np.shape(number)}")
    return value


def _all_values(name: str, number, shape: tuple) -> np.ndarray:
    """Every number given, for checks that need no mesh; a dict as an array of its numbers."""
    if not isinstance(number, dict):
        return _number(name, number, shape)
    if not number:
        raise ValueError(f'{name}: the dict is empty; name tetrahedron sets, or give a number for "default"')
    return np.array([_one(f"{name}[{key!r}]", value, shape) for key, value in number.items()])


def _on_mesh(name: str, number, mesh, shape: tuple, each: tuple | None) -> np.ndarray:
    """each: shape of a number that is given at points."""
    if isinstance(number, dict):
        return values_of_sets(name, number, mesh, shape)
    if each is not None:
        if np.shape(number) != each or mesh.order == 1:
            raise ValueError(
                f"{name}: at points expected shape {each} of a mesh with ten nodes, as mesh.at_stress_points(x) has, got "
                f"shape {np.shape(number)}"
            )
        return np.asarray(number, np.float64)
    value, whole = _number(name, number, shape), (mesh.num_tetrahedra, *shape)
    if value.shape not in (shape, whole):
        one = f"{shape[0]} numbers or {shape[0]}" if shape else "one number or one"
        raise ValueError(f"{name}: expected {one} per tetrahedron, shape {whole}, got shape {value.shape}")
    return value


def _short(number) -> str:
    if isinstance(number, dict):
        return "{" + ", ".join(f"{key!r}: {_short(value)}" for key, value in number.items()) + "}"
    value = np.asarray(number, np.float64)
    if value.ndim:
        return f"array({value.size} values, {_short(value.min())} to {_short(value.max())})"
    digits, exponent = f"{value:.11e}".split("e")
    return min(f"{value:.12g}", f"{digits.rstrip('0').rstrip('.')}e{int(exponent)}", key=len)


class TwoModuli(Material):
    """A material of (E, nu) or of (mu, lam): see `Material`."""

    def __init__(
        self,
        youngs_modulus: PerTetrahedron | None = None,
        poissons_ratio: PerTetrahedron | None = None,
        *,
        E: PerTetrahedron | None = None,
        nu: PerTetrahedron | None = None,
        mu: PerTetrahedron | None = None,
        lam: PerTetrahedron | None = None,
    ):
        super().__init__(youngs_modulus, poissons_ratio, E=E, nu=nu, mu=mu, lam=lam)
