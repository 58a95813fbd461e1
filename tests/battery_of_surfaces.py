"""Dirty surfaces, filled and dropped: python tests/battery_of_surfaces.py --cases 100

Bodies of known volume (boxes, balls, tori, dumb-bells, a hollow ball) lose triangles, get flipped and doubled ones, meet
themselves, get T-junctions, crumbs, thin walls and noise; each is filled by `from_surface` and falls by the command
`simulate` with its default settings (--falls 0 leaves that out). Right is a volume within 5 % of the clean body's, or a
refusal that says why. Prints a table; exit code 1 if more than one in twenty is neither.
"""

import argparse
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path

import numpy as np

import diffsim_ti as ds
from diffsim_ti.cli import app


def ball(levels: int = 3, radius: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """An icosahedron, its triangles cut in four, on a sphere."""
    import trimesh

    made = trimesh.creation.icosphere(subdivisions=levels, radius=radius)
    return np.array(made.vertices), np.array(made.faces)


def torus() -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    made = trimesh.creation.torus(0.1, 0.035, major_sections=40, minor_sections=20)
    return np.array(made.vertices), np.array(made.faces)


def box() -> tuple[np.ndarray, np.ndarray]:
    made = ds.TetrahedralMesh.create_box((7, 5, 5), (0.2, 0.1, 0.1))
    used, corners = np.unique(made.surface_triangles, return_inverse=True)
    return made.vertices[used], corners.reshape(-1, 3)


def joined(*parts) -> tuple[np.ndarray, np.ndarray]:
    firsts = np.cumsum([0, *(len(p) for p, _ in parts)])
    return np.concatenate([p for p, _ in parts]), np.concatenate([t + k for (_, t), k in zip(parts, firsts)])


BODIES = dict(box=box, ball=ball, torus=torus)


def volume(points, triangles) -> float:
    a, b, c = points[triangles].transpose(1, 0, 2)
    return abs(float(np.einsum("ij,ij->", a, np.cross(b, c)))) / 6


def hole(points, triangles, rng):
    """A few neighbouring triangles are missing."""
    middle = points[triangles].mean(1)
    near = np.argsort(np.linalg.norm(middle - middle[rng.integers(len(middle))], axis=1))
    return points, np.delete(triangles, near[: rng.integers(1, 5)], 0)


def flipped(points, triangles, rng):
    some = rng.random(len(triangles)) < 0.2
    triangles = triangles.copy()
    triangles[some] = triangles[some][:, ::-1]
    return points, triangles


def doubled(points, triangles, rng):
    return points, np.concatenate([triangles, triangles[rng.choice(len(triangles), 5, replace=False)]])


def crossing(points, triangles, rng):
    """One vertex is pushed a little through the opposite side of its neighbourhood."""
    points, k = points.copy(), rng.integers(len(points))
    near = np.argsort(np.linalg.norm(points - points[k], axis=1))[1:4]
    points[k] = points[near].mean(0) + 0.3 * (points[near].mean(0) - points[k]) + 1e-4 * rng.standard_normal(3)
    return points, triangles


def junctions(points, triangles, rng):
    """A triangle is cut at the middle of an edge, and its neighbour is not."""
    for k in rng.choice(len(triangles), 4, replace=False):
        a, b, c = triangles[k]
        points = np.vstack([points, points[[a, b]].mean(0)])
        triangles = np.vstack([np.delete(triangles, k, 0), [[a, len(points) - 1, c], [len(points) - 1, b, c]]])
    return points, triangles


def crumbs(points, triangles, rng):
    """Small triangles that belong to nothing, beside the body."""
    loose = points[rng.choice(len(points), 3)][:, None] * 1.3 + 1e-3 * rng.standard_normal((3, 3, 3))
    return joined((points, triangles), (loose.reshape(-1, 3), np.arange(9).reshape(3, 3)))


def noise(points, triangles, rng):
    return points + 3e-4 * rng.standard_normal(points.shape), triangles


def split_points(points, triangles, rng):
    """Every triangle has points of its own, moved by rounding of float32."""
    return points[triangles].reshape(-1, 3).astype(np.float32).astype(np.float64), np.arange(
        3 * len(triangles)
    ).reshape(-1, 3)


def shells(points, triangles, rng):
    """A second body beside it, and one that overlaps it by a corner."""
    other = points * 0.5 + [0.3, 0, 0]
    return joined((points, triangles), (other, triangles))


FAULTS = (hole, flipped, doubled, crossing, junctions, crumbs, noise, split_points, shells)


def case(seed: int) -> tuple[str, np.ndarray, np.ndarray, float]:
    rng = np.random.default_rng(seed)
    name = list(BODIES)[rng.integers(len(BODIES))]
    points, triangles = BODIES[name]()
    clean = volume(points, triangles)
    faults = [FAULTS[k] for k in rng.choice(len(FAULTS), rng.integers(1, 3), replace=False)]
    for fault in sorted(faults, key=FAULTS.index):
        if fault is shells:
            clean *= 1.125
        points, triangles = fault(points, triangles, rng)
    return f"{name}: {', '.join(fault.__name__ for fault in faults)}", points, triangles, clean


def judge(seed: int, falls: bool, folder: Path) -> tuple[str, str]:
    """(what, "filled", "refused" or "WRONG ...")"""
    what, points, triangles, clean = case(seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            body = ds.TetrahedralMesh.from_surface(points, triangles)
        except ValueError as error:
            return what, f"refused: {error}"
        off = body.volume / clean - 1
        if abs(off) > 0.05:
            return what, f"WRONG: volume {100 * off:+.1f} %"
        if falls:
            body.save(folder / "body.vtu")
            try:
                app.main(["simulate", str(folder / "body.vtu"), "-o", str(folder / "fall.npz"), "--duration", "0.05"])
            except SystemExit as end:
                if end.code:
                    return what, "WRONG: it does not fall"
    return what, "filled"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--cases", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--falls", type=int, default=1, help="1: each falls by the command simulate, too")
    options = parser.parse_args()
    counts = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(options.seed, options.seed + options.cases):
            begin = time.time()
            what, said = judge(seed, bool(options.falls), Path(folder))
            counts[said.split(":")[0]] += 1
            print(f"{seed:4d} {time.time() - begin:6.1f} s  {what:40s} {said}", flush=True)
    print(", ".join(f"{count} {name}" for name, count in counts.items()))
    return int(counts["WRONG"] + counts["refused"] > 0.05 * options.cases)


if __name__ == "__main__":
    sys.exit(main())
