"""Speed of implicit steps: against a direct solver, as the mesh grows, backward, and where they beat explicit ones.

    python examples/benchmarks/implicit_steps.py --part direct    # a Newton step by SciPy's sparse LU
    python examples/benchmarks/implicit_steps.py --part growth    # time per step and memory, 1 000 to 200 000 tetrahedra
    python examples/benchmarks/implicit_steps.py --part backward  # the gradient of one step, in Newton iterations
    python examples/benchmarks/implicit_steps.py --part crossing [mesh.msh]  # a second to 1 %, and explicit

A beam held at one end, that falls into sag: stable neo-Hookean, nu = 0.45, 1000 kg/m^3, float64; E = 1e6 Pa and steps of
10 ms unless said. Prints a table in Markdown.
"""

import argparse
import resource
import sys
import time

import numpy as np
from scipy.sparse import bsr_matrix
from scipy.sparse.linalg import splu

import diffsim_ti as ds

NU, DENSITY, DT, TOLERANCE = 0.45, 1000.0, 1e-2, 1e-6
FRAMES, ERROR, HELD = 20, 1e-2, 0.05


def beam(tetrahedra: int) -> ds.TetrahedralMesh:
    """About so many tetrahedra, 1 m long, in cells that are nearly cubes."""
    across = max(1, round((tetrahedra / 30) ** (1 / 3)))
    return ds.TetrahedralMesh.create_box(
        (round(tetrahedra / 6 / across**2) + 1, across + 1, across + 1), (1.0, 0.2, 0.2)
    )


def scene_of(mesh: ds.TetrahedralMesh, E: float = 1e6, held: float = 1e-6, **more) -> ds.Scene:
    """Held at the `held` share of its length where x is least."""
    held = mesh.vertices_where(lambda X: X[:, 0] < X[:, 0].min() + held * np.ptp(X[:, 0]) + 1e-12)
    material = ds.StableNeoHookean(E, NU)
    return ds.Scene(mesh, material, DENSITY, [ds.Gravity()], **dict(fixed=held, precision="f64") | more)


def print_table(header: list, rows: list) -> None:
    """Markdown, at once."""
    cells = [[f"{x:.3g}" if isinstance(x, float) else str(x) for x in row] for row in rows]
    for line in [header, ["---:"] * len(header), *cells]:
        print("| " + " | ".join(line) + " |")
    sys.stdout.flush()


# ---- a direct solver to compare with ----------------------------------------------------------------------------------


class DirectEuler:
    """Backward Euler by Newton's method with assembled matrices and SciPy's sparse LU, in NumPy.

    P = mu (F - F^-T) + lam (J - 1) J F^-T; with g_a = F^-T grad N_a the stiffness between corners a and b is
    V (mu grad N_a . grad N_b I + (mu - lam (J - 1) J) g_b g_a^T + lam (2 J - 1) J g_a g_b^T).
    """

    def __init__(self, scene: ds.Scene):
        mesh, n = scene.mesh, scene.mesh.num_vertices
        self.tets, self.N, self.V, self.X = mesh.tetrahedra, mesh.shape_gradients, mesh.volumes, mesh.vertices
        mu, lam = scene.material.lame(scene.material.values(mesh))
        self.mu, self.lam = float(mu), float(lam)
        self.mass = scene.inputs.derive(scene.inputs.values).mass[:, None]
        self.free = np.ones((n, 1))
        self.free[scene.fixed] = 0
        self.loads = self.mass * scene.term(ds.Gravity).values["gravity"]
        self.u, self.v = np.zeros((n, 3)), np.zeros((n, 3))
        places, self.entry = np.unique((self.tets[:, :, None] * n + self.tets[:, None, :]).ravel(), return_inverse=True)
        self.rows, self.columns = places // n, places % n
        self.start = np.concatenate([[0], np.cumsum(np.bincount(self.rows, minlength=n))])
        self.couples = self.free[self.rows] * self.free[self.columns]
        self.diagonal = np.searchsorted(places, np.arange(n) * (n + 1))
        self.iterations = 0

    def deformed(self, u):
        F = np.swapaxes(u[self.tets], 1, 2) @ self.N + np.eye(3)
        J = np.linalg.det(F)
        if np.any(J <= 0):
            raise FloatingPointError("a tetrahedron turned over: take smaller steps")
        return F, J, np.swapaxes(np.linalg.inv(F), 1, 2)

    def residual(self, u, goal):
        """(force that is left, size of the forces that meet)"""
        F, J, T = self.deformed(u)
        P = self.mu * (F - T) + (self.lam * (J - 1) * J)[:, None, None] * T
        corner = -self.V[:, None, None] * (self.N @ np.swapaxes(P, 1, 2))
        f = np.stack([np.bincount(self.tets.ravel(), corner[:, :, k].ravel(), len(u)) for k in range(3)], 1)
        inertia = self.mass / DT**2 * (u - goal)
        size = np.sqrt((corner**2).sum() + (self.loads**2).sum() + (inertia**2).sum())
        return (f + self.loads - inertia) * self.free, size

    def matrix(self, u):
        _, J, T = self.deformed(u)
        g = self.N @ np.swapaxes(T, 1, 2)
        K = np.einsum("eai,ebj->eabij", g, g, optimize=True) * (self.lam * (2 * J - 1) * J)[:, None, None, None, None]
        K += (
            np.einsum("ebi,eaj->eabij", g, g, optimize=True)
            * (self.mu - self.lam * (J - 1) * J)[:, None, None, None, None]
        )
        K += self.mu * (self.N @ np.swapaxes(self.N, 1, 2))[..., None, None] * np.eye(3)
        K = (self.V[:, None, None, None, None] * K).reshape(-1, 9)
        data = np.stack([np.bincount(self.entry, K[:, k], len(self.rows)) for k in range(9)], 1).reshape(-1, 3, 3)
        data *= self.couples[:, :, None]
        data[self.diagonal] += (self.mass / DT**2 * self.free + (1 - self.free))[:, :, None] * np.eye(3)
        return bsr_matrix((data, self.columns, self.start), shape=(u.size, u.size)).tocsc()

    def step(self) -> None:
        goal = self.u + DT * self.v
        u, size = self.u, 0.0
        for _ in range(30):
            R, now = self.residual(u, goal)
            size = max(size, now)
            if np.linalg.norm(R) <= TOLERANCE * size:
                break
            lu = splu(self.matrix(u), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0, options=dict(SymmetricMode=True))
            u = u + lu.solve(R.ravel()).reshape(-1, 3)
            self.iterations += 1
        self.v, self.u = (u - self.u) / DT, u


def stepper(scene: ds.Scene):
    """(a function that takes one step of backward Euler, a function that returns the displacements)"""
    simulator = ds.Simulator(ds.ImplicitEulerSolver(scene, dt=DT, tolerance=TOLERANCE))
    return simulator.step, lambda: simulator.positions - scene.mesh.vertices


def seconds_per_step(step, steps: int) -> float:
    """Mean, after one step that compiles and sets up."""
    step()
    start = time.perf_counter()
    for _ in range(steps):
        step()
    return (time.perf_counter() - start) / steps


def direct(sizes, steps: int) -> list:
    """Rows (tetrahedra, ours [s], SciPy [s], SciPy / ours, largest difference of the displacements [m])."""
    rows = []
    for size in sizes:
        scene = scene_of(beam(size))
        step, displacements = stepper(scene)
        other = DirectEuler(scene)
        ours, theirs = seconds_per_step(step, steps), seconds_per_step(other.step, steps)
        off = float(np.abs(displacements() - other.u).max())
        rows.append((scene.mesh.num_tetrahedra, ours, theirs, theirs / ours, off))
    print_table(["tetrahedra", "ours [s/step]", "SciPy LU [s/step]", "LU / ours", "differ by [m]"], rows)
    return rows


def growth(sizes, steps: int) -> tuple[list, float]:
    """Rows (tetrahedra, seconds per step, peak memory of the process so far [MB]), and the exponent of the time."""
    rows = []
    for size in sorted(sizes):
        scene = scene_of(beam(size))
        seconds = seconds_per_step(stepper(scene)[0], steps)
        rows.append((scene.mesh.num_tetrahedra, seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024))
    print_table(["tetrahedra", "s/step", "peak memory [MB]"], rows)
    exponent = float(np.polyfit(*np.log([row[:2] for row in rows]).T, 1)[0]) if len(rows) > 1 else float("nan")
    print(f"\nseconds per step grow with the number of tetrahedra to the power {exponent:.2f}\n")
    return rows, exponent


def backward(sizes, repeats: int) -> list:
    """Rows (tetrahedra, Newton iterations, forward [s], backward [s], backward in Newton iterations)."""
    rows = []
    for size in sizes:
        scene = scene_of(beam(size))
        moving = ds.Rollout(ds.ImplicitEulerSolver(scene, dt=DT), 10).forward()
        scene = scene.replace(initial_positions=moving.positions[-1], initial_velocities=moving.velocities[-1])
        solver = ds.ImplicitEulerSolver(scene, dt=DT, tolerance=TOLERANCE)
        workspace = solver.workspace(solver.start_values())
        workspace.advance(0, 1, 1)
        iterations = len(workspace.newton.report.residuals) - 1
        rollout = ds.Rollout(solver, 1, gradients=["youngs_modulus"])
        forward_s, backward_s, adjoint = [], [], np.zeros((2, scene.mesh.num_vertices, 3))
        for k in range(repeats + 1):  # the first one compiles
            start = time.perf_counter()
            frames = rollout.forward()
            middle = time.perf_counter()
            adjoint[1] = frames.displacements[-1]
            rollout.vjp(frames, adjoint)
            if k:
                forward_s.append(middle - start)
                backward_s.append(time.perf_counter() - middle)
        there, back = min(forward_s), min(backward_s)
        rows.append((scene.mesh.num_tetrahedra, iterations, there, back, back * iterations / there))
    print_table(["tetrahedra", "Newton iterations", "forward [s]", "backward [s]", "backward [iterations]"], rows)
    return rows


# ---- where implicit steps pay -----------------------------------------------------------------------------------------


def carried(t: float) -> np.ndarray:
    """A hand that moves 0.2 m sideways in one second, from rest to rest [m]."""
    return np.array([0.0, 0.0, 0.1 * (1 - np.cos(np.pi * t))])


def motion_of(solver, steps: int) -> tuple[np.ndarray, float]:
    """Positions at `FRAMES` times in one second, and how long that took without compiling [s]."""
    ds.Rollout(solver, 1).forward()
    rollout = ds.Rollout(solver, steps, save_every=steps // FRAMES)
    start = time.perf_counter()
    return rollout.forward().positions, time.perf_counter() - start


def explicit_motion(scene: ds.Scene) -> tuple[np.ndarray, float]:
    """The same by velocity Verlet at 0.9 of the largest stable step: converged for all that moves visibly."""
    stable = ds.VelocityVerletSolver(scene, dt=1.0, allow_unstable=True).stable_dt(tight=True).dt
    steps = 32 * FRAMES
    return motion_of(ds.VelocityVerletSolver(scene, 1 / steps, int(np.ceil(1 / steps / (0.9 * stable)))), steps)


def sufficient(solver_class, scene, reference: np.ndarray, most: int) -> tuple[str, float, float]:
    """(number of steps in words, seconds, error) at the largest step whose error is small enough; beyond `most` steps it
    is extrapolated by the solver's order, and marked by ~."""
    size, steps = np.linalg.norm(reference - reference[0]), FRAMES
    while True:
        positions, seconds = motion_of(solver_class(scene, dt=1 / steps, tolerance=1e-5), steps)
        error = float(np.linalg.norm(positions - reference) / size)
        if error <= ERROR:
            return str(steps), seconds, error
        if 2 * steps > most:
            factor = (error / ERROR) ** (1 / solver_class.order)
            return f"~{round(steps * factor)}", seconds * factor, ERROR
        steps *= 2


def crossing(mesh: ds.TetrahedralMesh, moduli, most: int, motions=("falls", "carried")) -> list:
    """Rows (motion, E, solver, steps, error, seconds, over explicit); prints where implicit and explicit cost the same.

    falls: let go without sag, so that the answer is its vibration; carried: from equilibrium, the held end moved slowly.
    """
    rows, solvers = [], (ds.ImplicitEulerSolver, ds.ImplicitMidpointSolver, ds.BDF2Solver)
    for name in motions:
        for E in moduli:
            scene = scene_of(mesh, E, HELD)
            if name == "carried":
                rest = ds.Rollout(ds.StaticSolver(scene), 1).forward().positions[-1]
                scene = scene_of(mesh, E, HELD, initial_positions=rest, motion=carried)
            reference, explicit = explicit_motion(scene)
            rows.append((name, E, "explicit", "", 0.0, explicit, 1.0))
            for solver in solvers:
                steps, seconds, error = sufficient(solver, scene, reference, most)
                rows.append((name, E, solver.__name__, steps, error, seconds, seconds / explicit))
    print_table(["motion", "E [Pa]", "solver", "steps", "error", "seconds", "over explicit"], rows)
    print()
    for name in motions:
        for solver in solvers:
            ratios = [row[6] for row in rows if row[0] == name and row[2] == solver.__name__]
            print(f"{name}, {solver.__name__}: costs as much as explicit at {_where_one(moduli, ratios)}")
    return rows


def _where_one(moduli, ratios) -> str:
    """E at which ratios that follow a power law of E are 1."""
    slope, level = np.polyfit(np.log(moduli), np.log(ratios), 1) if len(moduli) > 1 else (0.0, 0.0)
    if slope > -0.05:
        return f"no E, as far as was measured ({', '.join(f'{r:.2g}' for r in ratios)})"
    at, most = np.exp(-level / slope), 1e3 * max(moduli)
    return f"E = {at:.2g} Pa" if at < most else f"E > {most:.0e} Pa: now {ratios[-1]:.2g} times as much"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", nargs="?", help="mesh file of --part crossing, held where x is least; default: a beam")
    parser.add_argument("--part", choices=["direct", "growth", "backward", "crossing"], required=True)
    parser.add_argument("--sizes", type=int, nargs="+", help="numbers of tetrahedra; crossing: that of its beam")
    parser.add_argument("--steps", type=int, default=5, help="steps, or repetitions, that are measured")
    parser.add_argument("--moduli", type=float, nargs="+", default=[1e7, 4e7], help="E [Pa] of --part crossing")
    parser.add_argument("--most-steps", type=int, default=640, help="of --part crossing: beyond that, extrapolate")
    parser.add_argument("--motions", nargs="+", choices=["falls", "carried"], default=["falls", "carried"])
    options = parser.parse_args()
    ds.init(precision="f64")
    sizes = options.sizes
    if options.part == "direct":
        direct(sizes or [1_000, 5_000, 20_000, 50_000], options.steps)
    elif options.part == "growth":
        growth(sizes or [1_000, 5_000, 20_000, 50_000, 100_000, 200_000], options.steps)
    elif options.part == "backward":
        backward(sizes or [1_000, 20_000], options.steps)
    else:
        mesh = ds.TetrahedralMesh.from_file(options.mesh) if options.mesh else beam((sizes or [1_000])[0])
        crossing(mesh, options.moduli, options.most_steps, options.motions)


if __name__ == "__main__":
    main()
