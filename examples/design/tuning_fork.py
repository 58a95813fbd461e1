"""Which shape must a tuning fork have, to ring at 440 Hz and its first overtone at six times that?

A beam of even thickness has its overtone at 6.27 times the pitch, this fork at 6.2; six is two octaves and a fifth. The
unknowns are the length of the prongs and how much they taper; both move the vertices, and the gradients of the two
frequencies by the rest positions (`modes(scene, k).gradients`) chain to them. Newton's method on two equations:

    (f, overtone) (length, taper) = (440, 2640) Hz,        df/dp = sum_i df/dX_i . dX_i/dp

The fork is of steel, clamped at the end of its stem. Its modes are those of this mesh: linear tetrahedra are too stiff in
bending, so that a finer mesh of the same shape rings lower, by the 3 % that are printed.

    python examples/design/tuning_fork.py [folder for a picture, default output]
"""

import sys
from pathlib import Path

import numpy as np

import diffsim_ti as ds
from diffsim_ti.picture import save_picture

PITCH, OVERTONE = 440.0, 2640.0  # [Hz]
E, NU, DENSITY = 206e9, 0.29, 7850.0
STEM, YOKE, PRONG, THICK, GAP, WIDE = 0.02, 0.008, 0.085, 0.004, 0.008, 0.005  # [m]; PRONG: the length before tuning


class Fork:
    """A mesh of boxes, and where its vertices go as the prongs become `length` [m] long and `taper` times thinner at their
    tips: a point at the share s of the prong has 1 - taper s of its distance from the prong's middle."""

    def __init__(self, along: int, across: int):
        """Cells along a prong, and through its thickness."""
        x = np.concatenate([np.linspace(0, THICK, across + 1), [THICK + GAP / 2]])
        x = np.concatenate([x, 2 * THICK + GAP - x[-2::-1]])
        y = np.concatenate(
            [np.linspace(-STEM - YOKE, -YOKE, 5)[:-1], np.linspace(-YOKE, 0, 4)[:-1], np.linspace(0, PRONG, along + 1)]
        )
        grid = ds.TetrahedralMesh.create_box((len(x), len(y), 3), (len(x) - 1.0, len(y) - 1.0, 2.0), pattern="five")
        cell = grid.vertices[grid.tetrahedra].mean(1).astype(int)
        on_stem = (cell[:, 0] >= across) & (cell[:, 0] < across + 2)  # the two columns between the prongs
        kept = grid.tetrahedra[np.where(cell[:, 1] >= 7, ~on_stem, (cell[:, 1] >= 4) | on_stem)]
        used, corners = np.unique(kept, return_inverse=True)
        at = np.rint(grid.vertices[used]).astype(int)
        self.base = np.stack([x[at[:, 0]], y[at[:, 1]], WIDE * (at[:, 2] / 2 - 0.5)], 1)
        self.mesh = ds.TetrahedralMesh(self.base, corners.reshape(-1, 4))
        self.middle = np.where(self.base[:, 0] < THICK + GAP / 2, THICK / 2, 1.5 * THICK + GAP)
        self.share = np.maximum(self.base[:, 1], 0) / PRONG

    def shape(self, p: np.ndarray) -> np.ndarray:
        """Rest positions [m] for p = (length, taper)."""
        out = np.array(self.base)
        out[:, 1] += self.share * (p[0] - PRONG)
        out[:, 0] -= p[1] * self.share * (self.base[:, 0] - self.middle)
        return out

    def slopes(self) -> np.ndarray:
        """dX/dp, shape (2, num_vertices, 3)."""
        out = np.zeros((2, *self.base.shape))
        out[0, :, 1] = self.share
        out[1, :, 0] = -self.share * (self.base[:, 0] - self.middle)
        return out

    def ring(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, ds.Modes, list[int]]:
        """(pitch and overtone [Hz], their Jacobian by p, the modes, which two they are)."""
        scene = ds.Scene(
            ds.TetrahedralMesh(self.shape(p), self.mesh.tetrahedra),
            ds.LinearElastic(E, NU),
            DENSITY,
            fixed=np.flatnonzero(self.base[:, 1] < -STEM - YOKE + 1e-9),
            precision="f64",
        )
        found = ds.modes(scene, 14)
        chosen = self.against_each_other(found.shapes)
        jacobian = [(found.gradients(np.eye(14)[k])["rest_positions"] * self.slopes()).sum((1, 2)) for k in chosen]
        return found.frequencies[chosen], np.array(jacobian), found, chosen

    def against_each_other(self, shapes: np.ndarray) -> list[int]:
        """The first two modes in which the prongs swing against each other in their plane, as a struck fork does."""
        upper = self.share > 0.3
        left = upper & (self.base[:, 0] < THICK + GAP / 2)
        right = upper & ~left
        out = []
        for k, phi in enumerate(shapes):
            motion = (phi[upper] ** 2).sum()
            mirrored = ((phi[left, 0] - phi[right, 0][self.mirror(left, right)]) ** 2).sum()
            if mirrored > 0.9 * 2 * motion:
                out.append(k)
        if len(out) < 2:
            raise RuntimeError("fewer than two of the modes are a fork's: look for more modes")
        return out[:2]

    def mirror(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """For each vertex of the left prong the place of its image among those of the right."""
        image = self.base[left] * [-1, 1, 1] + [2 * THICK + GAP, 0, 0]
        return np.array([((self.base[right] - x) ** 2).sum(1).argmin() for x in image])


def tuned(fork: Fork, p: np.ndarray, say=print) -> tuple[np.ndarray, list[np.ndarray]]:
    """(p, [pitch and overtone of each iteration]); Newton's method until both are right to 1e-6."""
    wanted, history = np.array([PITCH, OVERTONE]), []
    for iteration in range(12):
        heard, jacobian, _, _ = fork.ring(p)
        history.append(heard)
        say(f"{iteration}: prongs {1e3 * p[0]:.3f} mm, taper {p[1]:.4f}: {heard[0]:.3f} Hz, {heard[1]:.2f} Hz")
        if np.abs(heard / wanted - 1).max() < 1e-6:
            return p, history
        p = p + np.clip(np.linalg.solve(jacobian, wanted - heard), [-0.02, -0.3], [0.02, 0.3])
    raise RuntimeError("the fork was not tuned in 12 iterations")


def main(folder="output", quick: bool = False) -> dict:
    """Returns pitch and overtone before, after, on a finer mesh of that shape and in each iteration [Hz]; p; iterations."""
    fork, p = Fork(32, 2) if quick else Fork(64, 4), np.array([PRONG, 0.0])
    _, _, first, chosen = fork.ring(p)
    start = fork.shape(p)
    p, history = tuned(fork, p)
    heard, _, modes, of = fork.ring(p)
    finer, *_ = (Fork(48, 2) if quick else Fork(96, 6)).ring(p)
    before = history[0]
    print(
        f"from {before[0]:.1f} and {before[1]:.1f} Hz ({before[1] / before[0]:.3f} times) to {heard[0]:.4f} and "
        f"{heard[1]:.3f} Hz in {len(history) - 1} iterations: prongs {1e3 * p[0]:.2f} mm long, {100 * p[1]:.1f} % thinner "
        f"at the tips; a finer mesh of that shape rings at {finer[0]:.1f} and {finer[1]:.1f} Hz"
    )
    if folder:
        draw(Path(folder), fork, [start, fork.shape(p)], [first.shapes[chosen[0]], modes.shapes[of[0]]], before, heard)
    return dict(before=before, after=heard, p=p, iterations=len(history) - 1, finer=finer, history=history)


def draw(folder: Path, fork: Fork, rests: list, shapes: list, before: np.ndarray, after: np.ndarray) -> None:
    """Both forks side by side as they swing, coloured by how far."""
    folder.mkdir(exist_ok=True)
    apart, positions, swings = 4 * THICK + 3 * GAP, [], []
    for k, (rest, phi) in enumerate(zip(rests, shapes)):
        tip = phi[np.argmax(fork.share - 1e-3 * fork.base[:, 0])]
        swing = phi * (-np.sign(tip[0]) * 0.7 * GAP / np.abs(phi).max())
        positions.append(rest + swing + [k * apart, 0, 0])
        swings.append(np.linalg.norm(swing, axis=1) / (0.7 * GAP))
    both = ds.TetrahedralMesh.joined([fork.mesh, fork.mesh.translated([apart, 0, 0])])
    words = [f"{pair[0]:.0f} Hz, {pair[1]:.0f} Hz" for pair in (before, after)]
    save_picture(
        folder / "tuning_fork.png",
        both,
        np.concatenate(positions),
        np.concatenate(swings),
        "swing [of the tip's]",
        azimuth=14,
        elevation=8,
        wireframe=True,
        title=f"pitch and overtone: {words[0]} (left), tuned {words[1]}",
        fixed=np.concatenate([fork.base[:, 1], fork.base[:, 1]]) < -STEM - YOKE + 1e-9,
    )


if __name__ == "__main__":
    ds.init(precision="f64")
    main(*sys.argv[1:])
