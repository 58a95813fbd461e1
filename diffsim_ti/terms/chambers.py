"""Chambers: cavities of the body that hold a gas, or a liquid of given volume."""

from copy import copy
from dataclasses import replace

import numpy as np
import taichi as ti

from diffsim_ti.inputs import POSITIVE, Input, Link
from diffsim_ti.inputs.loads import InTime, RestVolume
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.enclosure import Enclosure
from diffsim_ti.mesh.named_sets import SetOrIndices
from diffsim_ti.mesh.ten_nodes import triangles_of
from diffsim_ti.terms.marks import pressing
from diffsim_ti.terms.over_time import GivenOverTime, OverTime, amount
from diffsim_ti.terms.term import OnSurface, Term


def gas_law(p0, outside, V0, n, V):
    """p = p_0 (V_0 / V)^n - p_out and its derivatives by p_0, p_out, V_0, n and V, of plain numbers or in a kernel."""
    log = ti.log(V0 / V)
    grown = ti.exp(n * log)
    absolute = p0 * grown
    return absolute - outside, grown, -1, n * absolute / V0, absolute * log, -n * absolute / V


ATMOSPHERE = 101325.0  # [Pa]


class Chamber(GivenOverTime, OnSurface, Term):
    """A cavity, by a surface of the body around it, whose filling pushes on it with one pressure.

    The surface is closed, or has rims that are fixed wholly or move in planes (supports by component), which close it there.
    Its triangles are those of the body, whose normals point out of the body and so into the chamber: a positive pressure
    inflates it. The forces are those of `Pressure`, p dV/dx, V the volume inside.
    Subclasses say what is given over time: its `argument`, what was `given`, its `unit` and its plain name.
    Rumpel, Schweizerhof 2003, Volume-dependent pressure loading, doi:10.1002/nme.561.
    """

    holds = False  # whether it holds a volume
    num_numbers = 0  # what is read of it lies in rows of its own
    row_names: tuple[str, ...] = ()  # of its numbers, each of which has a row in time

    def __init__(
        self,
        argument: str,
        given: OverTime,
        unit: str,
        plain: str,
        surface: SetOrIndices | None,
        name: str | None,
        *more: Input,
    ):
        described = replace(amount(argument, given, (), unit, plain), range=POSITIVE)
        super().__init__(described, *more, name=name)
        self.surface = surface
        self._give(given)

    def check(self, mesh: TetrahedralMesh) -> None:
        if len(self.faces(mesh)) == 0:
            raise ValueError(f"{type(self).__name__}: its surface is empty; name a set that has members")

    def settled(self, scene, density, initial_positions, initial_velocities) -> "Chamber":
        out, mesh, called = copy(self), scene.mesh, type(self).__name__ + (f" {self.name!r}" if self.name else "")
        free = scene.supports.freedom(mesh.num_vertices)
        out.enclosure = Enclosure.of(self.faces(mesh), free, mesh.vertices, called, moves=scene.motion is not None)
        return out

    def rows_in_time(self, own: str) -> list[str]:
        """Names of the rows of its numbers, of which `own` is the beginning."""
        return [f"{own} {row} in time" for row in self.row_names]

    def links(self, names: dict[str, str], own: str) -> list[Link]:
        volume, described = f"{own} volume", iter(self.described)
        sources = [volume if row == "rest" else names[next(described).plain] for row in self.row_names]
        out = [RestVolume(self.enclosure, volume)]
        for k, (source, row) in enumerate(zip(sources, self.rows_in_time(own))):
            out.append(InTime(source, row, 1, self.keyed and k == 0))
        return out


class GasChamber(Chamber):
    """A gas in a cavity: it pushes with p = p_0 (V_0 / V)^n - p_out, V_0 the volume of the chamber at rest.

    pressure: p_0 [Pa], absolute: what the gas would have in the chamber at rest, so that p_0 V_0 is the amount that is in it
        (n R T of an ideal gas); over time as in `Traction`, for gas that is pumped in, shape (steps,) for each step.
    surface: of the cavity, as in `Traction`; None: all of the body's surface, which encloses no chamber.
    outside: p_out [Pa], absolute; default one atmosphere. exponent: n, 1 of an isothermal gas, 1.4 of air that moves too
        fast to exchange heat.
    Inputs with gradient: "gas_pressure", "outside_pressure", "gas_exponent", or "<name>.pressure", ".outside", ".exponent".
    The gas has no mass and one pressure everywhere. Static solves apply p in load steps. Explicit steps sum the volume
    before each substep, in a launch of its own; what the gas adds to the stiffness counts in the stable step.
    Raises ValueError for surfaces that enclose no volume, numbers that are not positive, and what does not fit.
    Bonet, Wood 2008, Nonlinear Continuum Mechanics for Finite Element Analysis, 2nd ed., 8.5.2; Rumpel, Schweizerhof 2003,
    Volume-dependent pressure loading and its influence on the stability of structures, doi:10.1002/nme.561.
    """

    row_names, stiffest = ("pressure", "outside", "rest", "exponent"), staticmethod(np.max)

    def __init__(
        self,
        pressure: OverTime,
        surface: SetOrIndices | None = None,
        outside: float = ATMOSPHERE,
        exponent: float = 1.0,
        name: str | None = None,
    ):
        more = (
            Input("outside", outside, ((),), "Pa", plain="outside_pressure", label="outside"),
            Input("exponent", exponent, ((),), "-", POSITIVE, plain="gas_exponent", label="exponent"),
        )
        super().__init__("pressure", pressure, "Pa", "gas_pressure", surface, name, *more)

    def drawn(self, moment):
        p, outside, exponent = (float(moment.values[i.plain]) for i in self.described)
        V0, V = (self.enclosure.volume(x) for x in (moment.mesh.vertices, moment.positions))
        label = f"{self.name or 'gas'} [Pa]"
        return pressing(label, moment, triangles_of(self.faces(moment.mesh)), gas_law(p, outside, V0, exponent, V)[0])


class FilledChamber(Chamber):
    """A cavity filled with what does not change its volume: V is given, and the pressure is what that takes.

    volume: V [m^3], over time as in `Traction`, for what is pumped in, shape (steps,) for each step. Where a rim is open in
        planes, V is what is on the body's side of them. `Scene.chamber_volume` has that at rest.
    surface: as in `GasChamber`.
    Input with gradient: "chamber_volume" or "<name>.volume". The pressure is a result: `ChamberPressure`, with gradient.
    Implicit and static solvers hold V at the end of each substep (the midpoint rule in the middle of it), by a Lagrange
    multiplier: so a chamber is followed beyond the largest pressure that it bears. Static solves go from the volume at
    rest in load steps. Explicit solvers hold V at the end of each substep too, as velocity Verlet does in the manner of
    SHAKE and RATTLE: a stage after contact, on the host, to round-off and without a penalty, that no step is too large
    for. There a volume that jumps is reached within one substep: give keyframes. A contact of the chamber's own boundary is
    pushed after it. Raises ValueError for surfaces that enclose no volume, numbers that are not positive, and what does
    not fit. Nocedal, Wright, Numerical Optimization, 2nd ed., 2006, 17.3 and 18.4, doi:10.1007/978-0-387-40065-5;
    Leimkuhler, Reich, Simulating Hamiltonian Dynamics, 2004, 7.2, doi:10.1017/CBO9780511614118.
    """

    holds, row_names = True, ("volume", "rest")

    def __init__(self, volume: OverTime, surface: SetOrIndices | None = None, name: str | None = None):
        super().__init__("volume", volume, "m^3", "chamber_volume", surface, name)
