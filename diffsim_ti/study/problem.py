"""Problem: a scene with a number to get right, to be run by many solvers, steps and meshes."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.copies import made_again
from diffsim_ti.common.names import no_such
from diffsim_ti.common.public import Public
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.scene import Scene

# kinds of element: name -> what `Problem.scene` takes: arguments of Scene, and the order of the mesh
ELEMENTS = {"linear": {}, "patches": {"volume": "patches"}, "quadratic": {"order": 2}}
ELEMENTS["quadratic, mean dilatation"] = {"order": 2, "volume": "patches"}
VARIANTS = ELEMENTS | {"mass scaling": {"mass_scaling": 0.01}}  # of a chart: linear tetrahedra, their mass scaled


def of_order(mesh: TetrahedralMesh, order: int) -> TetrahedralMesh:
    """A mesh of linear tetrahedra, or its ten-node ones."""
    return mesh.quadratic() if order == 2 else mesh


@dataclass(frozen=True)
class FrameLoss:
    """A loss of one number per frame, q_f = sum_i w_i . u_f,i: sum_f [linear_f q_f + square_f (q_f - target_f)^2 / 2].

    weights(mesh) -> w, shape (num_vertices, 3); the others have a number for each frame. Called with frames and their mesh,
    it gives the loss's gradient by their positions.
    """

    weights: Callable
    linear: np.ndarray
    square: np.ndarray
    target: np.ndarray

    @classmethod
    def end(cls, weights: Callable, frames: int) -> "FrameLoss":
        """The number itself at the last of `frames` frames after the start."""
        none = np.zeros(frames + 1)
        return cls(weights, np.append(none[1:], 1.0), none, none)

    def __call__(self, frames, mesh) -> np.ndarray:
        weights = self.weights(mesh)
        q = np.tensordot(frames.displacements.astype(np.float64), weights, 2)
        return (self.linear + self.square * (q - self.target))[:, None, None] * weights


@dataclass(frozen=True)
class Problem(metaclass=Public):
    """What is computed, over how long, and against what it is measured.

    scene(cells, pattern, precision, **element) -> Scene, on a mesh of so many cells across.
    duration [s], frames: how long it moves, and at how many equal times it is evaluated.
    quantity(frames, gradients) -> the numbers to get right; frames are a Rollout's, gradients those of `adjoint`.
    exact: the closed form's numbers, or None: a converged reference is computed, with its own error.
    scale: what errors are divided by; default the largest of the exact numbers.
    adjoint(frames, mesh) -> the loss's gradient by the frames' positions, such as a `FrameLoss`; `inputs`: those asked for.
    cells, patterns, elements: the meshes of the chart, and the kinds of elements (VARIANTS) to try on each.
    reference_cells: those that the reference is extrapolated from, of ten-node tetrahedra (it then includes the mesh's
        error); None: the reference is of each mesh with linear elements by itself (the error of steps and precision).
    largest_step [s]: steps to start from, where the stable one does not say (contact to come).
    static: an equilibrium; only StaticSolver takes part.
    levels: steps per solver, each half the last.
    origin: (function, arguments) that make it again in another process, where it does not pickle otherwise.
    """

    name: str
    title: str
    error: str
    scene: Callable
    duration: float
    quantity: Callable
    frames: int = 16
    exact: np.ndarray | None = None
    scale: float | None = None
    adjoint: Callable | None = None
    inputs: tuple = ()
    cells: tuple = (2, 4, 8)
    patterns: tuple = ("five", "kuhn")
    elements: tuple = ("linear",)
    reference_cells: tuple | None = None
    largest_step: float = np.inf
    static: bool = False
    levels: int = 3
    origin: tuple | None = None

    def __reduce__(self):
        given = {field.name: getattr(self, field.name) for field in fields(self)}
        if self.origin is None:
            return made_again, (Problem, given)
        plain = ("duration", "frames", "cells", "patterns", "elements", "reference_cells", "largest_step", "levels")
        return _again, (self.origin, {name: given[name] for name in plain})

    @property
    def differentiates(self) -> bool:
        """Whether the number is a gradient."""
        return self.adjoint is not None

    def quick(self) -> "Problem":
        """The same with its smallest meshes, of the first pattern and kind of elements."""
        few = dict(cells=self.cells[:2], patterns=self.patterns[:1], elements=self.elements[:1])
        return replace(self, reference_cells=self.reference_cells and self.reference_cells[:3], **few)

    @classmethod
    def of_scene(
        cls, scene: Scene, duration: float, name: str = "scene", frames: int = 10, gradient: str | None = None
    ) -> "Problem":
        """The motion of a scene of one's own, against its converged motion on the same mesh; or a gradient through it.

        The error is the largest distance of any vertex at any frame, over the largest displacement from the start.
        gradient: an input's name; then the number is the gradient by it of the mean square displacement [m^2] at the end.
        """
        if not duration > 0:
            raise ValueError(f"duration must be > 0 [s], got {duration:g}")
        origin = cls.of_scene, (scene, duration, name, frames, gradient)
        if gradient is not None and gradient not in scene.inputs.values:
            raise ValueError(no_such("input", gradient, scene.inputs.values, "this scene"))

        def build(cells, pattern, precision, **element):
            return scene.replace(precision=precision, **element)

        def moved(frames, gradients=None):
            return frames.displacements.astype(np.float64) - frames.displacements[0]

        def adjoint(frames, mesh):
            out = np.zeros(frames.positions.shape)
            out[-1] = 2 * moved(frames)[-1] / mesh.num_vertices
            return out

        title = f"{name}: {scene.mesh.num_tetrahedra} tetrahedra, {duration:g} s"
        own = dict(cells=(0,), patterns=("own mesh",), origin=origin)
        if gradient is None:
            return cls(name, title, "error of motion", build, duration, moved, frames, **own)
        name, own = f"{name}-{gradient}", own | dict(adjoint=adjoint, inputs=(gradient,))
        number = lambda _, gradients: np.atleast_1d(gradients[gradient])  # noqa: E731
        return cls(name, title, f"error of the gradient by {gradient}", build, duration, number, frames, **own)


def _again(origin: tuple, changed: dict) -> Problem:
    make, arguments = origin
    return replace(make(*arguments), **changed)


def distance(problem: Problem, quantity: ArrayLike, exact: ArrayLike) -> float:
    """Error of a problem's numbers: the largest difference over the scale; rows of 3 count by their length."""
    quantity, exact = np.asarray(quantity, np.float64), np.asarray(exact, np.float64)
    apart = np.abs(quantity - exact)
    if apart.ndim > 1 and apart.shape[-1] == 3:
        apart = np.linalg.norm(apart, axis=-1)
    largest = np.abs(exact) if exact.ndim < 2 else np.linalg.norm(exact, axis=-1)
    return float(apart.max() / (problem.scale or largest.max() or np.finfo(float).tiny))  # of what stays where it is, 0
