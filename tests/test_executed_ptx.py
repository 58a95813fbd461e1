"""On executed PTX: how often the driver is called, what single precision compiles to, and that launches may be repeated."""

import gc
import re

import numpy as np
import pytest
from chamber_meshes import hollow_cube
from cuda_on_cpu.counters import Absent, Counters

from diffsim_ti import (
    Anchor,
    BDF2Solver,
    Cable,
    Corotated,
    ElasticFoundation,
    GasChamber,
    Gravity,
    Ground,
    ImplicitEulerSolver,
    Pressure,
    Rollout,
    Scene,
    SelfContact,
    SemiImplicitSolver,
    SmithNeoHookean,
    Spring,
    StaticSolver,
    TetrahedralMesh,
    Traction,
    VelocityVerletSolver,
)
from diffsim_ti.solvers.implicit.cg_kernels import ROOM
from diffsim_ti.solvers.implicit.multigrid import Multigrid

pytestmark = pytest.mark.backends
SUBSTEPS = 10
NO_TRAFFIC = dict(synchronisations=0, copies_to_host=0, copies_on_device=0, fills=0)
# Calls of the driver for each substep between two looks of the guard; a copy to the host waits, and so counts like a
# synchronisation. Each call of Taichi's launcher copies one buffer of arguments (half a kilobyte to one, by the list of
# arrays) and takes and returns two pieces of memory, so that copies and allocations are eighths of what a call makes. A
# substep is two loops; a launch has one task more, of one thread for the bounds, and backwards one for paths of obstacles.
EXPLICIT = NO_TRAFFIC | dict(
    launches=2.25, copies_to_device=1 / 8, bytes_to_device=1024 / 8, allocations=2 / 8, frees=2 / 8
)
# ... for each pass with self-contact that keeps its list of pairs, which reads one number to know that it may
CONTACT_FORWARD = NO_TRAFFIC | dict(launches=17, copies_to_device=3, bytes_to_device=2048, copies_to_host=1)
CONTACT_REVERSE = NO_TRAFFIC | dict(launches=19, copies_to_device=4, bytes_to_device=2048, copies_to_host=1)
# ... for a new list; every eighth puts the primitives in order anew, on the host
NEW_LIST = NO_TRAFFIC | dict(launches=55, copies_to_device=16, copies_to_host=11, fills=2)
# ... for each implicit step of this scene, whose rounds of Newton's method read a few numbers, and for a product of the host
IMPLICIT_FORWARD = NO_TRAFFIC | dict(launches=310, copies_to_device=68, copies_to_host=31, fills=4)
IMPLICIT_REVERSE = NO_TRAFFIC | dict(launches=63, copies_to_device=14, copies_to_host=10, fills=1)
PRODUCT = NO_TRAFFIC | dict(launches=3, copies_to_device=2, copies_to_host=1)
# ... for a whole explicit run, besides its substeps: arrays go each way once, zeroing is a memset
ONCE_FORWARD = dict(synchronisations=0, copies_to_device=17, copies_to_host=8, fills=4)
ONCE_REVERSE = dict(synchronisations=0, copies_to_device=6, copies_to_host=5, fills=14)
DOUBLE_IN_SINGLE = {
    "_find_bad": "ti.math.isinf compares with a double",
    "cg": "vectors of conjugate gradients, beside products in float32: a stiff body takes more digits than these have",
    **dict.fromkeys(("newton0", "newton1", "invert", "ready"), "vectors of Newton's method, and sums of energies"),
}


@pytest.fixture
def driver() -> Counters:
    try:
        return Counters()
    except Absent as absent:
        pytest.skip(str(absent))


@pytest.fixture(scope="module")
def cube() -> TetrahedralMesh:
    return TetrahedralMesh.create_cube(3)


def scene(mesh, *terms, law=None, precision="f64", **options) -> Scene:
    ground = Ground(mesh.vertices[:, 1].min() - 1e-3, 1e3, 0.01, **options)
    law = law or SmithNeoHookean(1e5, 0.4)
    return Scene(mesh, law, 1000.0, [Gravity(-9.8), ground, *terms], precision=precision)


def two_boxes() -> TetrahedralMesh:
    box = TetrahedralMesh.create_box(2, 0.1)
    return TetrahedralMesh.joined([box, box.translated([0.02, 0.125, 0.01])])


def explicit(scene, solver=SemiImplicitSolver, **options):
    return solver(scene, dt=1e-3, substeps=SUBSTEPS, allow_unstable=True, **options)


def sweeps(driver, solver, frames: int) -> list[dict[str, int]]:
    """Counts of a forward run and of its reverse, each made for the second time."""
    rollout = Rollout(solver, frames, gradients=["youngs_modulus", "initial_positions"])
    for _ in range(2):
        gc.collect()  # what earlier runs held goes back now, not in the middle of a count
        driver.restart()
        result = rollout.forward()
        forward = driver.counts()
        driver.restart()
        rollout.vjp(result, np.ones(result.positions.shape))
    return [forward, driver.counts()]


def check_counts(found: dict, ceiling: dict) -> None:
    assert found["launches"] > 0
    assert all(found[name] <= ceiling[name] for name in ceiling), f"{found}, allowed {ceiling}"


def check_ceilings(driver, solver, passes: int, frames: tuple[int, int], forward: dict, reverse: dict) -> None:
    """Each sweep may add so many calls for each further pass; what a run costs once drops out of the difference."""
    short, long = (sweeps(driver, solver, n) for n in frames)
    more = passes * (frames[1] - frames[0])
    for way, ceiling, few, many in zip(("forward", "reverse"), (forward, reverse), short, long):
        found = {name: (many[name] - few[name]) / more for name in ceiling}
        check_counts(found | {"way": way}, ceiling)


CONTACTS = {
    "ground": (SemiImplicitSolver, dict(), dict()),
    "friction by forces": (SemiImplicitSolver, dict(friction=0.5), dict(contact="force")),
    "friction, moving": (VelocityVerletSolver, dict(friction=0.5, path=lambda t: [0.1 * t, 0, 0]), dict()),
}


@pytest.mark.parametrize("name", CONTACTS)
def test_explicit_sweeps_neither_copy_nor_wait(driver, cube, name):
    solver, ground, options = CONTACTS[name]
    check_ceilings(driver, explicit(scene(cube, **ground), solver, **options), SUBSTEPS, (16, 28), EXPLICIT, EXPLICIT)


def test_explicit_runs_move_their_arrays_once(driver, cube):
    frames = 8
    for found, ceiling in zip(sweeps(driver, explicit(scene(cube)), frames), (ONCE_FORWARD, ONCE_REVERSE)):
        found["copies_to_device"] -= SUBSTEPS * frames // 16  # arguments of launches
        check_counts(found, ceiling)


def test_passes_with_self_contact_stay_below_their_ceilings(driver):
    solver = explicit(scene(two_boxes(), SelfContact(2e4, 2e-2), law=Corotated(5e4, 0.3)))
    check_ceilings(driver, solver, SUBSTEPS, (2, 4), CONTACT_FORWARD, CONTACT_REVERSE)


def test_new_lists_of_pairs_stay_below_their_ceiling(driver):
    solver = explicit(scene(two_boxes(), SelfContact(2e4, 2e-2), law=Corotated(5e4, 0.3)))
    workspace = solver.workspace(solver.start_values())
    for _ in range(workspace.pairs.list.trees[0].sort_every):
        driver.restart()
        workspace.pairs.fresh = False
        workspace.pairs.ensure(workspace.state.u, 0)
        check_counts(driver.counts(), NEW_LIST)


def test_implicit_steps_stay_below_their_ceilings(driver, cube):
    solver = ImplicitEulerSolver(scene(cube), dt=5e-3)
    check_ceilings(driver, solver, 1, (3, 6), IMPLICIT_FORWARD, IMPLICIT_REVERSE)
    potential, w = solver.workspace(solver.start_values()).potential, np.ones((cube.num_vertices, 3))
    potential.place(0 * w)
    for _ in range(2):
        driver.restart()
        potential.product(w)
    check_counts(driver.counts(), PRODUCT)


def test_ten_iterations_on_the_device_bring_a_few_numbers_to_the_host(driver, monkeypatch):
    """Besides arguments of launches nothing goes to the card; nor is anything compiled for other numbers of iterations."""
    monkeypatch.setattr(Multigrid, "direct", 0)
    mesh = TetrahedralMesh.create_box((9, 4, 4), (0.8, 0.3, 0.3))
    held = Scene(mesh, SmithNeoHookean(1e5, 0.4), 1000.0, [Gravity()], fixed="xmin", precision="f64")
    solver = StaticSolver(held, preconditioner="multigrid")
    workspace, found = solver.workspace(solver.start_values()), {}
    none, b = np.zeros((mesh.num_vertices, 1)), np.random.default_rng(0).standard_normal((mesh.num_vertices, 3))
    workspace.potential.place(0 * b)
    multigrid, _ = workspace.preconditioner(none)
    multigrid.update(0 * b)
    for iterations in (10, 10, 20, 7, 13, 29):
        driver.restart()
        _, _, count, _ = multigrid.solver(none, None, False, b * workspace.free, 1e-30, iterations, 1e-16)
        assert count == iterations
        found[iterations] = driver.counts()
    more = {name: found[20][name] - found[10][name] for name in found[10]}
    assert more["copies_to_host"] == 1 and more["bytes_to_host"] <= 8 * ROOM and more["synchronisations"] == 0
    assert more["fills"] == more["copies_on_device"] == 0
    assert more["bytes_to_device"] <= 1024 * more["launches"]
    assert [found[iterations]["modules"] for iterations in (7, 13, 29)] == [0, 0, 0]


def test_every_kernel_is_launched_again_and_again(driver, cube):
    """Taichi's launcher leaves a dead address in a launch context: the second launch is the one that crashed."""
    rollout = Rollout(explicit(scene(cube)), 3, gradients=["youngs_modulus", "initial_velocities"])
    runs = []
    driver.restart()
    for _ in range(3):
        frames = rollout.forward()
        runs.append((frames.positions, rollout.vjp(frames, frames.positions)))
    assert min(n for name, n in driver.launches().items() if not name.startswith("runtime_")) >= 3  # Taichi's own apart
    for positions, gradients in runs[1:]:
        assert np.array_equal(positions, runs[0][0])
        assert all(np.array_equal(gradients[name], runs[0][1][name]) for name in gradients)


def solvers_in_single_precision(cube):
    friction = Ground(cube.vertices[:, 1].min() - 1e-3, width=0.01, friction=0.5, stiffness_per_area=1e5)
    yield explicit(Scene(cube, SmithNeoHookean(1e5, 0.4), 1000.0, [Gravity(-9.8), friction], precision="f32"))
    yield explicit(scene(cube, law=Corotated(1e5, 0.3), precision="f32"), VelocityVerletSolver)
    yield explicit(scene(two_boxes(), SelfContact(2e4, 2e-2), precision="f32"))
    loads = Pressure(lambda t: 10 * t, "ymax"), Traction(lambda t: [t, 0, 0], "ymax")
    fixed = {"xmin": "x", "ymin": [0, 1, 1]}
    partly_fixed = Scene(cube, SmithNeoHookean(1e5, 0.4), 1000.0, [Gravity(), *loads], fixed, precision="f32")
    yield explicit(partly_fixed, VelocityVerletSolver)
    gas = GasChamber(lambda t: 1.1e5 + t, "cavity")
    yield explicit(Scene(hollow_cube(), SmithNeoHookean(1e5, 0.4), 1000.0, gas, "bottom", precision="f32"))
    lines = Spring(0, 7, 100.0), Cable([1, Anchor([0.0, 0.5, 0.0]), 6], tension=lambda t: 10 * t)
    held = Scene(
        cube, SmithNeoHookean(1e5, 0.4), 1000.0, [*lines, ElasticFoundation(1e4, 1e3, "ymin")], precision="f32"
    )
    yield explicit(held, VelocityVerletSolver)
    yield ImplicitEulerSolver(scene(cube, precision="f32"), dt=5e-3)
    yield BDF2Solver(scene(cube, precision="f32"), dt=5e-3)


def test_single_precision_computes_in_single_precision(driver, cube):
    """A double costs a card 32 to 64 times as much as a float; one number without a type is enough to compile to them."""
    driver.restart()
    for solver in solvers_in_single_precision(cube):
        rollout = Rollout(solver, 2, gradients=["youngs_modulus", "initial_positions"])
        frames = rollout.forward()
        rollout.vjp(frames, frames.positions)
        rollout.jvp(frames, youngs_modulus=1.0)
    found = {}
    for name, text in driver.ptx().items():
        kernel = re.sub(r"_c\d+_\d+_kernel_.*", "", name)
        doubles = set(re.findall(r"\s([a-z][\w.]*\.f64[\w.]*)\s", text))
        if doubles and kernel not in DOUBLE_IN_SINGLE:
            found[kernel] = doubles
    assert not found
    assert len(driver.ptx()) > 30
