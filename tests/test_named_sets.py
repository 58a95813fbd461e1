"""Numbers of a material by named sets, and gradients by the same names: from NumPy, under a tape, from torch."""

from functools import lru_cache

import numpy as np
import pytest
import taichi as ti

import diffsim_ti as ds
from diffsim_ti import verify
from diffsim_ti.outputs import Change


@lru_cache
def bar() -> ds.Rollout:
    """A bar whose middle is soft, bent by its weight."""
    mesh = ds.TetrahedralMesh.create_box((4, 2, 2), (0.3, 0.1, 0.1))
    middle = mesh.vertices[mesh.tetrahedra].mean(1)[:, 0]
    soft, stiff = np.flatnonzero(middle < 0.1), np.flatnonzero(middle > 0.2)
    sets = dict(vertex_sets=mesh.vertex_sets, tetrahedron_sets=dict(soft=soft, stiff=stiff, all=soft))
    mesh = ds.TetrahedralMesh(mesh.vertices, mesh.tetrahedra, **sets)
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), terms=[ds.Gravity()], fixed="xmin", precision="f64")
    return ds.Rollout(ds.VelocityVerletSolver(scene, dt=1e-3), 20)


GIVEN = dict(soft=4e4, stiff=2e5)


def whole() -> np.ndarray:
    mesh, E = bar().scene.mesh, np.full(bar().scene.mesh.num_tetrahedra, 1e5)
    for name, value in GIVEN.items():
        E[mesh.tetrahedron_sets[name]] = value
    return E


def seed(frames) -> np.ndarray:
    return np.random.default_rng(0).standard_normal(frames.positions.shape)


def test_gradients_have_the_names_of_the_sets():
    rollout = bar()
    frames, same = rollout.forward(youngs_modulus=GIVEN), rollout.forward(youngs_modulus=whole())
    assert np.array_equal(frames.positions, same.positions)
    by_sets = rollout.vjp(frames, positions=seed(frames))["youngs_modulus"]
    by_all = rollout.vjp(same, positions=seed(frames))["youngs_modulus"]
    for name in GIVEN:
        assert by_sets[name] == pytest.approx(by_all[rollout.scene.mesh.tetrahedron_sets[name]].sum(), rel=1e-14)
    assert by_sets.keys() == GIVEN.keys()

    def loss(**E):
        return float((rollout.forward(youngs_modulus=GIVEN | E).positions * seed(frames)).sum())

    difference = (loss(soft=4e4 + 20) - loss(soft=4e4 - 20)) / 40
    assert by_sets["soft"] == pytest.approx(difference, rel=1e-6)


def test_tangents_by_sets_meet_the_gradients():
    rollout = bar()
    frames, change = rollout.forward(youngs_modulus=GIVEN | dict(default=9e4)), dict(soft=3.0, default=-2.0)
    gradient = rollout.vjp(frames, positions=seed(frames))["youngs_modulus"]
    moved, _ = rollout.jvp(frames, youngs_modulus=change)
    assert gradient.keys() == {"soft", "stiff", "default"}
    assert (moved * seed(frames)).sum() == pytest.approx(
        sum(change[name] * gradient[name] for name in change), rel=1e-12
    )


def test_fields_of_sets_under_a_tape():
    rollout, loss = bar(), ti.field(ti.f64, shape=(), needs_grad=True)

    @ti.kernel
    def height(x: ti.template()):
        for i in range(x.shape[1]):
            loss[None] += x[1, i].y

    for name, value in GIVEN.items():
        rollout.field(f"youngs_modulus[{name}]")[None] = value
    with ti.ad.Tape(loss):
        rollout.run()
        height(rollout.positions)
    frames = rollout.forward(youngs_modulus=GIVEN)
    up = np.zeros(frames.positions.shape)
    up[1, :, 1] = 1
    taped = dict(rollout.gradients)
    expected = rollout.vjp(frames, positions=up)["youngs_modulus"]
    for name in GIVEN:
        key = f"youngs_modulus[{name}]"
        assert taped[key] == pytest.approx(expected[name], rel=1e-12)
        assert rollout.field(key).grad[None] == pytest.approx(expected[name], rel=1e-12)


def test_tensors_of_sets():
    torch = pytest.importorskip("torch")
    from diffsim_ti.torch_bridge.rollout_node import rollout_frames

    rollout = bar()
    E = {name: torch.tensor(value, dtype=torch.float64, requires_grad=True) for name, value in GIVEN.items()}
    rollout_frames(rollout, youngs_modulus=E).positions[-1, :, 1].sum().backward()
    frames = rollout.forward(youngs_modulus=GIVEN)
    up = np.zeros(frames.positions.shape)
    up[-1, :, 1] = 1
    expected = rollout.vjp(frames, positions=up)["youngs_modulus"]
    assert {name: x.grad.item() for name, x in E.items()} == pytest.approx({k: float(x) for k, x in expected.items()})


@pytest.mark.parametrize(
    "given, said",
    [
        (dict(youngs_modulus=dict(hard=1e5)), r"no tetrahedron set 'hard' \(it has: 'soft', 'stiff', 'all'\)"),
        (dict(youngs_modulus=dict(soft=1e5, all=1e5)), "in both 'soft' and 'all'; make the sets disjoint"),
        (dict(youngs_modulus=dict(soft=[1.0, 2.0])), r"youngs_modulus\['soft'\]: expected shape \(\), got \(2,\)"),
        (dict(gravity=dict(soft=1.0)), "gravity: has no numbers per tetrahedron"),
        (dict(stiffness=dict(soft=1.0)), "no input named 'stiffness'"),
    ],
)
def test_what_sets_cannot_say(given, said):
    with pytest.raises(ValueError, match=said):
        bar().forward(**given)


# ---- bodies by name ---------------------------------------------------------------------------------------------------

BLOCK = ds.TetrahedralMesh.create_box((3, 2, 2))
LAW = ds.StableNeoHookean(1e5, 0.3)
BODIES = ds.TetrahedralMesh.joined({"ball": BLOCK, "left": BLOCK.translated((3.0, 0.0, 0.0))})


def test_bodies_have_numbers_and_results_by_name():
    law = ds.StableNeoHookean(youngs_modulus={"ball": 1e5, "left": 2e5}, poissons_ratio=0.3)
    floor = ds.Ground(height=-0.004, width=0.01, stiffness_per_area=1e7, name="floor")
    scene = ds.Scene(BODIES, law, {"ball": 900.0, "left": 1100.0}, [ds.Gravity(), floor], precision="f64")
    volumes = BODIES.volumes[BODIES.tetrahedron_sets["left"]]
    mass = scene.inputs.derive(scene.inputs.values).mass
    assert mass[BODIES.vertex_sets["left"]].sum() == pytest.approx(1100.0 * volumes.sum(), rel=1e-12)
    outputs = [
        ds.CenterOfMass("left"),
        ds.ContactForce("floor", on="left"),
        ds.ContactForce("floor", on="ball", about=(0, 0, 0), name="moment"),
        ds.ContactForce("floor", name="whole"),
        ds.Stress(of="ball"),
        ds.KineticEnergy(sets=["ball", "left"]),
        ds.KineticEnergy(name="both"),
    ]
    rollout = ds.Rollout(ds.SemiImplicitSolver(scene, dt=5e-4), 12, save_every=4, outputs=outputs, gradients="all")
    frames = rollout.forward(density={"ball": 900.0, "left": 1100.0})
    assert frames["stress"].shape == (4, len(BODIES.tetrahedron_sets["ball"]), 3, 3)
    np.testing.assert_allclose(frames["kinetic_energy"].sum(1), frames["both"], rtol=1e-12)
    x = frames.positions[:, BODIES.vertex_sets["left"]]
    np.testing.assert_allclose(
        frames["center_of_mass"], np.average(x, axis=1, weights=mass[BODIES.vertex_sets["left"]]), rtol=1e-12
    )
    whole, of_left = frames["whole"][-1, 1], frames["contact_force"][-1, 1]
    assert 0 < of_left < whole and of_left / whole == pytest.approx(1100 / 2000, abs=0.1)
    assert verify.dot_product_test(rollout) < 1e-11
    by_name = rollout.vjp(frames, center_of_mass=np.ones((4, 3)))["density"]
    assert by_name.keys() == {"ball", "left"} and by_name["ball"] == 0 != by_name["left"]


def test_the_center_of_mass_of_ten_nodes_is_an_integral():
    """Of a block that is twice as heavy on one side, with consistent masses, and its derivatives without any run."""
    mesh = ds.TetrahedralMesh.joined({"light": BLOCK, "heavy": BLOCK.translated((1.0, 0.0, 0.0))}).quadratic()
    law = ds.StableNeoHookean(1e5, 0.3)
    scene = ds.Scene(mesh, law, {"light": 1000.0, "heavy": 2000.0}, precision="f64").with_consistent_mass()
    rng = np.random.default_rng(2)
    one = np.ones((2, 1, 1))
    still = ds.Frames(
        one * mesh.vertices, 0 * one * mesh.vertices, 0 * one * mesh.vertices, one.ravel(), scene.inputs.values
    )
    whole = ds.CenterOfMass().settled(scene)
    np.testing.assert_allclose(whole.value(still)[-1], [(0.5 + 2 * 1.5) / 3, 0.5, 0.5], rtol=1e-12)
    part, seed = ds.CenterOfMass(["heavy"]).settled(scene), rng.standard_normal((2, 3))
    x = still.positions + 0.1 * rng.standard_normal(still.positions.shape)
    frames = ds.Frames(x, 0 * x, x - mesh.vertices, one.ravel(), scene.inputs.values)
    tangents = {
        name: rng.standard_normal(np.shape(scene.inputs.values[name])) for name in ("density", "rest_positions")
    }
    change = Change(positions=rng.standard_normal(x.shape), inputs=tangents)
    pulled = part.vjp(frames, seed)
    across = (pulled.positions * change.positions).sum()
    across += sum((pulled.inputs[name] * tangent).sum() for name, tangent in tangents.items())
    assert (seed * part.jvp(frames, change)).sum() == pytest.approx(across, rel=1e-10)


@pytest.mark.parametrize(
    "made, said",
    [
        (lambda: ds.TetrahedralMesh.joined({"": BLOCK}), "needs a name"),
        (lambda: ds.TetrahedralMesh.joined({"xmin": BLOCK}), "a mesh has a set 'xmin': rename"),
        (lambda: ds.TetrahedralMesh.joined({"a": BLOCK, "a_xmin": BLOCK}), "a mesh has a set 'a_xmin': rename"),
        (lambda: ds.Scene(BODIES, LAW, {"bal": 1.0}), "no tetrahedron set 'bal' .*'ball', 'left'"),
        (lambda: ds.Scene(BODIES, LAW, {"ball": 1.0}), 'add a number for "default"'),
        (lambda: ds.Scene(BODIES, LAW, {"ball": -1.0, "left": 1.0}), r"density\['ball'\] must be > 0"),
        (lambda: ds.CenterOfMass("bal").settled(ds.Scene(BODIES, LAW)), "there are: ball, "),
    ],
)  # fmt: skip
def test_bad_names_of_bodies_are_answered_with_the_list(made, said):
    with pytest.raises(ValueError, match=said):
        made()
