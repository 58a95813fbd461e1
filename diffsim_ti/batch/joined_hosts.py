"""Host forces of the scenes of a batch, each with its own numbers."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from diffsim_ti.batch.joined_scene import of_scenes
from diffsim_ti.mechanics.host_force import HostForce, HostForces
from diffsim_ti.mechanics.interactions import host_forces


class JoinedHost(HostForce):
    """Forces of one kind on the bodies of all scenes, whose host forms are `parts`."""

    def __init__(self, parts: list[HostForce]):
        self.parts, self.count = parts, len(parts)
        self.has_energy, self.reads_velocities = parts[0].has_energy, parts[0].reads_velocities

    @property
    def symmetric(self) -> bool:
        return all(part.symmetric for part in self.parts)

    def _each(self, *vectors) -> list[tuple]:
        """(host form, its part of each of some vectors of all vertices) of each scene."""
        return list(zip(self.parts, *(of_scenes(x, self.count) for x in vectors)))

    def restrict(self, free, rest):
        for part, *own in self._each(free, rest):
            part.restrict(*own)

    def take(self, values, instant):
        """values: `each` of the scenes' own."""
        origins = [None] * self.count if instant.origin is None else of_scenes(instant.origin, self.count)
        for part, own, origin in zip(self.parts, values.each, origins):
            part.take(own, replace(instant, origin=origin))
        return self

    def forces(self, u):
        return np.concatenate([part.forces(x) for part, x in self._each(u)])

    def sizes(self, u):
        return np.concatenate([part.sizes(x) for part, x in self._each(u)])

    def energies(self, u):
        """(scenes, parts)"""
        return np.stack([part.energies(x) for part, x in self._each(u)])

    def work(self, u, step):
        """(scenes,)"""
        return np.array([part.work(*own) for part, *own in self._each(u, step)])

    def product(self, u, w, convex=False):
        return np.concatenate([part.product(*own, convex) for part, *own in self._each(u, w)])

    def blocks(self, u):
        return np.concatenate([part.blocks(x) for part, x in self._each(u)])

    def matrix(self, u):
        from scipy.sparse import block_diag

        found = [part.matrix(x) for part, x in self._each(u)]
        return None if found[0] is None else block_diag(found, format="csr")

    def vjp(self, u, w, adj=None):
        """adj: `each` of the scenes' own."""
        each = [None] * self.count if adj is None else adj.each
        found = [part.vjp(*own, a) for (part, *own), a in zip(self._each(u, w), each)]
        return tuple(
            np.concatenate([np.broadcast_to(x, own.shape) for x, own in zip(by, of_scenes(u, self.count))])
            for by in zip(*found)
        )


def joined_hosts(scene, count: int) -> HostForces:
    """Of `count` scenes like one."""
    each = [host_forces(scene) for _ in range(count)]
    return HostForces(JoinedHost(list(parts)) for parts in zip(*each))


def of_each(each: list) -> SimpleNamespace:
    """What the host forces of each scene take."""
    return SimpleNamespace(each=each)
