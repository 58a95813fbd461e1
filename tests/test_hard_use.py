"""What a hard use from outside met: foreign locales, odd numbers, Ctrl-C at any moment, threads, copies by pickle."""

import os
import signal
import subprocess
import sys
import time
from xml.etree import ElementTree

import numpy as np
import pytest
from test_cli import fails

import diffsim_ti as ds
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
        (("--fps", "1e-300"), "fps: must be from .01 to 1e6"),
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


@pytest.mark.parametrize("delay", [0.3, 0.9, 1.6, 2.4])
def test_interrupts_at_any_moment_end_in_one_line(tmp_path, delay):
    CUBE.save(tmp_path / "cube.vtu")
    command = [sys.executable, "-m", "diffsim_ti", "simulate", "cube.vtu", "--duration", "1000"]
    run = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    time.sleep(delay)
    run.send_signal(signal.SIGINT)
    said = run.communicate(timeout=60)[1]
    assert run.returncode == 130 and "Traceback" not in said
    assert said.splitlines()[-1].startswith("error: interrupted")
