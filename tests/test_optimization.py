"""State files that are whole or refused, and resumed optimisations that equal uninterrupted ones, also after kill -9."""

import os
import random
import signal
import subprocess
import sys
import time

import pytest
import torch

from diffsim_ti import TetrahedralMesh
from diffsim_ti.optimization import Optimization, load_state, save_state

MESH, OTHER = TetrahedralMesh.create_cube(2), TetrahedralMesh.create_cube(3)


def state(k: float) -> dict:
    return {"x": torch.full((50,), k), "k": k, "nested": {"list": [1, 2.5, None]}}


def same(a, b) -> bool:
    return torch.equal(a["x"], b["x"]) and a["k"] == b["k"] and a["nested"] == b["nested"]


def test_round_trip_and_previous(tmp_path):
    path = tmp_path / "new folder" / "run.state"
    assert load_state(path, MESH) is None
    for k in (1.0, 2.0, 3.0):
        save_state(path, MESH, state(k))
        assert same(load_state(path, MESH), state(k))
    assert sorted(p.name for p in path.parent.iterdir()) == ["run.state", "run.state.previous"]
    path.unlink()  # as if killed between the two renames
    assert same(load_state(path, MESH), state(2.0))


@pytest.mark.parametrize(
    "damage, reason",
    [
        (lambda data: data[: len(data) // 2], "truncated or damaged"),
        (lambda data: data[:30], "another version|not a saved state"),
        (lambda data: b"", "not a saved state"),
        (lambda data: data[:-5] + b"xxxxx", "truncated or damaged"),
        (lambda data: data.replace(b"version 1", b"version 9", 1), "written by another version"),
        (lambda data: b"PK\x03\x04" + data, "not a saved state"),
    ],
    ids=["half", "head", "empty", "bits", "version", "foreign"],
)
def test_damaged_files_are_refused_and_the_previous_one_used(tmp_path, damage, reason):
    path = tmp_path / "run.state"
    save_state(path, MESH, state(1.0))
    save_state(path, MESH, state(2.0))
    path.write_bytes(damage(path.read_bytes()))
    with pytest.warns(UserWarning, match=f"({reason}).*using .*previous"):
        assert same(load_state(path, MESH), state(1.0))
    (tmp_path / "run.state.previous").unlink()
    with pytest.raises(ValueError, match=reason):
        load_state(path, MESH)


def test_another_mesh_is_refused(tmp_path):
    save_state(tmp_path / "run.state", OTHER, state(1.0))
    with pytest.raises(ValueError, match="made for another mesh.*delete the file to start again"):
        load_state(tmp_path / "run.state", MESH)


@pytest.mark.parametrize("at", ["fsync", "replace"])
def test_a_full_disk_leaves_the_old_file(tmp_path, monkeypatch, at):
    path = tmp_path / "run.state"
    save_state(path, MESH, state(1.0))

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, at, full)
        with pytest.raises(OSError, match="No space left"):
            save_state(path, MESH, state(2.0))
    assert [p.name for p in tmp_path.iterdir()] == ["run.state"]
    assert same(load_state(path, MESH), state(1.0))


def problem(path=None, lr=0.1, save_every=1):
    torch.manual_seed(0)
    module = torch.nn.Linear(3, 1)
    run = Optimization(module, torch.optim.Adam(module.parameters(), lr=lr), MESH, path, save_every)
    return run, lambda: (module(torch.randn(4, 3)) - 1).square().mean()  # random numbers must resume too


def test_resumed_equals_uninterrupted(tmp_path):
    whole, loss = problem()
    whole.run(loss, 9)
    for stop in (4, 9):
        part, loss = problem(tmp_path / "run.state")
        part.run(loss, stop)
    assert part.losses == whole.losses and part.best_loss == whole.best_loss
    assert all(torch.equal(a, b) for a, b in zip(part.module.parameters(), whole.module.parameters()))


def test_resumed_lbfgs_equals_uninterrupted(tmp_path):
    def run(path, iterations):
        module = torch.nn.Linear(3, 2).double()
        torch.nn.init.constant_(module.weight, 0.5)
        torch.nn.init.constant_(module.bias, 0.1)
        x = torch.linspace(-1, 1, 12).double().reshape(4, 3)
        optimizer = torch.optim.LBFGS(module.parameters(), max_iter=3, line_search_fn="strong_wolfe")
        return Optimization(module, optimizer, MESH, path).run(
            lambda: (module(x).cosh() - 2).square().mean(), iterations
        )

    whole = run(None, 6)
    run(tmp_path / "run.state", 3)
    resumed = run(tmp_path / "run.state", 6)
    assert resumed.losses == whole.losses
    assert all(torch.equal(a, b) for a, b in zip(resumed.module.parameters(), whole.module.parameters()))


def test_a_loss_that_is_not_finite_keeps_the_best():
    module = torch.nn.Linear(1, 1)
    run = Optimization(module, torch.optim.SGD(module.parameters(), lr=0.1), MESH)
    values = iter([2.0, 1.0, 3.0, float("nan")])
    seen = []

    def loss():
        seen.append(module.weight.item())
        return next(values) + (module.weight - module.weight.detach()).sum() + 0 * module.bias.sum()

    with pytest.raises(FloatingPointError, match="iteration 3: the loss is nan"):
        run.run(loss, 10)
    assert module.weight.item() == seen[1] and run.best_loss == run.losses[1] and run.iteration == 3


SCRIPT = """
import sys, torch
from diffsim_ti import TetrahedralMesh
from diffsim_ti.optimization import Optimization
torch.manual_seed(0)
module = torch.nn.Linear(3, 1)
optimizer = torch.optim.Adam(module.parameters(), lr=0.1)
run = Optimization(module, optimizer, TetrahedralMesh.create_cube(2), sys.argv[1] or None)
print("ready", flush=True)
run.run(lambda: (module(torch.randn(4, 3)) - 1).square().mean(), 40)
print(run.losses[-1], *(p.sum().item() for p in module.parameters()))
"""


def start(path) -> subprocess.Popen:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-W", "error::UserWarning", "-c", SCRIPT, str(path)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)


@pytest.mark.thorough
def test_kill_at_random_moments(tmp_path):
    """In new processes: the next run finds a whole file (warnings are errors there) and ends as if nothing had been."""
    moments = random.Random(0)
    for _ in range(2):
        process = start(tmp_path / "run.state")
        assert process.stdout.readline() == "ready\n"
        time.sleep(moments.uniform(0.0, 0.15))
        process.send_signal(signal.SIGKILL)
        process.wait()
    results = [start(path) for path in (tmp_path / "run.state", "")]
    outputs = [process.communicate(timeout=600)[0] for process in results]
    assert outputs[0] == outputs[1] and len(outputs[0].split()) == 4


FIFTY = """
import os, random, signal, sys, time, warnings
warnings.simplefilter("error", UserWarning)  # a file that is refused is a warning
import torch
from diffsim_ti import TetrahedralMesh
from diffsim_ti.optimization import Optimization
torch.set_num_threads(1)
torch.optim.Adam(torch.nn.Linear(3, 1).parameters())  # imports half of torch, once for all children
mesh, path, iterations = TetrahedralMesh.create_cube(2), sys.argv[1], 400  # more than a busy machine does in 50 lives

def optimise(path, progress):
    torch.manual_seed(0)
    module = torch.nn.Linear(3, 1)
    run = Optimization(module, torch.optim.Adam(module.parameters(), lr=0.1), mesh, path)
    begun = run.iteration

    def loss():
        os.write(progress, b"i")
        return (module(torch.randn(4, 3)) - 1).square().mean()

    run.run(loss, iterations)
    return begun, run.losses, [p.tolist() for p in module.parameters()]

def child(path, report=None, progress=os.open(os.devnull, os.O_WRONLY)):
    pid = os.fork()
    if pid == 0:
        try:
            result = optimise(path, progress)
            if report:
                open(report, "w").write(repr(result))
            os._exit(0)
        except BaseException as error:
            print("failed:", repr(error), file=sys.stderr, flush=True)
            os._exit(1)
    return pid

moments, kills = random.Random(1), 0
while kills < 50:
    reading, writing = os.pipe()
    pid = child(path, progress=writing)
    os.close(writing)
    for _ in range(moments.randrange(4)):  # after so many iterations have begun, however fast the disk is,
        assert os.read(reading, 1), "it ended by itself"
    time.sleep(moments.uniform(0.0, 0.005))  # in the midst of one, of its saving, or of the start
    os.kill(pid, signal.SIGKILL)
    status = os.waitpid(pid, 0)[1]
    assert os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL, "it had ended, or failed, before the kill"
    os.close(reading)
    kills += 1
for name in (path, ""):
    assert os.waitpid(child(name or None, path + ("A" if name else "B")), 0)[1] == 0
killed, whole = (eval(open(path + end).read()) for end in "AB")
assert killed[1:] == whole[1:], "not the uninterrupted run"
print(kills, killed[0], len(killed[1]))
"""


def test_fifty_kills(tmp_path):
    """Children of one light process, killed 50 times: no file is refused, and the last run ends bitwise as if alone."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    out = subprocess.run(
        [sys.executable, "-c", FIFTY, str(tmp_path / "run.state")],
        capture_output=True,
        text=True,
        timeout=600,
        env=environment,
    )
    assert out.returncode == 0, out.stderr
    kills, begun, iterations = map(int, out.stdout.split())
    assert kills == 50 and iterations == 400
    assert 20 < begun < 400  # the kills fell into the optimisation, and it went on from there
