"""The same scene, and the same rollout, on a finer mesh of the body: of ten-node tetrahedra, or refined."""

import math
from collections.abc import Callable, Mapping
from copy import copy
from typing import TYPE_CHECKING

import numpy as np

from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.outputs import SmoothMaximum, Strain, Stress
from diffsim_ti.scene import Scene
from diffsim_ti.terms import ExternalForce, MultiPointConstraint, Obstacle, Robot, Tie
from diffsim_ti.terms.pose import Pose

if TYPE_CHECKING:
    from diffsim_ti.rollout import Rollout

HELD = "held, by indices"  # the set of what a scene holds so
SHARE = 0.5  # of the stable step, so that a body may be found four times as stiff


def is_named(chosen) -> bool:
    """Whether a part of a mesh is chosen by names of sets, or not at all, not by indices."""
    by_name = chosen is None or isinstance(chosen, str | Mapping)
    return by_name or all(isinstance(name, str) for name in np.ravel(chosen))


def on_ten_nodes(scene: Scene) -> Scene:
    """The same scene of ten-node tetrahedra with the same corners; see `on_finer`."""
    return on_finer(scene, TetrahedralMesh.quadratic)


def on_finer(scene: Scene, finer: Callable[[TetrahedralMesh], TetrahedralMesh]) -> Scene:
    """The same scene on a finer mesh of the body, `TetrahedralMesh.quadratic` or `refined`, whose first vertices are its
    own.

    What is chosen by indices becomes a set, which new vertices on its sides join; forces on single vertices, and relations
    between them, stay there.
    Raises ValueError for what cannot be carried over.
    """
    given, base, terms = dict(scene.arguments), scene.mesh, []
    for k, term in enumerate(given["terms"]):
        surface, own = None if isinstance(term, Obstacle) else getattr(term, "surface", None), copy(term)
        if isinstance(term, Tie) and not (is_named(term.a) and is_named(term.b)):
            raise ValueError(f"{term!r} is of faces by their indices: name them as sets, by mesh.with_surface_set")
        if isinstance(term, ExternalForce | MultiPointConstraint):
            own.vertices, terms = term.indices(scene.mesh), [*terms, own]
            continue
        if not callable(surface) and not is_named(surface):
            own.surface = f"surface of term {k}"
            base, term = base.with_surface_set(own.surface, surface), own
        if not is_named(chosen := getattr(term, "tetrahedra", None)):
            own.tetrahedra = f"tetrahedra of term {k}"
            base, term = base.with_tetrahedron_set(own.tetrahedra, chosen), own
        if isinstance(term, Robot):
            term, own.attached = own, dict(own.attached)
            for link, chosen in own.attached.items():
                if not is_named(chosen):
                    own.attached[link] = f"held by {link} of term {k}"
                    base = base.with_vertex_set(own.attached[link], chosen)
        terms.append(term)
    if not is_named(given["fixed"]):
        base, given["fixed"] = base.with_vertex_set(HELD, given["fixed"]), HELD
    mesh = finer(base)
    known = mesh.refinement is not None or mesh.order > base.order
    if not known or interpolation(mesh).shape != (mesh.num_vertices, base.num_vertices):
        raise ValueError(
            f"finer: must return the mesh of {base.num_vertices} vertices that it is given as quadratic() or refined() make "
            f"it in one call, new vertices at other places if need be; got {mesh.num_vertices} vertices, made otherwise"
        )
    for name in ("initial_positions", "initial_velocities"):
        if np.ndim(given[name]) == 2:
            given[name] = interpolation(mesh) @ np.asarray(given[name], np.float64)
    if given["reduced"]:
        given["reduced"] = {name: _basis(kind, interpolation(mesh)) for name, kind in given["reduced"].items()}
    if given["motion"] is not None:
        given["motion"] = _motion(scene, mesh, given["fixed"])
    if mesh.order > scene.mesh.order:
        given["volume"] = "tetrahedra"
    else:
        given["density"] = mesh.refinement.spread(given["density"])
        given["material"] = scene.material.spread(mesh.refinement)
    return Scene(**given | dict(mesh=mesh, terms=terms))


def _basis(kind, P):
    """What a set moves by, bases also at what lies between their vertices."""
    if isinstance(kind, str):
        return kind
    kind = np.asarray(kind, np.float64)
    return P @ kind if kind.ndim == 2 else np.stack([P @ field for field in kind])


def interpolation(fine: TetrahedralMesh):
    """The matrix from what vertices of the mesh have that a finer one was made of to what its own have."""
    return fine.from_corners if fine.refinement is None else fine.refinement.from_coarse


def _motion(scene: Scene, nodes: TetrahedralMesh, fixed):
    """The scene's prescribed motion, where it is given for each vertex also of what lies between these."""

    def carried(motion, old: np.ndarray, new: np.ndarray):
        def rows(x) -> np.ndarray:
            x = np.asarray(x, np.float64)
            if x.shape[-2:] != (len(old), 3):
                return x
            every = np.zeros((*x.shape[:-2], scene.mesh.num_vertices, 3))
            every[..., old, :] = x
            return np.moveaxis(np.tensordot(interpolation(nodes)[new].toarray(), every, (1, -2)), 0, -2)

        if callable(motion):
            return lambda t: rows(motion(t))
        if isinstance(motion, Pose):
            return motion
        return motion[0], rows(motion[1]) if np.ndim(motion[1]) == 3 else motion[1]

    motion = scene.arguments["motion"]
    if isinstance(motion, Mapping):
        return {k: carried(x, scene.mesh.vertex_indices(k), nodes.vertex_indices(k)) for k, x in motion.items()}
    names = [fixed] if isinstance(fixed, str) else list(fixed)
    return carried(motion, scene.held, np.unique(np.concatenate([nodes.vertex_indices(name) for name in names])))


def rollout_on_finer(rollout: "Rollout", finer: Callable, values: dict | None = None, **more) -> "Rollout":
    """The same rollout on a finer mesh, as in `on_finer`, with some arguments of its solver replaced; an explicit one takes
    as many substeps more as that asks for at the values of inputs."""
    scene, outputs = rollout.scene, []
    for k, output in enumerate(rollout.given_outputs):
        inner = output.of if isinstance(output, SmoothMaximum) else output
        if getattr(inner, "per_vertex", False):
            raise ValueError(f"{output!r} is of each vertex, and forces on those of ten-node tetrahedra are others")
        parts = [getattr(inner, name, None) for name in ("on", "sets")]
        if not all(is_named(part) for part in parts):
            raise ValueError(f"{output!r} is of vertices by their indices: name them as a set")
        if not is_named(getattr(output, "support", None)):
            name, own = f"support of output {k}", copy(output)
            own.support = name
            scene, output = scene.replace(mesh=scene.mesh.with_vertex_set(name, output.support)), own
        outputs.append(output)
    fine, solver = on_finer(scene, finer), rollout.solver
    for output in outputs if fine.mesh.refinement else ():
        inner = output.of if isinstance(output, SmoothMaximum) else output
        if isinstance(inner, Stress | Strain) and not is_named(inner.of):
            raise ValueError(f"{output!r} is of tetrahedra by their indices: name them as a set")
    if solver.explicit:
        if solver.unequal_steps is not None:
            raise ValueError(
                "its steps are of unequal lengths, which explicit steps of a finer mesh would have to divide"
            )
        stable = solver.unchecked_for(fine.with_values(values or {})).stable_dt(tight=True).dt
        more |= dict(check_start=False, substeps=max(solver.substeps, math.ceil(solver.dt / (SHARE * stable))))
    return rollout.on(solver.for_scene(fine, **more), outputs=outputs)
