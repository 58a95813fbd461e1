"""A piece of work in a file that every peer's interpreter can read: NumPy alone, nothing of diffsim_ti.

A job is a body of Smith neo-Hookean tetrahedra, its start, its floor, and symplectic Euler's step and number of steps. Every
peer answers with its frames, its gradients if asked for, and its best time.
"""

import sys
import time
from copy import copy

import numpy as np


class Job:
    """vertices (n, 3) [m], tetrahedra (m, 4); start, velocities (n, 3); fixed: indices; E [Pa], nu, density,
    gravity [m/s^2]; h [s], substeps per frame, frames; keep: what is left of the velocity after a substep;
    ground: (stiffness [N/m], width [m]) of the barrier of y = 0, or nothing; repeats: timed runs; device: "cpu" or "cuda";
    worlds: how many such bodies at once, of which the first one is answered.

    With `weights` (n, 3) a gradient is wanted, of the loss sum_f [linear_f q_f + square_f (q_f - target_f)^2 / 2],
    q_f = sum(weights * displacements_f); the three are of length frames + 1.
    """

    def __init__(self, path: str):
        self.path = path
        with np.load(path) as file:
            self.__dict__.update(dict(device="cpu", worlds=1) | {name: value[()] for name, value in file.items()})
        self.device = str(self.device)
        self.frames, self.substeps, self.repeats = int(self.frames), int(self.substeps), int(self.repeats)
        self.worlds = int(self.worlds)
        self.rest_edges = np.moveaxis(self.edges(self.vertices), 1, 2)
        self.volumes = np.linalg.det(self.rest_edges) / 6
        self.masses = np.bincount(
            self.tetrahedra.ravel(), np.repeat(self.density * self.volumes / 4, 4), len(self.vertices)
        )
        self.mu = self.E / (2 * (1 + self.nu))
        self.lam = self.E * self.nu / ((1 + self.nu) * (1 - 2 * self.nu))

    def in_one(self) -> "Job":
        """All worlds as one body of so many pieces."""
        out, n = copy(self), len(self.vertices)
        shift = n * np.arange(self.worlds)
        for name in ("vertices", "start", "velocities", *(["weights"] if self.differentiates else [])):
            setattr(out, name, np.tile(getattr(self, name), (self.worlds, 1)))
        out.tetrahedra = (self.tetrahedra + shift[:, None, None]).reshape(-1, 4)
        out.fixed = (self.fixed + shift[:, None]).ravel()
        out.rest_edges = np.tile(self.rest_edges, (self.worlds, 1, 1))
        out.volumes, out.masses = (np.tile(x, self.worlds) for x in (self.volumes, self.masses))
        return out

    @property
    def differentiates(self) -> bool:
        return "weights" in self.__dict__

    def edges(self, x):
        """Edges from each tetrahedron's first vertex, shape (m, 3, 3)."""
        return x[self.tetrahedra[:, 1:]] - x[self.tetrahedra[:, :1]]

    def adjoints(self, positions) -> np.ndarray:
        """The loss's gradient by the frames' positions, shape (frames + 1, n, 3)."""
        q = np.tensordot(np.asarray(positions, np.float64) - self.vertices, self.weights, 2)
        slope = self.linear + self.square * (q - self.target)
        return slope[:, None, None] * self.weights

    def by_youngs_modulus(self, by_mu, by_lam) -> float:
        """d / dE from d / dmu and d / dlam."""
        return (by_mu * self.mu + by_lam * self.lam) / self.E


def timed(function, repeats: int, compiles: bool = True, enough: float = 6.0):
    """(best wall time [s], the result) of up to `repeats` calls, until `enough` seconds are spent; where a first call
    `compiles` it is not counted."""
    result, times = function() if compiles else None, []
    while not times or (len(times) < repeats and sum(times) < enough):
        begin = time.perf_counter()
        result = function()
        times.append(time.perf_counter() - begin)
    return min(times), result


def answer_all(work) -> None:
    """Answer the jobs whose files the command line names; work(job) -> (seconds, positions, gradients)."""
    for path in sys.argv[1:]:
        job = Job(path)
        seconds, positions, gradients = work(job)
        displacements = np.asarray(positions, np.float64) - job.vertices
        np.savez(path.replace(".job.npz", ".answer.npz"), seconds=seconds, displacements=displacements, **gradients)
        print(f"{path}: {seconds:.3g} s", flush=True)
