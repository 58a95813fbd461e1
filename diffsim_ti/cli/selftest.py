"""The command that says whether an installation computes what it should: `diffsim-ti selftest`."""

import os
import platform
import time
import warnings
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from typing import Annotated

import numpy as np
import typer
from typer import Option

import diffsim_ti as ds
from diffsim_ti import runtime
from diffsim_ti.cli import options as opt
from diffsim_ti.solvers import Solver

# scene -> motion, then the derivative by each input that its rollout names; in float64 on x86-64
STORED = {
    "beam, velocity Verlet": [2.216989495e-04, -1.756738853e-08, 3.554677871e-04],
    "throw, friction": [1.608871023e-02, -2.553501825e-04, -1.354664219e-02],
    "two bodies meet": [5.149441837e-03, -8.291453715e-08, -2.322544537e-02],
    "cable, viscous body": [7.926821122e-04, -6.816480120e-08, 3.036270163e-04],
    "traction, backward Euler": [-4.017354559e-03, 6.041727136e-10, 1.695607705e-05],
    "rubber on a floor, BDF2": [3.981810088e-02, 2.600371922e-07, -8.224239593e-03],
    "ten nodes, midpoint rule": [6.903324037e-03, -1.962372809e-07],
    "equilibrium, nu = 0.49": [-9.668507481e-03, 7.042892072e-02, -1.088917376e-05],
    "equilibrium by rest shape": [-8.723864487e-03, 5.294622907e01],
    "reaction of a support": [4.259517742e00, 2.119547901e-03],
}
TOLERANCE = {"f64": 1e-6, "f32": 5e-3}  # relative: solvers' tolerances and other processors' rounding; of float32
RATIOS = {"gradient : forward": 2.2, "forward : NumPy": 1.0}  # of times, on two cores
SLOW = 8.0  # times a stored ratio, beyond which something is amiss: a busy machine makes it three times as large


def _bar(order: int = 1) -> ds.TetrahedralMesh:
    mesh = ds.TetrahedralMesh.create_box((5, 3, 3), (0.2, 0.1, 0.1), pattern="five").translated((0, 0.011, 0))
    return mesh.quadratic() if order == 2 else mesh


def _scene(law: ds.Material, *terms, mesh: ds.TetrahedralMesh | None = None, **how) -> ds.Scene:
    return ds.Scene(mesh or _bar(), law, terms=[ds.Gravity(), *terms], **how)


def _scenes() -> dict[str, tuple]:
    """{title: (what makes its solver, steps, inputs to differentiate by, further results)}; each uses other parts."""
    soft, rubber = ds.StableNeoHookean(5e4, 0.3), ds.MooneyRivlin(c10=8e3, c01=2e3, bulk_modulus=5e4)
    viscous, stiff = ds.KelvinVoigt(soft, time=1e-3), ds.StableNeoHookean(5e4, 0.49)
    floor, thrown = ds.Ground(0.0, stiffness=50.0, width=0.01, friction=0.3), dict(initial_velocities=[1.0, -0.5, 0.0])
    halves = ds.TetrahedralMesh.joined([ds.TetrahedralMesh.create_box(3, 0.1, origin=(x, 0, 0)) for x in (0, 0.105)])
    meeting = dict(mesh=halves, initial_velocities=np.where(halves.vertices[:, :1] < 0.102, 1, -1) * [0.5, 0, 0])
    touch, pull = ds.SelfContact(width=0.004), ds.Traction([0, 200, 0], "xmax")
    cable = ds.Cable([[0.0, 0.111, 0.05], [0.1, 0.111, 0.05], [0.2, 0.111, 0.05]], tension=2.0)
    press, held = ds.Pressure(500.0, "ymax"), dict(fixed="xmin")
    verlet, euler, static = ds.VelocityVerletSolver, ds.SemiImplicitSolver, ds.StaticSolver
    backward, bdf2, midpoint = ds.ImplicitEulerSolver, ds.BDF2Solver, ds.ImplicitMidpointSolver
    squeezed, support = dict(volume="patches", **held), ds.Reaction("xmin")
    # so that the way to it does not count
    solved = dict(tolerance=1e-10) if runtime.check_precision(None) == "f64" else {}
    by_E, by_speed = "youngs_modulus", "initial_velocities"
    by_pull, by_c10 = f"{by_E} traction", f"c10 {by_speed}"
    return {
        "beam, velocity Verlet": (lambda: verlet(_scene(soft, **held), 2e-3), 20, "youngs_modulus gravity"),
        "throw, friction": (lambda: euler(_scene(soft, floor, **thrown), 1e-3), 30, "poissons_ratio friction"),
        "two bodies meet": (lambda: backward(_scene(soft, touch, **meeting), 2e-3, **solved), 10, f"{by_E} {by_speed}"),
        "cable, viscous body": (lambda: euler(_scene(viscous, cable, **held), 1e-3), 20, "density cable_tension"),
        "traction, backward Euler": (lambda: backward(_scene(soft, pull, **held), 0.02, **solved), 4, by_pull),
        "rubber on a floor, BDF2": (lambda: bdf2(_scene(rubber, floor, **thrown), 0.01, **solved), 5, by_c10),
        "ten nodes, midpoint rule": (lambda: midpoint(_scene(soft, mesh=_bar(2), **held), 0.02, **solved), 3, by_E),
        "equilibrium, nu = 0.49": (lambda: static(_scene(stiff, press, **squeezed)), 1, "poissons_ratio pressure"),
        "equilibrium by rest shape": (lambda: static(_scene(soft, **held)), 1, "rest_positions"),
        "reaction of a support": (lambda: verlet(_scene(soft, **held), 2e-3), 10, "density", support),
    }


def _numbers(solver: Callable[[], Solver], steps: int, inputs: str, *outputs: ds.Reaction) -> list[float]:
    """A weighted sum of what a rollout ends with, and its derivative along a direction of each input."""
    rollout = ds.Rollout(solver(), steps, gradients=inputs.split(), outputs=outputs)
    frames = rollout.forward()
    name = next(iter(rollout.computed), "displacements")
    end = np.asarray(frames[name], dtype=np.float64)
    weights = np.zeros(end.shape)
    weights[-1] = np.cos(np.arange(end[-1].size)).reshape(end[-1].shape)
    by_input = rollout.vjp(frames, **{"positions" if name == "displacements" else name: weights})
    sums = [float((g * np.cos(np.arange(g.size)).reshape(g.shape)).sum()) for g in map(np.asarray, by_input.values())]
    return [float((weights * end).sum()), *sums]


def _seconds(work: Callable[[], object]) -> float:
    """Of the quickest of five."""
    times = []
    for _ in range(5):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return min(times)


def _speed() -> tuple[float, float]:
    """Gradient to forward, and forward to NumPy's product of two matrices for each tetrahedron and substep."""
    mesh = ds.TetrahedralMesh.create_cube(11, 0.5)
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), terms=[ds.Gravity()], precision="f32")
    rollout = ds.Rollout(ds.SemiImplicitSolver(scene, dt=5e-4, substeps=1), 50)
    frames = rollout.forward()
    seed = np.ones(frames.positions.shape)
    rollout.vjp(frames, positions=seed)
    matrices = np.random.default_rng(0).standard_normal((mesh.num_tetrahedra, 3, 3)).astype(np.float32)
    forward = _seconds(rollout.forward)
    gradient = _seconds(lambda: rollout.vjp(rollout.forward(), positions=seed))
    return gradient / forward, forward / (50 * _seconds(lambda: matrices @ matrices))


def _versions() -> str:
    """Of the package and of what it needs, the system, the backends."""
    said = [f"Python {platform.python_version()}"]
    for name in ("taichi", "torch", "numpy", "scipy", "meshio", "pyamg"):
        try:
            said.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            said.append(f"{name}: not installed by pip")
    backends = ", ".join(runtime.available_archs())
    return (
        f"diffsim_ti {ds.__version__}; {', '.join(said)}\n{platform.platform()}, {os.cpu_count()} processors; backends: "
        f"{backends}; runs on {runtime.device_name()}"
    )


def selftest(
    backend: opt.Backend = "cpu",
    precision: Annotated[str | None, Option(help="f32 or f64; default f64, on Vulkan f32")] = None,
    numbers: Annotated[bool, Option("--numbers", hidden=True)] = False,
) -> None:
    """Run ten scenes with gradients and compare them with stored numbers, time two pieces of work, and print a report
    that can be pasted into an issue. Exit code 1 if a number or a ratio of times is not as stored."""
    begin, wrong = time.perf_counter(), 0
    precision = precision or ("f32" if backend == "vulkan" else "f64")
    runtime.init(backend, precision)
    print(f"{_versions()} in {precision}\n\n{'scene':26s} {'largest rel. difference':>24s} {'seconds':>8s}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for title, scene in _scenes().items():
            start = time.perf_counter()
            try:
                found = np.array(_numbers(*scene))
                if numbers:
                    print(f"    {title!r}: {found.tolist()},")
                    continue
                off = np.abs(found / STORED[title] - 1).max()
                said = f"{off:24.1e}"
            except Exception as error:  # whatever an installation may raise belongs into the report
                off, said = np.inf, f"{type(error).__name__}: {error}"
            right = off <= TOLERANCE[precision]
            wrong += not right
            print(f"{title:26s} {said} {time.perf_counter() - start:8.1f}  {'right' if right else 'WRONG'}")
        ratios = _speed()
    print()
    for (name, stored), ratio in zip(RATIOS.items(), ratios):
        slow = backend == "cpu" and ratio > SLOW * stored
        wrong += slow
        print(f"time, {name:20s} {ratio:.2f}, stored {stored:.2f}  {'SLOW' if slow else 'as it should be'}")
    print(f"\n{f'{wrong} not as stored' if wrong else 'all as stored'}, after {time.perf_counter() - begin:.0f} s")
    if wrong:
        raise typer.Exit(1)
