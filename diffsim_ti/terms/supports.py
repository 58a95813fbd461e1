"""Supports: which vertices do not move freely, and in which directions."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import TypeAliasType

from diffsim_ti.common.checked import numbers, shown
from diffsim_ti.common.warn import warn
from diffsim_ti.inputs.poses import PosedSupport
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.geometry import triangle_normals
from diffsim_ti.mesh.sets import parts_of_joined
from diffsim_ti.terms.over_time import Motion, sampled
from diffsim_ti.terms.pose import Pose

# a vertex set's name, several, indices or a mask: fixed wholly; or {name of a set: in which directions it is fixed}
Fixed = TypeAliasType("Fixed", str | ArrayLike | Mapping[str, str | ArrayLike])
AXES = {"x": 0, "y": 1, "z": 2}


class Supports:
    """What holds a body.

    vertices: sorted indices of all that are fixed in some direction, shape (k,).
    held: projectors Q onto the directions in which each of them is fixed, shape (k, 3, 3); the identity where all are.
    """

    def __init__(self, mesh: TetrahedralMesh, fixed: Fixed | None):
        self.by_name: dict[str, tuple[np.ndarray, np.ndarray]] = {}  # (vertices, unit directions) of each set
        _warn_of_several_bodies(mesh, fixed)
        if isinstance(fixed, Mapping):
            for name, how in fixed.items():
                self.by_name[name] = mesh.vertex_indices(name), _directions(mesh, name, how)
            parts = [own for own, _ in self.by_name.values()]
            self.vertices = np.unique(np.concatenate([np.zeros(0, np.int64), *parts]))
            self._stack()
        else:
            self.vertices = np.zeros(0, np.int64) if fixed is None else mesh.vertex_indices(fixed)
            self.held = np.tile(np.eye(3), (len(self.vertices), 1, 1))
        if isinstance(fixed, np.ndarray) and not len(self.vertices):  # the outcome of a choice, not a plain []
            sets = ", ".join(name for name, rows in mesh.vertex_sets.items() if len(rows)) or "none"
            raise ValueError(
                "fixed holds nothing: no vertex was chosen; choose some, name a set that has some "
                f"({sets}), or pass None for a body that is free"
            )
        self.wholly = np.linalg.matrix_rank(self.held, tol=1e-6) == 3 if len(self.vertices) else np.zeros(0, bool)
        self.held[self.wholly] = np.eye(3)

    def _stack(self) -> None:
        """The rows N of all directions of each vertex, zero where it has less, their pseudo-inverses, and Q = N^+ N."""
        rows = [len(directions) for _, directions in self.by_name.values()]
        self._normals = np.zeros((len(self.vertices), max(sum(rows), 1), 3))
        at = 0
        self._rows = {}
        for (name, (own, directions)), count in zip(self.by_name.items(), rows):
            self._rows[name] = np.searchsorted(self.vertices, own), slice(at, at + count)
            self._normals[self._rows[name]] = directions
            at += count
        self._inverse = np.linalg.pinv(self._normals, rcond=1e-6)
        held = self._inverse @ self._normals
        self.held = 0.5 * (held + np.swapaxes(held, 1, 2))
        self.held[np.abs(self.held) < 1e-15] = 0

    @property
    def fixed(self) -> np.ndarray:
        """Sorted indices of the vertices that are fixed in all directions."""
        return self.vertices[self.wholly]

    @property
    def partly_fixed(self) -> np.ndarray:
        """Sorted indices of the vertices that are fixed in some directions only."""
        return self.vertices[~self.wholly]

    @property
    def sliding_supports(self) -> np.ndarray:
        """Projectors onto the directions in which these are fixed, shape (k, 3, 3)."""
        return self.held[~self.wholly]

    def free(self, x: np.ndarray) -> np.ndarray:
        """Vectors of all vertices, shape (num_vertices, 3), without what is held of them; a copy."""
        out = np.array(x)
        out[self.fixed] = 0
        if len(self.partly_fixed):
            out[self.partly_fixed] -= np.einsum("kij,kj->ki", self.sliding_supports, out[self.partly_fixed])
        return out

    def freedom(self, num_vertices: int) -> np.ndarray:
        """Projectors onto what each vertex of a mesh of so many may do, shape (num_vertices, 3, 3)."""
        out = np.tile(np.eye(3), (num_vertices, 1, 1))
        out[self.vertices] -= self.held
        return out

    def projectors(self, vertices: np.ndarray, name: object = None) -> np.ndarray:
        """Onto the directions in which the support of that name holds each of its vertices, shape (k, 3, 3); of another
        name, those in which any does."""
        if isinstance(name, str) and name in self.by_name:
            directions = self.by_name[name][1]
            return np.tile(np.linalg.pinv(directions, rcond=1e-6) @ directions, (len(vertices), 1, 1))
        return self.held[np.searchsorted(self.vertices, vertices)]

    def moved(self, motion: Motion | Pose | Mapping | None) -> np.ndarray:
        """Sorted indices of the vertices that a motion moves."""
        if not isinstance(motion, Mapping):
            return self.vertices[: 0 if motion is None else None]
        return np.unique(np.concatenate([self.by_name[name][0] for name in motion if name in self.by_name] or [[]]))

    def parts_of(self, motion: Motion | Pose | Mapping | None) -> tuple[list[tuple[PosedSupport, Pose]], bool]:
        """What of a motion is a pose, and whether there is anything else."""
        parts = motion.values() if isinstance(motion, Mapping) else [motion]
        return self._posed_supports(motion), motion is not None and not all(isinstance(own, Pose) for own in parts)

    def _posed_supports(self, motion) -> list[tuple[PosedSupport, Pose]]:
        if isinstance(motion, Pose):
            every = np.arange(len(self.vertices))
            one = np.tile(np.eye(3), (len(every), 1, 1))
            return [(PosedSupport("prescribed_pose", "prescribed_about", self.vertices, every, one), motion)]
        out = []
        for name, own in motion.items() if isinstance(motion, Mapping) else ():
            if isinstance(own, Pose) and name in self.by_name:
                places, rows = self._rows[name]
                projectors = self._inverse[places][:, :, rows] @ self.by_name[name][1]
                names = f"prescribed_pose.{name}", f"prescribed_about.{name}"
                out.append((PosedSupport(*names, self.vertices[places], places, projectors), own))
        return out

    def rows(self, motion: Motion | Pose | Mapping[str, Motion | Pose], times: ArrayLike) -> np.ndarray:
        """Prescribed displacements at each time [s], shape (len(times), k, 3) [m]; others stay.

        Raises ValueError where two sets want different motions of one vertex in one direction.
        """
        if isinstance(motion, Pose):
            return np.zeros((len(times), len(self.vertices), 3))
        if not isinstance(motion, Mapping):
            return sampled("motion", motion, times, len(self.vertices))
        unknown = [name for name in motion if name not in self.by_name]
        if unknown:
            known = ", ".join(self.by_name) or "no sets by name: pass fixed={name: directions}"
            raise ValueError(f"motion moves {unknown[0]!r}, which is not fixed; fixed has {known}")
        wanted = np.zeros((len(times), *self._normals.shape[:2]))
        for name, own in motion.items():
            if isinstance(own, Pose):
                continue
            vertices, rows = self._rows[name]
            given = sampled(f"motion of {name!r}", own, times, len(vertices))
            wanted[:, vertices, rows] = given @ self.by_name[name][1].T
        out = np.einsum("kij,tkj->tki", self._inverse, wanted)
        left = np.abs(np.einsum("kji,tki->tkj", self._normals, out) - wanted).max(initial=0.0)
        if left > 1e-9 * np.abs(wanted).max(initial=0.0):
            raise ValueError(
                f"motion: two sets move a vertex that both fix differently, by {left:.3g} m in one direction; leave the "
                "vertex out of one set, or fix the sets in other directions"
            )
        return out


def _warn_of_several_bodies(mesh: TetrahedralMesh, fixed: Fixed | None) -> None:
    """Say which sets hold several bodies because these had sets of one name before they were joined."""
    given = [fixed] if isinstance(fixed, str) else fixed if isinstance(fixed, Mapping | list | tuple) else ()
    for name in (name for name in given if isinstance(name, str)):
        if parts := parts_of_joined(mesh, name):
            warn(
                f"fixed: {name!r} contains {len(parts)} bodies, whose sets of this name were joined; name those that are "
                f"meant: {', '.join(map(repr, parts))}"
            )


def _directions(mesh: TetrahedralMesh, name: str, how: str | ArrayLike) -> np.ndarray:
    """Unit directions of a support, shape (k, 3)."""
    if isinstance(how, str) and how == "normal":
        return _normal(mesh, name)[None]
    if isinstance(how, str):
        if not how or set(how) - set(AXES) or len(set(how)) < len(how):
            raise ValueError(
                f'fixed: {name!r} must be fixed along axes such as "x" or "xyz", along "normal" of a flat surface set, or '
                f"along directions, 3 numbers each; got {how!r}"
            )
        return np.eye(3)[[AXES[axis] for axis in how]]
    directions = np.atleast_2d(numbers(f"fixed: directions of {name!r}", how))
    if directions.ndim != 2 or directions.shape[1] != 3 or not np.all(np.isfinite(directions)):
        raise ValueError(
            f'fixed: {name!r} must be fixed along axes by letters, such as "x" or "xyz", or along directions, finite, of '
            f"shape (3,) or (k, 3), got {shown(how)}"
        )
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    if not np.all(lengths > 0):
        raise ValueError(f"fixed: directions of {name!r} must not be zero, got {how!r}")
    return directions / lengths


def _normal(mesh: TetrahedralMesh, name: str) -> np.ndarray:
    """The unit normal of a surface set that is flat."""
    normals = triangle_normals(mesh.vertices, mesh.surface_triangles[mesh.surface_indices(name)])
    mean = normals.sum(0)
    mean = mean / max(np.linalg.norm(mean), 1e-300)
    off = np.linalg.norm(np.cross(normals, mean), axis=1).max(initial=0.0) / np.linalg.norm(normals, axis=1).max()
    if off > 1e-6:
        raise ValueError(
            f'fixed: {name!r} is fixed along its "normal", but it is not flat (normals turn by a sine of {off:.2g}); pass '
            "directions, or name flat parts of it"
        )
    return mean


def rigid_motions_left(places: np.ndarray, held: np.ndarray) -> str:
    """The rigid motions that supports at places [m], shape (k, 3), with projectors onto what is held leave, in words; ""
    if none. Motions are t + w x (x - middle): those that no fixed direction resists.
    """
    middle = places.mean(0) if len(places) else np.zeros(3)
    arms = places - middle
    size = float(np.abs(arms).max(initial=0.0)) or 1.0
    across = np.cross(np.eye(3)[None], arms[:, None] / size)  # rows e_d x arm
    motions = np.concatenate([np.tile(np.eye(3), (len(places), 1, 1)), across], 1)  # (k, 6, 3)
    return motions_left(np.einsum("kij,kmj->kim", held, motions).reshape(-1, 6))


def motions_left(rows: np.ndarray) -> str:
    """The rigid motions that none of the rows, shape (k, 6), resists, in words; a row says how it resists three translations
    and of three rotations."""
    _, sizes, V = np.linalg.svd(np.concatenate([np.zeros((6, 6)), rows]), full_matrices=False)
    left = V[sizes <= 1e-8 * max(sizes.max(), 1.0)]
    if len(left) == 6:
        return "6 rigid modes: 3 translations, 3 rotations"
    if not len(left):
        return ""
    U, sizes, _ = np.linalg.svd(left[:, 3:])
    turning = int((sizes > 1e-6).sum())
    shifting = len(left) - turning
    shifts, turns = U[:, turning:].T @ left[:, :3], left[:, 3:]  # combinations that do not turn; what all turn about
    parts = [(shifting, "translation", "along", shifts), (turning, "rotation", "about", turns)]
    words = ", ".join(f"{n} {word}{'s' if n > 1 else ''}" for n, word, _, _ in parts if n)
    along = ", ".join(f"{how} {_spanned(rows)}" for n, _, how, rows in parts if 0 < n < 3)
    return f"{words}: {along}" if along else words


def _spanned(vectors: np.ndarray) -> str:
    """A basis of what vectors span, in words."""
    _, sizes, V = np.linalg.svd(vectors.reshape(-1, 3), full_matrices=False)
    basis = V[sizes > 1e-6]
    basis = basis * np.sign(basis[np.arange(len(basis)), np.abs(basis).argmax(1)])[:, None]
    projector = basis.T @ basis
    axes = [axis for axis, d in AXES.items() if abs(projector[d, d] - 1) < 1e-9]
    if len(axes) == len(basis):
        return " and ".join(axes)
    return " and ".join("(" + ", ".join(f"{c:.3g}" for c in np.round(row, 6) + 0.0) + ")" for row in basis)
