"""Motions without strain that a scene leaves its body: rigid ones, and those about hinges.

At rest, without load, the energy of a displacement vanishes where each part, tetrahedra that are joined by faces, moves
rigidly and nothing that holds the parts resists it. Each thing that does is a row, a wrench (F, X x F) on one part or more:
a support or a foundation in a direction F, a spring or an elastic cable along its path, a vertex that parts share, in three.
Pellegrino, Calladine 1986, Matrix analysis of statically and kinematically indeterminate frameworks,
doi:10.1016/0020-7683(86)90014-4.
"""

import numpy as np

from diffsim_ti.mechanics.interactions import host_forces
from diffsim_ti.mesh.geometry import inner_faces
from diffsim_ti.mesh.sets import components, pieces
from diffsim_ti.terms import Robot
from diffsim_ti.terms.supports import motions_left

MOST = 200  # parts that hang on each other, whose motions are found together


def free_motions(scene) -> str:
    """What moves without strain, and what to do, in words; "" if nothing does."""
    rows = Rows(scene)
    ground = rows.grounded()
    for component in rows.components(ground):
        found = len(component) <= MOST and rows.described(component, ground)
        if found:
            return found
    return ""


def parts_of(mesh) -> np.ndarray:
    """For each tetrahedron the number of the part, joined by faces, that it belongs to."""
    pairs, _ = inner_faces(mesh.tetrahedra, mesh.num_vertices)
    return components(*pairs.T, mesh.num_tetrahedra)


class Rows:
    """Wrenches on the parts of a scene's body, and on its reduced sets, which are parts that share their vertices.

    row, part, wrench: of each entry; shared: of each row the vertex that parts share, or -1.
    """

    def __init__(self, scene):
        self.mesh = mesh = scene.mesh
        self.X, n = mesh.vertices - mesh.vertices.mean(0), mesh.num_vertices
        self.part_of = parts_of(mesh)
        count = self.part_of.max(initial=-1) + 1
        owned = np.unique(np.repeat(self.part_of, mesh.elements.shape[1]) * np.int64(n) + mesh.elements.ravel())
        sets = [body.vertices + (count + k) * n for k, body in enumerate(scene.reduced.bodies if scene.reduced else [])]
        part, vertex = np.divmod(np.concatenate([owned, *sets]).astype(np.int64), n)
        self.count, order = count + len(sets), np.argsort(vertex, kind="stable")
        self.parts, self.vertices = part[order], vertex[order]
        used, begin = np.unique(self.vertices, return_index=True)
        self.first = np.full(n, -1)  # part of each vertex
        self.first[used] = self.parts[begin]
        size = np.bincount(self.parts, minlength=self.count)[:, None]
        self.middle = np.stack([np.bincount(self.parts, x, self.count) for x in self.X[self.vertices].T], 1) / size
        arms, self.size = np.linalg.norm(self.X[self.vertices] - self.middle[self.parts], axis=1), np.zeros(self.count)
        np.maximum.at(self.size, self.parts, arms)
        self._entries, self.num_rows, self.shared = [], 0, []
        self._add_held(scene.supports.vertices, scene.supports.held)
        for _, vertices in (x for robot in scene.terms_of(Robot) for x in robot.holds):
            self._add_held(vertices, np.tile(np.eye(3), (len(vertices), 1, 1)))
        self._add_shared(np.setdiff1d(np.arange(len(self.vertices)), begin))
        derived = scene.inputs.derive(scene.inputs.at_times([0.0])) if scene.interactions else None
        for force in host_forces(scene).take(derived):
            self._add_resisted(*force.resisted())
        self.row, self.part, self.wrench = (np.concatenate(x) for x in zip(*self._entries))
        self.shared = np.concatenate(self.shared)

    def _add(self, row, part, place, force, shared) -> None:
        """Entries of new rows, which are counted from 0; shared: of each row."""
        wrench = np.concatenate([force, np.cross(self.X[place] if place.ndim == 1 else place, force)], 1)
        self._entries.append((self.num_rows + row, part, wrench))
        self.num_rows += len(shared)
        self.shared.append(shared)

    def _add_held(self, vertices, held) -> None:
        own = self.first[vertices] >= 0
        vertices, held = np.repeat(vertices[own], 3), held[own].reshape(-1, 3)
        self._add(np.arange(len(held)), self.first[vertices], vertices, held, np.full(len(held), -1))

    def _add_shared(self, others) -> None:
        """Vertices that are in other parts, too, than their first."""
        vertices = np.repeat(self.vertices[others], 3)
        rows, unit = np.arange(len(vertices)), np.tile(np.eye(3), (len(others), 1))
        both = np.concatenate([self.first[vertices], np.repeat(self.parts[others], 3)])
        self._add(np.tile(rows, 2), both, np.tile(vertices, 2), np.concatenate([unit, -unit]), vertices)

    def _add_resisted(self, row, vertex, force) -> None:
        """What a host force resists (mechanics/host_force.py)."""
        own = self.first[vertex] >= 0
        row, vertex, count = row[own], vertex[own], row.max(initial=-1) + 1
        self._add(row, self.first[vertex], vertex, force[own], np.full(count, -1))

    def grounded(self) -> np.ndarray:
        """Mask over the parts that are held by what is fixed, and by parts that are held so."""
        ground = np.zeros(self.count, bool)
        while True:
            free = ~ground[self.part]
            least, most = np.full(self.num_rows, self.count), np.full(self.num_rows, -1)
            np.minimum.at(least, self.row[free], self.part[free])
            np.maximum.at(most, self.row[free], self.part[free])
            own = np.flatnonzero(free & (least == most)[self.row])  # of rows that act on one part alone
            own = own[np.argsort(self.part[own], kind="stable")]
            parts = np.split(own, np.flatnonzero(np.diff(self.part[own])) + 1) if len(own) else []
            new = [self.part[k[0]] for k in parts if not motions_left(self._resistance(k, self.part[k[:1]]))]
            if not new:
                return ground
            ground[new] = True

    def _resistance(self, entries, parts, together: bool = True) -> np.ndarray:
        """What rows resist of motions about the middle of parts, scaled by their size: shape (rows, 6) of all together, or
        (rows, parts, 6) of each."""
        rows, row = np.unique(self.row[entries], return_inverse=True)
        mine = np.isin(self.parts, parts)
        middle, place = self.X[self.vertices[mine]].mean(0), np.searchsorted(parts, self.part[entries])
        size = np.linalg.norm(self.X[self.vertices[mine]] - middle, axis=1).max()
        if not together:
            middle, size = self.middle[self.part[entries]], self.size[self.part[entries], None]
        force, moment = np.hsplit(self.wrench[entries], 2)
        out = np.zeros((len(rows), 1 if together else len(parts), 6))
        np.add.at(out, (row, 0 if together else place), np.hstack([force, (moment - np.cross(middle, force)) / size]))
        return out[:, 0] if together else out

    def components(self, ground) -> list[np.ndarray]:
        """Parts that are not held each by itself, in groups that act on each other."""
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components

        free, shape = ~ground[self.part], (self.num_rows, self.count)
        acts = coo_matrix((np.ones(free.sum()), (self.row[free], self.part[free])), shape).tocsr()
        label = connected_components(acts.T @ acts, directed=False)[1]
        left = np.flatnonzero(~ground)
        return [left[label[left] == k] for k in np.unique(label[left])]

    def described(self, component: np.ndarray, ground: np.ndarray) -> str:
        """The motions that a component has, in words; "" if none."""
        entries = np.flatnonzero(np.isin(self.part, component))
        rows = self._resistance(entries, component, together=False).reshape(-1, 6 * len(component))
        sizes = np.linalg.svd(rows, compute_uv=False)
        left = rows.shape[1] - int((sizes > 1e-8 * max(sizes.max(initial=0.0), 1.0)).sum())
        if not left:
            return ""
        whole = motions_left(self._resistance(entries, component))
        mine, shared = np.isin(self.parts, component), self.shared[np.unique(self.row[entries])]
        outside = np.intersect1d(self.vertices[mine], self.vertices[ground[self.parts]])
        hinge = np.unique(outside if len(outside) else shared[shared >= 0])
        if len(hinge) and (len(outside) or not whole):
            own = self.mesh.tetrahedra[np.isin(self.part_of, component)]
            at = ", ".join(map(str, hinge[:6])) + (", ..." if len(hinge) > 6 else "")
            about = np.round(self.mesh.vertices[own].mean((0, 1)), 6).tolist()
            return (
                f"{len(own)} tetrahedra about {about} meet others, or each other, at vertices or edges alone "
                f"(vertices {at}): a hinge, about which they turn without strain ({whole or f'{left} motions'}), a "
                "mechanism; join them by faces, leave them out of the mesh, hold them"
            )
        number = pieces(self.mesh)
        every = np.unique(number[self.mesh.tetrahedra[:, 0]])
        own = np.unique(np.searchsorted(every, number[self.vertices[mine]])).tolist()
        many = f"pieces {', '.join(map(str, own))} of {len(every)} of the body, which springs or cables join, are"
        one = "the body is" if len(every) == 1 else f"piece {own[0]} of {len(every)} of the body is"
        which = many if len(own) > 1 else one
        motions = f"rigidly ({whole})" if whole else f"against each other without strain ({left} motions)"
        return (
            f"{which} free to move {motions}: hold it by fixed=..., at three vertices that do not lie on a line or in as "
            "many directions as that takes, by springs, elastic cables that are not slack, or foundations"
        )
