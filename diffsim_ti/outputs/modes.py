"""Vibrations of a body about a state: frequencies and shapes, with the gradients of frequencies."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.brief import brief_fields
from diffsim_ti.common.checked import shown
from diffsim_ti.common.errors import NotConverged
from diffsim_ti.common.public import Public, public
from diffsim_ti.differentiation.arrays import Recorded, reverse
from diffsim_ti.inputs import DerivedNode, StressPoints
from diffsim_ti.inputs.description import InputValue
from diffsim_ti.mechanics.host_force import HostForces
from diffsim_ti.mechanics.interactions import host_forces
from diffsim_ti.outputs.forces_at_frames import BodyForces
from diffsim_ti.scene import Scene
from diffsim_ti.terms import MultiPointConstraint

SMALL, DENSE = 1e-8, 600  # of the largest eigenvalue: zero; unknowns up to which all of them are computed


@dataclass(eq=False, repr=False)
class Modes(metaclass=Public):
    """frequencies [Hz], ascending, shape (k,), negative where the state is unstable (lambda < 0: -sqrt(-lambda) / 2 pi);
    eigenvalues lambda = (2 pi f)^2 [1/s^2]; shapes [1/sqrt(kg)], (k, num_vertices, 3), with shapes_i . M shapes_j = 1 where
    i = j, else 0; groups: lists of modes whose frequencies coincide, whose mean alone has a gradient;
    scene and displacements [m]: about what state they are."""

    frequencies: np.ndarray
    eigenvalues: np.ndarray
    shapes: np.ndarray
    groups: list[list[int]]
    scene: Scene = field(repr=False)
    displacements: np.ndarray = field(repr=False)

    __repr__ = brief_fields

    def __getitem__(self, name: str) -> np.ndarray:
        """What `Frames` call outputs: frequencies."""
        return getattr(self, name)

    def gradients(self, by_frequency: ArrayLike) -> dict[str, np.ndarray]:
        """Gradients of a loss by every input of the scene, for its gradient by the frequencies, shape (k,).

            d lambda_i = phi_i . (dK - lambda_i dM) phi_i,        df = d lambda / (8 pi^2 f)

        Where frequencies coincide each mode takes the mean of its group, which is the one of them that is differentiable:
        the loss must weigh the modes of a group alike, and a group must not be cut by k. "displacements" is the gradient
        by the state, besides. Initial positions and loads have none: chain what moves the state through its own rollout.
        Of what is given over time the gradient is that of time 0.
        phi . dK phi is the slope of the exact derivatives of phi . forces along phi, by differences of fourth order whose
        error is 1e-10 of it.

        Raises ValueError for another shape, for weights that differ within a group, and for frequencies of zero.
        Magnus 1985, On differentiating eigenvalues and eigenvectors, doi:10.1017/S0266466600011129.
        """
        by = np.asarray(by_frequency, np.float64)
        if by.shape != self.frequencies.shape:
            raise ValueError(f"by_frequency: expected shape {self.frequencies.shape}, got {by.shape}")
        size = np.abs(by).max(initial=0.0)
        for group in self.groups:
            if np.ptp(by[group]) > 1e-9 * size:
                raise ValueError(
                    f"modes {group} have one frequency, {self.frequencies[group[0]]:.6g} Hz, of which only the mean has a "
                    f"gradient: weigh them alike, not {by[group]}"
                )
            if by[group[0]] and not abs(self.frequencies[group[0]]) > 0:
                raise ValueError(f"modes {group} are motions without stiffness: their frequency 0 has no gradient")
        body = BodyForces(self.scene)
        values = self.scene.inputs.at_times([0.0])
        derived, hosts = body.load(values), host_forces(self.scene).with_energy
        total, by_state = derived.zeros(), np.zeros_like(self.displacements)
        for group in self.groups:
            if not by[group[0]]:
                continue
            weight = by[group[0]] / (8 * np.pi**2 * abs(self.frequencies[group[0]]))
            for i in group:
                slope, by_u = _slope(body, hosts, self.displacements, self.shapes[i], derived)
                total.add(slope, weight)
                by_state += weight * by_u
                self._add_mass(total, -weight * self.eigenvalues[i], self.shapes[i])
        return self.scene.inputs.derive_vjp(values, total, tuple(values)) | {"displacements": by_state}

    def _add_mass(self, total, weight: float, phi: np.ndarray) -> None:
        """Adds the adjoint of masses for that of phi . M phi."""
        if total.element_masses is None:
            total.mass = total.mass + weight * (phi**2).sum(1)
            return
        at = phi[self.scene.mesh.elements]
        total.element_masses = total.element_masses + weight * at @ np.swapaxes(at, 1, 2)


FOURTH_ORDER = ((-2, 1 / 12), (-1, -8 / 12), (1, 8 / 12), (2, -1 / 12))  # shifts and weights of a difference


def _slope(body: BodyForces, hosts: HostForces, u: np.ndarray, phi: np.ndarray, derived):
    """Derivatives of phi . K phi, of what kernels read and of u: those of stress and of host forces."""
    H, none = StressPoints.of(body.scene.mesh, derived).displacement_gradients(phi), np.zeros((1, *u.shape))

    def of_stress(u):
        of, at = DerivedNode(derived), Recorded(u)
        return reverse(body.at_frames(of, at[None], none, none)[0], phi, [of, at])

    def of_hosts(u):
        found = derived.zeros()
        return found, hosts.vjp(u, phi, found)[0]

    parts = [(of_stress, max(np.abs(H).max(), 1e-300))]  # 2e-3 is a strain that a law's third derivatives resolve
    parts += [(of_hosts, hosts.take(derived).turning(u, phi))] if hosts else []
    total, by_u = derived.zeros(), np.zeros_like(u)
    for pull, size in parts:
        for shift, weight in FOURTH_ORDER:
            found, by = pull(u + shift * 2e-3 / size * phi)
            total.add(found, -weight * size / 2e-3)
            by_u -= weight * size / 2e-3 * by
    return total, by_u


def free_directions(scene: Scene):
    """An orthonormal basis of the motions that supports leave, as columns of a SciPy CSC matrix, (3 num_vertices, k); each
    moves one vertex."""
    from scipy.sparse import csc_matrix

    if any(term.is_exact for term in scene.terms_of(MultiPointConstraint)):
        raise ValueError(
            "modes and load_path do not support a MultiPointConstraint that is held exactly: give it a stiffness= of a "
            "thousand times E times the body's size"
        )
    held = np.zeros((scene.mesh.num_vertices, 3, 3))
    held[scene.held] = scene.supports.held
    held[scene.mesh.unused_vertices] = np.eye(3)  # which have no mass
    values, vectors = np.linalg.eigh(held)  # of a vertex that is free or fixed wholly, the axes
    vertex, which = np.nonzero(values < 0.5)
    rows = 3 * vertex[:, None] + np.arange(3)
    columns = np.repeat(np.arange(len(vertex)), 3)
    shape = 3 * scene.mesh.num_vertices, len(vertex)
    out = csc_matrix((vectors[vertex, :, which].ravel(), (rows.ravel(), columns)), shape=shape)
    out.eliminate_zeros()
    return out


class Tangent:
    """Factors of a matrix A without pivoting, so that `negative` pivots are as many as negative eigenvalues."""

    def __init__(self, A):
        from scipy.sparse.linalg import splu

        self.A = A
        try:
            factors = splu(A, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=dict(SymmetricMode=True))
        except RuntimeError:
            raise NotConverged("the stiffness is singular to rounding", []) from None
        self._solve, self.negative = factors.solve, int((factors.U.diagonal() < 0).sum())

    def solve(self, b: np.ndarray, transposed: bool = False) -> np.ndarray:
        trans, A = ("T", self.A.T) if transposed else ("N", self.A)
        x = self._solve(b, trans)
        return x + self._solve(b - A @ x, trans)

    def null(self) -> tuple[np.ndarray, np.ndarray, float]:
        """(v, w, mu): A v = mu v, w A = mu w, mu nearest to zero, of length one."""
        v = w = np.random.default_rng(0).standard_normal(self.A.shape[0])
        for _ in range(4):
            v, w = self.solve(v / np.linalg.norm(v)), self.solve(w / np.linalg.norm(w), True)
        v, w = v / np.linalg.norm(v), w / np.linalg.norm(w)
        return v, w, float(w @ (self.A @ v)) / float(w @ v)


@public
def modes(scene: Scene, k: int, displacements: ArrayLike | None = None, **values: InputValue) -> Modes:
    """The k lowest modes of small vibrations of a body about a state: K phi = lambda M phi, f = sqrt(lambda) / 2 pi.

    K: `scene.stiffness_matrix(displacements)`, of the body's stress, springs, cables and foundations at displacements [m]
    from the rest shape, default none; M: `scene.mass_matrix()`, lumped, or consistent of ten-node tetrahedra; vertices do
    not move where they are held, and obstacles and pressures are not in K.
    values: of the scene's inputs, instead of its own, such as youngs_modulus=2e5 or rest_positions=X.
    A body that is not fixed has six frequencies of 0, its rigid motions, with k counting them. Everything is in float64.

    Raises ValueError for k outside 1 .. the number of free unknowns, shapes that do not fit, or a law with rates or a state.
    Bathe, Finite Element Procedures, 2nd ed., 2014, ch. 10.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> scene = ds.Scene(mesh, ds.StableNeoHookean(E=1e5, nu=0.3), terms=[ds.Gravity()], precision="f64")
    >>> frequencies = ds.modes(scene, 7).frequencies  # six rigid motions, and the first that strains
    >>> print(abs(frequencies[:6]).max() < 1e-3, f"{frequencies[6]:.3f} Hz")
    True 2.282 Hz
    """
    from scipy.linalg import eigh
    from scipy.sparse import diags, identity
    from scipy.sparse.linalg import LinearOperator, eigsh

    if not hasattr(scene, "stiffness_matrix"):
        raise ValueError(f"modes: scene must be a Scene, got {shown(scene)}")
    if scene.precision != "f64":
        scene = scene.replace(precision="f64")
    if any(body.kind != "tie" for body in scene.reduced.bodies):
        raise ValueError(
            "modes: a scene with sets that are reduced= has no modes here; leave it out for those of all vertices"
        )
    u = scene.checked_displacements(displacements)
    scene = scene.with_consistent_mass().with_values(values)
    free = free_directions(scene)
    for tie in scene.reduced.bodies:
        free = (tie.matrix @ free).tocsc()
        free = free[:, np.diff(free.indptr) > 0]
    count = free.shape[1]
    if k not in range(1, count + 1) or isinstance(k, bool):
        raise ValueError(f"modes: k must be a whole number of 1 .. {count}, the free unknowns, got {shown(k)}")
    k = int(k)
    mass = scene.mass_matrix()
    scale = 1 / np.sqrt(abs(free).T.power(2) @ mass.diagonal())
    K = free.T @ scene.stiffness_matrix(u) @ free
    A = diags(scale) @ (0.5 * (K + K.T)) @ diags(scale)
    M = diags(scale) @ (free.T @ mass @ free) @ diags(scale) if scene.mesh.order == 2 or scene.reduced else None
    size = float(abs(A).sum(1).max())
    if count <= DENSE or 3 * k >= count:
        values, vectors = eigh(A.toarray(), None if M is None else M.toarray(), subset_by_index=[0, k - 1])
    else:
        sigma, start = -1e-6 * size, np.random.default_rng(0).standard_normal(count)
        while (factors := Tangent((A - sigma * (identity(count) if M is None else M)).tocsc())).negative:
            sigma *= 4  # not below all of them yet
        solve = LinearOperator(A.shape, factors._solve, dtype=float)
        values, vectors = eigsh(A.tocsc(), k, M, sigma=sigma, OPinv=solve, which="LM", tol=1e-13, v0=start)
        order = np.argsort(values)
        values, vectors = values[order], vectors[:, order]
    values = np.where(np.abs(values) < 1e-13 * size, 0.0, values)
    shapes = (free @ (vectors * scale[:, None])).T
    frequencies = np.sign(values) * np.sqrt(np.abs(values)) / (2 * np.pi)
    groups = [[0]]
    for i in range(1, k):
        near = abs(values[i] - values[i - 1]) <= SMALL * max(abs(values[i]), 1e-6 * size * SMALL)
        groups[-1].append(i) if near else groups.append([i])
    return Modes(frequencies, values, shapes.reshape(k, -1, 3), groups, scene, u)
