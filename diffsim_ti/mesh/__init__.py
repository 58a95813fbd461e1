"""Meshes of tetrahedra at rest: made, loaded, checked, saved."""

from diffsim_ti.mesh.tetrahedral_mesh import TetrahedralMesh

__all__ = ["TetrahedralMesh"]
