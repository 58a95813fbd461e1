"""What helps tetrahedra against locking: four elements side by side, on small strains and nu up to 0.4999.

    tetrahedra   linear, lam/2 tr(e)^2 in each
    nodal        the same with tr(e) averaged over the tetrahedra round each vertex (average nodal pressure;
                 Bonet, Burton 1998, doi:10.1002/(SICI)1099-0887(199805)14:5<437::AID-CNM162>3.0.CO;2-W)
    patches      the same with tr(e) averaged over patches of up to eight: `Scene(..., volume="patches")`
    quadratic    ten vertices, four points of integration; on half as many cells, so about as many unknowns

Three problems with known answers: a cantilever's drop under its own weight (share of the exact one), Cook's membrane in
plane strain (share of the corner's rise), and the Lamé mode of a free cube (frequency over the exact one, in which lam has
no part, since the mode is free of divergence). The matrices are assembled here with SciPy, apart from diffsim_ti's kernels;
the last line holds the two against each other.

    python examples/benchmarks/locking.py
"""

import time

import numpy as np
from scipy.sparse import coo_matrix, diags, kron
from scipy.sparse.linalg import eigsh, splu

import diffsim_ti as ds
from diffsim_ti.mesh.patches import volume_patches

ELEMENTS = ("tetrahedra", "nodal", "patches", "quadratic")
EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
E, RHO, G = 1e6, 1000.0, 9.81
# Limits of quadratic elements with a constant pressure in each, which do not lock, to about 0.3 %: the drop of the beam's
# end [m], and the rise of the membrane's corner for E = 70 and a traction of 6.25 [mm]
DROP = {0.3: 0.3765, 0.4999: 0.3653}
RISE = {0.3: 32.95, 0.4999: 27.75}


def sparse(rows, columns, values, shape):
    return coo_matrix((values.ravel(), (rows.ravel(), columns.ravel())), shape).tocsr()


class System:
    """Stiffness K, lumped mass m (per vertex) and mass matrix M of a mesh of one kind of element, for E, nu."""

    def __init__(self, mesh: ds.TetrahedralMesh, nu: float, element: str):
        mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
        self.X, self.tets, V = mesh.vertices, mesh.tetrahedra, mesh.volumes
        points = [(mesh.shape_gradients, 1.0)]
        share = np.full((4, 4), 0.0) + np.eye(4) / 4  # of an element's mass, lumped
        if element == "quadratic":
            self._add_midpoints()
            points, share = quadratic_gradients(mesh.shape_gradients), quadratic_mass()
        n, m = len(self.X), len(self.tets)
        self.K, self.evaluations = 0, m * len(points)
        for N, weight in points:
            div = self._divergence(N)
            self.K = self.K + self._shear(N, weight * V * mu)
            if element in ("tetrahedra", "quadratic"):
                self.K = self.K + div.T @ diags(weight * V * lam) @ div
        if element in ("nodal", "patches"):  # rows of `mean` average over the tetrahedra of a vertex or patch
            groups, part = (self.tets, 4) if element == "nodal" else (volume_patches(mesh)[:, None], 1)
            parts, column = np.repeat(V / part, part), np.repeat(np.arange(m), part)
            sizes = np.bincount(groups.ravel(), parts)
            mean = sparse(groups, column, parts / sizes[groups.ravel()], (len(sizes), m)) @ div
            self.K = self.K + mean.T @ diags(sizes * lam) @ mean
        a = self.tets.shape[1]
        rows, columns = np.repeat(self.tets, a, 1), np.tile(self.tets, (1, a))
        self.M = kron(sparse(rows, columns, RHO * V[:, None, None] * share, (n, n)), np.eye(3)).tocsc()
        lump = np.diag(share) / np.trace(share)
        self.m = RHO * np.bincount(self.tets.ravel(), (V[:, None] * lump).ravel(), n)
        self.loads = np.bincount(self.tets.ravel(), (V[:, None] * share.sum(1)).ravel(), n)  # of a unit body force

    def _add_midpoints(self):
        ends = np.sort(np.concatenate([self.tets[:, list(e)] for e in EDGES]), 1)
        unique, inverse = np.unique(ends, axis=0, return_inverse=True)
        self.tets = np.concatenate([self.tets, len(self.X) + inverse.reshape(6, -1).T], 1)
        self.X = np.concatenate([self.X, self.X[unique].mean(1)])

    def _unknowns(self):
        return (3 * self.tets[:, :, None] + np.arange(3)).reshape(len(self.tets), -1)

    def _divergence(self, N):
        rows = np.broadcast_to(np.arange(len(N))[:, None], (len(N), 3 * N.shape[1]))
        return sparse(rows, self._unknowns(), N.reshape(len(N), -1), (len(N), 3 * len(self.X)))

    def _shear(self, N, weight):
        same = np.einsum("eai,ebi,jk->eajbk", N, N, np.eye(3)) + np.einsum("eak,ebj->eajbk", N, N)
        size, at = 3 * N.shape[1], self._unknowns()
        values = (weight[:, None, None, None, None] * same).reshape(len(N), size, size)
        return sparse(np.repeat(at, size, 1), np.tile(at, (1, size)), values, (3 * len(self.X),) * 2)

    def solve(self, free, forces):
        """Displacements [m] of all vertices."""
        free, u = np.flatnonzero(free.ravel()), np.zeros(3 * len(self.X))
        K = self.K[free][:, free].tocsc()
        u[free] = splu(K, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(forces.ravel()[free])
        self.unknowns = len(free)
        return u.reshape(-1, 3)

    def stable_step(self) -> float:
        """2 / omega_max with lumped masses [s]."""
        root = diags(np.repeat(self.m, 3) ** -0.5)
        return 2 / np.sqrt(eigsh(root @ self.K @ root, 1, which="LA", tol=1e-3, return_eigenvectors=False)[0])


def quadratic_gradients(G4: np.ndarray) -> list:
    """(gradients of the ten shape functions, weight) at the four points."""
    a = (5 - np.sqrt(5)) / 20
    out = []
    for L in np.full((4, 4), a) + (1 - 4 * a) * np.eye(4):
        corners = [(4 * L[i] - 1) * G4[:, i] for i in range(4)]
        out.append((np.stack(corners + [4 * (L[i] * G4[:, j] + L[j] * G4[:, i]) for i, j in EDGES], 1), 0.25))
    return out


def quadratic_mass() -> np.ndarray:
    """Integral of N_a N_b over a tetrahedron of volume one."""
    out = np.zeros((10, 10))
    out[:4, :4] = 1 + 5 * np.eye(4)
    for k, edge in enumerate(EDGES):
        out[:4, 4 + k] = out[4 + k, :4] = [-4 if i in edge else -6 for i in range(4)]
        for other, pair in enumerate(EDGES):
            out[4 + k, 4 + other] = {2: 32, 1: 16, 0: 8}[len(set(edge) & set(pair))]
    return out / 420


def beam_mesh(cells: int, pattern: str) -> ds.TetrahedralMesh:
    return ds.TetrahedralMesh.create_box((5 * cells + 1, cells + 1, cells + 1), (1.0, 0.2, 0.2), pattern=pattern)


def beam(cells, pattern, nu, element):
    """(drop of the end face's vertices over the exact one, system)."""
    system = System(beam_mesh(cells, pattern), nu, element)
    free, forces = np.repeat(system.X[:, :1] > 1e-9, 3, 1), np.zeros(system.X.shape)
    forces[:, 1] = -RHO * G * system.loads
    u = system.solve(free, forces)
    return -u[system.X[:, 0] > 1 - 1e-9, 1].mean() / DROP[nu], system


def membrane(cells, pattern, nu, element):
    """(rise of the corner over the exact one, system); one layer of cells, u_z = 0."""
    box = ds.TetrahedralMesh.create_box((cells + 1, cells + 1, 2), (1, 1, 1 / cells), pattern=pattern)
    s, r, q = box.vertices.T
    mesh = ds.TetrahedralMesh(np.stack([48 * s, 44 * s + r * (44 - 28 * s), 44 * q], 1), box.tetrahedra)
    system = System(mesh, nu, element)
    faces = mesh.surface_triangles
    faces = faces[(mesh.vertices[faces][:, :, 0] > 48 - 1e-9).all(1)]
    edges = np.diff(mesh.vertices[faces][:, [0, 1, 2]], axis=1)
    traction = 6.25 / 70 * E * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 6
    if element == "quadratic":  # a traction goes to the middles of a triangle's edges
        middles = {tuple(x): k for k, x in enumerate(np.round(system.X, 6))}
        faces = np.array(
            [[middles[tuple(x)] for x in np.round((x3 + np.roll(x3, 1, 0)) / 2, 6)] for x3 in mesh.vertices[faces]]
        )
    forces = np.zeros(system.X.shape)
    np.add.at(forces[:, 1], faces.ravel(), np.repeat(traction, 3))
    free = np.repeat(system.X[:, :1] > 1e-9, 3, 1) & [True, True, False]
    corner = (system.X[:, 0] > 48 - 1e-9) & (system.X[:, 1] > 60 - 1e-9)
    return system.solve(free, forces)[corner, 1].mean() / RISE[nu], system


def lame(cells, pattern, nu, element):
    """Frequency of the cube's Lamé mode q over the exact omega, from the forced response (K + omega^2 M) u = 2 omega^2 M q:
    u = q if the mesh has that mode; it moves by r = q M u / q M q, as a mode of frequency omega sqrt(2 / r - 1) would."""
    system = System(ds.TetrahedralMesh.create_cube(cells + 1, 1.0, pattern), nu, element)
    x, q = np.pi * system.X, np.zeros(system.X.shape)
    q[:, 0], q[:, 1] = np.cos(x[:, 0]) * np.sin(x[:, 1]), -np.sin(x[:, 0]) * np.cos(x[:, 1])
    omega2, weight = 2 * np.pi**2 * E / (2 * (1 + nu)) / RHO, system.M @ q.ravel()
    system.K = system.K + omega2 * system.M
    u = system.solve(np.ones(q.shape, bool), 2 * omega2 * weight)
    return np.sqrt(2 / ((weight @ u.ravel()) / (weight @ q.ravel())) - 1)


def product_drop(cells, pattern, nu, volume) -> float:
    """The share of `beam` from diffsim_ti."""
    mesh = beam_mesh(cells, pattern)
    scene = ds.Scene(mesh, ds.LinearElastic(E, nu), RHO, [ds.Gravity(-G)], "xmin", precision="f64", volume=volume)
    u = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-10), 1).forward().displacements[-1]
    return -u[mesh.vertex_sets["xmax"], 1].mean() / DROP[nu]


def main(quick: bool = False) -> dict:
    """{(nu, pattern, element): dict of the three ratios, unknowns, evaluations, step [s]} and "agreement", "seconds"."""
    start, out = time.perf_counter(), {}
    cells, ratios = (2, 4) if quick else (4, 8), (0.4999,) if quick else tuple(DROP)
    print(
        "share of the drop and of the rise, frequency ratio; unknowns, evaluations of the law, stable step of the beam"
    )
    for nu in ratios:
        for pattern in ("five", "kuhn"):
            for element in ELEMENTS:
                n, c = (k // (2 if element == "quadratic" else 1) for k in cells)
                drop, system = beam(n, pattern, nu, element)
                row = dict(
                    beam=drop,
                    cook=membrane(c, pattern, nu, element)[0],
                    lame=lame(n, pattern, nu, element),
                    unknowns=system.unknowns,
                    evaluations=system.evaluations,
                    step=system.stable_step(),
                )
                out[nu, pattern, element] = row
                print(
                    f"nu {nu:<6} {pattern} {element:10s} {row['beam']:.3f}  {row['cook']:.3f}  {row['lame']:.3f}; "
                    f"{row['unknowns']:5d} {row['evaluations']:5d}  {1e3 * row['step']:.3g} ms"
                )
    off = [
        product_drop(2, p, 0.4999, v) / beam(2, p, 0.4999, v)[0] - 1
        for p in ("five", "kuhn")
        for v in ("tetrahedra", "patches")
    ]
    out["agreement"], out["seconds"] = max(map(abs, off)), time.perf_counter() - start
    print(f"diffsim_ti differs from these matrices by {out['agreement']:.1g}; {out['seconds']:.1f} s")
    return out


if __name__ == "__main__":
    ds.init(precision="f64")
    main()
