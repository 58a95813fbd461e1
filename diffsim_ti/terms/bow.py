"""What self-contact makes of curved faces: four flat triangles each."""

import warnings

from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.face_points import bow


def warn_of_bow(mesh: TetrahedralMesh, term) -> None:
    """Warn where curved faces lie further from their triangles than a barrier is wide: that much they may reach through."""
    off, width = bow(mesh), next((float(x) for name, x in term.values.items() if name.endswith("width")), None)
    if width is not None and off > width:
        warnings.warn(
            f"{type(term).__name__}: faces of this mesh are curved, and lie up to {off:.3g} m from the four triangles that "
            f"stand for each in contact, which is more than the barrier's width {width:.3g} m: refine the mesh where it is "
            "curved, or take a wider barrier",
            stacklevel=4,
        )
