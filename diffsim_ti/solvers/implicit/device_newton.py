"""Rounds of Newton's method on the device: of what crosses to the host, a few numbers a round."""

import weakref
from collections.abc import Callable
from contextlib import nullcontext

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.inputs import ConsistentMass
from diffsim_ti.mechanics.supports.free import FreeDirections
from diffsim_ti.runtime import Repeated, kernels_of, runs_on_cpu
from diffsim_ti.solvers.implicit import newton_kernels as nk
from diffsim_ti.solvers.implicit.cg_kernels import COUNT, LIMIT, ROOM, SQUARE, STOPPED
from diffsim_ti.solvers.implicit.newton_kernels import NewtonKernels


class DeviceNewton:
    """Takes rounds of a `Newton` whose products are all on the device, by the same rules, as long as nothing is unusual: an
    indefinite Hessian, a line search without success and the like are left to the host.

    beside: whether the host has a part in them, between launches: pairs of surfaces, of which it keeps the list, forces of
    its own, masses that are no diagonal.

    A round is a launch for a trial of the line search and the residual of what is taken, some for the preconditioner, and
    those of conjugate gradients; of small bodies on the processor they are one kernel, and a solve is a launch or few. What
    comes next is a number on the device, `PHASE`.
    """

    small, many = 300, 200  # vertices up to which a solve on one thread is one kernel; phases in a launch of it
    short = 600  # variables of a law's longest kernel up to which one kernel of all compiles soon
    most_rounds = 64  # before the host looks at their residuals

    def __init__(self, potential, preconditioner, detection, beside: bool):
        self.potential, self.detection, self.beside = potential, detection, beside
        self.preconditioner = weakref.proxy(preconditioner)  # which holds this: no circle
        self.cg, a, n = preconditioner.solver, potential.arrays, potential.arrays.num_vertices
        cg, points, self.contact = self.cg, potential.J.shape[0], bool(a.contacts) or beside
        guided = isinstance(preconditioner.free, FreeDirections)
        kernels = kernels_of(NewtonKernels, a.precision, cg.precision, cg.parallel, guided, self.contact, beside)
        fp, vector = runtime.PRECISIONS[cg.precision], runtime.array_types(cg.precision)["vectors"].dtype
        self.u, self.d, self.R, self.inertial, self.loads = (runtime.array(vector, n) for _ in range(5))
        self.far, self.stiffness, self.history = (runtime.array(fp, k) for k in (n, n, self.most_rounds + 1))
        self.J, self._filled = runtime.array(a.fp, points), {}
        self.pushes, self.carried = (runtime.array(vector, n if beside else 1) for _ in range(2))
        self.sizes = dict(chunks=cg.chunks, length=cg.length, nodes=n, count=detection.count)
        self.sizes |= dict(points=points, points_length=-(-points // cg.chunks))
        way, barriers = (detection.way, potential.barriers) if self.contact else (None, None)
        own = dict(cg=cg, at=potential, newton=(self, way), out=detection.found, barriers=barriers)
        of_potential = dict(scene=a, pass_=potential, at=potential, out=potential)
        forces, (tries, judges, updates, solves) = potential.kernels.forces, kernels.wanted
        direction, residual = [(kernels.direction, own)], [(forces, of_potential)]
        if a.contacts:
            of_way = dict(scene=a, way=way, at=potential, out=detection.found)
            direction += [(detection.kernels.shares, of_way), (kernels.bound, own)]
        if self.contact:
            residual.append((potential.kernels.contact_blocks, of_potential | dict(out=barriers)))
        compare = [(potential.kernels.energy, of_potential), (kernels.choose, own)]
        steps = direction, [(kernels.move, own)], compare, residual, [(kernels.judge, own)]
        steps = [[(*part, None) for part in group] for group in steps]
        groups = [[(tries, own, None), *sum(steps[:3], [])], [(judges, own, None), *sum(steps[3:], [])]]
        update, hard = ([], None) if beside else preconditioner.updating()
        update = [*update, (kernels.ready, dict(cg=cg, body=hard), None)] if update else []
        on_cpu = runs_on_cpu()
        self.whole = on_cpu and not cg.parallel and n <= self.small and not beside
        self.whole &= potential.kernels.blocks.variables <= self.short
        self._always, self._update = self.sizes | dict(most=1.0, kept=detection.kept), self._in_turn(update)
        if self.whole:
            groups += [[(updates, own, None), *update]] if update else []
            groups.append([(solves, own, None), *cg.parts(False, potential.multiplying())[1:]])
        self._trial = self._residual = self._steps = self._more = None
        if self.whole:
            self._trial = Repeated("newton", groups, cg.parallel, vectorized=True)
        elif beside or on_cpu:
            self._steps = [self._in_turn(group) for group in steps]
        else:
            self._trial, self._residual = (Repeated(f"newton{k}", [own], True) for k, own in enumerate(groups))
        if self.whole:
            launch, always = self._trial, self._always
            cg.serve(lambda times, rounding: launch(times, **always, **potential.sizes(), rounding=rounding))

    def _in_turn(self, parts: list) -> Callable:
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

    def _begin(self, newton, phase: int, most: int = 0) -> np.ndarray:
        """Tell the device the problem of a solve, and that it begins where the potential stands."""
        state, self.newton, self._base = np.zeros(ROOM), weakref.proxy(newton), self.potential.held_at
        self.cg.put_mass(newton.mass if isinstance(newton.mass, np.ndarray) else np.zeros((self.cg.nodes, 1)))
        self._put("inertial", newton.inertial)
        self._put("loads", newton.loads)
        runtime.fill(self.stiffness, newton.stiffness.ravel())
        if self.contact:
            self.detection.put(runtime.fetch(self.potential.poses)[::3])
        state[nk.TOLERANCE], state[nk.EPS], state[nk.MOST] = newton.tolerance, newton.eps, min(most, self.most_rounds)
        state[LIMIT] = min(10 * self.cg.nodes, self.preconditioner.patience)
        state[nk.INSIST], state[nk.SHORTEST] = newton.insist, newton.shortest
        state[nk.INEXACT], state[nk.ROUGHEST], state[nk.FRACTION] = newton.inexact, newton.rough, 1.0
        state[STOPPED], state[nk.PHASE] = nk.WAITS, phase
        return state

    # ---- rises of the potential --------------------------------------------------------------------------------------

    def stand(self, newton, u: np.ndarray) -> None:
        """Measure `rise` from u."""
        self.potential.place(u)
        self._based = self._run(self._begin(newton, nk.BASE), newton.eps)
        self._based[nk.PHASE] = nk.PROBE

    def rise(self, there: np.ndarray) -> float:
        """How much higher Phi is there; infinite where a tetrahedron changes its volume more than tenfold."""
        self.potential.place(there)
        return float(self._run(self._based)[nk.RISE])

    # ---- rounds ------------------------------------------------------------------------------------------------------

    def __call__(self, newton, most: int, rough: bool, roughly: float) -> tuple[np.ndarray, np.ndarray]:
        """(displacement, numbers of newton_kernels.py) after at most so many rounds from where the potential stands, which
        the report of `newton` has; solved, or `roughly` so, where the phase is DONE. rough: whether the linear solve that
        led there was."""
        state = self._begin(newton, nk.START, most)
        state[nk.ROUGH], state[nk.ROUGHLY] = rough, roughly
        state = self._run(state, newton.eps)
        return self._report(newton, state), state

    def _run(self, state: np.ndarray, eps: float = 0.0) -> np.ndarray:
        """From one phase to the next until it is done, or the host has to go on."""
        cg, on_cpu, served = self.cg, runs_on_cpu(), False
        numbers = self._always | self.potential.sizes() | dict(rounding=10 * eps)
        if state[nk.PHASE] == nk.START:
            self.preconditioner.follow(self.potential.held_at)
        runtime.fill(cg.state, state)
        while state[nk.PHASE] > nk.TROUBLE and self._is_going_well(state):
            phase, solving = state[nk.PHASE], state[nk.PHASE] == nk.SOLVE and not state[STOPPED]
            if phase == nk.UPDATE and (served or not self._update):
                self.preconditioner.update(self._here())
                self._more = self._matrix() if self.beside else None
                state[nk.PHASE], state[STOPPED], served = nk.SOLVE, 0, False
                runtime.fill(cg.state, state)
                continue
            # a card goes on before the host has looked, but not to conjugate gradients
            ahead = not (on_cpu or self.beside) and nk.START <= phase and not solving
            if self.whole:
                self._trial(self.many, **numbers)
            elif solving:
                state = self._iterate(state, eps)
            elif phase not in (nk.JUDGE, nk.UPDATE):
                self._try(state, numbers)
            if not self.whole and (phase == nk.JUDGE or ahead and phase != nk.UPDATE):
                self._judge(numbers)
            served = bool(self._update) and (self.whole or phase == nk.UPDATE or ahead)
            if served and not self.whole:
                if on_cpu:
                    self.preconditioner.follow(self._here())
                self._update(1, **numbers)
            state = state if solving and not self.whole else runtime.fetch(cg.state)
            if state[STOPPED] == 1 and not self.whole:
                cg.last = int(state[COUNT])
                if solving:
                    self.preconditioner.learn(float(np.sqrt(state[SQUARE])), cg.last)
        return state

    # ---- where kernels are launched in turn, with what the host has beside them --------------------------------------

    def _try(self, state: np.ndarray, numbers: dict) -> None:
        """Energies of a trial, of a new direction or along the same."""
        if self._steps is None:
            return self._trial(1, **numbers)
        direct, move, compare, *_ = self._steps
        is_new = state[nk.PHASE] == nk.SOLVE
        if is_new:
            direct(1, **numbers)
            if self.potential.pairs:
                self._shorten()
        move(1, **numbers)
        if self.beside:
            u = self.potential.arrive(on_way=True) if is_new or state[nk.PHASE] == nk.TRY else self.potential.held_at
            energies, mass = self.potential.energies_beside(), self.newton.mass
            against = 0.0
            if isinstance(mass, ConsistentMass):
                step = u - self._base
                against = float((step * (mass * (self._base + 0.5 * step - self.newton.inertial))).sum())
            self._set({nk.BESIDE: energies.sum(), nk.BESIDE_PARTS: np.abs(energies).sum(), nk.BESIDE_CHANGE: against})
        compare(1, **numbers)

    def _shorten(self) -> None:
        """Not farther along a new direction than to where surfaces meet."""
        u, step, friction = self._base, runtime.fetch_row(self.detection.way.step, 0), self.potential.surface_friction
        state = runtime.fetch(self.cg.state)
        share = self.potential.pairs.safe_share(u, step, float(state[nk.FRACTION]), placed=True)
        cuts = state[nk.CUTS] + (share < 1 == state[nk.FRACTION])
        self._set(
            {nk.CUTS: cuts, nk.FRACTION: share} | ({} if share > self.newton.shortest else {nk.PHASE: nk.TROUBLE})
        )
        if friction:
            self.newton.turning = friction.turns(u, u + step)

    def _set(self, numbers: dict) -> None:
        """Numbers of the state, by their places."""
        state = runtime.fetch(self.cg.state)
        state[list(numbers)] = list(numbers.values())
        runtime.fill(self.cg.state, state)

    def _judge(self, numbers: dict) -> None:
        """The residual of what is tried."""
        if self._steps is None:
            return self._residual(1, **numbers)
        potential, mass = self.potential, self.newton.mass
        if self.beside:
            forces, sizes = potential.forces_beside()
            runtime.fill(self.pushes, np.column_stack([forces, sizes]))
            if isinstance(mass, ConsistentMass):
                runtime.fill(self.carried, mass * (potential.held_at - self.newton.inertial))
        *_, residual, judge = self._steps
        residual(1, **numbers)
        if self.beside:
            potential.leave_contact_blocks()
        judge(1, **numbers)
        if self.beside and runtime.fetch(self.cg.state)[nk.PHASE] != nk.TRY:
            self._base = potential.held_at

    def _matrix(self):
        """What joins the Hessian of a round, for conjugate gradients."""
        mass, more, _ = self.newton.operator().on_device()
        self.cg.put_system(mass, more)
        return more

    def _iterate(self, state: np.ndarray, eps: float) -> np.ndarray:
        """The state after conjugate gradients, which go on until they stop."""
        friction, more = self.potential.surface_friction, self._more is not None
        with friction.bounded(self.newton.turning) if friction else nullcontext():
            while not state[STOPPED] and self._is_going_well(state):
                self.cg.iterate(int(state[COUNT]), int(state[LIMIT]), eps, more)
                state = runtime.fetch(self.cg.state)
        return state

    def _here(self) -> np.ndarray:
        """The displacement on the device, of which the host is told."""
        self.potential.held_at = runtime.fetch_row(self.potential.u, 0)
        return self.potential.held_at

    @staticmethod
    def _is_going_well(state: np.ndarray) -> bool:
        """Whether a linear solve is not at its limit, and has met no negative curvature and nothing that is not finite."""
        fails = state[STOPPED] in (2, 3) or not np.isfinite(state[SQUARE])
        fails = fails or (not state[STOPPED] and state[COUNT] >= state[LIMIT])
        return not (state[nk.PHASE] == nk.SOLVE and fails)

    def _report(self, newton, state: np.ndarray) -> np.ndarray:
        """Note what rounds took; returns where they ended."""
        solved, report = state[nk.PHASE] == nk.DONE, newton.report
        self.preconditioner.spent += int(state[nk.PRODUCTS])
        report.residuals += runtime.fetch(self.history)[: int(state[nk.ROUND])].tolist()
        for name, place in nk.COUNTED.items():
            setattr(report, name, getattr(report, name) + int(state[place]))
        newton.upright = state[nk.UPRIGHT] == 1
        return self._here() if solved else runtime.fetch(self.u).astype(np.float64)
