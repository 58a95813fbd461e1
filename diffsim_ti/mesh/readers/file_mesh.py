"""What a file holds of a mesh, and what of it goes into a TetrahedralMesh."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from diffsim_ti.mesh.geometry import sorted_faces
from diffsim_ti.mesh.sets import places_of_triangles

DIMENSION = {"vertex": 0, "line": 1, "line3": 1, "triangle": 2, "triangle6": 2, "tetra": 3, "tetra10": 3}
THIN = ("quad", "line4", "line5", "line6", "triangle7", "triangle10", "triangle15", "polygon")  # beginnings of kinds
UNGROUPED = 0  # the number of cells that belong to no group, in formats that number groups


@dataclass
class FileMesh:
    """points: (n, 3). blocks: (kind, cells of node indices, shape (m, k)); kinds in meshio's words, nodes in VTK's order.
    groups: name -> (block, rows), as often as the file says. point_sets: name -> node indices. faces: name -> triangles by
    their corners, of faces of tetrahedra. left_out: what else the file holds, one short text for each kind."""

    points: np.ndarray
    blocks: list[tuple[str, np.ndarray]] = field(default_factory=list)
    groups: dict[str, list[tuple[int, np.ndarray]]] = field(default_factory=dict)
    point_sets: dict[str, np.ndarray] = field(default_factory=dict)
    faces: dict[str, np.ndarray] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)

    def group(self, name: str, block: int, rows: np.ndarray) -> None:
        """Add rows of a block to a group."""
        if len(rows):
            self.groups.setdefault(name, []).append((block, np.asarray(rows, np.int64)))

    def group_by_number(self, numbers: list, names: dict | None = None, base: str = "tag", named_zero=False) -> None:
        """Groups of cells that share a number: `<base>_<number>`, or names[dimension, number].

        numbers: an array for each block, or None. A number that all tetrahedra share tells nothing apart, nor does 0, which
        stands for no group unless named_zero.
        """
        volumes = [n for n, (kind, _) in zip(numbers, self.blocks) if n is not None and DIMENSION.get(kind) == 3]
        used = np.unique(np.concatenate(volumes)) if volumes else np.zeros(0)
        for k, (rows, (kind, _)) in enumerate(zip(numbers, self.blocks)):
            dim = DIMENSION.get(kind)
            if rows is None or dim is None:
                continue
            for number in np.unique(rows).tolist():
                name = (names or {}).get((dim, number))
                if name is None and ((number == UNGROUPED and not named_zero) or (dim == 3 and len(used) == 1)):
                    continue
                self.group(name or f"{base}_{number}", k, np.nonzero(rows == number)[0])


def parts_of(mesh: FileMesh, again: bool = False) -> tuple[tuple, list[str]]:
    """((vertices, elements of four or ten nodes, vertex sets, tetrahedron sets, triangles by name), what is left out).

    again: the file may list a tetrahedron once for each of its groups.
    """
    left_out = [*mesh.left_out, *_check_kinds(mesh)]
    volumes = [k for k, (kind, _) in enumerate(mesh.blocks) if DIMENSION.get(kind) == 3]
    offset = dict(zip(volumes, np.cumsum([0] + [len(mesh.blocks[k][1]) for k in volumes])))
    tetrahedra = np.concatenate([mesh.blocks[k][1] for k in volumes])
    vertex_sets = {name: [rows] for name, rows in mesh.point_sets.items()}
    triangles = {name: [rows] for name, rows in mesh.faces.items()}
    for name, rows in mesh.faces.items():
        vertex_sets.setdefault(name, []).append(rows.ravel())
    tetrahedron_sets = {}
    for name, parts in mesh.groups.items():
        for k, rows in parts:
            kind, cells = mesh.blocks[k]
            dim = DIMENSION.get(kind)
            if dim == 3:
                tetrahedron_sets.setdefault(name, []).append(rows + offset[k])
            elif dim is not None:
                vertex_sets.setdefault(name, []).append(cells[rows].ravel())
                if dim == 2:
                    triangles.setdefault(name, []).append(cells[rows, :3])
    join = _joined(tetrahedron_sets)
    if again:
        tetrahedra, join = _merge_repeated(tetrahedra, join)
    triangles = {name: np.concatenate(parts).astype(np.int64).reshape(-1, 3) for name, parts in triangles.items()}
    _check_indices(mesh, tetrahedra)
    left_out += _left_over(mesh, tetrahedra, triangles)
    return (mesh.points, tetrahedra, _joined(vertex_sets), join, triangles), left_out


def beside(path: Path, name: str, says: str, remedy: str, suffix: str = "") -> Path:
    """The file that another one names, in its folder or below. Raises ValueError where it is not there."""
    target, folder = (path.parent / name).resolve(), path.parent.resolve()
    if not name or not target.is_relative_to(folder) or suffix and target.suffix.lower() != suffix:
        kind = f"no {suffix} file within its folder" if suffix else f"outside of the folder of {path.name}"
        raise ValueError(f"{says} {name!r}, which is {kind}; {remedy}")
    if not target.is_file():
        raise ValueError(f"{says} {name!r}, which is not there; {remedy}")
    return target


def _joined(sets: dict) -> dict[str, np.ndarray]:
    return {name: np.unique(np.concatenate(parts)).astype(np.int64) for name, parts in sets.items()}


def _check_indices(mesh: FileMesh, tetrahedra: np.ndarray) -> None:
    """Cells beside tetrahedra name points that there are; those of tetrahedra are checked where the mesh is made."""
    for kind, cells in mesh.blocks:
        if cells.size and (cells.min() < 0 or cells.max() >= len(mesh.points)):
            wrong = cells.min() if cells.min() < 0 else cells.max()
            raise ValueError(f"a {kind} names point {wrong}, but there are {len(mesh.points)}; export the file again")


def _check_kinds(mesh: FileMesh) -> list[str]:
    """Cells that are left out, as a text; raises ValueError for what must not be."""
    found = {}
    for kind, cells in mesh.blocks:
        found[kind] = found.get(kind, 0) + len(cells)
    other = sorted(set(found) - set(DIMENSION))
    listing = ", ".join(f"{kind} ({count})" for kind, count in found.items()) or "none"
    if any(kind.startswith("tetra") for kind in other) or {"tetra", "tetra10"} <= set(found):
        raise ValueError(
            f"a file holds tetrahedra of four nodes, or of ten; cell types found: {listing}; export elements of order 1 or "
            "2 (in Gmsh: Mesh.ElementOrder = 2)"
        )
    if not found.get("tetra", 0) and not found.get("tetra10", 0):
        raise ValueError(
            f"the file holds no tetrahedra; cell types found: {listing}; fill the surface with tetrahedra first, "
            "for example by TetrahedralMesh.from_surface, Gmsh or fTetWild"
        )
    solid = [kind for kind in other if not kind.startswith(THIN)]
    if solid:
        raise ValueError(
            f"tetrahedra beside {', '.join(solid)} cells cannot be read, as these would be lost; cell types found: "
            f"{listing}; mesh the body with tetrahedra alone"
        )
    return [f"{found[kind]} {kind} cells" for kind in other]


def _left_over(mesh: FileMesh, tetrahedra: np.ndarray, triangles: dict) -> list[str]:
    """Triangles that are no faces of tetrahedra, and named ones within the body, which no surface set keeps."""
    thin = [cells[:, :3] for kind, cells in mesh.blocks if DIMENSION.get(kind) == 2]
    if not thin and not triangles:
        return []
    own = np.concatenate(thin) if thin else np.zeros((0, 3), np.int64)
    if tetrahedra.min() < 0 or tetrahedra.max() >= len(mesh.points):  # refused where the mesh is made
        return []
    faces, order, same = sorted_faces(tetrahedra[:, :4], len(mesh.points))
    inner = np.zeros(len(order), bool)
    inner[order[:-1][same]] = inner[order[1:][same]] = True
    out, alone = [], places_of_triangles(own, faces) < 0
    if alone.any():
        out.append(f"{alone.sum()} triangles that are no faces of tetrahedra")
    within = {n: int((places_of_triangles(rows, faces[inner]) >= 0).sum()) for n, rows in triangles.items()}
    named = ", ".join(f"{name} ({count})" for name, count in within.items() if count)
    if named:
        out.append(f"triangles within the body, of which vertex sets keep the vertices: {named}")
    return out


def _merge_repeated(tetrahedra: np.ndarray, sets: dict) -> tuple[np.ndarray, dict]:
    """Gmsh 2.2 lists a tetrahedron once per physical group that holds it; keep the first and all its groups."""
    _, first, inverse = np.unique(tetrahedra, axis=0, return_index=True, return_inverse=True)
    if len(first) == len(tetrahedra):
        return tetrahedra, sets
    groups_of = np.zeros(len(tetrahedra), np.int64)
    for rows in sets.values():
        groups_of[rows] += 1
    if np.any(groups_of[np.setdiff1d(np.arange(len(tetrahedra)), first)] == 0):
        return tetrahedra, sets  # true repetitions: the mesh's own check reports them
    keep = np.sort(first)
    new = np.searchsorted(keep, first[inverse.ravel()])
    return tetrahedra[keep], {name: np.unique(new[rows]) for name, rows in sets.items()}
