"""One drawing, two back ends: the same camera, colours and contents by Vulkan and without it."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import contact_scenes
import numpy as np
import pytest

import diffsim_ti as ds
from diffsim_ti import obstacles
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.visual import painters
from diffsim_ti.visual.camera import Camera
from diffsim_ti.visual.colouring import Colouring
from diffsim_ti.visual.drawing import Drawing
from diffsim_ti.visual.painters import has_vulkan
from diffsim_ti.visual.surface import Soup

ROOT = Path(__file__).parents[1]
SIZE = (200, 150)
BACKENDS = ["software", pytest.param("vulkan", marks=pytest.mark.skipif(not has_vulkan(), reason="no Vulkan driver"))]
BOX = [[-0.3, 0.0, -0.3], [0.5, 0.6, 0.5]]
LOOK = dict(size=SIZE, box=BOX, ground=0.0, azimuth=20.0, elevation=10.0)


@pytest.fixture(scope="module")
def cube():
    return TetrahedralMesh.create_cube(4, 0.2)


def blue(image):
    """Pixels of a body without values."""
    image = image.astype(float)
    return image[..., 2] - image[..., 0] > 25


def centre(seen):
    row, column = np.nonzero(seen)
    return np.array([column.mean(), row.mean()])


@pytest.mark.parametrize("backend", BACKENDS)
def test_body_covers_what_the_camera_projects(cube, backend):
    from scipy.spatial import ConvexHull

    with Drawing(cube, backend=backend, **LOOK) as drawing:
        at = drawing.camera.project(cube.vertices + [0, 0.2, 0], SIZE)[:, :2]
        seen = blue(drawing.image(cube.vertices + [0, 0.2, 0]))
    hull = ConvexHull(at)
    assert seen.sum() == pytest.approx(hull.volume, rel=0.05)  # in two dimensions `volume` is the area
    assert centre(seen) == pytest.approx(at[hull.vertices].mean(0), abs=2)
    moved = [0.1, 0.15, 0.0]
    with Drawing(cube, backend=backend, **LOOK) as drawing:
        step = drawing.camera.project(cube.vertices + [0, 0.2, 0] + moved, SIZE)[:, :2] - at
        after = blue(drawing.image(cube.vertices + [0, 0.2, 0] + moved))
    assert centre(after) - centre(seen) == pytest.approx(step.mean(0), abs=1.5)


@pytest.mark.parametrize("backend", BACKENDS)
def test_colours_are_where_they_should_be(cube, backend):
    """Values that rise with height: the map's two ends below and above; a mark where a vertex is fixed."""
    colouring = Colouring("height [m]", (0.0, 0.2))
    corner = int(np.argmax(cube.vertices @ [-0.2, 1.0, 1.0]))
    with Drawing(cube, backend=backend, colouring=colouring, fixed=[corner], **LOOK) as drawing:
        image = drawing.image(cube.vertices + [0, 0.1, 0], cube.vertices[:, 1]).astype(float)
        bare = drawing.image(cube.vertices + [0, 0.1, 0]).astype(float)
        at = drawing.camera.project(cube.vertices + [0, 0.1, 0], SIZE)[:, :2]
    front = cube.vertices[:, 2] > 0.19
    inside = lambda y: at[front & (abs(cube.vertices[:, 1] - y) < 1e-6)].mean(0).round().astype(int)  # noqa: E731
    (x0, low), (x1, high) = inside(0.0), inside(0.2)
    top, bottom = image[high + 2, x1], image[low - 3, x0]
    assert top[1] > top[2] + 60 and bottom[2] > bottom[1] + 20  # yellow above, violet below
    column, row = at[corner].astype(int)
    mark = bare[row - 1 : row + 2, column - 1 : column + 2].reshape(-1, 3)
    assert (mark[:, 0] - mark[:, 2]).max() > 80  # orange


@pytest.mark.skipif(not has_vulkan(), reason="no Vulkan driver")
@pytest.mark.parametrize("wireframe", [False, True])
def test_back_ends_agree(cube, wireframe):
    twisted = cube.vertices + [0, 0.1, 0] + 0.02 * np.sin(20 * cube.vertices[:, [1, 2, 0]])
    around = [obstacles.ball([0.3, 0.1, 0.1], 0.1), obstacles.box([-0.2, 0.1, 0.0], [0.1, 0.2, 0.1], [1.0, 0.2, 0, 0])]
    images = []
    for backend in ("software", "vulkan"):
        with Drawing(cube, backend=backend, obstacles=around, wireframe=wireframe, **LOOK) as drawing:
            images.append(drawing.image(twisted, cube.vertices[:, 0]).astype(float))
    difference = np.abs(images[0] - images[1]).max(-1)
    assert difference.mean() < 2.5 and (difference > 40).mean() < 0.005  # of 255; along edges and the floor's lines
    assert images[0].std() > 10


@pytest.mark.parametrize("backend", BACKENDS)
def test_shadow_and_obstacles(cube, backend):
    """A floor darkens below the body; an obstacle in front hides it."""
    with Drawing(cube, backend=backend, **LOOK) as alone, Drawing(cube, backend="software", **LOOK) as other:
        up, away = alone.image(cube.vertices + [0, 0.1, 0]).astype(float), other.image(cube.vertices + [0, 50.0, 0])
        darker = (away.astype(float) - up).min(-1)
        assert (darker > 30)[~blue(up)].sum() > 100
        eye = alone.camera.position
    middle = np.array([0.1, 0.2, 0.1])
    hidden = obstacles.ball(middle + 0.35 * (eye - middle) / np.linalg.norm(eye - middle), 0.2)
    with Drawing(cube, backend=backend, obstacles=[hidden], **LOOK) as drawing:
        behind = drawing.image(cube.vertices + [0, 0.1, 0])
    assert blue(behind).sum() < 0.3 * blue(up).sum()


def test_wireframe_darkens_edges_only(cube):
    pictures = []
    for wireframe in (False, True):
        with Drawing(cube, backend="software", wireframe=wireframe, **LOOK | dict(size=(400, 300))) as drawing:
            pictures.append(drawing.image(cube.vertices + [0, 0.1, 0]).astype(float))
    darker = (pictures[0] - pictures[1]).mean(-1)
    body = blue(pictures[0])
    assert 0.05 < (darker > 15)[body].mean() < 0.6 and np.abs(darker[~body]).max() < 60


def test_camera_turns_zooms_and_projects():
    camera = Camera.framing(np.array(BOX), SIZE, 0.0, 0.0)
    middle = camera.project(camera.look_at, SIZE)
    assert middle == pytest.approx([100, 75, np.linalg.norm(camera.position - camera.look_at)])
    ray = camera.rays(np.array([30.0]), np.array([40.0]), SIZE)[0]
    assert camera.project(camera.position + 3 * ray, SIZE)[:2] == pytest.approx([30, 40])
    assert camera.orbited(90, 0).position - camera.look_at == pytest.approx([middle[2], 0, 0], abs=1e-9)
    assert np.linalg.norm(camera.zoomed(2).position - camera.look_at) == pytest.approx(middle[2] / 2)
    right = 0.1 * camera.axes[0]
    shifted = replace(camera, position=camera.position + right, look_at=camera.look_at + right)
    assert shifted.project(camera.look_at, SIZE)[0] == pytest.approx(100 - 0.1 * camera.focal(SIZE) / middle[2])
    with pytest.raises(ValueError, match="elevation"):
        Camera.framing(np.array(BOX), SIZE, 0.0, 90.0)


@pytest.mark.parametrize(
    "shape, volume",
    [
        (obstacles.ball([1, 2, 3], 0.5), 4 / 3 * np.pi * 0.125),
        (obstacles.box([1, 0, 0], [0.2, 0.4, 0.6], [1.0, 0.3, 0.2, 0.1]), 0.048),
        (obstacles.tube(np.zeros(3), np.array([1.0, 1.0, 0]), 0.2, False), np.pi * 0.04 * 2**0.5),
        (obstacles.tube(np.zeros(3), np.array([0, 0, 1.0]), 0.2, True), np.pi * 0.04 + 4 / 3 * np.pi * 0.008),
    ],
)
def test_obstacles_are_closed_and_face_outwards(shape, volume):
    points, triangles = shape
    a, b, c = (points[triangles[:, k]] for k in range(3))
    enclosed = np.einsum("ij,ij->", a - points.mean(0), np.cross(b - points.mean(0), c - points.mean(0))) / 6
    assert enclosed == pytest.approx(volume, rel=0.02)  # 32 sides


def test_a_hollow_ball_is_a_bowl_seen_from_within():
    points, triangles = obstacles.bowl(np.array([1.0, 2, 3]), 0.5)
    normals = np.cross(
        points[triangles[:, 1]] - points[triangles[:, 0]], points[triangles[:, 2]] - points[triangles[:, 0]]
    )
    inwards = np.einsum("nd,nd->n", normals, [1.0, 2, 3] - points[triangles].mean(1))
    assert (inwards >= -1e-12).all() and points[:, 1].max() == pytest.approx(2.0)
    assert np.linalg.norm(normals, axis=1).sum() / 2 == pytest.approx(2 * np.pi * 0.25, rel=0.02)


@pytest.mark.parametrize("size", [(40, 30), (7, 5)])
def test_spans_cover_the_pixels_inside(size):
    """Against the half-plane test of every pixel centre, also for triangles that stick out of the picture."""
    corners = np.random.default_rng(0).uniform(-10, 45, (30, 3, 2))
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    inside = np.zeros((30, size[1], size[0]), bool)
    for k, (a, b, c) in enumerate(corners):
        sides = [(q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0]) for p, q in ((a, b), (b, c), (c, a))]
        inside[k] = np.all(np.array(sides) > 0, 0) | np.all(np.array(sides) < 0, 0)
    found = np.zeros_like(inside)
    for k, row, first, end in zip(*painters.spans(corners, size)):
        found[k, row, first:end] = True
    assert inside.any() and np.array_equal(found, inside)
    assert np.array_equal(painters.covered(corners, size), inside.any(0))


def test_the_nearer_triangle_is_seen_and_colours_are_linear_in_space():
    """A blue triangle that pierces a red one: in perspective they meet where their depths are equal."""
    corners = np.array([[[0, 0, 1.0], [40, 0, 1.0], [0, 40, 2.0]], [[0, 0, 2.0], [40, 0, 2.0], [0, 40, 1.0]]])
    colours = np.zeros((2, 3, 3))
    colours[0, :, 0], colours[1, :, 2] = 1, [0.5, 0.5, 1.0]
    soup = Soup(corners, colours, corners[..., 2].mean(1))
    image = painters.SoftwarePainter((40, 40)).paint(soup, np.ones((40, 40, 3), np.float32))
    assert (
        image[18, 5] == pytest.approx([1, 0, 0]) and image[22, 5, 0] == 0 and image[35, 35] == pytest.approx([1, 1, 1])
    )
    y = 30.5  # 1 / depth is linear in the picture: 1/2 + y / 80; so is colour / depth
    assert image[30, 2, 2] == pytest.approx((0.25 + y / 40 * 0.75) / (0.5 + y / 80), abs=0.02)


def test_obstacles_of_a_scene_by_type(cube):
    floor, ball = ds.Ground(-0.25, stiffness=1e4, width=0.01), ds.Sphere((0, 0, 0), 0.5)
    scene = SimpleNamespace(terms=[ds.Gravity(), floor, ball], mesh=cube)
    assert obstacles.floor_of(scene) == -0.25
    ((points, _),) = obstacles.obstacle_surfaces(scene)
    assert np.linalg.norm(points, axis=1) == pytest.approx(0.5)


@pytest.mark.parametrize("name", contact_scenes.SHAPES)
def test_what_is_drawn_of_an_obstacle_is_where_its_distance_is_zero(name):
    """Corners of what is round lie on it; what faces the eye faces outwards."""
    term = contact_scenes.SHAPES[name]()
    surface, floor = term.surface(0.2), term.floor_height()
    assert (surface is None) == (floor is not None)
    if surface is None:
        assert term.distance(np.array([[0.3, floor, 0.7]])) == pytest.approx(0)
        return
    points, triangles = surface
    assert np.abs(term.distance(points)).max() < 1e-9
    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normals, axis=1)
    large = size > 1e-3 * size.max()  # at the poles of what is round triangles have no area
    outside = corners.mean(1)[large] + 1e-2 * normals[large] / size[large, None]
    assert term.distance(outside).min() > 0


@pytest.mark.parametrize(
    "arguments, text",
    [
        (dict(size=(3, 3)), "size"),
        (dict(backend="opengl"), "backend must be one of"),
        (dict(elevation=91.0), "elevation"),
    ],
)
def test_bad_arguments_are_refused(cube, arguments, text):
    with pytest.raises(ValueError, match=text):
        Drawing(cube, **arguments)


@pytest.mark.parametrize(
    "values, limits, text", [([0.0, np.nan], None, "finite"), ([0.0, 1.0], (1.0, 1.0), "lower first")]
)
def test_bad_colours_are_refused(values, limits, text):
    with pytest.raises(ValueError, match=text):
        Colouring.of(values, limits=limits)
    with pytest.raises(ValueError, match="colour map"):
        Colouring(map="rainbows")


CODE = """
import resource, numpy as np, sys
from diffsim_ti.visual.drawing import Drawing
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.visual.surface import Soup
cube = TetrahedralMesh.create_cube(3, 0.2)
pages = lambda: int(open("/proc/self/statm").read().split()[1]) * resource.getpagesize() / 2**20
with Drawing(cube, (160, 120), ground=0.0, backend=sys.argv[1]) as drawing:
    print(drawing.describe())
    for k in range(90):
        if k == 20:
            start = pages()
        drawing.image(cube.vertices + [0, 1e-3 * k, 0], cube.vertices[:, 0], f"frame {k}")
print(pages() - start)
"""


def in_process(code, *arguments, **environment):
    env = os.environ | {"PYTHONPATH": str(ROOT)} | environment
    done = subprocess.run([sys.executable, "-c", code, *arguments], env=env, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is read from /proc")
@pytest.mark.parametrize("backend", BACKENDS)
def test_many_frames_without_growth(backend):
    grown = float(in_process(CODE, backend)[-1])
    assert grown < 8, f"{grown:.1f} MB"  # a mesh of taichi.ui's scene would keep 19


def test_without_a_vulkan_driver_the_choice_is_software():
    """An empty list of drivers is what a machine without Vulkan has."""
    code = CODE.replace("90", "21").replace("sys.argv[1]", "'auto'")
    lines = in_process(
        code, VK_ICD_FILENAMES="/nonexistent.json", VK_DRIVER_FILES="/nonexistent.json", TI_ENABLE_VULKAN="0"
    )
    assert "drawn by NumPy (no Vulkan driver here)" in lines[0]
