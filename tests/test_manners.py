"""Warnings, log records, and what objects say of themselves where a user meets them: on a line, in a notebook."""

import runpy
import warnings
from pathlib import Path

import pytest

from diffsim_ti.common.warn import warn

PACKAGE = Path(__file__).parent.parent / "diffsim_ti"

# each line of a user that is warned of, and what it says
SCRIPT = """
import numpy as np
import torch

import diffsim_ti as ds
from diffsim_ti.diff_physics import DifferentiableMaterial, conjugate_gradient
from diffsim_ti.diff_simulator import DifferentiableSimulator, DifferentiableSolver
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
ds.MeshObstacle(np.float32(corners + 1e6), [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])  # float32 resolves vertices
solver = ds.SemiImplicitSolver(mesh, soft, dt=0.1)  # is divided into
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
