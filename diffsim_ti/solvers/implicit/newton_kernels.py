"""Kernels of rounds of Newton's method (newton.py), all of whose numbers stay on the device."""

from dataclasses import dataclass
from functools import cached_property

import taichi as ti

from diffsim_ti.runtime import PRECISIONS, A, Kernel, as_kernel, kernels_of
from diffsim_ti.solvers.implicit.cg_kernels import COUNT, LEAST, LIMIT, NUMBERS, SQUARE, STOPPED, CGKernels

# places of numbers in `state`, behind those of conjugate gradients: what is done next; norms of the residual and what
# measures them; of the line search; potential and the sum of its absolute parts, before and where it is tried; of the report
(PHASE, NORM, BEFORE, FLOOR, ROUGH, SLOPE, FRACTION, FRESH, DOUBTED, ACCEPTED, RISE) = range(NUMBERS, NUMBERS + 11)
(E, PARTS, E_TRIED, PARTS_TRIED, UPRIGHT, ROUND, PRODUCTS, TRIALS, HALVINGS, CUTS) = range(RISE + 1, RISE + 11)
# what a solve is told: tolerances, limits, and numbers of `Newton`
(TOLERANCE, EPS, MOST, INSIST, INEXACT, ROUGHEST, SHORTEST, ROUGHLY) = range(CUTS + 1, CUTS + 9)
# what the host adds to energies, to their sizes and to the change along a step; whether volumes that are held are not met,
# and whether multipliers of theirs are counted anew once a step is taken
(BESIDE, BESIDE_PARTS, BESIDE_CHANGE, UNMET, RECOUNTS) = range(ROUGHLY + 1, ROUGHLY + 6)
# whether R is small; what brings the linear solve's x to the direction, whether that is of negative curvature, the longest
# free step along it, the least change of the potential along it so far (1: go back to that); what makes a step good, and
# the |R| that it is to lower; places that rises are asked of, how many there are, and the rise of the second
(SOLVED, SCALE, INDEFINITE, LONGEST, BEST, MEASURE, TO_LOWER) = range(RECOUNTS + 1, RECOUNTS + 8)
(PROBES, PROBED, SECOND_RISE) = range(TO_LOWER + 1, TO_LOWER + 4)
COUNTED = dict(products=PRODUCTS, trials=TRIALS, halvings=HALVINGS, cuts=CUTS)  # by NewtonReport, too
# phases: it is done, no step is found, rounds are used up; energies where rises are measured from, and of one; where a solve
# starts, a trial of the line search, its residual, the preconditioner, conjugate gradients; the host says how far along a
# direction surfaces stay apart, makes the list of pairs anew
DONE, TROUBLE, MANY, BASE, PROBE, START, TRY, JUDGE, UPDATE, SOLVE, WAY, ASTRAY = range(12)
WAITS = 4  # of STOPPED: conjugate gradients have not begun
BY_WORK, BY_RESIDUAL = 1, 2  # of MEASURE where there is no potential: work or |R| is lower, |R| is
LONGEST_STEP = 64.0  # along an indefinite direction, which is doubled while Phi falls, for its length says little


@dataclass(frozen=True)
class NewtonKernels:
    """scene: precision of displacements and energies; vectors: of all else; guided: whether vertices are fixed in some
    directions only; contact: whether there is contact; beside: whether the host says the residual; several: whether there
    are several bodies, each with its row of `state` (cg_kernels.py); pairs: whether there are pairs of surfaces; noted:
    whether each round's residual is."""

    scene: str
    vectors: str
    parallel: bool
    guided: bool
    contact: bool
    beside: bool
    several: bool = False
    pairs: bool = False
    noted: bool = True

    @property
    def fp(self):
        return PRECISIONS[self.vectors]

    @property
    def values(self) -> str:
        """The kind of arrays of numbers of the scene."""
        return "singles" if self.scene == "f32" else "doubles"

    @cached_property
    def cg(self) -> CGKernels:
        return kernels_of(CGKernels, self.scene, self.vectors, self.parallel, self.guided, False, self.several)

    @property
    def displacements(self) -> str:
        """The kind of arrays of displacements of the scene."""
        return f"vectors2_{self.scene}"

    @property
    def guide(self) -> dict:
        return dict(guide="ints", held="vectors2") if self.guided else {}

    def _kernel(self, name: str, function, **arrays) -> Kernel:
        cg = dict(part="scalars2", state="scalars2") | arrays.pop("cg", {})
        sizes = ("chunks", "length", "nodes", "points", "points_length", "count", "systems")
        sizes += ("energies", "energies_length") if self.pairs else ()
        return Kernel(name, function, self.vectors, dict(cg=cg) | arrays, dict.fromkeys(sizes, "int"))

    @ti.func
    def is_tried(self, b, cg: A):
        s = ti.cast(cg.state[b, PHASE], ti.i32)
        return (s >= BASE and s <= TRY) or (s == SOLVE and cg.state[b, STOPPED] == 1)

    @ti.func
    def is_trial(self, cg: A, plan: A):
        return self.is_tried(0, cg)

    @ti.func
    def is_judged(self, cg: A, plan: A):
        return cg.state[0, PHASE] == JUDGE

    @ti.func
    def is_updated(self, cg: A, plan: A):
        return cg.state[0, PHASE] == UPDATE

    @ti.func
    def is_solved(self, cg: A, plan: A):
        return cg.state[0, STOPPED] == 0 and cg.state[0, COUNT] < cg.state[0, LIMIT]

    @ti.func
    def is_fresh(self, cg: A, plan: A):
        return cg.state[0, PHASE] == TRY and cg.state[0, FRESH] == 1

    @cached_property
    def wanted(self) -> list[Kernel]:
        """Whether something is tried, whether it may be taken, whether the preconditioner is to follow, whether conjugate
        gradients go on, whether a direction is new, for `Repeated`."""
        own = dict(cg=dict(state="scalars2"))
        asks = self.is_trial, self.is_judged, self.is_updated, self.is_solved, self.is_fresh
        return [Kernel(function.__name__, function, self.vectors, own, {}) for function in asks]

    # ---- line search -------------------------------------------------------------------------------------------------

    @as_kernel(
        "direction",
        cg=lambda self: dict(x="vectors2", free="scalars") | self.guide,
        newton=lambda self: dict(d="vectors", R="vectors") | (dict(step=self.displacements) if self.contact else {}),
    )
    def direction(self, cg: A, newton: A, plan: A):
        """d of a linear solve, and R . d."""
        ti.loop_config(serialize=not self.parallel)
        for c in range(plan.chunks):
            b, slope = self.cg.system(c, plan.chunks, plan), ti.cast(0, self.fp)
            if cg.state[b, PHASE] == SOLVE and cg.state[b, STOPPED] == 1:
                begin, end = self.cg.span(c, plan.length, plan.nodes, plan)
                for i in range(begin, end):
                    d = cg.x[0, i] * cg.state[b, SCALE]
                    if ti.static(self.guided):
                        d = self.cg.allowed(i, cg, d)
                    newton.d[i] = d
                    if ti.static(self.contact):
                        newton.step[0, i] = self.cg.to(PRECISIONS[self.scene], d)
                    slope += self.cg.dot(newton.R[i], d)
            cg.part[0, c] = slope
        ti.loop_config(serialize=self.cg.one_by_one)
        for b in range(plan.systems):
            cg.state[b, FRESH] = ti.cast(0, self.fp)
            if cg.state[b, PHASE] == SOLVE and cg.state[b, STOPPED] == 1:
                cg.state[b, PHASE], cg.state[b, FRESH] = ti.cast(TRY, self.fp), ti.cast(1, self.fp)
                cg.state[b, SLOPE] = cg.part[0, self.cg.add_up(cg.part, 1, b, plan)]
                cg.state[b, FRACTION], cg.state[b, LONGEST] = ti.cast(1, self.fp), ti.cast(1, self.fp)
                if cg.state[b, INDEFINITE] == 1:
                    cg.state[b, LONGEST] = ti.cast(LONGEST_STEP, self.fp)
                cg.state[b, PRODUCTS] = cg.state[b, PRODUCTS] + cg.state[b, COUNT]

    @as_kernel("bound", out=lambda self: dict(found=self.values))
    def bound(self, cg: A, out: A, plan: A):
        """The longest step before an obstacle, of what each vertex may go."""
        ti.loop_config(serialize=not self.parallel)
        for j in range(plan.count):
            b, share = self.cg.system(j, plan.count, plan), ti.cast(out.found[j], self.fp)
            if cg.state[b, FRESH] == 1 and share < cg.state[b, LONGEST]:
                ti.atomic_min(cg.state[b, LONGEST], share)
        ti.loop_config(serialize=self.cg.one_by_one)
        for b in range(plan.systems):
            if cg.state[b, FRESH] == 1:
                cg.state[b, FRACTION] = ti.min(cg.state[b, FRACTION], cg.state[b, LONGEST])
                if cg.state[b, FRACTION] < 1:
                    cg.state[b, CUTS] = cg.state[b, CUTS] + ti.cast(1, self.fp)

    @as_kernel("lead", newton=lambda self: dict(u="vectors", d="vectors", next=self.displacements))
    def lead(self, cg: A, newton: A, plan: A):
        """Where the longest step along a new direction leads, or what is tried next along the same."""
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.nodes):
            share = cg.state[0, FRACTION]
            if cg.state[0, FRESH] == 1:
                share = cg.state[0, LONGEST]
            newton.next[0, i] = self.cg.to(PRECISIONS[self.scene], newton.u[i] + newton.d[i] * share)

    @as_kernel("halt", near=dict(flags="ints"))
    def halt(self, cg: A, near: A, plan: A):
        """A phase of the host's where the list of pairs does not hold, or surfaces may meet."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            away, meets = near.flags[0] > 0, near.flags[2] > 0
            if cg.state[0, PHASE] == TRY:
                cg.state[0, ACCEPTED] = ti.cast(0, self.fp)
                if cg.state[0, FRESH] == 1 and (away or meets):
                    cg.state[0, PHASE] = ti.cast(WAY, self.fp)
                elif away:
                    cg.state[0, PHASE] = ti.cast(ASTRAY, self.fp)

    @as_kernel(
        "move",
        newton=lambda self: dict(u="vectors", d="vectors", far="scalars", places=self.displacements),
        at=lambda self: dict(u=self.displacements),
    )
    def move(self, cg: A, newton: A, at: A, plan: A):
        """To what is tried."""
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.nodes):
            b = self.cg.system(i, plan.nodes, plan)
            if cg.state[b, PHASE] == BASE or cg.state[b, PHASE] == START:
                u, most = self.cg.to(self.fp, at.u[0, i]), ti.cast(0, self.fp)
                for k in ti.static(range(3)):
                    most = ti.max(most, ti.abs(u[k]))
                newton.far[i], newton.u[i] = most, u
            if cg.state[b, PHASE] == TRY:
                at.u[0, i] = self.cg.to(PRECISIONS[self.scene], newton.u[i] + newton.d[i] * cg.state[b, FRACTION])
            if cg.state[b, PHASE] == PROBE and cg.state[b, PROBES] > 0:
                at.u[0, i] = newton.places[ti.cast(cg.state[b, PROBED], ti.i32), i]

    @ti.func
    def sum_energies(self, c, b, cg: A, newton: A, at: A, plan: A):
        """Of a chunk: energies, their sizes, tetrahedra whose volume falls too far or is not positive; inertia and loads;
        rounding of strains that come from large u."""
        zero = ti.cast(0, self.fp)
        value, size, flat, turned, against, noise = zero, zero, zero, zero, zero, zero
        begin, end = self.cg.span(c, plan.points_length, plan.points, plan)
        for k in range(begin, end):
            e, J = ti.cast(at.elastic[k], self.fp), at.J[k]
            value += e
            size += ti.abs(e)
            least, most = newton.J[k] * ti.cast(0.1, PRECISIONS[self.scene]), newton.J[k] * 10
            if not J > least or (cg.state[b, PHASE] == PROBE and not J < most):
                flat += ti.cast(cg.state[b, PHASE] != PROBE or newton.J[k] > 0, self.fp)
            turned += ti.cast(not J > 0, self.fp)
        if ti.static(self.pairs):
            first, last = self.cg.span(c, plan.energies_length, plan.energies, plan)
            for k in range(first, last):
                e = ti.cast(at.energy[k], self.fp)
                value += e
                size += ti.abs(e)
        begin, end = self.cg.span(c, plan.length, plan.nodes, plan)
        for i in range(begin, end):
            e, u = ti.cast(at.contact[i], self.fp), self.cg.to(self.fp, at.u[0, i])
            value += e
            size += ti.abs(e)
            step = u + newton.u[i] * ti.cast(-1, self.fp)
            middle = (u + newton.u[i]) * ti.cast(0.5, self.fp) + newton.inertial[i] * ti.cast(-1, self.fp)
            against += self.cg.dot(step, middle * cg.mass[i] + newton.loads[i] * ti.cast(-1, self.fp))
            noise += newton.stiffness[i] * self.cg.dot(u, u)
        cg.part[0, c], cg.part[1, c], cg.part[2, c], cg.part[3, c] = value, size, flat, turned
        cg.part[4, c], cg.part[5, c] = against, noise

    @ti.func
    def decide(self, b, cg: A, plan: A):
        """Whether what is tried lowers the potential."""
        c = self.cg.add_up(cg.part, 6, b, plan)
        value, size = cg.part[0, c] + cg.state[b, BESIDE], cg.part[1, c] + cg.state[b, BESIDE_PARTS]
        cg.state[b, E_TRIED], cg.state[b, PARTS_TRIED], cg.state[b, DOUBTED] = value, size, ti.cast(0, self.fp)
        cg.state[b, ACCEPTED], cg.state[b, FRESH] = ti.cast(0, self.fp), ti.cast(0, self.fp)
        change = value - cg.state[b, E] + cg.part[4, c] + cg.state[b, BESIDE_CHANGE]
        flat = cg.part[2, c] > 0
        if cg.state[b, PHASE] == BASE:
            cg.state[b, E], cg.state[b, PARTS], cg.state[b, ACCEPTED] = value, size, ti.cast(1, self.fp)
            cg.state[b, PHASE] = ti.cast(ti.select(cg.state[b, PROBES] > 0, PROBE, DONE), self.fp)
        elif cg.state[b, PHASE] == PROBE:
            if flat:
                change = ti.cast(ti.math.inf, self.fp)
            if cg.state[b, PROBED] == 0:
                cg.state[b, RISE] = change
            else:
                cg.state[b, SECOND_RISE] = change
            cg.state[b, PROBED] = cg.state[b, PROBED] + ti.cast(1, self.fp)
            if cg.state[b, PROBED] >= cg.state[b, PROBES]:
                cg.state[b, PHASE] = ti.cast(DONE, self.fp)
        elif cg.state[b, PHASE] == START:
            if cg.state[b, UPRIGHT] < 0:
                cg.state[b, UPRIGHT] = ti.cast(cg.part[3, c] == 0, self.fp)
            cg.state[b, PHASE], cg.state[b, TRIALS] = ti.cast(JUDGE, self.fp), cg.state[b, TRIALS] + ti.cast(1, self.fp)
        else:
            cg.state[b, TRIALS] = cg.state[b, TRIALS] + ti.cast(1, self.fp)
            noise = cg.state[b, EPS] * 10 * (cg.state[b, PARTS] + size + cg.part[5, c])
            admissible = not (cg.state[b, UPRIGHT] == 1 and cg.state[b, FRACTION] > cg.state[b, INSIST] and flat)
            lower = admissible and change <= cg.state[b, FRACTION] * cg.state[b, SLOPE] * ti.cast(-1e-4, self.fp)
            if cg.state[b, BEST] != 0:
                self.lengthen(b, cg, change, admissible)
            elif cg.state[b, MEASURE] > 0:
                if lower and cg.state[b, MEASURE] == BY_WORK and cg.state[b, SLOPE] > 0:
                    cg.state[b, PHASE] = ti.cast(JUDGE, self.fp)
                elif admissible and change - change == 0:
                    cg.state[b, PHASE], cg.state[b, DOUBTED] = ti.cast(JUDGE, self.fp), ti.cast(1, self.fp)
                else:
                    self.halve(b, cg)
            elif lower:
                self.lengthen(b, cg, change, True)
            elif admissible and ti.abs(cg.state[b, SLOPE]) * cg.state[b, FRACTION] <= noise and change <= noise:
                cg.state[b, PHASE], cg.state[b, DOUBTED] = ti.cast(JUDGE, self.fp), ti.cast(1, self.fp)
            else:
                self.halve(b, cg)

    @ti.func
    def lengthen(self, b, cg: A, change, admissible):
        """Take what is tried, or try twice as much of an indefinite direction while that is lower still."""
        share = cg.state[b, FRACTION]
        if cg.state[b, BEST] > 0:  # it is where the last step was lower
            cg.state[b, PHASE], cg.state[b, BEST] = ti.cast(JUDGE, self.fp), ti.cast(0, self.fp)
        elif not (admissible and (cg.state[b, BEST] == 0 or change < cg.state[b, BEST])):
            cg.state[b, FRACTION], cg.state[b, BEST] = share * ti.cast(0.5, self.fp), ti.cast(1, self.fp)
        elif share >= 1 and share * 2 <= cg.state[b, LONGEST]:  # which is more than 1 of an indefinite direction alone
            cg.state[b, FRACTION], cg.state[b, BEST] = share * 2, change
        else:
            cg.state[b, PHASE], cg.state[b, BEST] = ti.cast(JUDGE, self.fp), ti.cast(0, self.fp)

    @ti.func
    def halve(self, b, cg: A):
        cg.state[b, PHASE], cg.state[b, FRACTION] = ti.cast(TRY, self.fp), cg.state[b, FRACTION] * ti.cast(0.5, self.fp)
        cg.state[b, HALVINGS] = cg.state[b, HALVINGS] + ti.cast(1, self.fp)
        if not cg.state[b, FRACTION] > cg.state[b, SHORTEST]:
            cg.state[b, PHASE] = ti.cast(TROUBLE, self.fp)

    def compared(self) -> dict:
        own = ("elastic", "contact", "J", *(["energy"] if self.pairs else []))
        return dict.fromkeys(own, self.values) | dict(u=self.displacements)

    @as_kernel(
        "choose",
        cg=dict(mass="scalars"),
        newton=lambda self: (
            dict.fromkeys(("u", "inertial", "loads"), "vectors") | dict(stiffness="scalars", J=self.values)
        ),
        at=compared,
    )
    def choose(self, cg: A, newton: A, at: A, plan: A):
        """Whether what is tried is taken, its energies being there."""
        ti.loop_config(serialize=not self.parallel)
        for c in range(plan.chunks):
            self.sum_energies(c, self.cg.system(c, plan.chunks, plan), cg, newton, at, plan)
        ti.loop_config(serialize=self.cg.one_by_one)
        for b in range(plan.systems):
            if self.is_tried(b, cg):
                self.decide(b, cg, plan)
        ti.loop_config(serialize=not self.parallel)
        for c in range(plan.chunks):
            if cg.state[self.cg.system(c, plan.chunks, plan), ACCEPTED] == 1:
                first, last = self.cg.span(c, plan.points_length, plan.points, plan)
                for k in range(first, last):
                    newton.J[k] = at.J[k]

    # ---- residual ----------------------------------------------------------------------------------------------------

    @ti.func
    def sum_residual(self, c, b, cg: A, newton: A, at: A, barriers: A, plan: A):
        """Of a chunk: |R|^2, of what it is measured by, of rounding; R . d."""
        zero = ti.cast(0, self.fp)
        square, size, floor, slope = zero, zero, zero, zero
        begin, end = self.cg.span(c, plan.length, plan.nodes, plan)
        for i in range(begin, end):
            u, rigidity, R = self.cg.to(self.fp, at.u[0, i]), newton.stiffness[i], newton.R[i]
            if ti.static(self.beside):
                size += R[3] * R[3]
            else:
                inertia = (u + newton.inertial[i] * ti.cast(-1, self.fp)) * cg.mass[i]
                R = self.cg.to(self.fp, at.y[0, i]) + newton.loads[i] + inertia * ti.cast(-1, self.fp)
                R, forces = self.cg.allowed(i, cg, R), ti.cast(at.size[i], self.fp)
                newton.R[i] = R
                size += forces * forces + self.cg.dot(newton.loads[i], newton.loads[i])
                size += self.cg.dot(inertia, inertia) * cg.free[i]
            square += self.cg.dot(R, R)
            slope += self.cg.dot(R, newton.d[i])
            far = newton.far[i]
            for k in ti.static(range(3)):
                far = ti.max(far, ti.abs(u[k]))
                if ti.static(self.contact):
                    for d in ti.static(range(3)):
                        rigidity += ti.abs(ti.cast(barriers.blocks[d, i][k], self.fp))
            rounding = rigidity * far * cg.state[b, EPS] * cg.free[i]
            floor += rounding * rounding
        cg.part[0, c], cg.part[1, c], cg.part[2, c], cg.part[3, c] = square, size, floor, slope

    @ti.func
    def take(self, b, c, cg: A, newton: A):
        """What is tried, and its residual is known: whether it is the last round, or how the next is solved."""
        one = ti.cast(1, self.fp)
        if cg.state[b, FRACTION] <= cg.state[b, INSIST]:
            cg.state[b, UPRIGHT] = ti.cast(0, self.fp)
        cg.state[b, E], cg.state[b, PARTS] = cg.state[b, E_TRIED], cg.state[b, PARTS_TRIED]
        cg.state[b, ACCEPTED], cg.state[b, BEFORE] = one, cg.state[b, NORM]
        norm, size, floor = ti.sqrt(cg.part[0, c]), ti.sqrt(cg.part[1, c]), ti.sqrt(cg.part[2, c]) * 4
        cg.state[b, NORM], cg.state[b, FLOOR] = norm, floor
        if ti.static(self.noted):
            relative = norm
            if size > 0:
                relative = norm / size
            newton.history[ti.cast(cg.state[b, ROUND], ti.i32)] = relative
        cg.state[b, ROUND] = cg.state[b, ROUND] + one
        solved = norm <= cg.state[b, TOLERANCE] * size + floor and cg.state[b, UNMET] == 0
        cg.state[b, SOLVED], cg.state[b, SCALE] = ti.cast(solved, self.fp), norm
        cg.state[b, INDEFINITE] = ti.cast(0, self.fp)
        if (solved and (cg.state[b, ROUGH] == 0 or norm <= floor)) or norm < cg.state[b, ROUGHLY] * size:
            cg.state[b, PHASE] = ti.cast(DONE, self.fp)
        elif not norm - norm == 0:
            cg.state[b, PHASE] = ti.cast(TROUBLE, self.fp)
        else:
            self.force(b, cg, size, solved)
            cg.state[b, PHASE] = ti.cast(UPDATE, self.fp)
            if cg.state[b, ROUND] > cg.state[b, MOST]:
                cg.state[b, PHASE] = ti.cast(MANY, self.fp)
            cg.state[b, STOPPED], cg.state[b, COUNT], cg.state[b, SQUARE] = (
                ti.cast(WAITS, self.fp),
                ti.cast(0, self.fp),
                one,
            )

    @ti.func
    def force(self, b, cg: A, size, solved):
        """How exact a round's linear solve is: rough while rounds gain little, but not of the last one, whose error slow
        motions of stiff bodies would show. Eisenstat, Walker 1996, Choosing the Forcing Terms in an Inexact Newton Method,
        choice 2, doi:10.1137/0917003."""
        norm, exact, hidden = cg.state[b, NORM], cg.state[b, INEXACT], ti.cast(0, self.fp)
        forcing = exact
        if norm > 0:  # else only a volume is not as it is to be
            last = cg.state[b, TOLERANCE] * size / norm * ti.cast(0.3, self.fp)  # what makes this round the last one
            hidden = cg.state[b, FLOOR] / norm * ti.cast(0.3, self.fp)  # by rounding
            exact = ti.min(exact, ti.sqrt(norm / size))
            if last > cg.state[b, INEXACT] * ti.cast(0.03, self.fp):  # which is within reach
                exact = ti.min(exact, last)
            exact = ti.max(exact, hidden)
            forcing = exact
            if not solved:
                gained = ti.cast(1, self.fp)
                if cg.state[b, BEFORE] > 0:
                    gained = ti.min(norm / cg.state[b, BEFORE], gained)
                forcing = ti.max(exact, ti.min(cg.state[b, ROUGHEST], gained * gained * ti.cast(0.9, self.fp)))
        cg.state[b, ROUGH] = ti.cast(forcing > ti.max(cg.state[b, INEXACT], hidden), self.fp)
        forcing = ti.max(forcing, cg.state[b, EPS] * 10)
        cg.state[b, LEAST] = forcing * forcing

    @ti.func
    def is_good(self, b, c, cg: A):
        """Whether R says that a step is: that the potential does not rise again as steeply as it fell before, which is left
        to ask where its change drowns in rounding; where there is none, that |R| is less. Hager, Zhang 2005, A New Conjugate
        Gradient Method with Guaranteed Descent, doi:10.1137/030601880."""
        good = cg.part[3, c] >= cg.state[b, SLOPE] * ti.cast(-0.8, self.fp)
        if cg.state[b, MEASURE] > 0:
            lower = cg.state[b, TO_LOWER] * (1 - cg.state[b, FRACTION] * ti.cast(1e-4, self.fp))
            good = ti.sqrt(cg.part[0, c]) <= lower
        return good

    @ti.func
    def weigh(self, cg: A, newton: A, at: A, barriers: A, plan: A):
        ti.loop_config(serialize=not self.parallel)
        for c in range(plan.chunks):
            self.sum_residual(c, self.cg.system(c, plan.chunks, plan), cg, newton, at, barriers, plan)
        ti.loop_config(serialize=self.cg.one_by_one)
        for b in range(plan.systems):
            cg.state[b, ACCEPTED] = ti.cast(0, self.fp)
            if cg.state[b, PHASE] == JUDGE:
                c = self.cg.add_up(cg.part, 4, b, plan)
                if cg.state[b, DOUBTED] == 1 and not self.is_good(b, c, cg):
                    self.halve(b, cg)
                elif cg.state[b, DOUBTED] == 1 and cg.state[b, RECOUNTS] == 1:  # R is another then
                    cg.state[b, DOUBTED] = ti.cast(0, self.fp)
                else:
                    self.take(b, c, cg, newton)
        ti.loop_config(serialize=not self.parallel)
        for c in range(plan.chunks):
            b = self.cg.system(c, plan.chunks, plan)
            if cg.state[b, ACCEPTED] == 1:
                begin, end = self.cg.span(c, plan.length, plan.nodes, plan)
                for i in range(begin, end):
                    newton.u[i] = self.cg.to(self.fp, at.u[0, i])
                    cg.r[0, i] = newton.R[i] / cg.state[b, NORM]
                first, last = self.cg.span(c, plan.points_length, plan.points, plan)
                for k in range(first, last):
                    newton.J[k] = at.J[k]

    @cached_property
    def judge(self) -> Kernel:
        """R where something is tried, its forces being there; if that is taken, what the round solves: r = R / |R|."""
        cg, values = dict(free="scalars", r="vectors2"), self.values
        own = dict.fromkeys(("far", "stiffness"), "scalars") | dict.fromkeys(("u", "d", "R"), "vectors")
        own |= dict(history="scalars") if self.noted else {}
        own, at = own | dict(J=values), dict(u=self.displacements, J=values)
        if not self.beside:
            cg |= dict(mass="scalars") | self.guide
            own |= dict(inertial="vectors", loads="vectors")
            at |= dict(y=self.displacements, size=values)
        barriers = dict(blocks=self.displacements) if self.contact else {}
        return self._kernel("judge", self.weigh, cg=cg, newton=own, at=at, barriers=barriers)

    # ---- preconditioner ----------------------------------------------------------------------------------------------

    @as_kernel("ready", body=dict(hard="ints"))
    def ready(self, cg: A, body: A, plan: A):
        """The preconditioner is of the present place, unless a vertex is too hard for it."""
        ti.loop_config(serialize=not self.parallel)
        for c in range(plan.chunks):
            hard = 0
            begin, end = self.cg.span(c, plan.length, plan.nodes, plan)
            for i in range(begin, end):
                hard = hard | body.hard[i]
            cg.part[0, c] = ti.cast(hard, self.fp)
        ti.loop_config(serialize=True)
        for b in range(1):
            if cg.state[0, PHASE] == UPDATE and cg.part[0, self.cg.add_up(cg.part, 1, b, plan)] == 0:
                cg.state[0, PHASE], cg.state[0, STOPPED] = ti.cast(SOLVE, self.fp), ti.cast(0, self.fp)
