"""Force and moment at a point, that a surface takes up."""

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import numbers
from diffsim_ti.inputs import Link
from diffsim_ti.inputs.loads import RemoteForces, VertexAreas
from diffsim_ti.mesh.named_sets import SetOrIndices
from diffsim_ti.terms.loads import Load
from diffsim_ti.terms.marks import arrows
from diffsim_ti.terms.over_time import OverTime
from diffsim_ti.terms.term import OnSurface


class RemoteLoad(OnSurface, Load):
    """Force F [N] and moment M [N m] at a point, spread over a surface that stays free to deform: a torque on a face, or
    what a part acts with that is not modelled (the averaging kind of a remote point, RBE3).

        f_i = a_i (F / A + omega x r_i),    J omega = M + (p - c) x F,    J = sum a_i (|r_i|^2 - r_i r_i^T)

    a_i: area of vertex i, as of `Traction`; r_i: from the surface's centre c at rest. The forces sum to F and have the
    moment M about p at rest. They are dead loads: as the body turns they keep their directions. A surface that is to stay
    rigid is a set of reduced={...: "rigid"}, and one that is moved about a point has motion={...: Pose(path, about=point)}.

    load: (F_x, F_y, F_z, M_x, M_y, M_z), over time as in `Traction`. surface: as there. point: p [m]; None: c.
    Input with gradient: "remote_load" or "<name>.load", of the shape given, (steps + 1, 6) of what is linear within steps.
    Raises ValueError for other shapes, what is not finite, and unknown sets.
    MSC Nastran, Linear Static Analysis User's Guide, sec. 5, on RBE3.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_box((7, 3, 3), size=(0.6, 0.1, 0.1))
    >>> twist = ds.RemoteLoad((0, 0, 0, 0.1, 0, 0), surface="xmax")
    >>> scene = ds.Scene(mesh, ds.StableNeoHookean(E=1e5, nu=0.3), terms=[twist], fixed="xmin", precision="f64")
    >>> held = ds.Reaction("xmin", about=(0.0, 0.05, 0.05))
    >>> frames = ds.Rollout(ds.StaticSolver(scene), steps=1, outputs=[held]).forward()
    >>> print(f"{frames['reaction'][-1, 0]:.3f} N m")
    -0.100 N m
    """

    shape = (6,)

    def __init__(
        self,
        load: OverTime,
        surface: SetOrIndices | None = None,
        point: ArrayLike | None = None,
        name: str | None = None,
    ):
        super().__init__("load", load, "N, N m", "remote_load", name)
        self.surface, self.point = surface, None if point is None else numbers("RemoteLoad: point [m]", point)
        if point is not None and (self.point.shape != (3,) or not np.all(np.isfinite(self.point))):
            raise ValueError(f"RemoteLoad: point must be 3 finite numbers [m], got {point!r}")

    def drawn(self, moment):
        vertices, load = self.indices(moment.mesh), moment.values[self.plain]
        areas = VertexAreas(self.faces(moment.mesh), vertices, "areas").value(moment.mesh.vertices)[0]
        link = RemoteForces("load", "areas", vertices, self.point, "forces")
        (forces,) = link.value(np.reshape(load, (1, 1, 6)), moment.mesh.vertices, areas)
        return [arrows(f"{self.name or 'remote load'} [N]", moment.mesh, moment.positions, vertices, forces[0, 0])]

    def force_links(self, names: dict[str, str], own: str, consistent: bool = False) -> list[Link]:
        """To forces of its vertices, by the name `own` forces."""
        vertices, areas = self.indices(self.mesh), f"{own} areas"
        spread = RemoteForces(f"{own} in time", areas, vertices, self.point, f"{own} forces")
        return [self.in_time(names, own), VertexAreas(self.faces(self.mesh), vertices, areas), spread]
