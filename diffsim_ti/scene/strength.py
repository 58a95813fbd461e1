"""Whether a body can bear what a scene has in store for it: its own weight, and the floor that it falls on."""

import math

import numpy as np

from diffsim_ti.materials.moduli import youngs_poisson
from diffsim_ti.scene import Scene
from diffsim_ti.terms import Gravity, Obstacle

MARGIN = 4.0  # in what is advised, so that it does not stand at the limit itself


def check_strength(scene: Scene) -> None:
    """Raise ValueError, naming what would do, where a body is crushed whatever the step.

    That is where it meets a floor faster than waves run through it, v > sqrt(E / rho), and where its weight is more than it
    can carry, rho g H > E, H [m] being its height on a floor or between what holds it; E and rho are means.
    """
    values, gravity = scene.inputs.values, scene.term(Gravity)
    mu, lam = scene.material.lame({name: values[name] for name in scene.material.inputs})
    E, rho = float(np.mean(youngs_poisson(mu, lam)[0])), float(np.mean(values["density"]))
    pull = -float(gravity.values["gravity"][1]) if gravity else 0.0
    floors = [t for t in scene.terms if isinstance(t, Obstacle) and t.path is None and t.floor_height() is not None]
    if not E > 0:
        return
    held = bool(floors) or len(scene.held) > 0
    H = float(np.ptp(scene.mesh.vertices[:, 1])) if gravity and held else 0.0
    weight = rho * abs(pull) * H
    start = values["initial_positions"]
    fall = max((max(float(t.gap(start).min()), 0.0) for t in floors), default=0.0) if pull > 0 else 0.0
    own = max(-float(values["initial_velocities"][:, 1].mean()), 0.0) if floors else 0.0
    impact = rho * (own**2 + 2 * max(pull, 0.0) * fall)
    if max(weight, impact) <= E:
        return
    enough = rounded(MARGIN * max(weight, impact), 1)
    advice = f"raise Young's modulus to {enough:g} Pa"
    if weight > E:
        raise ValueError(
            f"the body is crushed by its own weight: density x gravity x height = {weight:.3g} Pa is more than its Young's "
            f"modulus, {E:.3g} Pa: {advice}, or make it smaller"
        )
    height = (E / MARGIN / rho - own**2) / (2 * pull) if pull > 0 else 0.0
    lower = f", or let it fall from at most {rounded(height, -1):g} m" if fall > height > 0 else ""
    raise ValueError(
        f"the body meets the floor at {math.sqrt(impact / rho):.3g} m/s, faster than waves run through it, sqrt(E / "
        f"density) = {math.sqrt(E / rho):.3g} m/s, and is crushed whatever the step: {advice}{lower}"
    )


def rounded(x: float, way: int) -> float:
    """Up (1) or down (-1), with two digits."""
    unit = 10.0 ** (math.floor(math.log10(x)) - 1)
    return way * math.ceil(way * x / unit * (1 - way * 1e-12)) * unit
