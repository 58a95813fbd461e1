"""How stiff a barrier must be: from density, speed of waves, impact and weight."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.materials.moduli import pressure_wave_speed

TIMES = np.linspace(0, 1, 41)  # [s] at which functions of time are evaluated


def stiffness_of_impact(
    mesh, material, density: float, gravity: float, speed: float, width: float, pressed: float = 0.0, axis: int = 1
) -> float:
    """Stiffness per area [N/m^3] of a barrier `width` [m] wide for a body that meets an obstacle at `speed` [m/s].

    On a front that is stopped acts p = rho c v (c the speed of pressure waves), to which come rho v^2 and the weight of the
    column above, rho g H along the axis of gravity, and twice the pressure that loads and muscles press with (`pressed`),
    for loads that are applied suddenly swings as far again. The surface shall carry p at half the width: k = p / (1.19 w). A
    point that meets the obstacle alone may carry 47 times that before it uses 98 % of the width.
    """
    mu, lam = material.lame(material.values(mesh))
    wave = np.max(pressure_wave_speed(mu, lam, density))
    pressure = density * (wave * speed + speed**2 + abs(gravity) * np.ptp(mesh.bounding_box, 0)[axis])
    return float((pressure + 2 * pressed) / (1.19 * width))


def pressed_by(terms, mesh, density: float) -> float:
    """What muscles, loads and gases of a scene press with at most, together [Pa]: muscles by their stress, activations of
    less than 1 being taken for 1; forces by the section of the body that they go through, moments as couples across it."""
    size, total = np.ptp(mesh.bounding_box, 0), 0.0
    section = float(np.sort(size)[:2].prod())
    for term in terms:
        kind, most = type(term).__name__, {}
        if kind in ("Muscle", "Cable", "Traction", "Pressure", "GasChamber", "BodyForce", "ExternalForce"):
            most = {described.plain: _most(term, described) for described in term.described}
        if kind == "Muscle":
            total += most["muscle_stress"] * max(1.0, most["activation"])
        elif kind == "Cable":
            total += sum(x for name, x in most.items() if "tension" in name) / section
        elif kind in ("Traction", "Pressure"):
            total += sum(most.values())
        elif kind == "GasChamber":
            outside = most.pop("outside_pressure")
            total += abs(most[term.described[0].plain] - outside)
        elif kind == "BodyForce":
            total += most["body_force"] * (density if term.per == "mass" else 1.0) * float(size.max())
        elif kind == "RemoteLoad":
            force, moment = np.linalg.norm(_amounts(term, term.described[0]).reshape(-1, 2, 3), axis=2).max(
                0, initial=0
            )
            total += (force + moment / float(np.sort(size)[1])) / section
        elif kind == "ExternalForce":
            total += most["external_forces"] * len(term.indices(mesh)) / section
    return total


def _amounts(term, described) -> np.ndarray:
    """Sizes of an input's numbers over time."""
    value = over_time(term.rows) if described.value is None and hasattr(term, "rows") else described.value
    return np.abs(np.zeros(1) if value is None else np.asarray(value, np.float64))


def _most(term, described) -> float:
    """The largest amount of a number, or of rows of three, over time."""
    value = _amounts(term, described)
    return float((np.linalg.norm(value, axis=-1) if value.shape[-1:] == (3,) else value).max(initial=0.0))


def over_time(rows: Callable[[list[float]], ArrayLike]) -> np.ndarray:
    """What a function of times says at TIMES, as far as it can be asked: one may know those of its run alone."""
    out = [np.asarray(rows([0.0]))[0]]
    for t in TIMES[1:]:
        try:
            out.append(np.asarray(rows([t]))[0])
        except (IndexError, KeyError, ValueError, FloatingPointError):
            break
    return np.array(out)


def approach(gaps: ArrayLike) -> float:
    """The largest speed [m/s] with which gaps [m] at TIMES close, shape (times, k)."""
    return float(-np.diff(gaps, axis=0).min(initial=0.0) / np.diff(TIMES)[0])
