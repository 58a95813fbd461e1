"""How many simulations do numbers cost? `identify` beside SciPy's `least_squares` with differences and torch's Adam.

A forward run, a tangent run and a reverse sweep count as one each. All start from the same guess, see the same noisy data,
and count until each unknown is on average within one standard error, and within a tenth, of the least cost that any of them
found: chi^2 + prior then lies above it by the number of unknowns, and by a hundredth of that.

    python examples/benchmarks/identify_costs.py [--cells 9 3 3]

Two unknowns (E and nu of a swinging beam), and a field: E of every tetrahedron of the beam of `stiffness_field.py`.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from scipy.optimize import least_squares

import diffsim_ti as ds
from diffsim_ti.identification.fit import METHODS
from diffsim_ti.identification.measurements import measurements
from diffsim_ti.identification.problem import Problem
from diffsim_ti.identification.search import Search
from diffsim_ti.identification.unknowns import Priors

NOISE = 1e-4  # [m]
NEAR = 1.0, 0.1  # standard errors off the least


@dataclass
class Run:
    """(simulations, seconds, cost) whenever the cost fell."""

    search: Search
    seconds: float = field(default_factory=time.perf_counter)
    points: list = field(default_factory=list)

    def note(self, cost: float) -> None:
        if not self.points or cost < self.points[-1][2]:
            self.points.append((self.search.problem.simulations, time.perf_counter() - self.seconds, cost))

    def reached(self, cost: float) -> tuple[int, float] | None:
        """(simulations, seconds) until the cost was that low, or None."""
        return next(((n, s) for n, s, c in self.points if c <= cost), None)


def beam(cells=(9, 3, 3)) -> tuple[ds.Rollout, np.ndarray]:
    """A beam that swings, and its stiff middle."""
    mesh = ds.TetrahedralMesh.create_box([c + 1 for c in cells], [0.8, 0.3, 0.3])
    terms = [ds.Gravity((0.0, -9.8, 3.0)), ds.Drag(3.0)]
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), terms=terms, fixed="xmin", precision="f64")
    rollout = ds.Rollout(ds.SemiImplicitSolver(scene, dt=0.01, substeps=8), 30, save_every=5)
    return rollout, np.abs(mesh.centroids[:, 0] - 0.35) < 0.15


def problems(cells) -> dict:
    """{name: (function that makes a search, Adam's rates)}"""
    rollout, stiff = beam(cells)
    rng = np.random.default_rng(0)

    def made(truth: dict, unknowns: dict, prior: dict | None) -> Callable[[], Search]:
        seen = rollout.forward(**truth).positions
        data = measurements({"positions": seen + NOISE * rng.standard_normal(seen.shape)}, NOISE)

        def search() -> Search:
            problem = Problem([rollout], [data], unknowns)
            return Search(problem, Priors(prior, problem.unknowns, rollout.scene.mesh), None)

        return search

    two = made(dict(youngs_modulus=8e4, poissons_ratio=0.35), dict(youngs_modulus=1e5, poissons_ratio=0.25), None)
    each = {"youngs_modulus": ds.Unknown(1e5, regions="each")}
    field_of = made(
        dict(youngs_modulus=np.where(stiff, 2e5, 5e4)), each, {"youngs_modulus": ds.Smooth(0.3, edges=False)}
    )
    return {"E and nu": two, f"E of {len(stiff)} tetrahedra": field_of}


def ours(search: Search, method: str) -> Run:
    run = Run(search)
    run.note(search.cost)
    METHODS[method](search, lambda *_: run.note(search.cost), 1e-3)
    return run


def scipys(search: Search, most: int) -> Run:
    """`least_squares` on the same residuals, the prior's rows below them, with differences of the whole Jacobian."""
    problem, priors, run = search.problem, search.priors, Run(search)

    def residual(t):
        if problem.simulations > most:
            raise StopIteration
        r = problem.run(t).residual
        run.note(float(r @ r) + priors.cost(t))
        return np.concatenate([r, priors.R @ t - priors.r])

    try:
        least_squares(residual, search.point.t, method="trf", xtol=1e-10, ftol=1e-10)
    except StopIteration:
        pass
    return run


def adams(search: Search, rate: float, most: int) -> Run:
    run, t = Run(search), torch.tensor(search.point.t, requires_grad=True)
    optimizer = torch.optim.Adam([t], lr=rate)
    while search.problem.simulations < most:
        point = search.problem.run(t.detach().numpy().copy())
        run.note(search.cost_of(point))
        t.grad = torch.from_numpy(2 * search.half_gradient(point))
        optimizer.step()
    return run


def main(cells=(9, 3, 3), most: int = 12000, rates=(0.03, 0.1)) -> dict:
    """Returns {problem: {method: [(simulations, seconds), or None where it did not get there, of each of NEAR]}}."""
    out = {}
    for name, search in problems(cells).items():
        runs = {method: ours(search(), method) for method in ("Levenberg-Marquardt", "L-BFGS-B")}
        runs["SciPy, differences"] = scipys(search(), most)
        for rate in rates:
            runs[f"Adam, rate {rate:g}"] = adams(search(), rate, most // 2 if "of" in name else min(most, 600))
        size = search().problem.size
        least = min(run.points[-1][2] for run in runs.values())
        out[name] = {m: [run.reached(least + near**2 * size) for near in NEAR] for m, run in runs.items()}
        print(f"\n| {name} | simulations, 1 s.e. | .1 s.e. | seconds |\n| --- | --- | --- | --- |")
        for method, got in out[name].items():
            told = " | ".join(str(g[0]) if g else f"not in {runs[method].points[-1][0]}" for g in got)
            print(f"| {method} | {told} | {(got[-1] or runs[method].points[-1])[1]:.2g} |")
    return out


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--cells", type=int, nargs=3, default=(9, 3, 3))
    ds.init(precision="f64")
    main(parser.parse_args().cells)
