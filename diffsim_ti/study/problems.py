"""The built-in problems: closed forms where there are some, else converged references."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from diffsim_ti.materials import LinearElastic, SmithNeoHookean, StableNeoHookean
from diffsim_ti.materials.material import Material
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.rollout import Frames
from diffsim_ti.scene import Scene
from diffsim_ti.study.problem import FrameLoss, Problem, of_order
from diffsim_ti.terms import Gravity, Ground
from diffsim_ti.terms.obstacles.barrier import beta


def oscillator() -> Problem:
    """A tetrahedron sheared at its apex: u'' = -omega^2 u at any amplitude, omega = 2 sqrt(mu / rho) / h."""
    E, density, height, reach, time = 1e5, 1000.0, 0.5, 0.2, 0.5
    omega = 2 * np.sqrt(E / 2 / density) / height

    def scene(cells, pattern, precision, **element):
        mesh = TetrahedralMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, height]], [[0, 1, 2, 3]])
        how = dict(initial_positions=mesh.vertices + reach * np.eye(4, 3, -3), precision=precision) | element
        return Scene(mesh, StableNeoHookean(E, 0.0), density, fixed=[0, 1, 2], **how)

    said = "oscillator", "One tetrahedron in shear, closed form", "error of motion"
    exact, mesh = reach * np.cos(omega * np.linspace(0, time, 17)), dict(cells=(1,), patterns=("one tetrahedron",))
    apex = lambda frames, _: frames.displacements[:, 3, 0]  # noqa: E731
    return Problem(*said, scene, time, apex, exact=exact, scale=reach, levels=9, **mesh)


def lame_mode(X: np.ndarray, a: float = 1.0) -> np.ndarray:
    """Lame mode of a cube of width a [m] at points X, shape (n, 3), of size 1."""
    p = np.pi / a
    x, y, z = X.T
    return np.stack([np.cos(p * x) * np.sin(p * y), -np.sin(p * x) * np.cos(p * y), 0 * z], 1)


def lame_share_by_mass(mesh: TetrahedralMesh) -> np.ndarray:
    """Weights that give the mode's share [m], weighed by mass: what the mesh mixes in counts squared only."""
    shares = np.outer(mesh.volumes, mesh.reference.lumped)
    mass = np.bincount(mesh.elements.ravel(), shares.ravel(), mesh.num_vertices)[:, None]
    mode = lame_mode(mesh.vertices)
    return mass * mode / (mass * mode**2).sum()


LAME = dict(E=1e5, density=1000.0, reach=1e-3)  # the reach is so small that what is nonlinear stays below 1e-5


def lame_scene(nu: float, cells: int, pattern: str, precision: str, order: int = 1, **element) -> Scene:
    """A free cube of 1 m in its Lame mode."""
    mesh = of_order(TetrahedralMesh.create_cube(cells + 1, 1.0, pattern), order)
    how = dict(initial_positions=mesh.vertices + LAME["reach"] * lame_mode(mesh.vertices), precision=precision)
    return Scene(mesh, StableNeoHookean(LAME["E"], nu), LAME["density"], **how, **element)


def lame_omega(nu: float) -> float:
    return np.pi * np.sqrt(LAME["E"] / (1 + nu) / LAME["density"])


def lame(nu: float = 0.3) -> Problem:
    """Lame mode of a free cube, exact for any nu: u = (cos px sin py, -sin px cos py, 0), p = pi / a,
    omega = p sqrt(2 mu / rho). Free of divergence, so what the mesh adds to its frequency is locking.

    The number is the mode's frequency with its decay, fitted to the projection of the motion on the mode over a period.
    """
    omega = lame_omega(nu)

    def frequency(frames, _):
        mode = lame_mode(frames.inputs["rest_positions"])  # its share: the projection by least squares
        q = np.tensordot(frames.displacements.astype(float), mode / (mode**2).sum(), 2)
        return fit_oscillation(frames.times, q / LAME["reach"], omega)

    said = "lame", f"Lamé mode of a free cube, nu = {nu:g}, closed form", "error of frequency and decay"
    of, exact, meshes = partial(lame_scene, nu), np.array([omega, 0.0]), dict(cells=(4, 8, 12, 16, 24))
    return Problem(*said, of, 2 * np.pi / omega, frequency, exact=exact, elements=("linear", "quadratic"), **meshes)


def lame_gradient(nu: float = 0.3) -> Problem:
    """How the Lame mode's motion q = reach cos(omega t) depends on E: dq / dE = -reach omega t / (2 E) sin(omega t).

    The number is that of L = sum_f c_f q_f over two periods, c = sin(omega t) sin^2(pi t / T): a window that hears the
    mode's own frequency alone, for what a mesh adds are other modes, the faster the more they depend on E.
    """
    omega, frames = lame_omega(nu), 32
    time = 4 * np.pi / omega
    t = np.linspace(0, time, frames + 1)
    window = np.sin(omega * t) * np.sin(np.pi * t / time) ** 2
    exact = -LAME["reach"] * omega / 2 * (window * t * np.sin(omega * t)).sum()
    said = "lame-gradient", f"Gradient by E of the Lamé mode, nu = {nu:g}, closed form", "error of the derivative"
    of, meshes = partial(lame_scene, nu), dict(cells=(4, 8, 12, 16, 24), patterns=("five",))
    loss = dict(adjoint=FrameLoss(lame_share_by_mass, window, 0 * t, 0 * t), inputs=("youngs_modulus",))
    by_E = lambda _, gradients: LAME["E"] * np.atleast_1d(gradients["youngs_modulus"])  # noqa: E731
    return Problem(*said, of, time, by_E, frames=frames, exact=np.array([exact]), **loss, **meshes)


def fit_oscillation(times: np.ndarray, q: np.ndarray, guess: float) -> np.ndarray:
    """(omega, sigma) [1/s] of q = exp(-sigma t) (A cos omega t + B sin omega t), by least squares from omega = guess."""
    from scipy.optimize import least_squares

    def remainder(p):
        wave = np.exp(-p[1] * times)[:, None] * np.stack([np.cos(p[0] * times), np.sin(p[0] * times)], 1)
        return wave @ np.linalg.lstsq(wave, q, rcond=None)[0] - q

    near = ([guess * s, guess * d] for s in (0.7, 0.85, 1.0, 1.2, 1.5) for d in (0.0, 0.2))
    start = min(near, key=lambda p: (remainder(p) ** 2).sum())
    return least_squares(remainder, start, x_scale=guess, xtol=1e-12, ftol=1e-12, gtol=1e-12).x


def beam_scene(
    law: type[Material], cells: int, pattern: str, precision: str, nu: float = 0.3, order: int = 1, **element
) -> Scene:
    """A beam 1 m long and 0.2 m thick, held at x = 0, under its own weight; E = 1e6 Pa, 1000 kg/m^3."""
    mesh = of_order(TetrahedralMesh.create_box((5 * cells + 1, cells + 1, cells + 1), (1.0, 0.2, 0.2), pattern), order)
    return Scene(mesh, law(1e6, nu), 1000.0, Gravity(), fixed="xmin", precision=precision, **element)


def corners(rest: np.ndarray) -> np.ndarray:
    """The four corners of the beam's end, which every mesh has."""
    return np.flatnonzero((rest[:, 0] == 1) & np.isin(rest[:, 1], (0, 0.2)) & np.isin(rest[:, 2], (0, 0.2)))


def tip(frames: Frames, _: object | None = None) -> np.ndarray:
    """Mean displacement of the beam's end, shape (frames, 3) [m]."""
    return frames.displacements[:, corners(frames.inputs["rest_positions"])].astype(np.float64).mean(1)


def beam() -> Problem:
    """Large motion of the clamped beam that is let go straight: the path of its end over half a swing."""
    said = "beam", "Clamped beam let go under its own weight, nu = 0.3", "error of motion, over its reach"
    meshes = dict(cells=(1, 2, 3, 4, 6, 8), elements=("linear", "patches", "quadratic"), reference_cells=(2, 3, 4))
    return Problem(*said, partial(beam_scene, SmithNeoHookean), 0.5, tip, frames=10, **meshes)


def sag(nu: float = 0.3) -> Problem:
    """Equilibrium of the clamped beam for small strains: Timoshenko's drop of the end,

    q L^4 / (8 E I) + q L^2 / (2 k G A), k = 10 (1 + nu) / (12 + 11 nu)  (Cowper 1966, doi:10.1115/1.3625046)
    """
    E, load, L, H = 1e6, 1000 * 9.81 * 0.04, 1.0, 0.2
    shear = 10 * (1 + nu) / (12 + 11 * nu) * E / (2 * (1 + nu)) * H**2
    drop = load * L**4 / (8 * E * H**4 / 12) + load * L**2 / (2 * shear)
    said = "sag", f"Clamped beam at rest, small strains, nu = {nu:g}, beam theory", "error of the end's drop"
    of, meshes = partial(beam_scene, LinearElastic, nu=nu), dict(elements=("linear", "patches", "quadratic"))
    how = meshes | dict(exact=np.array([-drop]), cells=(1, 2, 4, 6, 8), frames=1, static=True)
    return Problem(*said, of, 1.0, lambda frames, _: tip(frames)[-1:, 1], **how)


def bounce_scene(speed: float, cells: int, pattern: str, precision: str, **element) -> Scene:
    """A mass of 1 kg that meets a floor at `speed` [m/s] from 5 mm above the barrier: stiffness 1e4 N/m, width 0.01 m.

    It is the apex of a tetrahedron too soft to count (1e-6 Pa), hanging from three fixed vertices.
    """
    mesh = TetrahedralMesh([[0, 1, 0], [1, 1, 0], [0, 1, 1], [0, 0.015, 0]], [[0, 1, 2, 3]], fix_orientation=True)
    how = dict(initial_velocities=-speed * np.eye(4, 3, -3)[:, [1, 0, 2]], precision=precision) | element
    floor = Ground(0.0, 1e4, 0.01)
    return Scene(mesh, StableNeoHookean(1e-6, 0.0), 4 / mesh.volume, floor, fixed=[0, 1, 2], **how)


def barrier_energy(d: float, stiffness: float = 1e4, width: float = 0.01) -> float:
    """Energy [J] of the barrier at the gap d [m] below its width."""
    return float(stiffness * width**2 * beta(d / width))


def time_in_contact(speed: float, energy: Callable[[float], float] = barrier_energy, width: float = 0.01) -> float:
    """Time [s] that a mass of 1 kg spends in the barrier: 2 int dd / sqrt(v^2 - 2 b(d)) from the deepest point."""
    from scipy.integrate import quad
    from scipy.optimize import brentq

    deepest = brentq(lambda d: 2 * energy(d) - speed**2, 1e-3 * width, width * (1 - 1e-12), xtol=1e-18)
    # d = deepest + s^2 takes the root of the denominator away
    rate = lambda s: 2 * s / np.sqrt(max(speed**2 - 2 * energy(deepest + s * s), 1e-300))  # noqa: E731
    return 2 * quad(rate, 0, np.sqrt(width - deepest), epsabs=1e-12, limit=400)[0]


BOUNCE_TIME = 0.03  # [s]
ONE_MASS = dict(cells=(1,), patterns=("one mass",), largest_step=2e-3, levels=9, frames=1)


def bounce_height(speed: float, energy: Callable[[float], float] = barrier_energy) -> float:
    """Height [m] after BOUNCE_TIME: down from 15 mm, in the barrier, up again."""
    return 0.01 + speed * (BOUNCE_TIME - 0.005 / speed - time_in_contact(speed, energy))


def bounce(speed: float = 2.0) -> Problem:
    """Bounce on the barrier, by energy: the height after it, in widths of the barrier."""
    said = "bounce", f"A mass meets a floor at {speed:g} m/s, by energy", "error of height, in barrier widths"

    def height(frames, _):
        return frames.inputs["rest_positions"][3, 1] + frames.displacements[-1:, 3, 1].astype(float)

    how = ONE_MASS | dict(exact=np.array([bounce_height(speed)]), scale=0.01)
    return Problem(*said, partial(bounce_scene, speed), BOUNCE_TIME, height, **how)


def bounce_gradient(speed: float = 2.0) -> Problem:
    """How the height after the bounce depends on that before: d x / d x0 = -1 exactly."""
    height = lambda mesh: np.eye(4, 3, -3)[:, [1, 0, 2]]  # noqa: E731, of the apex
    by_height = lambda _, gradients: gradients["initial_positions"][3, 1:2]  # noqa: E731
    said = "bounce-gradient", f"Gradient through a bounce at {speed:g} m/s, by energy", "error of the derivative"
    how = ONE_MASS | dict(exact=np.array([-1.0]), adjoint=FrameLoss.end(height, 1), inputs=("initial_positions",))
    return Problem(*said, partial(bounce_scene, speed), BOUNCE_TIME, by_height, **how)


def identify() -> Problem:
    """The gradient by E that identification follows: a clamped beam that sags, its end watched at 10 times for 0.25 s.

    Loss: mean square of the drop's distance [m] from what E = 0.9e6 Pa would about have made it.
    """
    times = np.linspace(0, 0.25, 11)

    def drop(mesh):
        at = corners(mesh.vertices)
        weights = np.zeros(mesh.vertices.shape)
        weights[at, 1] = 1 / len(at)
        return weights

    loss = FrameLoss(drop, 0 * times, np.full(11, 2 / 11), -4.3 * times**2)
    said = "identify", "Gradient by E of a beam's watched motion, per mesh", "error of d loss / d E"
    how = dict(frames=10, adjoint=loss, inputs=("youngs_modulus",), cells=(2, 4), patterns=("five",))
    by_E = lambda _, gradients: np.atleast_1d(gradients["youngs_modulus"])  # noqa: E731
    return Problem(*said, partial(beam_scene, SmithNeoHookean), 0.25, by_E, **how)


MAKERS = (oscillator, lame, lame_gradient, beam, sag, bounce, bounce_gradient, identify)
PROBLEMS = {make.__name__.replace("_", "-"): make for make in MAKERS}


def problem(name: str) -> Problem:
    """A built-in problem by its name."""
    if name not in PROBLEMS:
        raise ValueError(f"no problem is called {name!r}; there are {', '.join(PROBLEMS)}")
    return replace(PROBLEMS[name](), origin=(problem, (name,)))
