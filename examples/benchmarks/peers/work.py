"""Jobs for the peers made from scenes and problems of diffsim_ti, the peers run on them, their errors."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from diffsim_ti.study.problem import Problem, distance
from diffsim_ti.study.work_precision import SHARE
from diffsim_ti.terms import Drag, Gravity, Obstacle

HERE = Path(__file__).parent
PEERS = {
    "torch-diffsim": ("run_torch_diffsim.py", "diffsim"),
    "Warp": ("run_warp.py", "warp"),
    "JAX": ("run_jax.py", "jax"),
}
# what `pip install` is given for each, in an environment of its own
PINNED = {
    "torch-diffsim": ("torch==2.13.0", "torch-diffsim==0.2.0"),
    "Warp": ("warp-lang==1.19.0", "numpy==2.4.6"),
    "JAX": ("jax==0.10.2",),
    "Newton": ("newton==1.8.0", "warp-lang==1.19.0"),
    "torch-fem": ("torch==2.13.0", "torch-fem==0.14.0"),
}


def versions(*names: str) -> dict[str, str]:
    """{package: version} of what these peers are measured with; NumPy's is left to ours."""
    pins = (pin.split("==") for who in names for pin in PINNED[who])
    return {package: version for package, version in pins if package != "numpy"}


def ran(command, timeout: float = 3600.0, **environment: str) -> tuple[str, str]:
    """(what a command prints, why it failed or "")"""
    try:
        words = list(map(str, command))
        said = subprocess.run(words, capture_output=True, text=True, timeout=timeout, env=os.environ | environment)
    except subprocess.TimeoutExpired:
        return "", f"not done after {timeout:.0f} s"
    if not said.returncode:
        return said.stdout, ""
    lines = [line for line in said.stderr.splitlines() if line.strip()]
    named = [line for line in lines if line.startswith("ERROR")]  # pip's; its last lines are hints
    return said.stdout, (named[:1] or lines[-1:] or ["it failed and gave no reason"])[0]


def installed(python: str) -> list[str]:
    """The peers that an interpreter has."""
    code = "import importlib.util, sys; print(*(n for n in sys.argv[1:] if importlib.util.find_spec(n)))"
    modules = [module for _, module in PEERS.values()]
    found = subprocess.run([python, "-c", code, *modules], capture_output=True, text=True, check=True).stdout.split()
    return [who for who, (_, module) in PEERS.items() if module in found]


def scene_numbers(scene, h: float) -> dict:
    """What a job says of a scene; E and nu are the same everywhere."""
    values, ground, gravity = scene.inputs.values, scene.term(Obstacle), scene.term(Gravity)
    drag = scene.term(Drag)
    return dict(
        vertices=scene.mesh.vertices,
        tetrahedra=scene.mesh.tetrahedra,
        start=values["initial_positions"],
        velocities=values["initial_velocities"],
        fixed=np.asarray(scene.fixed, int),
        density=float(np.mean(values["density"])),
        E=float(np.mean(values.get("youngs_modulus", 0))),
        nu=float(np.mean(values.get("poissons_ratio", 0))),
        h=h,
        gravity=0.0 if gravity is None else float(values["gravity"][1]),
        keep=1.0 if drag is None else float(np.exp(-values["drag_rate"] * h)),
        ground=np.array([values[n] for n in ("barrier_stiffness", "barrier_width")], float) if ground else np.zeros(0),
    )


def problem_job(problem: Problem, scene, substeps: int, repeats: int = 3) -> dict:
    """A job of a built-in problem: symplectic Euler with so many substeps a frame."""
    job = scene_numbers(scene, problem.duration / problem.frames / substeps)
    job |= dict(frames=problem.frames, substeps=substeps, repeats=repeats)
    if problem.differentiates:
        watch = problem.adjoint
        job |= dict(weights=watch.weights(scene.mesh), linear=watch.linear, square=watch.square, target=watch.target)
    return job


def ask(who: str, python: str, jobs: list[dict]) -> list[dict]:
    """A peer's answers: seconds, displacements, gradients; None for a job that failed, with the reason on stderr."""
    script = HERE / PEERS[who][0]
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{k}.job.npz" for k in range(len(jobs))]
        for path, job in zip(paths, jobs):
            np.savez(path, **job)
        answers = []
        for path in paths:  # a process each: one that fails leaves the others
            _, why = ran([python, script, path])
            result = Path(str(path).replace(".job.npz", ".answer.npz"))
            if why or not result.exists():
                print(f"{who}: {why or 'it left no answer'}", file=sys.stderr)
                answers.append(None)
                continue
            with np.load(result) as file:
                answers.append({name: value[()] for name, value in file.items()})
    return answers


def numbers(problem: Problem, scene, answer: dict) -> np.ndarray:
    """The problem's numbers from a peer's frames and gradients."""
    rest = scene.mesh.vertices
    times = np.linspace(0, problem.duration, problem.frames + 1)
    frames = SimpleNamespace(
        displacements=answer["displacements"],
        positions=rest + answer["displacements"],
        times=times,
        inputs=dict(rest_positions=rest),
    )
    return problem.quantity(frames, answer)


def first_substeps(problem: Problem, scene) -> int:
    """Substeps per frame at the stable step of the start, with the margin of the charts."""
    from diffsim_ti.solvers import SemiImplicitSolver

    frame = problem.duration / problem.frames
    stable = SemiImplicitSolver(scene, dt=frame, allow_unstable=True).stable_dt(tight=True).dt
    return int(np.ceil(frame / min(SHARE * stable, problem.largest_step)))


def peer_points(
    problem: Problem, who: str, python: str, cells, levels: int = 1, right=None
) -> list[tuple[float, float]]:
    """[(seconds per simulated second, error)] of a peer on the problem, pattern "five", on meshes of so many cells across,
    at the stable step and `levels - 1` halves of it.

    Errors are against the problem's closed form or `right(scene, answers)`; default the motion extrapolated from the peer's
    own last two steps, whose first-order error falls by half.
    """
    out = []
    for n in cells:
        scene = problem.scene(n, problem.patterns[0], "f32")
        first = first_substeps(problem, scene)
        own = problem.exact is None and right is None
        steps = [first * 2**k for k in range(levels + own)]
        answers = ask(who, python, [problem_job(problem, scene, k) for k in steps])
        found = [None if a is None else numbers(problem, scene, a) for a in answers]
        if any(a is None for a in found[-2:]):
            continue
        exact = problem.exact if right is None else right(n)
        if own:
            exact = 2 * found[-1] - found[-2]
        out += [
            (float(a["seconds"]) / problem.duration, distance(problem, q, exact))
            for a, q in list(zip(answers, found))[:levels]
            if q is not None
        ]
    return out
