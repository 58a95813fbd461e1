"""Materials that are written outside the package (open_laws/), with random numbers: exponents, vectors, rates, states."""

import numpy as np
from open_laws.fibres import FibreTissue
from open_laws.gent import Gent
from open_laws.ogden import Ogden
from open_laws.power_law import Knowles
from open_laws.relaxing import RelaxingRubber
from open_laws.viscous import ViscousRubber

EVERYWHERE, ON_TETRAHEDRA, IN_STEPS, IN_EXPLICIT_STEPS = (
    (Gent, FibreTissue, Ogden),
    (Knowles,),
    (RelaxingRubber,),
    (ViscousRubber,),
)


def open_laws(explicit: bool, static: bool, patches: bool) -> tuple:
    """Those that a solver and an element can do."""
    if patches:
        return EVERYWHERE
    return EVERYWHERE + ON_TETRAHEDRA + IN_STEPS * (not static) + IN_EXPLICIT_STEPS * explicit


def open_material(law: type, rng, mesh, E: float, nu: float, spread):
    """spread(number, share): what differs between tetrahedra, or not."""
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    if law is Gent:
        return Gent(mu=spread(mu, 0.5), limit=spread(rng.uniform(15, 60), 0.5), lam=spread(lam, 0.5))
    if law is FibreTissue:
        fibre = rng.standard_normal((mesh.num_tetrahedra, 3) if rng.random() < 0.5 else 3)
        fibre = fibre / np.linalg.norm(fibre, axis=-1, keepdims=True)
        return FibreTissue(mu=mu, lam=spread(lam, 0.5), k1=0.3 * mu, k2=spread(rng.uniform(0.2, 1.5), 0.5), fibre=fibre)
    if law is Ogden:
        numbers = dict(mu_1=0.5 * mu, a_1=rng.uniform(1.5, 3.0), mu_2=-0.3 * mu, a_2=rng.uniform(-3.0, -1.5), lam=lam)
        return Ogden(**numbers | {"lam": spread(lam, 0.5)})
    if law is Knowles:
        return Knowles(E=spread(E, 0.5), nu=nu, b=rng.uniform(0.5, 2.0), n=spread(rng.uniform(0.6, 1.5), 0.3))
    if law is ViscousRubber:
        return ViscousRubber(E=spread(E, 0.5), nu=nu, viscosity=spread(1e-4 * E * rng.uniform(0.3, 3.0), 0.5))
    return RelaxingRubber(
        mu=spread(mu, 0.5), lam=lam, g=spread(rng.uniform(0.2, 1.0) * mu, 0.5), tau=rng.uniform(2e-3, 5e-2)
    )
