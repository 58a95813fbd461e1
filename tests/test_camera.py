"""What cameras see: projections as calibrations define them, depth, segments, points in space, tracks with gradients."""

import numpy as np
import pytest
from example_files import example

import diffsim_ti as ds
from diffsim_ti import verify
from diffsim_ti.common import rotations
from diffsim_ti.picture import Camera, DepthImage
from diffsim_ti.writers import Frame, Setting

SIZE = (96, 72)
MATRIX = np.array([[110.0, 0, 50.0], [0, 120.0, 33.0], [0, 0, 1]])
CUBE = ds.TetrahedralMesh.create_box(3, size=0.2, origin=(-0.1, 0.05, -0.1))


def pose(rotation=(2.9, 0.2, -0.1), distance=0.7):
    """Rotation and translation of a camera that looks at the cube."""
    q = rotations.quaternion(np.array(rotation))
    R = rotations.turned(q[None], np.eye(3)).T
    return R, np.array([0, 0, distance]) - R @ np.array([0, 0.15, 0])


def calibrated(**options):
    return Camera.calibrated(MATRIX, SIZE, *pose(**options))


def test_a_calibrated_camera_projects_by_its_matrix():
    camera, (R, t) = calibrated(), pose()
    x = CUBE.vertices
    by_matrix = (R @ x.T).T + t
    seen = (MATRIX @ (by_matrix / by_matrix[:, 2:]).T).T[:, :2]
    np.testing.assert_allclose(camera.project(x, SIZE)[:, :2], seen, rtol=1e-12)
    np.testing.assert_allclose(camera.project(x, SIZE)[:, 2], by_matrix[:, 2], rtol=1e-12)
    twice = camera.project(x, (2 * SIZE[0], 2 * SIZE[1]))[:, :2]
    np.testing.assert_allclose(twice, 2 * seen, rtol=1e-12)  # a finer picture of the same camera
    rays = camera.rays(*seen.T, SIZE)
    away = x - camera.position
    np.testing.assert_allclose(rays, away / np.linalg.norm(away, axis=1, keepdims=True), atol=1e-12)


@pytest.mark.parametrize(
    "wrong, said",
    [
        (dict(matrix=np.eye(4)), "must have shape"),
        (dict(matrix=MATRIX + [[0, 1, 0], [0, 0, 0], [0, 0, 0]]), r"must be \[\[fx, 0, cx\]"),
        (dict(rotation=2 * np.eye(3)), "must be a rotation matrix"),
        (dict(rotation=np.diag([1.0, 1, -1])), "must be a rotation matrix"),
    ],
)
def test_what_is_no_calibration_is_refused(wrong, said):
    given = dict(matrix=MATRIX, size=SIZE, rotation=np.eye(3), translation=np.zeros(3))
    with pytest.raises(ValueError, match=said):
        Camera.calibrated(**given | wrong)


def seen_by_rays(camera, shapes, pixels):
    """(depth, shape) of the nearest triangle along each ray, one by one: Moeller and Trumbore 1997."""
    out = []
    for column, row in pixels:
        d, best = camera.rays(np.array([column + 0.5]), np.array([row + 0.5]), SIZE)[0], (np.inf, -1)
        for k, (points, triangles) in enumerate(shapes):
            a, b, c = (points[triangles[:, j]] for j in range(3))
            p = np.cross(d, c - a)
            det = ((b - a) * p).sum(1)
            s = camera.position - a
            u, q = (s * p).sum(1) / det, np.cross(s, b - a)
            v, r = (q @ d) / det, ((c - a) * q).sum(1) / det
            hit = r[(u >= 0) & (v >= 0) & (u + v <= 1) & (r > 0)]
            if len(hit) and hit.min() < best[0]:
                best = hit.min(), k
        out.append((best[0] * -(d @ camera.axes[2]), best[1]))
    return np.array(out).T


def test_depth_is_that_of_rays():
    """Of a body beside a ball and above a floor, at random pixels, and points that lie on what is seen."""
    terms = [ds.Ground(0.0, stiffness=1.0, width=0.01), ds.Sphere((0.06, 0.12, 0.2), 0.06, stiffness=1.0, width=0.01)]
    scene = ds.Scene(CUBE, ds.StableNeoHookean(1e4, 0.3), terms=terms, precision="f64")
    setting, frame = Setting.of(scene), Frame.of(ds.Simulator(ds.SemiImplicitSolver(scene, dt=1e-3)))
    camera = calibrated(rotation=(3.5, 0.3, 0.1))
    image = DepthImage.of(camera, setting, frame, SIZE)
    assert image.names == ["body", "obstacle 1", "floor"] and set(np.unique(image.segments)) >= {0, 1, 2}
    pixels = np.random.default_rng(0).integers((0, 0), SIZE, (150, 2))
    shapes = [(CUBE.vertices, CUBE.surface_triangles), *setting.obstacles]
    depth, of = seen_by_rays(camera, shapes, pixels)
    segments, found = image.segments[pixels[:, 1], pixels[:, 0]], image.depth[pixels[:, 1], pixels[:, 0]]
    assert ((segments == of) | (of == -1)).mean() > 0.99  # but where a ray meets an edge
    same = (segments == of) & (of >= 0)
    np.testing.assert_allclose(found[same], depth[same], rtol=1e-9)
    on_floor = image.segments[np.isfinite(image.depth)] == 2
    np.testing.assert_allclose(image.points[on_floor][:, 1], 0, atol=1e-12)
    seen = camera.project(image.points, SIZE)
    np.testing.assert_allclose(seen[:, 2], image.depth[np.isfinite(image.depth)], rtol=1e-9)


def test_segments_tell_bodies_apart():
    mesh = ds.TetrahedralMesh.joined({"left": CUBE, "right": CUBE.translated((0.25, 0, 0))})
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e4, 0.3), precision="f64")
    frame = Frame.of(ds.Simulator(ds.SemiImplicitSolver(scene, dt=1e-3)))
    camera = Camera.framing(mesh.vertices, SIZE)
    image = DepthImage.of(camera, Setting.of(scene), frame, SIZE, bodies=("left", "right"))
    of_pixel = image.segments[np.isfinite(image.depth)]
    np.testing.assert_array_equal(of_pixel, (image.points[:, 0] > 0.125).astype(int))


def markers(mesh):
    """All points of the surface, half of which a camera does not see."""
    return mesh.vertices[mesh.surface_vertices]


@pytest.fixture(scope="module")
def cameras():
    return example("identify/two_cameras")


@pytest.fixture(scope="module")
def filmed(cameras):
    return cameras.filmed()


def test_tracks_have_gradients(filmed):
    frames = filmed.forward()
    assert verify.dot_product_test(filmed, seed=1) < 1e-9
    named = ["youngs_modulus", "floor.friction", "rest_positions", "initial_velocities"]
    report = verify.check_gradients(filmed, inputs=named, verbose=False)
    assert report.passed, str(report)
    assert np.ptp(frames["camera_0"], axis=0).max() > 30  # pixels


def test_hidden_points_are_known(filmed):
    """A marker behind the body is hidden from one side, and one outside the picture is not in it."""
    frames = filmed.forward()
    x = markers(filmed.scene.mesh)
    normal_z = x[:, 2] > x[:, 2].max() - 1e-9
    box = np.array([[-0.15, 0, -0.15], [0.3, 0.25, 0.2]])
    behind = ds.PixelTracks(Camera.framing(box, SIZE, 180.0, 5.0), x, SIZE).settled(filmed.scene)
    front = ds.PixelTracks(Camera.framing(box, SIZE, 0.0, 5.0), x, SIZE).settled(filmed.scene)
    on_face = normal_z & (x[:, 1] < x[:, 1].max() - 1e-9)
    assert front.visible(frames)[0][on_face].all() and not behind.visible(frames)[0][on_face].any()
    near = Camera(np.array([0.03, 0.07, 0.4]), np.array([0.03, 0.07, 0.0]), field_of_view=2.0)
    assert not ds.PixelTracks(near, x, SIZE).settled(filmed.scene).visible(frames)[0].any()
    with pytest.raises(ValueError, match="it has no scene yet"):
        ds.PixelTracks(near, x, SIZE).visible(frames)
    inside = Camera(np.array([0, 0.1, 0.0]), np.array([0, 0.1, 1.0]))
    with pytest.raises(FloatingPointError, match="behind the camera; move it back"):
        ds.PixelTracks(inside, x, SIZE).settled(filmed.scene).value(frames)


def test_two_cameras_tell_stiffness_and_friction(cameras, filmed):
    """With noise of half a pixel, and no sample where the body hides a point: truth within the 95 % interval."""
    frames = filmed.forward()
    assert all(0.3 < track.visible(frames).mean() < 0.8 for track in frames.computed.values())
    found = cameras.identified(filmed, frames, seed=2)
    for name, truth in cameras.TRUTH.items():
        low, high = found.intervals[name]
        assert low < truth < high and high - low < 0.01 * truth, str(found)


def test_the_mesh_is_checked_beside_a_floor(filmed):
    """What identify tells of ten nodes, in a scene with an obstacle."""
    camera = ds.PixelTracks(filmed.outputs["camera_0"].camera, markers(filmed.scene.mesh)[:3], name="film")
    rollout = ds.Rollout(ds.ImplicitEulerSolver(filmed.scene, dt=0.01), 2, outputs=[camera])
    data = {"film": rollout.forward(youngs_modulus=1.9e4)["film"]}
    found = ds.identify(rollout, data, {"youngs_modulus": 2e4}, noise=0.5, check_mesh=True)
    assert found.mesh is not None and not found.mesh.reason
