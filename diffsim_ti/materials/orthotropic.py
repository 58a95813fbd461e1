"""Orthotropic and transversely isotropic elasticity: wood, prints, composites."""

from dataclasses import dataclass

import numpy as np

from diffsim_ti.differentiation.arrays import as_array, value_of, with_slopes
from diffsim_ti.materials.calculus.tensor import PAIRS, green_strain, six
from diffsim_ti.materials.energy_law import EnergyLaw
from diffsim_ti.materials.material import Material, PerTetrahedron, check_range

ROWS, COLUMNS = np.triu_indices(6)


@dataclass(frozen=True)
class HookeLaw(EnergyLaw):
    """psi = 1/2 e . C e, e = (E_xx, E_yy, E_zz, 2 E_yz, 2 E_xz, 2 E_xy) of Green's strain E, C any symmetric 6 x 6."""

    coefficient_names = tuple(f"C_{i + 1}{j + 1}" for i, j in zip(ROWS, COLUMNS))

    def psi(self, H, p):
        E = six(green_strain(H, 0.5))
        e = [*E[:3], *(2 * x for x in E[3:])]
        return sum(c * e[i] * e[j] * (0.5 if i == j else 1) for c, i, j in zip(p, ROWS.tolist(), COLUMNS.tolist()))


class Orthotropic(Material):
    """Hooke's law with three planes of symmetry: psi = 1/2 E : C : E [J/m^3], P = F (C : E) [Pa], E = (F^T F - I) / 2.

    `Orthotropic(E1, E2, E3, nu12, nu23, nu13, G12, G23, G13, direction_1, direction_2)`: Young's moduli along three
    perpendicular directions [Pa], shear moduli [Pa], and Poisson's ratios [-]: nu12 is how much the body narrows along 2
    when it is pulled along 1, and nu21 = nu12 E2 / E1. direction_1, direction_2: vectors at rest, of any length, by default
    x and y; of the second counts what is perpendicular to the first, and the third is perpendicular to both.
    `Orthotropic(E1=, E2=, nu12=, nu23=, G12=, direction_1=)` is transversely isotropic, alike in all directions across 1:
    E3 = E2, nu13 = nu12, G13 = G12, G23 = E2 / (2 (1 + nu23)).
    Each is one number (or vector of shape (3,)), one per tetrahedron or by sets, and an input with gradient.

    Rotations may be large; strains are to be small: under compression it softens, as `StVenantKirchhoff`, which it is for
    equal directions. What takes moduli of an isotropic body (the stable step, barriers, `KelvinVoigt(time=)`) takes lam =
    the mean of C_12, C_23, C_13, and the least mu with 2 mu |e|^2 + lam tr(e)^2 >= e : C : e for all strains e.
    volume="patches" does not support it.
    Lekhnitskii, Theory of Elasticity of an Anisotropic Body, 1981, ch. 1.
    Raises ValueError for constants whose stiffness is not positive definite, and directions without length or parallel.
    """

    spellings = (
        ("E1", "E2", "E3", "nu12", "nu23", "nu13", "G12", "G23", "G13", "direction_1", "direction_2"),
        ("E1", "E2", "nu12", "nu23", "G12", "direction_1"),
    )
    shapes = {"direction_1": (3,), "direction_2": (3,)}
    units = {name: "-" for name in ("nu12", "nu23", "nu13", *shapes)}

    def __init__(
        self,
        E1: PerTetrahedron,
        E2: PerTetrahedron,
        E3: PerTetrahedron | None = None,
        nu12: PerTetrahedron | None = None,
        nu23: PerTetrahedron | None = None,
        nu13: PerTetrahedron | None = None,
        G12: PerTetrahedron | None = None,
        G23: PerTetrahedron | None = None,
        G13: PerTetrahedron | None = None,
        direction_1: PerTetrahedron = (1.0, 0.0, 0.0),
        direction_2: PerTetrahedron | None = None,
    ):
        if E3 is not None and direction_2 is None:
            direction_2 = (0.0, 1.0, 0.0)
        constants = dict(E1=E1, E2=E2, E3=E3, nu12=nu12, nu23=nu23, nu13=nu13, G12=G12, G23=G23, G13=G13)
        # numbers of sets are compared on a mesh alone, where each tetrahedron has its own
        self._comparable = not any(isinstance(x, dict) for x in (*constants.values(), direction_1, direction_2))
        super().__init__(**constants, direction_1=direction_1, direction_2=direction_2)
        self._comparable = True

    def check(self, values):
        super().check(values)
        for name in self.inputs:
            if name[0] in "EG":
                check_range(name, values[name], 0, np.inf, False, "a stiffness [Pa]")
        for name in (name for name in self.shapes if name in values):
            length = np.linalg.norm(values[name], axis=-1)
            check_range(f"length of {name}", length, 0, np.inf, False, "a direction needs a length")
        if not self._comparable:
            return
        E, nu, _, a, b = self._expanded(values)
        squares = {}
        for k, (i, j) in enumerate(((1, 2), (2, 3), (1, 3))):
            ratio = squares[k] = nu[k] ** 2 * E[j - 1] / E[i - 1]
            remedy = (
                f"the stiffness is positive definite for |nu{i}{j}| < sqrt(E{i} / E{j}) alone; nu{i}{j} is the narrowing "
                f"along {j} of a pull along {i}, and where that of a pull along {j} is known, times E{i} / E{j}"
            )
            check_range(f"nu{i}{j}^2 E{j} / E{i}", ratio, 0, 1, True, remedy)
        determinant = 1 - sum(squares.values()) - 2 * nu[0] * nu[1] * nu[2] * E[2] / E[0]
        remedy = "the stiffness is positive definite where this is above 0; lower Poisson's ratios"
        name = "1 - nu12 nu21 - nu23 nu32 - nu13 nu31 - 2 nu21 nu32 nu13"
        check_range(name, determinant, 0, np.inf, False, remedy)
        sine = np.linalg.norm(np.cross(a, b), axis=-1) / np.linalg.norm(a, axis=-1) / np.linalg.norm(b, axis=-1)
        check_range(
            "sine between direction_1 and direction_2", sine, 1e-6, np.inf, False, "let them differ, such as x and y"
        )

    def _expanded(self, x: dict) -> tuple:
        """Three Young's moduli, Poisson's ratios 12, 23, 13 and shear moduli 23, 13, 12, and two directions."""
        a = as_array(x["direction_1"])
        if "E3" in x:
            E, nu, G = ([x[n] for n in names.split()] for names in ("E1 E2 E3", "nu12 nu23 nu13", "G23 G13 G12"))
            return E, nu, G, a, as_array(x["direction_2"])
        across = x["E2"] / (2 * (1 + x["nu23"]))
        aside = np.eye(3)[np.argmin(np.abs(value_of(a)), -1)]  # any direction that is not along the axis
        return [x["E1"], x["E2"], x["E2"]], [x["nu12"], x["nu23"], x["nu12"]], [across, x["G12"], x["G12"]], a, aside

    def _stiffness(self, x: dict) -> np.ndarray:
        """C of (11, 22, 33, 23, 13, 12), shear strains doubled, in the material's directions."""
        E, nu, G, _, _ = self._expanded(x)
        zero = np.zeros(np.broadcast_shapes(*map(np.shape, (*E, *nu, *G))))
        S = [[zero] * 6 for _ in range(6)]
        for k in range(3):
            S[k][k], S[k + 3][k + 3] = 1 / E[k] + zero, 1 / G[k] + zero
        for (i, j), ratio in zip(((0, 1), (1, 2), (0, 2)), nu):
            S[i][j] = S[j][i] = -ratio / E[i] + zero
        return np.linalg.inv(np.stack([np.stack(row, -1) for row in S], -2))

    def _coefficients(self, x: dict) -> np.ndarray:
        """N C N^T along x, y, z; N turns the six numbers of a stress, the material's directions being columns of Q."""
        *_, a, b = self._expanded(x)
        a = a / np.sqrt((a * a).sum(-1, keepdims=True))
        b = b - (a * b).sum(-1, keepdims=True) * a
        b = b / np.sqrt((b * b).sum(-1, keepdims=True))
        Q = np.stack([a, b, np.cross(a, b)], -1)
        i, j = np.array(PAIRS).T
        first, second = Q[..., i, :], Q[..., j, :]
        N = first[..., i] * second[..., j] + (i != j) * first[..., j] * second[..., i]
        return (N @ self._stiffness(x) @ np.swapaxes(N, -1, -2))[..., ROWS, COLUMNS]

    def lame(self, values):
        """2 mu is the largest eigenvalue of C less lam 1 (x) 1, on strains of unit length."""
        self.check(values)
        C, length, of_normal = self._stiffness(values), np.array([1, 1, 1, 2**0.5, 2**0.5, 2**0.5]), np.zeros((6, 6))
        of_normal[:3, :3] = 1
        lam = C[..., [0, 1, 0], [1, 2, 2]].mean(-1)
        rest = C * np.outer(length, length) - lam[..., None, None] * of_normal
        sizes, vectors = np.linalg.eigh(value_of(rest))
        v = vectors[..., -1]
        return with_slopes(sizes[..., -1], (rest, lambda: v[..., :, None] * v[..., None, :])) / 2, lam

    def law(self, precision):
        return HookeLaw(precision)
