"""Numbers of a material by named sets, and gradients by the same names: from NumPy, under a tape, from torch."""

from functools import lru_cache

import numpy as np
import pytest
import taichi as ti

import diffsim_ti as ds


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
