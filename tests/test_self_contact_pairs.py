"""Distances, energies and candidates of pairs of surface primitives, against IPC Toolkit, differences and brute force."""

from types import SimpleNamespace

import numpy as np
import pytest
import taichi as ti
from pairs_alone import evaluate_pairs

import diffsim_ti as ds
from diffsim_ti import runtime
from diffsim_ti.mechanics.surfaces.box_tree import BoxTree, beyond
from diffsim_ti.mechanics.surfaces.broad_phase import CandidatePairs
from diffsim_ti.mechanics.surfaces.broad_phase_kernels import bits_from, lowest, sort
from diffsim_ti.mechanics.surfaces.buffers import BLOCK, Buffers, Launches
from diffsim_ti.mechanics.surfaces.listed_pair import MARGIN
from diffsim_ti.mechanics.surfaces.proximity import EDGE_EDGE, VERTEX_TRIANGLE
from diffsim_ti.mesh.geometry import edges_of
from diffsim_ti.mesh.sets import pieces

by_kind = pytest.mark.parametrize("kind", [VERTEX_TRIANGLE, EDGE_EDGE])
STIFFNESS, WIDTH = 2.0, 3.0


def random_pairs(kind, count=400, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, 4, 3)), rng.normal(size=(count, 4, 3))


def away_from_borders(kind, x, direction, width=WIDTH, step=1e-4):
    """Pairs whose second derivatives do not jump within `step`: the distance's product changes little."""
    a, b = (evaluate_pairs(kind, x + s * direction, direction, STIFFNESS, width).square_product for s in (-step, step))
    size = np.abs(a).max((1, 2))
    return np.abs(a - b).max((1, 2)) < 0.02 * size


@by_kind
def test_distances_agree_with_ipc_toolkit(kind):
    ipctk = pytest.importorskip("ipctk")
    name = ("point_triangle", "edge_edge")[kind]
    distance, gradient, hessian = (getattr(ipctk, f"{name}_distance{part}") for part in ("", "_gradient", "_hessian"))
    x, direction = random_pairs(kind)
    ours = evaluate_pairs(kind, x, direction)
    theirs = np.array([distance(*p) for p in x])
    np.testing.assert_allclose(ours.distance**2, theirs, rtol=1e-10)
    g = np.array([gradient(*p) for p in x]).reshape(x.shape)
    h = np.array([hessian(*p) @ d.ravel() for p, d in zip(x, direction)]).reshape(x.shape)
    scale = np.abs(h).max((1, 2), keepdims=True)
    assert np.abs(ours.square_gradient - g).max() <= 1e-10 * np.abs(g).max()
    assert (np.abs(ours.square_product - h) / scale).max() <= 1e-10


@by_kind
def test_energy_and_gradient_agree_with_ipc_toolkit(kind):
    """Their barrier -(d - w)^2 log(d / w) of the distance itself, times their mollifier."""
    ipctk = pytest.importorskip("ipctk")
    x, _ = random_pairs(kind, seed=1)
    x[:50, 3] = x[:50, 2] + (x[:50, 1] - x[:50, 0]) + 0.02 * x[:50, 3]  # nearly parallel edges
    ours = evaluate_pairs(kind, x, None, STIFFNESS, WIDTH)
    name = ("point_triangle", "edge_edge")[kind]
    barrier, faded = ipctk.ClampedLogBarrier(), 0
    for k, p in enumerate(x):
        square, by_x = getattr(ipctk, f"{name}_distance")(*p), getattr(ipctk, f"{name}_distance_gradient")(*p)
        d = np.sqrt(square)
        if d <= 2e-3 * WIDTH:
            continue
        value, slope = barrier(d, WIDTH), barrier.first_derivative(d, WIDTH)
        m, by_m = 1.0, np.zeros(12)
        if kind == EDGE_EDGE:
            threshold = ipctk.edge_edge_mollifier_threshold(*p)
            m = ipctk.edge_edge_mollifier(*p, threshold)
            by_m = ipctk.edge_edge_mollifier_gradient(*p, threshold)
            faded += m < 1
        gradient = STIFFNESS * (m * slope * by_x / (2 * d) + value * by_m)
        assert ours.energy[k] == pytest.approx(STIFFNESS * m * value, rel=1e-9, abs=1e-14)
        # an edge's own length squared is what a nearly parallel pair's distance loses of its digits
        np.testing.assert_allclose(
            ours.gradient[k].ravel(), gradient, rtol=1e-7, atol=1e-8 * np.abs(gradient).max() + 1e-14
        )
    assert kind == VERTEX_TRIANGLE or faded >= 20


@by_kind
@pytest.mark.parametrize("threshold", [1e-6, 30.0], ids=["plain", "faded"])
def test_derivatives_agree_with_differences(kind, threshold):
    x, direction = random_pairs(kind, seed=2)
    keep = away_from_borders(kind, x, direction) & (evaluate_pairs(kind, x).distance > 0.1)
    x, direction, eps = x[keep], direction[keep], 1e-6
    assert len(x) > 100

    def at(shift=0.0, stiffness=STIFFNESS, width=WIDTH):
        return evaluate_pairs(kind, x + shift * direction, direction, stiffness, width, threshold=threshold)

    here, plus, minus = at(), at(eps), at(-eps)
    slope = (here.gradient * direction).sum((1, 2))
    np.testing.assert_allclose(
        (plus.energy - minus.energy) / (2 * eps), slope, rtol=1e-5, atol=1e-6 * np.abs(slope).max()
    )
    product = (plus.gradient - minus.gradient) / (2 * eps)
    scale = np.abs(product).max((1, 2), keepdims=True) + 1e-6 * np.abs(product).max()
    assert (np.abs(product - here.product) / scale).max() <= 1e-4
    for name in ("stiffness", "width"):
        value = dict(stiffness=STIFFNESS, width=WIDTH)[name]
        plus, minus = at(**{name: value + eps}), at(**{name: value - eps})
        by = ((plus.gradient - minus.gradient) * direction).sum((1, 2)) / (2 * eps)
        np.testing.assert_allclose(getattr(here, f"by_{name}"), by, rtol=1e-5, atol=1e-6 * np.abs(by).max())


@by_kind
def test_product_is_symmetric(kind):
    x, a = random_pairs(kind, seed=3)
    b = np.random.default_rng(4).normal(size=x.shape)
    ka, kb = (evaluate_pairs(kind, x, d, STIFFNESS, WIDTH).product for d in (a, b))
    left, right = (b * ka).sum((1, 2)), (a * kb).sum((1, 2))
    size = np.linalg.norm(ka.reshape(len(x), -1), axis=1) * np.linalg.norm(b.reshape(len(x), -1), axis=1)
    assert np.all(np.abs(left - right) <= 1e-9 * size + 1e-12)


def test_single_precision_follows_double():
    kind = EDGE_EDGE
    x, direction = random_pairs(kind, seed=5)
    double = evaluate_pairs(kind, x, direction, STIFFNESS, WIDTH)
    keep = (double.distance > 0.05) & away_from_borders(kind, x, direction)
    single = evaluate_pairs(kind, x, direction, STIFFNESS, WIDTH, precision="f32")
    assert np.abs(single.distance - double.distance)[keep].max() <= 1e-5
    assert np.abs(single.gradient - double.gradient)[keep].max() <= 1e-4 * np.abs(double.gradient[keep]).max()


def test_parallel_edges_exert_no_force():
    """Exactly parallel: the nearest points are not unique, and the energy is faded out with its slope."""
    x = np.array([[[0, 0, 0], [1, 0, 0], [0.2, 0.1, 0], [1.1, 0.1, 0]]])
    out = evaluate_pairs(EDGE_EDGE, x, np.random.default_rng(0).normal(size=x.shape), STIFFNESS, 1.0)
    assert out.distance[0] == pytest.approx(0.1, rel=1e-14) and out.energy[0] == 0 and np.all(out.gradient == 0)
    assert np.all(np.isfinite(out.product))


@by_kind
def test_beyond_the_width_exactly_nothing(kind):
    x, direction = random_pairs(kind)
    x[:, 2:] += 10.0
    x[:, 1] += 10.0 * (kind == VERTEX_TRIANGLE)
    out = evaluate_pairs(kind, x, direction, STIFFNESS, 1.0)
    assert out.distance.min() > 1
    for part in (out.energy, out.gradient, out.product, out.by_stiffness, out.by_width):
        assert np.all(part == 0)


@pytest.mark.backends
@pytest.mark.parametrize("precision", ["f64", "f32"])
def test_broad_phase_finds_what_brute_force_finds(precision):
    try:
        runtime.check_backend(precision)
    except ValueError as error:
        pytest.skip(str(error))
    box = ds.TetrahedralMesh.create_box(4, 1.0)
    shaken = np.random.default_rng(0).normal(size=box.vertices.shape) * 0.03
    rough = ds.TetrahedralMesh(box.vertices + shaken, box.tetrahedra)
    mesh = ds.TetrahedralMesh.joined([rough, box.translated([0.3, 1.1, 0.2]), rough.translated([-900.0, 0, 0])])
    triangles, edges = mesh.surface_triangles, edges_of(mesh.surface_triangles)[0]
    lengths = np.linalg.norm(mesh.vertices[edges[:, 0]] - mesh.vertices[edges[:, 1]], axis=1)
    found = CandidatePairs(mesh.surface_vertices, triangles, edges, lengths, pieces(mesh), precision)
    vector = ti.types.vector(4, runtime.PRECISIONS[precision])
    rest, u = runtime.upload(mesh.vertices, vector), runtime.upload(np.zeros((1, mesh.num_vertices, 3)), vector)
    reach = 0.21
    found.build(rest, u, 0, reach)
    first_two = np.arange(mesh.num_vertices) < 2 * box.num_vertices
    i, t = np.nonzero(first_two[mesh.surface_vertices][:, None] & first_two[triangles].all(1)[None])
    vt = np.column_stack([mesh.surface_vertices[i], triangles[t]])
    vt = vt[(vt[:, :1] != vt[:, 1:]).all(1)]
    a, b = np.triu_indices(int(first_two[edges].all(1).sum()), 1)
    ee = np.column_stack([edges[a], edges[b]])
    ee = ee[(ee[:, :2, None] != ee[:, None, 2:]).all((1, 2))]
    distances = [
        evaluate_pairs(kind, mesh.vertices[p], precision=precision).distance for kind, p in enumerate((vt, ee))
    ]
    near = [p[distance < reach] for p, distance in zip((vt, ee), distances)]
    pairs = runtime.fetch(found.pairs)[: 4 * found.count].reshape(-1, 4)
    ours = [pairs[: found.num_vt], pairs[found.num_vt :]]
    for mine, brute in zip(ours, near):
        np.testing.assert_array_equal(mine[first_two[mine].all(1)], brute)
        assert len(mine) > len(brute) > 50  # the body far away has its own
    assert found.first_piercing(rest, u, 0) is None
    lowered = np.zeros((1, mesh.num_vertices, 3))
    lowered[0, box.num_vertices : 2 * box.num_vertices, 1] = -0.3
    runtime.fill(u, lowered)
    found.build(rest, u, 0, reach)
    edge, triangle = found.first_piercing(rest, u, 0)
    assert (edges[edge][0] < box.num_vertices) != (triangles[triangle][0] < box.num_vertices)


@pytest.mark.backends
@pytest.mark.parametrize("parallel", [False, True])
@pytest.mark.parametrize("count", [0, 1, BLOCK, 3 * BLOCK + 7, 301 * BLOCK + 11])
def test_scan_sums_what_lies_before(parallel, count):
    if runtime.arch_name() == "vulkan" and not parallel and count > 2**16:
        pytest.skip("Mesa's lavapipe leaves a loop after 65 535 turns; a GPU has none so long")
    numbers = np.random.default_rng(count).integers(0, 9, count + 1)
    values = runtime.upload(numbers, ti.i32)
    Buffers(Launches(), parallel).scan(values, count)
    np.testing.assert_array_equal(runtime.fetch(values), np.cumsum(numbers) - numbers)


@pytest.mark.backends
@pytest.mark.parametrize("count", [2, 70, 70_000])  # of the last, threads of a GPU gather up three levels of subtrees
def test_boxes_hold_those_below_them(count):
    runtime.program()
    points, vector = np.random.default_rng(count).random((count, 3)).astype(np.float32), ti.types.vector(4, ti.f32)
    tree = BoxTree(np.arange(count)[:, None], "f32", True, Launches())
    rest, u = runtime.upload(points, vector), runtime.upload(np.zeros((1, count, 3)), vector)
    names = dict(place=np.arange(count), body=np.zeros(count, int))
    vertices = SimpleNamespace(**{name: runtime.upload(data, ti.i32) for name, data in names.items()})
    vertices.slack = runtime.upload(np.zeros((count, 3)), vector)
    tree.refit((SimpleNamespace(rest=rest, u=u), vertices), 0, 0.1)
    boxes = runtime.fetch(tree.boxes)
    lowest, highest = (
        boxes[2 : 2 * tree.leaves : 2],
        boxes[3 : 2 * tree.leaves : 2],
    )  # of nodes 1, 2 .. above the leaves
    below = boxes[4:].reshape(-1, 4, 3)  # of the two children of each: lowest, highest, lowest, highest
    np.testing.assert_array_equal(lowest, np.minimum(below[:, 0], below[:, 2]))
    np.testing.assert_array_equal(highest, np.maximum(below[:, 1], below[:, 3]))
    np.testing.assert_allclose(lowest[0], points.min(0) - 0.0505, atol=1e-5)
    np.testing.assert_allclose(highest[0], points.max(0) + 0.0505, atol=1e-5)


@pytest.mark.backends
def test_motion_since_the_last_forces_is_that_of_all_vertices():
    """`frame` and `farthest` (motion_kernels.py), which come together block by block."""
    box, small = ds.TetrahedralMesh.create_box(14, 1.0), ds.TetrahedralMesh.create_box(2, 0.1)
    mesh = ds.TetrahedralMesh.joined([box, *(small.translated([0.3 * k, 2.0, 0]) for k in range(29))])
    precision = "f32" if runtime.arch_name() == "vulkan" else "f64"
    scene = ds.Scene(mesh, ds.Corotated(1e5, 0.3), 1000.0, [ds.SelfContact(1e3, 1e-2)], precision=precision)
    solver = ds.ImplicitEulerSolver(scene, dt=1e-5)
    workspace = solver.workspace(solver.start_values())
    pairs, surface = workspace.pairs, mesh.surface_vertices
    move = np.random.default_rng(0).normal(size=mesh.vertices.shape) * 1e-4
    runtime.fill(workspace.state.u, move[None])
    pairs.ensure(workspace.state.u, 0)
    pairs.near = pairs.list.buffers.take("near", ti.i32, pairs.list.count)
    pairs.look_at(pairs.motion.find, workspace.state.u, 0)
    assert pairs.builds == 2  # the list still holds: no new one was made after those of the rest shape and the start
    marked = move[surface][runtime.fetch(pairs.marked)].reshape(30, -1, 3)
    found, latest = runtime.fetch(pairs.frame), marked[:, 0].mean(0)
    np.testing.assert_allclose(found[:30], marked.mean(1), atol=1e-10)
    np.testing.assert_allclose(found[30:32], [marked.mean((0, 1)), latest], atol=1e-10)
    farthest = np.linalg.norm(move[surface] - latest, axis=1).max()
    assert runtime.fetch(pairs.farthest)[0] == pytest.approx(2 * MARGIN * farthest, rel=1e-5)


def test_walk_that_skips_children_meets_every_other_node_once():
    """The walk that goes down wherever it can sees all nodes 1..2n-1 of a whole tree."""

    @ti.kernel
    def walk(leaves: ti.i32, seen: ti.types.ndarray(ti.i32, 1)):
        for _ in range(1):
            node = 1
            while node > 0:
                seen[node] += 1
                if node < leaves:
                    node = 2 * node
                else:
                    node = beyond(node)

    runtime.program()
    for leaves in (1, 2, 8, 64):
        seen = np.zeros(2 * leaves, np.int32)
        walk(leaves, seen)
        np.testing.assert_array_equal(seen, [0] + [1] * (2 * leaves - 1))


def test_sort_and_bits():
    @ti.kernel
    def work(row: ti.types.ndarray(ti.i32, 1), bits: ti.types.ndarray(ti.i32, 1)):
        for _ in range(1):
            sort(row, 3, 17)
        for k in range(bits.shape[0]):
            bits[k] = lowest(bits_from(k))

    runtime.program()
    given = np.random.default_rng(0).integers(0, 50, 20).astype(np.int32)
    row, bits = given.copy(), np.zeros(8, np.int32)
    work(row, bits)
    np.testing.assert_array_equal(row, np.concatenate([given[:3], np.sort(given[3:17]), given[17:]]))
    np.testing.assert_array_equal(bits, np.arange(8))
