"""Writers of runs: one is chosen by each output's suffix, before anything runs; a format of one's own is a class."""

import csv
from types import SimpleNamespace

import imageio.v2 as imageio
import meshio
import numpy as np
import pytest
from matplotlib.image import imread

import diffsim_ti as ds
from diffsim_ti import writers
from diffsim_ti.cli import app
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.visual.series import SavedSeries
from diffsim_ti.writers import Frame, Setting, View, Writer, open_writer, register, writer_for
from diffsim_ti.writers.adaptive_run import ForwardRun, file_in, run_and_write

SIZE = (160, 120)


@pytest.fixture(scope="module")
def run():
    """A cube held at one side that sags beside a ball which rises."""
    cube = TetrahedralMesh.create_cube(3, 0.2)
    ball = ds.Sphere((0.5, 0.1, 0.1), 0.08, stiffness=1.0, width=0.01, path=lambda t: [0, t, 0])
    terms = [ds.Gravity(), ds.Ground(-0.3, stiffness=1.0, width=0.01), ball]
    return ForwardRun(
        ds.Scene(cube, ds.StableNeoHookean(2e4, 0.3), terms=terms, fixed="xmin"), ds.SemiImplicitSolver, 0.02
    )


@pytest.fixture
def again(run):
    run.simulator.reset()
    run.restart_balance()
    return run


def body(image):
    """Pixels of the body: saturated, left of the legend."""
    return np.ptp(np.asarray(image, float)[:, : int(0.7 * image.shape[1]), :3], axis=2) > 0.15 * np.max(image)


def test_several_outputs_of_one_run_hold_the_same_frames(again, tmp_path):
    view = View(size=SIZE, colour="displacement")
    names = ("a.pvd", "a.npz", "a.gif", "end.png", "all_%02d.png")
    seconds, said, kept = run_and_write(again, 3, [writer_for(tmp_path / n, view) for n in names], keep=(0, 3))
    assert seconds > 0 and [len(said), len(kept)] == [5, 2] and "4 .vtu frames" in said[0]
    arrays, saved = np.load(tmp_path / "a.npz"), SavedSeries(tmp_path / "a.pvd")
    assert arrays["time"] == pytest.approx([0, 0.02, 0.04, 0.06]) and len(saved) == 4
    for k in range(4):
        frame = saved.frame(k)
        assert np.array_equal(arrays["displacements"][k], frame.displacements)
        assert np.array_equal(arrays["velocities"][k], frame.velocities)
        assert arrays["J"][k] == pytest.approx(frame.fields["J"], rel=1e-6)
        assert frame.obstacles[0][:, 1].mean() == pytest.approx(0.1 + 0.02 * k)
    assert np.array_equal(arrays["positions"][3], again.simulator.positions)
    assert np.array_equal(arrays["positions"][3], kept[1].positions)
    assert arrays["rest_positions"] == pytest.approx(again.scene.mesh.vertices) and len(arrays["fixed"]) == 9
    assert len(imageio.mimread(tmp_path / "a.gif")) == 4
    assert sorted(p.name for p in tmp_path.glob("all*")) == [f"all_0{k}.png" for k in range(4)]
    first, last, end = (imread(tmp_path / name) for name in ("all_00.png", "all_03.png", "end.png"))
    assert first.shape[:2] == (120, 160) and np.array_equal(last, end)  # one camera and one scale of colours
    assert not np.array_equal(first, end)


def test_a_picture_of_the_end_may_be_framed_by_the_end(tmp_path):
    """A body that shrinks to a tenth: small in the frame of the run, large in its own."""
    cube, seen = TetrahedralMesh.create_cube(2, 0.2), {}
    for fit in ("run", "end"):
        writer = writer_for(tmp_path / f"{fit}.png", View(size=SIZE, colour="speed", fit=fit))
        writer.open(Setting(cube))
        with writer:
            for scale in (1.0, 0.1):
                x = scale * cube.vertices
                writer.write(Frame(0.0, x, x - cube.vertices, 0 * x, {"speed": np.arange(len(x))}))
        seen[fit] = body(imread(tmp_path / f"{fit}.png")).sum()
    assert seen["end"] > 10 * seen["run"] > 0


class TableWriter(Writer):
    """The heights over time, as a user's own format."""

    suffixes = (".csv",)

    def open(self, setting):
        self.file, self.count = open(self.path, "w", newline=""), 0
        self.rows = csv.writer(self.file)
        self.rows.writerow(["time", "lowest", f"of {setting.mesh.num_vertices}"])

    def write(self, frame):
        self.rows.writerow([f"{frame.time:.3f}", f"{frame.positions[:, 1].min():.6f}"])
        self.count += 1

    def close(self):
        self.file.close()


def test_a_format_of_ones_own_is_a_class_and_its_registration(again, tmp_path, monkeypatch):
    monkeypatch.setattr(writers.writer, "WRITERS", dict(writers.WRITERS))
    with pytest.raises(ValueError, match=r"must end in \.gif, .*\.npz, .*\.pvd, .*got 'a\.csv'"):
        run_and_write(again, 1, tmp_path / "a.csv")
    register(TableWriter)
    _, said, _ = run_and_write(again, 2, tmp_path / "a.csv")
    rows = list(csv.reader(open(tmp_path / "a.csv")))
    assert said == [f"{tmp_path / 'a.csv'}, 3 frames"] and [row[0] for row in rows[1:]] == ["0.000", "0.020", "0.040"]
    assert float(rows[3][1]) == pytest.approx(again.simulator.positions[:, 1].min(), abs=1e-6)

    class Another(TableWriter):
        pass

    with pytest.raises(ValueError, match="written by TableWriter already"):
        register(Another)
    register(TableWriter)  # once more is no other
    Another.suffixes = ("csv",)
    with pytest.raises(ValueError, match="suffixes"):
        register(Another)


def test_unknown_outputs_are_refused_before_anything_runs(tmp_path, monkeypatch, capsys):
    unrun = SimpleNamespace(advance=lambda: pytest.fail("ran"), scene=None)
    with pytest.raises(ValueError, match=r"must end in .*\.mp4, .*got 'a\.avi'; rename it"):
        run_and_write(unrun, 3, [tmp_path / "a.pvd", tmp_path / "a.avi"])
    assert not list(tmp_path.iterdir())
    monkeypatch.setattr("diffsim_ti.runtime.init", lambda *_: pytest.fail("ran"))
    TetrahedralMesh.create_cube(2).save(tmp_path / "cube.vtu")
    for output, text in (("a.avi", ".npz"), ("a_%d_%d.png", "%04d")):
        with pytest.raises(SystemExit) as stop:
            app.main(["simulate", str(tmp_path / "cube.vtu"), "-o", str(tmp_path / output)])
        said = capsys.readouterr().err
        assert stop.value.code == 2 and text in said and output in said and len(said.splitlines()) == 1


@pytest.mark.parametrize(
    "name, view, text",
    [
        ("a.gif", dict(colour="mass"), "must be one of"),
        ("a.gif", dict(fps=np.nan), "fps"),
        ("a.gif", dict(size=(8, 8)), "16 pixels"),
        ("a.mp4", dict(size=(161, 120)), "even"),
        ("a.gif", dict(elevation=90.0), "elevation"),
        ("a.gif", dict(backend="opengl"), "backend"),
        ("a.gif", dict(fit="middle"), "fit"),
    ],
)
def test_bad_views_are_refused(name, view, text):
    with pytest.raises(ValueError, match=text):
        writer_for(name, View(**view))


def test_a_field_that_a_frame_lacks_is_named(tmp_path):
    cube = TetrahedralMesh.create_cube(2)
    writer, zero = writer_for(tmp_path / "a.gif", View(colour="J")), np.zeros((8, 3))
    writer.open(Setting(cube))
    with pytest.raises(ValueError, match="must hold J, it holds speed"):
        writer.write(Frame(0.0, cube.vertices, zero, zero, {"speed": np.zeros(8)}))


def test_what_was_run_before_an_error_is_written(again, tmp_path, monkeypatch):
    advance = again.advance

    def fail_later():
        if again.simulator.step_count >= 2 * again.parts:
            raise FloatingPointError("unstable")
        advance()

    monkeypatch.setattr(again, "advance", fail_later)
    with pytest.raises(FloatingPointError, match="unstable"):
        run_and_write(again, 9, [tmp_path / "a.npz", writer_for(tmp_path / "a.gif", View(size=SIZE))])
    assert len(np.load(tmp_path / "a.npz")["time"]) == len(imageio.mimread(tmp_path / "a.gif")) == 3


def test_a_loop_of_ones_own_writes_too(again, tmp_path):
    """And a writer that is opened again starts anew."""
    sim = again.simulator
    for steps in (3, 2):
        with open_writer(tmp_path / "b.pvd", again.scene) as out:
            for _ in range(steps):
                sim.step()
                out.write(Frame.of(sim))
        assert len(SavedSeries(tmp_path / "b.pvd")) == steps
    last = meshio.read(tmp_path / "b_0001.vtu")
    assert np.array_equal(last.points, sim.positions.astype(float)) and last.point_data["fixed"].sum() == 9


def test_folders_have_no_suffix_or_are_there(tmp_path):
    (tmp_path / "v1.5").mkdir()
    assert file_in(tmp_path / "out", "a.pvd") == tmp_path / "out" / "a.pvd"
    assert file_in(tmp_path / "v1.5", "a.pvd") == tmp_path / "v1.5" / "a.pvd"
    assert file_in(tmp_path / "a.gif", "a.pvd") == tmp_path / "a.gif"


def test_results_of_a_rollout_are_written(tmp_path):
    """Each output that every vertex or tetrahedron has, tensors row by row; others are not."""
    scene = ds.Scene(
        TetrahedralMesh.create_cube(3),
        ds.StableNeoHookean(1e5, 0.3),
        terms=[ds.Gravity(), ds.Ground(-0.005, 1e4, width=0.01)],
        precision="f64",
    )
    named = [ds.ContactForce(scene.terms[1], per_vertex=True), ds.ContactForce(scene.terms[1], name="sum"), ds.Stress()]
    named += [ds.Stress("principal", at="vertices", principal=True)]
    frames = ds.Rollout(ds.SemiImplicitSolver(scene, dt=1e-3), 4, save_every=2, outputs=named).forward()
    with open_writer(tmp_path / "run.pvd", scene) as out:
        for k in range(3):
            out.write(Frame.of_run(scene, frames, k))
    last = meshio.read(tmp_path / "run_0002.vtu")
    assert np.array_equal(last.point_data["contact_force"], frames["contact_force"][2]) and frames["sum"][2, 1] > 0
    assert np.array_equal(last.point_data["principal"], frames["principal"][2]) and "sum" not in last.point_data
    assert np.array_equal(last.cell_data["stress"][0].reshape(-1, 3, 3), frames["stress"][2])
    assert len(SavedSeries(tmp_path / "run.pvd").frame(2).positions) == scene.mesh.num_vertices
    simulator = ds.Simulator(ds.SemiImplicitSolver(scene, dt=1e-3))
    simulator.run(4)
    for name, values in Frame.of(simulator).colours.items():
        if name != "energy_density":
            np.testing.assert_allclose(Frame.of_run(scene, frames, 2).fields[name], values, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("law", [ds.StableNeoHookean(1e5, 0.3), ds.Prony(ds.StableNeoHookean(1e5, 0.3), [0.5], [0.1])])
def test_defaults_draw_frames_of_a_rollout(tmp_path, law):
    """By von Mises stress where a law's stress is a function of places, else by displacement."""
    scene = ds.Scene(TetrahedralMesh.create_cube(3), law, fixed="ymin", terms=[ds.Gravity()], precision="f64")
    frames = ds.Rollout(ds.SemiImplicitSolver(scene, dt=1e-3), 0).forward()
    with open_writer(tmp_path / "run.png", scene, View(size=(64, 48))) as out:
        out.write(Frame.of_run(scene, frames, 0))
    assert (tmp_path / "run.png").stat().st_size > 100
