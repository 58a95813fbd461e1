"""What stands around a body: a scene's floor, its obstacles as triangles to draw, and simple shapes."""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from diffsim_ti.common.public import public
from diffsim_ti.scene import Scene
from diffsim_ti.terms import Obstacle, Robot
from diffsim_ti.terms.obstacles.shapes import Triangles, ball, bowl, box, revolved, square, tube

__all__ = ["ball", "bowl", "box", "floor_of", "obstacle_surfaces", "revolved", "square", "tube"]


def floor_of(scene: Scene) -> float | None:
    """Height of a scene's floor [m], or None: the first obstacle's that is one (`Obstacle.floor_height`)."""
    heights = (term.floor_height() for term in scene.terms if isinstance(term, Obstacle) and not term.turns)
    return next((height for height in heights if height is not None), None)


def link_rows(scene: Scene, joint_states: np.ndarray | None) -> dict[str, np.ndarray]:
    """{name of the obstacle: its pose, 7 numbers} of the links of all robots, at joint positions in the first column."""
    out, at = {}, 0
    for robot in scene.terms_of(Robot) if joint_states is not None else ():
        out |= robot.poses(joint_states[at : at + robot.model.size, 0])
        at += robot.model.size
    return out


@public
def obstacle_surfaces(scene: Scene, time: float = 0.0, rows: Mapping = MappingProxyType({})) -> list[Triangles]:
    """(points [m], shape (k, 3), triangles) of each obstacle of a scene at `time` [s] that has a surface to draw.

    Floors that do not turn have none: they are drawn as a plane without end. Each shape says what it looks like
    (`Obstacle.surface`). rows: {name of a path's input: its row at that time}, where a run was given one; of links of robots
    {name of the obstacle: its pose} (`link_rows`), where they are not at the start.
    """
    out, size = [], float(np.ptp(scene.mesh.bounding_box, 0).max())
    given = {term: rows[name] for name, term in zip(scene.inputs.paths, scene.moving) if name in rows} if rows else {}
    given |= {term: rows[term.name] for term in scene.terms if term.led is not None and term.name in rows}
    for term in scene.terms:
        shape = term.surface_at(size, time, given.get(term)) if isinstance(term, Obstacle) else None
        if shape is not None:
            out.append(shape)
    return out
