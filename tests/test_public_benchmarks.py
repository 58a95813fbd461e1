"""The scripts of examples/benchmarks/public in their quick form: their numbers are right, and the page stays as it is.

The longer ones are marked thorough, and CI runs them by a command of their own.
"""

import sys
from pathlib import Path

import numpy as np
import pytest

PUBLIC = Path(__file__).parents[1] / "examples" / "benchmarks" / "public"
sys.path.insert(0, str(PUBLIC))

import closed_forms  # noqa: E402
import ipc_corpus  # noqa: E402
import table  # noqa: E402
import torch_fem_suite  # noqa: E402
import vbd_beam  # noqa: E402


@pytest.fixture(autouse=True)
def page_stays():
    before = table.PAGE.read_bytes()
    yield
    assert table.PAGE.read_bytes() == before


def test_a_table_is_written_between_its_marks(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(table, "PAGE", tmp_path / "page.md")
    table.PAGE.write_text("before\n<!-- one -->\nold\n<!-- end of one -->\nafter\n")
    table.report("one", ("what", "seconds"), [("a", 0.12345), ("b", table.ratio(30.0, 10.0))], quick=True)
    assert "| a | 0.123 |" in capsys.readouterr().out and "old" in table.PAGE.read_text()
    table.report("one", ("what", "seconds"), [("a", 0.12345), ("b", table.ratio(30.0, 10.0))], quick=False, peer="1.2")
    text = table.PAGE.read_text()
    assert text.startswith("before\n<!-- one -->\n| what | seconds |\n") and text.endswith(
        "<!-- end of one -->\nafter\n"
    )
    assert "| b | 30 (3x) |" in text and "peer 1.2." in text and "old" not in text
    with pytest.raises(ValueError, match="has no <!-- two --> ... <!-- end of two -->: add both lines"):
        table.report("two", ("what",), [], quick=False)


def test_a_peer_says_why_it_did_not_run(tmp_path, monkeypatch):
    script = tmp_path / "broken.py"
    script.write_text("raise SystemExit('no such device')")
    assert table.asked(sys.executable, script) == {"error": "no such device"}
    assert "absent.py" in table.asked(sys.executable, script.with_name("absent.py"))["error"]
    monkeypatch.setattr(sys, "executable", "false")  # the command
    assert table.environment(tmp_path, "none", "a-package==1.0") == ("", "it failed and gave no reason")


def test_the_reason_is_what_pip_calls_an_error(tmp_path):
    """The lines after it are hints; and a last line that is not JSON is no answer."""
    script = tmp_path / "pip.py"
    script.write_text("import sys; sys.exit('looking\\nERROR: no such file\\n\\nHint: It looks like a path')")
    assert table.asked(sys.executable, script) == {"error": "ERROR: no such file"}
    script.write_text("print('done')")
    assert table.asked(sys.executable, script) == {"error": "its last line is not JSON: 'done'"}
    script.write_text("import time; time.sleep(60)")
    assert table.asked(sys.executable, script, timeout=0.5)["error"].startswith("not done after")


def test_meshes_are_searched_in_all_folders(tmp_path):
    """As they lie in the paper's repository; what is in none is said and ends no run."""
    surfaces = tmp_path / "surfaces"
    surfaces.mkdir()
    (surfaces / "spike.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    meshes = ipc_corpus.corpus.Meshes(str(tmp_path), str(surfaces))
    vertices, triangles = meshes.surface("spike")
    assert vertices.shape == (3, 3) and triangles.tolist() == [[0, 1, 2]]
    for name, lacking in (("spike on wedge.obj", "no wedge.obj in"), ("arch, friction 0.5", "no arch/")):
        assert ipc_corpus.result(name, meshes, 1, 1.0).startswith(f"not posed: {lacking}")
    nothing = ipc_corpus.corpus.Meshes()
    assert ipc_corpus.result("spike on hole.obj", nothing, 1, 1.0) == "needs a surface of the paper's repository"


def test_every_table_of_these_scripts_has_marks_on_the_page():
    page = table.PAGE.read_text()
    names = (
        "torch_fem_suite ipc_corpus vbd_beam vbd_contrast closed_forms diffpd_identification gradient_quality all_peers"
    )
    for name in names.split():
        assert f"<!-- {name} -->" in page and f"<!-- end of {name} -->" in page


@pytest.mark.thorough
def test_closed_forms():
    """On coarse meshes of ten nodes, one or two of which lie across what is bent."""
    rows = closed_forms.main(quick=True)
    assert len(rows) > 10
    for name, _, _, error, _, _ in rows:
        assert error < 10, name


@pytest.mark.thorough
def test_corpus_of_contact():
    rows, runs = ipc_corpus.main(quick=True)
    assert [run.done for run in runs] == list(ipc_corpus.QUICK.values())
    assert all(run.error is None and run.intersections == 0 for run in runs) and len(rows) == len(runs)


@pytest.mark.thorough
def test_beam_of_vertex_block_descent():
    """Linear elasticity stretches by rho g L^2 / 2 E, of which finite strains of this law make 3 % more."""
    first, second = vbd_beam.main(quick=True, peers=None)
    bar = 1e3 * vbd_beam.bar_extension()
    assert bar == pytest.approx(1e3 * 9810 / 2 / 1.25e5, rel=0.04) and bar > 1e3 * 9810 / 2 / 1.25e5
    free = [row for row in first if row[0].startswith("free sections")]
    assert len(free) == 2 and all(row[3] < 0.05 for row in free)
    held = [row for row in first if row[0].startswith("held")]
    assert all(1 < row[3] < 2 and row[4] < 1e-3 for row in held)  # of the end that cannot narrow
    assert all(row[2] < 1e-4 for row in second)


def test_problems_of_torch_fem():
    """A bar's force, more for its held end; and as compliance C goes as 1 / E, the derivatives times E add up to -C."""
    scene, solve = torch_fem_suite.cube(7)
    force, gradient = solve()
    assert force == pytest.approx(104, rel=0.01)
    [by_force] = gradient().values()
    assert by_force.shape == (343, 3) and np.abs(by_force[scene.mesh.vertex_sets["xmin"]]).max() == 0
    scene, solve = torch_fem_suite.topology(3)
    compliance, gradient = solve()
    moduli, rho, _ = torch_fem_suite.stiffness(3)
    slope = 70000.0 * (1 - 1e-3) * 3 * rho**2
    assert (gradient() / slope * moduli).sum() == pytest.approx(-compliance, rel=1e-6) and len(rho) == 54
