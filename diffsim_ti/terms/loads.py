"""Loads on surfaces, volumes and vertices: traction, pressure, body force, what acts at a far point, given forces."""

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.checked import numbers, present
from diffsim_ti.inputs import Input, Link
from diffsim_ti.inputs.links import PerStep
from diffsim_ti.inputs.loads import ConsistentShares, InTime, RemoteForces, Spread, VertexAreas, VertexShares
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.named_sets import SetOrIndices
from diffsim_ti.mesh.ten_nodes import triangles_of
from diffsim_ti.terms.marks import arrows, pressing
from diffsim_ti.terms.over_time import GivenOverTime, OverTime, amount
from diffsim_ti.terms.term import OnMesh, OnSurface, Term, nonempty


class Load(GivenOverTime, OnMesh, Term):
    """An amount per area or volume, over time. A scene may list several of a kind: they add up.

    Subclasses say what it is: its `argument`, what was `given`, its `unit` and its plain name.
    Bonet, Wood 2008, Nonlinear Continuum Mechanics for Finite Element Analysis, 2nd ed., 9.4,
    doi:10.1017/CBO9780511755446.
    """

    num_numbers = 0  # what kernels read of it lies in arrays of its own

    def __init__(self, argument: str, given: OverTime, unit: str, plain: str, name: str | None):
        super().__init__(amount(argument, given, self.shape, unit, plain), name=name)
        self._give(given)

    def in_time(self, names: dict[str, str], own: str) -> Link:
        """Its amount in time, as inputs/loads.py has it, by the name `own` in time."""
        return InTime(names[self.plain], f"{own} in time", len(self.shape) + 1, self.keyed)


class Traction(OnSurface, Load):
    """Force per area of the surface at rest, t [N/m^2], whatever becomes of the surface: a dead load, f_i = t A_i.

    A_i is the integral of the shape function of vertex i over the surface: a third of the area of each triangle around it;
    with ten-node tetrahedra a third of each face at its mid-edge vertices and, where it is flat, nothing at its corners.

    traction: 3 numbers [N/m^2]; or one set for each step, shape (steps, 3), each held during its step; or a function of time
        [s] that returns 3 numbers, or keyframes (times, values), a tuple, sampled at the steps and linear within each.
    surface: where it acts: a surface set's name, several, rows of `surface_triangles`; None: all of the surface.
    Input with gradient: "traction" or "<name>.traction", of the shape given, (steps + 1, 3) of what is linear within steps.
    Raises ValueError for other shapes, what is not finite, and unknown sets.
    Bonet, Wood 2008, Nonlinear Continuum Mechanics for Finite Element Analysis, 2nd ed., 9.4,
    doi:10.1017/CBO9780511755446.

    >>> import diffsim_ti as ds
    >>> mesh = ds.TetrahedralMesh.create_cube(resolution=2)
    >>> material = ds.StableNeoHookean(E=1e5, nu=0.3)
    >>> load = ds.Traction((0.0, 0.0, 250.0), surface="xmax")
    >>> scene = ds.Scene(mesh, material, terms=[load], fixed="xmin", precision="f64")
    >>> frames = ds.Rollout(ds.StaticSolver(scene), steps=1, outputs=[ds.Reaction("xmin")]).forward()
    >>> print(f"{frames['reaction'][-1, 2]:.3f} N")  # what holds the other side
    -250.000 N
    """

    shape = (3,)

    def __init__(self, traction: OverTime, surface: SetOrIndices | None = None, name: str | None = None):
        super().__init__("traction", traction, "N/m^2", "traction", name)
        self.surface = surface

    def drawn(self, moment):
        vertices = self.indices(moment.mesh)
        label = f"{self.name or 'traction'} [N/m^2]"
        return [arrows(label, moment.mesh, moment.positions, vertices, moment.values[self.plain])]

    def force_links(self, names: dict[str, str], own: str, consistent: bool = False) -> list[Link]:
        """To forces of its vertices, by the name `own` forces."""
        areas = VertexAreas(self.faces(self.mesh), self.indices(self.mesh), f"{own} areas")
        return [self.in_time(names, own), areas, Spread((f"{own} in time", f"{own} areas"), f"{own} forces")]


class BodyForce(Load):
    """Force per volume at rest b [N/m^3], or per mass [m/s^2], on some of a body: dead loads f_i = b V_i or b m_i.

    V_i and m_i are a fourth of the volume and mass of each tetrahedron around vertex i; of ten-node ones integrals of N_i
    in static solves and implicit steps, and shares of lumped masses in explicit ones, so that free fall stays rigid. Uniform
    weight is `Gravity`.

    force: 3 numbers, over time as in `Traction`; per: "volume" or "mass". tetrahedra: a tetrahedron set's name, several,
        indices or a mask; None: all.
    Input with gradient: "body_force" or "<name>.force", of the shape given, (steps + 1, 3) of what is linear within steps.
    Raises ValueError for other shapes, what is not finite, unknown sets, and another `per`.
    Bonet, Wood 2008, Nonlinear Continuum Mechanics for Finite Element Analysis, 2nd ed., 9.4,
    doi:10.1017/CBO9780511755446.
    """

    shape = (3,)

    def __init__(
        self,
        force: OverTime,
        tetrahedra: SetOrIndices | None = None,
        per: Literal["volume", "mass"] = "volume",
        name: str | None = None,
    ):
        if per not in ("volume", "mass"):
            raise ValueError(f'BodyForce: per must be "volume" [N/m^3] or "mass" [m/s^2], got {per!r}')
        super().__init__("force", force, "N/m^3" if per == "volume" else "m/s^2", "body_force", name)
        self.tetrahedra, self.per = tetrahedra, per

    def check(self, mesh: TetrahedralMesh) -> None:
        self.chosen(mesh)

    def chosen(self, mesh: TetrahedralMesh) -> np.ndarray:
        """Tetrahedra that are acted upon."""
        every = np.arange(mesh.num_tetrahedra)
        return nonempty(self, every if self.tetrahedra is None else mesh.tetrahedron_indices(self.tetrahedra))

    def indices(self, mesh: TetrahedralMesh) -> np.ndarray:
        """Vertices that are acted upon."""
        return np.unique(mesh.elements[self.chosen(mesh)])

    def drawn(self, moment):
        mesh, unit = moment.mesh, self.described[0].unit
        vertices = np.intersect1d(self.indices(mesh), mesh.surface_vertices)  # those within would not be seen
        label = f"{self.name or 'body force'} [{unit}]"
        return [arrows(label, mesh, moment.positions, vertices, moment.values[self.plain], most=24)]

    def force_links(self, names: dict[str, str], own: str, consistent: bool = False) -> list[Link]:
        """To forces of its vertices, by the name `own` forces."""
        mesh, weights, kind = self.mesh, f"{own} weights", ConsistentShares if consistent else VertexShares
        shares = kind(mesh, self.chosen(mesh), self.indices(mesh), self.per == "mass", weights)
        return [self.in_time(names, own), shares, Spread((f"{own} in time", weights), f"{own} forces")]


class Pressure(OnSurface, Load):
    """Pressure p [Pa] on the surface as it is now: it follows area and normal, f_a = -p n / 3 at each corner of a triangle.

    n = (x_1 - x_0) x (x_2 - x_0) / 2 points outwards, so that positive pressures push inwards; on faces of six nodes f_a is
    minus the integral of p N_a dx/ds x dx/dt, exactly.

    On a closed surface it has the potential p V, V the volume inside, and its tangent is symmetric. On one
    with an edge that moves freely it has neither: implicit and static solvers then search by the residual, solve with GMRES,
    and transpose for gradients. Its stiffness does not enter the stable step of explicit solvers.

    pressure: one number [Pa], over time as in `Traction`, shape (steps,) for each step. surface: as there.
    Input with gradient: "pressure" or "<name>.pressure", of the shape given, (steps + 1,) of what is linear within steps.
    Raises ValueError for other shapes, what is not finite, and unknown sets.
    Bonet, Wood 2008, Nonlinear Continuum Mechanics for Finite Element Analysis, 2nd ed., 8.5.2 and 9.6.1,
    doi:10.1017/CBO9780511755446.
    """

    def __init__(self, pressure: OverTime, surface: SetOrIndices | None = None, name: str | None = None):
        super().__init__("pressure", pressure, "Pa", "pressure", name)
        self.surface = surface

    def links(self, names: dict[str, str], own: str) -> list[Link]:
        return [self.in_time(names, own)]

    def drawn(self, moment):
        label, pressure = f"{self.name or 'pressure'} [Pa]", float(moment.values[self.plain])
        return pressing(label, moment, triangles_of(self.faces(moment.mesh)), pressure)


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


class ExternalForce(Term):
    """Forces [N] on vertices: constant, shape (k, 3), or per step (controls), shape (steps, k, 3).

    vertices: which k vertices, as indices or the name of a vertex set; None means all. A single vector of 3 is laid
    on each of them. Per-step forces hold during one step dt; a run longer than the list is an error.
    Input with gradient: "external_forces", of the shape given, or "<name>.forces". Several in a scene add up.
    Raises ValueError for other shapes, unknown sets, and a run longer than the list.
    Belytschko, Liu, Moran, Nonlinear Finite Elements for Continua and Structures, 2000, sec. 4.4.
    """

    def __init__(self, forces: ArrayLike, vertices: SetOrIndices | None = None, name: str | None = None):
        present("forces", forces)
        shapes = (3,), ("k", 3), ("steps", "k", 3)
        super().__init__(Input("forces", forces, shapes, "N", plain="external_forces", label="forces"), name=name)
        self.vertices = vertices

    num_numbers = 0  # forces lie in an array of their own

    def links(self, names, own):
        return [PerStep(names["external_forces"], "forces", 3)]

    def force_links(self, names, own, consistent=False):
        """Beside other loads, which add up, by the name `own` forces."""
        return [InTime(names["external_forces"], f"{own} forces", 3, keyed=False)]

    def indices(self, mesh: TetrahedralMesh) -> np.ndarray:
        """Vertices that are acted upon, shape (k,)."""
        if self.vertices is None:
            return np.arange(mesh.num_vertices)
        return mesh.vertex_indices(self.vertices)

    def check(self, mesh) -> None:
        k, shape = len(self.indices(mesh)), self.values["external_forces"].shape
        if len(shape) > 1 and shape[-2] != k:
            raise ValueError(f"ExternalForce: expected forces for {k} vertices, shape (..., {k}, 3), got {shape}")

    def drawn(self, moment):
        vertices, forces = self.indices(moment.mesh), moment.values["external_forces"]
        return [arrows(f"{self.name or 'force'} [N]", moment.mesh, moment.positions, vertices, forces)]

    def settled(self, scene, density, initial_positions, initial_velocities) -> "ExternalForce":
        """With a force for each of the vertices acted upon."""
        k, forces = len(self.indices(scene.mesh)), self.values["external_forces"]
        rows = np.tile(forces, (k, 1)) if forces.ndim == 1 else forces
        return self.with_input("external_forces", value=rows, shapes=((k, 3), ("steps", k, 3)))
