"""Random impacts of small bodies on thin walls, needles, plates and balls, at rest and moving, judged by geometry alone.

    python tests/battery_of_impacts.py --cases 200 --seed 0 [--turning] [--rough] [--reduced] [--order 2] [--pairs]
        [--meshed]
        [--solver NAME]

Each case runs once; where it raises, what the error advises is done and the case runs again, three times at most.
--turning: obstacles turn about a point near them as well. --rough: friction. --reduced: the body, or what comes first of it
and is stiffer, moves by few numbers, in implicit steps and static solves. --order 2: of ten-node tetrahedra, on the
same grids. --pairs: points and edges of obstacles act by pairs. --meshed: obstacles are triangles, a segment or a point.
"""

import argparse
import re
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from impact_judge import Judge

import diffsim_ti as ds

SOLVERS = {  # dealt in turn
    "VelocityVerletSolver": ds.VelocityVerletSolver,
    "SemiImplicitSolver": ds.SemiImplicitSolver,
    "ImplicitEulerSolver": ds.ImplicitEulerSolver,
    "BDF2Solver": ds.BDF2Solver,
    "ImplicitMidpointSolver": ds.ImplicitMidpointSolver,
    "StaticSolver": ds.StaticSolver,
}
DENSITY = 1000.0
SHARE = 0.7  # of the stable step at the start, which explicit solvers take


@dataclass
class Case:
    """One impact; the body comes along -x' of its own frame towards an obstacle about the origin."""

    number: int
    seed: int
    solver: str
    kind: str
    precision: str
    speed: float
    dt: float
    youngs_modulus: float
    size: float
    resolution: int
    thickness: float
    moving: bool
    turning: bool = False
    rough: bool = False
    reduced: str | None = None  # how a part of the body moves
    order: int = 1
    pairs: bool = False
    meshed: bool = False
    stiffness: float | None = None  # per area [N/m^3]
    substeps: int = 1  # of explicit solvers: times what stability asks for
    substep: float = float("inf")  # what explicit ones were advised [s]
    advice: list = field(default_factory=list)

    @property
    def wave_speed(self) -> float:
        return float(np.sqrt(self.youngs_modulus / DENSITY))

    @property
    def explicit(self) -> bool:
        return SOLVERS[self.solver].explicit

    @property
    def slow(self) -> bool:
        return self.speed < self.wave_speed

    def __str__(self) -> str:
        words = [
            self.moving and "moving",
            self.turning and "turning",
            self.rough and "rough",
            self.reduced,
            self.order == 2 and "ten nodes",
            self.meshed and "meshed",
        ]
        return (
            f"{self.number}: {self.solver} {self.kind} {self.precision} {self.speed:.3g} m/s dt {self.dt:.3g} s E "
            f"{self.youngs_modulus:.2g} size {self.size:.3g} m, {self.resolution} vertices a side, thickness "
            f"{self.thickness:.3g} m" + "".join(f", {word}" for word in words if word)
        )


def draw(
    number: int,
    seed: int,
    solvers,
    turning: bool = False,
    order: int = 1,
    reduced: bool = False,
    rough: bool = False,
    pairs: bool = False,
    meshed: bool = False,
) -> Case:
    rng, names = np.random.default_rng([seed, number]), list(solvers)
    log = lambda low, high: float(np.exp(rng.uniform(np.log(low), np.log(high))))  # noqa: E731
    return Case(
        number=number,
        seed=seed,
        solver=names[number % len(names)],
        kind=("wall", "needle", "plate", "ball")[int(rng.integers(4))],
        precision="f32" if number % 5 == 4 else "f64",
        speed=log(0.1, 50),
        dt=log(1e-4, 3e-2),  # of explicit solvers: how often one looks
        youngs_modulus=log(1e4, 1e6),
        size=log(0.04, 0.15),
        resolution=int(rng.integers(2, 5)),
        thickness=log(2e-3, 2e-2),
        moving=bool(rng.integers(2)),
        turning=turning,
        rough=rough,
        reduced=("affine", "by functions", "by fields", "rigid")[(number + number // 6) % 4] if reduced else None,
        order=order,
        pairs=pairs,
        meshed=meshed,
    )


def build(case: Case):
    """(solver, steps, Judge's solid, where points lie in the obstacle as it was made at a time) of a case."""
    rng = np.random.default_rng([case.seed, case.number, 1])
    static, width = case.solver == "StaticSolver", 0.25 * float(np.clip(case.thickness, 4e-3, 1.2e-2)) + 1e-3
    if case.explicit:
        case = replace(case, dt=min(case.dt, 0.25 * case.size / case.speed))
    mesh = ds.TetrahedralMesh.create_box(max(case.resolution, 3 if case.reduced else 2), size=case.size).translated(
        [-0.5 * case.size] * 3
    )
    turn = turned(rng) if rng.random() < 0.5 and not static else np.eye(3)
    x = mesh.vertices @ turn.T
    off = rng.uniform(-0.3, 0.3, 2) * case.size
    obstacle, solid = make_obstacle(case, rng, width)
    gap = width * rng.uniform(0.3, 2.0) + case.speed * case.dt * rng.uniform(0, 2) * (not static)
    x = x + [-(x[:, 0].max() + half_depth(solid) + gap), *off]
    mesh = ds.TetrahedralMesh(x, mesh.tetrahedra)
    mesh = mesh.quadratic() if case.order == 2 else mesh
    x = mesh.vertices
    steps = int(np.clip(np.ceil((gap + 2 * case.size) / (case.speed * case.dt)), 6, 60 if case.explicit else 14))
    own = case.speed * (0.0 if case.moving else 1.0)
    speed = case.speed - own
    if static:  # pressed on by a third of its size, either by its own held side or by the obstacle
        way = gap + 0.3 * case.size
        steps, total = 4, way
        path, motion = (lambda t: [-total * t * case.moving, 0, 0]), (lambda t: [total * t * (not case.moving), 0, 0])
        case = replace(case, dt=1 / steps)
        fixed = x[:, 0] < x[:, 0].min() + 1e-6
        more = dict(fixed=fixed, motion=motion)
    else:
        path, more = (lambda t: [-speed * t, 0, 0]), dict(initial_velocities=(own, 0, 0))
    stiffness = case.stiffness or natural_stiffness(case, mesh, width)
    given, back = turning(case, path) if case.turning else (dict(path=path), lambda x, t: x - path(t))
    if case.pairs and not case.meshed:  # meshes always do
        given["by_pairs"] = True
    if case.rough:
        given |= dict(friction=0.5, friction_speed=0.01 * case.speed)
    obstacle = obstacle(width=width, stiffness_per_area=stiffness, **given)
    E = case.youngs_modulus
    if case.reduced:
        mesh, E, more["reduced"] = reduced(case, mesh, held=more.get("fixed"))
    scene = ds.Scene(mesh, ds.StableNeoHookean(E, 0.3), DENSITY, [obstacle], precision=case.precision, **more)
    options = dict(load_steps=case.substeps) if static else dict(substeps=case.substeps)
    if case.explicit:
        longest = min(SHARE * ds.stable_dt(scene).dt / case.substeps, case.substep)
        options["substeps"] = int(np.ceil(case.dt / longest))
    return SOLVERS[case.solver](scene, dt=case.dt, **options), steps, solid, back


def turning(case: Case, path) -> tuple[dict, Callable]:
    """(arguments of an obstacle that turns besides, where points lie in it as it was made)."""
    rng = np.random.default_rng([case.seed, case.number, 2])
    axis, about = unit(rng.standard_normal(3)), 0.5 * case.size * rng.standard_normal(3)
    rate = rng.uniform(0.2, 1.0) * min(case.speed / case.size, 1.5 / case.dt) if case.solver != "StaticSolver" else 0.3
    back = lambda x, t: about + (x - path(t) - about) @ rotation(axis * rate * t)  # noqa: E731
    return dict(path=lambda t: [*path(t), *(axis * rate * t)], about=about), back


def reduced(case: Case, mesh, held) -> tuple:
    """(mesh with a set "front", moduli, how the set moves): all that is not held, or what comes first, a hundred times
    stiffer than the rest."""
    rng, x = np.random.default_rng([case.seed, case.number, 3]), mesh.vertices
    along = x[:, 0] - x[:, 0].min()
    front = ~held if held is not None else (along > 0.4 * case.size if rng.random() < 0.5 else along > -1)
    mesh = ds.TetrahedralMesh(x, mesh.elements, vertex_sets={"front": np.flatnonzero(front)})
    stiffer = np.where(front[mesh.elements].all(1), 1.0 if front.all() else 100.0, 1.0)
    n = len(x)
    if case.reduced in ("affine", "rigid"):
        how = case.reduced
    elif case.reduced == "by functions":
        how = np.column_stack([np.ones(n), x, rng.standard_normal((n, 2))])
    else:
        turns = [np.cross(axis, x - x.mean(0)) for axis in np.eye(3)]
        how = np.stack([*(0 * x + axis for axis in np.eye(3)), *turns, *rng.standard_normal((6, n, 3))])
    return mesh, case.youngs_modulus * stiffer, {"front": how}


def natural_stiffness(case: Case, mesh, width: float) -> float:
    """What the scene chooses per area where it knows the speed: that of its own velocity."""
    still = ds.Scene(
        mesh,
        ds.StableNeoHookean(case.youngs_modulus, 0.3),
        DENSITY,
        [ds.HalfSpace(point=(1e3, 0, 0), normal=(-1, 0, 0), width=width)],
        initial_velocities=(case.speed if case.solver != "StaticSolver" else case.wave_speed, 0, 0),
    )
    return float(still.terms[0].values["barrier_stiffness_per_area"])


def make_obstacle(case: Case, rng, width: float):
    """(obstacle as a function of its barrier, solid) about the origin."""
    make, solid = analytic_obstacle(case, rng)
    if not case.meshed:
        return make, solid
    if solid["kind"] == "capsule":  # a point or a segment
        ends = np.array([solid["start"], solid["end"]])
        parts = dict(segments=[[0, 1]]) if np.any(ends[0] != ends[1]) else dict(points=[0])
        return (lambda **o: ds.MeshObstacle(ends, radius=solid["radius"], **parts, **o)), solid
    box = ds.TetrahedralMesh.create_box(2, size=tuple(2 * solid["half"]), origin=tuple(-solid["half"]))
    return (lambda **o: ds.MeshObstacle(box.vertices @ solid["axes"], box.surface_triangles, **o)), solid


def analytic_obstacle(case: Case, rng):
    t, s = case.thickness, case.size
    if case.kind in ("wall", "plate"):
        wide = 20 * s if case.kind == "wall" else s * rng.uniform(0.3, 0.8)
        size, angle = np.array([t, wide, wide]), np.zeros(3)
        if case.kind == "plate" and rng.random() < 0.5:  # edge on, or askew
            angle = rng.uniform(-1, 1, 3) * np.pi / 2
        solid = dict(kind="box", center=np.zeros(3), axes=rotation(angle).T, half=size / 2)
        return (lambda **o: ds.Box((0, 0, 0), size, angle, **o)), solid
    if case.kind == "ball":
        solid = dict(kind="capsule", start=np.zeros(3), end=np.zeros(3), radius=t)
        return (lambda **o: ds.Sphere((0, 0, 0), t, **o)), solid
    along = np.array([1.0, 0, 0]) if rng.random() < 0.5 else np.array([0, *unit(rng.standard_normal(2))])
    start, end = -s * along, s * along
    solid = dict(kind="capsule", start=start, end=end, radius=t / 2)
    return (lambda **o: ds.Capsule(start, end, t / 2, **o)), solid


def half_depth(solid: dict) -> float:
    """How far a solid about the origin reaches along x."""
    if solid["kind"] == "box":
        return float(np.abs(solid["axes"][:, 0]) @ solid["half"])
    return float(abs(solid["start"][0]) + solid["radius"])


def unit(v):
    return v / np.linalg.norm(v)


def rotation(turn) -> np.ndarray:
    """Rodrigues' formula."""
    angle = np.linalg.norm(turn)
    x, y, z = turn / angle if angle > 0 else np.zeros(3)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def turned(rng) -> np.ndarray:
    return rotation(unit(rng.standard_normal(3)) * rng.uniform(0, np.pi))


def run(case: Case) -> str:
    """ "in front", "impaled", "passed" (in silence), or what the error says."""
    solver, steps, solid, back = build(case)
    try:
        simulator = ds.Simulator(solver)
        judge = Judge(simulator.scene.mesh.surface_triangles, solid, back(simulator.positions, 0.0))
        for _ in range(steps):
            simulator.step()
            wrong = judge.after_step(back(simulator.positions, simulator.time), np.zeros(3))
            if wrong:
                return f"{wrong} in step {simulator.step_count}"
    except (FloatingPointError, ValueError) as error:
        return f"{type(error).__name__}: {error}"
    return "in front"


NUMBER = r"([-+.\deE]*\d)"


def follow(case: Case, said: str) -> Case | None:
    """The case changed as an error advises, or None."""
    stiffness, substep = re.search(f"per_area to {NUMBER} N/m\\^3", said), re.search(f"steps of {NUMBER} s", said)
    advice = [*case.advice, said]
    if stiffness:
        with_it = re.search(f"with substeps of {NUMBER} s", said)
        shorter = dict(substep=float(with_it[1])) if with_it else {}
        return replace(case, stiffness=float(stiffness[1]), advice=advice, **shorter)
    if "BDF2Solver" in said and case.solver == "ImplicitMidpointSolver":
        return replace(case, solver="BDF2Solver", advice=advice)
    shorter = re.search(f"substep to {NUMBER} s", said)
    if case.explicit and shorter:
        return replace(case, substep=float(shorter[1]), advice=advice)
    if case.explicit and "raise substeps" in said:
        return replace(case, substeps=2 * case.substeps, advice=advice)
    if substep and case.solver != "StaticSolver":
        more = int(np.ceil(case.dt / float(substep[1])))
        return replace(case, substeps=max(more, 2 * case.substeps), advice=advice)
    if "smaller steps" in said or "load steps" in said:
        return replace(case, substeps=4 * case.substeps, advice=advice)
    return None


def finish(case: Case) -> tuple[str, str]:
    """(what the first run said, what the last one said)."""
    first = last = run(case)
    while ":" in last and len(case.advice) < 3:
        case = follow(case, last)
        if case is None:
            break
        last = run(case)
    return first, last


def battery(cases, show=print) -> dict[str, Counter]:
    """Counts for each solver: cases, slow ones (below the body's wave speed) and how they ended."""
    table: dict[str, Counter] = {}
    for case in cases:
        begin = time.perf_counter()
        first, last = finish(case)
        row = table.setdefault(case.solver, Counter())
        silent = "step" in last and ":" not in last or "step" in first and ":" not in first
        raised, in_front = ":" in first, first == "in front"
        row.update(cases=1, silent=int(silent), raised=int(raised), finished_then=int(raised and last == "in front"))
        row.update(slow=int(case.slow), slow_in_front=int(case.slow and in_front))
        if first != "in front":
            show(f"{case}\n    first: {first[:400]}\n    then: {last[:300]}  ({time.perf_counter() - begin:.1f} s)")
    return table


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--solver", choices=list(SOLVERS), action="append")
    parser.add_argument("--only", type=int, nargs="*", help="numbers of cases")
    parser.add_argument("--turning", action="store_true")
    parser.add_argument("--rough", action="store_true")
    parser.add_argument("--reduced", action="store_true")
    parser.add_argument("--pairs", action="store_true")
    parser.add_argument("--meshed", action="store_true")
    parser.add_argument("--order", type=int, choices=(1, 2), default=1)
    given = parser.parse_args()
    warnings.simplefilter("ignore", UserWarning)
    ds.init("cpu", precision="f64")
    # by few numbers: dealt in turn to those that solve for them
    solvers = {name: kind for name, kind in SOLVERS.items() if not (given.reduced and kind.explicit)}
    cases = (
        draw(n, given.seed, solvers, given.turning, given.order, given.reduced, given.rough, given.pairs, given.meshed)
        for n in given.only or range(given.cases)
    )
    table = battery(c for c in cases if not given.solver or c.solver in given.solver)
    for name, row in table.items():
        print(f"{name:24s} " + ", ".join(f"{key} {row[key]}" for key in row))
    return int(any(row["silent"] for row in table.values()))


if __name__ == "__main__":
    sys.exit(main())
