"""What self-contact leaves out of curved faces."""

import warnings

from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.collision_surface import cuts_of
from diffsim_ti.mesh.face_points import bow


def warn_of_bow(mesh: TetrahedralMesh, term) -> None:
    """Warn where curved faces lie further from the triangles that stand for them than the width: so far they may reach
    through."""
    width = float(term.values["self_contact_width"])
    off = bow(mesh) / 4 ** cuts_of(mesh, term)
    if off > width:
        warnings.warn(
            f"{type(term).__name__}: faces of this mesh are curved, and lie up to {off:.3g} m from the triangles that "
            f"stand for each, more than the width {width:.3g} m: refine the mesh where it is curved, or take a wider one",
            stacklevel=4,
        )
