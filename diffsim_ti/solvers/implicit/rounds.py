"""The rounds of Newton's method: kernels that decide what comes next, and what the host does between them."""

import weakref
from collections.abc import Callable
from contextlib import nullcontext

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.inputs import ConsistentMass, diagonal_of
from diffsim_ti.mechanics.supports.free import FreeBodies, FreeDirections
from diffsim_ti.runtime import Repeated, kernels_of, runs_on_cpu
from diffsim_ti.solvers.implicit import newton_kernels as nk
from diffsim_ti.solvers.implicit.cg_kernels import COUNT, LEAST, LIMIT, ROOM, SQUARE, STOPPED
from diffsim_ti.solvers.implicit.newton_kernels import NewtonKernels


class Rounds:
    """Takes the rounds of a `Newton` with a preconditioner.

    A round is a launch for a trial of the line search and the residual of what is taken, some for the preconditioner, and
    those of conjugate gradients; of small bodies on the processor they are one kernel, and a solve is a launch or few. What
    comes next is a number on the device, `PHASE`; of what crosses to the host there are a few numbers a round.

    The host solves where something is unusual in a linear system (`Newton.step`), and takes part between the launches where
    there is something `beside` the kernels: pairs of surfaces, of which it keeps the list, forces of its own, masses that
    are no diagonal, volumes, joints of robots, sets that move by few numbers. It adds energies and work, and says R.
    """

    small, many = 300, 200  # vertices up to which a solve on one thread is one kernel; phases in a launch of it
    short = 600  # variables of a law's longest kernel up to which one kernel of all compiles soon
    most_rounds = 64  # before the host looks at their residuals

    def __init__(self, newton, preconditioner):
        potential, detection = newton.potential, newton.detection
        self.potential, self.detection = potential, detection
        self.preconditioner = weakref.proxy(preconditioner)  # which holds this: no circle
        self.cg, a, n = preconditioner.solver, potential.arrays, potential.arrays.num_vertices
        cg, points, free = self.cg, potential.J.shape[0], preconditioner.free
        reduced, consistent = isinstance(free, FreeBodies), isinstance(newton.mass, ConsistentMass)
        by_host = newton.others or potential.joints or reduced
        self.beside = beside = bool(by_host or potential.pairs or potential.hosts or consistent)
        known = len(potential.hosts.matrices(potential.held_at)) == len(potential.hosts)
        self.solves_on_host = bool(by_host) or not known
        self.contact = contact = bool(a.contacts or potential.pairs or potential.hosts)
        kernels = kernels_of(
            NewtonKernels, a.precision, cg.precision, cg.parallel, isinstance(free, FreeDirections), contact, beside
        )
        fp, vector = runtime.PRECISIONS[cg.precision], runtime.array_types(cg.precision)["vectors"].dtype
        self.u, self.d, self.R, self.inertial, self.loads = (runtime.array(vector, n) for _ in range(5))
        self.far, self.stiffness, self.history = (runtime.array(fp, k) for k in (n, n, self.most_rounds + 1))
        self.J, self._filled = runtime.array(a.fp, points), {}
        self.sizes = dict(chunks=cg.chunks, length=cg.length, nodes=n, count=detection.count)
        self.sizes |= dict(points=points, points_length=-(-points // cg.chunks))
        way, barriers = (detection.way, potential.barriers) if contact else (None, None)
        own = dict(cg=cg, at=potential, newton=(self, way), out=detection.found, barriers=barriers)
        of_potential = dict(scene=a, pass_=potential, at=potential, out=potential)
        tries, judges, updates, solves = kernels.wanted
        direction, residual = [(kernels.direction, own)], []
        if a.contacts and not potential.joints:
            of_way = dict(scene=a, way=way, at=potential, out=detection.found)
            direction += [(detection.kernels.shares, of_way), (kernels.bound, own)]
        if not beside:
            residual.append((potential.kernels.forces, of_potential))
            if contact:
                residual.append((potential.kernels.contact_blocks, of_potential | dict(out=barriers)))
        compare = [(potential.kernels.energy, of_potential), (kernels.choose, own)]
        steps = direction, [(kernels.move, own)], compare, residual, [(kernels.judge, own)]
        steps = [[(*part, None) for part in group] for group in steps]
        groups = [[(tries, own, None), *sum(steps[:3], [])], [(judges, own, None), *sum(steps[3:], [])]]
        update, hard = ([], None) if beside else preconditioner.updating()
        update = [*update, (kernels.ready, dict(cg=cg, body=hard), None)] if update else []
        self.whole = runs_on_cpu() and cg.is_one_kernel and not cg.parallel and n <= self.small and not beside
        self.whole &= potential.kernels.blocks.variables <= self.short
        self._always, self._update = self.sizes | dict(kept=detection.kept), self._in_turn(update)
        if self.whole:
            groups += [[(updates, own, None), *update]] if update else []
            groups.append([(solves, own, None), *cg.parts(False, potential.multiplying())[1:]])
        self._trial = self._residual = self._steps = self._more = None
        if self.whole:
            self._trial = Repeated("newton", groups, cg.parallel, vectorized=True)
        elif beside or runs_on_cpu() or not cg.is_one_kernel:
            self._steps = [self._in_turn(group) for group in steps]
        else:
            self._trial, self._residual = (Repeated(f"newton{k}", [own], True) for k, own in enumerate(groups))
        if self.whole:
            launch, always = self._trial, self._always | dict(most=1.0)
            cg.serve(lambda times, rounding: launch(times, **always, **potential.sizes(), rounding=rounding))

    def _in_turn(self, parts: list) -> Callable | None:
        """Kernels that are launched one by one, as others launch them, so that they are compiled once."""
        in_vectors = self.potential.kernels.forces, self.potential.kernels.blocks
        bound = [
            (kernel.bind(kernel in in_vectors and self.potential.arrays.in_vectors, **records), own or {})
            for kernel, records, own in parts
        ]

        def launch(times: int, **numbers) -> None:
            for one, own in bound:
                one(**(numbers | own))

        return launch if parts else None

    # ---- what is solved ----------------------------------------------------------------------------------------------

    def _put(self, name: str, data: np.ndarray) -> None:
        """Set an array, unless it holds the same object's numbers."""
        if self._filled.get(name) is not data:
            runtime.fill(getattr(self, name), data)
            self._filled[name] = data

    def _begin(self, newton, phase: int) -> None:
        """Tell the device the problem of a solve, and that it begins where the potential stands."""
        self.state = state = np.zeros(ROOM)
        self.newton, self._base, self._direction = weakref.proxy(newton), self.potential.held_at, None
        self.cg.put_mass(newton.mass if isinstance(newton.mass, np.ndarray) else np.zeros((self.cg.nodes, 1)))
        self._put("inertial", newton.inertial)
        self._put("loads", newton.loads)
        runtime.fill(self.stiffness, newton.stiffness.ravel())
        if self.potential.arrays.contacts:
            self.detection.put(runtime.fetch(self.potential.poses)[::3])
        state[nk.TOLERANCE], state[nk.EPS], state[nk.INSIST] = newton.tolerance, newton.eps, newton.insist
        state[nk.SHORTEST], state[nk.UPRIGHT] = newton.shortest, -1
        state[nk.INEXACT], state[nk.ROUGHEST], state[nk.FRACTION] = newton.inexact, newton.rough, 1.0
        state[STOPPED], state[nk.PHASE], state[nk.RECOUNTS] = nk.WAITS, phase, bool(newton.volumes)

    # ---- rises of the potential --------------------------------------------------------------------------------------

    def stand(self, newton, u: np.ndarray) -> None:
        """Measure `rise` from u."""
        self.potential.place(u)
        self._begin(newton, nk.BASE)
        self._advance()
        self._based = self.state

    def rise(self, there: np.ndarray) -> float:
        """How much higher Phi is there; infinite where a tetrahedron changes its volume more than tenfold."""
        self.potential.place(there)
        self.state = self._based.copy()
        self.state[nk.PHASE] = nk.PROBE
        self._advance()
        return float(self.state[nk.RISE])

    # ---- a solve -----------------------------------------------------------------------------------------------------

    def start(self, newton, roughly: float) -> None:
        """Begin a solve where the potential stands; it also ends where R is `roughly` small."""
        self._begin(newton, nk.START)
        self.state[nk.ROUGHLY] = roughly

    def run(self, most: int) -> tuple[float, float, float, bool]:
        """(why they end: DONE, TROUBLE or MANY; |R|, what of it is rounding, whether R is small) after rounds until the
        report of Newton has so many residuals, and one more."""
        done, state = self.newton.report.residuals, self.state
        state[nk.ROUND], state[nk.MOST] = 0, min(max(most - len(done), 0), self.most_rounds)
        state[list(nk.COUNTED.values())] = 0
        state[LIMIT] = self._limit()
        self._advance()
        state, report = self.state, self.newton.report
        self.preconditioner.spent += int(state[nk.PRODUCTS])
        done += runtime.fetch(self.history)[: int(state[nk.ROUND])].tolist()
        for name, place in nk.COUNTED.items():
            setattr(report, name, getattr(report, name) + int(state[place]))
        self.newton.upright = state[nk.UPRIGHT] == 1
        return int(state[nk.PHASE]), float(state[nk.NORM]), float(state[nk.FLOOR]), state[nk.SOLVED] == 1

    def go_on(self) -> None:
        """With a round more than asked for."""
        self.state[nk.PHASE] = nk.UPDATE

    def go(self, direction: np.ndarray, R: np.ndarray) -> None:
        """Along a direction in which Phi falls though R is zero; R: of which it is as if it were Newton's."""
        self._take(direction, R, 0)
        self._direction = None  # along which volumes are as they are

    def stiffen(self) -> bool:
        """Begin again where no step along the last direction was taken, with stiffer chambers, if they may be so."""
        if self._direction is None:
            return False
        self.newton.recount(self._base, np.zeros_like(self._base), self._direction)
        if not self.newton.volumes.can_stiffen():
            return False
        self.potential.place(self._base)
        self.state[nk.PHASE], self.state[STOPPED] = nk.START, nk.WAITS
        return True

    def end(self) -> np.ndarray:
        """Where the last step that was taken has led, where the potential then stands."""
        if self.state[nk.PHASE] == nk.DONE:
            return self._here()
        return self.potential.place(runtime.fetch(self.u).astype(np.float64))

    # ---- rounds ------------------------------------------------------------------------------------------------------

    def _limit(self) -> int:
        """Products of a linear solve on the device; none where the host solves."""
        own, static = self.preconditioner, not diagonal_of(self.newton.mass).any()
        slow = own.given_up or static and own.spent > 2 * own.patience
        return 0 if self.solves_on_host or slow else min(10 * self.cg.nodes, own.patience)

    def _advance(self) -> None:
        """From one phase to the next until it is over."""
        cg, served, state = self.cg, False, self.state
        numbers = self._always | self.potential.sizes() | dict(rounding=10 * self.newton.eps)
        if state[nk.PHASE] == nk.START:
            self.preconditioner.follow(self.potential.held_at)
        runtime.fill(cg.state, state)
        while state[nk.PHASE] > nk.MANY:
            phase, solving = state[nk.PHASE], state[nk.PHASE] == nk.SOLVE and not state[STOPPED]
            if phase == nk.UPDATE and (served or not self._update):
                self.preconditioner.update(self._here())
                self._more = self._matrix() if self.beside and state[LIMIT] else None
                state[nk.PHASE], state[STOPPED], served = nk.SOLVE, 0, False
                runtime.fill(cg.state, state)
                continue
            if not self._is_going_well(state):
                self._solve()
                runtime.fill(cg.state, self.state)
                continue
            numbers["most"] = nk.LONGEST_STEP if state[nk.INDEFINITE] else 1.0
            # a card goes on before the host has looked, but not to conjugate gradients
            ahead = not (self.whole or self._steps) and nk.START <= phase and not solving
            if self.whole:
                self._trial(self.many, **numbers)
            elif solving:
                self._iterate()
            elif phase not in (nk.JUDGE, nk.UPDATE):
                self._try(numbers)
            if not self.whole and (phase == nk.JUDGE or ahead and phase != nk.UPDATE):
                self._judge(numbers)
            served = bool(self._update) and (self.whole or phase == nk.UPDATE or ahead)
            if served and not self.whole:
                if self._steps:
                    self.preconditioner.follow(self._here())
                self._update(1, **numbers)
            if self.whole or not solving:
                state = self.state = runtime.fetch(cg.state).astype(np.float64)
            elif state[STOPPED] == 1:
                cg.last = int(state[COUNT])
                self.preconditioner.learn(float(np.sqrt(state[SQUARE])), cg.last)
            if phase == nk.JUDGE and state[nk.ACCEPTED]:
                self._base = self.potential.held_at

    @staticmethod
    def _is_going_well(state: np.ndarray) -> bool:
        """Whether a linear solve is not at its limit, and has met no negative curvature and nothing that is not finite."""
        fails = state[STOPPED] in (2, 3) or not np.isfinite(state[SQUARE])
        fails = fails or (not state[STOPPED] and state[COUNT] >= state[LIMIT])
        return not (state[nk.PHASE] == nk.SOLVE and fails)

    def _here(self) -> np.ndarray:
        """The displacement on the device, of which the host is told."""
        self.potential.held_at = runtime.fetch_row(self.potential.u, 0)
        return self.potential.held_at

    # ---- linear solves -----------------------------------------------------------------------------------------------

    def _matrix(self):
        """What joins the Hessian of a round, for conjugate gradients."""
        mass, more, _ = self.newton.operator().on_device()
        self.cg.put_system(mass, more)
        return more

    def _iterate(self) -> None:
        """Conjugate gradients until they stop."""
        friction, more, state = self.potential.surface_friction, self._more is not None, self.state
        with friction.bounded(self.newton.turning) if friction else nullcontext():
            while not state[STOPPED] and self._is_going_well(state):
                self.cg.iterate(int(state[COUNT]), int(state[LIMIT]), self.newton.eps, more)
                state[:] = runtime.fetch(self.cg.state)

    def _solve(self) -> None:
        """The host's direction."""
        state, newton = self.state, self.newton
        R, forcing = runtime.fetch(self.R).astype(np.float64), float(np.sqrt(state[LEAST]))
        direction, R = newton.step(self._here(), R, forcing)
        early = len(newton.report.residuals) + state[nk.ROUND] <= newton.by_work
        self._take(direction, R, 0 if not newton.by_residual else nk.BY_WORK if early else nk.BY_RESIDUAL)

    def _take(self, direction: np.ndarray, R: np.ndarray, measure: int) -> None:
        """A direction that goes down by R is what a linear solve has found; measure: of what makes a step good."""
        state, self._direction = self.state, direction
        runtime.fill(self.cg.x, direction[None])
        runtime.fill(self.R, R)
        state[nk.PHASE], state[STOPPED], state[COUNT], state[SQUARE] = nk.SOLVE, 1, 0, 0
        state[nk.SCALE], state[nk.INDEFINITE], state[LIMIT] = 1.0, self.newton.indefinite, self._limit()
        state[nk.MEASURE], state[nk.TO_LOWER] = measure, np.linalg.norm(R)

    # ---- where kernels are launched in turn, with what the host has beside them --------------------------------------

    def _set(self, numbers: dict) -> None:
        """Numbers of the state, by their places."""
        state = runtime.fetch(self.cg.state)
        state[list(numbers)] = list(numbers.values())
        runtime.fill(self.cg.state, state)

    def _try(self, numbers: dict) -> None:
        """Energies of a trial, of a new direction or along the same."""
        if self._steps is None:
            return self._trial(1, **numbers)
        (direct, move, compare, *_), phase = self._steps, self.state[nk.PHASE]
        if phase == nk.SOLVE:
            direct(1, **numbers)
            if self.potential.pairs or (self.potential.joints and self.contact):
                self._shorten()
        move(1, **numbers)
        if self.beside:
            self._set(self._beside(phase))
        compare(1, **numbers)

    def _shorten(self) -> None:
        """Not farther along a new direction than to where surfaces meet, or links that give way."""
        potential, newton, u = self.potential, self.newton, self._base
        state, step = runtime.fetch(self.cg.state), runtime.fetch_row(self.detection.way.step, 0)
        share = longest = float(state[nk.LONGEST])
        if potential.joints:
            share = newton.collisions(u, step, longest)[0]
        if potential.pairs:
            share = min(share, potential.pairs.safe_share(u, step, share, placed=True))
        if potential.surface_friction:
            newton.turning = potential.surface_friction.turns(u, u + step)
        numbers = {nk.CUTS: state[nk.CUTS] + (share < 1 <= longest), nk.LONGEST: share, nk.FRACTION: min(1.0, share)}
        self._set(numbers | ({} if share > newton.shortest else {nk.PHASE: nk.TROUBLE}))

    def _beside(self, phase: int) -> dict:
        """What the host adds to the energies where something is tried, and to their change on the way there."""
        potential, newton, base = self.potential, self.newton, self._base
        moved, met = phase in (nk.SOLVE, nk.TRY), False
        if moved and newton.rigid:  # which may turn on another way than the step that was looked at
            there = newton.rigid.nearest(runtime.fetch_row(potential.u, 0))
            met = not newton.is_free(base, there - base)
            u = potential.place(there)
        else:
            u = potential.arrive(on_way=True) if moved else potential.held_at
        if newton.rigid and phase == nk.START:
            runtime.fill(self.far, runtime.fetch(self.far) + newton.rigid.rounding.ravel() / newton.eps)
        energies, change, step, mass = potential.energies_beside(), 0.0, u - base, newton.mass
        if isinstance(mass, ConsistentMass):
            change += float((step * (mass * (base + 0.5 * step - newton.inertial))).sum())
        if newton.others and step.any():
            work = newton.others.work(base, step)
            change -= min(float((newton.others.forces(base) * step).sum()), work) if phase == nk.PROBE else work
        return {
            nk.BESIDE: energies.sum(),
            nk.BESIDE_PARTS: np.abs(energies).sum(),
            nk.BESIDE_CHANGE: np.inf if met else change,
        }

    def _judge(self, numbers: dict) -> None:
        """The residual of what is tried."""
        if self._steps is None:
            return self._residual(1, **numbers)
        potential, newton, (*_, residual, judge) = self.potential, self.newton, self._steps
        if self.beside:
            u = potential.held_at
            if newton.volumes and not self.state[nk.DOUBTED]:
                if self._direction is not None:
                    newton.recount(self._base, u - self._base, self._direction)
                    self._direction = None
                self._set({nk.UNMET: not newton.volumes.met(u)})
            runtime.fill(self.R, np.column_stack(newton.residual(u)))
            if self.contact:
                potential.put_contact_blocks()
        else:
            residual(1, **numbers)
        judge(1, **numbers)
