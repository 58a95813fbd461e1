"""How gradients grow in long rollouts, and up to where they are of use."""

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from diffsim_ti.common.public import public
from diffsim_ti.materials import SmithNeoHookean
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.rollout import Rollout
from diffsim_ti.scene import Scene
from diffsim_ti.solvers import VelocityVerletSolver, stable_dt
from diffsim_ti.solvers.solver import Solver
from diffsim_ti.study.charts import STYLES, new_figure, save, write_results
from diffsim_ti.study.problems import beam_scene, lame_scene
from diffsim_ti.terms import Gravity, Ground
from diffsim_ti.terms.obstacles.stiffness import stiffness_of_impact


@dataclass
class Growth:
    """Size of the tangent |dx / dx0| at the frames' times [s], for several random directions (rows).

    rate [1/s]: slope of the logarithm of the largest one over the second half of the run: a finite-time Lyapunov
    exponent. horizon [s]: when the rounding of the precision, grown at the measured pace, reaches `useful` of the state,
    so that the gradient no longer tells where the motion goes; None if it does not within the run.
    """

    times: np.ndarray
    sizes: np.ndarray
    rate: float
    horizon: float | None

    def __str__(self) -> str:
        until = f"of use until t = {self.horizon:.3g} s" if self.horizon is not None else "of use to the end"
        return f"gradients grow to {self.sizes[:, -1].max():.3g} at rate {self.rate:.3g} 1/s; {until}"


@public
def growth(
    solver: Solver, steps: int, frames: int = 50, directions: int = 2, useful: float = 1e-2, seed: int = 0
) -> Growth:
    """Tangents of the positions by the start along random directions, through `steps` steps of the solver.

    Benettin et al. 1980, doi:10.1007/BF02128236; Metz et al. 2021, Gradients are not all you need, arXiv:2111.05803.
    """
    if not 0 < useful < 1:
        raise ValueError(f"useful must lie between 0 and 1, got {useful:g}")
    every = max(1, steps // frames)
    rollout = Rollout(solver, steps // every * every, save_every=every)
    start, rng, sizes = rollout.forward(), np.random.default_rng(seed), []
    for _ in range(directions):
        d = solver.scene.supports.free(rng.standard_normal(start.positions.shape[1:]))
        moved, _ = rollout.jvp(start, initial_positions=d / np.linalg.norm(d))
        sizes.append(np.linalg.norm(moved, axis=(1, 2)))
    sizes, times = np.array(sizes), rollout.times
    largest = sizes.max(0)
    half = len(times) // 2
    rate = float(np.polyfit(times[half:], np.log(np.maximum(largest[half:], 1e-300)), 1)[0])
    rounding = float(np.finfo(start.displacements.dtype).eps)
    beyond = np.flatnonzero(largest * rounding > useful)
    return Growth(times, sizes, rate, float(times[beyond[0]]) if len(beyond) else None)


def bouncing_block(precision: str) -> Scene:
    """A cube of 0.2 m that falls 5 cm on its edge and goes on bouncing: every contact parts neighbouring motions."""
    mesh = TetrahedralMesh.create_cube(4, 0.2, "five").rotated((0.3, 0.2, 1.0), 0.6)
    mesh = mesh.translated((0, 0.05 - mesh.vertices[:, 1].min(), 0))
    law = SmithNeoHookean(1e5, 0.3)
    floor = Ground(0.0, width=0.01, stiffness_per_area=stiffness_of_impact(mesh, law, 1000.0, 9.81, 1.0, 0.01))
    return Scene(mesh, law, 1000.0, [Gravity(), floor], precision=precision)


GROWTH_SCENES = {
    "swinging cube (Lame mode)": lambda precision: lame_scene(0.3, 4, "five", precision),
    "clamped beam let go": lambda precision: beam_scene(SmithNeoHookean, 2, "five", precision),
    "bouncing block": bouncing_block,
}


def study_growth(scenes: dict, duration: float, share: float = 0.1, frames: int = 100) -> dict[str, Growth]:
    """Growth in each scene over `duration` [s], by velocity Verlet at `share` of the stable step of the start, so that
    contacts are resolved too."""
    out = {}
    for name, scene in scenes.items():
        dt = share * stable_dt(scene).dt
        steps = int(np.ceil(duration / dt))
        out[name] = growth(VelocityVerletSolver(scene, dt=duration / steps, substeps=1), steps, min(frames, steps))
    return out


def draw_growth(results: dict[str, Growth], path: str | Path, rounding: float) -> None:
    """Size of the tangent against time, a line per run, with the size at which rounding has grown to 1 % of the state."""
    figure, axes = new_figure()
    styles = ("-", "--", "-.", ":")
    for k, ((name, result), (color, _)) in enumerate(zip(results.items(), STYLES.values())):
        largest = result.sizes.max(0)
        until = "to the end" if result.horizon is None else f"until {result.horizon:.2g} s"
        label = f"{name}: {result.rate:.2g} 1/s, of use {until}"
        axes.plot(result.times, largest, styles[k % 4], color=color, lw=1.8, label=label)
        if result.horizon is not None:
            axes.plot(result.horizon, np.interp(result.horizon, result.times, largest), "o", color=color, ms=8)
    axes.set(yscale="log", xlabel="time [s]", ylabel="largest d positions / d start [-]")
    top = max(np.nanmax(result.sizes) for result in results.values())
    if top * rounding > 1e-4:
        axes.axhline(1e-2 / rounding, color="0.4", lw=1)
        place = dict(transform=axes.get_yaxis_transform(), va="bottom")
        axes.text(0.01, 1e-2 / rounding, "rounding grown to 1 % of the state", fontsize=9, color="0.35", **place)
    axes.grid(which="major", color="0.9")
    axes.set_title("Growth of gradients with the length of a run", loc="left", fontsize=11)
    axes.legend(frameon=False, fontsize=9, loc="upper left", bbox_to_anchor=(0, -0.12))
    save(figure, path)


def write_growth(results: dict[str, Growth], folder: str | Path, rounding: float) -> list[str]:
    """growth.png, .csv, .json in a folder; returns their names."""
    rows = [dict(scene=k, time=t, size=s) for k, r in results.items() for t, s in zip(r.times, r.sizes.max(0))]
    record = {name: asdict(r) | dict(times=r.times.tolist(), sizes=r.sizes.tolist()) for name, r in results.items()}
    return write_results(Path(folder) / "growth", lambda path: draw_growth(results, path, rounding), rows, record)
