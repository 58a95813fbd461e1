"""What a mesh is, in a few lines for people, and as a number for files."""

import hashlib
from typing import TYPE_CHECKING

import numpy as np

from diffsim_ti.mesh import jacobian
from diffsim_ti.mesh.sets import sizes

if TYPE_CHECKING:
    from diffsim_ti.mesh.tetrahedral_mesh import TetrahedralMesh


def describe(mesh: "TetrahedralMesh") -> str:
    """Counts, size, edge lengths, worst tetrahedron, sets."""
    low, high = mesh.bounding_box
    lengths = np.linalg.norm(np.diff(mesh.vertices[mesh.edges], axis=1)[:, 0], axis=1)
    worst, thin = int(np.argmin(mesh.quality)), int(np.argmin(mesh.altitudes.min(1)))
    orphans = len(mesh.unused_vertices)
    return "\n".join(
        [
            f"TetrahedralMesh: {mesh.num_vertices} vertices"
            + (f" ({orphans} unused)" if orphans else "")
            + f", {mesh.num_tetrahedra} tetrahedra, {mesh.num_pieces} {'piece' if mesh.num_pieces == 1 else 'pieces'}",
            f"surface: {len(mesh.surface_triangles)} triangles, {len(mesh.surface_vertices)} vertices",
            "size: " + " x ".join(f"{d:.6g}" for d in high - low) + f" m, from ({_numbers(low)}) to ({_numbers(high)})",
            f"volume: {mesh.volume:.6g} m^3",
            *_ten_nodes(mesh),
            f"edges: {lengths.min():.4g} to {lengths.max():.4g} m, mean {lengths.mean():.4g} m",
            f"worst quality: {mesh.quality[worst]:.3g} in tetrahedron {worst}; mean {mesh.quality.mean():.3g} of 1",
            f"smallest altitude: {mesh.altitudes[thin].min():.4g} m in tetrahedron {thin}",
            f"vertex sets: {sizes(mesh.vertex_sets)}",
            f"tetrahedron sets: {sizes(mesh.tetrahedron_sets)}",
            f"surface sets: {sizes(mesh.surface_sets)}",
        ]
    )


def _ten_nodes(mesh: "TetrahedralMesh") -> list[str]:
    if mesh.order == 1:
        return []
    text = f"ten-node tetrahedra: {len(mesh.corners)} corners, {len(mesh.middles)} mid-edge vertices"
    if not mesh.curved.any():
        return [f"{text}, straight edges"]
    J = lowest_jacobian(mesh)
    worst = int(np.argmin(J))
    bound = f"lowest bound of J over its mean {J[worst]:.3g} in tetrahedron {worst}"
    return [f"{text}; {mesh.curved.sum()} are curved, {bound}"]


def lowest_jacobian(mesh: "TetrahedralMesh") -> np.ndarray:
    """Lower bound of J = det dx/dxi over its mean in each element, shape (num_tetrahedra,); 1 where edges are straight."""
    out = np.ones(mesh.num_tetrahedra)
    some = mesh.curved
    out[some] = jacobian.lowest(mesh.vertices[mesh.elements[some]]) / (6 * mesh.volumes[some])
    return out


def _numbers(values) -> str:
    return ", ".join(f"{value:.6g}" for value in values)


def content_hash(mesh: "TetrahedralMesh") -> str:
    """SHA-256 of vertices and elements, 64 hexadecimal digits."""
    digest = hashlib.sha256(np.array([mesh.num_vertices, mesh.num_tetrahedra], "<i8").tobytes())
    digest.update(mesh.vertices.astype("<f8").tobytes())
    digest.update(mesh.elements.astype("<i8").tobytes())
    return digest.hexdigest()
