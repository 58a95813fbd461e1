"""Pictures of optimisations, by what is in their panels and files."""

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PolyCollection
from PIL import Image

from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.optimization_picture import OptimizationPicture, optimization_figure

CUBE = TetrahedralMesh.create_cube(3, 0.2)
X = CUBE.vertices
SIZE = (480, 160)


def test_panels_hold_the_curves_the_body_and_the_target():
    losses = [1.0, 1e-3, 0.0]  # met exactly
    figure = optimization_figure(
        losses,
        {"E [Pa]": [1e5, 2e5, 3e5], "v [m/s]": np.eye(3)},
        CUBE,
        X + 0.1,
        X + 0.1,
        X,
        {"E [Pa]": 3e5},
        loss_label="loss [m²]",
        size=SIZE,
    )
    loss, E, v, body = figure.axes
    assert loss.get_yscale() == "log" and loss.get_ylabel() == "loss [m²]" and loss.get_ylim()[0] == pytest.approx(3e-4)
    assert loss.lines[0].get_ydata()[:2] == pytest.approx(losses[:2])
    assert E.lines[0].get_ydata() == pytest.approx([1e5, 2e5, 3e5]) and E.lines[1].get_ydata() == pytest.approx(
        [3e5] * 2
    )
    assert len(v.lines) == 3 and len({line.get_color() for line in v.lines}) == 3
    start, found = [c for c in body.collections if isinstance(c, PolyCollection)]
    (edges,) = [c for c in body.collections if isinstance(c, LineCollection)]
    middles = [np.mean([p.vertices.mean(0) for p in c.get_paths()], 0) for c in (start, found, edges)]
    assert middles[0] == pytest.approx([0.1, 0.1], abs=0.01)
    assert middles[1] == pytest.approx([0.2, 0.2], abs=0.01) == middles[2]
    figure.canvas.draw()
    assert np.asarray(figure.canvas.buffer_rgba()).shape == (160, 480, 4)


def test_points_as_target_and_the_view_from_the_side():
    figure = optimization_figure([1.0], {}, CUBE, X, np.array([[1.0, 2.0, 3.0]]), plane="zy", size=SIZE)
    body = figure.axes[-1]
    assert np.concatenate(body.lines[0].get_data()) == pytest.approx([3, 2]) and body.get_xlabel() == "z [m]"


def test_written_while_it_runs(tmp_path):
    """Each evaluation replaces the picture; nothing else is left in the folder."""
    path = tmp_path / "new" / "run.png"
    picture = OptimizationPicture(CUBE, X, path, every=0.0, size=SIZE)
    seen = []
    for k in range(3):
        picture.add(10.0**-k, {"E [Pa]": 1e5 + k}, X + 0.05 * k)
        with Image.open(path) as image:
            seen.append(np.asarray(image.convert("RGB"), float))
    assert seen[0].shape == (160, 480, 3) and all(np.abs(a - b).mean() > 0.5 for a, b in zip(seen, seen[1:]))
    assert [p.name for p in path.parent.iterdir()] == ["run.png"]
    assert picture.losses == [1.0, 0.1, 0.01] and picture.start == pytest.approx(X)


def test_written_only_when_asked(tmp_path):
    picture = OptimizationPicture(CUBE, X, size=SIZE)
    picture.add(1.0, {}, X)
    picture.save(tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 1000
    with pytest.raises(ValueError, match="path: must be given"):
        picture.save()


@pytest.mark.parametrize(
    "change, text",
    [
        (dict(losses=[1.0, -1.0, 0.1]), "losses"),
        (dict(losses=[1.0, np.nan, 0.1]), "finite"),
        (dict(plane="xx"), "plane"),
        (dict(truth={"nu": 1.0}), "truth"),
        (dict(parameters={"E": [1.0]}), "one row for each"),
        (dict(found=X[:3]), "must have shape"),
        (dict(target=np.zeros(3)), "target"),
    ],
)
def test_bad_arguments_are_refused(change, text):
    good = dict(losses=[1.0, 0.5, 0.1], parameters={"E": [1.0, 2.0, 3.0]}, mesh=CUBE, found=X, target=X, size=SIZE)
    with pytest.raises(ValueError, match=text):
        optimization_figure(**good | change)


def test_bad_collection_is_refused():
    with pytest.raises(ValueError, match="every"):
        OptimizationPicture(CUBE, X, every=1.0)
    picture = OptimizationPicture(CUBE, X)
    picture.add(1.0, {"E": 1.0}, X)
    with pytest.raises(ValueError, match="each time"):
        picture.add(1.0, {"nu": 1.0}, X)
