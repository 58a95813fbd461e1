"""A scene moved as a whole, and how far what it does is from what it did: nothing but places may depend on where it is."""

from copy import copy
from dataclasses import replace

import numpy as np

import diffsim_ti as ds
from diffsim_ti.terms.lines import LineTerm

FAR = np.array([1e5, -3e6, 1e7])


def moved_point(point, offset):
    """What a tie may run through: vertices and names stay, places and anchors move."""
    if isinstance(point, ds.Anchor):
        return ds.Anchor(point.position + offset)
    if isinstance(point, str) or np.asarray(point).dtype.kind in "iu":
        return point
    return np.asarray(point, float) + offset


def moved_term(term, offset):
    out = copy(term)
    out.described = tuple(
        i
        if i.value is None
        else replace(i, value=i.value + (offset if i.name == "anchors" else i.shift(offset).reshape(i.value.shape)))
        for i in term.described
    )
    if isinstance(term, LineTerm):
        out._found = None
        for name in ("start", "end"):
            if hasattr(term, name):
                setattr(out, name, moved_point(getattr(term, name), offset))
        if hasattr(term, "points"):
            out.points = [moved_point(point, offset) for point in term.points]
    return out


def moved(scene: ds.Scene, offset) -> ds.Scene:
    """The scene at another place."""
    offset, given = np.asarray(offset, float), scene.arguments
    start, motion = given["initial_positions"], given["motion"]
    turned = lambda m: replace(m, about=np.asarray(m.about) + offset) if isinstance(m, ds.Pose) else m  # noqa: E731
    return scene.replace(
        mesh=scene.mesh.translated(offset),
        terms=[moved_term(term, offset) for term in given["terms"]],
        initial_positions=None if start is None else np.asarray(start, float) + offset,
        motion={name: turned(m) for name, m in motion.items()} if isinstance(motion, dict) else turned(motion),
    )


def found(rollout: ds.Rollout) -> dict[str, np.ndarray]:
    """What a run gives that does not say where it is: states, other outputs, gradients by all inputs, tangents by them."""
    frames, rng = rollout.forward(), np.random.default_rng(0)
    w, z = rng.standard_normal((2, *frames.displacements.shape))
    out = dict(displacements=frames.displacements, velocities=frames.velocities) | frames.outputs
    gradients = rollout.vjp(frames, w, z)
    d = {name: rng.standard_normal(x.shape) for name, x in gradients.items()}
    moved = rollout.jvp(frames, **{n: x for n, x in d.items() if n not in ("rest_positions", "initial_positions")})
    return out | {f"gradient by {name}": x for name, x in gradients.items()} | dict(tangent=moved[0])


def worst(ours: dict, theirs: dict, noise: dict | None = None) -> tuple[float, str]:
    """(the largest difference, as a share of the size of what differs or of 10 times its noise, what it is)."""
    out = (0.0, "")
    for name, x in theirs.items():
        size = np.abs(x).max(initial=0.0)
        size = max(size, 1e4 * np.abs(noise[name] - x).max(initial=0.0)) if noise else size
        off = np.abs(np.asarray(ours[name], float) - x).max(initial=0.0)
        out = max(out, (float(off / size) if size > 0 else float(off > 0), name))
    return out
