"""What a hard use from outside met: foreign locales, odd numbers, Ctrl-C at any moment, threads, copies by pickle."""

import os
import pickle
import signal
import subprocess
import sys
import time
from xml.etree import ElementTree

import numpy as np
import pytest
from test_cli import fails

import diffsim_ti as ds
from diffsim_ti.common import interrupts
from diffsim_ti.film import render_series
from diffsim_ti.visual.frame import Frame, Setting
from diffsim_ti.visual.series import SavedSeries
from diffsim_ti.writers import ParaViewWriter

CUBE = ds.TetrahedralMesh.create_cube(2)


def series(path, name="force"):
    """A series of one frame at rest, with a field of that name."""
    still = np.zeros_like(CUBE.vertices)
    writer = ParaViewWriter(path)
    writer.open(Setting(CUBE))
    writer.write(Frame(0.0, CUBE.vertices, still, still, {name: still}, units={name: "N"}))
    return writer.path


# ---- series -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["körper", os.fsdecode("körper".encode("latin-1")), os.fsdecode(b"a\x01")])
def test_a_series_is_valid_xml_whatever_the_locale_made_of_its_name(tmp_path, name):
    path = series(tmp_path / f"{name}.pvd", name)
    for file in tmp_path.iterdir():
        ElementTree.fromstring(file.read_bytes())
    assert len(SavedSeries(path)) == 1 and len(SavedSeries(path).frame(0).positions) == 8


def test_a_series_of_the_c_locale_is_valid_xml(tmp_path):
    CUBE.save(tmp_path / "cube.vtu")
    (tmp_path / "cube.vtu").rename(tmp_path / "körper.vtu")
    environment = os.environ | dict(LC_ALL="C", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0")
    command = [sys.executable, "-m", "diffsim_ti", "simulate", tmp_path / "körper.vtu", "--duration", ".01", "-o"]
    subprocess.run([*command, tmp_path / "körper.pvd"], check=True, env=environment, capture_output=True)
    assert "körper_0001.vtu" in ElementTree.parse(tmp_path / "körper.pvd").getroot()[0][1].attrib["file"]
    assert len(SavedSeries(tmp_path / "körper.pvd")) == 2


@pytest.mark.parametrize(
    "content, said",
    [
        ("<a/>", "no <Collection>"),
        ("solid body", "syntax error"),
        ("<VTKFile><Collection><DataSet timestep='x' file='b.vtu'/></Collection></VTKFile>", "could not convert"),
        ("<VTKFile><Collection><DataSet timestep='0'/></Collection></VTKFile>", "an entry without 'file'"),
        ("<VTKFile><Collection/></VTKFile>", "lists none"),
    ],
)
def test_what_is_no_series_is_said(capsys, tmp_path, content, said):
    (tmp_path / "a.pvd").write_text(content)
    line = fails(capsys, "render", tmp_path / "a.pvd", "-o", tmp_path / "a.png")
    assert "a.pvd" in line and said in line
    assert "take the .pvd that a run" in line or "run the simulation first" in line


def test_a_series_that_is_missing_or_foreign_is_said(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.pvd: no such series; take the \.pvd"):
        render_series(tmp_path / "none.pvd", tmp_path / "a.png")
    path = series(tmp_path / "a.pvd")
    CUBE.save(tmp_path / "a_0000.vtu")
    with pytest.raises(ValueError, match=r"a_0000\.vtu, a file of the series.*must hold 'displacement'"):
        render_series(path, tmp_path / "a.png")


# ---- the command line -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options, said",
    [
        (("--fps", "1e300"), "makes 1e+300 frames"),
        (("--fps", "1e-300"), "fps: must be from 0.01 to 1e6"),
        (("--dt", "1e-300"), "takes 1e+300 steps"),
        (("--duration", "1e8", "--fps", ".01"), "days: shorten it"),
        (("--size", "inf"), "--size must be > 0 and finite"),
    ],
)
def test_runs_without_an_end_are_refused(capsys, tmp_path, options, said):
    CUBE.save(tmp_path / "cube.vtu")
    assert said in fails(capsys, "simulate", tmp_path / "cube.vtu", "-o", tmp_path, *options)


@pytest.mark.parametrize("fps", ["inf", "1e300", "1e-300"])
def test_films_of_odd_speeds_are_refused(capsys, tmp_path, fps):
    assert "fps: must be from" in fails(capsys, "render", series(tmp_path / "a.pvd"), "--fps", fps)


SAYS_THAT_IT_IS_GUARDED = """
import signal

set_handler = signal.signal


def guarded(*choice):
    signal.signal = set_handler
    set_handler(*choice)
    print("started", flush=True)


signal.signal = guarded
"""


@pytest.mark.parametrize("delay", [0.0, 0.6, 1.8])
def test_interrupts_at_any_moment_end_in_one_line(tmp_path, delay):
    CUBE.save(tmp_path / "cube.vtu")
    (tmp_path / "sitecustomize.py").write_text(SAYS_THAT_IT_IS_GUARDED)
    paths = [str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])]
    run = subprocess.Popen(
        [sys.executable, "-m", "diffsim_ti", "simulate", "cube.vtu", "--duration", "1000"],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert run.stdout.readline() == "started\n"  # until then it is Python's own matter
    time.sleep(delay)
    run.send_signal(signal.SIGINT)
    said = run.communicate(timeout=60)[1]
    assert run.returncode == 130 and "Traceback" not in said
    assert said.splitlines()[-1].startswith("error: interrupted")


def test_a_signal_just_before_a_command_has_ended_is_no_traceback(monkeypatch):
    """Python raises what it was sent while the handler is taken away."""
    kept, tries = signal.getsignal(signal.SIGINT), []

    def set_handler(*choice):
        tries.append(choice)
        if len(tries) < 3:
            raise KeyboardInterrupt
        return taken(*choice)

    taken = signal.signal
    taken(signal.SIGINT, signal.default_int_handler)  # a shell starts what it does not wait for without
    monkeypatch.setattr(interrupts, "_is_command", True)
    monkeypatch.setattr(interrupts.signal, "signal", set_handler)
    try:
        interrupts.command_ended()
        assert len(tries) == 3 and signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        taken(signal.SIGINT, kept)


ENDS_WITHIN_EXEC = """
import sys
sys.argv = ["diffsim-ti", "x"]
from diffsim_ti import interrupts

interrupts.commands_may_run()
try:
    exec("import os, signal; os.kill(os.getpid(), signal.SIGINT); [None for _ in range(10**6)]")
except KeyboardInterrupt:
    interrupts.command_ended()
    sys.exit(130)
"""


def test_a_signal_while_text_is_executed_ends_by_the_exit_code_too(tmp_path):
    """As while a dataclass is made, of a command that runs as a module."""
    (tmp_path / "ends.py").write_text(ENDS_WITHIN_EXEC)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    reset = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)  # noqa: E731
    run = [sys.executable, "-m", "ends"]
    assert subprocess.run(run, env=environment, preexec_fn=reset).returncode == 130


def test_a_signal_at_any_line_of_a_command_is_exit_code_130(monkeypatch, capsys):
    """Of what begins and ends a command; what happens within is another matter (above)."""
    from diffsim_ti.cli import app

    now = [signal.default_int_handler]
    monkeypatch.setattr(interrupts, "_is_command", True)
    monkeypatch.setattr(interrupts.signal, "getsignal", lambda _: now[0])
    monkeypatch.setattr(interrupts.signal, "signal", lambda _, handler: now.__setitem__(0, handler))
    lines, wanted = [0], [0]

    def watch(frame, event, _):
        if frame.f_code.co_name in ("main", "_ran", "command_ended") and "diffsim_ti" in frame.f_code.co_filename:
            if event == "line" and now[0] is interrupts._raise:
                lines[0] += 1
                if lines[0] == wanted[0]:
                    interrupts._raise()
            return watch

    codes, before = [], sys.gettrace()
    for wanted[0] in range(1, 100):
        lines[0], now[0] = 0, signal.default_int_handler
        sys.settrace(watch)
        try:
            app.main(["simulate", "no.msh"])
        except SystemExit as end:
            codes.append(end.code)
        finally:
            sys.settrace(before)
        if lines[0] < wanted[0]:
            break
    assert len(codes) > 8 and codes[-1] == 2 and set(codes[:-1]) == {130}
    assert "Traceback" not in capsys.readouterr().err


# ---- threads, restarts of Taichi, copies ------------------------------------------------------------------------------

IN_THREADS = """
import threading
import numpy as np
import diffsim_ti as ds

ds.init()
mesh, found = ds.TetrahedralMesh.create_cube(2), {}


def work(k, kind, law):
    simulator = ds.Simulator(kind(ds.Scene(mesh, law(1e4, 0.3), terms=[ds.Gravity()], fixed="xmin"), dt=1e-3))
    simulator.run(3)
    simulator.tetrahedron_fields()
    found[k] = simulator.positions


jobs = [(ds.VelocityVerletSolver, ds.StableNeoHookean), (ds.BDF2Solver, ds.Corotated)]
for rounds in ((0, 1), (2, 3)):
    threads = [threading.Thread(target=work, args=(k, *jobs[k % 2])) for k in rounds]
    for thread in threads:
        thread.start()
        if rounds[0]:  # one after the other
            thread.join()
    for thread in threads:
        thread.join()
assert all(np.array_equal(found[k], found[k + 2]) for k in (0, 1))
"""


def test_threads_take_turns(tmp_path):
    environment = os.environ | dict(TI_OFFLINE_CACHE_FILE_PATH=str(tmp_path))  # so that they compile
    done = subprocess.run([sys.executable, "-c", IN_THREADS], env=environment, capture_output=True, text=True)
    assert done.returncode == 0 and not done.stderr, done.stderr


def moved(t):
    return [0.01 * t, 0.0, 0.0]


def test_scenes_solvers_and_rollouts_are_copied_by_pickle():
    path = ([0.0, 1.0], [[0, 0, 0], [0, 0.1, 0]])
    terms = [ds.Gravity(), ds.Sphere([0, -3, 0], 1.0, path=path), ds.Spring(0, 7, 10.0), ds.Cable([0, 5], 1.0)]
    scene = ds.Scene(CUBE, ds.StableNeoHookean(1e4, 0.3), 1e3, terms, "xmin", moved, precision="f64")
    rollout = ds.Rollout(ds.VelocityVerletSolver(scene, dt=1e-2, substeps=3), [1e-2, 2e-2], gradients="all")
    again = pickle.loads(pickle.dumps(rollout))
    first, second = rollout.forward(), pickle.loads(pickle.dumps(again.forward()))
    assert np.array_equal(first.positions, second.positions) and again.wanted == rollout.wanted
    assert first.contact_resolution == second.contact_resolution
    solver = pickle.loads(pickle.dumps(ds.BDF2Solver(scene, dt=1e-2, tolerance=1e-7)))
    assert solver.tolerance == 1e-7 and solver.scene.precision == "f64" and len(solver.scene.terms) == 4


def test_what_does_not_pickle_says_what_to_do():
    scene = ds.Scene(CUBE, ds.StableNeoHookean(1e4, 0.3), fixed="xmin", motion=lambda t: [t, 0, 0])
    with pytest.raises(TypeError, match=r"its motion is .*lambda.*define the function in a module, or give keyframes"):
        pickle.dumps(scene)
    with pytest.raises(TypeError, match=r"pickle its solver and its state"):
        pickle.dumps(ds.Simulator(ds.VelocityVerletSolver(scene, dt=1e-3)))


def test_errors_pickle_with_what_they_carry():
    for error in (
        ds.Divergence("a", 3, 1, 2, 0.5),
        ds.Crossing("a", 3, 1, 0.5, 0.1, 2.0, None),
        ds.NotConverged("a", [1.0, 0.5]),
        ds.EnergyGained("a", 1.0, 0.5, 3, 0.1, 0.01),
        ds.Buckled("a", 3, 1, 2),
    ):
        again = pickle.loads(pickle.dumps(error))
        assert type(again) is type(error) and str(again) == "a" and vars(again) == vars(error)


def test_a_checkpoint_without_its_keys_says_which(tmp_path):
    torch = pytest.importorskip("torch")
    from diffsim_ti.optimization import Optimization, save_state

    module = torch.nn.Linear(1, 1)
    for state, said in (({"iteration": 3}, r"a state without losses, seconds"), ([1], "holds a list")):
        save_state(tmp_path / "state", CUBE, state)
        with pytest.raises(ValueError, match=said):
            Optimization(module, torch.optim.SGD(module.parameters(), 0.1), CUBE, tmp_path / "state")
        (tmp_path / "state").unlink()


# ---- files and messages -----------------------------------------------------------------------------------------------

GMSH_1 = """$NOD
5
1 0 0 0
2 1 0 0
3 0 1 0
10 0 0 1
11 1 1 1
$ENDNOD
$ELM
4
1 15 5 5 1 1
2 2 7 7 3 1 2 3
3 4 9 9 4 1 2 3 10
4 4 8 9 4 2 3 10 11
$ENDELM
"""


def test_gmsh_1_files_are_read_with_their_groups(tmp_path):
    (tmp_path / "a.msh").write_text(GMSH_1)
    mesh = ds.TetrahedralMesh.from_file(tmp_path / "a.msh")
    assert mesh.num_tetrahedra == 2 and mesh.num_vertices == 5
    assert mesh.tetrahedron_sets["tag_8"].tolist() == [1] and mesh.vertex_sets["tag_5"].tolist() == [0]
    assert mesh.vertex_sets["tag_7"].tolist() == [0, 1, 2]


@pytest.mark.parametrize(
    "old, new, said",
    [
        ("$ENDELM", "", "needs .*ENDELM"),
        ("3 4 9 9 4 1 2 3 10", "3 4 9 9 4 1 2 3 12", "has node 12"),
        ("11 1 1 1\n$ENDNOD\n", "11 1 1", "no complete Gmsh file"),
    ],
)
def test_gmsh_1_files_that_are_damaged_say_so(tmp_path, old, new, said):
    (tmp_path / "a.msh").write_text(GMSH_1.replace(old, new))
    with pytest.raises(ValueError, match=said):
        ds.TetrahedralMesh.from_file(tmp_path / "a.msh")


def test_messages_lead_to_what_works():
    soft = ds.Scene(CUBE, ds.StableNeoHookean(1e-300, 0.3), precision="f32")
    with pytest.raises(FloatingPointError, match=r"stiffness of this state is zero .* check Young's"):
        ds.stable_dt(soft)
    for how in ((0,), [[0, 1]], ("a",)):
        with pytest.raises(ValueError, match='letters, such as "x"|must be numbers'):
            ds.Scene(CUBE, ds.StableNeoHookean(1e4, 0.3), fixed={"xmin": how})
    with pytest.raises(ValueError, match=r"indices must be integers.*whole numbers, such as \[0, 3\]"):
        ds.Scene(CUBE, ds.StableNeoHookean(1e4, 0.3), fixed=(0.5,))
    pressed = ds.Scene(CUBE, ds.StableNeoHookean(1e4, 0.3), 1e3, [ds.Gravity(-300.0)], "ymin", precision="f64")
    with pytest.raises(ds.NotConverged, match=r"unstable \(it buckles or snaps\).* by ImplicitEulerSolver with Drag"):
        ds.Rollout(ds.StaticSolver(pressed, max_iterations=1, tolerance=1e-12), 1).forward()
