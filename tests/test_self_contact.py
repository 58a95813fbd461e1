"""Contact of bodies with each other and with themselves in runs: motion, gradients, conservation, determinism, refusals."""

from functools import lru_cache

import numpy as np
import pytest
from exact_predicates import ExactJudge
from pairs_alone import follow_parts
from scipy.integrate import quad
from scipy.optimize import brentq

import diffsim_ti as ds
from diffsim_ti import runtime, verify
from diffsim_ti.mechanics.surfaces import contact_stage
from diffsim_ti.mechanics.surfaces.surface_pairs import SurfacePairs

MATERIAL = ds.StableNeoHookean(5e4, 0.3)
STIFFNESS, WIDTH, DT = 2e4, 5e-3, 1e-4


def tetrahedron(size=0.1):
    return ds.TetrahedralMesh(size * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]), [[0, 1, 2, 3]])


@lru_cache
def crossed_edges(precision="f64", speed=3.0, solver=ds.SemiImplicitSolver, **options):
    """Two tetrahedra that meet edge across edge, a little askew."""
    corners = np.array([[-0.05, 0, 0], [0.05, 0, 0], [0, -0.08, -0.05], [0, -0.08, 0.05]])
    lower = ds.TetrahedralMesh(corners, [[0, 1, 2, 3]], fix_orientation=True)
    upper = lower.rotated([1, 0, 1], np.pi).rotated([1, 0.3, 0.2], 0.1).translated([0.01, 7e-3, 0.005])
    mesh = ds.TetrahedralMesh.joined([lower, upper])
    velocity = np.zeros((8, 3))
    velocity[4:] = [0.1, -speed, 0.2]
    scene = ds.Scene(
        mesh,
        MATERIAL,
        density=1000.0,
        terms=[ds.SelfContact(STIFFNESS, WIDTH)],
        initial_velocities=velocity,
        precision=precision,
    )
    return solver(scene, dt=DT, **options)


@lru_cache
def two_blocks(precision="f64", **options):
    """A turned block that falls on another; many pairs of all kinds."""
    block = ds.TetrahedralMesh.create_box(3, 0.1)
    upper = block.rotated([1, 2, 0.5], 0.7, center=(0.05, 0.05, 0.05)).translated([0.02, 0.125, 0.01])
    mesh = ds.TetrahedralMesh.joined([block, upper])
    velocity = np.zeros((mesh.num_vertices, 3))
    velocity[mesh.vertex_sets["body_1"]] = [0, -2, 0]
    scene = ds.Scene(
        mesh,
        MATERIAL,
        density=1000.0,
        terms=[ds.SelfContact(STIFFNESS, WIDTH)],
        initial_velocities=velocity,
        precision=precision,
    )
    return ds.SemiImplicitSolver(scene, dt=DT, **options)


@lru_cache
def collision():
    """A rollout of the blocks through their first contact."""
    return ds.Rollout(two_blocks(), 150, gradients="all")


def momenta(simulator):
    mass, x, v = simulator._start.mass[:, None], simulator.positions, simulator.velocities
    return (mass * v).sum(0), np.cross(x, mass * v).sum(0), (mass * np.abs(v)).sum()


def test_energy_and_momenta_through_a_collision():
    simulator = ds.Simulator(two_blocks())
    energy, (p, L, size) = simulator.compute_energy(), momenta(simulator)
    contact, gap = 0.0, np.inf
    for _ in range(30):
        simulator.run(10)
        now = simulator.compute_energy()
        contact, gap = max(contact, now.parts["contact"]), min(gap, simulator.smallest_gap())
    assert contact > 1e-4 * energy and 0 < gap < WIDTH
    assert abs(now - energy) <= 0.01 * energy
    p1, L1, _ = momenta(simulator)
    assert np.abs(p1 - p).max() <= 1e-12 * size and np.abs(L1 - L).max() <= 1e-12 * size
    simulator.check_surfaces()


@pytest.mark.parametrize("kind", ["edges", "blocks"])
def test_gradients_through_a_collision(kind):
    rollout = collision() if kind == "blocks" else ds.Rollout(crossed_edges(), 60, gradients="all")
    frames = rollout.forward()
    free = (frames.displacements[-1] - frames.displacements[0]) - rollout.values["initial_velocities"] * frames.times[
        -1
    ]
    assert np.abs(free).max() > 1e-3  # they met
    loss = verify.linear_loss(rollout)
    value, *adjoints = loss(frames)
    gradients = rollout.vjp(frames, *adjoints)
    rng = np.random.default_rng(0)
    for name in rollout.wanted:
        x = rollout.values[name]
        direction = rng.standard_normal(x.shape) * (np.abs(x).max() if x.ndim == 0 else 0.01)
        slope = float((gradients[name] * direction).sum())
        steps = np.array([3e-5, 1e-5])
        central = [
            (
                loss(rollout.forward(**{name: x + s * direction}))[0]
                - loss(rollout.forward(**{name: x - s * direction}))[0]
            )
            / (2 * s)
            for s in steps
        ]
        # second derivatives jump where pairs change their nearest corners: no better than that
        assert min(abs(c - slope) for c in central) <= 2e-5 * abs(slope) + 1e-9, name


@pytest.mark.parametrize("solver", [ds.SemiImplicitSolver, ds.VelocityVerletSolver])
def test_tangent_and_adjoint_agree(solver):
    rollout = ds.Rollout(crossed_edges(solver=solver), 60, save_every=20, gradients="all")
    assert verify.dot_product_test(rollout) <= 1e-11


def test_checkpoints_and_list_age_do_not_change_a_bit(monkeypatch):
    rollout = collision()
    frames = rollout.forward()
    adjoints = np.random.default_rng(1).normal(size=(2, *frames.positions.shape))
    whole = rollout.vjp(frames, *adjoints)
    again = ds.Rollout(two_blocks(), 150, checkpoint_every=7, gradients="all")
    builds = []
    names = "least_slack", "typical_slack", "fewest_passes"
    for numbers in ([getattr(SurfacePairs, name) for name in names], (0.02, 0.05, 2)):
        for name, number in zip(names, numbers):
            monkeypatch.setattr(SurfacePairs, name, number)
        before = again.sweep.workspace.pairs.builds if again.sweep.workspace else 0
        other = again.forward()
        builds.append(again.sweep.workspace.pairs.builds - before)
        np.testing.assert_array_equal(other.positions, frames.positions)
    assert builds[1] > 1.5 * builds[0]  # other lists
    pieces = again.vjp(other, *adjoints)
    for name in whole:
        np.testing.assert_array_equal(pieces[name], whole[name], err_msg=name)


def test_threads_do_not_change_a_bit():
    positions = []
    for parallel in (True, False, True):
        simulator = ds.Simulator(ds.SemiImplicitSolver(two_blocks().scene, dt=DT, parallel=parallel))
        simulator.run(150)
        positions.append(simulator.positions)
    assert simulator.compute_energy().parts["contact"] > 0
    np.testing.assert_array_equal(positions[0], positions[1])
    np.testing.assert_array_equal(positions[0], positions[2])


HEAD_ON = dict(speed=1.0, gap=0.02, time=0.06, stiffness=3e3, width=8e-3)


@lru_cache
def head_on():
    """A rollout of equal stiff bodies, corner against corner on one line; the left one moves."""
    body = tetrahedron().translated(-0.025 * np.ones(3))  # its centroid at the origin
    corner = body.vertices[1] / np.linalg.norm(body.vertices[1])
    turn = np.cross(corner, [1.0, 0.0, 0.0])
    left = body.rotated(turn / np.linalg.norm(turn), float(np.arccos(corner[0])))
    left = left.translated([-left.vertices[:, 0].max() - HEAD_ON["gap"] / 2, 0, 0])
    mesh = ds.TetrahedralMesh.joined([left, left.rotated([0, 1, 0], np.pi)])
    velocity = np.zeros((8, 3))
    velocity[:4, 0] = HEAD_ON["speed"]
    contact = ds.SelfContact(HEAD_ON["stiffness"], HEAD_ON["width"])
    scene = ds.Scene(
        mesh,
        ds.StableNeoHookean(1e7, 0.3),
        density=1000.0,
        terms=[contact],
        initial_velocities=velocity,
        precision="f64",
    )
    rollout = ds.Rollout(
        ds.SemiImplicitSolver(scene, dt=5e-5), 1200, gradients=["initial_velocities", "initial_positions"]
    )
    return rollout, rollout.forward(), 1000.0 * body.volume


def test_head_on_collision_exchanges_velocities():
    """Velocities are exchanged, as are their derivatives."""
    rollout, frames, _ = head_on()
    travelled = [(frames.positions[-1, k : k + 4] - frames.positions[0, k : k + 4]).mean(0)[0] for k in (0, 4)]
    np.testing.assert_allclose(sum(travelled), HEAD_ON["speed"] * HEAD_ON["time"], rtol=1e-10)
    seed = np.zeros(frames.positions.shape)
    seed[-1, 4:, 0] = 0.25
    gradients = rollout.vjp(frames, velocities=seed)
    # v_right(T) = v_left(0)
    by_left, by_right = (gradients["initial_velocities"][k : k + 4, 0].sum() for k in (0, 4))
    assert by_left == pytest.approx(1.0, abs=0.05) and by_right == pytest.approx(0.0, abs=0.05)
    v = [frames.velocities[-1, k : k + 4].mean(0)[0] for k in (0, 4)]
    assert v[0] == pytest.approx(0, abs=0.05) and v[1] == pytest.approx(HEAD_ON["speed"], rel=0.05)


def test_head_on_collision_ends_where_rigid_bodies_would():
    """Positions and their gradients against the exact motion of two rigid bodies that exchange their velocities.

    Within the width w they spend the time t = 2 int dd / sqrt(v^2 - 2 E(d) / (m / 2)), so that the right body travels
    v T + w - gap - v t / 2. Corner on corner: six pairs of vertex and triangle and nine of edges, all at one distance.
    """
    rollout, frames, mass = head_on()
    gap, time, stiffness, w = (HEAD_ON[name] for name in ("gap", "time", "stiffness", "width"))

    def travel(v):
        energy = lambda d: -15 * stiffness * (d - w) ** 2 * np.log(d / w)  # noqa: E731
        least = brentq(lambda d: energy(d) - mass * v * v / 4, 1e-9 * w, w * (1 - 1e-9))
        # d = least + (w - least) x^2 takes the root at the turning point away
        inside = (
            2
            * quad(
                lambda x: 2 * (w - least) * x / np.sqrt(v * v - 4 * energy(least + (w - least) * x * x) / mass), 1e-6, 1
            )[0]
        )
        return v * time + w - gap - v * inside / 2

    speed = HEAD_ON["speed"]
    travelled = (frames.positions[-1, 4:] - frames.positions[0, 4:]).mean(0)[0]
    assert travelled == pytest.approx(travel(speed), rel=0.05)  # the bodies are not rigid
    seed = np.zeros(frames.positions.shape)
    seed[-1, 4:, 0] = 0.25
    gradients = {name: g[:4, 0].sum() for name, g in rollout.vjp(frames, positions=seed).items()}
    slope = (travel(speed + 1e-4) - travel(speed - 1e-4)) / 2e-4
    assert gradients["initial_velocities"] == pytest.approx(slope, rel=0.05)
    assert gradients["initial_positions"] == pytest.approx(
        1.0, rel=0.05
    )  # an earlier hit by as much is that much farther


@lru_cache
def stacked(gap=1e-3, precision="f64"):
    """Two equal cubes, face upon face, corner upon corner, pressed together at rest in space."""
    cube = ds.TetrahedralMesh.create_box(3, 0.1, pattern="five")
    mesh = ds.TetrahedralMesh.joined([cube.translated([0, -0.1 - gap / 2, 0]), cube.translated([0, gap / 2, 0])])
    return ds.Scene(mesh, MATERIAL, density=1000.0, terms=[ds.SelfContact(500.0, WIDTH)], precision=precision)


def test_touching_faces_stay_symmetric():
    """Every corner above a corner, every edge parallel to one below: finite, and mirrored to round-off."""
    simulator = ds.Simulator(ds.SemiImplicitSolver(stacked(), dt=DT))
    simulator.run(100)
    lower, upper = np.split(simulator.displacements, 2)
    assert np.all(np.isfinite(upper)) and upper[:, 1].mean() > 1e-5
    assert abs(upper[:, 1].sum() + lower[:, 1].sum()) <= 1e-12
    turned = 2 * np.array([0.05, 0, 0.05]) * [1, 0, 1]  # half a turn about the vertical through the centre
    rest = stacked().mesh.vertices[27:]
    partner = [int(np.argmin(np.abs(rest - (turned + x * [-1, 1, -1])).sum(1))) for x in rest]
    np.testing.assert_allclose(upper[partner], upper * [-1, 1, -1], atol=1e-10)


def test_no_contact_costs_no_bit():
    """Bodies that never come near move as if there were no contact."""
    scene = two_blocks().scene
    apart = np.array(scene.mesh.vertices)
    apart[scene.mesh.vertex_sets["body_1"]] += [0, 1, 0]
    runs = [
        ds.Simulator(ds.SemiImplicitSolver(scene.replace(terms=terms, initial_positions=apart), dt=DT))
        for terms in ([ds.SelfContact(STIFFNESS, WIDTH)], [])
    ]
    for run in runs:
        run.run(50)
    np.testing.assert_array_equal(runs[0].positions, runs[1].positions)
    assert runs[0].smallest_gap() == np.inf


@pytest.mark.backends
def test_collision_in_single_precision():
    if runtime.arch_name() == "vulkan":
        pytest.skip("kernels of the stage take more arrays than it lends")
    simulator = ds.Simulator(crossed_edges("f32"))
    gaps = []
    for _ in range(8):
        simulator.run(5)
        gaps.append(simulator.smallest_gap())
    assert 0 < min(gaps) < 0.8 * WIDTH and simulator.velocities[:4, 1].mean() < -0.5
    p, _, size = momenta(simulator)
    np.testing.assert_allclose(p, (simulator._start.mass[:, None] * simulator._start.velocity).sum(0), atol=1e-5 * size)


# ---- refusals --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments, said", [((-1.0, 1e-3), "stiffness"), ((1.0, 0.0), "width"), ((np.nan, 1), "finite")]
)
def test_bad_numbers_are_refused(arguments, said):
    with pytest.raises(ValueError, match=said):
        ds.SelfContact(*arguments)


def test_bodies_that_start_in_each_other_are_refused():
    scene = two_blocks().scene
    start = np.array(scene.mesh.vertices)
    start[scene.mesh.vertex_sets["body_1"]] -= [0, 0.06, 0]
    with pytest.raises(ValueError, match=r"pass through each other: edge \(\d+, \d+\) and triangle .*apart"):
        ds.Simulator(ds.SemiImplicitSolver(scene.replace(initial_positions=start), dt=DT))
    simulator = ds.Simulator(two_blocks())
    with pytest.raises(ValueError, match="pass through each other"):
        simulator.set_state(positions=start)


def test_a_width_beyond_many_elements_is_refused():
    scene = two_blocks().scene.replace(terms=[ds.SelfContact(STIFFNESS, 0.5)])
    with pytest.raises(ValueError, match=r"more than 4 times the mean edge.*take a width below 0\.\d+ m") as refusal:
        ds.Simulator(ds.SemiImplicitSolver(scene, dt=DT))
    width = float(str(refusal.value).split()[-2])
    assert 0.1 < width < 0.5


def test_what_the_stage_cannot_resolve_is_an_error_that_keeps_the_state(monkeypatch):
    """Where parts of a substep may not become as short as they would have to."""
    monkeypatch.setattr(contact_stage, "SHORTEST", 0.3)
    simulator = ds.Simulator(crossed_edges(speed=100.0, substeps=1))
    with pytest.raises(ds.Tunnelling, match=r"^step \d+, t = .*substep of 0\.0001 s.*take substeps of") as error:
        simulator.run(20)
    assert error.value.step == simulator.step_count and f"t = {simulator.time:.6g} s" in str(error.value)
    simulator.check_surfaces()
    monkeypatch.undo()
    step = error.value.enough
    assert f"take substeps of {step:.3g} s" in str(error.value)
    shorter = ds.Simulator(ds.SemiImplicitSolver(simulator.solver.scene, dt=step, substeps=1))
    shorter.run(round(2e-3 / step))
    shorter.check_surfaces()


@pytest.mark.parametrize("stiffness, dt", [(1e-2, 4e-4), (1e7, 4e-4)])
def test_the_stage_keeps_surfaces_apart_whatever_the_stiffness(stiffness, dt):
    """Much too weak, and much too stiff for a force in such steps: no intersection, momenta to round-off, no
    energy from nowhere but for the second order of turning surfaces."""
    mesh, scene = two_blocks().scene.mesh, two_blocks().scene
    scene = scene.replace(terms=[ds.SelfContact(stiffness, WIDTH)])
    simulator = ds.Simulator(ds.SemiImplicitSolver(scene, dt=dt))
    judge = ExactJudge(mesh.vertices, mesh.surface_triangles, (), mesh.elements, np.arange(mesh.num_vertices))
    energy, (p, L, size) = simulator.compute_energy(), momenta(simulator)
    for _ in range(8):
        simulator.run(3)
        assert judge.count(simulator.positions) == 0 and simulator.smallest_gap() > 0
    p1, L1, _ = momenta(simulator)
    assert np.abs(p1 - p).max() <= 1e-12 * size and np.abs(L1 - L).max() <= 1e-12 * size
    lower = mesh.vertex_sets["body_0"]
    assert np.linalg.norm(simulator.velocities[lower].mean(0)) > 0.1  # they met
    assert simulator.compute_energy() <= 1.02 * energy


@pytest.mark.parametrize("mu, speed", [(0.4, 1e-3), (1e-2, 1e-5), (1e3, 1.0)])
def test_parts_of_the_stage_are_those_of_its_formulas(mu, speed, monkeypatch):
    """The list and its length leave no trace."""
    seen, scene = follow_parts(monkeypatch), two_blocks().scene
    scene = scene.replace(terms=[ds.SelfContact(STIFFNESS, WIDTH, friction=mu, friction_speed=speed)])

    def frames():
        rollout = ds.Rollout(ds.SemiImplicitSolver(scene, dt=4e-4, substeps=1), 24, gradients="all")
        out = rollout.forward()
        rollout.vjp(out, np.ones_like(out.positions))  # for which passes are recorded
        return out.positions

    first = frames()
    assert sum(pressed for pressed, _ in seen) > 10 and max(lost for _, lost in seen) > 1e-6
    if mu == 0.4:
        monkeypatch.setattr(contact_stage, "PASSES", (1.0, 1.0))
        np.testing.assert_array_equal(first, frames())


def test_one_per_scene_and_gap_needs_it():
    scene = two_blocks().scene
    with pytest.raises(ValueError, match="one SelfContact"):
        scene.replace(terms=[ds.SelfContact(), ds.SelfContact()])
    with pytest.raises(ValueError, match="add it to the scene's terms"):
        ds.Simulator(ds.SemiImplicitSolver(scene.replace(terms=[]), dt=DT)).smallest_gap()


# ---- meshes of several bodies ----------------------------------------------------------------------------------------


def test_joined_meshes_keep_their_sets():
    a, b = ds.TetrahedralMesh.create_box(2, 0.1), ds.TetrahedralMesh.create_box(3, 0.1).translated([1, 0, 0])
    a = a.with_tetrahedron_set("hard", [0, 1])
    both = ds.TetrahedralMesh.joined([a, b])
    assert both.num_pieces == 2 and both.num_tetrahedra == a.num_tetrahedra + b.num_tetrahedra
    np.testing.assert_array_equal(both.vertices, np.concatenate([a.vertices, b.vertices]))
    np.testing.assert_array_equal(both.vertex_sets["body_1"], a.num_vertices + np.arange(b.num_vertices))
    expected = np.concatenate([a.vertex_sets["ymin"], a.num_vertices + b.vertex_sets["ymin"]])
    np.testing.assert_array_equal(both.vertex_sets["ymin"], expected)
    np.testing.assert_array_equal(both.tetrahedron_sets["hard"], [0, 1])
    assert both.volume == pytest.approx(a.volume + b.volume, rel=1e-14)


def test_joined_refuses_nothing_and_taken_names():
    with pytest.raises(ValueError, match="at least one mesh"):
        ds.TetrahedralMesh.joined([])
    with pytest.raises(ValueError, match="rename"):
        ds.TetrahedralMesh.joined([tetrahedron().with_vertex_set("body_0", [0])])
