"""Films of a saved series, by what is seen in their frames."""

from types import SimpleNamespace

import imageio.v2 as imageio
import numpy as np
import pytest
from matplotlib import colormaps

from diffsim_ti import cli, film, series_fields
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.series import Series

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


@pytest.mark.parametrize("change, text", [
    (dict(colour="mass"), "must be one of"), (dict(fps=0.0), "fps"), (dict(size=(161, 120)), "even"),
    (dict(output="a.avi"), "must end in"),
])  # fmt: skip
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
