"""DiffPD's two identifications: a body let go and a ball thrown onto a rough floor, from twenty random starts.

    python examples/benchmarks/public/diffpd_identification.py [--quick] [--starts 20]

Source: Du et al. 2021, DiffPD, doi:10.1145/3490168, and its public code (MIT licence), whose scripts plant_3d.py and
bouncing_ball_3d.py give these numbers. Equal are the truth, the bounds, the steps, the number of frames, the sum of
squared distances over all frames as cost, densities, the ball's first velocity and height, log E and log nu as unknowns
of L-BFGS. Not equal: a cantilever stands in for the plant; both meshes are our own, of 40 tetrahedra; the law is the
corotated one of Stomakhin et al. 2012, where theirs is projective dynamics' corotated energy with a penalty of volume;
friction 0.4 is our own choice. DiffPD publishes a search from one start each, stopped after ten iterations: no share of
starts that arrive. It is C++ that is built from source, so it does not run here.

A start arrives when E is within 1 % and nu within 0.01 of the truth. A search ends when it arrives, or after 100
simulations. `identify` may begin up to five further searches, the first from what the first part of the motion says; the
other methods have one start. A
forward, a tangent and a reverse run count as a simulation each. Times leave out compiling; the two tasks run at the
same time, a process each.
"""

import sys
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from scipy.optimize import minimize
from threadpoolctl import threadpool_limits

import diffsim_ti as ds

sys.path.insert(0, str(Path(__file__).parent))
from table import parser, report  # noqa: E402

NAMES = "youngs_modulus", "poissons_ratio"
NEAR = 0.01, 0.01  # of E, a share; of nu
MOST = 100  # simulations of a search


def ball(cells: int, radius: float) -> ds.TetrahedralMesh:
    """A cube of so many cells, each shell of which is pushed onto a sphere."""
    cube = ds.TetrahedralMesh.create_box(cells + 1, 2.0, "five", (-1, -1, -1))
    x = cube.vertices
    length = np.maximum(np.linalg.norm(x, axis=1), 1e-12)
    return ds.TetrahedralMesh(x * (radius * np.abs(x).max(1) / length)[:, None], cube.tetrahedra)


def cantilever(quick: bool) -> tuple:
    """(rollout, truth, bounds of E, of nu): bent and stretched, it is let go."""
    mesh = ds.TetrahedralMesh.create_box((5, 2, 2) if quick else (9, 2, 2), (0.5, 0.1, 0.1), "five")
    s = mesh.vertices[:, 0] / 0.5
    bent = mesh.vertices + np.stack([0.02 * s, 0.1 * s**2, 0.05 * s**2], 1)
    scene = ds.Scene(mesh, ds.Corotated(1e6, 0.4), 5e3, fixed="xmin", initial_positions=bent, precision="f64")
    rollout = ds.Rollout(ds.ImplicitEulerSolver(scene, dt=0.01), 40 if quick else 200, save_every=1)
    return rollout, (1e6, 0.4), (1e4, 5e6), (0.2, 0.45)


def thrown_ball(quick: bool) -> tuple:
    """(rollout, truth, bounds of E, of nu): thrown at 1.5, -1 and 0.5 m/s along x, y and z from 7 cm above a rough floor."""
    mesh = ball(2, 0.1).translated((0, 0.17, 0))
    scene = ds.Scene(
        mesh,
        ds.Corotated(2e6, 0.4),
        1e3,
        [ds.Gravity(), ds.Ground(0.0, friction=0.4)],
        initial_velocities=(1.5, -1.0, 0.5),
        precision="f64",
    )
    rollout = ds.Rollout(ds.ImplicitEulerSolver(scene, dt=0.004), 35 if quick else 125, save_every=1)
    return rollout, (2e6, 0.4), (1e6, 1e7), (0.2, 0.45)


class Task:
    """A rollout, what it showed at the truth, and where searches begin."""

    def __init__(self, made: tuple, starts: int, first: tuple | None = None):
        self.rollout, self.truth, *self.bounds = made
        self.seen = self.rollout.forward(**dict(zip(NAMES, self.truth))).positions
        rng = np.random.default_rng(42)
        low, high = np.log(self.bounds).T
        drawn = np.exp(rng.uniform(low, high, (starts, 2)))
        self.starts = [first, *drawn[1:]] if first is not None else list(drawn)

    def is_near(self, x) -> bool:
        return abs(x[0] / self.truth[0] - 1) < NEAR[0] and abs(x[1] - self.truth[1]) < NEAR[1]


class Watch:
    """Simulations and seconds of a search until the best point so far is near the truth; then the search is ended."""

    def __init__(self, task: Task):
        self.task, self.simulations, self.begin, self.best = task, 0, time.perf_counter(), np.inf

    def note(self, x, cost: float) -> None:
        if cost < self.best:
            self.best, self.x = cost, np.array(x)
        if self.task.is_near(self.x) or self.simulations >= MOST:
            raise StopIteration

    def told(self) -> tuple:
        """(whether it arrived, simulations, seconds)"""
        return (
            self.task.is_near(self.x) and self.simulations <= MOST + 1,
            self.simulations,
            time.perf_counter() - self.begin,
        )


def by_identify(task: Task, start) -> tuple:
    """`identify` as it comes: Gauss-Newton by tangent runs, begun anew from elsewhere where data are not met."""
    watch = Watch(task)

    def note(row, frames):
        watch.simulations = row["simulations"]
        try:
            watch.note(row["numbers"], row["cost"])
        except StopIteration:
            return True

    unknowns = {name: ds.Unknown(x, range=tuple(b)) for name, x, b in zip(NAMES, start, task.bounds)}
    options = dict(noise=1e-5, covariance=False, check_mesh=False, callback=note)
    ds.identify(task.rollout, {"positions": task.seen}, unknowns, **options)
    return watch.told()


def by_scipy(task: Task, start, method: str) -> tuple:
    """L-BFGS-B by a reverse run, or Nelder and Mead's method by values alone, over log E and log nu within their bounds."""
    watch, gradients = Watch(task), method == "L-BFGS-B"
    scale = None

    def cost(y):
        nonlocal scale
        x = np.exp(y)
        frames = task.rollout.forward(**dict(zip(NAMES, x)))
        off = frames.positions - task.seen
        value = 0.5 * float((off**2).sum())
        watch.simulations += 1
        scale = value if scale is None else scale  # the first cost is one, as DiffPD's is of the order of one
        watch.note(x, value)
        if not gradients:
            return value / scale
        g = task.rollout.vjp(frames, positions=off)
        watch.simulations += 1
        return value / scale, np.array([float(g[name]) for name in NAMES]) * x / scale

    options = dict(maxfun=MOST, ftol=1e-16, gtol=1e-12) if gradients else dict(xatol=1e-6, fatol=0.0, maxfev=MOST)
    try:
        minimize(cost, np.log(start), jac=gradients, method=method, bounds=np.log(task.bounds), options=options)
    except StopIteration:
        pass
    return watch.told()


METHODS = {
    "`identify`": by_identify,
    "L-BFGS-B by reverse runs": lambda task, start: by_scipy(task, start, "L-BFGS-B"),
    "Nelder-Mead, no gradients": lambda task, start: by_scipy(task, start, "Nelder-Mead"),
}
# how it is made, and the published start, which comes first
TASKS = {"cantilever": (cantilever, None), "ball on a rough floor": (thrown_ball, (0.99e7, 0.4455))}


def searched(name: str, quick: bool, starts: int) -> dict:
    """{method: [(arrived, simulations, seconds) of each start]}"""
    make, first = TASKS[name]
    task = Task(make(quick), starts, first)
    frames = task.rollout.forward()  # compiles, with what follows
    task.rollout.vjp(frames, positions=np.zeros_like(task.seen))
    task.rollout.tangents(frames, youngs_modulus=1.0)
    out = {method: [] for method in METHODS}
    for k, start in enumerate(task.starts):
        for method, search in METHODS.items():
            out[method].append(search(task, start))
        told = ", ".join(f"{runs[-1][1]}{'' if runs[-1][0] else ' (not there)'}" for runs in out.values())
        print(f"{name}, start {k + 1}: E {start[0]:.3g} Pa, nu {start[1]:.3f}: simulations {told}", flush=True)
    return out


def alone(*arguments) -> dict:
    """`searched` in a process of its own."""
    ds.init("cpu", precision="f64", threads=1)
    with threadpool_limits(1):
        return searched(*arguments)


HEAD = ["task", "search", "starts that arrive", "simulations: median (most)", "seconds: median (most)"]


def rows_of(found: dict) -> list:
    """Of the starts that arrive the median and the largest number of simulations, and of seconds."""
    rows = []
    for task, methods in found.items():
        for method, runs in methods.items():
            there = np.array([run[1:] for run in runs if run[0]], float).reshape(-1, 2)
            cells = ["", ""]
            if len(there):
                (n, s), (most, longest) = np.median(there, 0), there.max(0)
                cells = [f"{n:.0f} ({most:.0f})", f"{s:.2g} ({longest:.2g})"]
            rows.append([task, method, f"{len(there)} of {len(runs)}", *cells])
    return rows


def main() -> None:
    options = parser(__doc__, peers=False)
    options.add_argument("--starts", type=int, default=20)
    given = options.parse_args()
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        each = {name: pool.submit(alone, name, given.quick, 2 if given.quick else given.starts) for name in TASKS}
        found = {name: one.result() for name, one in each.items()}
    partial = given.quick or given.starts != options.get_default("starts")
    report("diffpd_identification", HEAD, rows_of(found), partial)


if __name__ == "__main__":
    main()
