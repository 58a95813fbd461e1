"""What twists of joints make of points of links, and forces on these points of joints."""

import numpy as np

from diffsim_ti.common import rotations


def moved(S: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Velocities at points of twists S, shape (..., joints, 3), of points of shape (..., 3)."""
    return S[:, :3] + np.tensordot(x, rotations.skew(S[:, 3:]), (-1, 2))


def moved_jvp(S: np.ndarray, dx: np.ndarray) -> np.ndarray:
    """Change of these velocities as the points move by dx, shape (k, 3)."""
    return np.cross(S[:, 3:], dx[:, None])


def on_joints(J: np.ndarray, f: np.ndarray) -> np.ndarray:
    """J^T f: what forces on points, shape (k, 3), do on joints that move these by J, shape (k, joints, 3)."""
    return np.einsum("iad,id->a", J, f)


def by_turns(turns: np.ndarray, carried: np.ndarray, x: np.ndarray, f: np.ndarray) -> np.ndarray:
    """How J_a^T f of a link changes as joint b turns it, [b, a], for forces f at points x that stay where they are.

    turns: of `Joints.turns`; carried: which joints move the link."""
    force, moment = f.sum(0), np.cross(x, f).sum(0)
    return (turns[..., :3] @ force + turns[..., 3:] @ moment) * carried * carried[:, None]
