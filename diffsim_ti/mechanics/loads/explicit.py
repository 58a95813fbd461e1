"""Forces that are given on vertices, in explicit passes: constant, for each step, or linear within steps."""

from dataclasses import dataclass

import taichi as ti

from diffsim_ti.runtime import assign, at, let, number_type, traced, vector_type
from diffsim_ti.state.features import Features
from diffsim_ti.state.pass_table import between, kicks

A = ti.template()  # an array or Bundle handed to a Taichi function


@dataclass(frozen=True)
class GivenForces:
    """Functions of one vertex i, and of lists of numbers for who reads rows of forces in a manner of its own."""

    features: Features
    precision: str

    fp, vector = number_type, vector_type

    @traced
    def terms(self, now, has) -> list:
        """(row, how far in its step, weight) of the forces of a pass: of the two steps that share its kicks, or of all that
        do not change; no share where they do not change within a step. has: 1, or 0 where there is no force."""
        F = self.features
        if not (F.forces_keyed or F.forces_per_step):
            return [(0, None, has)]
        return [(r, s if F.forces_keyed else None, let(w * has)) for r, s, w in kicks(now, F.forces_per_step, self.fp)]

    @traced
    def mean(self, read, now, has=1) -> list:
        """Numbers of the force of a pass: `read(row, end)` gives those of a row, at the beginning of its step (end = 0) or
        at its end (1)."""
        total = None
        for row, share, weight in self.terms(now, has):
            own = read(row, 0)
            if share is not None:
                own = [between(x, y, share) for x, y in zip(own, read(row, 1))]
            own = [let(weight * x) for x in own]
            total = own if total is None else [let(x + y) for x, y in zip(total, own)]
        return total

    @traced
    def mean_vjp(self, add, by: list, now, has=1) -> None:
        """Its transpose: `add(row, end, numbers)`."""
        for row, share, weight in self.terms(now, has):
            weights = (weight,) if share is None else (let(weight * (1 - share)), let(weight * share))
            for end, own in enumerate(weights):
                add(row, end, [let(own * x) for x in by])

    @traced
    def place(self, k, end: int):
        """Of force k in a row."""
        return 2 * k + end if self.features.forces_keyed else k

    @traced
    def own_force(self, k, now, forces):
        return self.mean(lambda row, end: [at(forces, row, self.place(k, end))], now)[0]

    @ti.func
    def force(self, i, now: A, scene: A, forces: A):
        """External force on vertex i: of the present step, or of the two that share a kick their part."""
        f = self.vector(0)
        k = scene.force_slot[i]
        if k >= 0:
            f = self.own_force(k, now, forces)
        return f

    @ti.func
    def gathered(self, i, scene: A, plan: A, pulls: A):
        """What pressures do at vertex i, and what pulls, cables, of what it gathers: they are the last of its corners."""
        f, first, end = self.vector(0), plan.first_load, scene.start[i + 1]
        if ti.static(self.features.pulled and not pulls):
            first = plan.first_push
        for back in range(1, end - scene.start[i] + 1):
            c = scene.corner_of[end - back]
            if c < first:
                break
            f = f + scene.corner[c]
        return f

    @traced
    def add_own(self, k, f_adj, now, adjoint) -> None:
        def add(row, end, numbers):
            target = at(adjoint.forces, row, self.place(k, end))
            assign(target, target + numbers[0])

        self.mean_vjp(add, [f_adj], now)

    @ti.func
    def add_vjp(self, i, f_adj, now: A, scene: A, adjoint: A):
        k = scene.force_slot[i]
        if k >= 0:
            self.add_own(k, f_adj, now, adjoint)
