"""Which scenes can be computed side by side, and the order in which kernels go through their tetrahedra."""

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.mechanics.interactions import host_forces
from diffsim_ti.terms import Robot, SelfContact


def why_not(solver) -> str | None:
    """What keeps scenes of a solver from being computed side by side, or None if nothing does."""
    scene = solver.scene
    if not solver.explicit:
        return _why_not_joined(solver)
    if runtime.runs_on_cpu() and not scene.law.lanes:
        return f"the law of {type(scene.material).__name__} does not come in lanes"
    terms = dict(self_contact=scene.term(SelfContact)) | {x.name: True for x in scene.interactions if x.apart}
    terms |= dict(contact_by_pairs=any(term.primitives is not None for term in scene.terms))
    terms |= dict(mesh_obstacles=_tables(scene), reduced_sets=scene.reduced)
    there = [name.replace("_", " ") for name, some in terms.items() if some]
    return f"it has {' and '.join(there)}" if there else None


def _why_not_joined(solver) -> str | None:
    """The same of scenes whose implicit steps are solved together (joined_newton.py)."""
    scene = solver.scene
    terms = dict(
        self_contact=scene.term(SelfContact), contact_by_pairs=any(t.primitives is not None for t in scene.terms)
    )
    terms |= dict(
        mesh_obstacles=_tables(scene), reduced_sets_or_ties=scene.reduced, chambers_of_given_volume=scene.holds_volumes
    )
    terms |= dict(robots=scene.terms_of(Robot))
    there = [name.replace("_", " ") for name, some in terms.items() if some]
    if there:
        return f"it has {' and '.join(there)}"
    if solver.loose:
        return f"but for contact {solver.loose}, and each scene closes its contact by itself"
    values = scene.inputs.derive(scene.inputs.at_times([0.0, solver.dt]))
    hosts, u = host_forces(scene).take(values), values.displacement
    free = scene.supports.freedom(scene.mesh.num_vertices)
    hosts.restrict(free, values.rest)
    w = np.einsum("kij,kj->ki", free, np.random.default_rng(0).standard_normal(u.shape))
    own = [type(x).__name__ for x in hosts if not (x.symmetric and _is_matrix(x, u, w))]
    return f"the Hessian of {' and '.join(own)} is no symmetric sparse matrix" if own else None


def _is_matrix(host, u: np.ndarray, w: np.ndarray) -> bool:
    """Whether the product with w is that of the matrix that a host force knows."""
    matrix, product = host.matrix(u), host.product(u, w)
    return matrix is not None and np.allclose(matrix @ w.ravel(), product.ravel(), 1e-9, 1e-9 * np.abs(product).max())


def _tables(scene) -> bool:
    return any(term.table.size for term in scene.ordered_terms if term.acts_on_surface)


def placed(arrays, name: str, x: np.ndarray) -> np.ndarray:
    """Numbers `name` of a scene, those of tetrahedra in the order of places: by patches, where there are some, whose
    repetitions have no volume."""
    of_all = name == "coefficients" and x.ndim == 1
    if isinstance(arrays.place, slice) or name not in ("elements", "coefficients", "gradients", "volumes") or of_all:
        return x
    rows = x[arrays.order]
    return rows * arrays.alone.reshape(-1, *[1] * (x.ndim - 1)) if name == "volumes" else rows


def growths_placed(arrays, growths: list[np.ndarray | None]) -> np.ndarray:
    """Growths of scenes, (rows, 2, 1 or num_tetrahedra) each, as (scenes, rows, 2 places): beginning and end of a step of
    each tetrahedron in turn. Zeros of one place where none grows over time."""
    if growths[0] is None:
        return np.zeros((len(growths), 1, 2))
    whole = np.stack([np.broadcast_to(x, (*x.shape[:2], arrays.num_tetrahedra)) for x in growths])
    each = whole if isinstance(arrays.place, slice) else whole[..., arrays.order]
    return np.swapaxes(each, 2, 3).reshape(*whole.shape[:2], -1)
