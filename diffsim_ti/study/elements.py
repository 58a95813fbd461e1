"""Which elements a scene needs: the error of its mesh by linear tetrahedra, patches and ten-node tetrahedra."""

import time
from dataclasses import dataclass

import numpy as np

from diffsim_ti.accuracy.finer import on_finer, on_ten_nodes
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.rollout import Rollout
from diffsim_ti.scene import Scene
from diffsim_ti.solvers import VelocityVerletSolver
from diffsim_ti.study.coarser import halved_grid, on_coarser
from diffsim_ti.study.problem import ELEMENTS


@dataclass
class ElementTrial:
    """A kind of element (ELEMENTS) on a scene's own mesh, or a coarser one: the largest distance of its motion from that of
    finer elements at the scene's vertices over the largest displacement (NaN: not known), and the wall time [s] of the run.
    """

    element: str
    error: float
    seconds: float

    def __str__(self) -> str:
        error = "error not known" if np.isnan(self.error) else f"error {self.error:.2g}"
        return f"{self.element} {error} in {self.seconds:.2g} s"


def own_element(scene: Scene) -> str:
    """The kind that a scene has."""
    how = {"order": 2} if scene.mesh.order == 2 else {}
    how |= {"volume": scene.volume} if scene.volume != "tetrahedra" else {}
    return next(name for name, own in ELEMENTS.items() if own == how)


def _with_volume(scene: Scene, how: dict) -> Scene:
    return scene.replace(volume=how.get("volume", "tetrahedra"))


class ElementTrials:
    """Runs of a scene by kinds of elements over `duration` [s], for at most about `budget` [s] of wall time.

    coarser: another mesh for those of ten nodes; None: a grid of half the cells, where the scene's mesh is a grid.
    """

    def __init__(
        self, scene: Scene, duration: float, frames: int, budget: float, coarser: TetrahedralMesh | None = None
    ):
        self.coarser = coarser or halved_grid(scene.mesh)
        self.scene, self.duration, self.frames, self.budget = scene.replace(precision="f64"), duration, frames, budget
        self.notes: list[str] = []

    def run(self) -> list[ElementTrial]:
        """Trials of all kinds, by time; none if the scene cannot be had of ten-node tetrahedra."""
        scene, motions, seconds = self.scene, {}, {}
        if scene.mesh.order == 2:
            self.notes.append("elements were not compared: the mesh has ten nodes already")
            return []
        try:
            on_mesh = {1: scene, 2: on_ten_nodes(scene)}
            scenes = {name: _with_volume(on_mesh[how.get("order", 1)], how) for name, how in ELEMENTS.items()}
        except ValueError as error:
            self.notes.append(f"ten-node tetrahedra were not tried: {error}")
            return []
        coarser = self.on_coarser_mesh()
        for name, made in (scenes | coarser).items():
            motions[name], seconds[name] = self._motion(made)
        for name, made in coarser.items():  # as the scene's own vertices see it
            at = made.mesh.locate(scene.mesh.vertices, nearest=True).matrix
            motions[name] = np.stack([at @ u for u in motions[name]])
        finest, error_of_finest = self._finest(seconds["quadratic"])
        if finest is None:
            finest = motions["quadratic"]
        n, largest = scene.mesh.num_vertices, np.linalg.norm(finest, axis=2).max()
        found = []
        for name, moved in motions.items():
            apart = np.linalg.norm(moved[:, :n] - finest[:, :n], axis=2).max() / largest
            unknown = name.startswith("quadratic") and name not in coarser and not error_of_finest
            found.append(ElementTrial(name, np.nan if unknown else float(apart), seconds[name]))
        return sorted(found, key=lambda trial: trial.seconds)

    def on_coarser_mesh(self) -> dict[str, Scene]:
        """Scenes of ten-node tetrahedra on the coarser mesh, by name."""
        if self.coarser is None:
            return {}
        try:
            made = on_coarser(self.scene, self.coarser)
            kinds = {name: how for name, how in ELEMENTS.items() if how.get("order") == 2}
            return {f"{name}, coarser mesh": _with_volume(made, how) for name, how in kinds.items()}
        except ValueError as error:
            self.notes.append(f"a coarser mesh was not tried: {error}")
            return {}

    def _finest(self, seconds: float) -> tuple:
        """(motion of ten-node tetrahedra on the mesh that is refined once, whether there is one); it takes some 16 times as
        long."""
        if 40 * seconds > self.budget:
            return None, False
        try:
            return self._motion(on_ten_nodes(on_finer(self.scene, TetrahedralMesh.refined)))[0], True
        except (ValueError, FloatingPointError):
            return None, False

    def _motion(self, scene: Scene) -> tuple[np.ndarray, float]:
        frame = self.duration / self.frames
        rollout = Rollout(VelocityVerletSolver(scene, dt=frame), self.frames, save_every=1)
        rollout.forward()  # compiles
        begin = time.perf_counter()
        moved = rollout.forward().displacements
        return moved - moved[0], time.perf_counter() - begin
