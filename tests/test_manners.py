"""Warnings, log records, and what objects say of themselves where a user meets them: on a line, in a notebook."""

import base64
import io
import logging
import pickle
import re
import runpy
import warnings
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import PIL.Image
import pytest
import torch

import diffsim_ti as ds
from diffsim_ti import notebook
from diffsim_ti.common import progress
from diffsim_ti.common.warn import warn
from diffsim_ti.monitor.quantities import TetrahedronFields
from diffsim_ti.torch_bridge.rollout_node import rollout_frames
from diffsim_ti.verify import GradientCheck, GradientReport
from diffsim_ti.writers import WRITERS, Frame, Setting, View, open_writer, save_frames

PACKAGE = Path(__file__).parent.parent / "diffsim_ti"

# each line of a user that is warned of, and what it says
SCRIPT = """
import numpy as np
import torch

import diffsim_ti as ds
from diffsim_ti.diff_physics import conjugate_gradient
from diffsim_ti.optimization import load_state, save_state
from diffsim_ti.torch_bridge.step_sizes import bounded
from diffsim_ti.torch_bridge.rollout_node import rollout_frames

corners, one = np.eye(4, 3), [[0, 1, 2, 3]]
corners = np.roll(corners, 1, 0)
soft = ds.StableNeoHookean(1e5, 0.3)
ds.TetrahedralMesh(np.vstack([corners, [2.0, 2.0, 2.0]]), one)  # in no tetrahedron
flat = ds.TetrahedralMesh(corners * [1, 1, 1e-3], one)  # sliver
mesh = ds.TetrahedralMesh(corners, one, vertex_sets={"held": [0]})
mesh.scaled([1, 1, 1e-3])  # sliver
mesh.save(FOLDER / "body.mesh")  # cannot keep the sets held
two = ds.TetrahedralMesh.joined([mesh, mesh.translated([3, 0, 0])])
ds.Scene(two, soft, fixed="held")  # contains 2 bodies
ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.49))  # tetrahedra lock
ds.Scene(mesh, soft, precision="f32", initial_positions=mesh.vertices + 1e6)  # float32 resolves
floor, above = ds.Ground(1e5, stiffness_per_area=1e6), mesh.vertices + [0, 100001, 0]
ds.Scene(mesh, soft, terms=floor, precision="f32", initial_positions=above)  # float32
ds.Measurement("positions", np.float32([[1e6]]), noise=1e-3)  # float32 rounds
faces = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
ds.MeshObstacle(np.float32(corners + 1e6), faces, width=0.01)  # float32 resolves vertices
ds.SemiImplicitSolver(mesh, soft, dt=0.1, substeps=1)  # is divided into
conjugate_gradient(lambda v: -v, torch.ones(3))  # not positive definite
conjugate_gradient(lambda v: v * torch.arange(1.0, 4.0), torch.ones(3), max_iters=1, atol=1e-12)  # did not converge
bounded(torch.tensor(2.0), 0.0, 1.0, "nu")  # has left
ds.TieLength  # is called diffsim_ti.Length
for k in (1.0, 2.0):
    save_state(FOLDER / "run.state", mesh, {"k": k})
(FOLDER / "run.state").write_bytes(b"")
load_state(FOLDER / "run.state", mesh)  # using
scene = ds.Scene(mesh, soft, terms=ds.Gravity(), precision="f64")
limit = ds.stable_dt(scene).dt
rollout = ds.Rollout(ds.SemiImplicitSolver(scene, dt=1.3 * limit, allow_unstable=True), 40)
frames = rollout.forward()
rollout.vjp(frames, positions=np.random.default_rng(0).normal(size=frames.positions.shape))  # the adjoint grew
velocities = torch.zeros(mesh.vertices.shape, requires_grad=True)
loss = (rollout_frames(rollout, initial_velocities=velocities).positions[-1] * torch.arange(1.0, 13.0).reshape(4, 3)).sum()
loss.backward()  # the adjoint grew
"""


def test_warnings_point_at_the_line_of_the_user(tmp_path):
    """Of a script of theirs, through constructors, functions and torch; test_layout.py: no other way leads to a warning."""
    path = tmp_path / "users_script.py"
    path.write_text(SCRIPT)
    expected = [(k, line.split("  # ")[1]) for k, line in enumerate(SCRIPT.split("\n"), 1) if "  # " in line]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        runpy.run_path(str(path), {"FOLDER": tmp_path})
    ours = [said for said in caught if said.filename == str(path)]
    assert len(expected) == 18 and not [said for said in caught if str(PACKAGE) in said.filename]
    for line, words in expected:
        assert any(said.lineno == line and words in str(said.message) for said in ours), (line, words)
    assert {said.lineno for said in ours} == {line for line, _ in expected}


def test_a_loop_is_warned_once_of_each_kind():
    """Where a message differs in its numbers alone; at another line, of another kind, and under other filters again."""

    def said(action: str, times: int = 3) -> list[str]:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter(action)
            for k in range(times):
                warn(f"{k} slivers, worst {10.0**-k:.3g} m")
                warn(f"vertex {k} is loose")
            warn("9 slivers, worst 9 m")
        return [str(w.message) for w in caught]

    assert said("default") == ["0 slivers, worst 1 m", "vertex 0 is loose", "9 slivers, worst 9 m"]
    assert len(said("always")) == 7 and len(said("default")) == 3 and not said("ignore")
    with pytest.raises(UserWarning, match="0 slivers"):
        said("error")


def test_users_may_silence_a_warning_by_its_words():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", "vertex")
        warn("vertex 1 is loose")


# ---- logging ----------------------------------------------------------------------------------------------------------


def test_long_work_says_how_far_it_is(caplog, capfd, monkeypatch):
    monkeypatch.setattr(progress, "EVERY", 0.0)
    scene = ds.Scene(ds.TetrahedralMesh.create_cube(2), ds.StableNeoHookean(1e5, 0.3), terms=ds.Gravity(), fixed="ymin")
    with caplog.at_level(logging.INFO, "diffsim_ti"):
        seen = ds.Rollout(ds.StaticSolver(scene), 1).forward(youngs_modulus=8e4)
        rollout = ds.Rollout(ds.StaticSolver(scene), 1)
        ds.identify(rollout, {"positions": seen.positions}, {"youngs_modulus": 1e5}, noise=1e-4, check_mesh=False)
    said = [record.getMessage() for record in caplog.records if record.name == "diffsim_ti"]
    assert any(re.fullmatch(r"step 0: \d+ Newton iterations, residual \S+", line) for line in said)
    assert any(re.match(r"identify: 1 of 50, chi\^2 .* youngs_modulus", line) for line in said)
    monkeypatch.setattr(progress, "EVERY", 3600.0)
    caplog.clear()
    with caplog.at_level(logging.INFO, "diffsim_ti"):
        rollout.forward()
    assert not caplog.records and capfd.readouterr() == ("", "")


# ---- what objects say of themselves -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def objects() -> dict:
    """One of each kind, with more numbers than anyone reads."""
    mesh = ds.TetrahedralMesh.create_cube(4, 0.2)
    each = np.linspace(1e5, 2e5, mesh.num_tetrahedra)
    terms = [ds.Gravity(), ds.ExternalForce(np.full((mesh.num_vertices, 3), 1e-3))]
    scene = ds.Scene(mesh, ds.StableNeoHookean(each, 0.3), terms=terms, fixed="ymin")
    solver = ds.StaticSolver(scene)
    rollout, batch = ds.Rollout(solver, 2, save_every=1, outputs=ds.Stress()), ds.Batch(solver, 1, 2)
    frames, modes, test = rollout.forward(), ds.modes(scene, 12), ds.ModalTest(scene, 12)
    found = ds.identify(test, {"frequencies": modes.frequencies}, {"density": 900.0}, noise=1e-3, check_mesh=False)
    return dict(
        mesh=mesh,
        scene=scene,
        solver=solver,
        rollout=rollout,
        frames=frames,
        end=ds.Rollout(solver, 1).forward(),
        run=frames.run,
        unpickled=pickle.loads(pickle.dumps(frames)),
        simulator=ds.Simulator(solver),
        fields=TetrahedronFields(each, each, each),
        batch=batch,
        of_batch=batch.forward(density=np.array([900.0, 1000.0])),
        tensors=rollout_frames(rollout, density=torch.tensor(900.0)),
        batch_tensors=rollout_frames(batch, density=torch.tensor([900.0, 1000.0])),
        modes=modes,
        modal_test=test,
        found=found,
        information=found.information,
        expected=ds.expected(test, "frequencies", {"density": 900.0}, noise=1e-3),
        measurement=ds.Measurement("positions", frames.positions, 1e-3),
        unknown=ds.Unknown(each),
        report=rollout.report,
        gradients=GradientReport([GradientCheck("density", 1.0, 1.0, 1e-9, 1e-8, 2.0, "right", "")]),
        frame=Frame.of_run(scene, frames),
        setting=Setting.of(scene),
    )


def test_reprs_are_one_screen_without_arrays(objects):
    for name, x in objects.items():
        said = repr(x)
        assert len(said) < 1200 and said.count("\n") < 20, name
        assert " object at 0x" not in said and "array([" not in said and "tensor([" not in said, (name, said)
    assert repr(objects["frames"]).startswith("Frames(positions=(3, 64, 3) from -")
    assert "velocities=(3, 64, 3) all 0, " in repr(objects["frames"])
    assert "scene" not in repr(objects["simulator"]) and "step 0, t = 0 s" in repr(objects["simulator"])
    assert repr(objects["unknown"]) == "Unknown(start=(162,) from 1e+05 to 2e+05)"


def test_a_notebook_shows_tables_pictures_and_films(objects):
    shown = {name: x._repr_html_() for name, x in objects.items() if type(x) in notebook.FORMS}
    assert {type(objects[name]) for name in shown} == set(notebook.FORMS)
    for name, html in shown.items():
        ElementTree.fromstring(f"<div>{html}</div>")
        assert len(html) < 4e5 and "<table" in html, name
    kinds = {name: re.findall(r"data:image/(\w+);base64,([^\"]+)", html) for name, html in shown.items()}
    assert {name for name, found in kinds.items() if found} == {"mesh", "scene", "simulator", "frames", "end"}
    for name, found in kinds.items():
        for kind, data in found:
            image = PIL.Image.open(io.BytesIO(base64.b64decode(data)))
            assert image.format.lower() == kind and image.size == notebook.SIZE
            assert getattr(image, "n_frames", 1) == (3 if name == "frames" else 1)
    assert "Poisson" not in shown["found"] and "density" in shown["found"] and "95 %" in shown["found"]


@pytest.mark.parametrize("suffix", sorted({kind.suffixes[0] for kind in WRITERS.values()}))
def test_writers_work_with_their_defaults(objects, tmp_path, suffix):
    """`View()` and the last frame."""
    with open_writer(tmp_path / f"run{suffix}", objects["scene"], View()) as out:
        out.write(Frame.of_run(objects["scene"], objects["frames"]))
    assert out.count == 1 and (tmp_path / f"run{suffix}").stat().st_size > 100


def test_a_run_is_saved_in_a_line(objects, tmp_path):
    assert save_frames(tmp_path / "run.npz", objects["frames"]).count == 3
    np.testing.assert_array_equal(np.load(tmp_path / "run.npz")["positions"], objects["frames"].positions)
    with pytest.raises(ValueError, match="a copy by pickle has no scene: write each by open_writer"):
        save_frames(tmp_path / "run.npz", objects["unpickled"])
