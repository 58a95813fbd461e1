"""Links of chambers: the volume that a surface encloses at rest."""

from diffsim_ti.inputs.chain import Link
from diffsim_ti.mesh.enclosure import Enclosure


class RestVolume(Link):
    """Of rest positions the volume [m^3] of a chamber."""

    reads = ("rest",)

    def __init__(self, enclosure: Enclosure, writes: str):
        self.enclosure, self.writes = enclosure, (writes,)

    def value(self, X):
        return (self.enclosure.volume(X),)

    def jvp(self, x, dx):
        return ((self.enclosure.gradient(x[0]) * dx[0]).sum(),)

    def vjp(self, x, y_adj):
        return (self.enclosure.gradient(x[0]) * y_adj[0],)
