"""Films of a saved series, by what is seen in their frames."""

from types import SimpleNamespace

import imageio.v2 as imageio
import numpy as np
import pytest
from matplotlib import colormaps
from saved_series import Series

import diffsim_ti as ds
from diffsim_ti import cli, film
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.visual import colouring as series_fields

SIZE = (160, 120)
LEFT = slice(0, 110)  # columns without the legend


@pytest.fixture(scope="module")
def cube():
    return TetrahedralMesh.create_cube(3, 0.2)


@pytest.fixture(scope="module")
def series(cube, tmp_path_factory):
    """A cube that rises by 0.2 m a frame while its stress goes from 0 to 2 kPa."""
    out = Series(tmp_path_factory.mktemp("series"), cube, "cube")
    ones = np.ones(cube.num_tetrahedra)
    for k in range(3):
        offset = np.zeros(cube.vertices.shape) + [0, 0.2 * k, 0]
        fields = SimpleNamespace(von_mises=1e3 * k * ones, energy_density=k * ones, J=(1 + 0.1 * k) * ones)
        out.write(0.1 * k, cube.vertices + offset, offset, offset, fields)
    return out.path


def body(image):
    """Pixels of the body: saturated, left of the legend."""
    image = np.asarray(image, float)[:, LEFT, :3]
    return np.ptp(image, axis=2) > 40


@pytest.mark.parametrize("kind", ["gif", "mp4"])
def test_body_rises_and_changes_colour(series, tmp_path, kind):
    assert film.render_series(series, tmp_path / f"a.{kind}", size=SIZE, azimuth=0.0, elevation=0.0) == 3
    images = [np.asarray(i)[..., :3] for i in imageio.mimread(tmp_path / f"a.{kind}")]
    assert len(images) == 3 and all(i.shape == (120, 160, 3) for i in images)
    rows = [np.nonzero(body(i))[0].mean() for i in images]
    assert rows[0] > rows[1] + 15 > rows[2] + 30
    first, last = (i[:, LEFT][body(i)].mean(0) for i in (images[0], images[2]))
    assert first[2] > first[1] and last[1] > 2 * last[2]  # viridis: violet at nothing, yellow at the most


def test_states_in_memory_become_a_film(cube, tmp_path):
    """The body sinks, the ball beside it rises; all frames share one scale of colours."""
    from diffsim_ti.obstacles import ball

    at = [cube.vertices - [0, 0.1 * k, 0] for k in range(3)]
    balls = [[ball((0.4, 0.2 * k - 0.1, 0.1), 0.08)] for k in range(3)]
    count = film.save_film(
        tmp_path / "a.gif",
        cube,
        at,
        [np.full(cube.num_vertices, 5.0 * k) for k in range(3)],
        size=SIZE,
        obstacles=balls,
        azimuth=0.0,
        elevation=0.0,
        box=[[-0.1, -0.3, 0], [0.5, 0.4, 0.2]],
    )
    images = [np.asarray(i)[..., :3].astype(float) for i in imageio.mimread(tmp_path / "a.gif")]
    assert count == len(images) == 3
    rows = [np.nonzero(body(i))[0].mean() for i in images]
    assert rows[0] < rows[1] - 5 < rows[2] - 10
    grey = [(np.ptp(i, axis=2) < 20) & (i.mean(2) < 200) & (np.arange(160) > 85) for i in images]
    rows = [np.nonzero(g)[0].mean() for g in grey]
    assert rows[0] > rows[1] + 10 > rows[2] + 20
    first, last = (i[:, LEFT][body(i)].mean(0) for i in (images[0], images[2]))
    assert first[2] > first[1] and last[1] > 2 * last[2]
    with pytest.raises(ValueError, match="for each of the 3 frames"):
        film.save_film(tmp_path / "b.gif", cube, at, obstacles=balls[:2])


def test_a_series_shows_its_floor_obstacles_and_fixed_vertices(cube, tmp_path):
    """The scene's ball hides the cube more from frame to frame; orange marks where it is held."""
    ball = ds.Sphere((0.1, 0.4, 0.32), 0.08, stiffness=1.0, width=0.01, path=lambda t: [0, -3 * t, 0])
    terms = [ds.Ground(-0.05, stiffness=1.0, width=0.01), ball]
    scene = ds.Scene(cube, ds.StableNeoHookean(1e5, 0.3), terms=terms, fixed="ymin")
    out, still, ones = Series(tmp_path, cube, "a", scene), np.zeros(cube.vertices.shape), np.ones(cube.num_tetrahedra)
    for k in range(2):
        fields = SimpleNamespace(von_mises=ones, energy_density=ones, J=ones)
        out.write(0.1 * k, cube.vertices, still, still, fields)
    look = dict(size=SIZE, azimuth=0.0, elevation=0.0, backend="software")
    film.render_series(out.path, tmp_path / "a.gif", **look)
    first, last = (np.asarray(i)[..., :3].astype(float) for i in imageio.mimread(tmp_path / "a.gif"))
    assert body(last).sum() < 0.8 * body(first).sum()
    assert ((first[..., 0] - first[..., 2] > 100)[:, LEFT]).sum() > 5  # marks
    assert [p.name for p in sorted(tmp_path.glob("*.vtu"))] == [
        "a_0000.vtu",
        "a_0001.vtu",
        "a_obstacles_0000.vtu",
        "a_obstacles_0001.vtu",
    ]
    Series(tmp_path, cube, "a")  # an older series goes with its obstacles
    assert not list(tmp_path.glob("*.vtu"))


def test_picture_of_the_end_has_a_legend(series, tmp_path):
    film.render_series(series, tmp_path / "a.png", size=SIZE, azimuth=0.0, elevation=0.0)
    image = imageio.imread(tmp_path / "a.png")
    bar = image[32:88, 149].astype(float)
    expected = 255 * colormaps["viridis"]([1.0, 0.0])[:, :3]
    assert np.abs(bar[[0, -1]] - expected).max() < 30  # sampled some 4 % inside the bar's ends
    assert np.nonzero(body(image))[0].mean() < 50


@pytest.mark.parametrize("low, high, expected", [(0.9, 1.3, (0.7, 1.3)), (1.0, 1.0, (0.0, 2.0))])
def test_two_sided_limits_are_symmetric(low, high, expected):
    assert series_fields.FIELDS["J"].limits(low, high) == pytest.approx(expected)


@pytest.mark.parametrize(
    "change, text",
    [
        (dict(colour="mass"), "must be one of"),
        (dict(fps=0.0), "fps"),
        (dict(size=(161, 120)), "even"),
        (dict(output="a.avi"), "must end in"),
    ],
)
def test_bad_arguments_are_refused(series, tmp_path, change, text):
    output = tmp_path / change.pop("output", "a.mp4")
    with pytest.raises(ValueError, match=text):
        film.render_series(series, output, **change)
    assert not output.exists()


def test_command(series, tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["render", str(series), "-o", str(tmp_path / "a.gif"), "--colour", "J", "--size", "160", "120"])
    assert stop.value.code == 0 and "3 frames: " in capsys.readouterr().out
    assert len(imageio.mimread(tmp_path / "a.gif")) == 3
