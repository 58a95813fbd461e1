"""Materials by their energy, of the package and from outside it (open_laws/): exponents, vectors, rates, states."""

import numpy as np
from open_laws.power_law import Knowles
from open_laws.relaxing import RelaxingRubber
from open_laws.viscous import ViscousRubber

from diffsim_ti.materials import FibreReinforced, Gent, KelvinVoigt, Ogden, Prony, StableNeoHookean, Yeoh

EVERYWHERE, ON_TETRAHEDRA, IN_STEPS, IN_EXPLICIT_STEPS = (
    (Gent, FibreReinforced, Ogden, Yeoh),
    (Knowles, KelvinVoigt),
    (RelaxingRubber, Prony),
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
    bulk = spread(lam + 2 / 3 * mu, 0.5)
    if law is Gent:
        return Gent(mu=spread(mu, 0.5), limit=spread(rng.uniform(15, 60), 0.5), bulk_modulus=bulk)
    if law is Yeoh:
        return Yeoh(spread(mu / 2, 0.5), -0.02 * mu, spread(0.01 * mu, 0.5), bulk)
    if law is FibreReinforced:
        fibre = rng.standard_normal((mesh.num_tetrahedra, 3) if rng.random() < 0.5 else 3)
        fibre = fibre / np.linalg.norm(fibre, axis=-1, keepdims=True)
        matrix = StableNeoHookean(mu=mu, lam=spread(lam, 0.5))
        return FibreReinforced(matrix, 0.3 * mu, spread(rng.uniform(0.2, 1.5), 0.5), fibre)
    if law is Ogden:
        return Ogden([0.5 * mu, -0.3 * mu], [rng.uniform(1.5, 3.0), rng.uniform(-3.0, -1.5)], bulk)
    if law is Knowles:
        return Knowles(E=spread(E, 0.5), nu=nu, b=rng.uniform(0.5, 2.0), n=spread(rng.uniform(0.6, 1.5), 0.3))
    if law is KelvinVoigt:
        elastic, time = StableNeoHookean(E=spread(E, 0.5), nu=nu), spread(10 ** rng.uniform(-4, -2), 0.5)
        return KelvinVoigt(elastic, time=time)
    if law is Prony:
        return branches(StableNeoHookean(mu=mu, lam=spread(lam, 0.5)), rng)
    if law is ViscousRubber:
        return ViscousRubber(E=spread(E, 0.5), nu=nu, viscosity=spread(1e-4 * E * rng.uniform(0.3, 3.0), 0.5))
    return RelaxingRubber(
        mu=spread(mu, 0.5), lam=lam, g=spread(rng.uniform(0.2, 1.0) * mu, 0.5), tau=rng.uniform(2e-3, 5e-2)
    )


def branches(elastic, rng) -> Prony:
    """Two of them."""
    return Prony(elastic, rng.uniform(0.1, 1.0, 2), 10 ** rng.uniform(-3, -1, 2))
