"""A moment of a run, and what all of its moments share: what writers, films and windows are given."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.obstacles import floor_of, obstacle_surfaces
from diffsim_ti.scene import Scene
from diffsim_ti.simulator import Simulator
from diffsim_ti.terms.obstacles.shapes import Triangles

if TYPE_CHECKING:
    from diffsim_ti.rollout.frames import Frames


@dataclass
class Setting:
    """What all frames share: the mesh at rest, the floor's height [m], fixed vertices, obstacles as they first stand."""

    mesh: TetrahedralMesh
    ground: float | None = None
    fixed: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    obstacles: list[Triangles] = field(default_factory=list)

    @classmethod
    def of(cls, scene: Scene) -> "Setting":
        """A scene's."""
        return cls(scene.mesh, floor_of(scene), scene.held, obstacle_surfaces(scene))


@dataclass
class Frame:
    """A moment of a run.

    time [s]; positions, displacements [m], velocities [m/s]: shape (num_vertices, 3).
    fields: numbers to colour by, one per vertex or per tetrahedron, under the names in fields.py: "displacement" [m],
    "speed" [m/s], "von_mises" [Pa], "energy_density" [J/m^3], "J" [-] ...
    obstacles: points of each obstacle [m], or None where the setting has them.
    """

    time: float
    positions: np.ndarray
    displacements: np.ndarray
    velocities: np.ndarray
    fields: dict[str, np.ndarray]
    obstacles: list[np.ndarray] | None = None

    @classmethod
    def of_run(cls, scene: Scene, frames: "Frames", k: int) -> "Frame":
        """Frame k of a Rollout's run of a scene; its fields are the outputs that each vertex or each tetrahedron has:
        vectors such as ContactForce(per_vertex=True), tensors and principal values such as Stress(at="vertices").

        Raises IndexError for a frame that there is not.
        """
        u, v = frames.displacements[k], frames.velocities[k]
        fields = dict(displacement=np.linalg.norm(u, axis=1), speed=np.linalg.norm(v, axis=1))
        sizes = scene.mesh.num_vertices, scene.mesh.num_tetrahedra
        shown = {name: y[k] for name, y in frames.outputs.items() if y.ndim > 2 and y.shape[1] in sizes}
        return cls(float(frames.times[k]), frames.positions[k], u, v, fields | shown)

    @classmethod
    def of(cls, simulator: Simulator, **more) -> "Frame":
        """The present state of a simulator, in its scene's precision. more: further arguments of the class."""
        u, v, scene = simulator.displacements, simulator.velocities, simulator.scene
        measured = simulator.tetrahedron_fields()
        fields = dict(displacement=np.linalg.norm(u, axis=1), speed=np.linalg.norm(v, axis=1))
        fields |= {name: getattr(measured, name) for name in ("von_mises", "energy_density", "J")}
        moved = [points for points, _ in obstacle_surfaces(scene, simulator.time)] if scene.moving else None
        return cls(simulator.time, simulator.positions, u, v, fields, moved, **more)
