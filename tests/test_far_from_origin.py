"""float32 far from the origin: what a scene does, and its gradients, do not depend on where it is; or somebody says so.

`battery_of_places.py` draws scenes of every term, solver and element.
"""

import json
import struct
import warnings

import numpy as np
import pytest
import torch
from contact_scenes import SHAPES, tetrahedron
from far_places import FAR, found, moved, worst
from scipy.spatial.transform import Rotation
from test_own_obstacle import Ring

import diffsim_ti as ds
from diffsim_ti.diff_physics import DifferentiableMaterial
from diffsim_ti.diff_simulator import DifferentiableSimulator, DifferentiableSolver, rollout_frames
from diffsim_ti.inputs.links import NearestPoint
from diffsim_ti.writers import Frame, open_writer

BESIDE = np.array([3.3, 2.2, -1.1])  # another rounding [m]
OWN = dict(stiffness=300.0, width=0.2)
ROUGH = OWN | dict(friction=0.3, friction_speed=20.0)
MESH = ds.TetrahedralMesh.joined([tetrahedron(0.15), tetrahedron(0.7)])  # an apex 5 cm below a face


def scene(*terms, mesh=MESH, **options) -> ds.Scene:
    terms = [ds.Gravity(), *terms]
    options = dict(precision="f32", initial_velocities=[0.8, -1.0, 0.3]) | options
    return ds.Scene(mesh, ds.StableNeoHookean(2e4, 0.3), 100.0, terms, **options)


def all_of_them(**options) -> ds.Scene:
    """Obstacles that stand, move and turn, one that its path brings from elsewhere, surfaces in contact, ties, a fluid."""
    shift, made = np.array([50.0, -80.0, 20.0]), np.array([0.25, -0.8, 0.2])
    brought = [0, 0.02], np.array([[*shift, 0, 0, 0], [*(shift + [0.02, 0.01, -0.02]), 0.1, 0.2, -0.05]])
    return scene(
        SHAPES["ground"](**ROUGH),
        ds.HalfSpace([700.0, -140.0, 0.0], [0.2, 1, 0.0], **OWN),  # in the slope through the origin
        ds.Sphere(made - shift, 0.8, path=brought, about=made - shift + 0.1, **OWN),
        ds.SelfContact(300.0, 0.1),
        ds.Spring(2, ds.Anchor([0.3, 0.5, 0.6]), 40.0, name="tie"),
        ds.Cable([3, ds.Anchor([0.1, 0.9, 0.2]), 7], length=0.4, stiffness=30.0),
        *([] if "fixed" in options else [ds.SurfaceDrag(100.0)]),  # which equilibria do not have
        **options,
    )


def solver_of(kind, made, **options):
    return kind(made, **(dict(tolerance=1e-5) if kind is ds.StaticSolver else dict(dt=4e-3, substeps=2)), **options)


EXACT = np.array([2.0**17, 0.0, 10 * 2.0**20])  # what is taken off is what was added


@pytest.mark.parametrize("place", [FAR, EXACT], ids=["far", "exact"])
@pytest.mark.parametrize(
    "kind", [ds.SemiImplicitSolver, ds.ImplicitEulerSolver, ds.StaticSolver], ids=lambda k: k.__name__
)
def test_it_does_not_matter_where_a_scene_is(kind, place, vertices_alone):
    static = kind is ds.StaticSolver
    here = all_of_them(**(dict(fixed=[1, 2, 3, 5, 6, 7]) if static else {}))

    def at(offset):
        about = tuple(np.array([0.1, 0.2, 0.3]) + offset)
        outputs = [ds.Length("tie"), ds.Reaction(MESH.vertex_indices([1, 2, 3]), about=about)][: 1 + static]
        rollout = ds.Rollout(solver_of(kind, moved(here, offset)), 2, gradients="all", outputs=outputs)
        return found(rollout)

    near, far = at(np.zeros(3)), at(place)
    share, what = worst(far, near) if place is EXACT else worst(far, near, at(BESIDE))
    assert share < (1e-5 if place is EXACT else 1e-3), what
    if kind.explicit:  # whose steps are those of a simulator
        simulator = ds.Simulator(solver_of(kind, moved(here, place)))
        simulator.run(2)
        np.testing.assert_allclose(simulator.displacements, far["displacements"][-1], atol=1e-6)


def test_near_the_origin_nothing_is_taken_from_places():
    made = scene(ds.Ground(-0.5, stiffness=1.0, width=0.01), mesh=MESH.translated((5.0, 0.0, -5.0)))
    assert not made.origin.any() and made.inputs.derive(made.inputs.values).parameters[0] == -0.5
    assert not moved(made.replace(precision="f64"), FAR).origin.any()


def test_positions_keep_their_digits():
    """As arrays and tensors, of a simulator and of the torch simulator."""
    far = moved(scene(), FAR)
    rollout = ds.Rollout(ds.SemiImplicitSolver(far, dt=1e-3), 2)
    frames = rollout.forward()
    exact = far.mesh.vertices + frames.displacements.astype(np.float64)
    np.testing.assert_array_equal(frames.positions, exact)
    u = torch.zeros(exact[0].shape, requires_grad=True)
    tensors = rollout_frames(rollout, initial_displacements=u)
    np.testing.assert_array_equal(tensors.positions.detach().numpy(), exact)
    tensors.positions[-1].sum().backward()
    assert u.grad.dtype == torch.float32 and u.grad.sum() == pytest.approx(u.numel(), rel=1e-4)
    simulator = ds.Simulator(ds.SemiImplicitSolver(far, dt=1e-3))
    simulator.set_state(exact[-1] + 0.25)
    np.testing.assert_allclose(simulator.positions, exact[-1] + 0.25, rtol=0, atol=1e-7)
    theirs = DifferentiableSimulator(
        far.mesh, DifferentiableMaterial(torch.tensor(2e4), 0.3), DifferentiableSolver(dt=1e-3), contact=False
    )
    theirs.reset(torch.from_numpy(exact[0] + 0.25))
    np.testing.assert_allclose(theirs.positions.numpy(), exact[0] + 0.25, rtol=0, atol=1e-7)


@pytest.mark.parametrize("up, gravity", [("x", -9.8), ("y", -9.8), ("z", -9.8), ("y", 0.0)])
def test_a_file_for_blender_keeps_its_digits_and_has_y_up(up, gravity, tmp_path):
    far = moved(scene(), FAR).replace(terms=[ds.Gravity(gravity, up=up)])
    with open_writer(tmp_path / "run.glb", far) as writer:
        writer.write(Frame.of(ds.Simulator(ds.SemiImplicitSolver(far, dt=1e-3))))
    whole = (tmp_path / "run.glb").read_bytes()
    size = struct.unpack("<I", whole[12:16])[0]
    parts, numbers = json.loads(whole[20 : 20 + size]), whole[28 + size :]
    x, node = far.mesh.vertices[MESH.surface_vertices], parts["nodes"][0]
    turn = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1]))
    places = turn.apply(np.frombuffer(numbers, "<f4", x.size).reshape(-1, 3)) + node["translation"]
    np.testing.assert_allclose(places, turn.apply(x), atol=1e-6)
    np.testing.assert_allclose(places[:, 1], x[:, "xyz".index(up)], atol=1e-6)


def test_the_nearest_point_of_a_plane():
    rng = np.random.default_rng(0)
    p, n, dp, dn, w, near = rng.standard_normal((6, 3))
    link = NearestPoint("p", "n", "q", near)
    (q,), (dq,), by = link.value(p, n), link.jvp((p, n), (dp, dn)), link.vjp((p, n), (w,))
    assert np.dot(n, q - p) == pytest.approx(0, abs=1e-14) and np.linalg.norm(np.cross(n, q - near)) < 1e-14
    assert w @ dq == pytest.approx(by[0] @ dp + by[1] @ dn, rel=1e-12)
    ends = [link.value(p + h * dp, n + h * dn)[0] for h in (-1e-5, 1e-5)]
    np.testing.assert_allclose(dq, (ends[1] - ends[0]) / 2e-5, rtol=1e-8)


STILL = [0, 1], np.zeros((2, 6))
THERE, BELOW = MESH.translated(FAR), FAR - [0, 3.0, 0]
F32 = dict(precision="f32"), dict(precision="f64")
SINGLE, SINGLE_TENSOR = (np.float32, np.float64), (torch.float32, torch.float64)
# what makes it, and from what: what float32 does not resolve, and the remedy
CASES = {
    "a start far from the mesh": (lambda o: scene(initial_positions=THERE.vertices, **o), *F32),
    "the earth": (lambda o: scene(ds.Sphere([0, -6.4e6 - 0.1, 0], 6.4e6, stiffness=1.0, width=0.01), **o), *F32),
    "a rail": (
        lambda o: scene(
            ds.Cylinder(BELOW - [1e6, 0, 0], BELOW + [1e6, 0, 0], 1.0, stiffness=1.0, width=0.01), mesh=THERE, **o
        ),
        *F32,
    ),
    "a turn": (lambda c: scene(ds.Box(BELOW, path=STILL, about=c, stiffness=1.0, width=0.01), mesh=THERE), None, BELOW),
    "a shape of one's own": (
        lambda o: scene(Ring(BELOW, 0.1, 0.05, stiffness=1.0, by_pairs=False), mesh=THERE, **o),
        *F32,
    ),
    "a start": (lambda kind: scene(mesh=THERE, initial_positions=THERE.vertices.astype(kind)), *SINGLE),
    "a sphere": (
        lambda kind: scene(ds.Sphere(BELOW.astype(kind), 1.0, stiffness=1.0, width=0.01), mesh=THERE),
        *SINGLE,
    ),
    "an anchor": (
        lambda kind: scene(ds.Spring(0, ds.Anchor(torch.tensor(BELOW, dtype=kind)), 1.0), mesh=THERE),
        *SINGLE_TENSOR,
    ),
    "a mesh": (lambda kind: ds.TetrahedralMesh((MESH.vertices + [0, 2e4, 0]).astype(kind), MESH.tetrahedra), *SINGLE),
}


def test_an_obstacle_made_far_away_is_measured_from_there():
    """A mesh in coordinates of a map, where it is or where its path has taken it."""
    keys = [0, 1], np.stack([FAR, FAR])
    for away, path in ((FAR, None), (0, keys)):
        made = ds.MeshObstacle(MESH.vertices[:4] - [0, 3, 0] + away, MESH.surface_triangles[:4], path=path, **OWN)
        there = scene(made, mesh=THERE)
        derived = there.inputs.derive(there.inputs.at_times([0.0, 1.0]))
        position = derived.parameters[:3] + (0 if path is None else derived.path[0, 0])
        corners = there.obstacles[0]._tree.x
        at = position + corners + there.origin - FAR
        np.testing.assert_allclose(at, MESH.vertices[:4] - [0, 3, 0], atol=1e-8)
        assert np.abs(derived.parameters[:3]).max() < 10 and np.abs(corners).max() < 10


def test_a_shape_of_ones_own_says_what_is_a_place():
    ring = Ring(BELOW, 0.1, 0.05, stiffness=1.0, by_pairs=False).with_input("ring_center", axes="xyz")
    made = scene(ring, mesh=THERE)
    own = made.inputs.derive(made.inputs.values).parameters[made.inputs.parameters.of(made.term(Ring))]
    np.testing.assert_allclose(own[:5], [*(BELOW - made.origin), 0.1, 0.05], rtol=1e-12)


@pytest.mark.parametrize("name", CASES)
def test_what_float32_cannot_resolve_is_said(name):
    """And what the message names helps."""
    make, wrong, remedy = CASES[name]
    refused = pytest.raises(ValueError, match="none of its inputs says that it is a place")
    with refused if "own" in name else pytest.warns(UserWarning, match="float32 resolves"):
        make(wrong)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make(remedy)


def test_runs_say_it_too():
    """Values of a run, states that are set, tensors, fields, a body that flies away."""
    rollout, single = (
        ds.Rollout(ds.SemiImplicitSolver(scene(mesh=THERE), dt=1e-3), 1),
        THERE.vertices.astype(np.float32),
    )
    batch, simulator = ds.Batch(rollout.solver, 1, scenes=2), ds.Simulator(rollout.solver)
    flies = ds.Rollout(ds.SemiImplicitSolver(scene(initial_velocities=[0, 1e7, 0]), dt=1e-3), 1)
    for run in (
        lambda: rollout.forward(initial_positions=single),
        lambda: batch.forward(initial_positions=single),
        lambda: rollout_frames(rollout, initial_positions=torch.from_numpy(single)),
        lambda: simulator.set_state(single),
        lambda: rollout.field("positions"),
        lambda: rollout.field("initial_positions"),
        lambda: flies.forward(),
    ):
        with pytest.warns(UserWarning, match="float32 resolves"):
            run()
