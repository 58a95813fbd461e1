"""Soft bodies that are thrown at each other in explicit steps; what an error advises is followed to the letter.

    python tests/battery_of_throws.py --cases 200 --seed 0

Two to five blocks, or a thin part that closes on itself, at up to 0.4 of the speed of pressure waves, with random widths,
stiffnesses, friction, elements, rigid and affine sets, precisions and solvers. Exact predicates judge every end of a substep
(tests/exact_predicates.py), so that nothing fails in silence. Every case prints a line, and the last lines are a table.
"""

import argparse
import re
import time
from collections import Counter

import numpy as np
from exact_predicates import ExactJudge

import diffsim_ti as ds
from diffsim_ti.mesh.collision_surface import cuts_of

SOLVERS = ds.VelocityVerletSolver, ds.SemiImplicitSolver
NUMBER = r"([-+.\de]*\d)"
ROUNDS = 4  # runs, at most


def draw(rng) -> dict:
    """A case: its mesh, numbers of the contact, velocities, solver, duration."""
    E, order = 10 ** rng.uniform(3.5, 6), int(rng.integers(1, 3))
    wave = np.sqrt(1.6 * E / 1000)  # of a ratio of 0.35
    speed = rng.uniform(0.05, 0.4) * wave
    contact = dict(width=10 ** rng.uniform(-3.3, -2.6), stiffness=10 ** rng.uniform(1.5, 5))
    contact["friction"] = float(rng.choice([0, 0.5]))
    case = dict(
        E=E, contact=contact, solver=SOLVERS[rng.integers(2)], precision="f32" if rng.random() < 0.25 else "f64"
    )
    if rng.random() < 0.15:
        return case | closing_part(rng, order, speed) | dict(kind="thin", reduced={})
    bodies = int(rng.integers(2, 6))
    block = ds.TetrahedralMesh.create_box(3 if order == 1 and bodies < 4 else 2, 0.1)
    block = block.quadratic() if order == 2 else block
    turned = [block.rotated(rng.normal(size=3), rng.uniform(0, 0.5), center=(0.05, 0.05, 0.05)) for _ in range(bodies)]
    for k in range(1, bodies):  # one beside the other, out of line
        gap = turned[k - 1].vertices[:, 0].max() + rng.uniform(0.002, 0.01) - turned[k].vertices[:, 0].min()
        turned[k] = turned[k].translated([gap, *rng.uniform(-0.05, 0.05, 2)])
    mesh = ds.TetrahedralMesh.joined(turned)
    v, body = np.zeros_like(mesh.vertices), np.arange(mesh.num_vertices) // block.num_vertices
    v[:, 0] = 0.5 * speed * (1 - 2 * body / (bodies - 1))
    v += speed * rng.uniform(-0.1, 0.1, (bodies, 3))[body]
    kinds = {"body_0": str(rng.choice(["rigid", "affine"]))} if rng.random() < 0.15 else {}
    duration = 0.2 / wave + 0.01 * (bodies - 1) / speed
    return case | dict(mesh=mesh, v=v, duration=duration, kind="reduced" if kinds else f"order {order}", reduced=kinds)


def closing_part(rng, order: int, speed: float) -> dict:
    """A block with a slit, whose halves are driven towards each other."""
    box = ds.TetrahedralMesh.create_box((3, 4, 2), size=(0.15, 0.1, 0.05))
    centers = box.vertices[box.elements].mean(1)
    kept = ~((centers[:, 0] > 0.05) & (centers[:, 1] > 0.025) & (centers[:, 1] < 0.075))
    used, elements = np.unique(box.elements[kept], return_inverse=True)
    mesh = ds.TetrahedralMesh(box.vertices[used], elements.reshape(-1, 4))
    mesh = mesh.quadratic() if order == 2 else mesh
    share = np.clip((mesh.vertices[:, 0] - 0.05) / 0.1, 0, 1) ** 2
    v = 0.5 * speed * np.stack([0 * share, -np.sign(mesh.vertices[:, 1] - 0.05) * share, 0 * share], 1)
    return dict(mesh=mesh, v=v + rng.normal(0, 0.02 * speed, v.shape), duration=0.15 / speed)


class Judge:
    """Of the surface that contact keeps apart: the mesh's, or a finer one on curved faces, made here."""

    def __init__(self, mesh, cuts: int = 1):
        self.of = lambda x: x
        triangles, tetrahedra = mesh.surface_triangles, mesh.elements
        if mesh.order == 2:
            parts = 2**cuts
            grid = np.array([[i, j] for i in range(parts + 1) for j in range(parts + 1 - i)])
            place = {tuple(ij): k for k, ij in enumerate(grid.tolist())}
            small = [[(i, j), (i + 1, j), (i, j + 1)] for i, j in place if i + j < parts]
            small += [[(i + 1, j), (i + 1, j + 1), (i, j + 1)] for i, j in place if i + j < parts - 1]
            L = np.stack([1 - grid.sum(1) / parts, *grid.T / parts], 1)
            N = np.concatenate([L * (2 * L - 1), 4 * L * np.roll(L, -1, 1)], 1)
            every = lambda x: np.einsum("ga,fad->fgd", N, x[mesh.surface_faces]).reshape(-1, 3)  # noqa: E731
            _, first, inverse = np.unique(every(mesh.vertices).round(9), axis=0, return_index=True, return_inverse=True)
            self.of = lambda x: every(x)[first]
            numbers = inverse.reshape(len(mesh.surface_faces), -1)
            triangles = numbers[:, np.array([[place[c] for c in t] for t in small])].reshape(-1, 3)
            tetrahedra = ()
        points = np.unique(triangles) if len(tetrahedra) else ()
        self.exact = ExactJudge(self.of(mesh.vertices), triangles, tetrahedra=tetrahedra, points=points)

    def count(self, x, wholly: bool) -> int:
        """Intersections at x; wholly: also bodies within others, which no edge pierces."""
        x = self.of(np.asarray(x, np.float64))
        return self.exact.count(x) if wholly else len(self.exact.pierced(x))


def throw(case: dict, looks: int = 1) -> tuple[list[str], int]:
    """(what the runs said, the last one of all, which is empty if it came to its end; intersections that nothing said);
    looks: substeps from one look of the judge to the next."""
    said, dt, silent, judges, simulator = [], None, 0, {}, None
    for _ in range(ROUNDS):
        try:
            if not (simulator and "reset() the simulator" in said[-1]):
                scene = ds.Scene(
                    case["mesh"],
                    ds.StableNeoHookean(case["E"], 0.35),
                    1000.0,
                    [ds.SelfContact(**case["contact"])],
                    initial_velocities=case["v"],
                    reduced=case["reduced"],
                    precision=case["precision"],
                )
                dt = dt or 0.7 * float(ds.stable_dt(scene).dt)
                simulator = ds.Simulator(case["solver"](scene, dt=dt, substeps=1))
            simulator.reset()
            left = int(np.ceil(case["duration"] / dt))
            while left > 0:
                simulator.run(min(looks, left))
                left -= looks
                cuts = 1 + cuts_of(case["mesh"], case["contact"]["width"], simulator.workspace.arrays.bend)
                judges[cuts] = judges.get(cuts) or Judge(case["mesh"], cuts)
                silent += judges[cuts].count(simulator.positions, left <= 0)
            return [*said, ""], silent
        except (FloatingPointError, ValueError) as error:
            said.append(str(error))
        step = re.search(rf"(?:substeps of|substep to) {NUMBER}", said[-1])
        dt = float(step[1]) if step else dt
        if not (step or "reset() the simulator" in said[-1]):
            return said, silent
    return said, silent


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=30)
    parser.add_argument("--first", type=int, default=0, help="the first case that is run, of those that are drawn")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--looks", type=int, default=1, help="substeps from one look of the judge to the next")
    options = parser.parse_args()
    ds.init(precision="f64")
    rng, counts = np.random.default_rng(options.seed), Counter()
    for k in range(options.cases):
        case, begin = draw(rng), time.process_time()
        if k < options.first:
            continue
        said, silent = throw(case, options.looks)
        verdict = "silent" if silent else "failed" if said[-1] else "in front" if len(said) == 1 else "after advice"
        counts[case["kind"], verdict] += 1
        of = f"{case['kind']:8} {case['precision']} {case['solver'].__name__:20}"
        took = f"{verdict} after {len(said)} runs, {time.process_time() - begin:.1f} s"
        print(f"{k:4d} {of} {took}", *filter(None, said), sep="\n     ", flush=True)
    verdicts = "in front", "after advice", "failed", "silent"
    print("".join(f"{name:>14}" for name in ("", *verdicts)))
    for kind in sorted({kind for kind, _ in counts}):
        print(f"{kind:>14}" + "".join(f"{counts[kind, name]:14d}" for name in verdicts))
    total = {name: sum(n for (_, v), n in counts.items() if v == name) for name in verdicts}
    print(f"{'all':>14}" + "".join(f"{total[name]:14d}" for name in verdicts))
    return int(total["failed"] + total["silent"] > 0)


if __name__ == "__main__":
    raise SystemExit(main())
