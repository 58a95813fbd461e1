"""A scene run forward, frame by frame, with a step that follows the state, and written to files."""

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.common import interrupts
from diffsim_ti.common.progress import progress
from diffsim_ti.mechanics.loads.interaction import DeadLoads
from diffsim_ti.mechanics.surfaces.surface_pairs import Overlap
from diffsim_ti.monitor.quantities import Energy
from diffsim_ti.monitor.stability import lanczos_limit
from diffsim_ti.obstacles import link_rows
from diffsim_ti.outputs import Output
from diffsim_ti.rollout.simulator import Simulator
from diffsim_ti.scene import Scene
from diffsim_ti.scene.strength import check_strength
from diffsim_ti.solvers import ImplicitEulerSolver
from diffsim_ti.solvers.solver import Solver
from diffsim_ti.terms import ExternalForce, Gravity, Obstacle, Robot
from diffsim_ti.visual.frame import Frame, Setting
from diffsim_ti.writers import Writer, writer_for

SHARE = 0.8  # of the stable step, which explicit steps take
IN_A_WIDTH = {"stage": 4, "force": 10}  # steps that a vertex takes through a barrier at least, by the kind of contact
SQUEEZED = 0.1  # J below which the stable step, which changes fastest there, is looked up after each part of a frame
# by the order of the method, as shares of the largest kinetic energy: what energy may rise by in a part, which is a passing
# error within an oscillation; and once it is a third share above its lowest
ENERGY_RISE = {1: (0.01, 0.001, 0.03), 2: (0.002, 5e-5, 0.004)}


class Interrupted(Exception):
    """Ctrl-C ended a run; says where, and what is written."""


@dataclass
class Seen:
    """The extremes of a run: smallest J and gap [m], most tetrahedra inside-out and vertices in an obstacle at once."""

    J: float = np.inf
    gap: float = np.inf
    inverted: int = 0
    implicit_parts: int = 0  # done by implicit Euler, where no explicit step tried held
    crossed: int = 0
    substeps: list[int] = field(default_factory=list)  # per frame
    retries: list[str] = field(default_factory=list)
    shortest: float = np.inf  # substep [s]
    longest: float = 0.0
    seconds: float = 0.0


class ForwardRun:
    """Frames of equal length; the substeps of each follow the stable step of the state, unless `dt` is given.

    A frame has 16 parts, after each of which the state is checked. One that diverges, outgrows its step or gains energy is
    run again from its start with twice the substeps, and that is counted; where that helps no more, implicit Euler does the
    part, and that is said. With an implicit solver a frame has 4 parts, whose steps are halved only where one does not
    converge or gains energy. With dt nothing is chosen and nothing repeated: what goes wrong is an error.

    Raises ValueError for a body that no step saves (strength.py), naming what would.

    outputs: what frames shall have besides, such as Reaction(per_vertex=True); contact forces are those of the last part.
    driven: whether something outside may add energy, which is then no sign of a bad step. before_part: called before each
    part, for instance to change forces.
    """

    parts, attempts = 16, 7  # per frame; per part

    def __init__(
        self,
        scene: Scene,
        solver_class: type[Solver],
        frame_time: float,
        dt: float | None = None,
        outputs: Sequence[Output] = (),
        **options,
    ):
        check_strength(scene)
        self.scene, self.seen, self.adapts = scene, Seen(), dt is None
        given = any(x.is_load and not isinstance(x, DeadLoads) for x in scene.interactions)
        self.driven = scene.motion is not None or bool(scene.moving or scene.terms_of(Robot)) or given
        self.before_part: Callable[[], object] | None = None
        self.obstacles = tuple(t for t in scene.terms if isinstance(t, Obstacle))
        gravity = scene.term(Gravity)
        self._pull = float(np.linalg.norm(gravity.values["gravity"])) if gravity else 0.0
        self.implicit = not solver_class.explicit
        if dt is None:
            self.parts, unchecked = (4, {}) if self.implicit else (self.parts, dict(check_start=False))
            solver = solver_class(scene, dt=frame_time / self.parts, **unchecked, **options)
        else:
            if not dt > 0:
                raise ValueError(f"--dt must be > 0 [s], got {dt:g}")
            steps = max(1, round(frame_time / dt))
            self.parts = max(p for p in range(1, self.parts + 1) if steps % p == 0)  # dt and the time stay as asked
            steps //= self.parts
            solver = solver_class(scene, dt=steps * dt, substeps=steps, **options)
        self.outputs = tuple(outputs)
        reads = {output.reads_contact_forces for output in self.outputs}
        self._noted = dict(contact_forces=True in reads or "surfaces" in reads and "surfaces")
        self.simulator = self._last = Simulator(solver, **self._noted)
        self.frame_time = self.parts * solver.dt
        ws = self.simulator.workspace
        self._balance = ws.balance()
        # [J], the steps' own (monitor/energy_balance.py)
        self.drift: float | None = None if self._balance is None else 0.0
        self._start = ws.history(1)
        ws.save(self._start, 0)
        ws.advance(0, 1, solver.num_passes(1))  # compiles
        ws.restore(self._start, 0)
        self._begin_balance()
        self._limit = self._stable_dt()
        self._energy, self._refined = self.simulator.compute_energy(), 0
        self._lowest, self._begun, self._squeezed, self._implicit = self._energy, self._energy, False, None
        self.energies, self.largest_energy = [self._energy], self._moving(self._energy)
        self._fastest = self.largest_energy  # of what moves, by its kinetic energy: what strains and falls can set free

    @property
    def first_substep(self) -> float:
        """Length of the first substep to come [s]."""
        dt = self.simulator.solver.dt
        return dt / self._choose_substeps() if self.adapts else self.simulator.solver.substep

    def _begin_balance(self) -> None:
        if self._balance:
            self._balance.begin()

    def restart_balance(self) -> None:
        """Measure the rise and drift of energy from the present state on, which something outside has changed."""
        self._begin_balance()
        self._energy = self._lowest = self._begun = self.simulator.compute_energy()
        self.largest_energy = max(self.largest_energy, self._moving(self._energy))
        self._fastest = max(self._fastest, self._moving(self._energy))

    def advance(self) -> None:
        """One frame. Raises FloatingPointError if no number of substeps tried keeps it stable."""
        begin = time.perf_counter()
        self.seen.substeps.append(0)
        for part in range(self.parts):
            if self.before_part is not None:
                self.before_part()
            self._last = self.simulator
            if self.adapts:
                self._advance_part(last=part == self.parts - 1)
            else:
                self.simulator.step()
            if self.drift is not None:
                self.drift += self._balance.take()
            self._check()
        self.energies.append(self._energy)
        self.seen.seconds += time.perf_counter() - begin

    def frame(self) -> Frame:
        """The present moment, with the outputs."""
        return Frame.of(self.simulator, self.outputs, self._last)

    def _advance_part(self, last: bool) -> None:
        sim, first = self.simulator, self.simulator.step_count
        substeps = max(self._choose_substeps(), self._refined)
        sim.workspace.save(self._start, 0)
        rises = []
        for tried in range(self.attempts):
            sim.set_substeps(substeps)
            try:
                sim.step()
                why = self._complaint(last or self._squeezed)
            except FloatingPointError as error:
                why = str(error)
            if why is None:
                self._refined = substeps if tried else self._refined // 2
                return
            self.seen.retries.append(f"t = {first * sim.solver.dt:.4g} s, substep {sim.solver.substep:.3g} s: {why}")
            if sim.step_count > first and self._is_rounding(rises):
                self.seen.retries[-1] += "; shorter ones do not lower that, and the energy is below that of the start"
                return
            sim.workspace.restore(self._start, 0)
            self._begin_balance()
            sim.step_count = first
            substeps *= 2
        if self.implicit or not self._advance_part_implicitly(why):
            raise FloatingPointError(
                f"t = {sim.time:.4g} s: unstable even with a substep of {sim.solver.substep:.3g} s ({why}); lower the "
                "impact or the load, raise the stiffness, or add --drag; the frames before are written"
            )

    def _advance_part_implicitly(self, why: str) -> bool:
        """The part by implicit Euler, where no explicit step tried holds; whether that could be done."""
        sim = self.simulator
        if self.scene.law.in_steps().reads != ("H",):  # what implicit solvers do not know
            return False
        if self._implicit is None:
            self._implicit = Simulator(ImplicitEulerSolver(self.scene, dt=sim.solver.dt), **self._noted)
            self._implicit.workspace.balance()
        other = self._implicit
        if self.scene.term(ExternalForce) is not None:
            runtime.fill(other.workspace.arrays.forces, runtime.fetch(sim.workspace.arrays.forces))
        for substeps in (1, 4, 16, 64):
            other.set_substeps(substeps)
            other.step_count = sim.step_count
            try:
                hand_on(sim, other)
                watch = other.workspace.energy_watch
                if watch:
                    watch.begin()
                other.step()
            except (FloatingPointError, Overlap):
                continue
            self.seen.implicit_parts += 1
            self.seen.retries.append(f"t = {sim.time:.4g} s: {why}; this part by {substeps} steps of implicit Euler")
            hand_on(other, sim)
            self._begin_balance()
            self.drift = None if self.drift is None or watch is None else self.drift + watch.take()
            sim.step_count += 1
            self._last = other
            self._limit = self._stable_dt()
            return True
        return False

    def _check(self) -> None:
        """Note the extremes of the present state."""
        sim, seen = self.simulator, self.seen
        J = sim.tetrahedron_fields().J
        self._squeezed = J.min() < SQUEEZED
        seen.J, seen.inverted = min(seen.J, float(J.min())), max(seen.inverted, int((J <= 0).sum()))
        self._check_gaps()
        seen.substeps[-1] += sim.solver.substeps
        seen.shortest = min(seen.shortest, sim.solver.substep)
        seen.longest = max(seen.longest, sim.solver.substep)
        self._energy = sim.compute_energy()
        self._lowest, self._fastest = min(self._lowest, self._energy), max(self._fastest, self._energy.parts["kinetic"])
        self.largest_energy = max(self.largest_energy, self._moving(self._energy))

    def _check_gaps(self) -> None:
        sim, seen, offsets = self.simulator, self.seen, self.scene.places(self.simulator.time)
        links = link_rows(self.scene, sim.joint_states)
        positions, crossed = sim.positions[self.scene.mesh.surface_vertices], 0
        for term in self.obstacles:
            gap = term.gap(positions, links.get(term.name, offsets.get(term, np.zeros(3))))
            seen.gap, crossed = min(seen.gap, float(gap.min())), crossed + int((gap < 0).sum())
        seen.crossed = max(seen.crossed, crossed)
        seen.gap = min(seen.gap, sim.contact_resolution.smallest_gap)  # of all substeps

    def _complaint(self, look_up: bool) -> str | None:
        """Why the part that was just run cannot be trusted, or None; `look_up`: find the stable step at its end."""
        energy, h = self.simulator.compute_energy(), self.simulator.solver.substep
        rise, scale = energy - self._energy, max(self._fastest, energy.parts["kinetic"])
        part, later, drift = ENERGY_RISE[1 if self.implicit else self.simulator.solver.order]
        if not self.driven and not rise <= (later if energy - self._lowest > drift * scale else part) * scale:
            return f"the energy rose by {rise:.3g} J"
        if not look_up:
            return None
        try:
            self._limit = self._stable_dt()
        except RuntimeError as error:
            return f"no stable step was found at the end ({error})"
        return f"the stable step fell to {self._limit:.3g} s" if h > self._limit else None

    def _is_rounding(self, rises: list[float]) -> bool:
        """Whether what the energy rises by is no matter of an implicit step's length, and nothing is gained on the whole.

        rises: of the tries before, to which that of the part that was just run is added. An error of the steps falls by a
        factor of four or more with each halving."""
        energy = self.simulator.compute_energy()
        rises.append(energy - self._energy)
        return self.implicit and len(rises) > 2 and rises[-1] > 0.5 * rises[-3] and energy < self._begun

    def _stable_dt(self) -> float:
        return lanczos_limit(self.simulator.workspace, 1e-2).dt if self.adapts and not self.implicit else np.inf

    def _choose_substeps(self) -> int:
        dt = self.simulator.solver.dt
        fewest = dt / (SHARE * self._limit)
        if self.obstacles and not self.implicit:  # a vertex shall not cross the barrier in a few substeps
            speed = np.linalg.norm(self.simulator.velocities, axis=1).max() + self._pull * self.frame_time
            now, then = (self.scene.places(self.simulator.time + step) for step in (0.0, dt))
            positions = self.simulator.positions
            speed += max((t.way(positions, now[t], then[t]) / dt for t in now), default=0.0)
            in_a_width = IN_A_WIDTH[self.simulator.solver.contact]
            width = min(float(t.values["barrier_width"]) for t in self.obstacles)
            fewest = max(fewest, in_a_width * speed * dt / width)
        return max(1, int(np.ceil(fewest)))

    @staticmethod
    def _moving(energy: Energy) -> float:
        return sum(value for name, value in energy.parts.items() if name != "gravity")


def hand_on(source: Simulator, target: Simulator) -> None:
    """Bring the state of one simulator to another of the same scene, bit by bit, with what the law remembers."""
    source.workspace.state.copy(0, target.workspace.state, 0)
    target.workspace.forget()


def run_and_write(
    run: ForwardRun,
    frames: int,
    output: str | Path | Writer | Sequence[str | Path | Writer],
    name: str = "frames",
    keep: Sequence[int] = (),
) -> tuple[float, list[str], list[Frame]]:
    """Run `frames` frames and write them, and the start, to one output or to several at once.

    output: a file, whose suffix says the format, a folder, which gets the series `name`.pvd, or a `Writer`.
    Returns seconds of writing, what was written, and the frames numbered in `keep`.
    Raises ValueError for a suffix that is not known, Interrupted on Ctrl-C; what was run before any error is written.
    """
    outputs = [output] if isinstance(output, str | Path | Writer) else output
    writers = [o if isinstance(o, Writer) else writer_for(file_in(o, f"{name}.pvd")) for o in outputs]
    setting, kept, begin = Setting.of(run.scene), [], time.perf_counter()
    with progress("simulating", frames) as show, ExitStack() as opened:
        for writer in writers:
            writer.open(setting)
            opened.enter_context(writer)
        writing = time.perf_counter() - begin
        for k in range(frames + 1):
            try:
                interrupts.check()
                if k:
                    run.advance()
                begin = time.perf_counter()
                frame = run.frame()
                for writer in writers:
                    writer.write(frame)
                writing += time.perf_counter() - begin
            except KeyboardInterrupt:
                said = f"interrupted at t = {run.simulator.time:.4g} s; {k} frames are in "
                raise Interrupted(said + ", ".join(str(writer.path) for writer in writers)) from None
            if k in keep:
                kept.append(frame)
            show(k, f"t = {frame.time:.3f} s")
        begin = time.perf_counter()
    writing += time.perf_counter() - begin
    return writing, [writer.describe() for writer in writers], kept


def file_in(output: str | Path, name: str) -> Path:
    """The output itself, or where it is a folder, which has no suffix or is there, the file of that name in it."""
    output = Path(output)
    return output / name if not output.suffix or output.is_dir() else output
