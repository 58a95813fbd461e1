"""Advice: the cheapest solver, step, precision, element and checkpoints for a tolerance, from trial runs and theory."""

import copy
import time
import warnings
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import Unpack

from diffsim_ti.common.checked import between, instance, number, whole
from diffsim_ti.common.public import public
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.outputs import Output
from diffsim_ti.rollout import Rollout
from diffsim_ti.rollout.rollout import RolloutOptions
from diffsim_ti.scene import Scene
from diffsim_ti.scene.scene import LOCKING_RATIO
from diffsim_ti.solvers import SOLVERS, BDF2Solver, StaticSolver, VelocityVerletSolver, stable_dt
from diffsim_ti.study.alternatives import Alternative, alternatives
from diffsim_ti.study.elements import ElementTrial, ElementTrials, advised
from diffsim_ti.study.executors import each
from diffsim_ti.study.problem import Problem, distance
from diffsim_ti.study.quantity import Quantity
from diffsim_ti.terms import Drag, Robot


@dataclass
class Option:
    """A way to run a scene, with what a trial run says of it."""

    solver: type
    precision: str
    substep: float  # [s]
    steps: int  # of the whole duration
    error: float = np.nan  # over the whole duration, relative to `Quantity.scale`
    seconds: float = np.nan  # wall time of the whole duration, with its gradient if asked for
    substeps: int = 0  # per frame of the trial

    @property
    def label(self) -> str:
        return f"{self.solver.__name__}, {self.substep:.3g} s, {self.precision}"


@dataclass(repr=False)
class Recommendation:
    """What to use: `solver`, `dt` [s], `steps`, `precision`, `memory` [MB] for the checkpoints, `element`; what to expect
    of it: `seconds` of wall time, `megabytes` kept for gradients, `error` relative to the largest displacement, or to
    how far the number changes.

    `reasons`: three lines; `left_out`: what the scene does without, and why. `rollout(scene)` makes it, of the scene as it
    is. `elements`: what its mesh makes wrong by each kind of element; `element`: the cheapest that keeps to the tolerance.
    `alternatives`: mass scaling, stiff parts that move affinely and adaptive steps beside it, where these keep to the
    tolerance.
    """

    option: Option
    duration: float
    gradients: bool
    memory: float | None
    megabytes: float
    error: float
    element: str
    reasons: list[str]
    left_out: list[str]
    tried: list[Option] = field(repr=False, default_factory=list)
    elements: list[ElementTrial] = field(repr=False, default_factory=list)
    alternatives: list[Alternative] = field(repr=False, default_factory=list)
    scale: str = "the largest displacement"  # what errors are relative to

    solver = property(lambda self: self.option.solver)
    precision = property(lambda self: self.option.precision)
    dt = property(lambda self: self.option.substep)
    steps = property(lambda self: self.option.steps)
    seconds = property(lambda self: self.option.seconds)

    def rollout(self, scene: Scene, frames: int = 1, **options: Unpack[RolloutOptions]) -> Rollout:
        """The recommended run of the scene, `frames` times saved; options are Rollout's."""
        if not self.duration:
            scene = scene.replace(precision=self.precision)
            return Rollout(StaticSolver(scene), frames, save_every=1, memory=self.memory, **options)
        substeps = -(-self.steps // frames)
        solver = self.solver(scene.replace(precision=self.precision), dt=self.duration / frames, substeps=substeps)
        return Rollout(solver, frames, save_every=1, memory=self.memory, **options)

    def __str__(self) -> str:
        how = f"dt={self.dt:.4g}), {self.steps} steps" if self.duration else f"load_steps={self.steps})"
        how = f"{self.solver.__name__}(scene, {how}, precision {self.precision}"
        kept = f"{self.megabytes:.3g} MB" if self.gradients else "no states"
        lines = [f"{how}, element {self.element}" + (f", Rollout(..., memory={self.memory:g})" if self.memory else "")]
        error = f"error {self.error:.2g} of {self.scale}"
        lines.append(f"expect: {self.seconds:.3g} s of wall time, {kept} kept, {error}")
        lines += [f"- {line}" for line in self.reasons]
        lines += [f"- elements: {'; '.join(map(str, self.elements))}, of the mesh alone"] if self.elements else []
        lines += [f"- beside it: {other}" for other in self.alternatives]
        return "\n".join([*lines, "left out: " + "; ".join(self.left_out)])

    __repr__ = __str__


SAFETY = 0.7  # of the tolerance: what a trial run must keep, for the error of the whole run is predicted
SHARE = 0.8  # of the stable step at the start, which may fall on the way


class Trials:
    """Trial runs of a scene: a reference, then each solver at the steps that its order of convergence suggests."""

    def __init__(
        self,
        scene: Scene,
        duration: float,
        tolerance: float,
        memory: float | None,
        gradients: bool,
        budget: float,
        frames: int,
        quantity: Quantity,
    ):
        self.scene, self.duration, self.tolerance, self.frames = scene, duration, tolerance, frames
        self.memory, self.gradients, self.budget, self.quantity = memory, gradients, budget, quantity
        self.stable = stable_dt(scene).dt
        self.tried: list[Option] = []
        self.notes: list[str] = []
        self.spent = 0.0  # [s] of the trials, compile time apart
        self.elements: list[ElementTrial] = []
        self.coarser: TetrahedralMesh | None = None  # to try ten nodes on
        self._find_reference()

    def _find_reference(self) -> None:
        """Converged motion in float64 over `self.span`: by velocity Verlet, over all of the duration if a tenth of the
        budget allows; else by implicit steps over all of it; else, where these do not converge, by velocity Verlet over
        the first part.
        """
        k = int(np.ceil(self.duration / self.frames / (SHARE * self.stable)))
        self.explicit_cost = self._seconds_per_substep()
        seconds = self.explicit_cost * k * self.frames
        self.span, part = self.duration, min(1.0, 0.1 * self.budget / max(3 * seconds, 1e-9))
        self.problem = replace(Problem.of_scene(self.scene, self.span), frames=self.frames)
        if part < 1 and self._converge(BDF2Solver, 1, 0.5 * self.budget):
            self.reference_by = BDF2Solver
            return
        self.span, self.reference_by = part * self.duration, VelocityVerletSolver
        self.problem = replace(Problem.of_scene(self.scene, self.span), frames=self.frames)
        if not self._converge(VelocityVerletSolver, max(1, int(np.ceil(k * part)))):
            raise FloatingPointError(
                f"the motion does not converge: with ever more steps in {self.span:.3g} s the last halving still changed it "
                f"by {self.own_error:.1g} of {self.quantity.scale}; shorten the duration"
            )

    def _converge(self, kind, k: int, limit: float = np.inf) -> bool:
        """Halve the steps of a second-order solver, from k per frame, until two agree to a tenth of the tolerance; the
        reference is extrapolated from them, its error is their distance from it. False if that takes more than `limit` [s].
        """
        coarse, self.own_error, begin = None, np.nan, None
        for _ in range(8):
            try:
                fine = self._motion(kind, "f64", k)[0]
            except FloatingPointError:  # the stable step falls on the way, or Newton's method does not converge
                fine = None
            if coarse is not None and fine is not None:
                self.reference = fine + (fine - coarse) / 3
                self.own_error = distance(self.problem, fine, self.reference)
                if self.own_error < 0.1 * self.tolerance:
                    return True
            begin = begin or time.perf_counter()  # the first run compiles
            if time.perf_counter() - begin > limit:
                return False
            coarse, k = fine, 2 * k
        return False

    def _seconds_per_substep(self) -> float:
        """Wall time of a substep of velocity Verlet [s], the cost of starting a run taken off."""
        times = []
        for substeps in (40, 400):
            rollout = self.rollout(VelocityVerletSolver, "f64", substeps, frames=1, span=0.1 * substeps * self.stable)
            rollout.forward()
            begin = time.perf_counter()
            rollout.forward()
            times.append(time.perf_counter() - begin)
        return max((times[1] - times[0]) / 360, 0.1 * times[1] / 400)

    def rollout(self, kind, precision, substeps, scene=None, frames=None, span=None, **how) -> Rollout:
        """Of the scene in that precision, or of another one."""
        frames, span, scene = frames or self.frames, span or self.span, scene or self.scene.replace(precision=precision)
        solver = kind(scene, dt=span / frames, substeps=substeps, **how)
        return self.quantity.rollout(solver, frames, memory=self.memory)

    def _motion(self, kind, precision, substeps, timed: bool = False):
        """(what errors are of, wall time [s], `timed`, with the gradient if one is wanted)."""
        rollout = self.rollout(kind, precision, substeps)
        moved = self.quantity.of(rollout, rollout.forward())
        if not timed:
            return moved, np.nan
        self.time(rollout)  # compiles
        seconds = self.time(rollout)
        self.spent += 3 * seconds
        return moved, seconds

    def time(self, rollout) -> float:
        """Wall time of a run [s], with its gradient if one is wanted."""
        return self.quantity.time(rollout, self.gradients)

    def error(self, moved) -> float:
        return distance(self.problem, moved, self.reference)

    def _compare(self, rounds: int = 5) -> None:
        """Time the good options that are near the best once more, back to back, for the machine may have been busy."""
        best = self._best()
        good = [o for o in self.tried if o.error <= SAFETY * self.tolerance]
        near = [o for o in good if o.seconds < max(12 * best.seconds, 1e-3 * self.budget)]
        rollouts = [self.rollout(o.solver, o.precision, o.substeps) for o in near]
        times, longer = [[] for _ in near], self.duration / self.span
        for _ in range(rounds):
            for k, (option, rollout) in enumerate(zip(near, rollouts)):
                if not times[k] or option.seconds / longer < 0.02 * self.budget:
                    times[k].append(self.time(rollout))
        for option, seconds in zip(near, times):
            option.seconds = longer * min(seconds[1:] or seconds)

    def _try(self, kind, precision, substeps) -> Option:
        """Run an option over the span; its error and time are carried on to the whole duration."""
        longer = self.duration / self.span
        total = int(np.ceil(substeps * self.frames * longer))
        option = Option(kind, precision, self.duration / total, total, substeps=substeps)
        try:
            moved, seconds = self._motion(kind, precision, substeps, timed=True)
            option.error = self.error(moved) * longer
            option.seconds = seconds * longer
        except FloatingPointError as error:
            self.notes.append(f"{option.label}: {type(error).__name__}")
        self.tried.append(option)
        return option

    def run(self, elements: bool, executor: Executor | None = None) -> None:
        """Try every solver, and kinds of elements, each by itself where there is an executor; then time the best again."""
        first = max(1, int(np.ceil(self.span / self.frames / (SHARE * self.stable))))
        other = lambda kind: (kind.explicit != self.reference_by.explicit, kind is not BDF2Solver)  # noqa: E731
        kinds = sorted(SOLVERS, key=other)
        if executor is None:
            self.solvers(kinds, first)
        else:
            calls = [(self, [kind], first) for kind in kinds] + [(self, [], first)] * elements
            for tried, notes, compared in each(executor, _apart, calls):
                self.tried += tried
                self.notes += notes
                self.elements += compared
        if self._best() is not None:
            self._compare()
        if elements and executor is None:
            self.compare_elements()

    def solvers(self, kinds: list, first: int) -> None:
        """Every solver from its largest step to one that meets the tolerance; first the kind that made the reference.

        Explicit ones in float32, then in float64 at the same step, which costs little more on small meshes; implicit ones
        in float32, and in float64 where finer steps do not help.
        """
        for kind in kinds:
            stuck = self._refine(kind, "f32", first if kind.explicit else 1)
            if not kind.explicit and stuck:
                self._refine(kind, "f64", 1)
        for kind in [kind for kind in SOLVERS if kind.explicit]:
            known = [o for o in self.tried if o.solver is kind and np.isfinite(o.error)]
            if known and not self._too_dear(kind, "f64", known[-1].substeps):
                self._try(kind, "f64", min(known, key=lambda o: o.error).substeps)

    def _refine(self, kind, precision: str, substeps: int) -> bool:
        """Try ever more substeps a frame, as many as the order of convergence suggests, until the tolerance is met or
        that is too dear; whether it got stuck, a finer step being no better (rounding, or the solver's tolerance)."""
        before = np.inf
        for _ in range(5):
            if self._too_dear(kind, precision, substeps):
                return False
            option = self._try(kind, precision, substeps)
            if option.error <= SAFETY * self.tolerance:
                return False
            if option.error > 0.9 * before:
                return True
            before = np.fmin(option.error, before)
            finer = (option.error / (0.5 * self.tolerance)) ** (1 / kind.order) if np.isfinite(option.error) else 4
            substeps = int(np.ceil(substeps * np.clip(finer, 1.3, 16)))
        return True

    def _too_dear(self, kind, precision: str, substeps: int) -> bool:
        """Whether a trial would take longer than twelve times the best so far, or than the budget's rest."""
        best = self._best()
        known = [o for o in self.tried if o.solver is kind and np.isfinite(o.seconds)]
        if not known and not kind.explicit:
            return self.spent > self.budget
        longer = self.duration / self.span
        guess = self.explicit_cost * self.frames * longer * (3 if self.gradients else 1)
        seconds = substeps * min((o.seconds / o.substeps for o in known), default=guess)
        trial, dearer = 3 * seconds / longer, best is not None and seconds > 12 * best.seconds
        if dearer or (self.spent + trial > self.budget and (known or best is not None)):
            step = self.span / self.frames / substeps
            self.notes.append(f"{kind.__name__} with a step of {step:.3g} s, {precision}, was not tried: too dear")
            return True
        return False

    def compare_elements(self) -> None:
        """Try the kinds of elements over the span of the reference."""
        asked = self.span, self.frames, 0.5 * self.budget, self.coarser, self.quantity
        compared = ElementTrials(self.scene, *asked)
        try:
            self.elements = compared.run()
        except FloatingPointError as error:
            self.notes.append(f"elements were not compared: {type(error).__name__}")
        self.notes += compared.notes

    def _best(self) -> Option | None:
        good = [o for o in self.tried if o.error <= SAFETY * self.tolerance]
        return min(good, key=lambda o: o.seconds, default=None)

    # ---- what follows from it -------------------------------------------------------------------------------------------

    def advice(self) -> Recommendation:
        """The cheapest option that met the tolerance, in words as well."""
        best = self._best()
        if best is None:
            closest = min(self.tried, key=lambda o: np.nan_to_num(o.error, nan=np.inf))
            raise FloatingPointError(
                f"nothing tried meets a tolerance of {self.tolerance:g}: the closest is {closest.label} with an error of "
                f"{closest.error:.2g}; loosen the tolerance, raise budget= ({self.budget:g} s), or shorten the duration"
            )
        others, why = alternatives(self, best)
        self.notes += why
        k = -(-best.steps // self.frames)
        solver = best.solver(self.scene.replace(precision=best.precision), dt=self.duration / self.frames, substeps=k)
        plan = Rollout(solver, self.frames, memory=self.memory)
        asked, megabytes = (self.duration, self.gradients, self.memory), plan.memory if self.gradients else 0.0
        said = advised(self.elements, self.tolerance, self.scene), self._reasons(best, plan), self._left_out(best)
        error = max(best.error, self.own_error)
        more = self.tried, self.elements, others, self.quantity.scale
        return Recommendation(best, *asked, megabytes, error, *said, *more)

    def _reasons(self, best, plan) -> list[str]:
        others = {}
        for o in self.tried:
            if o.solver is not best.solver and o.error <= SAFETY * self.tolerance:
                others[o.solver.__name__] = min(others.get(o.solver.__name__, np.inf), o.seconds / best.seconds)
        beaten = ", ".join(
            f"{name} {times:.1f} times as long" for name, times in sorted(others.items(), key=lambda x: x[1])
        )
        share = best.substep / self.stable
        of = "of the stable step" if best.solver.explicit else "times the explicit limit"
        limit = f"its step is {share:.2g} {of} {self.stable:.3g} s"
        kept = plan.checkpoints
        again = "each step runs once more in the reverse sweep" if kept.num_segments > 1 else "all steps are kept"
        accuracy = f"error {best.error:.2g} against a converged run (itself good to {self.own_error:.1g})"
        memory = f"{plan.memory:.3g} MB in {kept.num_segments} segments, {again}"
        return [
            f"accuracy: {accuracy}, order {best.solver.order}; {limit}",
            f"time: {beaten or 'no other solver met the tolerance'}",
            f"memory: {memory if self.gradients else 'without gradients no state is kept'}",
        ]

    def _left_out(self, best) -> list[str]:
        out = []
        if best.precision == "f32":
            out.append("float64: float32's rounding stays below the tolerance")
        implicit = [o for o in self.tried if not o.solver.explicit and np.isfinite(o.error)]
        if best.solver.explicit and implicit:
            close = min(implicit, key=lambda o: o.error)
            times = close.seconds / best.seconds
            name = close.solver.__name__
            out.append(f"implicit solvers: {name} takes {times:.2g} times as long, error {close.error:.2g}")
        if self.scene.term(Drag) is None:
            out.append("damping: none in the scene")
        if not any(getattr(t, "acts_on_surface", False) for t in self.scene.terms):
            out.append("contact: none in the scene")
        if not any(x.is_load for x in self.scene.interactions) and self.scene.motion is None:
            out.append("forces and motion per step")
        nu = self.scene.largest_poissons_ratio()
        if nu > LOCKING_RATIO + 1e-12:
            if self.scene.volume == "tetrahedra":
                out.append(
                    f'nothing against locking, though nu = {nu:.4g}: volume="patches" of a Scene is advised, or ten-node '
                    "tetrahedra, mesh.quadratic()"
                )
        else:
            out.append(f"elements against locking: nu = {nu:.4g} is at most {LOCKING_RATIO}")
        return out + self.notes


def _apart(trials: Trials, kinds: list, first: int) -> tuple[list, list, list]:
    """(tried, notes, elements) of some solvers, or with none of the kinds of elements, in whichever process."""
    own = copy.copy(trials)
    own.tried, own.notes, own.elements = [], [], []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        if kinds:
            own.solvers(kinds, first)
        else:
            own.compare_elements()
    return own.tried, own.notes, own.elements


def _of_equilibrium(trials: ElementTrials, tolerance: float, memory: float | None, gradients: bool, elements: bool):
    """The cheapest precision and element of an equilibrium; trials: of its elements."""
    quantity, exact, tried = trials.quantity, None, []
    for precision, how in (("f64", dict(tolerance=1e-12)), ("f64", {}), ("f32", {})):
        rollout = quantity.rollout(StaticSolver(trials.scene.replace(precision=precision), **how), 1, memory=memory)
        value = quantity.of(rollout, rollout.forward())
        if exact is None:
            exact, size = value, max(float(np.linalg.norm(value, axis=-1).max()), np.finfo(float).tiny)
            continue
        quantity.time(rollout, gradients)  # compiles
        seconds, error = quantity.time(rollout, gradients), float(np.linalg.norm(value - exact, axis=-1).max()) / size
        tried.append(Option(StaticSolver, precision, 1.0, 1, error, seconds))
    best = min((o for o in tried if o.error <= SAFETY * tolerance), key=lambda o: o.seconds, default=None)
    if best is None:
        raise FloatingPointError(
            f"an equilibrium in float64 is off by {tried[0].error:.2g} for the solver's tolerance, and a tolerance of "
            f"{tolerance:g} is asked for; loosen it"
        )
    compared = trials.run() if elements else []
    megabytes = rollout.memory if gradients else 0.0
    others = ", ".join(
        f"{o.precision} {o.seconds:.2g} s with an error of {o.error:.2g}" for o in tried if o is not best
    )
    reasons = [f"accuracy: error {best.error:.2g} against a run in float64 to a tolerance of 1e-12", f"time: {others}"]
    said = advised(compared, tolerance, trials.scene), reasons, trials.notes or ["nothing"]
    asked = 0.0, gradients, memory, megabytes, best.error
    return Recommendation(best, *asked, *said, tried, compared, scale=quantity.scale)


@public
def recommend(
    scene: Scene,
    duration: float,
    tolerance: float = 1e-2,
    memory: float | None = None,
    gradients: bool = True,
    budget: float = 20.0,
    frames: int = 8,
    elements: bool = True,
    coarser: TetrahedralMesh | None = None,
    executor: Executor | None = None,
    output: Output | None = None,
    weights: ArrayLike | Callable | None = None,
) -> Recommendation:
    """The cheapest way to run `scene` for `duration` [s], 0 of its equilibrium, with a relative error below `tolerance`.

    The error meant is that of steps and precision on the scene's own mesh: the largest distance of any vertex at any of
    `frames` times over the largest displacement from the start. With an `output` it is that of a number, over how far this
    changes: weights are as of `Rollout.accuracy`. memory [MB]: most that gradients may keep.
    gradients: whether runs will be differentiated, which is then timed as well.
    budget [s]: wall time of the trials, compiling apart; if the reference of the whole duration would take more, trials
    cover a first part and errors grow with time from there.
    elements: whether linear tetrahedra, patches and ten nodes are compared too, by what the mesh itself makes wrong; the
    advice's `element` is the cheapest that keeps to the tolerance. That of a number is what `Rollout.accuracy` says of it in
    equilibria and steps of BDF2; where that has doubts, which `left_out` names, and of motions, runs of all kinds are
    compared with one of the finest elements. coarser: a linear mesh of the body with the same
    named sets, to try ten nodes on; None: half the cells of a mesh that `create_box` made.
    executor: any `concurrent.futures.Executor`, which takes a solver at a time, each with the budget, and the elements;
    those near the best are timed again here.

    Raises ValueError for a duration or tolerance that is no such thing and for scenes with robots, FloatingPointError if
    nothing meets the tolerance.
    """
    if scene.terms_of(Robot):
        raise ValueError("recommend takes no robots: compare Rollouts of ImplicitEulerSolver and explicit solvers")
    at_rest = np.array_equal(duration, 0)
    duration = 0.0 if at_rest else number("duration, if not 0 for an equilibrium,", duration, unit="s")
    budget, frames = number("budget", budget, unit="s"), whole("frames", frames, 1)
    if output is None and weights is not None:
        raise ValueError("weights are of a number of an output: pass output=, such as MaterialPoints([[0, 0, 0]])")
    if output is not None:
        instance("recommend", "output", output, Output, "an output, such as MaterialPoints([[0, 0, 0]])")
    quantity = Quantity(output, weights)
    tolerance = between("tolerance", tolerance, 0, 1, ends=False)
    memory = None if memory is None else number("memory", memory, unit="MB")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of trials with coarse steps, whose errors are measured
        if not duration:
            trials = ElementTrials(scene, 0.0, 1, 0.5 * budget, coarser, quantity)
            return _of_equilibrium(trials, tolerance, memory, gradients, elements)
        trials = Trials(scene, duration, tolerance, memory, gradients, budget, frames, quantity)
        trials.coarser = coarser
        trials.run(elements, executor)
    return trials.advice()
