"""A beam that hangs, and one whose halves differ in stiffness, by vertex block descent: error against time.

    python examples/benchmarks/public/vbd_beam.py [--quick] [--peers FOLDER]

The first table: 4 x 4 x 20 cells of 0.05 m, 1000 kg/m^3, mu = lambda = 5e4 Pa, held at its upper end, hangs by its own
weight. Its law is Newton's, psi = mu/2 (I_C - 3) + l/2 (J - a)^2 with l = lambda + mu, a = 1 + mu / l. The answer of a
bar in which sections stretch by themselves: mu (s - a / s^2 + mu / (l s^3)) = rho g (L - Z), integrated over Z; "off
the bar" is the mean extension of the lower end against that, and "off the mesh" against the equilibrium of the same
tetrahedra, which leaves the error of the solver alone. Vertex block descent has no equilibria: it moves for 2.5 s, 150
frames of 1/60 s, of six steps each, and of one. Its extension is the mean of the last 75 frames, so its error contains
what it still swings.
The second table: the lower half is 1 to 1e4 times as stiff; ten steps of backward Euler of 1/60 s from rest. Both codes
minimise the same function in each step, so the error is that of the minimiser: the largest distance of a vertex from
the converged motion over the largest displacement, at the end. Wall time of the run; compiling is not timed.

Masses, tetrahedra and steps are equal. Not equal: Newton moves for 2.5 s where ours finds one equilibrium; it computes
in float32, on a CPU on one thread, and is made for cards. Masses there are those of the mesh and not of the proposed
test's `add_soft_grid`, which puts the mass of a whole cell at each vertex, 1.64 times the weight of this beam. Proposed
test: https://github.com/newton-physics/newton/pull/2901 (Apache-2.0), an open pull request, which allows 15 % about a
baseline of its own. Method: Chen, Liu, Yang, Yuksel 2024, Vertex Block Descent, doi:10.1145/3658179.
"""

import os
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.integrate import quad
from scipy.optimize import brentq
from table import HERE, asked, environment, parser, report, work
from threadpoolctl import threadpool_limits

import diffsim_ti as ds
from diffsim_ti.materials import EnergyLaw, Material
from diffsim_ti.materials.calculus.tensor import invariants

MU = LAM = 5e4
E, NU = MU * (3 * LAM + 2 * MU) / (LAM + MU), LAM / (2 * (LAM + MU))
RHO, G, LENGTH = 1000.0, 9.81, 1.0


@dataclass(frozen=True)
class NewtonsLaw(EnergyLaw):
    """mu/2 (I_C - 3) + l/2 (J - 1 - mu/l)^2 less its value at rest, by j = J - 1 and s = I_C - 3 - 2 j"""

    coefficient_names = ("mu", "lam")

    def psi(self, H, p):
        (mu, lam), (_, j, s) = p, invariants(H)
        return 0.5 * mu * s + 0.5 * (lam + mu) * j**2


class NewtonsNeoHookean(Material):
    """The material of Newton's tetrahedra: youngs_modulus [Pa], poissons_ratio."""

    def law(self, precision: str) -> NewtonsLaw:
        return NewtonsLaw(precision)


def bar_extension() -> float:
    """Of a bar whose sections stretch by themselves [m]."""
    bulk = LAM + MU
    a = 1 + MU / bulk

    def stretch(Z: float) -> float:
        return brentq(lambda s: MU * (s - a / s**2 + MU / (bulk * s**3)) - RHO * G * (LENGTH - Z), 0.9, 3)

    return quad(stretch, 0, LENGTH, epsabs=1e-12)[0] - LENGTH


def hanging(cells: int, contrast: float = 1.0, free_sections: bool = False, quadratic: bool = False) -> ds.Scene:
    """Held at its upper end, or there along z alone and in its two middle planes across them; cells across."""
    mesh = ds.TetrahedralMesh.create_box((cells + 1, cells + 1, 5 * cells + 1), (0.2, 0.2, LENGTH), "five")
    mesh = mesh.quadratic() if quadratic else mesh
    stiffness = np.where(mesh.centroids[:, 2] < 0.5 * LENGTH, contrast, 1.0) * E
    fixed = {"zmax": "xyz"}
    if free_sections:
        x, y, _ = np.abs(mesh.vertices - 0.1).T < 1e-9
        mesh = mesh.with_vertex_set("middle x", x).with_vertex_set("middle y", y)
        fixed = {"zmax": "z", "middle x": "x", "middle y": "y"}
    weight = ds.Gravity((0.0, 0.0, -G))
    return ds.Scene(mesh, NewtonsNeoHookean(stiffness, NU), RHO, [weight], fixed=fixed, precision="f64")


def extension(scene: ds.Scene, u: np.ndarray) -> float:
    """By how much the lower end hangs lower, in the mean of its area [m]; a trapezoid's weights on equal cells."""
    end = scene.mesh.vertex_sets["zmin"]
    inner = (np.abs(scene.mesh.vertices[end, :2] - 0.1) < 0.1 - 1e-9).sum(1)
    return -float(np.average(u[end, 2], weights=2.0**inner))


def equilibrium(scene: ds.Scene, tolerance: float) -> tuple[np.ndarray, float]:
    """(displacements, seconds with setting up)"""
    begin = time.perf_counter()
    u = ds.Rollout(ds.StaticSolver(scene, tolerance=tolerance), 1).forward().displacements[-1]
    return u, time.perf_counter() - begin


def motion(scene: ds.Scene, dt: float, steps: int, tolerance: float) -> tuple[np.ndarray, float]:
    """(displacements at the end, seconds of the steps)"""
    simulator = ds.Simulator(ds.ImplicitEulerSolver(scene, dt=dt, tolerance=tolerance))
    begin = time.perf_counter()
    for _ in range(steps):
        simulator.step()
    u = simulator.displacements
    return u, time.perf_counter() - begin


def by_newton(python: str, scene: ds.Scene, dt, steps, iterations, keep_every=1, damping=0.0) -> list | dict:
    """A list of (displacements, seconds) of kept states for each number of iterations, or {"error": reason}."""
    moduli = (
        np.asarray(m) * np.ones(scene.mesh.num_tetrahedra)
        for m in scene.material.lame(scene.material.values(scene.mesh))
    )
    mu, lam = moduli
    with tempfile.TemporaryDirectory() as folder:
        job, answer = (os.path.join(folder, name) for name in ("job.npz", "answer.npz"))
        np.savez(
            job, vertices=scene.mesh.vertices, tetrahedra=scene.mesh.tetrahedra, mu=mu, lam=lam, density=RHO,
            fixed=scene.mesh.vertex_sets["zmax"], gravity=-G, dt=dt, steps=steps, keep_every=keep_every,
            damping=damping, iterations=iterations,
        )  # fmt: skip
        said = asked(python, HERE / "vbd_by_newton.py", job, answer)
        if "error" in said:
            return said
        with np.load(answer) as found:
            return [
                [(x - scene.mesh.vertices, t) for x, t in zip(found[f"positions_{k}"], found[f"seconds_{k}"])]
                for k in range(len(iterations))
            ]


def beam_rows(python: str, quick: bool) -> list:
    bar = bar_extension()
    rows = [("a bar whose sections stretch by themselves", "integrated", 1e3 * bar, "", "", "")]

    def row(what, how, scene, u, seconds, right=None):
        found = extension(scene, u)
        off = "" if right is None else 100 * abs(found / right - 1)
        rows.append((what, how, 1e3 * found, 100 * abs(found / bar - 1), off, seconds))
        return found

    for cells, quadratic in ((4, False), (2 if quick else 4, True)):
        scene = hanging(cells, free_sections=True, quadratic=quadratic)
        kind = f"free sections, {cells} x {cells} x {5 * cells} cells, {'ten' if quadratic else 'four'} nodes"
        equilibrium(scene, 1e-8)
        row(kind, "diffsim_ti, equilibrium", scene, *equilibrium(scene, 1e-8))
    scene = hanging(4)
    right = extension(scene, equilibrium(scene, 1e-12)[0])
    held = "held end, 4 x 4 x 20 cells"
    for tolerance in (1e-1, 1e-6):
        row(held, f"diffsim_ti, equilibrium, tolerance {tolerance:.0e}", scene, *equilibrium(scene, tolerance), right)
    runs = ((1 / 60, 5, (2,)),) if quick else ((1 / 360, 900, (20,)), (1 / 60, 150, (20, 100)))
    for dt, steps, iterations in runs if python else ():
        found = by_newton(python, scene, dt, steps, iterations, keep_every=round(1 / 60 / dt), damping=0.1)
        for count, kept in zip(iterations, found if isinstance(found, list) else []):
            mean = np.mean([u for u, _ in kept[len(kept) // 2 :]], 0)
            row(held, f"VBD, {steps} steps of 1/{1 / dt:.0f} s, {count} iterations", scene, mean, kept[-1][1], right)
        if not isinstance(found, list):
            rows.append((held, f"VBD: {found['error']}", "", "", "", ""))
    return rows


def contrast_rows(python: str, quick: bool) -> list:
    rows, dt, steps = [], 1 / 60, 3 if quick else 10
    tolerances, iterations = ((1e-4,), (10,)) if quick else ((1e-1, 1e-4), (10, 100, 500))
    for contrast in (1, 1e4) if quick else (1, 100, 1e4):
        scene = hanging(2 if quick else 4, contrast)
        right = motion(scene, dt, steps, 1e-11)[0]
        size = np.linalg.norm(right, axis=1).max()
        off = lambda u: float(np.linalg.norm(u - right, axis=1).max() / size)  # noqa: E731
        for tolerance in tolerances:
            u, seconds = motion(scene, dt, steps, tolerance)
            rows.append((f"{contrast:g}", f"diffsim_ti, tolerance {tolerance:.0e}", off(u), seconds))
        if python:
            runs = by_newton(python, scene, dt, steps, iterations, keep_every=steps)
            for count, kept in zip(iterations, runs if isinstance(runs, list) else []):
                ((u, seconds),) = kept
                rows.append((f"{contrast:g}", f"VBD, {count} iterations", off(u), seconds))
            if not isinstance(runs, list):
                rows.append((f"{contrast:g}", f"VBD: {runs['error']}", "", ""))
    return rows


def main(quick: bool, peers: Path | None) -> tuple[list, list]:
    python, reason = (
        environment(peers, "newton", *work.PINNED["Newton"]) if peers else ("", "no --peers FOLDER was given")
    )
    notes = "" if python else f"Newton is left out: {reason.rstrip('.')}."
    versions = work.versions("Newton") if python else {}
    first, second = beam_rows(python, quick), contrast_rows(python, quick)
    head = ("beam", "by", "extension [mm]", "off the bar [%]", "off the mesh [%]", "seconds")
    report("vbd_beam", head, first, quick or not peers, notes, **versions)
    report("vbd_contrast", ("contrast", "by", "error", "seconds"), second, quick or not peers, notes, **versions)
    return first, second


if __name__ == "__main__":
    options = parser(__doc__).parse_args()
    ds.init("cpu", precision="f64")
    with threadpool_limits(1):
        main(options.quick, options.peers)
