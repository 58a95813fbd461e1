"""Stress and strain tensors of tetrahedra, averaged to vertices, or at material points."""

from abc import abstractmethod
from copy import copy
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.mesh.named_sets import SetOrIndices
from diffsim_ti.outputs.deformation import (
    NUMBERS,
    PatchRecovery,
    PointInterpolation,
    PointMeans,
    displacement_gradients,
)
from diffsim_ti.outputs.output import Frames, Output, derived
from diffsim_ti.outputs.stresses import PatchStress, TetrahedronStress
from diffsim_ti.scene import Scene


class _Tensors(Output):
    """at: "tetrahedra", (frames, num_tetrahedra, 3, 3); "vertices", the means of what the tetrahedra around have there;
    "recovered", at vertices, too, by superconvergent patches (`PatchRecovery`); or material points X [m], shape (k, 3), each
    with the tensor of its tetrahedron. That of a tetrahedron with ten nodes is the mean over its points, by their volumes;
    at X and at its nodes it is the linear function of place that these four make, which is more accurate than the tensor of
    the displacements there. of: the tetrahedra that are meant: only these have a tensor, or count alone at their vertices.
    numbers: what of them is given instead, a name in deformation.NUMBERS, or None. name: how a loss calls it.
    Barlow 1976, Optimal stress locations in finite element models, doi:10.1002/nme.1620100202; Hinton, Campbell 1974, Local
    and global smoothing of discontinuous finite element functions, doi:10.1002/nme.1620080305."""

    per_item = True  # whether there is a value for each tetrahedron or vertex
    alike = False  # whether tetrahedra count alike at their vertices, and not by their volumes

    def __init__(self, name: str, at: str | ArrayLike, of: str | ArrayLike | None, **numbers: bool):
        asked = [which for which, wanted in numbers.items() if wanted]
        if len(asked) > 1:
            raise ValueError(
                f"{type(self).__name__}: {' and '.join(asked)} exclude each other; take one output for each"
            )
        self.name, self.at, self.of, self.numbers = name, at, of, asked[0] if asked else None
        if isinstance(at, str) and at not in ("tetrahedra", "vertices", "recovered"):
            raise ValueError(
                f'{type(self).__name__}: at must be "tetrahedra", "vertices", "recovered" or points, got {at!r}'
            )
        if of is not None and not isinstance(at, str):
            raise ValueError(
                f'{type(self).__name__}: of= says which tetrahedra are meant; it goes with at="tetrahedra", "vertices" or '
                '"recovered"'
            )

    def settled(self, scene: Scene) -> "Output":
        out, mesh = copy(self), scene.mesh
        out.scene, out.num_vertices, out.means, out.points = scene, mesh.num_vertices, None, mesh.reference.num_points
        every, of = isinstance(self.at, str), [] if self.of is None else mesh.tetrahedron_indices(self.of)
        located = None if every else mesh.locate(self.at)
        out.chosen = np.arange(mesh.num_tetrahedra) if every else located.tetrahedra
        if every and self.of is not None and not self._at_vertices:
            out.chosen = of
        out.read, out.count = out.chosen, len(out.chosen)  # read: whose deformation is looked at
        if self._at_vertices:
            recovered = self.at == "recovered"
            out.means = PatchRecovery(mesh, of) if recovered else PointMeans.of_vertices(mesh, of)
            out.count, out.alike = mesh.num_vertices, out.points > 1 and not recovered
        elif out.points > 1 and not every:
            out.means = PointInterpolation(mesh, located)
        elif out.points > 1:
            out.means = PointMeans.of_tetrahedra(out.count, out.points)
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return num_frames, self.count, *(NUMBERS[self.numbers][0] if self.numbers else (3, 3))

    @abstractmethod
    def _tensors(self, H: np.ndarray, z: np.ndarray, derived) -> np.ndarray:
        """T of the chosen tetrahedra; z: what the law remembers, as `remembered` has it."""

    def value(self, frames: Frames) -> np.ndarray:
        of = derived(self.scene, frames)
        H, z = displacement_gradients(frames, of, self.scene.mesh, self.read), self.remembered(frames, self.scene)
        T = self._tensors(H, z, of)
        shown = T if self.means is None else self.means.value(T, self._shares(of))
        return NUMBERS[self.numbers][1](shown) if self.numbers else shown

    @property
    def _at_vertices(self) -> bool:
        return isinstance(self.at, str) and self.at != "tetrahedra"

    def _shares(self, of) -> np.ndarray:
        """How much the points of the chosen tetrahedra count: by their volumes, alike, or by shares in values at places."""
        if self.alike:
            return np.ones(self.points * len(self.chosen))
        return self.means.shares(of.rest) if self.means.moves else of.volumes[self.chosen].ravel()


class Strain(_Tensors):
    """Green's strain E = (F^T F - I) / 2 [-], F = I + sum_a u_a (x) grad N_a, in each frame; symmetric 3x3 tensors.

    at: "tetrahedra", (frames, num_tetrahedra, 3, 3); "vertices" or "recovered", (frames, num_vertices, 3, 3), as `Stress`
    has them; or points X [m] of the rest shape, shape (k, 3). of: as of `Stress`. name: how a loss calls it.
    principal: its eigenvalues E_i instead, ascending, shape (frames, ..., 3). stretches: the principal stretches
    sqrt(1 + 2 E_i) [-], ascending; at vertices those of the mean strain. Where two of either coincide only their sum has a
    gradient: each has the slope along an eigenvector that the solver happened to choose.
    The gradient is exact by all inputs. Raises ValueError for another `at`, points outside the mesh, or both of these, and
    by the first run that has no stretches somewhere, strains changing too much within a ten-node tetrahedron.
    Holzapfel, Nonlinear Solid Mechanics, 2000, sec. 2.5 and 2.6.
    """

    def __init__(
        self,
        name: str = "strain",
        at: str | ArrayLike = "tetrahedra",
        principal: bool = False,
        stretches: bool = False,
        of: SetOrIndices | None = None,
    ):
        super().__init__(name, at, of, principal=principal, stretches=stretches)

    def _tensors(self, H, z, derived):
        Ht = np.swapaxes(H, -1, -2)
        return 0.5 * (H + Ht + Ht @ H)  # small strains keep their digits


class Stress(_Tensors):
    """Stress [Pa] in each frame: Cauchy's sigma = P F^T / J, or the first Piola-Kirchhoff stress P = dpsi/dF.

    kind: "cauchy" or "first_piola". at: "tetrahedra", (frames, num_tetrahedra, 3, 3); "vertices" or "recovered", (frames,
        num_vertices, 3, 3); or points X [m] of the rest shape, shape (k, 3). name: how a loss calls it.
    of: tetrahedra, by a set's name, indices, a mask or a list of names: at tetrahedra only theirs is given, shape
        (frames, k, 3, 3); at vertices, and recovered, they count alone: where two materials meet and stress jumps, which
        side's stress is meant. Without it an interface has the mean of both sides.

    At a vertex it is the mean over the tetrahedra around of the stress that each has at the vertex, which in ten-node
    tetrahedra is the linear function through their four points, with volume="patches" too. Linear tetrahedra have one stress
    each and count by their volumes: at a surface this mean is the stress some half an element below. "recovered" is the
    value at the vertex of the polynomial, linear or of ten nodes quadratic, that fits the points of the tetrahedra around
    it, about twice as accurate with ten nodes, at surfaces too (Zienkiewicz, Zhu 1992, doi:10.1002/nme.1620330702).
    principal: Cauchy's eigenvalues instead, ascending, shape (frames, ..., 3); where two coincide only their sum has a
    gradient. von_mises: sqrt(3/2 s : s) of Cauchy's deviator s instead, shape (frames, ...), at vertices that of the mean
    stress; where it is 0 it has a kink, and its gradient is given as 0 (a stress of mere rounding has a slope).
    The gradient is exact by all inputs; in single precision the stress has an error of some 1e-6 of the modulus. Of a law
    with a state, such as `Prony`, it is that of the strain and of what the law remembers in the frame; the viscous stress
    of `KelvinVoigt` is not in it.

    With volume="patches" its pressure is that of the tetrahedron's patch.

    Raises ValueError for another kind or `at`, both of these, or one of them of P, which is not symmetric, points outside
    the mesh, and laws that read more than the displacement gradient.
    Holzapfel, Nonlinear Solid Mechanics, 2000, sec. 3.1.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> scene = ds.Scene(mesh, ds.StableNeoHookean(E=1e5, nu=0.3), terms=[ds.Gravity()], fixed="ymin", precision="f64")
    >>> frames = ds.Rollout(ds.StaticSolver(scene), steps=1, outputs=[ds.Stress(von_mises=True)]).forward()
    >>> frames["stress"].shape, bool((frames["stress"][-1] > 0).all())
    ((2, 6), True)
    """

    reads_law_state = True

    def __init__(
        self,
        name: str = "stress",
        at: str | ArrayLike = "tetrahedra",
        principal: bool = False,
        kind: Literal["cauchy", "first_piola"] = "cauchy",
        von_mises: bool = False,
        of: SetOrIndices | None = None,
    ):
        if kind not in ("cauchy", "first_piola"):
            raise ValueError(f'Stress: kind must be "cauchy" or "first_piola", got {kind!r}')
        if (principal or von_mises) and kind != "cauchy":
            raise ValueError("Stress: principal values and von Mises stress are Cauchy's; P is not symmetric")
        super().__init__(name, at, of, principal=principal, von_mises=von_mises)
        self.kind = kind

    def settled(self, scene: Scene) -> "Stress":
        law = scene.law
        if law.in_steps().reads != ("H",):
            raise ValueError(
                f"Stress supports laws of the displacement gradient, not {law.title}: take a law without rates"
            )
        self.refuse_growth("Stress", scene)
        out = super().settled(scene)
        out.stresses = (TetrahedronStress if scene.volume == "tetrahedra" else PatchStress)(scene, out.chosen)
        out.read = out.stresses.read
        return out

    def _tensors(self, H, z, derived):
        P = self.stresses.value(H, z, derived)
        if self.kind == "first_piola":
            return P
        F = np.eye(3) + self.stresses.chosen_of(H)
        return P @ np.swapaxes(F, -1, -2) / np.linalg.det(F)[..., None, None]


class PlasticStrain(_Tensors):
    """Equivalent plastic strain [-], the integral of sqrt(2/3) |D_p| over time, as the law remembers it in each frame:
    after implicit and static steps that of the frame, after explicit ones that of the substep before.

    at: "tetrahedra", (frames, num_tetrahedra), the means over their points; "vertices", (frames, num_vertices); or material
    points X [m], shape (k, 3). of, name: as of `Stress`. In pictures colour="plastic_strain".
    The gradient is exact by all inputs. Raises ValueError for laws without plastic flow.
    Simo, Hughes, Computational Inelasticity, 1998, sec. 2.3.
    """

    reads_law_state = True

    def __init__(
        self, name: str = "plastic_strain", at: str | ArrayLike = "tetrahedra", of: SetOrIndices | None = None
    ):
        super().__init__(name, at, of)

    def settled(self, scene: Scene) -> "PlasticStrain":
        if not scene.law.plastic:
            raise ValueError(f"PlasticStrain: {scene.law.title} has no plastic flow; take J2Plasticity as the material")
        out = super().settled(scene)
        out.place = scene.law.state_names.index("plastic_strain")
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return num_frames, self.count

    def _tensors(self, H, z, derived):
        return z[..., self.place][:, self.read].reshape(len(z), -1)
