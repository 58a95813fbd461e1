"""A soft hand finds the grip that lifts a soft ball and holds it for two seconds.

Two fingers hang from clamps that turn and rise (`ds.Pose`); friction of soft on soft is all that carries the ball. Unknown
is by how much each finger turns, at three times. The gradient goes through turning clamps, contact and friction; the start
drops the ball.

    python examples/control/soft_hand.py [folder for a film]
"""

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

import diffsim_ti as ds
from diffsim_ti.film import save_film
from diffsim_ti.picture import arrows

RADIUS, WIDTH, FRICTION = 0.04, 2e-3, 0.6  # [m], [m], [-]
FINGER, LOW = (0.025, 0.1, 0.035), 0.015  # size of a finger, how high its tip is at first [m]
LIFT, DT, EVERY = 0.08, 2.5e-4, 200  # [m], [s], steps between frames
CLOSED, LIFTED, TRIED, HELD = (
    0.25,
    0.65,
    0.95,
    2.65,
)  # when the hand has closed, has risen, ends of trials and of all [s]
KNOTS = np.array([0.2, 0.4, 0.6])  # when turns are chosen [s]; they begin at 0, and stay after the last
START = (12.0, 10.0)  # of left and right [degrees], which drops the ball
SLIP = 4e-3  # what counts as held while it is lifted [m], in which fingers and ball are sheared
LOST = 0.01  # beyond which it hardly counts how far the ball has fallen [m]


def ball(radius: float, count: int = 4) -> ds.TetrahedralMesh:
    """A cube of `count` vertices a side, drawn out to a ball."""
    cube = ds.TetrahedralMesh.create_box(count, size=2.0, origin=(-1, -1, -1), pattern="five")
    x = cube.vertices
    a, b = np.roll(x, 1, 1) ** 2, np.roll(x, 2, 1) ** 2
    return ds.TetrahedralMesh(radius * x * np.sqrt(1 - a / 2 - b / 2 + a * b / 3), cube.tetrahedra)


def hand_scene(friction: float = FRICTION) -> ds.Scene:
    """The ball ("body_2") on a floor, between fingers whose upper ends, "left" and "right", are clamped."""
    finger, away = ds.TetrahedralMesh.create_box((3, 6, 3), size=FINGER, pattern="five"), RADIUS + 1.5 * WIDTH
    placed = [finger.translated([x, LOW, -FINGER[2] / 2]) for x in (-away - FINGER[0], away)]
    mesh = ds.TetrahedralMesh.joined([*placed, ball(RADIUS).translated([0, RADIUS + 3e-3, 0])])
    upper = finger.vertex_indices("ymax")
    ends = {"left": upper, "right": upper + finger.num_vertices}
    mesh = ds.TetrahedralMesh(mesh.vertices, mesh.tetrahedra, vertex_sets=mesh.vertex_sets | ends)
    E = np.full(mesh.num_tetrahedra, 6e4)
    E[: 2 * finger.num_tetrahedra] = 4e5
    still = ([0.0, HELD], np.zeros((2, 6)))  # how clamps move is an input
    about = {name: mesh.vertices[vertices].mean(0) for name, vertices in ends.items()}
    return ds.Scene(
        mesh,
        ds.StableNeoHookean(E, 0.3),
        1000.0,
        [
            ds.Gravity(),
            ds.Drag(5.0),
            ds.SelfContact(2e3, WIDTH, friction=friction, friction_speed=3e-4),
            ds.Ground(stiffness=1e3, width=2 * WIDTH, friction=0.5),
        ],
        fixed=dict.fromkeys(ends, "xyz"),
        motion={name: ds.Pose(still, about[name]) for name in ends},
        precision="f64",
    )


class Grip:
    """Runs of a scene for turns of the fingers; `outputs`: what frames have besides."""

    def __init__(
        self, scene: ds.Scene, end: float, outputs=(), gradients=("prescribed_pose.left", "prescribed_pose.right")
    ):
        steps = EVERY * round(end / DT / EVERY)
        self.scene, self.ball = scene, scene.mesh.vertex_sets["body_2"]
        self.rollout = ds.Rollout(
            ds.SemiImplicitSolver(scene, dt=DT), steps, EVERY, gradients=list(gradients), outputs=list(outputs)
        )
        times = np.arange(steps + 1) * DT
        rising = np.clip((times - CLOSED) / (LIFTED - CLOSED), 0, 1)
        self.lift = LIFT * rising**2 * (3 - 2 * rising)
        rows = np.eye(len(KNOTS) + 1)[1:]
        self.hats = np.stack([np.interp(times, [0, *KNOTS], row) for row in rows], 1)  # (steps + 1, knots)
        self.gripped = round(CLOSED / DT / EVERY)  # frames from here on count

    def run(self, turns: np.ndarray):
        """(frames, how far the ball has gone against the hand since it closed [m]) for turns [rad], shape (2, knots)."""
        poses = {}
        for name, sign, row in zip(("left", "right"), (1, -1), turns):
            poses[f"prescribed_pose.{name}"] = out = np.zeros((len(self.lift), 6))
            out[:, 1], out[:, 5] = self.lift, sign * self.hats @ row
        frames = self.rollout.forward(**poses)
        centre = frames.positions[:, self.ball].mean(1)
        centre[:, 1] -= self.lift[::EVERY]
        return frames, (centre - centre[self.gripped])[self.gripped :]

    def loss(self, frames, slip: np.ndarray) -> tuple[float, np.ndarray]:
        """(sum s^2 / (s^2 + LOST^2), its gradient by the turns), s: how far the ball has slipped in a frame."""
        squares = (slip**2).sum(1, keepdims=True)
        by_slip = 2 * slip * LOST**2 / (squares + LOST**2) ** 2 / len(self.ball)
        seed = np.zeros(frames.positions.shape)
        seed[self.gripped :, self.ball] = by_slip[:, None]
        seed[self.gripped, self.ball] -= by_slip.sum(0)
        by = self.rollout.vjp(frames, seed)
        gradient = [self.hats.T @ by["prescribed_pose.left"][:, 5], -self.hats.T @ by["prescribed_pose.right"][:, 5]]
        return float((squares / (squares + LOST**2)).sum()), np.stack(gradient)


def find_grip(scene: ds.Scene, most: int = 30) -> list[dict]:
    """What was tried: turns [rad] and how far the ball slipped while it was lifted [m]; the last one holds."""
    grip, seen = Grip(scene, TRIED), []

    def evaluate(degrees):
        """Loss and its gradient by turns [degrees]."""
        turns = np.radians(degrees).reshape(2, -1)
        frames, slip = grip.run(turns)
        seen.append(dict(slip=float(np.linalg.norm(slip, axis=1).max()), turns=turns))
        print(
            f"evaluation {len(seen)}: turns {np.round(degrees, 2).tolist()}, slips by {1e3 * seen[-1]['slip']:.3g} mm"
        )
        if seen[-1]["slip"] < SLIP or len(seen) == most:
            raise StopIteration
        loss, gradient = grip.loss(frames, slip)
        return loss, np.radians(gradient).ravel()

    begin = np.repeat(START, len(KNOTS))
    try:
        minimize(evaluate, begin, jac=True, method="L-BFGS-B", bounds=[(0, 40)] * len(begin))
    except StopIteration:
        pass
    return seen


def save_hands(path, runs, grip: Grip) -> None:
    """A film of runs side by side, with what the hand does to the ball as arrows, at the speed of life."""
    mesh, times, apart = grip.scene.mesh, runs[0][0].times, 0.32 * np.arange(len(runs))
    bare = ds.TetrahedralMesh(mesh.vertices, mesh.tetrahedra)
    both = ds.TetrahedralMesh.joined([bare.translated([x, 0, 0]) for x in apart])
    positions = np.concatenate([frames.positions + [x, 0, 0] for (frames, _), x in zip(runs, apart)], 1)
    balls = np.concatenate([grip.ball + k * mesh.num_vertices for k in range(len(runs))])
    forces = np.concatenate([frames["self_contact_force"][:, grip.ball] for frames, _ in runs], 1)
    shown = [arrows("hand on the ball [N]", both, *now) for now in zip(positions, [balls] * len(times), forces)]
    colour = np.zeros(both.num_vertices)
    colour[balls] = 1
    save_film(
        path,
        both,
        positions,
        [colour] * len(times),
        fps=1 / (EVERY * DT),
        size=(400, 200),
        title=lambda k: f"t = {times[k]:.2f} s: as the hand turns at first, and as it found",
        colours="PuOr",
        limits=(-0.3, 1.4),
        ground=0.0,
        marks=[[replace(mark, through=True)] for mark in shown],
        wireframe=True,
        azimuth=12.0,
        elevation=8.0,
        box=[[-0.06, 0.02, -0.03], [0.38, 0.16, 0.03]],
        backend="software",
    )


def main(picture_folder: str | None = None) -> dict:
    """Returns how high the ball is at the end with the turns of the start and those found, how far it has gone against the
    hand in the two seconds [m], the force of each finger that presses [N], turns [degrees], evaluations and seconds."""
    start, scene = time.process_time(), hand_scene()
    seen = find_grip(scene)
    outputs = [ds.SelfContactForce(per_vertex=True)]
    outputs += [ds.SelfContactForce(f"body_{k}", "normal", name=f"finger_{k}") for k in (0, 1)]
    whole = Grip(scene, HELD, outputs, gradients=())
    runs = [whole.run(seen[k]["turns"]) for k in (0, -1)]
    first = runs[0][0].positions[0, whole.ball, 1].mean()
    heights = [float(frames.positions[-1, whole.ball, 1].mean() - first) for frames, _ in runs]
    slip = runs[1][1]
    creep = float(np.linalg.norm(slip[-1] - slip[round((LIFTED - CLOSED) / DT / EVERY)]))
    presses = [float(np.linalg.norm(runs[1][0][f"finger_{k}"][-1])) for k in (0, 1)]
    seconds, turns = time.process_time() - start, np.degrees(seen[-1]["turns"])
    if picture_folder:
        save_hands(Path(picture_folder) / "soft_hand.gif", runs, whole)
    print(
        f"lifted by {100 * heights[0]:.1f} cm at first, {100 * heights[1]:.1f} cm with turns of {turns.round(1).tolist()} "
        f"degrees; creeps by {1e3 * creep:.2g} mm in {HELD - LIFTED:g} s; fingers press with "
        f"{presses[0]:.2f} and {presses[1]:.2f} N; {len(seen)} evaluations, {seconds:.0f} s of processor time"
    )
    return {
        "before": heights[0],
        "after": heights[1],
        "creep": creep,
        "presses": presses,
        "turns": turns,
        "evaluations": len(seen),
        "seconds": seconds,
    }


if __name__ == "__main__":
    ds.init(precision="f64")
    main(*sys.argv[1:])
