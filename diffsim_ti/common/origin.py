"""Places far from the origin of coordinates: what is taken from them, in float64, before float32 rounds them.

float32 resolves x to 2^-24 |x|: 0.6 m at 1e7 m. Kernels of a scene in float32 therefore have places less `Scene.origin`,
near the middle of the mesh, which is zero along each axis where the middle is within FAR body lengths: such a scene keeps
its numbers as they are. An obstacle that its path takes far from where it was made has its numbers near that place, and its
path from there. Displacements u = x - X stay what they are. What float32 cannot resolve all the same is warned of.
"""

import numpy as np

from diffsim_ti.common.warn import warn

FAR = 16  # body lengths
ROUNDING = 2.0**-24
OF_EDGES, OF_WIDTHS = 2e-4, 1e-2  # what rounding may be, of the shortest edge and of a barrier's width
START_NEARER = "start nearer to where the mesh is (mesh.translated), or pass precision='f64'"


def far_part(x: np.ndarray, length: float) -> np.ndarray:
    """x rounded to a power of two near `length` [m], along axes where it is farther than FAR of these; else zero."""
    unit = 2.0 ** np.round(np.log2(length))
    return np.where(np.abs(x) > FAR * length, np.round(x / unit) * unit, 0.0)


def middle_far_part(points: np.ndarray) -> np.ndarray:
    """That of the middle of points, shape (k, 3) [m], by their extent; of one point, by a metre."""
    low, high = points.min(0), points.max(0)
    return far_part(0.5 * (low + high), float((high - low).max()) or 1.0)


def positions_of(scene, rest: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Positions [m] in the precision of displacements u, in float64 where that would cost digits: far from the origin."""
    warn_of_rounding("displacements", u, scene.mesh, START_NEARER)
    return rest + u if scene.origin.any() else (rest + u).astype(u.dtype)


def rounding_of(x) -> float:
    """What float32 rounds numbers by at most that are an array or tensor in float32; 0 for others."""
    if "float32" not in str(getattr(x, "dtype", "")) or 0 in x.shape:
        return 0.0
    with np.errstate(all="ignore"):
        return ROUNDING * float(abs(x).max())


def warn_of_rounding(what: str, x, mesh, remedy: str) -> None:
    """Where numbers [m] in float32 are too coarse for a mesh; other precisions pass."""
    largest = rounding_of(x) / ROUNDING
    if not np.ptp(mesh.vertices, 0).max() < largest < np.inf:
        return
    coarse, shortest = ROUNDING * largest, np.linalg.norm(np.diff(mesh.vertices[mesh.edges], axis=1), axis=2).min()
    if coarse > OF_EDGES * shortest:
        warn(
            f"{what}: float32 resolves {largest:.3g} m to {coarse:.2g} m, {coarse / shortest:.2g} of the mesh's shortest "
            f"edge, and what is made of it is off by that: {remedy}"
        )


def warn_of_coarse_places(scene) -> None:
    """Where places were given in float32, or where the start's displacements, or numbers of obstacles near the body, are too
    large for it."""
    inputs = scene.inputs
    for name, described in inputs.described.items():
        if described.single and described.axes:
            warn_of_rounding(name, described.value.astype(np.float32), scene.mesh, "give it in float64")
    if scene.precision != "f32":
        return
    away = inputs.values["initial_positions"] - inputs.values["rest_positions"]
    warn_of_rounding("initial displacements", away.astype(np.float32), scene.mesh, START_NEARER)
    barriers = [term for term in scene.obstacles if "barrier_width" in term.values]
    parameters, places = inputs.derive(inputs.values).parameters if barriers else (), scene.places(0.0)
    for term in barriers:
        known = [i for i in term.described if i.value is not None]
        lengths = np.repeat([i.unit == "m" for i in known], [i.value.size for i in known])
        largest = float(np.abs(parameters[inputs.parameters.of(term)][lengths]).max())
        coarse, width = ROUNDING * largest, float(term.values["barrier_width"])
        if coarse > OF_WIDTHS * width:
            x = inputs.values["initial_positions"][scene.mesh.surface_vertices]
            if term.gap(x, places.get(term, np.zeros(3))).min() < FAR * inputs.length:
                warn(
                    f"{term!r}: float32 resolves its {largest:.3g} m to {coarse:.2g} m, {coarse / width:.2g} of the "
                    "barrier's width, and contacts are off by that: pass precision='f64', or a part of it that is near the "
                    "body, with about= near it where it turns"
                )
