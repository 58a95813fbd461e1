"""What the peers are told is the problem as it is, and what is made of their answers is right; none needs be installed."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import diffsim_ti as ds
from diffsim_ti.study import problem

sys.path.insert(0, str(Path(__file__).parents[1] / "examples" / "benchmarks"))
sys.path.insert(0, str(Path(__file__).parents[1] / "examples" / "benchmarks" / "peers"))

sys.path.insert(0, str(Path(__file__).parents[1] / "examples" / "benchmarks" / "public"))

import all_peers  # noqa: E402
import compare_peers  # noqa: E402
import diffpd_identification  # noqa: E402
import gradient_quality  # noqa: E402
import table  # noqa: E402
from job import Job  # noqa: E402
from peers import work  # noqa: E402

# a peer of our own hand: symplectic Euler in NumPy, no gradients
NUMPY_PEER = """
import numpy as np
from job import answer_all, timed

def work(job):
    B, W = np.linalg.inv(job.rest_edges), job.volumes
    def run():
        x, v, seen = job.start.copy(), job.velocities.copy(), [job.start]
        for s in range(job.frames * job.substeps):
            F = np.moveaxis(job.edges(x), 1, 2) @ B
            J, C = np.linalg.det(F), np.linalg.det(F)[:, None, None] * np.linalg.inv(F).swapaxes(1, 2)
            m, k = 4 * job.mu / 3, job.lam + 5 * job.mu / 6
            P = (m * (1 - 1 / ((F * F).sum((1, 2)) + 1)))[:, None, None] * F + (k * (J - 1) - 0.75 * m)[:, None, None] * C
            h = np.swapaxes(-W[:, None, None] * (P @ B.swapaxes(1, 2)), 1, 2)
            f = np.zeros_like(x)
            np.add.at(f, job.tetrahedra, np.concatenate([-h.sum(1, keepdims=True), h], 1))
            f[:, 1] += job.gravity * job.masses
            v = job.keep * (v + job.h * f / job.masses[:, None])
            v[job.fixed] = 0
            x = x + job.h * v
            if (s + 1) % job.substeps == 0:
                seen.append(x)
        return np.stack(seen)
    seconds, x = timed(run, job.repeats)
    return seconds, x, {}

answer_all(work)
"""


def test_tables_have_whole_numbers_where_they_are_large():
    best = {("diffsim_ti", 750): [3.217, 68.4], ("JAX", 750): [1260.2, 684.0]}
    assert compare_peers.common_table(best).splitlines()[2:] == [
        "| diffsim_ti | 3.22 | 68.4 |",
        "| JAX | 1260 (391.7x) | 684 (10.0x) |",
    ]


def test_many_bodies_are_pieces_of_one(tmp_path):
    asked = problem("lame-gradient")
    scene = asked.scene(asked.cells[0], asked.patterns[0], "f64")
    np.savez(tmp_path / "a.job.npz", **work.problem_job(asked, scene, 3), worlds=3)
    one = Job(str(tmp_path / "a.job.npz"))
    all_of_them, n = one.in_one(), len(one.vertices)
    for b in range(3):
        piece = slice(b * n, (b + 1) * n)
        np.testing.assert_array_equal(all_of_them.start[piece], one.start)
        np.testing.assert_array_equal(all_of_them.masses[piece], one.masses)
        own = all_of_them.tetrahedra[b * len(one.tetrahedra) :][: len(one.tetrahedra)]
        np.testing.assert_array_equal(own, one.tetrahedra + b * n)
    np.testing.assert_array_equal(all_of_them.edges(all_of_them.start)[: len(one.tetrahedra)], one.edges(one.start))
    positions = np.tile(one.start, (one.frames + 1, 3, 1))
    assert all_of_them.adjoints(positions).shape == positions.shape


@pytest.mark.parametrize("name", ["lame-gradient", "identify", "bounce-gradient"])
def test_a_job_is_the_problem(name, tmp_path):
    """Masses, moduli and the loss's gradient by the frames, from the file alone, are ours."""
    asked = problem(name)
    scene = asked.scene(asked.cells[0], asked.patterns[0], "f64")
    np.savez(tmp_path / "a.job.npz", **work.problem_job(asked, scene, 3))
    job = Job(str(tmp_path / "a.job.npz"))
    derived = scene.inputs.derive(scene.inputs.values)
    np.testing.assert_allclose(job.masses, derived.mass, rtol=1e-12)
    assert job.h * job.substeps * job.frames == pytest.approx(asked.duration) and job.differentiates
    u = np.random.default_rng(0).standard_normal((job.frames + 1, *job.vertices.shape))
    frames = SimpleNamespace(displacements=u, inputs=dict(rest_positions=scene.mesh.vertices))
    np.testing.assert_allclose(job.adjoints(job.vertices + u), asked.adjoint(frames, scene.mesh), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", ["lame", "beam"])
def test_another_code_finds_our_error(name, tmp_path, monkeypatch):
    """The same steps in NumPy, through files and a process: the error of our own run, to rounding of float32 starts."""
    (tmp_path / "run_numpy.py").write_text(NUMPY_PEER)
    monkeypatch.setattr(work, "HERE", tmp_path)
    monkeypatch.setitem(work.PEERS, "NumPy", ("run_numpy.py", "numpy"))
    monkeypatch.setenv("PYTHONPATH", str(Path(work.__file__).parent))
    asked = problem(name)
    right = asked.exact if asked.exact is not None else np.zeros((asked.frames + 1, 3)) + 0.4
    [(seconds, error)] = work.peer_points(asked, "NumPy", sys.executable, (2,), right=lambda n: right)
    scene = asked.scene(2, asked.patterns[0], "f64")
    substeps = work.first_substeps(asked, scene)
    solver = ds.SemiImplicitSolver(scene, dt=asked.duration / asked.frames, substeps=substeps)
    ours = asked.quantity(ds.Rollout(solver, asked.frames, save_every=1).forward(), {})
    assert seconds > 0
    assert error == pytest.approx(work.distance(asked, ours, right), rel=1e-4)


def test_a_peer_that_fails_is_told_and_left_out(tmp_path, monkeypatch, capsys):
    (tmp_path / "run_broken.py").write_text("raise SystemExit('no such device')")
    monkeypatch.setattr(work, "HERE", tmp_path)
    monkeypatch.setitem(work.PEERS, "Broken", ("run_broken.py", "numpy"))
    assert work.peer_points(problem("lame"), "Broken", sys.executable, (2,)) == []
    assert "no such device" in capsys.readouterr().err
    monkeypatch.setitem(work.PEERS, "Absent", ("run_broken.py", "no_such_module"))
    assert "Absent" not in work.installed(sys.executable) and "Broken" in work.installed(sys.executable)


def test_table_and_picture_of_equal_accuracy(tmp_path):
    found = {f"problem {k}": {"diffsim_ti": [(0.1, 1e-1), (1.0, 5e-4)], "JAX": [(4.0, 5e-3)]} for k in range(4)}
    table = compare_peers.accuracy_table(found)
    assert "| problem 0 | 0.01 | 1 s (1x) | 4 s (4x) |" in table and "| 0.001 | 1 s (1x) | not reached |" in table
    compare_peers.draw(found, tmp_path / "peers.png")
    assert (tmp_path / "peers.png").stat().st_size > 10_000


def test_peers_are_installed_apart_or_left_out_with_the_reason(tmp_path, monkeypatch, capsys):
    """No version of NumPy is among those of peers, for ours stands beside them."""
    answers = {"JAX": ("python of JAX", ""), "Warp": ("", "no such version")}
    monkeypatch.setattr(
        compare_peers, "environment", lambda folder, name, *pins: answers[{"jax": "JAX", "warp": "Warp"}[name]]
    )
    pythons, reasons = compare_peers.interpreters(tmp_path, ["JAX", "Warp"])
    assert pythons == {"JAX": "python of JAX"} and reasons == ["Warp is left out: no such version."]
    told = capsys.readouterr().out
    assert f"JAX: {work.PINNED['JAX'][0]}" in told and "Warp is left out: no such version" in told
    assert set(work.PEERS) <= set(work.PINNED) and list(work.versions("Warp")) == ["warp-lang"]


def test_ratios_are_at_the_error_that_both_reach(tmp_path):
    """Of a peer that is four times as slow, and of one that wins by twice; who reaches nothing is in no mean."""
    ours = [(1.0, 1e-1), (2.0, 1e-2), (8.0, 1e-4)]
    found = {
        "slow": {"diffsim_ti": ours, "JAX": [(4.0, 1e-1), (8.0, 1e-2)], "Warp": []},
        "fast": {"diffsim_ti": ours, "JAX": [(1.0, 1e-2)]},
    }
    rows = all_peers.ratios(found)
    assert [(task, who, *times) for task, who, _, *times in rows] == [("slow", "JAX", 2, 8), ("fast", "JAX", 2, 1)]
    assert all_peers.mean_of(rows) == pytest.approx((2**0.5, 8**0.5))
    cells, said = all_peers.table_of(rows)
    assert cells[0][0] == "fast" and cells[0][-1] == "0.5" and "JAX 1.41 (2 tasks, spread 2.8)" in said
    all_peers.draw(found, rows, tmp_path / "all.png")
    assert (tmp_path / "all.png").stat().st_size > 10_000
    assert all_peers.unsolved(found) == ['Warp did not solve "slow".']


@pytest.mark.parametrize("words", [["--scenes", "1"], ["--tools", "Newton"], ["--show"], ["--quick"], []])
def test_a_partial_run_leaves_the_page(words, tmp_path, monkeypatch):
    """So does a run without --peers; with it, and all else as it comes, the table is written."""
    put = []
    monkeypatch.setattr(table, "put", lambda name, text: put.append(text))
    monkeypatch.setattr(gradient_quality, "interpreters", lambda *_: ({"Newton": ""}, ["torch-fem is left out: no."]))
    monkeypatch.setattr(gradient_quality, "measured", lambda *_: ([], ["a task, Newton: not done"]))
    for peers in [], ["--peers", str(tmp_path)]:
        monkeypatch.setattr(sys, "argv", ["gradient_quality.py", *words, *peers])
        gradient_quality.main()
    assert len(put) == (not words)
    if put:
        said = " ".join(put[0].split())
        assert "torch-fem is left out: no. a task, Newton: not done." in said and "newton 1.8.0" in said


def test_differences_of_order_six():
    """Exact to degree six; a gradient that is wrong by a factor keeps its cosine and shows its error."""
    sixth, fourth = gradient_quality.central(
        np.array([np.polyval([1.0, 3.0, -2.0, 1.0, 5.0, 2.0], gradient_quality.OFFSETS)])
    )
    assert sixth == pytest.approx([5.0]) and abs(fourth[0] - 5.0) > 1
    exact = np.array([1.0, 2.0, -1.0])
    assert gradient_quality.compared(1.5 * exact, exact, exact) == pytest.approx((1.0, 0.5, 0.0))
    words = [gradient_quality.off_one(x) for x in (0.0, -2.2e-16, 3e-9, 0.5, np.nan)]
    assert words == ["1", "1", "1 - 3e-09", "0.50", "not finite"]


@pytest.mark.parametrize("task", gradient_quality.TASKS[3:5], ids=lambda task: task.name)
def test_gradients_of_ours_are_those_of_our_motion(task):
    """A thrown block with friction, and a beam at rest: to what differences of float64 tell."""
    ours = gradient_quality.moving_by_us if hasattr(task, "held") else gradient_quality.still_by_us
    [(cosine, error, doubt)] = ours("f64", task, [0])
    assert cosine > 1 - 1e-6 and error < max(1e-5, 10 * doubt) and doubt < 1e-2


def test_identifications_of_diffpd(capsys):
    """The truth is found from twice E; a search that does not arrive is told as that."""
    task = diffpd_identification.Task(diffpd_identification.cantilever(quick=True), 1)
    runs = diffpd_identification.by_identify(task, (2.08e6, 0.352))
    assert runs[0] and 4 <= runs[1] <= 40
    rows = diffpd_identification.rows_of({"cantilever": {"one": [runs], "none": [(False, 150, 9.0)]}})
    assert rows[0][2] == "1 of 1" and rows[1][2:] == ["0 of 1", "", ""]
