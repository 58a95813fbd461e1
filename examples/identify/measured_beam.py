"""Stiffness and damping of a real silicone beam from how it swings, and how it swings with a weight that nobody fitted.

The folder holds motion capture of a clamped beam, one CSV file a recording: time [s], then x, y, z [m] of three markers on
its tip and three on its base, in the camera's frame: `beam_gravity_*.csv`, where the support of the tip is taken away, and
`beam_load52_*.csv`, the same with 52 g on the lower edge of the tip. Of such a set (Dragon Skin 10, 3 x 3 x 10 cm; Dubied,
Michelis, Spielberg, Katzschmann 2022, Sim-to-Real for Soft Robots Using Differentiable FEM, doi:10.1109/LRA.2022.3154050)
the script

1. finds each recording's frame from the base markers, and when the tip was let go;
2. fits E, creep and one of three kinds of damping, and how the support went away, to the recordings without a weight;
3. says which kind explains them (Akaike's criterion), and intervals that count how residuals hang together;
4. predicts the recordings with a weight: rest, frequency and decay beside what was measured.

Recordings without a weight have one frequency, at which a drag, a viscosity and a loss factor that does not depend on the
frequency are the same; with a weight they part. Rubber has the last: its loss factor changes little within a decade of
frequencies (Nashif, Jones, Henderson 1985, Vibration Damping, ch. 3), and causality then makes it stiffer with the frequency
to the power 2 delta / pi. That is what is predicted, and the others are its interval.

    python examples/identify/measured_beam.py FOLDER [--mass KG] [--recordings PATTERN] [--output FOLDER]
"""

import argparse
import re
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

import diffsim_ti as ds

LENGTH, SIDE, DENSITY, G = 0.1, 0.03, 1070.0, 9.81  # [m], [m], [kg/m^3], [m/s^2]
TIP = np.array([(0, 0.015, 0.036), (0, -0.006, 0.024), (0, 0.036, 0.006)])  # the makers' places of markers [m]
BASE = np.array([(-0.094, -0.01, -0.001), (-0.094, 0.04, 0.0275), (-0.094, 0.04, 0.0)])
MAKERS = "the makers fitted 263824 Pa with nu = 0.499"
NU = 0.45  # ten-node tetrahedra lock beyond; the bending of a beam does not tell it
STEP = 0.01  # [s]; the recordings have 100 Hz
EDGE = 3e-3  # [m] thickness of the cells that bear the weight
LEAD, SPAN = 0.01, 1.2  # [s] from the start of the simulation to the release, and of what is fitted
WINDOWS = ((1, 4), (4, 7))  # steps in which the support carries a share of the weight that is not known
EVERY = 2  # samples to a picture of a film
NOISE = 1e-4  # [m] of a marker's height
SLOW = 1.0  # [s] of the branch by which the beam creeps after it has come to rest, in every kind
SHARES = {"drag": 0.0, "Kelvin-Voigt": 2.0, "relaxation": 0.25}  # of a fast branch, where the search begins
FAST = {
    "drag": 0.01,
    "Kelvin-Voigt": 1e-3,
    "relaxation": 0.01,
}  # [s]; in a millisecond a branch is Kelvin-Voigt's viscosity
KINDS = tuple(SHARES)
DAMPS = ("drag_rate", "prony_shares[0]")  # what damps most
LOSS = "loss factor"  # of Kelvin-Voigt's viscosity, whose time goes with the period


# ---- recordings ---------------------------------------------------------------------------------------------------------


@dataclass
class Recording:
    """Tip markers in the beam's frame, x along it and z up. heights: rise above their places before the release [m]."""

    name: str
    times: np.ndarray  # [s] since the release
    tip: np.ndarray  # (frames, 3, 3) [m]
    frame_error: float  # [rad] standard error of the frame's pitch

    @property
    def start(self) -> np.ndarray:
        still = self.times < -0.05
        return self.tip[still].mean(0)

    @property
    def heights(self) -> np.ndarray:
        return (self.tip - self.start)[:, :, 2]

    @property
    def rest(self) -> np.ndarray:
        """Places of the markers in the last half second [m]."""
        return self.tip[self.times > self.times[-1] - 0.5].mean(0)


def rigid_motion(of: np.ndarray, to: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R, t of the rotation that carries points best, to = R of + t (Kabsch 1976, doi:10.1107/S0567739476001873)."""
    a, b = of.mean(0), to.mean(0)
    U, _, V = np.linalg.svd((of - a).T @ (to - b))
    R = (U @ np.diag([1, 1, np.sign(np.linalg.det(U @ V))]) @ V).T
    return R, b - R @ a


def read(path: Path) -> Recording:
    """A recording, in the frame in which its base stands after the release: the plate may slip as the weight arrives."""
    table = np.genfromtxt(path, delimiter=",", skip_header=1)
    times, markers = table[:, 0], table[:, 1:].reshape(len(table), 6, 3)
    R, t = rigid_motion(np.median(markers[:, 3:], 0), BASE)
    mean = (markers[:, :3] @ R.T + t)[:, :, 2].mean(1)
    first = int(np.argmax(mean < mean[10:30].mean() - 2e-4))  # the first sample that has fallen
    base = np.median(markers[first + 20 :, 3:], 0)
    R, t = rigid_motion(base, BASE)
    error = np.sqrt(((base @ R.T + t - BASE) ** 2).sum() / 3)  # nine numbers less six of the motion
    arm = np.sqrt(((BASE - BASE.mean(0))[:, 2] ** 2).sum())
    return Recording(path.stem, times - times[first - 1], markers[:, :3] @ R.T + t, error / arm)


# ---- the beam -----------------------------------------------------------------------------------------------------------


@lru_cache
def mesh(cells: int, edge: float = 0.0) -> ds.TetrahedralMesh:
    """Half of the beam, which moves in a plane, of ten nodes; edge [m]: a row of cells as thin, "weight", along the tip's
    lower edge."""
    counts = np.array([2 * cells + 1, cells // 2 + 1, cells + 1]) + (edge > 0) * np.array([1, 0, 1])
    box = ds.TetrahedralMesh.create_box(tuple(counts), 1.0, pattern="five")
    lines = [
        np.linspace(-LENGTH, 0, counts[0]),
        np.linspace(SIDE / 2, SIDE, counts[1]),
        np.linspace(0, SIDE, counts[2]),
    ]
    if edge:
        lines[0] = np.append(np.linspace(-LENGTH, -edge, counts[0] - 1), 0.0)
        lines[2] = np.append(0.0, np.linspace(edge, SIDE, counts[2] - 1))
    places = np.rint(box.vertices / box.vertices.max(0) * (counts - 1)).astype(int)
    vertices = np.stack([line[k] for line, k in zip(lines, places.T)], 1)
    middles = vertices[box.tetrahedra].mean(1)
    weight = np.flatnonzero((middles[:, 0] > -edge) & (middles[:, 2] < edge))
    whole = ds.TetrahedralMesh(
        vertices, box.tetrahedra, tetrahedron_sets={"weight": weight} if edge else {}
    ).quadratic()
    x, y = whole.vertices[:, 0], whole.vertices[:, 1]
    held = {"clamp": x < 1e-9 - LENGTH, "middle": y < SIDE / 2 + 1e-9}
    sets = dict(vertex_sets=held, tetrahedron_sets=whole.tetrahedron_sets)
    return ds.TetrahedralMesh(whole.vertices, whole.elements, **sets)


def scene(body: ds.TetrahedralMesh, damping: str | None, numbers: dict, steps: int = 0, mass: float = 0.0) -> ds.Scene:
    """The beam, straight at first; mass [kg] at the lower edge of the tip. steps: of a run that begins with its support."""
    density = np.full(body.num_tetrahedra, DENSITY)
    if mass:
        rows = body.tetrahedron_sets["weight"]
        X = body.vertices[body.tetrahedra[rows]]
        density[rows] += mass / 2 / (np.abs(np.linalg.det(X[:, 1:] - X[:, :1])).sum() / 6)  # half of it, of half a beam
    material, terms = ds.StableNeoHookean(numbers["youngs_modulus"], NU), [ds.Gravity(-G, up="z")]
    if damping:
        material = ds.Prony(material, numbers["prony_shares"], (FAST[damping], SLOW))
    if damping == "drag":
        terms.append(ds.Drag(numbers["drag_rate"]))
    if steps:
        terms.append(ds.BodyForce(support(steps, numbers.get("support", (0.5, 0.1))), per="mass"))
    return ds.Scene(body, material, density, terms, fixed={"clamp": "xyz", "middle": "y"}, precision="f64")


def support(steps: int, shares) -> np.ndarray:
    """Its force per mass in each step [m/s^2]: all of the weight, shares of it in the WINDOWS, nothing."""
    force = np.zeros((steps, 3))
    force[: WINDOWS[0][0], 2] = G
    for (a, b), share in zip(WINDOWS, shares):
        force[a:b, 2] = G * share
    return force


def markers() -> ds.MaterialPoints:
    """Where the pins of the tip's markers begin, on the simulated half."""
    points = TIP * [1, 0, 1] + [0, SIDE / 2, 0] + np.abs(TIP * [0, 1, 0] - [0, SIDE / 2, 0])
    return ds.MaterialPoints(np.clip(points, (-LENGTH, 0, 0), (0, SIDE, SIDE)), name="markers", nearest=True)


def swing(body: ds.TetrahedralMesh, damping: str, numbers: dict, seconds: float, mass: float = 0.0) -> ds.Rollout:
    steps = round(seconds / STEP)
    solver = ds.SemiImplicitSolver(scene(body, damping, numbers, steps, mass), dt=STEP)
    return ds.Rollout(solver, steps, save_every=1, outputs=[markers()])


def hang(body: ds.TetrahedralMesh, numbers: dict, mass: float = 0.0) -> ds.Rollout:
    """Its equilibrium, what relaxes having relaxed; the weight pulls at the edge itself."""
    edge = np.flatnonzero((body.vertices[:, 0] > -1e-9) & (body.vertices[:, 2] < 1e-9))
    weight = ds.ExternalForce([0, 0, -G * mass / 2 / len(edge)], edge)
    hanging = scene(body, None, numbers)
    hanging = hanging.replace(terms=[*hanging.terms, weight])
    return ds.Rollout(ds.StaticSolver(hanging, load_steps=2), 1, outputs=[markers()])


# ---- the fit ------------------------------------------------------------------------------------------------------------


def measured_heights(heights: np.ndarray) -> np.ndarray:
    """Values of the output `markers` of which z alone counts: along it a pin moves as the point where it begins."""
    values = np.full((*heights.shape, 3), np.nan)
    values[..., 2] = heights + np.clip(TIP[:, 2], 0, SIDE)
    return values


@dataclass
class Fit:
    damping: str
    numbers: dict  # those of the beam
    supports: list  # shares of each recording
    offsets: list  # [s]
    intervals: dict  # {number: (low, high)}, of 95 %
    misfit: float  # root mean square of residuals [m]
    effective: float  # residuals that count as independent
    unknowns: int

    @property
    def spread(self) -> np.ndarray:
        """Of rest, frequency and decay, relative half widths by those of E and of what damps."""
        ends = (self.intervals[name] for name in self.intervals if name in ("youngs_modulus", *DAMPS))
        E, damping = ((high - low) / (high + low) for low, high in ends)
        return np.array([E, E / 2, damping])

    def akaike(self, effective: float) -> float:
        """n log(misfit^2) + 2 unknowns; Akaike 1974, doi:10.1109/TAC.1974.1100705."""
        return effective * np.log((self.misfit / NOISE) ** 2) + 2 * self.unknowns


def fit(recordings: list[Recording], damping: str, cells: int, span: float = SPAN) -> Fit:
    steps = round((span + LEAD) / STEP) + 3
    start = {"youngs_modulus": 2.5e5, "prony_shares": np.array([SHARES[damping], 0.06])}
    dynamic, rollouts, data = range(len(recordings)), [], []
    unknowns = {"youngs_modulus": ds.Unknown(start["youngs_modulus"])}
    if damping == "drag":
        start["drag_rate"] = 5.0
        unknowns["drag_rate"] = ds.Unknown(5.0, experiments=dynamic)
    fitted = np.array([-1, 0]) if damping == "drag" else np.array([0, 1])
    shares = start["prony_shares"][fitted >= 0]
    unknowns["prony_shares"] = ds.Unknown(shares, regions=fitted, experiments=dynamic)
    groups = np.full((steps, 3), -1)
    for k, (a, b) in enumerate(WINDOWS):
        groups[a:b, 2] = k
    for k, recording in enumerate(recordings):
        rollouts.append(swing(mesh(cells), damping, start, steps * STEP))
        chosen = (recording.times >= 0) & (recording.times <= span)
        times = recording.times[chosen] + LEAD
        data.append(ds.Measurement("markers", measured_heights(recording.heights[chosen]), NOISE, times=times))
        shares = ds.Unknown(G * np.array([0.05, 0.05]), regions=groups, input="body_force", scale=1.0, experiments=[k])
        unknowns |= {f"support {k}": shares}
        unknowns |= {f"offset {k}": ds.Unknown(0.0, scale=3e-3, input="time_offset", experiments=[k])}
    rest = np.mean([(r.rest - r.start)[:, 2] for r in recordings], 0)
    rollouts.append(hang(mesh(cells), start))
    hung = np.concatenate([np.full((1, 3, 3), np.nan), measured_heights(rest[None])])
    data.append(ds.Measurement("markers", hung, NOISE / 3))  # a mean of many samples
    found = ds.identify(rollouts, data, unknowns, max_iterations=10, tolerance=0.5, starts=1, check_mesh=False)
    residuals = NOISE * found.residuals
    together = len(TIP) * correlation_length(residuals[: -len(TIP)].reshape(-1, len(TIP)))  # the markers tell the same
    half = 1.96 * np.sqrt((found.residuals**2).mean() * together * np.diag(found.covariance))
    intervals = {label: (x - h, x + h) for label, x, h in zip(found.labels, found.numbers, half)}
    names = tuple(start)
    misfit = float(np.sqrt((residuals**2).mean()))
    of = found.estimates
    supports = [np.asarray(of[f"support {k}"]) / G for k in dynamic]
    offsets = [float(of[f"offset {k}"]) for k in dynamic]
    numbers = {n: found.inputs[0][n] for n in names}
    return Fit(damping, numbers, supports, offsets, intervals, misfit, len(residuals) / together, len(found.labels))


def correlation_length(residuals: np.ndarray) -> float:
    """Samples that count as one, 1 + 2 sum of the autocorrelation up to its first zero; shape (samples, markers)."""
    x = residuals.mean(1) - residuals.mean()
    correlation = np.correlate(x, x, "full")[len(x) - 1 :] / max(x @ x, 1e-300)
    end = int(np.argmax(correlation < 0)) or len(x)
    return float(1 + 2 * correlation[1:end].sum())


def oscillation(times: np.ndarray, height: np.ndarray) -> tuple[float, float]:
    """(frequency [Hz], decay [1/s]) of a damped oscillation about a level that creeps, from 0.15 s after the release on."""
    chosen = (times > 0.15) & (times < 1.5)
    t, z = times[chosen], height[chosen] * 1e3

    def model(p):
        return (
            p[0]
            + p[1] * np.exp(-2 * t)
            + p[2] * t
            + np.exp(-p[3] * t) * (p[4] * np.cos(p[5] * t) + p[6] * np.sin(p[5] * t))
        )

    turns = np.fft.rfftfreq(16 * len(t), t[1] - t[0])
    seen = np.abs(np.fft.rfft((z - np.polyval(np.polyfit(t, z, 2), t)) * np.hanning(len(t)), 16 * len(t)))
    rate = 2 * np.pi * turns[np.argmax(seen)]
    found = least_squares(lambda p: model(p) - z, [z[-1], 0, 0, 2.0, 1.0, rate, 1.0], x_scale=[1, 1, 1, 1, 1, 10, 1])
    return float(found.x[5] / (2 * np.pi)), float(found.x[3])


# ---- the prediction -----------------------------------------------------------------------------------------------------


def finer(cells: int, better: ds.TetrahedralMesh) -> float:
    """E of another mesh that has the same first frequency, over that of `cells`: a coarse one is too stiff."""
    both = (scene(body, None, {"youngs_modulus": 1e5}) for body in (mesh(cells), better))
    coarse, fine = (ds.modes(one, 1).frequencies[0] for one in both)
    return float((coarse / fine) ** 2)


@dataclass
class Prediction:
    """Of the mean height of the tip's markers: rest [m], frequency [Hz], decay [1/s]; times [s], heights [m], where the
    markers' pins begin and the outline of the beam's side, x and z [m]."""

    rest: float
    frequency: float
    decay: float
    times: np.ndarray
    heights: np.ndarray
    pins: np.ndarray
    outline: np.ndarray


def predict(found: Fit, cells: int, mass: float, flat: bool = False, seconds: float = 1.3) -> Prediction:
    """flat: with the loss factor that the viscosity has without a weight."""
    body = mesh(cells, EDGE if mass else 0.0)
    numbers = dict(found.numbers, youngs_modulus=found.numbers["youngs_modulus"] * finer(cells, body))
    numbers["support"] = np.mean(found.supports, 0)
    hung, moving = hang(body, numbers, mass).forward()["markers"], dict(numbers)
    if flat:
        scenes = (scene(mesh(cells), None, found.numbers), scene(body, None, numbers, mass=mass))
        alone, laden = (ds.modes(one, 1).frequencies[0] for one in scenes)
        fast, slow = numbers["prony_shares"]
        delta = np.arctan(2 * np.pi * alone * fast * FAST[found.damping])
        moving["youngs_modulus"] = numbers["youngs_modulus"] * (laden / alone) ** (2 * delta / np.pi)
        moving["prony_shares"] = np.array([fast * alone / laden, slow])
    frames = swing(body, found.damping, moving, seconds + LEAD, mass).forward()
    pins, times = frames["markers"], np.asarray(frames.times) - LEAD
    heights = (pins - pins[0])[:, :, 2]
    outline = frames.positions[:, side(body)][..., [0, 2]]
    rest = float((hung[-1] - hung[0])[:, 2].mean())
    return Prediction(rest, *oscillation(times, heights.mean(1)), times, heights, pins[..., [0, 2]], outline)


def side(body: ds.TetrahedralMesh) -> np.ndarray:
    """Vertices of the outline of the beam's side, in their order: below, at the tip, above."""
    x, y, z = body.vertices.T
    ways = ((z < 1e-9, x), (x > -1e-9, z), (z > SIDE - 1e-9, -x))
    rows = [np.flatnonzero(on & (y > SIDE - 1e-9)) for on, _ in ways]
    return np.concatenate([row[np.argsort(along[row])] for row, (_, along) in zip(rows, ways)])


def misfit(prediction: Prediction, recording: Recording) -> float:
    """Root mean square of heights [m] over the time that both have, the start of the time chosen to fit best."""
    chosen = (recording.times > 0.05) & (recording.times < prediction.times[-1] - 0.05)
    seen, wanted = recording.times[chosen], recording.heights[chosen].mean(1)
    shifts = np.linspace(-0.04, 0.04, 81)
    simulated = [np.interp(seen + s, prediction.times, prediction.heights.mean(1)) for s in shifts]
    return float(min(np.sqrt(np.mean((one - wanted) ** 2)) for one in simulated))


def compare(predictions: dict, chosen: str, spread: np.ndarray, recordings: list[Recording], straight) -> dict:
    """Prints what was measured, and beside it what each kind of damping predicts. spread: how far rest, frequency and decay
    may be off, relatively, by the intervals of the fit. Returns relative errors of the chosen."""
    seen = []
    for one in recordings:
        rest, own = (1e3 * float((one.rest - of)[:, 2].mean()) for of in (straight, one.start))
        frame = 1.96e3 * LENGTH * one.frame_error  # of the tip's height, through the frame's pitch [mm]
        seen.append((rest, *oscillation(one.times, one.heights.mean(1))))
        print(
            f"  {one.name}: rest {rest:.2f} +- {frame:.2f} mm ({own:.2f} from where its support held it), "
            f"{seen[-1][1]:.3f} Hz, decay {seen[-1][2]:.2f} 1/s"
        )
    numbers = {kind: np.array([1e3 * p.rest, p.frequency, p.decay]) for kind, p in predictions.items()}
    for kind, (rest, frequency, decay) in numbers.items():
        off = np.mean([misfit(predictions[kind], one) for one in recordings])
        words = f"misfit of the motion {1e3 * off:.2f} mm"
        print(f"  by {kind}: rest {rest:.2f} mm, {frequency:.3f} Hz, decay {decay:.2f} 1/s; {words}")
    errors = dict(zip(("rest", "frequency", "decay"), numbers[chosen] / np.mean(seen, 0) - 1))
    each = np.array([x * (1 + sign * spread) for x in numbers.values() for sign in (-1, 1)])
    low, high = each.min(0), each.max(0)
    spans = [f"{name} {x:+.1%} ({a:.3g} to {b:.3g})" for (name, x), a, b in zip(errors.items(), low, high)]
    print(f"  {chosen} over what was measured (intervals of all kinds that explain the fitted): {', '.join(spans)}")
    return errors


def draw(path: Path, pairs: list, straight: np.ndarray) -> None:
    """Measured and simulated heights of the three markers above those of the straight beam, a row for each (recording,
    prediction, words)."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    path.parent.mkdir(parents=True, exist_ok=True)
    figure, axes = plt.subplots(
        len(pairs), 1, figsize=(9, 2.2 * len(pairs)), layout="constrained", sharex=True, squeeze=False
    )
    for axis, (recording, prediction, words) in zip(axes[:, 0], pairs):
        measured = (recording.tip - straight)[:, :, 2]
        for k, colour in enumerate(("tab:blue", "tab:orange", "tab:green")):
            axis.plot(recording.times, 1e3 * measured[:, k], ".", ms=3, color=colour)
            axis.plot(prediction.times, 1e3 * prediction.heights[:, k], "-", lw=1, color=colour)
        rest, frame = 1e3 * prediction.rest, 1.96e3 * LENGTH * recording.frame_error
        axis.axhspan(rest - frame, rest + frame, color="0.9", zorder=0)
        axis.set(xlim=(-0.05, prediction.times[-1]), ylabel="height [mm]", title=f"{recording.name}: {words}")
    words = "dots: measured, lines: simulated, grey: simulated rest and how far the camera's frame may be off"
    axes[-1, 0].set_xlabel(f"time since the release [s]; {words}")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def film(path: Path, recording: Recording, prediction: Prediction, words: str, straight: np.ndarray) -> None:
    """The simulated beam from the side, its markers and the measured ones, four times as slow; straight: places of these
    on the straight beam."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.animation import FuncAnimation, PillowWriter

    stand_off = (TIP - np.clip(TIP, [-LENGTH, 0, 0], [0, SIDE, SIDE]))[:, [0, 2]]
    chosen = (recording.times > -0.02) & (recording.times < prediction.times[-1])
    times, measured = recording.times[chosen], (recording.tip[chosen] - straight + TIP)[..., [0, 2]]
    shown = np.minimum(np.searchsorted(prediction.times, times), len(prediction.times) - 1)
    figure, axis = plt.subplots(figsize=(6, 4), gridspec_kw=dict(left=0.12, bottom=0.14))
    (beam,) = axis.fill(*(1e3 * prediction.outline[0]).T, color="tab:blue", alpha=0.3)
    (simulated,) = axis.plot([], [], "o", mfc="none", color="tab:blue", label="simulated")
    (seen,) = axis.plot([], [], ".", color="tab:red", label="measured")
    axis.set(xlim=(-105, 15), ylim=(-30, 50), aspect="equal", xlabel="along the beam [mm]", ylabel="height [mm]")
    axis.legend(loc="lower left")

    def show(k: int):
        beam.set_xy(1e3 * prediction.outline[shown[k]])
        simulated.set_data(*(1e3 * (prediction.pins[shown[k]] + stand_off)).T)
        seen.set_data(*(1e3 * measured[k]).T)
        axis.set_title(f"{recording.name}: {words}; {times[k]:.2f} s", fontsize=9)

    FuncAnimation(figure, show, range(0, len(times), EVERY)).save(path, PillowWriter(fps=25 / EVERY), dpi=80)
    plt.close(figure)


def main(
    folder: str | Path,
    mass: float | None = None,
    recordings: str = "beam_load*.csv",
    output: str | Path | None = None,
    cells: int = 2,
    kinds: tuple = KINDS,
    span: float = SPAN,
) -> dict:
    """Returns each kind's `Fit`, the name of the best, and relative errors of each mass that was predicted.

    Writes a picture, and films of what was predicted, to the folder `output`.

    mass [kg]: of the recordings with a weight; default: what the digits in a file's name say, in grams.
    """
    folder = Path(folder)
    light = [read(path) for path in sorted(folder.glob("beam_gravity_*.csv"))]
    if not light:
        raise SystemExit(f"{folder} has no beam_gravity_*.csv")
    straight = np.mean([one.start for one in light], 0)
    fits = {}
    for kind in kinds:
        one = fits[kind] = fit(light, kind, cells, span)
        said = "; ".join(
            f"{name} {low:.4g} to {high:.4g}" for name, (low, high) in one.intervals.items() if "sup" not in name
        )
        print(f"{kind}: misfit {1e3 * one.misfit:.3f} mm; intervals of 95 %: {said}", flush=True)
    effective = min(one.effective for one in fits.values())
    criteria = {kind: one.akaike(effective) for kind, one in fits.items()}
    best = min(criteria, key=criteria.get)
    weights = {kind: float(np.exp((criteria[best] - x) / 2)) for kind, x in criteria.items()}
    weights = {kind: x / sum(weights.values()) for kind, x in weights.items()}
    print("Akaike's weights: " + ", ".join(f"{kind} {x:.2f}" for kind, x in weights.items()))
    share = finer(cells, mesh(3 * cells))
    low, high = (share * x for x in fits[best].intervals["youngs_modulus"])
    print(f"E at rest, by {best}, on a mesh three times as fine: {low:.0f} to {high:.0f} Pa; {MAKERS}", flush=True)
    kinds = [kind for kind, x in weights.items() if x > 0.02]
    groups: dict = {0.0: light}
    for path in sorted(folder.glob(recordings)):
        digits = re.search(r"load(\d+)", path.stem)
        if mass is None and digits is None:
            raise SystemExit(f"{path.name} does not say its weight; give --mass KG")
        groups.setdefault(mass if mass is not None else 1e-3 * int(digits[1]), []).append(read(path))
    errors, pairs = {}, []
    for weight, group in groups.items():
        words = f"with {1e3 * weight:g} g, predicted" if weight else "without a weight, fitted"
        print(f"{words}:")
        predictions, chosen = {kind: predict(fits[kind], cells, weight) for kind in kinds}, best
        if weight and "Kelvin-Voigt" in kinds:
            chosen = LOSS
            predictions[LOSS] = predict(fits["Kelvin-Voigt"], cells, weight, flat=True)
        errors[weight] = compare(predictions, chosen, fits[best].spread, group, straight)
        pairs += [(one, predictions[chosen], words) for one in group]
    if output:
        draw(Path(output) / "measured_beam.png", pairs, straight)
        for one, prediction, words in pairs[len(light) :]:
            film(Path(output) / f"{one.name}.gif", one, prediction, words, straight)
    return dict(fits=fits, best=best, errors=errors)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--mass", type=float, help="of the recordings with a weight [kg]; default: their names' grams")
    parser.add_argument("--recordings", default="beam_load*.csv", help="pattern of those with a weight")
    parser.add_argument("--output", type=Path, help="folder for a picture and films")
    ds.init(precision="f64")
    main(**vars(parser.parse_args()))
