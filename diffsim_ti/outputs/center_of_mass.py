"""Centre of mass of a body, or of some of its vertices."""

from copy import copy

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.inputs import Derived
from diffsim_ti.outputs.frames import Frames
from diffsim_ti.outputs.output import Change, Output
from diffsim_ti.scene import Scene


class CenterOfMass(Output):
    """Centre of mass [m] in each frame, shape (frames, 3):

        x = sum_i m_i x_i / sum_i m_i

    m_i: the lumped mass of a vertex; of ten-node tetrahedra in implicit steps the sum of its row of the consistent mass, so
    that x is the integral of rho x over the body, divided by that of rho.

    of: whose centre, by a vertex set's name, indices, a mask or a list of names; of a joined mesh a body's name; None: all.
    name: how a loss calls it.
    The gradient is exact by all inputs. Raises ValueError for an unknown set, and for one without mass.
    Goldstein, Poole, Safko, Classical Mechanics, 3rd ed., 2002, sec. 1.2.

    >>> import diffsim_ti as ds
    >>> cube = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> mesh = ds.TetrahedralMesh.joined({"ball": cube, "left": cube.translated((2, 0, 0))})
    >>> scene = ds.Scene(mesh, ds.StableNeoHookean(E=1e5, nu=0.3), terms=[ds.Gravity()], precision="f64")
    >>> simulator = ds.Simulator(ds.VelocityVerletSolver(scene, dt=1e-3))
    >>> simulator.output(ds.CenterOfMass("left")).round(6).tolist()
    [2.5, 0.5, 0.5]
    """

    unit = "m"

    linear = True

    def __init__(self, of: str | ArrayLike | None = None, name: str = "center_of_mass"):
        self.of, self.name = of, name

    def __repr__(self) -> str:
        return f"CenterOfMass({self.of!r}, name={self.name!r})"

    def settled(self, scene: Scene) -> "CenterOfMass":
        out, mesh = copy(self), scene.mesh
        out.scene = scene
        out.vertices = np.arange(mesh.num_vertices) if self.of is None else mesh.vertex_indices(self.of)
        if not out._masses(scene.inputs.derive(scene.inputs.values), out.vertices).sum() > 0:
            raise ValueError(f"{self!r}: the set has no mass; name one that has vertices of tetrahedra")
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return num_frames, 3

    def _masses(self, derived: Derived, vertices: np.ndarray) -> np.ndarray:
        """m_i of some vertices [kg], or their change."""
        mass = derived.mass
        if derived.element_masses is not None:
            mass = np.zeros(len(derived.rest))
            np.add.at(mass, self.scene.mesh.elements, derived.element_masses.sum(2))
        return mass[vertices]

    def _read(self, frames: Frames) -> tuple[Derived, float, np.ndarray, np.ndarray, np.ndarray]:
        """(what kernels read, m [kg], shares m_i / m, positions x_i [m], x)."""
        derived = self.scene.inputs.derive(frames.inputs)
        own, x = self._masses(derived, self.vertices), frames.positions[:, self.vertices].astype(np.float64)
        share = own / own.sum()
        return derived, own.sum(), share, x, np.einsum("i,fij->fj", share, x)

    def value(self, frames: Frames) -> np.ndarray:
        return self._read(frames)[-1]

    def jvp(self, frames: Frames, change: Change) -> np.ndarray:
        _, mass, share, x, center = self._read(frames)
        dm = self._masses(self.scene.inputs.derive_jvp(frames.inputs, change.inputs), self.vertices)
        out = np.einsum("i,fij->fj", dm / mass, x - center[:, None])
        moved = change.positions
        return out if moved is None else out + np.einsum("i,fij->fj", share, moved[:, self.vertices])

    def vjp(self, frames: Frames, seed: np.ndarray) -> Change:
        derived, mass, share, x, center = self._read(frames)
        positions, adjoint, by_mass = np.zeros(frames.positions.shape), derived.zeros(), np.zeros(len(derived.rest))
        positions[:, self.vertices] = share[:, None] * seed[:, None]
        by_mass[self.vertices] = np.einsum("fj,fij->i", seed, x - center[:, None]) / mass
        if derived.element_masses is None:
            adjoint.mass = by_mass
        else:
            adjoint.element_masses += by_mass[self.scene.mesh.elements][:, :, None]
        inputs = self.scene.inputs.derive_vjp(frames.inputs, adjoint, tuple(frames.inputs))
        return Change(positions=positions, inputs=inputs)
