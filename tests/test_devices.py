"""Backends, cards, workers, memory; on CUDA in processes of their own, whose driver is the stand-in of cuda_on_cpu."""

import subprocess
import sys
from functools import cache

import pytest
import taichi as ti
from cuda_on_cpu.build import CannotBuild, environment

from diffsim_ti import TetrahedralMesh, runtime
from diffsim_ti.diff_physics import DifferentiableMaterial
from diffsim_ti.diff_simulator import DifferentiableSimulator, DifferentiableSolver
from diffsim_ti.runtime import start


@cache
def variables() -> dict[str, str]:
    try:
        return environment()
    except CannotBuild as error:
        pytest.skip(str(error))


@pytest.fixture
def on_cuda(tmp_path):
    """Runs a program, with options of the stand-in; returns its exit status and what it printed, errors included."""

    def run(code: str, **options) -> tuple[int, str]:
        script = tmp_path / "program.py"
        script.write_text("import diffsim_ti as ds\nimport taichi as ti\nfrom diffsim_ti import runtime\n" + code)
        env = variables() | {f"CUDA_ON_CPU_{name.upper()}": str(value) for name, value in options.items()}
        done = subprocess.run([sys.executable, script], env=env, capture_output=True, text=True, timeout=240)
        return done.returncode, done.stdout + done.stderr

    return run


# What the stand-in must not let pass, or the tests on it would prove little

KERNELS = """
@ti.kernel
def read(a: ti.types.ndarray(ti.f32, 1), i: ti.i32, out: ti.types.ndarray(ti.f32, 1)):
    out[0] = a[i]

@ti.kernel
def last(out: ti.types.ndarray(ti.f32, 1)):
    for i in range(100):
        out[0] = i

ds.init("cuda")
a, out = runtime.array(ti.f32, 8), runtime.array(ti.f32, 1)
"""


def test_host_may_not_follow_a_pointer_of_the_device(on_cuda):
    status, printed = on_cuda(
        KERNELS + "import ctypes\n"
        "address = ti.lang.impl.get_runtime().prog.get_ndarray_data_ptr_as_int(a.arr)\n"
        "print('address', flush=True)\n"
        "print(ctypes.c_float.from_address(address).value)"
    )
    assert status == -11 and "address" in printed


def test_kernels_may_not_leave_their_arrays(on_cuda):
    """And threads run in order, unless they are to run in reverse."""
    program = "read(a, 0, out)\nprint('inside', runtime.fetch(out))\nlast(out)\nprint('last', runtime.fetch(out))\n"
    status, printed = on_cuda(KERNELS + program + "read(a, 10**6, out)")
    assert status == -6 and "inside [0.]" in printed and "last [99.]" in printed
    assert "cuda_on_cpu: kernel read" in printed and "past the end of an array" in printed


def test_new_memory_is_poisoned_and_threads_run_in_reverse(on_cuda):
    """Taichi clears its arrays itself: new memory is looked at through the driver."""
    program = (
        KERNELS
        + """
import ctypes
driver, piece, number = ctypes.CDLL("libcuda.so"), ctypes.c_void_p(), ctypes.c_float(7)
driver.cuMemAlloc_v2(ctypes.byref(piece), ctypes.c_size_t(4))
driver.cuMemcpyDtoH_v2(ctypes.byref(number), piece, ctypes.c_size_t(4))
last(out)
print(number.value, runtime.fetch(out))
"""
    )
    assert on_cuda(program, poison=1, reverse=1)[1].split()[-2:] == ["nan", "[0.]"]


# Cards and memory


def test_driver_without_a_card(on_cuda):
    status, printed = on_cuda("print('has cuda:', 'cuda' in runtime.available_archs())\nds.init('cuda')", devices=0)
    assert status == 1 and "has cuda: False" in printed
    assert "RuntimeError: the cuda backend is not available here (available: cpu" in printed
    assert "CUDA's driver is installed, but sees no card); pass one of those to diffsim_ti.init" in printed


def test_memory_that_does_not_suffice(on_cuda):
    program = """
ds.init("cuda")
kept = runtime.array(ti.f64, 10**6)
try:
    runtime.array(ti.f64, 10**8)
except MemoryError as error:
    print(error)
runtime.fill(runtime.array(ti.f64, 10**6), 1.0)
print("goes on")
"""
    status, printed = on_cuda(program, memory_mb=200)
    assert status == 0 and "goes on" in printed
    assert "800 MB do not fit into the memory of the cuda device, of which this process holds 8 MB" in printed


@pytest.mark.parametrize("dtype, shape", [(ti.f32, (2**31,)), (ti.types.vector(3, ti.f64), (2**15, 2**15))])
def test_more_numbers_than_indices_reach(dtype, shape):
    with pytest.raises(ValueError, match="beyond the 2.15e.09 that Taichi's 32-bit indices reach: keep fewer states"):
        runtime.array(dtype, *shape)


def test_backend_that_the_package_does_not_know(monkeypatch):
    monkeypatch.setattr(start, "_ARCHS", {"cuda": ti.cuda})
    monkeypatch.setattr(start.impl, "current_cfg", lambda: type("Config", (), {"arch": ti.opengl}))
    monkeypatch.delitem(start._settings, "runs", raising=False)  # the name of the one before
    with pytest.raises(
        RuntimeError, match="Taichi was started on opengl, which diffsim_ti does not support: use one of"
    ):
        runtime.arch_name()


# device=


def test_device_cuda_starts_taichi_on_the_card(on_cuda):
    status, printed = on_cuda("""
import torch
from diffsim_ti.diff_physics import DifferentiableMaterial
from diffsim_ti.diff_simulator import DifferentiableSimulator, DifferentiableSolver

mesh = ds.TetrahedralMesh.create_cube(3, device="cuda")
print("started on", runtime.arch_name())
solver = ds.SemiImplicitSolver(ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0), dt=1e-3)
simulator = ds.Simulator(solver)
simulator.step()
print(simulator.describe())
material = DifferentiableMaterial(torch.tensor(1e5), torch.tensor(0.3))
simulator = DifferentiableSimulator(mesh, material, DifferentiableSolver(dt=1e-3))
simulator.step()
print(simulator.describe())
try:
    DifferentiableSimulator(mesh, material, DifferentiableSolver(dt=1e-3), device="cuda")
except RuntimeError as error:
    print(error)
""")
    assert status == 0, printed
    assert "started on cuda" in printed and "(f32, cuda)" in printed
    assert "computed on cuda, tensors on cpu" in printed
    assert "sees no card, and device='cuda' puts tensors there: install torch for CUDA" in printed


@pytest.mark.parametrize("make", [TetrahedralMesh.create_cube, DifferentiableSimulator])
def test_device_cuda_is_refused_where_taichi_runs_elsewhere(make):
    if runtime.arch_name() == "cuda":
        pytest.skip("Taichi runs on CUDA here")
    arguments = {"device": "cuda"}
    if make is DifferentiableSimulator:
        import torch

        material = DifferentiableMaterial(torch.tensor(1e5), torch.tensor(0.3))
        arguments |= dict(mesh=TetrahedralMesh.create_cube(2), material=material, solver=DifferentiableSolver())
    with pytest.raises(RuntimeError, match="device 'cuda' needs Taichi on CUDA, but it runs on cpu: call"):
        make(**arguments)


@pytest.mark.parametrize(
    "device, complaint",
    [
        ("cuda:1", "first card only, got device 'cuda:1': set CUDA_VISIBLE_DEVICES=1"),
        ("mps", "'cpu' or 'cuda', got 'mps'"),
    ],
)
def test_devices_that_taichi_cannot_take(device, complaint):
    with pytest.raises(ValueError, match=complaint):
        TetrahedralMesh.create_cube(2, device=device)


# Workers


def test_spawned_workers_start_where_their_parent_runs(on_cuda):
    status, printed = on_cuda("""
import multiprocessing
import subprocess
import sys

def say():
    print("worker on", runtime.arch_name(), flush=True)

if __name__ == "__main__":
    ds.init("cuda")
    runtime.program()
    worker = multiprocessing.get_context("spawn").Process(target=say)
    worker.start()
    worker.join()
    other = "from diffsim_ti import runtime; print('other on', runtime.arch_name())"
    print(subprocess.run([sys.executable, "-c", other], capture_output=True, text=True).stdout)
""")
    assert status == 0 and "worker on cuda" in printed and "other on cpu" in printed, printed
