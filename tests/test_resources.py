"""What the library takes from its host: import, start-up, memory, kernels, files."""

import gc
import os
import re
import subprocess
import sys
import textwrap
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import taichi as ti

import diffsim_ti as ds
from diffsim_ti import runtime
from diffsim_ti.solvers import SOLVERS as ALL_SOLVERS
from diffsim_ti.terms.obstacles.ground import GroundForce

SOLVERS = [s for s in ALL_SOLVERS if s.explicit]  # the implicit ones: test_implicit*.py
ROOT = Path(__file__).parents[1]


def python(code, **environment):
    """Run code in a fresh interpreter; its output, and an error if it fails."""
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    env = os.environ | {"PYTHONPATH": path} | environment
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, env=env, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def small(mesh=None, **options):
    mesh = ds.TetrahedralMesh.create_box(3) if mesh is None else mesh
    return ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), **options)


STEP = """
    mesh = ds.TetrahedralMesh.create_box(2)
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), terms=[ds.Gravity()])
    simulator = ds.Simulator(ds.SemiImplicitSolver(scene, dt=1e-3))
    simulator.run(10)
"""


# ---- import and start ---------------------------------------------------------------------------------------------------


@cache
def a_first_process() -> list[list[str]]:
    """Lines that one process prints: of its import, of what `init` refuses, of its first step, of gradients."""
    out = python(
        """
        import sys
        import diffsim_ti as ds
        import taichi.lang.impl as impl
        names = ("torch", "matplotlib", "scipy", "meshio", "rich", "typer", "pinocchio")
        heavy = [name for name in names if name in sys.modules]
        print(heavy, impl.get_runtime().prog is None)
        ds.TetrahedralMesh.create_cube()
        print("meshio" in sys.modules)
        print("---")
        for arguments in (dict(backend="metal"), dict(precision="half"), dict(default_fp=1)):
            try:
                ds.init(**arguments)
            except ValueError as error:
                print(error)
        try:
            ds.init("cuda")
            print("the cuda backend is not available here (available: cpu")  # a machine that has one
            ds.init("cpu")
        except RuntimeError as error:
            print(error)
        print("---")
        sys.modules["torch"] = None
    """
        + textwrap.indent(STEP, "    ")
        + """
        print(scene.precision, ds.runtime.arch_name(), simulator.positions.dtype)
        print("---")
        rollout = ds.Rollout(simulator.solver, 5)
        frames = rollout.forward()
        print(sorted(rollout.vjp(frames, positions=frames.positions)))
        for name in ("diff_physics", "diff_simulator"):
            try:
                __import__("diffsim_ti." + name)
            except ImportError as error:
                print(error)
    """
    )
    return [part.splitlines() for part in out.split("---\n")]


def test_import_is_light_and_quiet():
    """Nothing heavy, nothing printed, no runtime started; a mesh that is made needs no reader of files."""
    assert a_first_process()[0] == ["[] True", "False"]


def test_init_refuses_what_is_not_there():
    lines = a_first_process()[1]
    assert lines[0] == "backend must be one of cpu, cuda, vulkan, got 'metal'"
    assert lines[1] == "precision must be 'f32' or 'f64', got 'half'"
    assert lines[2].startswith("default_fp cannot be chosen: diffsim_ti needs default_fp=f64")
    assert lines[3].startswith("the cuda backend is not available here (available: cpu")


def test_use_before_init_starts_the_stated_default():
    assert a_first_process()[2] == ["f32 cpu float32"]  # and nothing else on the terminal


def test_torch_is_not_needed():
    """The core runs where torch cannot be imported, and what needs it says so."""
    first, *said = a_first_process()[3]
    assert "youngs_modulus" in first and len(said) == 2
    assert all(words in one for one in said for words in ("needs torch", "pip install 'torch", "halted")), said


def test_cuda_is_named_as_missing():
    if "cuda" in runtime.available_archs():
        pytest.skip("this machine has CUDA")
    names = ", ".join(runtime.available_archs())
    before = small().precision
    with pytest.raises(
        RuntimeError, match=rf"the cuda backend is not available here \(available: {names}\); pass one of those"
    ):
        ds.init("cuda", precision="f32" if before == "f64" else "f64")
    ds.Simulator(ds.SemiImplicitSolver(small(), dt=1e-3)).run(2)  # the running program is as it was
    assert small().precision == before  # and so is the default


def test_arrays_of_an_earlier_program_leave_those_of_the_next_alone():
    """Numbers and vectors of both lie at the same addresses."""
    out = python("""
        import numpy as np, taichi as ti, diffsim_ti as ds
        from diffsim_ti import runtime

        def some(value):
            return [runtime.upload(np.full((1000, 3), value), ti.types.vector(4, ti.f32)) for _ in range(50)] + [
                runtime.upload(np.full(1000, value), ti.i32) for _ in range(50)]

        ds.init()
        before = some(1)
        ti.reset()
        ds.init()
        kept = some(2)
        before.clear()
        later = some(3)
        print(all((runtime.fetch(array) == 2).all() for array in kept), runtime.allocated_megabytes())
    """)
    said, megabytes = out.split()
    assert said == "True" and float(megabytes) == 2 * (50 * 16e-3 + 50 * 4e-3)


def test_host_s_init_is_respected():
    """The host's fields live on, its settings stay, and a warning names what they cost."""
    out = python(
        """
        import warnings
        import taichi as ti
        ti.init(arch=ti.cpu, default_fp=ti.f32, log_level=ti.ERROR, random_seed=5)
        field = ti.field(ti.f32, 3)
        field[1] = 7
        import diffsim_ti as ds
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
    """
        + textwrap.indent(STEP, "        ")
        + """
            ds.SemiImplicitSolver(scene, dt=1e-3)
        print(field[1], ti.cfg.random_seed, len(caught), caught[0].message)
    """
    )
    assert re.search(r"^7.0 5 1 ti.init was called with fast_math=True, .* use diffsim_ti.init\(\)", out, re.M), out


def test_second_init_is_noticed():
    """Objects of the first program say so; new ones work."""
    out = python(
        "import diffsim_ti as ds\nds.init('cpu')\n"
        + textwrap.dedent(STEP)
        + textwrap.dedent("""
        rollout = ds.Rollout(simulator.solver, 5)
        frames = rollout.forward()
        rollout.field("initial_velocities")
        ds.init("cpu", precision="f64")
        simulator.step()  # the same settings: nothing was dropped
        ds.init("cpu", precision="f64", threads=1)
        for use in (simulator.step, simulator.reset, lambda: simulator.positions, lambda: simulator.compute_energy(),
                    lambda: simulator.set_state(velocities=mesh.vertices), rollout.forward, lambda: rollout.vjp(frames),
                    rollout.run, lambda: rollout.positions, simulator.tetrahedron_fields):
            try:
                use()
                print("used")
            except RuntimeError as error:
                print(error)
        again = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3))
        ds.Simulator(ds.SemiImplicitSolver(again, dt=1e-3)).run(3)
        del simulator, rollout
        print(again.precision, "done")
    """)
    )
    lines = out.splitlines()
    assert lines[-1] == "f64 done"
    assert (
        lines[:-1]
        == ["ti.init was called again, which destroys all Taichi data: build the scene and solver again"] * 10
    )


def test_home_that_cannot_be_written(tmp_path, monkeypatch):
    """Without a place for the kernel cache everything works, exit included; no folder is left. Nobody can write in /proc."""
    monkeypatch.setenv("HOME", "/proc")
    assert not runtime.start._can_write_cache(None) and runtime.start._can_write_cache(str(tmp_path))
    said = "import os; print(len(os.listdir(os.environ['TMPDIR'])) > 0)"
    code = f"import diffsim_ti as ds\nds.init()\nds.init()\n{textwrap.dedent(STEP)}{said}"
    out = python(code, HOME="/proc", TI_OFFLINE_CACHE_FILE_PATH="/proc/none", TMPDIR=str(tmp_path))
    assert out.splitlines()[-1] == "True" and list(tmp_path.glob("ticache-*")) == []


def test_the_next_process_finds_the_compiled_kernels(tmp_path):
    """Taichi writes its cache when its program ends, which it must do whatever still refers to it."""
    code = textwrap.dedent("import diffsim_ti as ds\nds.init()\n") + textwrap.dedent(STEP)
    python(code, TI_OFFLINE_CACHE_FILE_PATH=str(tmp_path))
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.tic")}
    assert kept
    python(code, TI_OFFLINE_CACHE_FILE_PATH=str(tmp_path))
    assert {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.tic")} == kept  # none compiled again


# ---- memory and kernels -------------------------------------------------------------------------------------------------


def build_and_drop(solver=ds.SemiImplicitSolver, size=3, field=False):
    of = small(ds.TetrahedralMesh.create_box(size), terms=[ds.Gravity()])
    simulator = ds.Simulator(solver(of, dt=1e-3))
    simulator.run(2)
    rollout = ds.Rollout(solver(of, dt=1e-3), 4)
    frames = rollout.forward()
    rollout.vjp(frames, positions=frames.positions)
    if field:
        rollout.positions.grad.fill(0)  # from the pool


def resident_megabytes():
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def specializations():
    """How many Taichi kernels exist, and how many versions of them are compiled."""
    kernels = [k for k in gc.get_objects() if issubclass(type(k), ti.lang.kernel_impl.Kernel)]  # proxies may be dead
    return len(kernels), sum(len(k.compiled_kernels) for k in kernels)


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads /proc")
def test_dropped_scenes_leave_nothing():
    """70 scenes: memory goes back, and no kernel compiles after the first."""
    gc.collect()
    start = runtime.allocated_megabytes()
    resident, compiled = [], []
    for k in range(70):
        build_and_drop(field=True)
        if k in (20, 45, 69):
            gc.collect()
            resident.append(resident_megabytes())
            compiled.append(specializations())
    assert runtime.allocated_megabytes() == pytest.approx(start, abs=1e-9)
    assert min(np.diff(resident)) < 3  # a leak grows all the time; memory that is handed out in large pieces does not
    assert len(set(compiled)) == 1


def test_equal_scenes_share_their_kernels():
    """Another mesh, other numbers, another solver of the family: nothing compiles anew."""
    build_and_drop()
    before = specializations()
    for size in (2, 4, 5):
        build_and_drop(size=size)
    build_and_drop(ds.VelocityVerletSolver)
    assert specializations() == before
    other = ds.StableNeoHookean(1e5, 0.3, J_floor=0.0137)  # a law that no other test has
    ds.Simulator(ds.SemiImplicitSolver(ds.Scene(ds.TetrahedralMesh.create_cube(2), other), dt=1e-4)).run(1)
    assert specializations() > before  # a scene of another kind does, so that the count counts


def test_memory_is_what_the_arrays_need():
    """Forward only: no adjoint, no record. Twelve numbers per vertex and corner forces come first."""
    gc.collect()
    before = runtime.allocated_megabytes()
    mesh = ds.TetrahedralMesh.create_box(9)
    of = small(mesh, precision="f32")
    rollout = ds.Rollout(ds.SemiImplicitSolver(of, dt=1e-4), 10)
    rollout.forward()
    forward = (runtime.allocated_megabytes() - before) * 1e6
    # tets, corner list: 2 x 16 bytes a tetrahedron; gradients, volume: 40; corner forces: 64
    assert forward < 1.3 * mesh.num_tetrahedra * (32 + 40 + 64) + 400 * mesh.num_vertices
    frames = rollout.forward()
    rollout.vjp(frames, positions=frames.positions)
    assert (runtime.allocated_megabytes() - before) * 1e6 > 1.3 * forward
    del rollout, frames
    gc.collect()
    assert runtime.allocated_megabytes() == pytest.approx(before, abs=1e-9)


# ---- pay for use --------------------------------------------------------------------------------------------------------


def workspace(of, solver=ds.SemiImplicitSolver):
    return ds.Simulator(solver(of, dt=1e-4)).workspace


def test_absent_features_take_no_memory():
    bare = workspace(small()).arrays
    for name in ("surface", "force_slot", "motion_slot", "forces", "motion", "anchor", "rest"):
        assert np.prod(getattr(bare, name).shape) == 1, name
    features = bare.features()
    assert features.groups == () and features.gravity == -1 and features.drag == -1
    assert not (features.forces or features.motion) and features.uniform
    assert np.prod(bare.coefficients.shape) == len(bare.law.coefficient_names)  # one block for all tetrahedra
    full = workspace(
        small(
            terms=[ds.Ground(-1, stiffness=1e4), ds.ExternalForce([0, 0, 0])], fixed="xmin", motion=lambda t: [0, 0, 0]
        )
    ).arrays
    n = full.num_vertices
    assert full.surface.shape == full.rest.shape == full.force_slot.shape == full.motion_slot.shape == (n,)
    assert len(full.features().groups) == 1 and full.features().forces and full.features().motion


@pytest.mark.parametrize("solver", SOLVERS)
def test_absent_contact_leaves_no_code(solver, monkeypatch):
    """The ground's distance is looked up while a step compiles if, and only if, the scene has a ground."""
    looked_up = []

    class Spy:
        def __get__(self, instance, owner):
            if instance is not None:
                looked_up.append(instance)
            return original.__get__(instance, owner)

    original = GroundForce.__dict__["distance_and_normal"]
    monkeypatch.setattr(GroundForce, "distance_and_normal", Spy())
    # J_floor is a compile-time number of the law: a new J_floor means that everything compiles here
    material = ds.StableNeoHookean(1e5, 0.3, J_floor=0.0123 + 1e-4 * SOLVERS.index(solver))
    mesh = ds.TetrahedralMesh.create_box(2)
    ds.Simulator(solver(ds.Scene(mesh, material, terms=[ds.Gravity()]), dt=1e-3)).run(2)
    assert looked_up == []
    ds.Simulator(solver(ds.Scene(mesh, material, terms=[ds.Ground(-1.0, stiffness=1e4)]), dt=1e-3)).run(2)
    assert looked_up


def test_vulkan_refuses_float64_with_a_remedy(monkeypatch):
    monkeypatch.setattr("diffsim_ti.runtime.start.arch_name", lambda: "vulkan")
    runtime.check_backend("f32")
    with pytest.raises(ValueError, match="no float64 logarithm.*precision='f32'"):
        runtime.check_backend("f64")
