"""Stiffness and friction of a soft cube from two films, with the share of repetitions whose intervals hold the truth.

A cube slides over a rough floor and comes to rest. Two cameras track all points of its surface, with noise of half a pixel
and no sample where the body hides a point. `identify` finds E and the coefficient of friction, each with a 95 % interval.

    python examples/identify/two_cameras.py [repetitions]
"""

import sys

import numpy as np

import diffsim_ti as ds
from diffsim_ti.picture import Camera

TRUTH, START = {"youngs_modulus": 2e4, "floor.friction": 0.3}, {"youngs_modulus": 4e4, "floor.friction": 0.2}
SIZE, NOISE = (640, 480), 0.5  # of a picture, of a track [pixels]
CUBE = ds.TetrahedralMesh.create_box(3, size=0.2, origin=(-0.1, 0.002, -0.1))
BOX = np.array([[-0.15, 0, -0.15], [0.3, 0.25, 0.2]])  # that both cameras see [m]


def filmed(steps: int = 20) -> ds.Rollout:
    """0.2 s by default, ten pictures."""
    rough = dict(friction=TRUTH["floor.friction"], friction_speed=0.02, name="floor")
    floor = ds.Ground(0.0, width=2e-3, stiffness_per_area=1e7, **rough)
    law, terms = ds.StableNeoHookean(TRUTH["youngs_modulus"], 0.3), [ds.Gravity(), floor]
    scene = ds.Scene(CUBE, law, 1e3, terms, initial_velocities=(0.5, 0, 0.1), precision="f64")
    points = CUBE.vertices[CUBE.surface_vertices]
    cameras = [Camera.framing(BOX, SIZE, azimuth, 20.0) for azimuth in (20.0, 70.0)]
    tracks = [ds.PixelTracks(camera, points, name=f"camera_{k}") for k, camera in enumerate(cameras)]
    solver = ds.ImplicitEulerSolver(scene, dt=0.01, tolerance=1e-12)
    return ds.Rollout(solver, steps, save_every=2, outputs=tracks, gradients="all")


def identified(film: ds.Rollout, frames, seed: int) -> ds.Identification:
    """From the tracks of frames with noise, without what is hidden."""
    rng, data = np.random.default_rng(seed), {}
    for name, track in frames.computed.items():
        seen = track.visible(frames)[..., None]
        data[name] = np.where(seen, frames[name] + rng.normal(scale=NOISE, size=frames[name].shape), np.nan)
    return ds.identify(film, data, START, noise=NOISE, check_mesh=False)


def main(repetitions: int = 20) -> dict[str, int]:
    """{number: in how many repetitions its interval holds the truth}"""
    film, held = filmed(), dict.fromkeys(TRUTH, 0)
    frames = film.forward()
    for seed in range(repetitions):
        found = identified(film, frames, seed)
        for name, (low, high) in found.intervals.items():
            held[name] += low < TRUTH[name] < high
        shown = ", ".join(f"{name} {low:.5g} to {high:.5g}" for name, (low, high) in found.intervals.items())
        print(f"{seed + 1}: {shown}", flush=True)
    for name, count in held.items():
        print(f"{name}: the interval holds the truth in {count} of {repetitions}")
    return held


if __name__ == "__main__":
    ds.init(precision="f64")
    main(*map(int, sys.argv[1:]))
