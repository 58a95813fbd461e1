"""Where a scene's tetrahedra lock: they resist changes of volume, and so bend too little, as Poisson's ratio nears 0.5."""

from typing import TYPE_CHECKING

from diffsim_ti.common.warn import warn
from diffsim_ti.materials.patch_law import PatchLaw
from diffsim_ti.terms import Growth

if TYPE_CHECKING:
    from diffsim_ti.scene import Scene

LOCKING_RATIO = 0.45  # Poisson's ratio above which linear tetrahedra lock noticeably
LOCKING_RATIO_OF_TEN_NODES = 0.49  # beyond it their mean dilatation is the better


def _averages(scene: "Scene") -> bool:
    """Whether patches support the scene's law."""
    try:
        PatchLaw(scene.precision, scene.law)
    except ValueError:
        return False
    return scene.term(Growth) is None


def warn_if_locking(scene: "Scene") -> None:
    """Warn, as from where the scene is made."""
    nu, linear = scene.largest_poissons_ratio(), scene.mesh.order == 1
    limit, kind = (LOCKING_RATIO, "linear") if linear else (LOCKING_RATIO_OF_TEN_NODES, "ten-node")
    remedy = "take mesh.quadratic(), " if linear else ""
    if _averages(scene):
        remedy += 'pass volume="patches" to the Scene, '
    if scene.law.plastic and linear:
        warn(
            f"{scene.material.name}: linear tetrahedra lock (carry too much load) once they flow, which keeps the volume: "
            f"{remedy.removesuffix(', ')}"
        )
    elif nu > limit + 1e-12:
        warn(
            f"{scene.material.name}: Poisson's ratio {nu:.6g} is above {limit}, where {kind} tetrahedra lock (bend too "
            f'little): {remedy}cut the cells of create_box with pattern="five", refine the mesh, or lower the ratio'
        )
