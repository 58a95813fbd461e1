"""Pairs of a list that have been near since it was made, on the device, for part_kernels.py."""

from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.surfaces.buffers import Buffers, Launches, whole
from diffsim_ti.mechanics.surfaces.host_geometry import NODES, SHARES
from diffsim_ti.mechanics.surfaces.part_kernels import OF_NODES, OF_POINTS, WORK, PartKernels
from diffsim_ti.runtime import kernels_of

VECTOR = ti.types.vector(4, ti.f64)
LEAST = 1024  # length of the arrays, so that few are made anew
KINDS = dict(ints=ti.i32, scalars=ti.f64, vectors=VECTOR)


class NearSet:
    """Arrays that grow, and launches of the kernels on them."""

    def __init__(self, pairs):
        self.inner, self.launch = pairs, Launches()
        self.buffers, self.kernels = Buffers(self.launch, False), kernels_of(PartKernels, "f64")
        self.numbers, self.builds, self.sizes = np.zeros(0, int), -1, {}
        self.arrays = {name: SimpleNamespace() for name in ("pairs", "nodes", "state", "work")}

    def _take(self, of: str, name: str, kind, count: int):
        array = self.buffers.take(f"{of} {name}", kind, count, least=LEAST)
        setattr(self.arrays[of], name, array)
        return array

    def _put(self, of: str, name: str, kind, data: np.ndarray) -> None:
        self._write(self._take(of, name, kind, len(data)), data)

    @staticmethod
    def _write(array, data: np.ndarray) -> None:
        host = runtime.view(array)
        if host is None:
            padded = np.zeros((array.shape[0], *data.shape[1:]), data.dtype)
            padded[: len(data)] = data
            runtime.fill(array, padded)
        elif data.ndim > 1:
            host[: len(data), :3] = data
        else:
            host[: len(data)] = data

    def _get(self, name: str) -> np.ndarray:
        host = whole(getattr(self.arrays["state"], name))
        return host[: self.sizes["num_nodes"], :3].copy()

    def holds(self, numbers: np.ndarray) -> bool:
        """Whether these pairs of the list are in the set."""
        return self.builds == self.inner.builds and bool(self.member[numbers].all())

    def fill(self, one, of) -> None:
        """one, of: a ContactPass of pairs of the list with `numbers`, and what its parts read."""
        near, chosen = one.near, np.zeros(len(one.numbers), np.int32)
        if self.builds == self.inner.builds:
            chosen[np.searchsorted(one.numbers, self.numbers)] = self.chosen
        self.builds, self.numbers = self.inner.builds, one.numbers
        self.member = np.zeros(self.inner.list.count, bool)
        self.member[self.numbers] = True
        (start, index, weight), n, count = near.rows, len(of.inverse), len(self.numbers)
        room = 4 * int(np.diff(start).max(initial=1))
        for name, data in (("corners", near.corners.ravel()), ("number", one.numbers), ("chosen", chosen)):
            self._put("pairs", name, ti.i32, data)
        for name, data in vars(of).items():
            if name in ("stiffness", "width", "radius", "mu", "speed"):
                self._put("pairs", name, ti.f64, np.broadcast_to(data, count))
        self._put("pairs", "scale", ti.f64, near.scale)
        self._put("nodes", "start", ti.i32, start)
        self._put("nodes", "index", ti.i32, index)
        self._put("nodes", "weight", ti.f64, weight)
        self._put("nodes", "inverse", ti.f64, of.inverse)
        free = np.broadcast_to(np.eye(3), (n, 3, 3)) if near.free is None else near.free
        self._put("nodes", "free", VECTOR, free.reshape(-1, 3))
        for name in ("x", "motion"):
            self._take("nodes", name, VECTOR, n)
        for name in ("e", "b", "e_next", "b_next", "xi"):
            self._take("state", name, VECTOR, n)
        self._take("state", "result", ti.i32, 1)
        self._take("state", "damping", ti.f64, 1)
        for name, kind in WORK.items():
            if name == "gauss":
                continue
            size = near.num_points if name in OF_POINTS else n if name in OF_NODES else count
            size = room * count if name in ("node", "share", "row") else size
            self._take("work", name, KINDS[kind], size)
        self._put("work", "gauss", ti.f64, np.stack([NODES, SHARES], 1).ravel())
        self.wall, self.rough = of.wall, of.rough
        num_vt = count - int(near.edges.sum())
        self.sizes = dict(num_vt=num_vt, num_pairs=count, num_points=near.num_points, num_nodes=n, room=room)
        self._choose = self.launch(self.kernels.choose, list=SimpleNamespace(near=self.inner.near), **self.arrays)
        self._take_part = self.launch(self.kernels.take, **self.arrays)

    @property
    def chosen(self) -> np.ndarray:
        return whole(self.arrays["pairs"].chosen)[: self.sizes["num_pairs"]]

    def begin(self, x: np.ndarray, anew: bool) -> None:
        """A pass begins with nodes at x; anew: and no pair is chosen."""
        self._write(self.arrays["nodes"].x, x)
        if anew:
            runtime.fill(self.arrays["pairs"].chosen, 0)

    def choose(self, motion: np.ndarray) -> int:
        """Choose the pairs that come near while nodes move so: how many are new."""
        self._write(self.arrays["nodes"].motion, motion)
        self._choose(**self.sizes)
        return int(whole(self.arrays["state"].result)[0])

    def start(self, motion: np.ndarray) -> None:
        """Parts begin, of a pass in which nodes would move so without contact."""
        self._write(self.arrays["nodes"].motion, motion)
        for name in ("e", "b"):
            runtime.fill(getattr(self.arrays["state"], name), 0)

    @property
    def moved(self) -> tuple[np.ndarray, np.ndarray]:
        """What contact has added to displacements and velocities, (e, b)."""
        return self._get("e"), self._get("b")

    def take(self, **numbers) -> tuple[int, float]:
        """(what came of a part, its damping)"""
        self._take_part(**self.sizes, wall=self.wall, rough=int(self.rough), **numbers)
        return int(whole(self.arrays["state"].result)[0]), float(whole(self.arrays["state"].damping)[0])

    @property
    def solution(self) -> np.ndarray:
        """xi of the part that was taken."""
        return self._get("xi").ravel()
