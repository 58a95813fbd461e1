"""How stiff a barrier must be: from density, speed of waves, impact and weight."""

import numpy as np

from diffsim_ti.materials.moduli import pressure_wave_speed


def stiffness_of_impact(mesh, material, density: float, gravity: float, speed: float, width: float) -> float:
    """Stiffness per area [N/m^3] of a barrier `width` [m] wide for a body that meets an obstacle at `speed` [m/s].

    A front that is stopped feels p = rho c v (c the speed of pressure waves), to which come rho v^2 and the weight of the
    column above, rho g H. The surface shall carry p at half the width: k = p / (1.19 w). A point that meets the
    obstacle alone may carry 47 times that before it uses 98 % of the width.
    """
    mu, lam = material.lame(material.values(mesh))
    wave = np.max(pressure_wave_speed(mu, lam, density))
    pressure = density * (wave * speed + speed**2 + abs(gravity) * np.ptp(mesh.bounding_box, 0)[1])
    return float(pressure / (1.19 * width))
