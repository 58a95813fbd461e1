"""Find Young's modulus and friction of a soft block from the force on a ball that is pressed in and dragged.

A laboratory records force against displacement. The ball goes down 8 mm, then 12 mm to the side; the force on it is
`ContactForce`. `identify` finds both numbers. Data carry noise of 0.2 % of the largest force.

    python examples/identify/indentation.py [folder for a picture]
"""

import sys
from pathlib import Path

import numpy as np

import diffsim_ti as ds
from diffsim_ti import picture
from diffsim_ti.obstacles import obstacle_surfaces

TRUTH = dict(youngs_modulus=6e4, friction=0.35)  # [Pa], [-]
GUESS = dict(youngs_modulus=2e4, friction=0.1)
DOWN, ASIDE, STEPS = 8e-3, 12e-3, 8  # [m], [m], steps of each
NOISE = 0.002  # of the largest force


def way(t: float) -> tuple[float, float, float]:
    """Displacement of the ball [m] after t steps."""
    return ASIDE * max(t - STEPS, 0) / STEPS, -DOWN * min(t, STEPS) / STEPS, 0.0


def experiment() -> ds.Rollout:
    mesh = ds.TetrahedralMesh.create_box((5, 4, 5), size=(0.08, 0.04, 0.08), pattern="five")
    ball = ds.Sphere(
        center=(0.04, 0.064, 0.04),
        radius=0.02,
        stiffness_per_area=1e7,
        width=4e-3,
        friction=GUESS["friction"],
        friction_speed=2e-4,  # of a static run: the way in a step [m] below which it sticks
        path=way,
        name="ball",
    )
    scene = ds.Scene(
        mesh, ds.StableNeoHookean(GUESS["youngs_modulus"], 0.4), terms=[ball], fixed="ymin", precision="f64"
    )
    force = ds.ContactForce("ball", name="force")
    return ds.Rollout(ds.StaticSolver(scene), 2 * STEPS, save_every=1, outputs=[force])


def main(folder: str | None = None) -> dict:
    """Returns the numbers found, their relative errors and standard errors, runs, and the forces [N]."""
    rollout = experiment()
    names = {"youngs_modulus": "youngs_modulus", "friction": "ball.friction"}  # of inputs

    def run(numbers):
        return rollout.forward(**{names[n]: x for n, x in numbers.items()})["force"]

    exact = run(TRUTH)
    noise = NOISE * np.abs(exact).max()
    seen = exact + noise * np.random.default_rng(0).standard_normal(exact.shape)
    unknowns = {n: ds.Unknown(x, input=names[n]) for n, x in GUESS.items()}
    found = ds.identify(rollout, {"force": seen}, unknowns, noise, check_mesh=False)  # data are of this very mesh
    numbers, spread = found.estimates, found.information.deviations  # relative, for the unknowns are logarithms
    errors = {name: abs(numbers[name] / TRUTH[name] - 1) for name in TRUTH}
    print(found)
    force = run(numbers)
    if folder:
        draw(Path(folder) / "indentation.png", rollout, -seen, -force, -run(GUESS))  # what the block does to the ball
    return dict(numbers=numbers, errors=errors, spread=spread, runs=1 + len(found.iterations), force=force, seen=seen)


def draw(path: Path, rollout, seen, found, guess) -> None:
    """The force curve, and the block at its end."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    path.parent.mkdir(parents=True, exist_ok=True)
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained", width_ratios=(3, 2))
    steps, colours = np.arange(len(seen)), {0: "tab:orange", 1: "tab:blue"}
    for axis, said in ((1, "up"), (0, "to the side")):
        axes[0].plot(steps, seen[:, axis], "o", color=colours[axis], mfc="none", label=f"{said}, measured")
        axes[0].plot(steps, found[:, axis], "-", color=colours[axis], label=f"{said}, found")
        axes[0].plot(steps, guess[:, axis], ":", color=colours[axis], label=f"{said}, guessed")
    axes[0].set(
        xlabel=f"step: {STEPS} of {DOWN * 1e3 / STEPS:g} mm down, {STEPS} aside", ylabel="force on the ball [N]"
    )
    axes[0].legend(fontsize=8)
    frames = rollout.forward(youngs_modulus=TRUTH["youngs_modulus"], **{"ball.friction": TRUTH["friction"]})
    mesh, scene = rollout.scene.mesh, rollout.scene
    balls = obstacle_surfaces(scene, 2.0 * STEPS)
    axes[1].imshow(picture.draw(mesh, frames.positions[-1], obstacles=balls, size=(640, 520), elevation=20))
    axes[1].axis("off")
    figure.savefig(path, dpi=120)
    plt.close(figure)


if __name__ == "__main__":
    ds.init(precision="f64")
    main(*sys.argv[1:])
