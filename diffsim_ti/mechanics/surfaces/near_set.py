"""Pairs of a list that have been near since it was made, on the device, for part_kernels.py."""

from types import SimpleNamespace

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.surfaces import part_kernels as kernels
from diffsim_ti.mechanics.surfaces.buffers import Buffers, Launches, put, whole
from diffsim_ti.mechanics.surfaces.host_geometry import NODES, SHARES
from diffsim_ti.runtime import kernels_of

KINDS = dict(ints=ti.i32, scalars=ti.f64, vectors=ti.types.vector(4, ti.f64))
LEAST = 1024  # length of the arrays, so that few are made anew


class NearSet:
    """Arrays that grow, and launches of the kernels on them. numbers: of its pairs in the list, in order; member: of all
    pairs of the list whether it has them."""

    def __init__(self, pairs):
        self.inner, self.launch = pairs, Launches()
        self.buffers, self.kernels = Buffers(self.launch, False), kernels_of(kernels.PartKernels, "f64")
        self.numbers, self.builds = np.zeros(0, int), -1
        self.arrays = {name: SimpleNamespace() for name in ("pairs", "nodes", "state", "work")}

    def _take(self, of: str, kinds: dict[str, str], count: int) -> None:
        """Arrays of at least so many numbers."""
        for name, kind in kinds.items():
            setattr(self.arrays[of], name, self.buffers.take(f"{of} {name}", KINDS[kind], count, LEAST))

    def _put(self, of: str, kinds: dict[str, str], **data: np.ndarray) -> None:
        for name, numbers in data.items():
            self._take(of, {name: kinds[name]}, len(numbers))
            put(getattr(self.arrays[of], name), numbers)

    def _get(self, name: str) -> np.ndarray:
        """Vectors of the nodes."""
        return whole(getattr(self.arrays["state"], name))[: self.sizes["num_nodes"], :3].copy()

    def holds(self, numbers: np.ndarray) -> bool:
        """Whether these pairs of the list are in the set."""
        return self.builds == self.inner.builds and bool(self.member[numbers].all())

    def fill(self, one, of) -> None:
        """one, of: a ContactPass of pairs of the list, those that were in the set among them, and what its parts read."""
        near, numbers, count = one.near, one.numbers, len(one.numbers)
        (start, index, weight), n, edges = near.rows, len(of.inverse), int(near.edges.sum())
        most = 4 * int(np.diff(start).max(initial=1))  # nodes of a pair
        room = most + sum(sorted(len(x.at) - len(x.here) for x in near.sets)[-most:])
        chosen = np.zeros(count, np.int32)
        if self.builds == self.inner.builds:
            chosen[np.searchsorted(numbers, self.numbers)] = self.chosen
        self.builds, self.numbers = self.inner.builds, numbers
        self.member = np.zeros(self.inner.list.count, bool)
        self.member[numbers] = True
        self.sizes = dict(num_vt=count - edges, num_pairs=count, num_points=near.num_points, num_nodes=n, room=room)
        radius = np.broadcast_to(of.radius, count)
        own = dict(stiffness=of.stiffness, width=of.width, radius=radius, mu=of.mu, speed=of.speed, scale=near.scale)
        self._put("pairs", kernels.PAIRS, corners=near.corners.ravel(), number=numbers, chosen=chosen, **own)
        free = np.broadcast_to(np.eye(3), (n, 3, 3)) if near.free is None else near.free
        rows = dict(start=start, index=index, weight=weight, rest=of.rest, free=free.reshape(-1, 3))
        inverse, self.sets, of_node = of.inverse.copy(), near.sets, np.full(n, -1)
        for k, x in enumerate(near.sets):
            of_node[x.at[: len(x.here)]], inverse[x.at[len(x.here) :]] = k, 1
        self._put("nodes", kernels.NODES, **rows, inverse=inverse, set=of_node)
        self.put_sets(of.sets)
        self._put("work", kernels.WORK, gauss=np.stack([NODES, SHARES], 1).ravel())
        self._take("pairs", dict(acting="ints"), count)
        self._take("nodes", dict(x="vectors", motion="vectors"), n)
        self._take("state", kernels.STATE, n)
        self._take("state", kernels.RESULT, 3)
        sizes = (kernels.OF_NODES, n), (kernels.OF_POINTS, near.num_points), (kernels.OF_PAIRS, count)
        for kinds, size in (*sizes, (kernels.OF_ROWS, room * count)):
            self._take("work", kinds, size)
        self.of_all = dict(wall=of.wall, rough=int(of.rough))
        self._choose = self.launch(self.kernels.choose, list=SimpleNamespace(near=self.inner.near), **self.arrays)
        self._take_part = self.launch(self.kernels.take, **self.arrays)

    def put_sets(self, factors: list) -> None:
        """Inverse masses of the sets."""
        table, parts, sizes, self.roots, first, size = [], [np.zeros((1, 3))], [np.zeros(1)], [], 1, 1
        for x, own in zip(self.sets, factors):
            members, count = len(x.here), len(x.at) - len(x.here)
            root, N = own.whitened()
            N = N[: len(N) // len(x.at) * members]
            if len(N) == members:
                N = np.einsum("vb,de->vdbe", N, np.eye(3))
            F = np.swapaxes(N.reshape(members, 3, count, 3), 1, 2)
            twist = -1 if x.twist is None else x.twist
            table.append([x.at[members], count, x.at[0], members, first, size, twist])
            parts.append(F.reshape(-1, 3))
            sizes.append(own.sizes.ravel())
            self.roots.append((x.at[members:], root))
            first, size = first + len(parts[-1]), size + members**2
        data = dict(sets=np.ravel(table).astype(int) if table else np.zeros(1, int), sizes=np.concatenate(sizes))
        self._put("nodes", kernels.NODES, **data, factor=np.concatenate(parts))

    @property
    def chosen(self) -> np.ndarray:
        """Whether each pair comes near in this pass, 0 or 1."""
        return whole(self.arrays["pairs"].chosen)[: self.sizes["num_pairs"]]

    def begin(self, x: np.ndarray, anew: bool) -> None:
        """A pass begins with nodes at x; anew: and no pair is chosen."""
        put(self.arrays["nodes"].x, x)
        if anew:
            runtime.fill(self.arrays["pairs"].chosen, 0)
            runtime.fill(self.arrays["state"].numbers, 0)

    def choose(self, motion: np.ndarray) -> int:
        """Choose the pairs that come near while nodes move so: how many are new."""
        put(self.arrays["nodes"].motion, motion)
        self._choose(**self.sizes)
        more, num_vt, num_pairs = (int(x) for x in whole(self.arrays["state"].result)[:3])
        self.acting = self.sizes | self.of_all | dict(num_vt=num_vt, num_pairs=num_pairs)
        return more

    def start(self, motion: np.ndarray) -> None:
        """Parts begin, of a pass in which nodes would move so without contact."""
        put(self.arrays["nodes"].motion, motion)
        for name in ("e", "b", "numbers"):
            runtime.fill(getattr(self.arrays["state"], name), 0)

    def take(self, **numbers) -> tuple[int, float]:
        """(what came of a part, its damping)"""
        self._take_part(**self.acting, **numbers)
        return int(whole(self.arrays["state"].result)[0]), float(whole(self.arrays["state"].numbers)[0])

    @property
    def moved(self) -> tuple[np.ndarray, np.ndarray]:
        """What contact has added to displacements and velocities, (e, b)."""
        out = self._get("e"), self._get("b")
        for at, root in self.roots:
            for x in out:
                x[at] = (root @ x[at].reshape(len(root), -1)).reshape(-1, 3)
        return out

    @property
    def work(self) -> float:
        """Done by what moves obstacles and held vertices, in all parts [J]."""
        return float(whole(self.arrays["state"].numbers)[1])

    @property
    def pushes(self) -> np.ndarray:
        """With what the chosen pairs press in the part that was taken."""
        return whole(self.arrays["work"].P)[: self.sizes["num_pairs"]][self.chosen > 0].copy()
