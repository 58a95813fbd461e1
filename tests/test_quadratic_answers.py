"""Ten-node tetrahedra against known answers: the elastica, Cook's membrane, a thick plate, stress at surfaces."""

import numpy as np
import pytest

import diffsim_ti as ds
from diffsim_ti.mesh.reference_element import quadrature


def tip_of(scene: ds.Scene, place, load_steps: int = 1) -> np.ndarray:
    """Displacement of the vertex nearest to a place [m]."""
    u = ds.Rollout(ds.StaticSolver(scene, load_steps=load_steps), 1).forward().displacements[-1]
    return u[np.linalg.norm(scene.mesh.vertices - place, axis=1).argmin()]


# rho g A L^3 / (E I): x, drop of the tip over L
ELASTICA = {5.0: (0.8467, 0.4959), 10.0: (0.6564, 0.7002), 50.0: (0.2450, 0.9079)}


def elastica(number: float, cells=(50, 2, 2)) -> ds.Scene:
    """Under its own weight, nu 0, a square section, length over height 50."""
    h, E = 0.02, 1e7
    mesh = ds.TetrahedralMesh.create_box(np.add(cells, 1), (1.0, h, h), "five").quadratic()
    density = number * E * h**2 / 12 / 9.81
    return ds.Scene(mesh, ds.StableNeoHookean(E, 0.0), density, ds.Gravity(), fixed="xmin", precision="f64")


@pytest.mark.parametrize("number", [5.0, pytest.param(10.0, marks=pytest.mark.thorough), 50.0])
def test_elastica_under_its_own_weight(number):
    u = tip_of(elastica(number), (1.0, 0.01, 0.01), load_steps=4 if number < 20 else 8)
    assert (1 + u[0], -u[1]) == pytest.approx(ELASTICA[number], rel=5e-3)


@pytest.mark.parametrize(
    "material, traction, exact, gate",
    [
        (ds.StableNeoHookean(2 * 0.4225 * 1.3, 0.3), 1 / 16, 13.577, 5e-3),
        (ds.LinearElastic(70.0, 1 / 3), 6.25, 32.18, 1e-2),
    ],
    ids=["large", "linear"],
)
def test_cooks_membrane(material, traction, exact, gate):
    """Plane strain, N, mm, MPa, twelve by twelve cells: rise of the upper right corner."""
    box = ds.TetrahedralMesh.create_box((13, 13, 2), (1, 1, 4 / 48), "five")
    s, r, q = box.vertices.T
    vertices = np.stack([48 * s, 44 * s + r * (44 - 28 * s), 48 * q], 1)
    sets = {"xmin": box.vertex_sets["xmin"], "xmax": box.vertex_sets["xmax"], "all": np.arange(len(vertices))}
    mesh = ds.TetrahedralMesh(vertices, box.tetrahedra, vertex_sets=sets).quadratic()
    assert len(mesh.vertex_sets["all"]) == mesh.num_vertices
    edge = np.isin(mesh.surface_triangles, mesh.vertex_sets["xmax"]).all(1)
    scene = ds.Scene(
        mesh,
        material,
        1.0,
        ds.Traction([0.0, traction, 0.0], np.nonzero(edge)[0]),
        fixed={"xmin": "xyz", "all": "z"},
        precision="f64",
    )
    assert tip_of(scene, (48.0, 60.0, 2.0))[1] == pytest.approx(exact, rel=gate)


# exact frequencies of three-dimensional elasticity [Hz]
THICK_PLATE = [45.9712, 109.8569, 109.8569, 155.0434, 155.0434, 168.8193, 205.8646, 205.8646, 219.2645]


def thick_plate(cells=(12, 12, 2)) -> ds.Scene:
    """10 x 10 x 1 m, whose sides do not move along themselves."""
    mesh = ds.TetrahedralMesh.create_box(np.add(cells, 1), (10.0, 10.0, 1.0), "five").quadratic()
    held = {"xmin": "yz", "xmax": "yz", "ymin": "xz", "ymax": "xz"}
    return ds.Scene(mesh, ds.LinearElastic(200e9, 0.3), 8000.0, fixed=held, precision="f64")


def test_thick_plate():
    assert ds.modes(thick_plate(), 9).frequencies == pytest.approx(THICK_PLATE, rel=1e-2)


def smooth_error(cells: int, volume: str) -> tuple[float, float]:
    """Errors, in the mean square, of displacements and of their gradients for u = c sin(pi x) sin(pi y) sin(pi z) on the
    unit cube, held all around, with its body force integrated consistently."""
    mesh = ds.TetrahedralMesh.create_cube(cells + 1, 1.0, "five").quadratic()
    X, element, c = mesh.vertices, mesh.reference, np.array([0.02, -0.01, 0.03])
    mu, lam, p = 1e5 / 2.6, 1e5 * 0.3 / (1.3 * 0.4), np.pi

    def waves(x):
        """(values, gradients, second derivatives) of sin(pi x) sin(pi y) sin(pi z)"""
        s, k = np.sin(p * x), p * np.cos(p * x)
        slope = [k[..., i] * s[..., (i + 1) % 3] * s[..., (i + 2) % 3] for i in range(3)]
        twice = np.empty((*x.shape, 3))
        for i in range(3):
            for j in range(3):
                if i == j:
                    twice[..., i, j] = -(p**2) * s.prod(-1)
                else:
                    twice[..., i, j] = k[..., i] * k[..., j] * s[..., 3 - i - j]
        return s.prod(-1), np.stack(slope, -1), twice

    xi, weights = quadrature(6)
    N, places = element.functions(xi), np.einsum("qa,eai->eqi", element.functions(xi), X[mesh.elements])
    value, slope, second = waves(places)
    force = 3 * p**2 * mu * value[..., None] * c - (mu + lam) * np.einsum("j,eqij->eqi", c, second)
    nodal = np.zeros_like(X)
    np.add.at(nodal, mesh.elements, np.einsum("e,q,qa,eqi->eai", mesh.volumes, weights, N, force))
    scene = ds.Scene(
        mesh,
        ds.LinearElastic(1e5, 0.3),
        terms=ds.ExternalForce(nodal),
        fixed=mesh.surface_vertices,
        precision="f64",
        volume=volume,
    )
    u = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-12), 1).forward().displacements[-1]
    corners = X[mesh.tetrahedra]
    B = np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))  # edges are straight
    H = np.einsum("eai,qak,ekj->eqij", u[mesh.elements], element.derivatives(xi), B, optimize=True)
    off = np.einsum("qa,eai->eqi", N, u[mesh.elements]) - value[..., None] * c
    turned = H - c[:, None] * slope[..., None, :]
    mean = lambda x: float(np.sqrt(np.einsum("e,q,eq->", mesh.volumes, weights, x)))  # noqa: E731
    return mean((off**2).sum(-1)), mean((turned**2).sum((-1, -2)))


@pytest.mark.parametrize("volume, displacement, stress", [("tetrahedra", 2.8, 1.85), ("patches", 1.8, 0.95)])
def test_orders_of_convergence(volume, displacement, stress):
    """Three of displacements and two of stresses for plain elements, two and one with mean dilatation."""
    coarse, fine = (np.array(smooth_error(n, volume)) for n in (4, 8))
    orders = np.log2(coarse / fine)
    assert orders[0] > displacement and orders[1] > stress, orders


# ---- stress at vertices of a surface ------------------------------------------------------------------------------------


def stress_at(scene, *points):
    """Of an equilibrium, at the vertices that lie there [MPa]."""
    frames = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-8), 1, outputs=ds.Stress(at="vertices")).forward()
    at = [np.linalg.norm(scene.mesh.vertices - point, axis=1).argmin() for point in points]
    assert np.allclose(scene.mesh.vertices[at], points, atol=1e-9)
    return frames["stress"][-1][at] / 1e6


STEEL = ds.LinearElastic(210e9, 0.3)


def thick_cylinder(cells=(8, 8, 2)) -> ds.Scene:
    """An eighth, radii 0.1 and 0.2 m, under a pressure of 1 MPa from within."""
    cube = ds.TetrahedralMesh.create_box(np.add(cells, 1), 1.0, "five").quadratic()
    faces = {name: cube.surface_triangles[rows] for name, rows in cube.surface_sets.items()}
    s, t, z = cube.vertices.T
    r, angle = 0.1 * (1 + s), np.pi / 4 * t
    x = np.stack([r * np.cos(angle), r * np.sin(angle), 0.02 * z], 1)
    mesh = ds.TetrahedralMesh(x, cube.elements, vertex_sets=cube.vertex_sets, surface_sets=faces)
    fixed = {"ymin": "normal", "ymax": "normal", "zmin": "z", "zmax": "z"}
    return ds.Scene(mesh, STEEL, terms=ds.Pressure(1e6, "xmin"), fixed=fixed, precision="f64")


def test_hoop_stress_of_a_thick_cylinder():
    """Lame: p (a^2 + b^2) / (b^2 - a^2) at corners and middles of the inner surface."""
    scene, angles = thick_cylinder(), np.pi / 4 * np.arange(4, 13) / 16
    points = [(0.1 * np.cos(angle), 0.1 * np.sin(angle), 0.01) for angle in angles]
    around = np.stack([-np.sin(angles), np.cos(angles), 0 * angles], 1)
    hoop = np.einsum("ni,nij,nj->n", around, stress_at(scene, *points), around)
    assert hoop == pytest.approx(5 / 3, rel=0.005)
