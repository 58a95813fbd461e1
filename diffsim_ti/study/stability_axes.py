"""Scenes by which stability maps ask where solvers fail, each with one quantity that varies, and their explicit limits."""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from diffsim_ti.common.public import public
from diffsim_ti.materials import KelvinVoigt, SmithNeoHookean
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.monitor.stability import Stiffness
from diffsim_ti.scene import Scene
from diffsim_ti.solvers.stable_step import start_workspace
from diffsim_ti.terms import Ground, Muscle, SelfContact, Term
from diffsim_ti.terms.obstacles.stiffness import stiffness_of_impact


@public
def power_limit(scene: Scene, rounds: int = 3000, tolerance: float = 1e-7) -> float:
    """The explicit limit 2 / omega_max [s] at the scene's start, by plain power iteration on the assembled stiffness.

    Independent of the Lanczos iteration by which solvers check their steps; converges from above. With viscosity, the step
    whose rate 2 / dt makes omega_max as large (`Stiffness`), by bisection.
    """
    stiffness = Stiffness(start_workspace(scene))
    low = 2 / np.sqrt(_largest(scene, stiffness, rounds, tolerance))
    if not stiffness.viscous:
        return low
    low, high = 0.0, low
    while high - low > 1e-4 * high:
        middle = 0.5 * (low + high)
        stiffness.set_rate(2 / middle)
        fits = _largest(scene, stiffness, rounds, tolerance) <= (2 / middle) ** 2
        low, high = (middle, high) if fits else (low, middle)
    return low


def _largest(scene: Scene, stiffness: Stiffness, rounds: int, tolerance: float) -> float:
    """The largest eigenvalue."""
    x = np.random.default_rng(5).standard_normal((scene.mesh.num_vertices, 3)) * (stiffness.root > 0)
    value = 0.0
    for k in range(rounds):
        x /= np.linalg.norm(x)
        y = stiffness.product(x)
        before, value = value, float((x * y).sum())
        if abs(value - before) < tolerance * abs(value) and k > 20:
            break
        x = y + 0.05 * abs(value) * x  # negative eigenvalues of a squeezed body do not compete
    return value


@dataclass(frozen=True)
class Axis:
    """A quantity that a map runs over: its values and the scene that each makes."""

    name: str
    unit: str
    values: tuple
    scene: Callable  # value -> Scene

    def __iter__(self):
        return iter(self.values)


def body(
    cells: int = 2,
    squeeze: float = 1.0,
    flat: float = 1.0,
    E: float = 1e5,
    nu: float = 0.3,
    terms: Sequence[Term] = (),
    lift: float = 0.0,
    speed: float = 0.0,
    viscous_time: float = 0.0,
) -> Scene:
    """A cube of 0.2 m, its elements flattened to `flat` of their height, the body squeezed to `squeeze` along y, and
    shaken by random velocities of 0.1 % of the speed of sound so that every mode takes part."""
    mesh = TetrahedralMesh.create_box(cells + 1, (0.2, 0.2 * flat, 0.2), "five").translated((0, lift, 0))
    shake = 1e-3 * np.sqrt(E / 1000.0) * np.random.default_rng(0).standard_normal(mesh.vertices.shape)
    start = dict(initial_positions=mesh.vertices * [1, squeeze, 1], initial_velocities=shake - [0, speed, 0])
    law = SmithNeoHookean(E, nu)
    law = KelvinVoigt(law, time=viscous_time) if viscous_time else law
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # nu near 1/2 and slivers are what is looked at
        return Scene(mesh, law, 1000.0, terms, precision="f64", **start)


def impact(speed: float) -> Scene:
    """The cube 2 mm above a barrier 5 mm wide that is as stiff as the impact asks for, moving down."""
    still = body()
    stiffness = stiffness_of_impact(still.mesh, still.material, 1000.0, 0.0, speed, 0.005)
    return body(lift=0.007, speed=speed, terms=[Ground(0.0, width=0.005, stiffness_per_area=stiffness)])


def viscous(ratio: float) -> Scene:
    """The cube, its fastest motion having that damping ratio xi = tau omega / 2."""
    return body(viscous_time=ratio * power_limit(body()))


def pulled(ratio: float) -> Scene:
    """The cube, its muscles let go at once: fibres along y all through it, which pull with that share of Young's modulus."""
    return body(E=1e5, terms=[Muscle([0, 1, 0], ratio * 1e5, 1.0)])


def sliding_blocks(friction: float) -> Scene:
    """A soft cube that comes down askew on another one and slides on it, as far as friction lets it."""
    mesh = TetrahedralMesh.create_box(3, 0.2, "five")
    velocity = 0.05 * np.random.default_rng(0).standard_normal((2 * mesh.num_vertices, 3))
    velocity[mesh.num_vertices :] += [1.0, -0.5, 0.2]
    upper = mesh.rotated([0, 1, 0], 0.3, center=(0.1, 0.1, 0.1)).translated((0.03, 0.206, 0.02))
    contact = SelfContact(1e3, 5e-3, friction=friction, friction_speed=0.01)
    both, material = TetrahedralMesh.joined([mesh, upper]), SmithNeoHookean(1e5, 0.3)
    return Scene(both, material, 1000.0, [contact], initial_velocities=velocity, precision="f64")


POISSON = 0.0, 0.1, 0.2, 0.3, 0.4, 0.45, 0.48, 0.49, 0.495, 0.499
FLAT = 1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01
STRETCH = 1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3
AXES = {
    "stiffness": Axis("Young's modulus", "Pa", tuple(10.0 ** np.arange(3, 8.1, 1.0)), lambda E: body(E=E)),
    "nu": Axis("Poisson's ratio", "-", POISSON, lambda nu: body(nu=nu)),
    "impact": Axis("speed of impact", "m/s", (0.1, 0.2, 0.5, 1.0, 2.0, 3.0, 5.0, 8.0), impact),
    "quality": Axis("height of the elements over their width", "-", FLAT, lambda flat: body(flat=flat)),
    "compression": Axis("stretch at the start", "-", STRETCH, lambda s: body(squeeze=s)),
    "viscosity": Axis("damping ratio of the fastest motion", "-", (0.01, 0.1, 0.3, 1.0, 3.0, 20.0), viscous),
    "activation": Axis("pull of muscles over Young's modulus", "-", (0.01, 0.03, 0.1, 0.3, 0.5, 1.0, 2.0), pulled),
    "friction": Axis("friction of soft on soft", "-", (0.0, 0.1, 0.3, 0.6, 1.0, 10.0), sliding_blocks),
}
