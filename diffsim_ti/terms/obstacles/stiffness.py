"""How stiff a barrier must be: from mass, speed of waves, impact and weight."""

import numpy as np

from diffsim_ti.materials.moduli import pressure_wave_speed


def barrier_stiffness(mesh, material, density: float, gravity: float, speed: float, width: float) -> float:
    """Stiffness k [N/m] of a barrier `width` [m] wide for a body that meets an obstacle at `speed` [m/s].

    A front that is stopped feels p = rho c v (c the speed of pressure waves), to which come rho v^2 and the weight of the
    column above, rho g H. A vertex of mean surface area A shall carry p A at half the width: k = p A / (1.19 w). A vertex
    that meets the obstacle alone may carry 47 times that before it uses 98 % of the width.
    """
    mu, lam = material.lame(material.values(mesh))
    wave = np.max(pressure_wave_speed(mu, lam, density))
    pressure = density * (wave * speed + speed**2 + abs(gravity) * np.ptp(mesh.bounding_box, 0)[1])
    a, b, c = (mesh.vertices[mesh.surface_triangles[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 / len(mesh.surface_vertices)
    return float(pressure * area / (1.19 * width))
