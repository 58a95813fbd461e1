"""Paths of equilibria through limit points, and buckling loads, against closed forms, beam theory and differences."""

import numpy as np
import pytest
from chamber_meshes import eighth_sphere
from quadratic_meshes import with_vertices
from scipy.integrate import solve_bvp

import diffsim_ti as ds

MU = 1e5
LEFT = ds.TetrahedralMesh.create_box((3, 3, 3), (0.2, 0.1, 0.1))


def balloon(outer=1.2) -> ds.TetrahedralMesh:
    """An eighth of a sphere of ten-node tetrahedra, whose edges are curved."""
    mesh = eighth_sphere(1.0, outer, layers=1, around=4)
    radius = np.linalg.norm(mesh.vertices, axis=1)
    fine, (a, b) = mesh.quadratic(), np.triu_indices(4, 1)
    ends = mesh.tetrahedra[:, np.stack([a, b], 1)].reshape(-1, 2)
    place = {tuple(np.round(x, 9)): pair for x, pair in zip(mesh.vertices[ends].mean(1), ends)}
    x = np.array(fine.vertices)
    for k in range(mesh.num_vertices, len(x)):
        x[k] *= radius[list(place[tuple(np.round(x[k], 9))])].mean() / np.linalg.norm(x[k])
    return with_vertices(fine, x)


def inflated(mesh: ds.TetrahedralMesh) -> ds.Scene:
    law, planes = ds.StableNeoHookean(E=2 * MU * 1.499, nu=0.499), {"x0": "x", "y0": "y", "z0": "z"}
    return ds.Scene(mesh, law, terms=[ds.Pressure(0.1 * MU, "inside")], fixed=planes, precision="f64")


def inner_stretch(mesh, u) -> float:
    return 1 + float(np.abs(u[np.argmin(np.abs(mesh.vertices - [0, 0, 1]).sum(1))]).sum())


@pytest.mark.filterwarnings("ignore")
def test_a_balloon_goes_through_its_greatest_pressure():
    mesh = balloon()
    scene = inflated(mesh)
    found = ds.load_path(scene, "pressure", step=0.5, until=lambda s, u: inner_stretch(mesh, u) > 1.7)
    (limit,) = found.critical
    assert limit.kind == "limit" and found.negative[-1] == 1 and found.negative[0] == 0
    assert 0.1 * limit.factor == pytest.approx(0.22514, rel=2e-3)  # mu, of the closed form; 48 tetrahedra
    assert inner_stretch(mesh, limit.displacements) == pytest.approx(1.470, rel=2e-3)
    assert found.factors[-1] < limit.factor > found.factors[:-1].max()

    by = limit.gradients()
    assert by["youngs_modulus"] * 2 * MU * 1.499 == pytest.approx(limit.factor, rel=1e-9)  # all forces in proportion
    wall, (thicker, thinner) = 0.2, (balloon(1.2 + d) for d in (1e-3, -1e-3))
    along = (thicker.vertices - thinner.vertices) / 2e-3
    exact = ((by["rest_positions"] + by["initial_positions"]) * along).sum()

    early = dict(step=0.5, steps=20, until=lambda s, u: inner_stretch(mesh, u) > 1.5)

    def factor(X) -> float:
        path = ds.load_path(scene, "pressure", **early, rest_positions=X, initial_positions=X)
        return path.critical[0].factor

    differences = (factor(thicker.vertices) - factor(thinner.vertices)) / 2e-3
    assert exact == pytest.approx(differences, rel=1e-4) and exact * wall > 0.5 * limit.factor


@pytest.mark.filterwarnings("ignore")
def test_a_gas_in_a_balloon_goes_through_the_same_pressures():
    mesh = eighth_sphere(1.0, 1.2, layers=1, around=3)
    pressed = inflated(mesh)
    gas = pressed.replace(terms=[ds.GasChamber(0.1 * MU, "inside", outside=0.0)])
    volume = gas.terms[0].enclosure.volume
    ways = []
    for scene, name in ((pressed, "pressure"), (gas, "gas_pressure")):
        path = ds.load_path(scene, name, step=0.5, until=lambda s, u: inner_stretch(mesh, u) > 1.6)
        V = np.array([volume(mesh.vertices + u) for u in path.displacements])
        amount = volume(mesh.vertices) / V if scene is gas else 1.0
        ways.append((V, path.factors * amount))
    (V, p), (own, q) = ways
    inside = own < V[-1]
    assert inside.sum() > 4 and np.interp(own[inside], V, p) == pytest.approx(q[inside], rel=0.02, abs=0.02)
    with pytest.raises(ValueError, match="grow over the steps of a StaticSolver"):
        ds.load_path(pressed.replace(terms=[ds.FilledChamber(0.6, "inside")]), "chamber_volume")


HALF, RISE, H, MODULUS = 1.0, 0.06, 0.02, 1e7  # of a clamped arch: half its span, rise, thickness and width [m], [Pa]
RADIUS = (HALF**2 + RISE**2) / (2 * RISE)
OPENING = np.arcsin(HALF / RADIUS)


def half_arch(thickness: float, cells=24) -> ds.TetrahedralMesh:
    box = ds.TetrahedralMesh.create_box((cells + 1, 2, 2), (RADIUS * OPENING, H, H), "five", (0, -H / 2, 0)).quadratic()
    s, z, w = box.vertices.T
    r, angle = RADIUS + thickness / H * z, s / RADIUS - OPENING
    return with_vertices(box, np.stack([r * np.sin(angle) + HALF, r * np.cos(angle) - RADIUS * np.cos(OPENING), w], 1))


def beam_loads(drops: np.ndarray) -> np.ndarray:
    """Loads [N] on the half of the arch at drops of its crown [m], by geometrically exact beams with shear (Reissner)."""
    EA, EI, GA = MODULUS * H * H, MODULUS * H**4 / 12, MODULUS / 2 * H * H * 5 / 6
    s = np.linspace(0, RADIUS * OPENING, 41)
    angle = s / RADIUS - OPENING

    def slope(s, y, force):
        c, d = np.cos(y[2]), np.sin(y[2])
        N, Q = force[0] * c + force[1] * d, force[1] * c - force[0] * d
        e, g = 1 + N / EA, Q / GA
        return np.array([e * c - g * d, e * d + g * c, -1 / RADIUS + y[3] / EI, g * N - e * Q])

    y = np.array([RADIUS * np.sin(angle) + HALF, RADIUS * (np.cos(angle) - np.cos(OPENING)), -angle, 0 * s])
    force, out = np.zeros(2), []
    for drop in drops:
        ends = lambda a, b, _: np.array([*a[:2], a[2] - OPENING, b[0] - HALF, b[1] - RISE + drop, b[2]])  # noqa: B023, E731
        found = solve_bvp(slope, ends, s, y, force, tol=1e-7, max_nodes=5000)
        assert found.success
        y, force = found.sol(s), found.p
        out.append(-force[1])
    return np.array(out)


def test_a_shallow_arch_snaps_through_both_limit_points():
    mesh, law = half_arch(H), ds.StableNeoHookean(MODULUS, 0.0)
    fixed = {"xmin": "xyz", "xmax": "x", "zmin": "z", "zmax": "z"}
    scene = ds.Scene(mesh, law, terms=[ds.Traction((0, -1 / H**2, 0), "xmax")], fixed=fixed, precision="f64")
    drop = lambda u: -float(u[mesh.vertex_sets["xmax"], 1].mean())  # noqa: E731
    found = ds.load_path(scene, "traction", until=lambda s, u: drop(u) > 1.6 * RISE)
    drops = np.array([drop(u) for u in found.displacements])
    expected = beam_loads(drops)
    assert np.abs(found.factors - expected).max() < 0.005 * expected.max()
    upper, lower = found.critical
    assert [c.kind for c in found.critical] == ["limit"] * 2 and found.negative.max() == 1 and found.negative[-1] == 0
    across = [np.linspace(0.95, 1.05, 9) * drop(c.displacements) for c in (upper, lower)]
    limits = [beam_loads(np.concatenate([np.linspace(0, a[0], 9), a]))[9:] for a in across]
    assert upper.factor == pytest.approx(limits[0].max(), rel=5e-3)
    assert lower.factor == pytest.approx(limits[1].min(), rel=5e-3)

    by, d = upper.gradients(), 1e-3 * H
    ends = [half_arch(H + e).vertices for e in (d, -d)]
    exact = ((by["rest_positions"] + by["initial_positions"]) * (ends[0] - ends[1])).sum()
    early = dict(step=0.05, until=lambda s, u: drop(u) > 0.5 * RISE)

    def factor(X) -> float:
        return ds.load_path(scene, "traction", **early, rest_positions=X, initial_positions=X).critical[0].factor

    assert exact == pytest.approx(factor(ends[0]) - factor(ends[1]), rel=1e-4)


def test_a_column_buckles_at_eulers_load_and_goes_on_beyond_it():
    L, b, h, E = 1.0, 0.08, 0.05, 1e6
    mesh = ds.TetrahedralMesh.create_box((7, 2, 2), (L, h, b), "five").quadratic()
    euler = np.pi**2 * E * b * h**3 / 12 / (4 * L**2)
    load = ds.Traction((-euler / (b * h), 0, 0), "xmax")
    scene = ds.Scene(mesh, ds.StableNeoHookean(E, 0.2), terms=[load], fixed={"xmin": "xyz"}, precision="f64")
    path = lambda **values: ds.load_path(scene, "traction", step=0.3, until=lambda s, u: s > 1.1, **values)  # noqa: E731
    (buckles,) = path().critical
    assert buckles.kind == "branch" and np.abs(buckles.mode).max(0).argmax() == 1
    assert buckles.factor == pytest.approx(1, rel=0.02)
    by, factor = buckles.gradients(), lambda **values: path(**values).critical[0].factor
    assert by["youngs_modulus"] * E == pytest.approx(buckles.factor, rel=1e-6)
    differences = (factor(poissons_ratio=0.201) - factor(poissons_ratio=0.199)) / 2e-3
    assert by["poissons_ratio"] == pytest.approx(differences, rel=1e-4)
    beyond = ds.load_path(scene, "traction", steps=9, step=0.3, branch=buckles)
    with pytest.raises(ValueError, match="of the path that it was found on"):
        ds.load_path(scene, "traction", branch=buckles, poissons_ratio=0.1)
    turned = np.pi / 2 * np.abs(beyond.displacements[-1, :, 1]).max() / L  # of the tip, [rad]
    assert np.all(beyond.negative[1:] == 0) and turned > 0.03
    assert beyond.factors[-1] / buckles.factor - 1 == pytest.approx(turned**2 / 8, rel=0.15)  # of the elastica; coarse


def test_the_load_may_be_a_motion():
    mesh = ds.TetrahedralMesh.create_box((3, 2, 2), 0.2)
    push = {"xmax": ([0.0, 1.0], [[0, 0, 0], [0.05, 0, 0]])}
    scene = ds.Scene(
        mesh, ds.StableNeoHookean(1e5, 0.3), fixed={"xmin": "xyz", "xmax": "xyz"}, motion=push, precision="f64"
    )
    found = ds.load_path(scene, "prescribed_motion", until=lambda s, u: s > 0.8)
    at = mesh.vertex_sets["xmax"]
    np.testing.assert_allclose(
        found.displacements[:, at, 0], np.outer(found.factors, np.full(len(at), 0.05)), atol=1e-12
    )
    share = found.factors[-1]
    there = scene.replace(motion={"xmax": ([0.0, 1.0], [[0, 0, 0], [0.05 * share, 0, 0]])})
    u = ds.Rollout(ds.StaticSolver(there), 1).forward().displacements[-1]
    np.testing.assert_allclose(found.displacements[-1], u, atol=1e-8)


def test_paths_go_through_ties_and_end_where_static_solves_do():
    mesh = ds.TetrahedralMesh.joined({"left": LEFT, "right": LEFT.translated([0.2, 0, 0])})
    loads = [
        ds.Tie("left_xmax", "right_xmin", tolerance=0.01),
        ds.Gravity((0, -400.0, 0)),
        ds.Pressure(200.0, "right_ymax"),
    ]
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), terms=loads, fixed="left_xmin", precision="f64")
    found = ds.load_path(scene, ["gravity", "pressure"], steps=12, until=lambda s, u: s > 0.8)
    share = found.factors[-1]
    there = dict(gravity=share * np.array([0, -400.0, 0]), pressure=200.0 * share)
    frames = ds.Rollout(ds.StaticSolver(scene, tolerance=1e-11), 1).forward(**there)
    np.testing.assert_allclose(found.displacements[-1], frames.displacements[-1], atol=1e-7)


@pytest.mark.parametrize(
    "options, load, words",
    [
        (dict(terms=[ds.Gravity(), ds.Ground(-1.0)]), "gravity", "Ground"),
        (dict(terms=[ds.Gravity()]), "presure", "no input named"),
        (dict(terms=[ds.Gravity()], reduced={"half": "affine"}), "gravity", "reduced="),
        (dict(terms=[ds.Pressure(0.0, "xmax")]), "pressure", "is zero"),
    ],
)
def test_what_paths_do_not_support_is_said(options, load, words):
    mesh = ds.TetrahedralMesh.create_box((3, 3, 3), 0.2)
    mesh = mesh.with_vertex_set("half", mesh.vertices[:, 0] > 0.05)
    with pytest.raises(ValueError, match=words):
        ds.load_path(ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), fixed="xmin", **options), load)
