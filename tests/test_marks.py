"""What is drawn of supports, loads and results: where arrows stand, how long they are, and that series keep them."""

import numpy as np
import pytest
from chamber_meshes import hollow_cube
from matplotlib.image import imread

import diffsim_ti as ds
from diffsim_ti.cli import app
from diffsim_ti.film import render_series, save_film
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.picture import Arrows, Lines, Points, draw, marks_of
from diffsim_ti.terms.marks import spread
from diffsim_ti.visual.drawing import Drawing
from diffsim_ti.visual.extent import Extent
from diffsim_ti.visual.glyphs import COLOURS, LENGTH, arrow_length, ends
from diffsim_ti.visual.series import SavedSeries
from diffsim_ti.writers import Frame, View, open_writer

SIZE = (320, 240)


def cube():
    return TetrahedralMesh.create_cube(3, 0.2)


def scene_of(*terms, **options):
    law = ds.StableNeoHookean(5e4, 0.3)
    return ds.Scene(cube(), law, 1000.0, terms, **dict(fixed="ymin", precision="f64") | options)


def test_a_load_is_drawn_as_it_is_at_the_moment():
    """Constant, for each step, by keyframes; what a run was given instead; nothing where it is zero."""
    X, held, steps = cube().vertices, np.array([3.0, -4.0, 0.0]), np.outer(np.arange(1, 5), [1.0, 0, 0])
    constant = scene_of(ds.Traction(held, "ymax"))
    (mark,) = marks_of(constant, X)
    assert mark.label == "traction [N/m^2]" and len(mark.points) == 9
    assert np.all(mark.vectors == held) and np.all(mark.points[:, 1] == 0.2)
    assert mark.onto[np.abs(mark.points[:, [0, 2]] - 0.1).max(1) < 0.05].all()  # it presses on the middle of the top
    rows = scene_of(ds.Traction(steps, "ymax"))
    assert [marks_of(rows, X, step=k)[0].vectors[0, 0] for k in range(6)] == [1, 1, 2, 3, 4, 4]
    keyed = scene_of(ds.Traction(([0.0, 2.0], [[0.0, 0, 0], [6.0, 0, 0]]), "ymax"))
    assert marks_of(keyed, X, 0.0) == [] and marks_of(keyed, X, 0.5)[0].vectors[0] == pytest.approx([1.5, 0, 0])
    for scene, given, expected in ((constant, [0, 7.0, 0], [0, 7.0, 0]), (keyed, np.full((3, 3), 5.0), [5.0] * 3)):
        frames = ds.Rollout(ds.SemiImplicitSolver(scene, dt=1e-4), 2).forward(traction=given)
        assert Frame.of_run(scene, frames, 1).marks[0].vectors[0] == pytest.approx(expected)


def test_pressure_stands_on_the_surface_as_it_is():
    turned = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    x = cube().vertices @ turned.T
    (mark,) = marks_of(scene_of(ds.Pressure(50.0, "xmax", name="wind")), x)
    assert (
        mark.label == "wind [Pa]" and mark.onto.all() and mark.vectors == pytest.approx(np.tile([0, -50.0, 0], (8, 1)))
    )
    assert mark.points[:, 1] == pytest.approx(0.2)
    (mark,) = marks_of(scene_of(ds.Pressure(-50.0, "xmax")), x)
    assert not mark.onto.any() and mark.vectors[:, 1] == pytest.approx(50.0)  # suction pulls outwards
    assert marks_of(scene_of(ds.Pressure(0.0)), x) == []


def test_springs_cables_foundations_and_gases():
    """Lines from point to point as they are now, anchors and founded vertices as points, the gas's own pressure."""
    X, top = cube().vertices, np.array([0.1, 0.4, 0.1])
    lines = ds.Spring(0, 1, 10.0), ds.Cable([[0.1, 0.2, 0.1], ds.Anchor(top), 2], tension=1.0, name="tendon")
    marks = marks_of(scene_of(*lines, ds.ElasticFoundation(1e4, 0.0, "ymax")), 1.5 * X)
    spring, tendon, anchor, founded = marks
    assert [m.label for m in marks] == ["spring", "tendon", "tendon, anchored", "foundation"]
    np.testing.assert_allclose(spring.ends, 1.5 * X[None, [0, 1]])
    np.testing.assert_allclose(tendon.ends, [[[0.15, 0.3, 0.15], top], [top, 1.5 * X[2]]], atol=1e-15)
    np.testing.assert_allclose(anchor.points, [top])
    assert len(founded.points) == 9 and np.all(founded.points[:, 1] == pytest.approx(0.3))
    body = hollow_cube()
    gas = ds.Scene(
        body, ds.StableNeoHookean(5e4, 0.3), 1000.0, ds.GasChamber(2e5, "cavity", 5e4), "bottom", precision="f64"
    )
    (mark,) = marks_of(gas, 2.0 * body.vertices)  # eight times the volume
    assert mark.label == "gas [Pa]" and not mark.onto.any()  # it sucks
    assert np.linalg.norm(mark.vectors, axis=1) == pytest.approx(5e4 - 2e5 / 8)


def test_forces_of_vertices_and_of_volumes():
    forces = np.zeros((27, 3))
    forces[[0, 26]] = [[1.0, 0, 0], [0, 2.0, 0]]
    scene = scene_of(ds.ExternalForce(forces), ds.BodyForce((0, -5.0, 0), per="mass"), fixed=None)
    X = cube().vertices
    force, body = marks_of(scene, X)
    assert np.array_equal(force.points, X[[0, 26]]) and np.array_equal(force.vectors, forces[[0, 26]])
    assert list(force.onto) == [True, False]  # vertex 0 is pushed in, 26 pulled out
    assert body.label == "body force [m/s^2]" and len(body.points) == 24
    assert marks_of(scene_of(ds.ExternalForce([0.0, 0, 0])), X) == []


def test_what_was_set_is_drawn():
    scene = scene_of(ds.ExternalForce(np.zeros((9, 3)), "ymax"))
    simulator = ds.Simulator(ds.SemiImplicitSolver(scene, dt=1e-4))
    assert Frame.of(simulator).marks == []
    simulator.set_forces(np.full((9, 3), 0.5))
    assert np.all(Frame.of(simulator).marks[0].vectors == 0.5)
    simulator.reset()
    assert Frame.of(simulator).marks == []


def test_many_points_are_thinned_evenly():
    line = np.stack([np.linspace(0, 1, 1001), np.zeros(1001), np.zeros(1001)], 1)
    assert np.diff(line[spread(line, 5), 0]) == pytest.approx(np.full(4, 0.25), abs=1e-3)
    assert list(spread(line[:3], 5)) == [0, 1, 2]


def coloured(image, colour):
    """Pixels of a hue, bright or dark, above the key."""
    image = image[: int(0.75 * SIZE[1])].astype(float)
    hue = image / np.maximum(image.max(2, keepdims=True), 1e-9)
    return (np.abs(hue - colour / colour.max()).max(2) < 0.12) & (np.ptp(image, axis=2) > 0.15 * 255)


def test_arrows_are_as_long_as_their_vectors():
    """The longest of a label has the share of the body that is promised, half a vector half of that; one scale for each."""
    mesh, row = cube(), np.array([[0.05, 0.25, 0.2], [0.15, 0.25, 0.2]])
    up = np.array([[0.0, 8.0, 0], [0, 4.0, 0]])
    with Drawing(
        mesh, SIZE, box=[[-0.1, 0, 0], [0.3, 0.4, 0.2]], azimuth=0, elevation=0, backend="software"
    ) as drawing:
        image = drawing.image(mesh.vertices, drawn=[Arrows("f [N]", row, up, np.array([False, True]))])
        plain = drawing.image(mesh.vertices)
        at = drawing.camera.project(np.stack([row, row + [0, LENGTH * 0.2, 0]]), SIZE)
    red = coloured(image, COLOURS[0])
    whole = at[0, 0, 1] - at[1, 0, 1]
    middle = int(at[0].mean(0)[0])
    rows = [np.flatnonzero(red[:, part].any(1)) for part in (slice(0, middle), slice(middle, None))]
    assert [np.ptp(r) + 1 for r in rows] == pytest.approx([whole, whole / 2], abs=2.0)
    assert rows[0].max() == pytest.approx(at[0, 0, 1], abs=2) and rows[1].min() == pytest.approx(at[0, 1, 1], abs=2)
    assert not coloured(plain, COLOURS[0]).any()
    key = (image != plain).any(2)[int(0.8 * SIZE[1]) :]
    assert key.any()  # the words that name unit and size


def test_lines_and_points_are_drawn_and_named():
    mesh = cube()
    drawn = [
        Lines("spring", np.array([[[-0.05, 0.1, 0.2], [-0.05, 0.3, 0.2]]])),
        Points("anchor", np.array([[0.25, 0.25, 0.2]])),
    ]
    image = 255 * draw(mesh, mesh.vertices, size=SIZE, marks=drawn, azimuth=0, elevation=0)
    line, point = coloured(image, COLOURS[0]), coloured(image, COLOURS[1])
    assert np.ptp(np.nonzero(line)[0]) > 8 * np.ptp(np.nonzero(line)[1]) and 2 < point.sum() < 200
    assert np.nonzero(line)[1].max() < np.nonzero(point)[1].min()


def test_supports_by_direction_are_cones_outside():
    """Rollers on three sides: one cone for each direction of each vertex, and the corner fixed wholly is a disc."""
    scene = scene_of(fixed={"xmin": "x", "ymin": "y", "zmin": "z"})
    with Drawing(scene.mesh, SIZE, fixed=scene.held, held=scene.supports.held, backend="software") as drawing:
        wholly, vertices, axes = drawing._cones
        assert [line for line, _ in drawing.key(())] == ["● held in all directions", "▲ held along the cone"]
        image = drawing.image(scene.mesh.vertices)
    X = scene.mesh.vertices
    assert list(wholly) == [0] and len(vertices) == 3 * 9 - 3
    assert (axes.sum(1) == pytest.approx(-np.ones(24))) and np.all(X[vertices][axes == -1.0] == 0)
    with Drawing(scene.mesh, SIZE, backend="software") as drawing:
        assert (image != drawing.image(X)).any(2)[: int(0.7 * SIZE[1])].sum() > 50


@pytest.fixture(scope="module")
def loaded():
    """(scene, frames) of a cube on rollers that is pulled and pressed."""
    terms = ds.Traction((0, -300.0, 0), "xmax"), ds.Pressure(200.0, "ymax")
    scene = scene_of(*terms, fixed={"xmin": "xyz", "zmin": "z"})
    outputs = [ds.Reaction(per_vertex=True), ds.Reaction("xmin", "left", per_vertex=True)]
    return scene, ds.Rollout(ds.SemiImplicitSolver(scene, dt=1e-4), 4, save_every=2, outputs=outputs).forward()


def test_a_series_keeps_supports_loads_and_results(loaded, tmp_path):
    """What is drawn of the series is, bit by bit, what is drawn of the run."""
    scene, frames = loaded
    view = View(size=SIZE, colour="speed", arrows=("left",))
    with open_writer(tmp_path / "run.pvd", scene) as series, open_writer(tmp_path / "run.png", scene, view) as picture:
        for k in range(3):
            frame = Frame.of_run(scene, frames, k)
            series.write(frame)
            picture.write(frame)
    saved = SavedSeries(tmp_path / "run.pvd")
    assert saved.setting.held == pytest.approx(scene.supports.held)
    for k in range(3):
        ours, theirs = Frame.of_run(scene, frames, k), saved.frame(k)
        assert [m.label for m in theirs.marks] == [m.label for m in ours.marks] == ["traction [N/m^2]", "pressure [Pa]"]
        for mine, back in zip(ours.marks, theirs.marks):
            for part in ("points", "vectors", "onto"):
                assert np.array_equal(getattr(mine, part), getattr(back, part))
        left = np.zeros((27, 3))
        left[scene.mesh.vertex_indices("xmin")] = frames["left"][k]
        assert np.array_equal(theirs.fields["left"], left) and theirs.units["left"] == "N"
    render_series(tmp_path / "run.pvd", tmp_path / "again.png", "speed", size=SIZE, backend="software", arrows=["left"])
    assert np.array_equal(imread(tmp_path / "run.png"), imread(tmp_path / "again.png"))
    render_series(tmp_path / "run.pvd", tmp_path / "bare.png", "speed", size=SIZE, backend="software")
    assert not np.array_equal(imread(tmp_path / "run.png"), imread(tmp_path / "bare.png"))


def test_forces_of_loads_are_a_field(loaded):
    """What they sum up to: traction times area at rest, pressure on the top as it is."""
    scene, frames = loaded
    forces, x = Frame.of_run(scene, frames, 2).fields["loads"], frames.positions[2]
    top = scene.mesh.surface_triangles[scene.mesh.surface_indices("ymax")]
    pushed = -200.0 * np.cross(x[top[:, 1]] - x[top[:, 0]], x[top[:, 2]] - x[top[:, 0]]).sum(0) / 2
    assert forces.sum(0) == pytest.approx(np.array([0, -300.0 * 0.2**2, 0]) + pushed, rel=1e-12, abs=1e-12)
    simulator = ds.Simulator(ds.SemiImplicitSolver(scene, dt=1e-4))
    simulator.run(4)
    assert Frame.of(simulator).fields["loads"] == pytest.approx(forces, rel=1e-12)


def test_the_command_draws_arrows(loaded, tmp_path, capsys):
    scene, frames = loaded
    with open_writer(tmp_path / "run.pvd", scene) as series:
        series.write(Frame.of_run(scene, frames, 2))
    command = ["render", str(tmp_path / "run.pvd"), "-o", str(tmp_path / "a.png"), "--size", "160", "120"]
    command += ["--colour", "speed", "--backend", "software"]
    with pytest.raises(SystemExit) as end:
        app.main([*command, "--arrows", "reaction", "--arrows", "left"])
    assert end.value.code == 0 and imread(tmp_path / "a.png").shape[:2] == (120, 160)
    with pytest.raises(SystemExit) as end:
        app.main([*command, "--arrows", "wind"])
    said = capsys.readouterr().err
    assert end.value.code == 2 and "arrows: 'wind' must be a vector of each vertex" in said and "reaction, left" in said


FORCES = [word for name in ("reaction", "contact", "friction") for word in ("--arrows", name)]


def test_a_simulation_of_the_command_line_writes_and_draws_forces(tmp_path, capsys):
    """A cube that hangs by one side: what holds it carries its weight once it rests, to what still swings."""
    TetrahedralMesh.create_cube(2, 0.1).save(tmp_path / "cube.vtu")
    command = [
        "simulate",
        str(tmp_path / "cube.vtu"),
        "--fixed",
        "ymax",
        "--duration",
        "0.02",
        "--fps",
        "100",
        "--height",
        "0",
    ]
    command += ["--ground-stiffness", "1e3", "-o", str(tmp_path / "a.pvd"), "-o", str(tmp_path / "a.npz")]
    command += ["-o", str(tmp_path / "a.png"), "--height", "0.0005", "--ground-friction", "0.5", "--velocity", "0.2"]
    command += ["0", "0"]
    with pytest.raises(SystemExit) as end:
        app.main([*command, *FORCES])
    assert end.value.code == 0, capsys.readouterr().err
    arrays = np.load(tmp_path / "a.npz")
    assert arrays["reaction"].shape == arrays["contact"].shape == arrays["friction"].shape == (3, 8, 3)
    top = arrays["rest_positions"][:, 1] > 0.09
    assert np.abs(arrays["reaction"][-1, top]).max() > 0 and not arrays["reaction"][-1, ~top].any()
    assert arrays["contact"][-1, ~top, 1].sum() > 0  # the floor presses from below, with friction
    normal = (arrays["contact"] - arrays["friction"])[-1, ~top, 1]
    friction = np.linalg.norm(arrays["friction"][-1, ~top], axis=1)
    assert friction.max() > 0 and np.all(friction <= 0.5001 * normal)
    saved = SavedSeries(tmp_path / "a.pvd").frame(2).fields["contact"]  # in single precision
    assert saved == pytest.approx(arrays["contact"][2], rel=1e-6)
    with pytest.raises(SystemExit) as end:
        app.main([*command, "--arrows", "wind"])
    assert end.value.code == 2 and "--arrows: must be reaction, contact or friction" in capsys.readouterr().err


def test_a_film_has_one_scale(tmp_path):
    mesh, marks = (
        cube(),
        [[Arrows("f [N]", np.array([[0.1, 0.25, 0.1]]), s * np.eye(3)[1:2], np.zeros(1, bool))] for s in (1, 4)],
    )
    positions = np.stack([mesh.vertices] * 2)
    assert save_film(tmp_path / "a.gif", mesh, positions, size=SIZE, marks=marks, backend="software") == 2
    import imageio.v2 as imageio

    frames = [
        np.asarray(frame)[: int(0.8 * SIZE[1]), :, :3].astype(int) for frame in imageio.mimread(tmp_path / "a.gif")
    ]
    first, last = (frame[..., 0] - frame[..., 1] > 25 for frame in frames)  # a GIF has few colours
    heights = [np.ptp(np.flatnonzero(seen.any(1))) + 1 for seen in (first, last)]
    assert heights[1] == pytest.approx(4 * heights[0], rel=0.3)
    with pytest.raises(ValueError, match="marks: must be given for each of the 2 frames"):
        save_film(tmp_path / "a.gif", mesh, positions, marks=marks[:1])


def test_a_scene_without_them_is_as_before(tmp_path):
    scene = scene_of(ds.Gravity())
    frames = ds.Rollout(ds.SemiImplicitSolver(scene, dt=1e-4), 1).forward()
    frame = Frame.of_run(scene, frames, 1)
    assert frame.marks == [] and Drawing(scene.mesh, SIZE, fixed=scene.held, backend="software").key(frame.marks) == []
    with open_writer(tmp_path / "run.pvd", scene) as series:
        series.write(frame)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.pvd", "run_0000.vtu"]
    assert "marks" not in (tmp_path / "run.pvd").read_text() and SavedSeries(tmp_path / "run.pvd").setting.held is None


def test_what_frames_span_is_kept_in_little_room():
    """The box of many frames' arrows, whose scale is known at the end alone, is that of all of them together."""
    mesh, rng = ds.TetrahedralMesh.create_box(2), np.random.default_rng(0)
    extent, all_marks = Extent(mesh, "speed"), []
    for k in range(300):
        onto = rng.random(5) < 0.5
        own = [
            Arrows("load", rng.normal(size=(5, 3)), (1 + 0.01 * k) * rng.normal(size=(5, 3)), onto),
            Arrows("still", np.ones((2, 3)), np.zeros((2, 3)), np.array([True, False])),
            Lines("spring", rng.normal(size=(2, 2, 3))),
            Points("bed", 0.9 * rng.normal(size=(3, 3))),
        ]
        extent.add(mesh.vertices, np.zeros(mesh.num_vertices), own)
        all_marks += own
    reached = np.concatenate([ends(mark, extent.scale, arrow_length(mesh)).reshape(-1, 3) for mark in all_marks])
    whole = np.concatenate([mesh.vertices, reached])
    np.testing.assert_allclose(extent.box, [whole.min(0), whole.max(0)], rtol=1e-12)
    assert sum(len(rows) for rows in extent._arrows.values()) < 100
