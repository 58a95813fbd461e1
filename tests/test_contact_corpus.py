"""The judge of contact, and small scenes of the corpus."""

import warnings
from fractions import Fraction

import contact_corpus
import numpy as np
import pytest
from exact_predicates import ExactJudge, segments_meet_triangles, side

import diffsim_ti as ds
from diffsim_ti.mechanics.surfaces.implicit_pairs import ImplicitPairs


def _slowly(p, q, a, b, c) -> bool:
    """Whether a segment and a triangle touch, by the rational solution of p + s (q - p) = a + u (b - a) + v (c - a)."""
    p, q, a, b, c = ([Fraction(float(x)) for x in point] for point in (p, q, a, b, c))
    rows = [[q[i] - p[i], a[i] - b[i], a[i] - c[i], a[i] - p[i]] for i in range(3)]

    def det(columns):
        x, y, z = ([row[k] for row in rows] for k in columns)
        return (
            x[0] * (y[1] * z[2] - y[2] * z[1]) + y[0] * (z[1] * x[2] - z[2] * x[1]) + z[0] * (x[1] * y[2] - x[2] * y[1])
        )

    whole = det((0, 1, 2))
    s, u, v = (det(k) / whole for k in ((3, 1, 2), (0, 3, 2), (0, 1, 3)))
    return 0 <= s <= 1 and u >= 0 and v >= 0 and u + v <= 1


@pytest.mark.parametrize("digits", [1, 16], ids=["touching", "anywhere"])
def test_a_segment_meets_a_triangle_as_rational_arithmetic_says(digits):
    """Coordinates of one digit make many ends on planes and edges, in which floating point is of no use."""
    five = np.random.default_rng(0).uniform(-1, 1, (5, 3000, 3)).round(digits)
    p, q, a, b, c = five[:, (side(*five[2:], five[0]) != 0) | (side(*five[2:], five[1]) != 0)]
    meet = segments_meet_triangles(p, q, a, b, c)
    skew = np.einsum("ki,ki->k", np.cross(b - a, c - a), q - p) != 0
    assert meet.sum() > 200
    assert all(meet[k] == _slowly(p[k], q[k], a[k], b[k], c[k]) for k in np.flatnonzero(skew)[:600])


def test_coplanar_segments_and_triangles():
    a, b, c = np.array([[0.1, 0.1, 0.3], [1.1, 0.1, 0.3], [0.1, 1.1, 0.3]])
    z = 0.3
    cases = {
        (0.2, 0.2, 0.3, 0.3): True,
        (-1, 0.2, 2, 0.2): True,
        (1.1, 1.1, 2, 2): False,
        (0.7, 0.7, 0.65, 0.65): False,
    }
    cases |= {(-1, 0.1, 0.1, 0.1): True, (-1, 0.1, 0.09, 0.1): False}
    for (x0, y0, x1, y1), expected in cases.items():
        p, q = np.array([[x0, y0, z]]), np.array([[x1, y1, z]])
        assert segments_meet_triangles(p, q, a[None], b[None], c[None])[0] == expected, (x0, y0, x1, y1)


def test_the_judge_finds_what_a_search_of_all_pairs_finds():
    rng = np.random.default_rng(1)
    n = 150
    x = (rng.uniform(0, 1, (n, 1, 3)) + rng.uniform(-0.08, 0.08, (n, 4, 3))).reshape(-1, 3)
    tetrahedra = np.arange(4 * n).reshape(n, 4)
    triangles = np.concatenate([tetrahedra[:, k] for k in ([0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3])])
    judge = ExactJudge(x, triangles, tetrahedra=tetrahedra, points=np.arange(4 * n))
    e, t = (i.ravel() for i in np.indices((len(judge.edges), len(triangles))))
    apart = ~(judge.edges[e][:, :, None] == triangles[t][:, None]).any((1, 2))
    e, t = e[apart], t[apart]
    meet = segments_meet_triangles(*x[judge.edges[e]].swapaxes(0, 1), *x[triangles[t]].swapaxes(0, 1))
    assert {tuple(r) for r in judge.pierced(x)} == set(zip(e[meet], t[meet], strict=True))
    assert len(judge.pierced(x)) > 50
    volume = np.linalg.det(x[tetrahedra[:, 1:]] - x[tetrahedra[:, :1]])
    assert np.array_equal(judge.turned(x), np.flatnonzero(volume <= 0))
    shares = np.linalg.solve(
        np.concatenate([x[tetrahedra].swapaxes(1, 2), np.ones((n, 1, 4))], 1),
        np.concatenate([x.T, np.ones((1, 4 * n))])[None],
    )
    within = np.argwhere((shares >= 0).all(1))
    expected = {(p, k) for k, p in within if p not in tetrahedra[k]}
    assert {tuple(r) for r in judge.inside(x)} == expected and expected


def test_the_judge_sees_a_needle_in_a_body_and_a_sheet_that_touches_itself():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    faces = [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]
    for tip, pierced, inside in ((0.3, 1, 1), (-0.1, 0, 0), (0.0, 1, 1), (2.0, 2, 0)):
        x = np.vstack([corners, [[0.2, 0.2, -1], [0.2, 0.2, tip]]])
        judge = ExactJudge(x, faces, segments=[[4, 5]], tetrahedra=[[0, 1, 2, 3]], points=[4, 5])
        assert len(judge.pierced(x)) == pierced and len(judge.inside(x)) == inside
    strip = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 2, 0], [1, 2, 0.0]])
    folded = strip.copy()
    folded[4:] = [[0.2, 0.5, 0], [0.8, 0.5, 0]]
    judge = ExactJudge(strip, [[0, 1, 3], [0, 3, 2], [2, 3, 5], [2, 5, 4]])
    assert judge.count(strip) == 0 and judge.count(folded) > 0
    assert ExactJudge(strip, judge.triangles, asked=np.zeros(6, bool)).count(folded) == 0


@pytest.mark.parametrize("name, steps", [("spike on soft spike", 60), ("slots", 60), ("slope 0.5, friction 0.49", 60)])
def test_scene_without_intersections(name, steps):
    """The slope takes all of its steps: the cube slides as far as Coulomb's law says."""
    posed = contact_corpus.SCENES[name](contact_corpus.Meshes())
    found = contact_corpus.run(name, posed, steps)
    assert found.error is None and found.done == steps
    assert found.intersections == found.on_the_way == found.turned == 0
    if steps == posed.steps:
        assert found.verdict == "as expected"


def test_a_mat_falls_on_knives(monkeypatch):
    """Edges give way sideways the more, the harder they press: preconditioners stay positive definite all the same. A list
    of pairs serves several rounds, though the directions of these go farther than it reaches."""
    lists, build = [], ImplicitPairs.build
    monkeypatch.setattr(ImplicitPairs, "build", lambda self, *given, **more: lists.append(build(self, *given, **more)))
    posed = contact_corpus.SCENES["mat on knives"](contact_corpus.Meshes())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = contact_corpus.run("mat", posed, 6)
    assert found.error is None and found.done == 6 and found.intersections == found.turned == 0
    of_starts = 3 * found.done  # where a step begins, and on the ways that inertia and velocities lead
    assert len(lists) - of_starts < 0.5 * sum(found.rounds)


def test_pins_come_in_few_parts_of_a_step():
    """Pins go on by four of their widths a step, and the body gives way as it did in the part of the step before."""
    posed = contact_corpus.SCENES["pin cushion of points"](contact_corpus.Meshes())
    found = contact_corpus.run("pins", posed, 15)
    assert found.error is None and found.intersections == 0
    assert 0 < max(found.rounds) <= 25  # 41 where parts begin from where the body is


def test_arch_stands():
    posed = contact_corpus.SCENES["arch, friction 0.5"](contact_corpus.Meshes())
    found = contact_corpus.run("arch", posed, 80)
    assert found.error is None and found.intersections == 0
    assert posed.expected(found) is None and found.speed(5) < 0.01


def test_what_passes_by_does_not_cut_a_step_short():
    """A small tetrahedron goes past a large one, at a distance of a twentieth of its way, and then straight towards it."""
    corners = np.vstack([np.zeros(3), np.eye(3)])
    large = ds.TetrahedralMesh(corners, [[0, 1, 2, 3]], fix_orientation=True)
    small = ds.TetrahedralMesh(0.1 * corners + [-0.15, 1.2, 0.2], [[0, 1, 2, 3]], fix_orientation=True)
    mesh = ds.TetrahedralMesh.joined([large, small])
    contact = ds.SelfContact(1e4, 1e-3)
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), terms=contact, precision="f64")
    pairs, moves = ds.Simulator(ds.ImplicitEulerSolver(scene)).workspace.pairs, np.arange(8)[:, None] > 3
    u = np.zeros((8, 3))
    assert pairs.safe_share(u, moves * np.array([0, -2.0, 0])) == 1
    share = pairs.safe_share(u, moves * np.array([1.0, -2.0, 0]))
    judge = ExactJudge(mesh.vertices, mesh.surface_triangles, tetrahedra=mesh.tetrahedra, points=np.arange(8))
    way = moves * np.array([1.0, -2.0, 0])
    touch = next(s for s in np.linspace(0, 1, 1001) if judge.count(mesh.vertices + s * way))
    assert 0.8 * touch < share < touch
