"""The rounds of Newton's method: kernels that decide what comes next, and what the host does between them."""

import weakref
from collections.abc import Callable

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.inputs import ConsistentMass, diagonal_of
from diffsim_ti.mechanics.supports.free import FreeBodies, FreeDirections
from diffsim_ti.runtime import Repeated, kernels_of, runs_on_cpu
from diffsim_ti.solvers.implicit import newton_kernels as nk
from diffsim_ti.solvers.implicit.cg_kernels import COUNT, LEAST, LIMIT, ROOM, SQUARE, STOPPED
from diffsim_ti.solvers.implicit.newton_kernels import NewtonKernels

# of what digits of places that a link holds may be off by, what strains the body, 0.013 in the mean square: the rest moves
# all of them as one
STRAINS = 0.01


class Rounds:
    """Takes the rounds of a `Newton` with a preconditioner.

    A round is a launch for a trial of the line search and the residual of what is taken, some for the preconditioner, and
    those of conjugate gradients; of small bodies on the processor they are one kernel, and a solve is a launch or few. What
    comes next is a number on the device, `PHASE`; of what crosses to the host there are a few numbers a round.

    The host solves where something is unusual in a linear system (`Newton.step`), makes the list of pairs of surfaces anew
    where that does not hold, and takes part between the launches where there is something `beside` the kernels: forces of
    its own, masses that are no diagonal, volumes, joints of robots, sets that move by few numbers. It adds energies and
    work, and says R.

    `state` has a row of numbers for each body of a batch (batch/joined_newton.py), else one. Bodies are in the same phases
    but where one halves its step more often than another.
    """

    small, many = 300, 200  # vertices up to which a solve on one thread is one kernel; phases in a launch of it
    short = 800  # variables of a law's longest kernel up to which one kernel of all compiles soon
    most_rounds = 64  # before the host looks at their residuals

    def __init__(self, newton, preconditioner):
        potential, detection = newton.potential, newton.detection
        self.potential, self.detection = potential, detection
        self.preconditioner = weakref.proxy(preconditioner)  # which holds this: no circle
        self.cg, a, n = preconditioner.solver, potential.arrays, potential.arrays.num_vertices
        cg, points, free = self.cg, potential.J.shape[0], preconditioner.free
        reduced, consistent = isinstance(free, FreeBodies), isinstance(newton.mass, ConsistentMass)
        by_host, self.several, self.pairs = newton.others or potential.joints or reduced, cg.several, potential.pairs
        self.beside = bool(by_host or potential.hosts or consistent)
        self.solves_on_host = newton.system() is None
        self.contact = bool(a.contacts or self.pairs or potential.hosts)
        slides = isinstance(free, FreeDirections) and not potential.joints  # whose directions are the host's
        self.whole = runs_on_cpu() and cg.is_one_kernel and (cg.by_scene or not (cg.parallel or cg.several))
        self.whole &= a.vertices_of_one <= self.small and not (self.beside or (self.pairs and self.pairs.asks))
        self.whole &= potential.kernels.blocks.variables <= self.short and not preconditioner.couples
        how = cg.parallel and not self.whole, slides, self.contact, self.beside, self.several and not self.whole
        how += bool(self.pairs), not self.several
        self._kernels = kernels_of(NewtonKernels, a.precision, cg.precision, *how)
        fp, vector = runtime.PRECISIONS[cg.precision], runtime.array_types(cg.precision)["vectors"].dtype
        self.u, self.d, self.R, self.inertial, self.loads = (runtime.array(vector, n) for _ in range(5))
        self.far, self.stiffness, self.history = (runtime.array(fp, k) for k in (n, n, self.most_rounds + 1))
        self.J, self._filled = runtime.array(a.fp, points), {}
        self.sizes = dict(chunks=cg.chunks, length=cg.length, nodes=n, count=detection.count, systems=cg.systems)
        self.sizes |= dict(points=points, points_length=-(-(points // cg.systems) // (cg.chunks // cg.systems)))
        self._always = self.sizes | dict(kept=detection.kept)
        self.next = runtime.array(a.vector, 1, n) if self.pairs else None  # where the longest step leads
        self.places = runtime.array(a.vector, 2, n if self.whole else 1)  # of which rises are asked in one kernel
        self._bind()
        if self.whole:
            cg.serve(self._serve)

    def _bind(self) -> None:
        """Kernels to the arrays that are there, of which pairs may have others now and then."""
        potential, detection, preconditioner, pairs = self.potential, self.detection, self.preconditioner, self.pairs
        kernels, cg, a, beside = self._kernels, self.cg, potential.arrays, self.beside
        self._version = self.cg.version
        way, barriers = (detection.way, potential.barriers) if self.contact else (None, None)
        at = (pairs.inner, potential) if pairs else potential
        own = dict(cg=cg, at=at, newton=(self, way), out=detection.found, barriers=barriers)
        of_potential = dict(scene=a, pass_=potential, at=potential, out=potential)
        one = lambda kernel, records: [(kernel, records, None)]  # noqa: E731
        tries, judges, updates, solves, fresh = (one(kernel, own) for kernel in kernels.wanted)
        direction, residual, holds, near, place = one(kernels.direction, own), [], [], [], []
        of_body = potential.of_one if self.whole else potential.kernels
        if a.contacts and not potential.joints:
            of_way = dict(scene=a, way=way, at=potential, out=detection.found)
            swept = detection.of_one if self.whole else detection.kernels
            direction += one(swept.shares, of_way) + one(kernels.bound, own)
        if not beside:
            residual += one(of_body.forces, of_potential)
            if self.contact:
                residual += one(of_body.contact_blocks, of_potential | dict(out=barriers))
        if pairs:
            u, step, halt = potential.u, way.step, one(kernels.halt, dict(cg=cg, near=pairs.inner))
            holds = [*one(kernels.lead, own), *pairs.holding(self.next, step), *halt]
            near, place = pairs.turning(u, step), pairs.placing(u)
            residual += pairs.adding_blocks(u, barriers.blocks)
        move, energy = one(kernels.move, own), one(of_body.energy, of_potential)
        compare, judge = one(kernels.choose, own), one(kernels.judge, own)
        first, trial = [*tries, *direction, *holds], [*move, *place, *energy, *compare]
        groups = [first, [*fresh, *near], [*tries, *trial]] if near else [[*first, *trial]]
        groups.append([*judges, *residual, *judge])
        by_host = beside or self.several and not self.whole
        update, hard = ([], None) if by_host else preconditioner.updating()
        update = [*update, (kernels.ready, dict(cg=cg, body=hard), None)] if update else []
        self._update = self._in_turn(update)
        self._trial = self._residual = self._steps = self._more = None
        if self.whole:
            groups += [[*updates, *update]] if update else []
            groups.append([*solves, *cg.parts(False, potential.multiplying())[1:]])
            self._trial = potential.repeated("newton", groups, cg.parallel)
        elif beside or pairs or self.several or runs_on_cpu() or not cg.is_one_kernel:
            self._steps = [self._in_turn(group) for group in (direction, holds, near, move, place, compare, judge)]
        else:
            self._trial, self._residual = (Repeated(f"newton{k}", [own], True) for k, own in enumerate(groups))

    def _numbers(self, most: float) -> dict:
        """Those of a launch, of kernels that are bound to the arrays that are there; most: the longest step."""
        numbers, pairs = self._always | self.potential.sizes() | dict(most=most), self.pairs
        if pairs:
            if self.cg.version != self._version:
                self._bind()
            count, pairs.inner.sizes["most"] = pairs.inner.num_energies, most
            numbers |= dict(energies=count, energies_length=-(-count // self.cg.chunks))
        return numbers

    def _serve(self, times: int, rounding: float) -> None:
        """Iterations of conjugate gradients."""
        numbers = self._numbers(1.0)  # which may bind anew what is launched
        self._trial(times, **numbers, rounding=rounding)

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
        self.newton, self._base, self._direction = weakref.proxy(newton), self.potential.held_at, None
        self.cg.put_mass(newton.mass if isinstance(newton.mass, np.ndarray) else np.zeros((self.cg.nodes, 1)))
        self._put("inertial", newton.inertial)
        self._put("loads", newton.loads)
        runtime.fill(self.stiffness, newton.stiffness.ravel())
        if self.potential.arrays.contacts:
            self.detection.put(runtime.fetch(self.potential.poses)[::3])
        told = {nk.TOLERANCE: newton.tolerance, nk.EPS: newton.eps, nk.INSIST: newton.insist, nk.FRACTION: 1.0}
        told |= {nk.SHORTEST: newton.shortest, nk.INEXACT: newton.inexact, nk.ROUGHEST: newton.rough, nk.UPRIGHT: -1}
        self.state = np.zeros((self.cg.systems, ROOM))
        self.state[:, list(told)] = list(told.values())
        self.state[:, STOPPED], self.state[:, nk.RECOUNTS] = nk.WAITS, bool(newton.volumes)
        self.state[:, nk.PHASE] = np.where(newton.going, phase, nk.DONE)
        if self.several:
            runtime.fill(self.u, self._base)

    # ---- rises of the potential --------------------------------------------------------------------------------------

    def stand(self, newton, u: np.ndarray) -> None:
        """Measure `rises` from u, where the potential then stands."""
        self.potential.place(u)
        self._begin(newton, nk.BASE)
        if not self.whole:
            self.advance()
            self.state[:, nk.PHASE] = np.where(newton.going, nk.PROBE, nk.DONE)
        self._based = self.state

    def rises(self, places: list) -> np.ndarray:
        """How much higher Phi of each body is at one place or two, shape (places, bodies); infinite where a tetrahedron
        changes its volume more than tenfold."""
        if self.whole:
            runtime.fill(self.places, np.stack([places[0], places[-1]]))
            self.state = self._based
            self.state[:, nk.PROBES], self.state[:, nk.PROBED] = len(places), 0
            asked = self.state[:, nk.PHASE] != nk.DONE
            self.advance()
            self.state[asked, nk.PHASE] = nk.PROBE
            self._based = self.state
            return self.state[:, [nk.RISE, nk.SECOND_RISE]][:, : len(places)].T
        found = []
        for there in places:
            self.potential.place(there)
            self.state = self._based.copy()
            self.advance()
            found.append(self.state[:, nk.RISE])
        return np.array(found)

    # ---- a solve -----------------------------------------------------------------------------------------------------

    def start(self, newton, roughly: float, most: int) -> None:
        """Begin a solve where the potential stands, which also ends where R is `roughly` small, or after so many rounds."""
        self._begin(newton, nk.START)
        self.state[:, nk.ROUGHLY], self.state[:, nk.MOST], self.state[:, LIMIT] = roughly, most, self._limit()

    def run(self, most: int) -> tuple[float, float, float, bool]:
        """(why they end: DONE, TROUBLE or MANY; |R|, what of it is rounding, whether R is small) after rounds until the
        report of Newton has so many residuals, and one more."""
        report, state = self.newton.report, self.state[0]
        state[nk.ROUND], state[nk.MOST] = 0, min(max(most - len(report.residuals), 0), self.most_rounds)
        state[list(nk.COUNTED.values())] = 0
        self.advance()
        state = self.state[0]
        self.preconditioner.spent += int(state[nk.PRODUCTS])
        report.residuals += runtime.fetch(self.history)[: int(state[nk.ROUND])].tolist()
        for name, place in nk.COUNTED.items():
            setattr(report, name, getattr(report, name) + int(state[place]))
        self.newton.upright = state[nk.UPRIGHT] == 1
        if state[nk.PHASE] == nk.DONE:
            self._here()
        return int(state[nk.PHASE]), float(state[nk.NORM]), float(state[nk.FLOOR]), state[nk.SOLVED] == 1

    def go_on(self) -> None:
        """With a round more than asked for."""
        self.state[0, nk.PHASE], self.state[0, LIMIT] = nk.UPDATE, self._limit()

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
        self.state[0, nk.PHASE], self.state[0, STOPPED], self.state[0, nk.FRACTION] = nk.START, nk.WAITS, 1.0
        return True

    def end(self) -> np.ndarray:
        """Where the last step that was taken has led, where the potential then stands."""
        if self.state[0, nk.PHASE] == nk.DONE:
            return self._here()
        return self.potential.place(runtime.fetch(self.u).astype(np.float64))

    # ---- rounds ------------------------------------------------------------------------------------------------------

    def _limit(self) -> int:
        """Products of a linear solve on the device; none where the host solves."""
        own, static = self.preconditioner, not diagonal_of(self.newton.mass).any()
        slow = own.given_up or static and own.spent > 2 * own.patience
        by_host = self.solves_on_host or slow or (self.newton.indefinite and self.potential.pairs)
        return 0 if by_host else min(10 * self.cg.nodes // self.cg.systems, own.patience)

    def _send(self) -> None:
        runtime.fill(self.cg.state, self.state)

    def _receive(self) -> None:
        self.state = runtime.fetch(self.cg.state).astype(np.float64, copy=False)

    def advance(self) -> None:
        """From one phase to the next until it is over."""
        served = False
        if nk.START in self.state[:, nk.PHASE]:
            self.preconditioner.follow(self.potential.held_at)
        self._send()
        while max(phases := self.state[:, nk.PHASE].tolist()) > nk.MANY:
            if phases[0] == nk.WAY:
                self._shorten()
                continue
            if phases[0] == nk.ASTRAY:
                self.pairs.reach(self.next)
                self._set({nk.PHASE: nk.TRY})
                continue
            solves = nk.SOLVE in phases
            if solves and (odd := self._odd()).any():
                self._solve(odd)
                self._send()
                continue
            found = solves and not (self.state[:, STOPPED] == 0).any()
            tries = found or any(nk.BASE <= phase <= nk.TRY for phase in phases)
            judges, updates = not tries and nk.JUDGE in phases, nk.UPDATE in phases
            updates = updates and not (tries or judges)
            solves = not (tries or judges or updates)
            if updates and (served or not self._update):
                self._follow()
                served = False
                continue
            numbers = self._numbers(nk.LONGEST_STEP if self.state[:, nk.INDEFINITE].any() else 1.0)
            numbers["rounding"] = 10 * self.newton.eps
            # a card goes on before the host has looked, but not to conjugate gradients
            ahead = not (self.whole or self._steps or solves) and phases[0] >= nk.START
            if self.whole:
                self._trial(self.many, **numbers)
            elif tries:
                self._try(numbers)
            elif solves:
                self._iterate()
            if not self.whole and (judges or ahead and tries):
                self._judge(numbers)
            served = bool(self._update) and (self.whole or updates or ahead)
            if served and not self.whole:
                if self._steps:
                    self.preconditioner.follow(self._here(), met=True)
                self._update(1, **numbers)
            if self.whole or not solves:
                self._receive()
            elif not self.several and self.state[0, STOPPED] == 1:
                self.preconditioner.learn(float(np.sqrt(self.state[0, SQUARE])), int(self.state[0, COUNT]))
            if judges and self.beside:
                taken = self.state[:, nk.ACCEPTED] == 1
                self._base = self.potential.held_at if taken.all() else self._where(taken, self._base)

    def _follow(self) -> None:
        """The preconditioner goes to where steps that were taken led, and conjugate gradients begin."""
        here = self.potential.place(runtime.fetch(self.u).astype(np.float64)) if self.several else self._here()
        self.preconditioner.update(here, met=self.contact)
        if self.beside and self.state[:, LIMIT].any():
            mass, self._more = self.newton.system()
            self.cg.put_system(mass, self._more)
        on = self.state[:, nk.PHASE] == nk.UPDATE
        self.state[on, nk.PHASE], self.state[on, STOPPED] = nk.SOLVE, 0
        self._send()

    def _where(self, which: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Where the potential stands of some bodies, else an other displacement."""
        return np.where(np.repeat(which, len(other) // len(which))[:, None], self.potential.held_at, other)

    def _odd(self) -> np.ndarray:
        """Which linear solves are at their limits, or have met negative curvature or something that is not finite."""
        state = self.state
        fails = (state[:, STOPPED] == 2) | (state[:, STOPPED] == 3) | ~np.isfinite(state[:, SQUARE])
        fails |= (state[:, STOPPED] == 0) & (state[:, COUNT] >= state[:, LIMIT])
        return (state[:, nk.PHASE] == nk.SOLVE) & fails

    def _here(self) -> np.ndarray:
        """The displacement on the device, of which the host is told."""
        self.potential.held_at = runtime.fetch_row(self.potential.u, 0)
        return self.potential.held_at

    # ---- linear solves -----------------------------------------------------------------------------------------------

    def _iterate(self) -> None:
        """Conjugate gradients until they stop."""
        while np.any(on := (self.state[:, STOPPED] == 0) & ~self._odd()):
            left = int(self.state[on, LIMIT].max() - self.state[on, COUNT].max())
            self.cg.iterate(self.state[on], left, self.newton.eps, self._more is not None)
            self._receive()

    def _solve(self, odd: np.ndarray) -> None:
        """The host's direction; of several bodies what is left to those that are odd."""
        if self.several:
            return self.newton.leave(self, odd)
        newton, state = self.newton, self.state[0]
        # taken for indefinite again where surfaces have cut the step before short
        newton.indefinite &= bool(self.potential.pairs) and bool(state[nk.LONGEST] < 1)
        R, forcing = runtime.fetch(self.R).astype(np.float64), float(np.sqrt(state[LEAST]))
        direction, R = newton.step(self._here(), R, forcing)
        early = len(newton.report.residuals) + state[nk.ROUND] <= newton.by_work
        self._take(direction, R, 0 if not newton.by_residual else nk.BY_WORK if early else nk.BY_RESIDUAL)

    def _take(self, direction: np.ndarray, R: np.ndarray, measure: int) -> None:
        """A direction that goes down by R is what a linear solve has found; measure: of what makes a step good."""
        state, self._direction = self.state[0], direction
        runtime.fill(self.cg.x, direction[None])
        runtime.fill(self.R, R)
        state[nk.PHASE], state[STOPPED], state[COUNT], state[SQUARE] = nk.SOLVE, 1, 0, 0
        state[nk.SCALE], state[nk.INDEFINITE], state[LIMIT] = 1.0, self.newton.indefinite, self._limit()
        state[nk.MEASURE], state[nk.TO_LOWER] = measure, np.linalg.norm(R)

    # ---- where kernels are launched in turn, with what the host has beside them --------------------------------------

    def _set(self, numbers: dict) -> None:
        """Numbers of the state, by their places."""
        self._receive()
        for place, number in numbers.items():
            self.state[:, place] = number
        self._send()

    def _try(self, numbers: dict) -> None:
        """Energies of a trial, of a new direction or along the same."""
        if self._steps is None:
            return self._trial(1, **numbers)
        (direct, holds, near, move, *_), phases = self._steps, self.state[:, nk.PHASE]
        tried = (nk.BASE <= phases) & (phases <= nk.TRY) | (phases == nk.SOLVE)
        phase = phases[tried].max()
        if phase == nk.SOLVE:
            direct(1, **numbers)
            if (self.potential.joints and self.contact) or (self.pairs and self.pairs.asks):
                self._shorten()
                if self.pairs:  # which may have other arrays now
                    return
        if holds:
            holds(1, **numbers)
            self._receive()
            if self.state[0, nk.PHASE] > nk.SOLVE:
                return
            if near and self.state[0, nk.FRESH] == 1:
                near(1, **numbers)
        move(1, **numbers)
        self.potential.only(tried)
        if self.beside:
            self._set(self._beside(phase))
            numbers |= self._numbers(numbers["most"])
        *_, place, compare, _ = self._steps
        if place:
            place(1, **numbers)
        self.potential.launch("energy", lanes=False)
        compare(1, **numbers)

    def _shorten(self) -> None:
        """Not farther along a new direction than to where surfaces meet, or links that give way."""
        self._receive()
        potential, newton, u = self.potential, self.newton, self._here()
        step, cuts = runtime.fetch_row(self.detection.way.step, 0), self.state[0, nk.CUTS]
        share = longest = float(self.state[0, nk.LONGEST])
        if potential.joints:
            share = newton.collisions(u, step, longest)[0]
        if self.pairs:
            share = min(share, self.pairs.safe_share(u, step, share, placed=True))
            self.pairs.launch(self.pairs.turning(potential.u, self.detection.way.step))
        numbers = {nk.CUTS: cuts + (share < 1 <= longest), nk.LONGEST: share, nk.FRACTION: min(1.0, share), nk.FRESH: 0}
        self._set(numbers | {nk.PHASE: nk.TRY if share > newton.shortest else nk.TROUBLE})

    def _beside(self, phase: int) -> dict:
        """What the host adds to the energies where something is tried, and to their change on the way there."""
        potential, newton, base = self.potential, self.newton, self._base
        moved, met = phase in (nk.SOLVE, nk.TRY), False
        if moved and newton.rigid:  # which may turn on another way than the step that was looked at
            there = newton.rigid.nearest(runtime.fetch_row(potential.u, 0))
            met = not newton.is_free(base, there - base)
            runtime.fill(potential.u, there[None])
            if self.pairs:
                self.pairs.reach(potential.u)
        u = potential.arrive(pairs=False) if moved else potential.held_at
        if (newton.rigid or potential.joints) and phase == nk.START:
            places = (
                newton.rigid.rounding.ravel() if newton.rigid else STRAINS * potential.joints.digits.max(initial=0.0)
            )
            runtime.fill(self.far, runtime.fetch(self.far) + places / newton.eps)
        rows = lambda x: x.reshape(self.cg.systems, -1)  # noqa: E731
        energies, change, step, mass = rows(potential.energies_beside()), 0.0, u - base, newton.mass
        if isinstance(mass, ConsistentMass):
            change = rows(step * (mass * (base + 0.5 * step - newton.inertial))).sum(1)
        if newton.others and step.any():
            work = newton.others.work(base, step)
            if phase == nk.PROBE:
                work = np.minimum(rows(newton.others.forces(base) * step).sum(1), work)
            change = change - work
        whole = {nk.BESIDE: energies.sum(1), nk.BESIDE_PARTS: np.abs(energies).sum(1)}
        return whole | {nk.BESIDE_CHANGE: np.inf if met else change}

    def _judge(self, numbers: dict) -> None:
        """The residual of what is tried."""
        if self._steps is None:
            return self._residual(1, **numbers)
        potential, newton, u = self.potential, self.newton, self.potential.held_at
        potential.only(self.state[:, nk.PHASE] == nk.JUDGE)
        if newton.volumes and not self.state[0, nk.DOUBTED]:
            counts = newton.volumes.have_energy
            before = potential.energies_beside().sum() if counts else 0.0
            if self._direction is None:  # of a start, or out of a saddle
                newton.volumes.place(u)
            else:
                newton.recount(self._base, u - self._base, self._direction)
            shift = potential.energies_beside().sum() - before if counts else 0.0  # of the energy, which counts from u
            self._direction = None
            self._set({nk.UNMET: not newton.volumes.met(u), nk.E_TRIED: self.state[0, nk.E_TRIED] + shift})
        if self.beside:
            runtime.fill(self.R, np.column_stack(newton.residual(u)))
        else:
            potential.launch("forces")
        if self.contact:
            potential.put_contact_blocks()
        self._steps[-1](1, **numbers)
