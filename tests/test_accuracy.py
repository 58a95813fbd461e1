"""Estimated errors against true ones, meshes that are refined, and the loop of both."""

import numpy as np
import pytest
from example_files import example

import diffsim_ti as ds
from diffsim_ti.accuracy import estimate
from diffsim_ti.accuracy.finer import on_finer, rollout_on_finer
from diffsim_ti.mesh.reference_element import quadrature

BARS = example("benchmarks/error_bars")


# ---- refined meshes -----------------------------------------------------------------------------------------------------


def curved_volume(mesh: ds.TetrahedralMesh) -> float:
    xi, weights = quadrature(6)
    D = np.einsum("eai,qaj->eqij", mesh.vertices[mesh.elements], mesh.reference.derivatives(xi))
    return (np.linalg.det(D) * weights).sum() / 6


def body(order: int) -> ds.TetrahedralMesh:
    """A box, of ten nodes a bent one."""
    mesh = ds.TetrahedralMesh.create_box((4, 3, 3), (3.0, 2.0, 2.0), "five").with_tetrahedron_set("left", [0, 1, 2, 7])
    if order == 1:
        return mesh
    nodes = mesh.quadratic()
    bent = nodes.vertices + 0.04 * np.sin(2 * nodes.vertices[:, [1, 2, 0]])
    surfaces = {name: nodes.surface_triangles[rows] for name, rows in nodes.surface_sets.items()}
    sets = dict(vertex_sets=dict(nodes.vertex_sets), tetrahedron_sets=dict(nodes.tetrahedron_sets))
    return ds.TetrahedralMesh(bent, nodes.elements, surface_sets=surfaces, **sets)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("edges", ["all", "longest"])
def test_refined_meshes_are_conforming_and_keep_the_body(order, edges):
    mesh = body(order)
    for where in (None, "left", np.random.default_rng(order).choice(mesh.num_tetrahedra, 9, replace=False)):
        fine = mesh.refined(where, edges)
        checked = ds.TetrahedralMesh(
            fine.vertices, fine.elements
        )  # every check there is, of faces that do not fit, too
        np.testing.assert_allclose(fine.volumes, checked.volumes, rtol=1e-12)
        assert fine.num_tetrahedra == 8 * mesh.num_tetrahedra or where is not None or edges == "longest"
        assert curved_volume(fine) == pytest.approx(curved_volume(mesh), rel=1e-13)
        for name, rows in fine.surface_sets.items():
            assert set(fine.vertex_sets[name]) == set(fine.surface_triangles[rows].ravel())
        of_left = np.isin(fine.refinement.parents, mesh.tetrahedron_sets["left"])
        np.testing.assert_array_equal(np.flatnonzero(of_left), fine.tetrahedron_sets["left"])
        P, n = fine.refinement.from_coarse, mesh.num_vertices
        np.testing.assert_array_equal(fine.vertices[:n], mesh.vertices)
        np.testing.assert_allclose(P @ mesh.vertices, fine.vertices, atol=1e-14)
        points = fine.vertices[n::7]
        np.testing.assert_allclose(  # as the coarse elements interpolate
            P[n::7] @ np.cos(mesh.vertices), mesh.locate(points, nearest=True).matrix @ np.cos(mesh.vertices), atol=1e-9
        )


def test_quality_is_bounded_where_a_mesh_is_refined_again_and_again():
    mesh = ds.TetrahedralMesh.create_cube(3, pattern="five")
    least = []
    for _ in range(15):
        near = np.argsort(np.linalg.norm(mesh.centroids - 0.5, axis=1))[:3]
        mesh = mesh.refined(near, "longest")
        least.append(mesh.quality.min())
    assert mesh.volumes.min() < 1e-3 * mesh.volumes.max() and min(least) > 0.25 and least[-1] == pytest.approx(least[7])


def test_supports_along_a_line_stay_so_where_ten_nodes_are_refined():
    mesh = ds.TetrahedralMesh.create_box((3, 3, 3), (1.0, 1.0, 1.0), "five").quadratic()
    on_line = lambda x: (x[:, :2] == 0).all(1)  # noqa: E731
    fine = mesh.with_vertex_set("line", on_line(mesh.vertices)).refined()
    np.testing.assert_array_equal(np.sort(fine.vertex_sets["line"]), np.flatnonzero(on_line(fine.vertices)))


def test_new_vertices_go_onto_a_round_surface():
    octahedron = np.concatenate([np.eye(3), -np.eye(3), np.zeros((1, 3))])
    faces = [[6, i, 1 + j, 2 + k] for i in (0, 3) for j in (0, 3) for k in (0, 3)]
    mesh = ds.TetrahedralMesh(octahedron, faces, fix_orientation=True)
    onto = lambda x: x * np.abs(x).sum(1, keepdims=True) / np.linalg.norm(x, axis=1, keepdims=True)  # noqa: E731
    ball = mesh.refined(onto=onto)
    assert np.linalg.norm(ball.vertices[ball.surface_vertices], axis=1) == pytest.approx(1, rel=1e-12)
    assert mesh.volume == pytest.approx(4 / 3) and ball.volume > 2
    with pytest.raises(ValueError, match="onto: expected places"):
        mesh.refined(onto=lambda x: x[:2])
    with pytest.raises(ValueError, match='"longest"'):
        mesh.refined([0], edges="shortest")


# ---- error bars ---------------------------------------------------------------------------------------------------------


KNOWN = [("cook", 1, 2), ("cook", 2, 2), ("lame", 1, 3), ("elastica", 2, 1), ("thick plate", 2, 1)]


@pytest.mark.parametrize("name, order, size", KNOWN)
def test_the_estimate_is_the_true_error(name, order, size):
    """Effectivity 0.7 to 1.4, of equilibria and of implicit steps, and no bar is far wider than the error."""
    found, true = BARS.measured(name, order, size)
    assert 0.7 < found.error / true < 1.4 and abs(true) < found.bar < 2 * abs(true)
    assert found.shares.sum() == pytest.approx(found.mesh, rel=1e-6)
    assert abs(found.corrected - (found.value - true)) < 0.5 * abs(true)


def block(order: int = 1, precision: str = "f64", tolerance: float = 1e-8) -> ds.Rollout:
    mesh = ds.TetrahedralMesh.create_box((3, 2, 2), (2.0, 1.0, 1.0))
    mesh = mesh.quadratic() if order == 2 else mesh
    terms = ds.Traction((0, 0, -2e3), "xmax")
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e6, 0.3), terms=terms, fixed="xmin", precision=precision)
    return ds.Rollout(ds.StaticSolver(scene, tolerance=tolerance), 1, outputs=ds.MaterialPoints([[2, 0.5, 0.5]], "end"))


def test_a_mesh_without_an_error_has_a_bar_as_small_as_the_tolerance():
    found, true = BARS.measured("uniaxial", 1, 2)
    assert found.relative < 1e-8 and abs(found.error - true) < 1e-12 and not found.doubts


def test_what_cancels_is_of_the_frames_that_the_number_is_of():
    off = {"end": np.array([3.0, -1.0])[:, None, None] * [0, 0, 1]}
    for of_frames, most in (([0, 1], 3.0), ([1, 0], 3.0), ([0.5, 1], 3.0), ([1, 2], 6.0), ([2, 1], 7.0)):
        number = estimate.Number(block(), "end", np.array(of_frames)[:, None, None] * [0, 0, 1])
        assert number.largest(off, {"end": 0 * off["end"]}) == most


def test_bars_of_random_problems_hold_the_error_of_most(monkeypatch, capsys):
    """One block under random loads: ten nodes in equilibrium, four in steps."""
    random = example("benchmarks/random_error_bars")
    rows = {moves: random.numbers(1, 1 if moves else 2, moves) for moves in (False, True)}
    monkeypatch.setattr(random, "numbers", lambda seed, order, moves: rows[moves])
    random.main(1)
    for kind, line in zip((False, False, True, True), capsys.readouterr().out.splitlines()[2:], strict=True):
        error, uncancelled, true, _ = np.array(rows[kind]).T
        assert np.all(uncancelled >= abs(error)) and 0.7 < np.median(error / true) < 1.0
        count, held, median, most, worst, quiet, good = map(float, line.split("|")[3:-1])
        assert count == len(true) > 20 and held > 0.9 and 1.3 < median < most < 8 and worst < 2.5
        assert 0 < quiet < 1 and good > 0.4


def test_doubts_have_names():
    """Of a mesh that locks, with an error that is large, in one tetrahedron, beside contact; and of a smaller, even one."""
    scene = block().scene
    stiff = scene.replace(material=ds.StableNeoHookean(1e6, 0.49))
    for of, mesh, shares, contact, names in (
        (stiff, 0.3, np.eye(60)[0], True, ["singular", "contact", "locking", "coarse"]),
        (scene, 0.2, np.full(60, 1 / 60), False, []),
    ):
        errors = dict(mesh=mesh, step=0.0, solver=0.0, rounding=0.0, uncancelled=dict(mesh=mesh, step=0.0))
        found = estimate.Accuracy("end", 1.0, 1.0, **errors, shares=mesh * shares, cost={})
        assert list(estimate._doubts(of, found, dict(unplaced="", contact=contact))) == names


def test_components_of_a_vector_count_together():
    rollout = block().on(block().solver, outputs=ds.CenterOfMass())
    off = np.array([[0.0, 0, 0], [3, 4, 0]])
    number = estimate.Number(rollout, "center_of_mass", (0, 0, 1))
    assert number.largest({"center_of_mass": off}, {"center_of_mass": 0 * off}) == 5


@pytest.fixture
def first_order(monkeypatch):
    """Sums of the shares by residuals and adjoints, as they come, before they are made to add up to what was solved."""
    sums, by_element = [], estimate._by_element

    def noted(*arguments):
        sums.append(by_element(*arguments).sum())
        return by_element(*arguments)

    monkeypatch.setattr(estimate, "_by_element", noted)
    return sums


UNEQUAL = ds.UnequalSteps([0.01, 0.02, 0.01], 2)
RUNS = [(ds.StaticSolver, 1), (ds.ImplicitMidpointSolver, UNEQUAL), (ds.ImplicitEulerSolver, 5), (ds.BDF2Solver, 5)]


@pytest.mark.parametrize("kind, steps", RUNS)
def test_small_motions_have_the_exact_difference_of_two_meshes(kind, steps, first_order):
    """Where all is linear the first order is all there is, of every solver, whatever acts."""
    mesh = block().scene.mesh
    terms = [ds.Traction((0, 0.1, -0.2), "xmax"), ds.Gravity((0, 1e-4, 2e-4))]
    terms += [] if kind is ds.StaticSolver else [ds.Drag(3.0)]
    start = dict(initial_velocities=1e-6 * np.sin(mesh.vertices * [1, 2, 3]))
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e6, 0.3), 900.0, terms, "xmin", precision="f64", **start)
    outputs = ds.MaterialPoints([[2, 0.5, 0.5], [1.2, 0.3, 0.7]], "places")
    rollout = ds.Rollout(kind(scene, dt=0.02, tolerance=1e-9), steps, outputs=outputs)
    weights = np.array([[1.0, -2.0, 3.0], [0.5, 1.0, -1.0]])
    scaled = rollout.on(rollout.solver, clip=1e-9, truncate=1)  # which change gradients, but no estimate
    found = scaled.accuracy("places", weights)
    other = rollout_on_finer(rollout, ds.TetrahedralMesh.quadratic).forward()["places"][-1]
    difference = (weights * (rollout.forward()["places"][-1] - other)).sum()
    assert found.mesh + found.solver == pytest.approx(difference, rel=2e-3, abs=1e-14)
    assert first_order[-1] == pytest.approx(found.mesh, rel=2e-3, abs=1e-14)
    if steps == 5:
        finer = rollout.on(rollout.solver.for_scene(scene, substeps=8)).forward()["places"][-1]
        assert found.step == pytest.approx((weights * (rollout.forward()["places"][-1] - finer)).sum(), rel=0.4)


def test_what_the_solver_and_rounding_leave():
    down = (0.0, 0.0, 1.0)
    exact, loose, rough = block(), block(tolerance=0.5), block(precision="f32")
    value = exact.forward()["end"][-1, 0, 2]
    found = loose.accuracy("end", down)
    assert abs(found.solver) > 1e-6 * found.size and found.solver == pytest.approx(found.value - value, rel=0.3)
    assert abs(exact.accuracy("end", down).solver) < 1e-3 * abs(found.solver)
    found = rough.accuracy("end", down)
    assert found.rounding == pytest.approx(rough.forward()["end"][-1, 0, 2] - value, rel=0.2)
    assert 0 < abs(found.rounding) < 1e-4 * found.size
    assert exact.accuracy("end", down).rounding < 1e-12


def glued(kind, gravity: float) -> ds.Rollout:
    box = ds.TetrahedralMesh.create_box
    mesh = ds.TetrahedralMesh.joined({"left": box(2, 1.0), "right": box(3, 1.0, origin=(1, 0, 0))})
    terms = [ds.Tie("left_xmax", "right_xmin"), ds.Gravity((0, -gravity, 0))]
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), terms=terms, fixed="left_xmin", precision="f64")
    return ds.Rollout(kind(scene, dt=0.02), 5, outputs=ds.MaterialPoints([[2, 0.5, 0.5]], "end"))


def falling(kind, gravity: float, tip=None, **options) -> ds.Rollout:
    """A bar that is held at one end; tip: what its other end moves by."""
    mesh = ds.TetrahedralMesh.create_box((4, 2, 2), (3.0, 1.0, 1.0), "five")
    mesh, reduced = mesh.with_tetrahedron_set("tip", mesh.centroids[:, 0] > 2), None
    if tip is not None:
        x, y, z = mesh.vertices.T
        reduced = {"tip": np.stack([x**0, x, y, z, x * y], 1) if tip == "basis" else tip}
    terms = ds.Gravity((0, -gravity, 0))
    law = ds.StableNeoHookean(1e5, 0.3)
    scene = ds.Scene(mesh, law, terms=terms, fixed="xmin", precision="f64", reduced=reduced)
    return ds.Rollout(kind(scene, **dict(dt=0.05) | options), 5, outputs=ds.MaterialPoints([[3, 0.5, 0.5]], "end"))


@pytest.mark.parametrize(
    "kind, tip",
    [(ds.BDF2Solver, "tie"), (ds.StaticSolver, "affine"), (ds.BDF2Solver, "rigid"), (ds.StaticSolver, "basis")],
)
def test_small_motions_of_ties_and_sets_have_the_exact_difference(kind, tip, first_order):
    rollout = glued(kind, 1e-4) if tip == "tie" else falling(kind, 1e-4, tip)
    found, fine = rollout.accuracy("end", (0.0, 1.0, 0.0)), rollout_on_finer(rollout, ds.TetrahedralMesh.quadratic)
    difference = found.value - fine.forward()["end"][-1, 0, 1]
    assert found.mesh + found.solver == pytest.approx(difference, rel=5e-3)
    assert first_order[-1] == pytest.approx(found.mesh, rel=5e-3)


FALLS = [(ds.BDF2Solver, "rigid", 0.05, 2), (ds.VelocityVerletSolver, None, 0.05, 2)]
FALLS += [(ds.ImplicitEulerSolver, None, 0.06, 9)]  # the estimate has the other sign


@pytest.mark.parametrize("kind, tip, dt, most", FALLS)
def test_the_bar_of_a_motion_has_the_error_by_two_finer_meshes(kind, tip, dt, most):
    rollout = falling(kind, 9.81, tip, dt=dt)
    found, fine = rollout.accuracy("end", (0.0, 1.0, 0.0)), rollout_on_finer(rollout, ds.TetrahedralMesh.quadratic)
    true = found.value - rollout_on_finer(fine, ds.TetrahedralMesh.refined, {}).forward()["end"][-1, 0, 1]
    of_mesh = 1.5 * abs(found.mesh) + found.uncancelled["mesh"] / 6
    assert abs(true) < of_mesh < most * abs(true) and of_mesh < found.bar
    assert ("unplaced" in found.doubts) == rollout.solver.explicit


@pytest.mark.parametrize("which", ["mesh", "step"])
def test_errors_that_cancel_are_said_and_widen_the_bar(which):
    """A number of two components whose weights leave it without an error."""
    rollout = falling(ds.BDF2Solver, 9.81)
    if which == "mesh":
        other, part = rollout_on_finer(rollout, ds.TetrahedralMesh.quadratic), 1.0
    else:
        other, part = rollout.on(rollout.solver.for_scene(rollout.scene, substeps=2)), 0.75
    apart = (rollout.forward()["end"] - other.forward()["end"])[-1, 0]
    size = np.linalg.norm(apart)
    found = rollout.accuracy("end", np.array([apart[1], -apart[0], 0.0]) / size)
    assert abs(getattr(found, which)) < 1e-6 * size and found.bar > found.uncancelled[which] / 6
    assert found.uncancelled[which] == pytest.approx(np.hypot(*apart[:2]) / part, rel=1e-2)
    assert f"add up to {found.uncancelled[which]:.2g}" in found.doubts[f"{which} cancels"]


def test_a_chamber_that_holds_its_volume_is_solved_on_the_finer_mesh():
    box = ds.TetrahedralMesh.create_box((4, 4, 4), 3.0)
    kept = box.tetrahedra[(np.abs(box.centroids - 1.5) > 0.5).any(1)]
    used, corners = np.unique(kept, return_inverse=True)
    mesh = ds.TetrahedralMesh(box.vertices[used], corners.reshape(-1, 4))
    mesh = mesh.with_vertex_set("floor", mesh.vertices[:, 1] == 0)
    wall = (np.abs(mesh.vertices[mesh.surface_triangles].mean(1) - 1.5) < 0.6).all(1)
    terms = [ds.FilledChamber(1.1, "wall"), ds.Gravity()]
    mesh, end = mesh.with_surface_set("wall", wall), ds.MaterialPoints([[1.5, 3, 1.5]], "end")
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), terms=terms, fixed="floor", precision="f64")
    rollout = ds.Rollout(ds.StaticSolver(scene), 1, outputs=end)
    found, fine = rollout.accuracy("end", (0.0, 1.0, 0.0)), rollout_on_finer(rollout, ds.TetrahedralMesh.quadratic)
    assert found.value - found.error == pytest.approx(fine.forward()["end"][-1, 0, 1], rel=1e-7)
    assert abs(found.solver) < 1e-6 * found.size and abs(found.error) > 1e-3 * found.size


def test_a_loss_and_a_place_by_the_vertices_are_numbers_too():
    rollout, n = block(), block().scene.mesh.num_vertices
    end = rollout.scene.mesh.vertices == (2.0, 1.0, 1.0)
    weights = end.all(1)[:, None] * [[0.0, 0.0, 1.0]]
    by_vertices = rollout.accuracy("displacements", weights)
    assert by_vertices.value == pytest.approx(rollout.forward().displacements[-1, end.all(1), 2].item())
    target = 0.01
    found = rollout.accuracy("end", lambda y: (0.5 * (y[-1, 0, 2] - target) ** 2, (y - target) * (y == y[-1, 0, 2])))
    place = rollout.accuracy("end", (0.0, 0.0, 1.0))
    assert weights.shape == (n, 3)
    assert found.corrected == pytest.approx(0.5 * (place.corrected - target) ** 2, rel=0.05)
    said = str(place)
    assert "end: " in said and "mesh +" in said and f"corrected {place.corrected:.6g}" in said


def test_tetrahedra_and_relations_stay_where_they_are_on_a_finer_mesh():
    mesh = body(1)
    relation = ds.MultiPointConstraint("left end", [[1, 0, 0], [-1, 0, 0]], stiffness=1e6)
    terms = [ds.BodyForce((0, 0, 1.0), [1, 5]), relation]
    scene = ds.Scene(mesh.with_vertex_set("left end", [0, 3]), ds.StableNeoHookean(1e6, 0.3), terms=terms, fixed="xmin")
    fine = on_finer(scene, ds.TetrahedralMesh.refined)
    load, relation = fine.terms_of(ds.BodyForce, ds.MultiPointConstraint)
    np.testing.assert_array_equal(load.chosen(fine.mesh), np.flatnonzero(np.isin(fine.mesh.refinement.parents, [1, 5])))
    np.testing.assert_array_equal(relation.indices(fine.mesh), [0, 3])


def test_what_cannot_be_estimated_is_refused():
    rollout = block()
    with pytest.raises(ValueError, match="finer: must return the mesh of 12 vertices"):
        rollout.accuracy("end", (0.0, 0.0, 1.0), lambda mesh: mesh.refined().refined())
    with pytest.raises(ValueError, match="did you mean 'end'"):
        rollout.accuracy("ende")
    with pytest.raises(ValueError, match="pass weights of this shape"):
        rollout.accuracy("end")
    with pytest.raises(ValueError, match=r"weights: expected shape \(1, 3\)"):
        rollout.accuracy("end", np.ones(4))
    stress = rollout.on(rollout.solver, outputs=ds.Stress(at="vertices"))
    with pytest.raises(ValueError, match="Stress at points"):
        stress.accuracy("stress", np.ones(stress.outputs["stress"].shape(2)[1:]))
    with pytest.raises(ValueError, match="Stress at points"):
        stress.accuracy("stress", lambda y: (y.sum(), np.ones_like(y)))
    greatest = ds.SmoothMaximum(ds.Stress(von_mises=True, of=[0, 1]))
    with pytest.raises(ValueError, match="name them as a set"):
        rollout.on(rollout.solver, outputs=greatest).accuracy("smooth_maximum", finer=ds.TetrahedralMesh.refined)


# ---- refinement by it ---------------------------------------------------------------------------------------------------


def test_refinement_ends_below_the_tolerance_with_gradients_there():
    start = block()
    found = ds.refine(start, "end", 0.4, (0.0, 0.0, 1.0), ten_nodes=False)
    unknowns = [n for n, _ in found.history]
    assert found.reached and found.accuracy.relative <= 0.4 < found.history[0][1].relative
    assert unknowns == sorted(unknowns) and 3 * found.mesh.num_vertices == unknowns[-1]
    frames = found.rollout.forward()
    assert found.rollout.solver.tolerance == start.solver.tolerance
    assert frames["end"][-1, 0, 2] == pytest.approx(found.accuracy.value)
    seed = np.zeros((2, 1, 3))
    seed[-1, 0, 2] = 1.0
    gradients = found.rollout.vjp(frames, end=seed)  # twice as stiff under twice the load is as before
    by_load = (gradients["traction"] * [0, 0, -2e3]).sum()
    assert gradients["youngs_modulus"] * 1e6 == pytest.approx(-by_load, rel=1e-6)
    assert not ds.refine(start, "end", 1e-9, (0.0, 0.0, 1.0), rounds=0).reached


def test_a_linear_mesh_is_given_ten_nodes_first():
    start, down = block(), (0.0, 0.0, 1.0)
    found = ds.refine(start, "end", 0.01, down, rounds=1)
    assert [start.scene.mesh.order, found.mesh.order] == [1, 2]
    assert found.mesh.num_tetrahedra == start.scene.mesh.num_tetrahedra
    cut = ds.refine(start, "end", 0.01, down, rounds=1, ten_nodes=False)
    assert cut.mesh.order == 1 and cut.mesh.num_tetrahedra > start.scene.mesh.num_tetrahedra
    assert found.accuracy.bar < 0.5 * cut.accuracy.bar
    assert ds.refine(start, "end", 0.01, down, rounds=1, onto=np.array).mesh.order == 1  # middles would not lie there
