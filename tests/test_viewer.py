"""What a window shows and does, with a window of ours that is told what the mouse and keys do; no display is needed."""

from dataclasses import replace
from types import SimpleNamespace

import imageio.v2 as imageio
import numpy as np
import pytest
import taichi as ti
from saved_series import Series

import diffsim_ti as ds
from diffsim_ti import cli
from diffsim_ti.cli import options as cli_options
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.visual import viewer
from diffsim_ti.visual.camera import Camera
from diffsim_ti.visual.drawing import Drawing
from diffsim_ti.visual.frame_sources import LiveFrames, SavedFrames
from diffsim_ti.visual.viewer import Grip, Viewer, picked_vertex
from diffsim_ti.writers import View, writer_for
from diffsim_ti.writers.adaptive_run import ForwardRun

SIZE = (200, 150)


class Panel:
    """A panel whose buttons and sliders are pressed by name."""

    def __init__(self, window):
        self.window, self.lines = window, []

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.window.panel = self

    def sub_window(self, *_):
        return self

    def text(self, line):
        self.lines.append(line)

    def button(self, name):
        return self.window.clicked == name.strip("* ")

    def checkbox(self, name, value):
        return value != (self.window.clicked == name)

    def slider_int(self, name, value, low, high):
        return self.window.slide if self.window.slide is not None else value

    def slider_float(self, name, value, low, high):
        return value


class Window:
    """A window that shows nothing."""

    def __init__(self):
        self.running, self.cursor, self.pressed, self.keys, self.clicked, self.slide = (
            True,
            (0.5, 0.5),
            (),
            [],
            None,
            None,
        )

    def get_events(self, kind):
        keys, self.keys = self.keys, []
        return [SimpleNamespace(key=key) for key in keys]

    def get_cursor_pos(self):
        return self.cursor

    def is_pressed(self, key):
        return key in self.pressed

    def get_gui(self):
        return Panel(self)

    def show(self):
        self.clicked = self.slide = None


@pytest.fixture
def make_viewer(monkeypatch):
    """A viewer of a source, and its window; `viewer.shown` has the triangles of the last refresh."""
    window = Window()
    monkeypatch.setattr(viewer, "open_window", lambda *_: window)

    def make(source, **options):
        out = Viewer(source, size=SIZE, **options)
        out._canvas = SimpleNamespace(draw=lambda soup, background, size: setattr(out, "shown", soup))
        out.draw()
        return out, window

    monkeypatch.setattr("diffsim_ti.visual.painters.Canvas", lambda window: None)
    return make


@pytest.fixture(scope="module")
def series(tmp_path_factory):
    """A cube on a moving ball rises by 0.2 m a frame, one side fixed, above a floor."""
    cube = TetrahedralMesh.create_cube(3, 0.2)
    ball = ds.Sphere((0.5, 0.1, 0.1), 0.1, stiffness=1.0, width=0.01, path=lambda t: [0, 2 * t, 0])
    terms = [ds.Ground(-0.1, stiffness=1.0, width=0.01), ball]
    scene = ds.Scene(cube, ds.StableNeoHookean(1e5, 0.3), terms=terms, fixed="xmin")
    out, ones = Series(tmp_path_factory.mktemp("series"), cube, "cube", scene), np.ones(cube.num_tetrahedra)
    for k in range(3):
        offset = np.zeros(cube.vertices.shape) + [0, 0.2 * k, 0]
        fields = SimpleNamespace(von_mises=1e3 * k * ones, energy_density=k * ones, J=(1 - 0.1 * k) * ones)
        out.write(0.1 * k, cube.vertices + offset, offset, offset, fields)
    return out.path


@pytest.fixture(scope="module")
def falling():
    """A small cube above a floor, in a run that can be pulled."""
    cube = TetrahedralMesh.create_cube(3, 0.2)
    scene, _ = cli_options.fall_scene(
        cube, ds.StableNeoHookean(1e5, 0.3), 1000.0, height=0.01, extra=[ds.ExternalForce([0.0, 0.0, 0.0])]
    )
    return ForwardRun(scene, ds.SemiImplicitSolver, 1 / 60)


@pytest.fixture
def live(falling):
    falling.simulator.reset()
    falling.restart_balance()
    return LiveFrames(falling)


# ---- sources ----------------------------------------------------------------------------------------------------------


def test_saved_frames_give_state_fields_and_limits(series):
    source = SavedFrames(series)
    frame = source.frame(2)
    assert len(source) == 3 and frame.time == pytest.approx(0.2) and "0.8" in frame.notes[0] and not source.advance()
    assert frame.positions[:, 1].min() == pytest.approx(0.4) and frame.fields["speed"] == pytest.approx(0.4)
    assert source.colouring("von_mises").limits == pytest.approx((0, 2000))
    assert source.colouring("J").limits == pytest.approx((0.8, 1.2))
    assert source.box()[:, 1] == pytest.approx([0, 0.6])


def test_saved_frames_know_floor_obstacles_and_what_is_fixed(series):
    source = SavedFrames(series)
    look = source.look
    assert look["ground"] == pytest.approx(-0.1)
    assert source.mesh.vertices[look["fixed"], 0] == pytest.approx(0) and len(look["fixed"]) == 9
    ((points, triangles),) = look["obstacles"]
    assert np.linalg.norm(points - [0.5, 0.1, 0.1], axis=1) == pytest.approx(0.1) and triangles.max() < len(points)
    (moved,) = source.frame(2).obstacles
    assert moved - points == pytest.approx(np.tile([0, 0.4, 0], (len(points), 1)), abs=1e-6)


def test_live_frames_advance_and_tell_numbers(live):
    source, sim = live, live.run.simulator
    for _ in range(2):
        assert source.advance()
    frame = source.frame(2)
    assert len(source) == 3 and frame.time == pytest.approx(2 / 60) == sim.time
    assert frame.positions == pytest.approx(sim.positions.astype(float))
    assert frame.fields["speed"] == pytest.approx(9.81 / 30, rel=1e-3)  # still in the air
    notes = " ".join(frame.notes)
    energy = sim.compute_energy()
    assert f"energy {energy:.4g} J" in notes and f"kinetic {energy.parts['kinetic']:.4g} J" in notes
    assert "smallest J 1" in notes and "smallest gap so far" in notes and "steps a second" in notes
    assert 9.81 / 30 < source.colouring("speed").limits[1] < 1.5 * 9.81 / 30
    assert source.look["ground"] == 0.0


def test_live_frames_forget_the_oldest(live):
    source = LiveFrames(live.run, keep=2)
    for _ in range(3):
        source.advance()
    assert len(source) == 2 and source.frame(0).time == pytest.approx(2 / 60)


# ---- keys and panel ---------------------------------------------------------------------------------------------------


def test_keys_and_panel_drive_the_viewer(series, make_viewer):
    view, window = make_viewer(SavedFrames(series), colour="speed")
    assert view.at == 0 and not view.playing
    rows = [view.shown.corners[..., 1].min()]
    for keys, at in (([ti.ui.RIGHT], 1), ([ti.ui.RIGHT], 2), ([ti.ui.RIGHT], 2), ([ti.ui.LEFT], 1), (["r"], 0)):
        window.keys = keys
        view.draw()
        rows.append(view.shown.corners[..., 1].min())
        assert view.at == at
    assert rows[0] > rows[1] + 5 > rows[2] + 10  # it rises in the picture, and so does the ball
    window.slide = 2  # scrubs
    view.draw()
    assert view.at == 2
    window.clicked = "von Mises stress [Pa]"
    view.draw()
    assert view.colour == "von_mises"
    view.draw()
    assert any("colours from 0 to 2e+03" in line for line in window.panel.lines)
    before = len(view.shown.corners)
    window.keys = ["w", "c", "+"]
    view.draw()
    assert view.drawing.wireframe and view.colour == "energy_density" and len(view.shown.corners) > before
    window.keys, view.speed = [ti.ui.SPACE], 1e9
    view.draw()
    assert view.playing and view.at == 0  # after the last comes the first
    window.keys = [ti.ui.ESCAPE]
    view.draw()
    assert not window.running


def test_right_button_turns(series, make_viewer):
    view, window = make_viewer(SavedFrames(series))
    eye = view.drawing.camera.position
    window.pressed, window.cursor = (ti.ui.RMB,), (0.75, 0.5)
    view.draw()
    turned = view.drawing.camera.position
    middle = view.drawing.camera.look_at
    angles = [np.degrees(np.arctan2(*(x - middle)[[0, 2]])) for x in (eye, turned)]
    assert angles[1] - angles[0] == pytest.approx(-45) and turned[1] == pytest.approx(eye[1])


def test_playing_a_live_run_makes_frames(live, make_viewer):
    view, window = make_viewer(live, playing=True)
    view.speed = 1e9
    view.draw()
    assert view.at == len(live) - 1 >= 1 and live.frame(view.at).time > 0
    assert any("kinetic" in line for line in window.panel.lines)
    view.go(0)
    assert view.at == 0 and not view.playing


# ---- dragging ---------------------------------------------------------------------------------------------------------


def test_the_vertex_under_the_cursor_is_picked():
    cube = TetrahedralMesh.create_cube(4, 0.3)
    camera = Camera.framing(cube.vertices, SIZE, 20.0, 30.0)
    points, triangles = cube.vertices, cube.surface_triangles
    front = [v for v in np.unique(triangles) if np.all(points[v] @ np.eye(3) > 0.05)]
    for vertex in front[:5]:
        aim = points[vertex] + 1e-3 * (points.mean(0) - points[vertex])
        ray = aim - camera.position
        assert picked_vertex(camera.position, ray / np.linalg.norm(ray), points, triangles) == vertex
    assert picked_vertex(camera.position, np.array([0.0, 1.0, 0.0]), points, triangles) is None


def test_the_grip_is_a_damped_spring_on_what_it_holds():
    cube = TetrahedralMesh.create_cube(3, 0.2)
    mass, grip = np.full(cube.num_vertices, 0.1), Grip(cube, np.full(cube.num_vertices, 0.1), 4)
    rest, still = cube.vertices, np.zeros(cube.vertices.shape)
    assert not grip.forces(rest, still).any()
    grip.target = rest[4] + [0.01, 0, 0]
    forces = grip.forces(rest, still)
    assert forces[4] == pytest.approx([grip.rate**2 * 0.01 * mass[4], 0, 0]) and (forces[:, 0] > 0).all()
    assert np.linalg.norm(forces, axis=1).argmax() == 4
    assert grip.held.sum() * grip.rate**2 == pytest.approx(15.0**2 * mass.sum())
    grip.target = rest[4] + [100.0, 0, 0]
    assert grip.forces(rest, still)[4, 0] == pytest.approx(grip.rate**2 * 0.2 * mass[4])  # no longer than the body
    assert grip.forces(rest, still + [1.0, 0, 0])[4, 0] < grip.forces(rest, still)[4, 0]


def test_the_left_button_pulls_a_live_body(live, make_viewer):
    """Grabbed near its middle and pulled up, it rises; let go, it falls."""
    view, window = make_viewer(live)
    window.cursor, window.pressed = (0.5, 0.5), (ti.ui.LMB,)
    view.draw()
    held = view.held
    assert held is not None
    at = view.drawing.camera.project(view._under_cursor(), SIZE)
    assert at[:2] == pytest.approx([100, 75], abs=1e-6)
    start = live.frame(len(live) - 1).positions
    for k in range(20):
        window.cursor = (0.5, 0.5 + 0.04 * k)
        view.draw()
        view.go(len(live))
    pulled = live.frame(len(live) - 1)
    assert pulled.positions[held, 1] > start[held, 1] + 0.15
    assert pulled.positions[:, 1].min() > 0.002  # beyond the reach of the floor
    window.pressed = ()
    view.draw()
    assert view.held is None
    velocity = live.run.simulator.velocities[:, 1].mean()
    view.go(len(live))
    assert live.run.simulator.velocities[:, 1].mean() - velocity == pytest.approx(
        -9.81 / 60, rel=0.15
    )  # a corner touches, and the floor has a stiffness per area


def test_a_click_on_the_panel_or_beside_the_body_grabs_nothing(live, make_viewer):
    view, window = make_viewer(live)
    for cursor in ((0.1, 0.9), (0.98, 0.02)):
        window.cursor, window.pressed = cursor, (ti.ui.LMB,)
        view.draw()
        assert view.held is None
        window.pressed = ()
        view.draw()


def test_a_saved_series_is_not_pulled(series, make_viewer):
    view, window = make_viewer(SavedFrames(series))
    window.pressed = (ti.ui.LMB,)
    view.draw()
    assert view.held is None


def test_forces_are_drawn_where_they_are_asked_for(series, make_viewer):
    source = SavedFrames(series)
    source.frame(0).fields["pull"] = np.ones(source.mesh.vertices.shape)
    plain, arrowed = (make_viewer(source, arrows=names) for names in ((), ("pull",)))
    more = len(arrowed[0].shown.corners) - len(plain[0].shown.corners)
    assert more > 20 * source.mesh.num_vertices / 2 and any("pull, longest 1.73" in x for x in arrowed[1].panel.lines)
    with pytest.raises(ValueError, match="arrows: 'push' must be a vector of each vertex that frames hold"):
        make_viewer(source, arrows=("push",))


def test_forces_are_refused_where_the_scene_has_none(live):
    sim = live.run.simulator
    with pytest.raises(ValueError, match="expected finite numbers of shape"):
        sim.set_forces(np.zeros((2, 3)))
    scene = ds.Scene(live.mesh, ds.StableNeoHookean(1e5, 0.3))
    with pytest.raises(ValueError, match="constant ExternalForce"):
        ds.Simulator(ds.SemiImplicitSolver(scene, dt=1e-4)).set_forces(np.zeros((2, 3)))


def test_the_command_opens_a_series_or_a_live_run(series, tmp_path, monkeypatch):
    opened = []

    class Opened:
        def __init__(self, source, colour, playing, **look):
            opened.append((source, colour, playing, look))

        def run(self):
            pass

    monkeypatch.setattr(viewer, "Viewer", Opened)
    monkeypatch.setattr(viewer, "has_display", lambda: True)
    monkeypatch.setattr("diffsim_ti.runtime.init", lambda: None)
    TetrahedralMesh.create_cube(3, 0.2).save(tmp_path / "cube.vtu")
    for arguments in (
        [str(series), "--ground", "-0.5", "-o", str(tmp_path / "seen.gif")],
        [str(tmp_path / "cube.vtu"), "--colour", "J", "--fixed", "xmin", "--arrows", "contact"],
    ):
        with pytest.raises(SystemExit) as stop:
            cli.main(["view", *arguments])
        assert stop.value.code == 0
    (saved, _, playing, look), (live, colour, plays, other) = opened
    assert list(other["arrows"]) == [force.name for force in live.run.outputs] == ["contact"]
    assert live.frame(0).fields["contact"].shape == live.mesh.vertices.shape
    assert isinstance(saved, SavedFrames) and not playing and look["ground"] == -0.5
    assert look["output"].path.name == "seen.gif" and look["output"].view.ground == -0.5
    assert isinstance(live, LiveFrames) and plays and colour == "J" and live.can_drag and live.look["ground"] == 0.0
    assert len(live.look["fixed"]) == 9 and live.frame(0).positions[:, 1].min() == pytest.approx(0.02, abs=1e-6)


def test_frames_are_saved_as_they_are_seen(series, live, make_viewer, tmp_path):
    """S and the button write what the source has: a series as it was, a film from where one looks."""
    view, window = make_viewer(SavedFrames(series), output=writer_for(tmp_path / "again.pvd"))
    window.keys = ["s"]
    view.draw()
    view.draw()
    assert any("again.pvd and 3 .vtu frames" in line for line in window.panel.lines)
    again, first = SavedFrames(tmp_path / "again.pvd"), SavedFrames(series)
    assert again.setting.ground == first.setting.ground and np.array_equal(again.setting.fixed, first.setting.fixed)
    for name in ("positions", "displacements", "velocities"):
        assert np.array_equal(getattr(again.frame(2), name), getattr(first.frame(2), name))
    assert np.array_equal(again.frame(2).obstacles[0], first.frame(2).obstacles[0])
    live.advance()
    view, window = make_viewer(live, colour="speed", output=writer_for(tmp_path / "a.gif", View(size=SIZE)))
    view.drawing.camera, window.clicked = view.drawing.camera.zoomed(0.5), "save"
    view.draw()
    images = imageio.mimread(tmp_path / "a.gif")
    with Drawing(live.mesh, SIZE, camera=view.drawing.camera, backend="software", ground=0.0) as drawing:
        drawing.colouring = replace(live.colouring("speed"), limits=(0.0, float(live.frame(1).fields["speed"].max())))
        expected = drawing.image(live.frame(1).positions, live.frame(1).fields["speed"])
    assert len(images) == 2 and view.output.view.fps == pytest.approx(60)
    assert np.abs(images[1][40:, :140, :3].astype(float) - expected[40:, :140]).mean() < 6  # of 256 colours


def test_without_a_display_the_viewer_says_what_to_do(series, monkeypatch, capsys):
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    source = SavedFrames(series)
    with pytest.raises(RuntimeError, match="diffsim-ti render"):
        Viewer(source)
    with pytest.raises(SystemExit) as stop:
        cli.main(["view", str(series)])
    assert stop.value.code == 2 and "diffsim-ti render" in capsys.readouterr().err
    with pytest.raises(ValueError, match="must be one of"):
        Viewer(source, "mass")
