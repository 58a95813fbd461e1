"""What is asked of every configuration: each input's derivative by the reverse sweep, by the tangent and by differences."""

import linecache
import os
import re
import traceback
import warnings
from dataclasses import dataclass, field, replace

import numpy as np

import diffsim_ti as ds

from .differences import closer, derivative
from .scenes import Configuration, build, path_at
from .structures import CELL

PASSED, ZERO, REFUSED, UNRESOLVED, INACCURATE, KINK, SINGLE_ROUNDING, FAILED = CLASSES = (
    "passed",
    "exactly zero",
    "refused as documented",
    "unresolved contact",
    "difference not accurate enough",
    "that of one side, at a kink",
    "rounding of f32, right in f64",
    "FAILED",
)
GATES = {("f64", True): (1e-10, 1e-6), ("f64", False): (1e-7, 1e-5)}  # (precision, explicit): (tangent, differences)
SINGLE = (2e-4, 2e-3)
ROUNDING = {"f64": 1e-12, "f32": 1e-4}  # a derivative this much smaller than the largest of a configuration is rounding
TINY = {"f64": 1e-16, "f32": 1e-8}  # what is left of terms that cancel, against the same
REFUSALS = (ValueError, FloatingPointError, RuntimeError)
CALMS = (1.0, 0.3, 0.1)  # shares of motion and pressure, tried until a configuration runs
LENGTHS = ("_positions", "_motion", "_path", "_center", "_point", "_about", "_start", "_end", "_position", "_height")


@dataclass
class Row:
    """One derivative, by one input along a random direction."""

    term: str  # the class of the term, or "scene" or "material"
    input: str  # without the number of a second one
    verdict: str
    reverse: float = 0.0
    tangent: float = 0.0
    difference: float = 0.0
    error: float = 0.0  # of the difference, as it thinks itself
    size: float = 0.0  # what errors are relative to


@dataclass
class Result:
    """All that one configuration showed."""

    seed: int
    structure: str
    law: str
    solver: str
    precision: str
    rows: list[Row] = field(default_factory=list)
    checks: dict[str, str] = field(default_factory=dict)  # name -> "right" or what is wrong
    refusal: str = ""
    calm: float = 1.0  # share of its motion and pressure that was left to it
    error: str = ""
    seen: dict[str, bool] = field(default_factory=dict)

    @property
    def failed(self) -> bool:
        wrong = any(said != "right" for said in self.checks.values())
        return bool(self.error) or wrong or any(row.verdict == FAILED for row in self.rows)


def is_refusal(error: Exception) -> bool:
    """Whether the package itself raised it, in a line that says raise, and with a message."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    package = os.path.dirname(os.path.abspath(ds.__file__))
    line = linecache.getline(last.filename, last.lineno)
    return (
        isinstance(error, REFUSALS) and last.filename.startswith(package) and "raise" in line and len(str(error)) > 20
    )


def scale_of(name: str, value: np.ndarray, duration: float) -> float:
    """How far an input is moved: by what matters for it."""
    name = name.rstrip("_0123456789")
    if name.endswith(LENGTHS):
        return 0.05 * CELL
    if name == "initial_velocities":
        return 0.05 * CELL / duration
    size = float(np.abs(value).max())
    return 0.1 * size if size > 0 else 0.1


def owners(configuration: Configuration, names) -> dict[str, tuple[str, str]]:
    """(class of the term, name without its number) of each input."""
    out, terms = {}, {}
    for term in configuration.terms:
        for name in [
            *term.values,
            *([term.plain] if getattr(term, "keyed", False) else []),
            *([term.path_name] if getattr(term, "path", None) is not None else []),
        ]:
            terms.setdefault(name, []).append(type(term).__name__)
    known = ("initial_positions", "initial_velocities", "density", "rest_positions", "prescribed_motion")
    for name in names:
        numbered = re.fullmatch(r"(.+)_(\d+)", name)
        plain, place = (numbered[1], int(numbered[2]) - 1) if numbered and numbered[1] in terms else (name, 0)
        out[name] = (terms[plain][place] if plain in terms else "scene" if plain in known else "material"), plain
    return out


class Judge:
    """Frames, gradients and weights of one configuration, for all checks."""

    def __init__(self, configuration: Configuration):
        self.configuration, kind = configuration, configuration.structure
        self.rollout, rng = configuration.rollout(), configuration.rng(1)
        self.duration = float(self.rollout.solver.schedule.time(configuration.steps))
        self.frames = self.rollout.forward()
        shape = self.frames.positions.shape
        self.w = rng.standard_normal(shape) / CELL
        self.z = 0 * self.w if kind.static else rng.standard_normal(shape) * self.duration / CELL
        if kind.precision == "f32":  # as the adjoints of its frames are stored
            self.w, self.z = (x.astype(np.float32).astype(np.float64) for x in (self.w, self.z))
        self.gradients = self.rollout.vjp(self.frames, self.w, self.z)
        self.gates = GATES.get((kind.precision, kind.explicit), SINGLE)
        self.directions = {
            name: scale_of(name, value, self.duration) * rng.standard_normal(value.shape)
            for name, value in self.rollout.values.items()
        }

    @property
    def floors(self) -> dict[str, float]:
        """What is rounding in each gradient: its own size at which it would matter this little beside the largest."""
        of = {name: np.abs(d).max() for name, d in self.directions.items()}
        largest = max(of[name] * np.abs(g).max(initial=0.0) for name, g in self.gradients.items())
        return {name: ROUNDING[self.configuration.structure.precision] * largest / of[name] for name in of}

    def weighed(self, dx: np.ndarray, dv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.w * dx, self.z * dv

    def along(self, dx: np.ndarray, dv: np.ndarray) -> float:
        return float(sum(x.sum() for x in self.weighed(dx, dv)))

    def rows(self) -> list[Row]:
        """A row for each input."""
        configuration, kind, out = self.configuration, self.configuration.structure, []
        exact = self.rollout
        if kind.precision == "f32":  # differences in f32 see nothing
            exact = build(configuration.seed, "f64", configuration.calm).rollout()
        resolved = self.frames.contact_resolution.resolved
        named = owners(configuration, self.rollout.inputs)
        compared = set(configuration.rng(2).permutation(list(named))[: len(named) if kind.explicit else 7])
        tangents = {name: self.rollout.jvp(self.frames, **{name: self.directions[name]}) for name in named}
        norms = {name: float(np.hypot(*(np.linalg.norm(x) for x in self.weighed(*t)))) for name, t in tangents.items()}
        floor = ROUNDING[kind.precision] * max(norms.values())
        for name, (term, plain) in named.items():
            if kind.static and name == "initial_velocities":  # which equilibria do not know
                continue
            direction = self.directions[name]
            reverse = float((self.gradients[name] * direction).sum())
            tangent = self.along(*tangents[name])
            size = max(norms[name], abs(tangent), abs(reverse), floor)
            row = Row(term, plain, PASSED, reverse, tangent, size=size)
            if name in compared:  # all where runs are cheap
                self._compare(row, exact, name, floor, resolved)
                out.append(row)
            elif abs(reverse - tangent) > max(self.gates[0] * size, TINY[kind.precision] * max(norms.values())):
                out.append(replace(row, verdict=FAILED))
        return out

    def _compare(self, row: Row, exact, name: str, floor: float, resolved: bool) -> None:
        dot_gate, gate = self.gates
        base, direction = exact.values[name], self.directions[name]

        def at(h: float):
            return exact.forward(**{name: base + h * direction})

        def between(one, other, h: float) -> float:
            # of displacements, which keep their digits; a moved rest shape moves positions as well
            dx = one.displacements - other.displacements
            return self.along(dx + h * direction if name == "rest_positions" else dx, one.velocities - other.velocities)

        def change(h: float) -> float:
            return between(at(h), at(-h), 2 * h)

        # rounding of positions, and what a solve leaves of the displacements
        rounding = 1e-16 * np.abs(self.frames.positions).max()
        rounding += getattr(exact.solver, "tolerance", 0.0) * np.abs(self.frames.displacements).max()
        noise = rounding * float(np.linalg.norm(self.w))
        row.difference, row.error = derivative(change, 0.1 * gate * row.size, noise, row.reverse)
        off = abs(row.reverse - row.difference)
        tiny = TINY[self.configuration.structure.precision] / ROUNDING[self.configuration.structure.precision] * floor
        if abs(row.reverse - row.tangent) > max(dot_gate * row.size, tiny):
            row.verdict = FAILED
        elif (
            max(abs(row.reverse), abs(row.tangent)) <= max(dot_gate * floor, tiny)
            and abs(row.difference) <= 3 * row.error
        ):
            row.verdict = ZERO
        elif off <= gate * row.size:
            row.verdict = PASSED
        elif off <= 3 * row.error:
            row.verdict = INACCURATE
        elif off <= 3 * gate * row.size and self._right_in_double(row, exact, name):
            row.verdict = SINGLE_ROUNDING
        else:
            here = at(0.0)
            row.verdict = self._closer(row, lambda h: between(at(h), here, h), gate * row.size)
            if row.verdict == FAILED and not resolved:
                row.verdict = UNRESOLVED

    def _right_in_double(self, row: Row, exact, name: str) -> bool:
        """Whether an implicit run in f32 has digits of its own only: the same run in f64 passes the gate of f64."""
        kind = self.configuration.structure
        if kind.precision != "f32" or kind.explicit:
            return False
        gradient = exact.vjp(exact.forward(), self.w, self.z)[name]
        found = float((gradient * self.directions[name]).sum())
        return abs(found - row.difference) <= GATES["f64", False][1] * row.size + 3 * row.error

    def _closer(self, row: Row, f, gate: float) -> str:
        """The verdict by smaller steps, where larger ones meet a kink."""
        (row.difference, row.error), *sides = closer(f)
        if max(row.error, abs(row.reverse - row.difference)) <= gate:
            return PASSED
        kink = abs(sides[0][0] - sides[1][0]) > gate
        return KINK if kink and any(max(e, abs(row.reverse - side)) <= gate for side, e in sides) else FAILED

    def acts_on_faces(self) -> bool:
        """Whether narrow obstacles press on faces by pairs at the end of explicit steps."""
        if not self.configuration.structure.explicit or not self.configuration.placed:
            return False
        rollout = self.configuration.rollout()
        rollout.forward()
        pairs = rollout.sweep.workspace.pairs
        return bool(pairs and pairs.obstacles) and pairs.look(rollout.sweep.workspace.state.u)[0] > 0

    def seen(self) -> dict[str, bool]:
        """What contacts do in this configuration."""
        configuration = self.configuration
        watched = configuration.rollout(save_every=1).forward()
        acts = sticks = slides = False
        ends = watched.times
        for placed, path in zip(configuration.placed, configuration.paths):
            for k in range(1, len(ends)):
                x, v, t, dt = watched.positions[k], watched.velocities[k], ends[k], ends[k] - ends[k - 1]
                here, before = ((path_at(path, s) if path is not None else np.zeros(3)) for s in (t, t - dt))
                if configuration.structure.static:  # friction acts on how far the step went
                    v = x - watched.positions[k - 1]
                touching, speed = placed.touching(x.astype(np.float64), v, here, (here - before) / dt)
                touching[configuration.scene.fixed] = False
                acts = acts or np.any(touching)
                if placed.kind.friction:
                    slow = speed < placed.friction_speed
                    sticks, slides = sticks or np.any(touching & slow), slides or np.any(touching & ~slow)
        presses = bool(self.gradients.get("self_contact_stiffness", 0.0))
        return dict(
            obstacle=bool(acts),
            sticks=bool(sticks),
            slides=bool(slides),
            self_contact=presses,
            faces=self.acts_on_faces(),
            static_contact=bool(acts) and configuration.structure.static,
        )


def begun(seed: int) -> Judge:
    """A configuration that runs: where it is refused (an impact that its step does not follow, a blade within the body) the
    same again, calmer; of the calmest the refusal."""
    for calm in CALMS:
        try:
            return Judge(build(seed, calm=calm))
        except Exception as error:
            if calm == CALMS[-1] or not is_refusal(error):
                raise


def judge(seed: int) -> Result:
    """Everything about one seed; nothing escapes but KeyboardInterrupt."""
    from .checks import run_checks
    from .structures import PER_STRUCTURE, structure

    kind = structure(seed // PER_STRUCTURE)
    result = Result(seed, str(kind), kind.law.__name__, kind.solver.__name__, kind.precision)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            it = begun(seed)
            result.calm = it.configuration.calm
            result.rows = it.rows()
            result.seen = it.seen()
            result.checks = run_checks(it)
        except Exception as error:  # a refusal, or a failure that the report shows
            if is_refusal(error):
                result.refusal = f"{type(error).__name__}: {error}"
            else:
                result.error = "".join(traceback.format_exception(error)[-3:])
    return result
