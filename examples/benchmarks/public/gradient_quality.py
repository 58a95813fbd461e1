"""Are gradients those of the program's own motion? Of several tools, for six tasks, over twenty random scenes each.

    python examples/benchmarks/public/gradient_quality.py [--quick] [--peers FOLDER] [--tools NAME ...]

The measure is that of the Mosaic benchmark of differentiable solvers: the cosine between a tool's gradient and
differences of what the same tool computes forward, and the size of what they differ by, relative to the differences. So
no tool is judged by the physics of another: each has its own law, floor and friction, and rounds as it rounds.

Four tasks move, by symplectic Euler in steps of 0.1 ms: a block that swings, a beam that is let go under its weight, a
block that falls flat on a floor, a block that is thrown onto it askew. The loss is a random linear function of the
vertices' places at the end. Its gradient is by log E and by four random fields of 1 cm of the start. Two tasks are
equilibria: a beam under random loads, and a block pulled to 1.5 times its length; there the gradient is by log E of
three thirds of the body, by Poisson's ratio, and by three random fields of load. Differences are central and of order
six. How well they are known is seven times how far those of order four are from them: where rounding makes that
difference, the error of order six is seven times as large. In float64 their steps are a tenth as long.

Tools: torch-diffsim's own classes; Newton's soft body (what Warp's own simulator became); a tape over Taichi's kernels,
which is ours, in the manner of DiffTaichi's examples (peers/run_tape.py); torch-fem in statics (JAX-FEM's solver needs
PETSc, which pip has to build from source). torch-diffsim, Newton and the tape compute in float32, torch-fem in float64.
With --peers each is installed into an environment of its own in FOLDER, and what does not install is left out with the
reason. --tools takes some of them, --show prints each scene. The page stays as it is with these, with other --scenes,
and without --peers.
"""

import contextlib
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

import diffsim_ti as ds

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
from compare_peers import interpreters  # noqa: E402
from peers import work  # noqa: E402
from table import parser, report  # noqa: E402

H, STEPS = 1e-4, 100  # [s]; of the tasks that move
FIELDS, BY_LOG_E, BY_FIELD = 4, 0.03, 3e-4  # of the start; steps of differences: of log E, of a field [m]
UNIT = 0.01  # [m]
SIXTH, FOURTH = np.array([45, -9, 1]) / 60, np.array([8, -1, 0]) / 12  # of f(k) - f(-k), k = 1, 2, 3
DOUBT = float(
    np.linalg.norm(SIXTH) / np.linalg.norm(FOURTH - SIXTH)
)  # what rounding does to sixth, seen in that difference
OFFSETS = np.array([1, -1, 2, -2, 3, -3])


def central(values) -> tuple[np.ndarray, np.ndarray]:
    """(differences of order six, of order four) from values at OFFSETS, the last axis, for a step of one."""
    odd = values[..., ::2] - values[..., 1::2]
    return odd @ SIXTH, odd @ FOURTH


def compared(gradient, sixth, fourth) -> tuple[float, float, float]:
    """(cosine, relative error, relative doubt about the differences)"""
    size = np.linalg.norm(sixth)
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = gradient @ sixth / (np.linalg.norm(gradient) * size)
    doubt = DOUBT * np.linalg.norm(fourth - sixth) / size
    return float(cosine), float(np.linalg.norm(gradient - sixth) / size), float(doubt)


# ---- bodies that move ---------------------------------------------------------------------------------------------------


class Moving:
    """A task: a body, whether it is held, whether there is a floor; its random scenes as jobs for all tools."""

    def __init__(self, name: str, cells, size, held=False, floor=False, askew=False):
        self.name, self.held, self.floor, self.askew = name, held, floor, askew
        self.mesh = ds.TetrahedralMesh.create_box(np.array(cells) + 1, size, "five")

    def job(self, seed: int) -> dict:
        """A random scene: moduli, start, velocity, loss."""
        rng, x = np.random.default_rng(seed), self.mesh.vertices
        E, nu = np.exp(rng.uniform(*np.log((3e4, 2e5)))), rng.uniform(0.2, 0.42)
        start, velocity = x + 0.0, np.zeros_like(x)
        if not self.held:
            middle = x.mean(0)
            start = middle + (x - middle) @ (np.eye(3) + 0.05 * rng.standard_normal((3, 3)))
        if self.floor:
            velocity += [0.0, -rng.uniform(0.8, 1.5), 0.0]
            if self.askew:
                axis, turn = rng.standard_normal(3), ds.TetrahedralMesh(x, self.mesh.tetrahedra)
                start = turn.rotated(axis / np.linalg.norm(axis), rng.uniform(0.2, 0.6)).vertices
                velocity += [rng.uniform(0.5, 1.0), 0.0, rng.uniform(-1.0, 1.0)]
            start = start + [0.0, 0.008 - start[:, 1].min(), 0.0]
        weights = rng.standard_normal(x.shape)
        return dict(
            vertices=x,
            tetrahedra=self.mesh.tetrahedra,
            start=start,
            velocities=velocity,
            fixed=self.held_vertices,
            density=1000.0,
            E=E,
            nu=nu,
            h=H,
            gravity=-9.8 if self.held or self.floor else 0.0,
            keep=1.0,
            ground=np.array([5e3, 0.005]) if self.floor else np.zeros(0),
            frames=1,
            substeps=STEPS,
            repeats=1,
            weights=weights / np.linalg.norm(weights),
            linear=np.array([0.0, 1.0]),
            square=np.zeros(2),
            target=np.zeros(2),
            fields=np.where(np.isin(np.arange(len(x)), self.held_vertices)[:, None], 0.0, self.fields(rng)),
        )

    @property
    def held_vertices(self) -> np.ndarray:
        return self.mesh.vertex_indices("xmin") if self.held else np.zeros(0, int)

    def fields(self, rng) -> np.ndarray:
        return rng.standard_normal((FIELDS, *self.mesh.vertices.shape))


def changed_starts(job: dict, share: float = 1.0) -> np.ndarray:
    """The start itself, then each field by all offsets, shape (1 + fields x offsets, n, 3)."""
    changes = share * BY_FIELD * OFFSETS[:, None, None] * job["fields"][:, None]
    return np.concatenate([job["start"][None], job["start"] + changes.reshape(-1, *job["start"].shape)])


def in_pieces(job: dict) -> dict:
    """The job with all changed starts at once, as pieces of one body; the loss is that of the first."""
    starts = changed_starts(job)
    k, n = len(starts), len(job["vertices"])
    shift = n * np.arange(k)
    weights = np.zeros((k, n, 3))
    weights[0] = job["weights"]
    out = {name: value for name, value in job.items() if name != "fields"}
    return out | dict(
        vertices=np.tile(job["vertices"], (k, 1)),
        tetrahedra=(job["tetrahedra"] + shift[:, None, None]).reshape(-1, 4),
        start=starts.reshape(-1, 3),
        velocities=np.tile(job["velocities"], (k, 1)),
        fixed=(job["fixed"] + shift[:, None]).ravel(),
        weights=weights.reshape(-1, 3),
    )


def jobs_of(job: dict, gradients: bool) -> list[dict]:
    """What a tool is asked for one scene: all starts with the gradient, then each change of E, with gradients or without."""
    left = {"fields"} | (set() if gradients else {"weights", "linear", "square", "target"})
    alone = {name: value for name, value in job.items() if name not in left}
    return [in_pieces(job), *(alone | dict(E=job["E"] * np.exp(BY_LOG_E * k)) for k in OFFSETS)]


def judged(job: dict, pieces, by_moduli, gradients, share: float = 1.0) -> tuple[float, float, float]:
    """From displacements at the end of all starts and of all changes of E, and the gradients of the first."""
    losses = np.tensordot(np.asarray(pieces).reshape(-1, *job["weights"].shape), job["weights"], 2)[1:]
    E_losses = np.array([np.tensordot(u, job["weights"], 2) for u in by_moduli])
    both = zip(central(E_losses), central(losses.reshape(FIELDS, -1)))
    sixth, fourth = (np.append(e / BY_LOG_E, UNIT * f / BY_FIELD) / share for e, f in both)
    by_start = np.asarray(gradients["initial_positions"])[: len(job["weights"])]
    g = np.append(gradients["youngs_modulus"] * job["E"], UNIT * np.tensordot(job["fields"], by_start, 2))
    return compared(g, sixth, fourth)


def answers(python: str, script: Path, jobs: list[dict], timeout: float = 240.0) -> tuple[list, str]:
    """(the answers of a tool to jobs, all in one process, why there are no more)"""
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{k}.job.npz" for k in range(len(jobs))]
        for path, job in zip(paths, jobs):
            np.savez(path, **job)
        _, why = work.ran([python, script, *paths], timeout)
        out = []
        for path in paths:
            with contextlib.suppress(OSError), np.load(str(path).replace(".job.", ".answer.")) as file:
                out.append({name: value[()] for name, value in file.items()})
        return out, why


def moving_by_peer(python: str, script: Path, task: Moving, seeds) -> tuple[list, str]:
    """([(cosine, error, doubt) of each scene], why there are no more)"""
    scenes = [task.job(seed) for seed in seeds]
    always = "torch_diffsim" in script.name  # its simulator without gradients is another one
    told, why = answers(python, script, [one for job in scenes for one in jobs_of(job, always)])
    each, out = 1 + len(OFFSETS), []
    for k, job in enumerate(scenes):
        part = told[k * each : (k + 1) * each]
        if len(part) == each:
            first, *rest = part
            out.append(judged(job, first["displacements"][-1], [a["displacements"][-1] for a in rest], first))
    return out, why


def moving_by_us(precision: str, task: Moving, seeds) -> list:
    """The same, by a rollout whose inputs change."""
    job = task.job(0)
    terms = [ds.Gravity(job["gravity"])]
    if task.floor:
        terms.append(ds.Ground(0.0, *job["ground"], friction=0.3 if task.askew else 0.0))
    scene = ds.Scene(
        task.mesh,
        ds.SmithNeoHookean(1e5, 0.3),
        1000.0,
        terms,
        fixed="xmin" if task.held else None,
        initial_positions=job["start"],
        initial_velocities=job["velocities"],
        precision=precision,
    )
    share = 0.1 if precision == "f64" else 1.0
    rollout = ds.Rollout(ds.SemiImplicitSolver(scene, dt=H * STEPS, substeps=STEPS), 1)
    out = []
    for job in map(task.job, seeds):
        given = dict(
            youngs_modulus=job["E"],
            poissons_ratio=job["nu"],
            initial_positions=job["start"],
            initial_velocities=job["velocities"],
        )

        def end(given=given, **changed):
            return rollout.forward(**(given | changed))

        frames = end()
        seed = np.zeros((len(frames.positions), *job["weights"].shape))
        seed[-1] = job["weights"]
        gradients = rollout.vjp(frames, positions=seed)
        pieces = [end(initial_positions=x).displacements[-1] for x in changed_starts(job, share)]
        by_E = [end(youngs_modulus=job["E"] * np.exp(share * BY_LOG_E * k)).displacements[-1] for k in OFFSETS]
        out.append(judged(job, pieces, by_E, gradients, share))
    return out


# ---- equilibria ---------------------------------------------------------------------------------------------------------


class Still:
    """A task: a body held at one end, under random loads, or pulled at the other end."""

    def __init__(self, name: str, cells, size, pulled: float = 0.0):
        self.name, self.pulled = name, pulled
        self.mesh = ds.TetrahedralMesh.create_box(np.array(cells) + 1, size, "five")

    def job(self, seed: int) -> dict:
        """Theta is log E of three thirds, nu and factors of three fields of load; all other numbers of a scene."""
        rng, mesh = np.random.default_rng(seed), self.mesh
        x, length = mesh.vertices, np.ptp(mesh.vertices[:, 0])
        third = np.minimum((3 * (mesh.centroids[:, 0] - x[:, 0].min()) / length).astype(int), 2)
        theta = np.array([*rng.uniform(np.log(5e4), np.log(2e5), 3), rng.uniform(0.2, 0.42), *rng.uniform(0.5, 1, 3)])
        ends = [mesh.vertex_indices("xmin")] + [mesh.vertex_indices("xmax")] * bool(self.pulled)
        moved = np.zeros_like(x)
        if self.pulled:
            moved[ends[1], 0] = self.pulled * length
        loads = rng.standard_normal((3, *x.shape)) * (0.2 / len(x))
        loads[:, np.concatenate(ends)] = 0
        loads[:, :, 1] -= 0.3 / len(x) * (not self.pulled)
        return dict(
            vertices=x,
            tetrahedra=mesh.tetrahedra,
            third=third,
            theta=theta,
            fixed=np.concatenate(ends),
            moved=moved,
            loads=loads,
            weights=rng.standard_normal(x.shape),
            steps=np.array([*[BY_LOG_E] * 3, 0.003, *[0.02] * 3]),
        )


def still_judged(job: dict, loss, gradient) -> tuple[float, float, float]:
    """From the loss as a function of theta."""
    steps = job["steps"]
    values = np.array([[loss(job["theta"] + k * row) for k in OFFSETS] for row in np.diag(steps)])
    sixth, fourth = central(values)
    return compared(gradient, sixth / steps, fourth / steps)


def still_by_us(precision: str, task: Still, seeds) -> list:
    job = task.job(0)
    scene = ds.Scene(
        task.mesh,
        ds.StableNeoHookean(1e5, 0.3),
        1000.0,
        [ds.ExternalForce(job["loads"].sum(0))],
        fixed=dict.fromkeys(["xmin", "xmax"] if task.pulled else ["xmin"], "xyz"),
        motion={"xmax": lambda t: [t * job["moved"].max(), 0.0, 0.0]} if task.pulled else None,
        precision=precision,
    )
    inputs = ["youngs_modulus", "poissons_ratio", "external_forces"]
    rollout = ds.Rollout(ds.StaticSolver(scene, dt=1.0, tolerance=1e-10), 1, gradients=inputs)
    out = []
    for job in map(task.job, seeds):

        def run(theta, job=job):
            E, loads = np.exp(theta[job["third"]]), np.tensordot(theta[4:], job["loads"], 1)
            return rollout.forward(youngs_modulus=E, poissons_ratio=theta[3], external_forces=loads)

        frames = run(job["theta"])
        seed = np.zeros_like(frames.positions)
        seed[-1] = job["weights"]
        found = rollout.vjp(frames, positions=seed)
        by_E = found["youngs_modulus"] * np.exp(job["theta"][job["third"]])
        g = np.array(
            [
                *np.bincount(job["third"], by_E, 3),
                float(np.sum(found["poissons_ratio"])),
                *np.tensordot(job["loads"], found["external_forces"], 2),
            ]
        )
        out.append(still_judged(job, lambda t, w=job["weights"]: float((run(t).displacements[-1] * w).sum()), g))
    return out


def still_by_peer(python: str, script: Path, task: Still, seeds) -> tuple[list, str]:
    """The peer answers with its loss at all points that differences take, and its gradient at theta."""
    scenes = [task.job(seed) for seed in seeds]
    told, why = answers(python, script, [job | dict(offsets=OFFSETS) for job in scenes])
    out = []
    for answer, job in zip(told, scenes):
        sixth, fourth = central(answer["values"])
        out.append(compared(answer["gradient"], sixth / job["steps"], fourth / job["steps"]))
    return out, why


# ---- all of it ----------------------------------------------------------------------------------------------------------

TASKS = (
    Moving("a block swings", (2, 2, 2), 0.1),
    Moving("a beam is let go", (4, 1, 1), (0.2, 0.05, 0.05), held=True),
    Moving("a block falls flat", (2, 2, 2), 0.1, floor=True),
    Moving("a block is thrown askew", (2, 2, 2), 0.1, floor=True, askew=True),
    Still("a beam at rest", (6, 2, 2), (0.3, 0.1, 0.1)),
    Still("a block pulled to 1.5", (3, 2, 2), (0.15, 0.1, 0.1), pulled=0.5),
)
# who: the script for what moves, or for equilibria, and what is installed for it
PEERS = {
    "torch-diffsim": ("run_torch_diffsim.py", None),
    "Newton": ("run_newton.py", None),
    "tape over Taichi": ("run_tape.py", None),
    "torch-fem": (None, "gradient_torch_fem.py"),
}


def measured(tools, pythons: dict, scenes: int, show: bool = False, tasks=TASKS) -> tuple[list, list]:
    """(rows of the table, what was said of tools that stopped)"""
    rows, said, pool, asked = [], [], ThreadPoolExecutor(2), {}  # no time is told, so two may run at once
    for task in tasks:
        moves = isinstance(task, Moving)
        for who, scripts in PEERS.items():
            script = scripts[0 if moves else 1]
            if who in tools and who in pythons and script:
                run = moving_by_peer if moves else still_by_peer
                where = HERE.parent / "peers" / script
                asked[task.name, who] = pool.submit(run, pythons[who], where, task, range(scenes))
    for task in tasks:
        moves, found = isinstance(task, Moving), {}
        for precision in ("f32", "f64"):
            ours = moving_by_us if moves else still_by_us
            if f"diffsim_ti, {precision}" in tools and (moves or precision == "f64"):
                found[f"diffsim_ti, {precision}"] = ours(precision, task, range(scenes))
        for who in PEERS:
            if (task.name, who) in asked:
                found[who], why = asked[task.name, who].result()
                if why:
                    said.append(f"{task.name}, {who}: {why}")
                    print(said[-1], flush=True)
        for who, numbers in found.items():
            if show:
                for k, (cosine, error, doubt) in enumerate(numbers):
                    print(f"{task.name}, {who}, scene {k}: cosine {cosine:.6f}, error {error:.2e}, doubt {doubt:.1e}")
            if numbers:
                rows.append([task.name, who, *row_of(np.array(numbers)), f"{len(numbers)} of {scenes}"])
                print(*rows[-1], sep=" | ", flush=True)
    return rows, said


def row_of(numbers: np.ndarray) -> list[str]:
    """Median and worst of the cosines, of the errors; median and worst doubt."""
    cosine, error, doubt = numbers.T
    off = 1 - cosine
    return [
        f"{off_one(np.median(off))}, {off_one(off.max())}",
        f"{np.median(error):.1e}, {error.max():.1e}",
        f"{np.median(doubt):.1e}, {doubt.max():.1e}",
    ]


def off_one(x: float) -> str:
    """A cosine by how far it is off one."""
    if not np.isfinite(x):
        return "not finite"
    return "1" if x < 1e-15 else f"1 - {x:.0e}" if x < 0.01 else f"{1 - x:.2f}"  # below is rounding


HEAD = ["task", "tool", "cosine: median, worst", "error: median, worst", "of the differences", "scenes"]


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--tools", nargs="+", default=["diffsim_ti, f32", "diffsim_ti, f64", *PEERS])
    options.add_argument("--scenes", type=int, default=20)
    options.add_argument("--show", action="store_true", help="each scene by itself")
    given = options.parse_args()
    wanted = [who for who in PEERS if who in given.tools and who in work.PINNED]
    peers, notes = interpreters(given.peers, wanted) if given.peers else ({}, [])
    pythons = {"tape over Taichi": sys.executable} | peers
    scenes, tasks = (2, TASKS[2:5:2]) if given.quick else (given.scenes, TASKS)  # of each kind one
    rows, said = measured(given.tools, pythons, scenes, given.show, tasks)
    asked = (given.tools, given.scenes) != tuple(map(options.get_default, ("tools", "scenes")))
    partial = given.quick or given.show or asked or not given.peers
    notes += [f"{line.rstrip('.')}." for line in said]
    report("gradient_quality", HEAD, rows, partial, " ".join(notes), **work.versions(*peers))


if __name__ == "__main__":
    import os

    os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
    ds.init("cpu", precision="f64")
    with threadpool_limits(1):
        main()
