"""Rounds of Newton's method on the device: of what crosses to the host, a few numbers a round."""

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.mechanics.supports.free import FreeDirections
from diffsim_ti.runtime import Repeated, kernels_of, runs_on_cpu
from diffsim_ti.solvers.implicit import newton_kernels as nk
from diffsim_ti.solvers.implicit.newton_kernels import NewtonKernels


class DeviceNewton:
    """Takes rounds of a `Newton` whose forces are all on the device, by the same rules, as long as nothing is unusual: an
    indefinite Hessian, a line search without success and the like are left to the host.

    Kernels are in three groups, for a trial of the line search with its residual, the preconditioner, and an iteration of
    conjugate gradients. On one thread of the processor all of a solve is one launch; elsewhere a launch is one group.
    """

    many, most_rounds = 400, 64  # groups in a launch on one thread, which stops by itself; rounds between looks

    def __init__(self, potential, preconditioner, detection):
        self.potential, self.preconditioner, self.detection = potential, preconditioner, detection
        self.cg, a, lanes = preconditioner.solver, potential.arrays, runs_on_cpu()
        cg, n, guided = self.cg, a.num_vertices, isinstance(preconditioner.free, FreeDirections)
        points, contact = potential.J.shape[0], bool(a.contacts)
        kernels = kernels_of(NewtonKernels, a.precision, cg.precision, cg.parallel, guided, contact)
        fp = runtime.PRECISIONS[cg.precision]
        vector = runtime.array_types(cg.precision)["vectors"].dtype
        self.u, self.d, self.R, self.inertial, self.loads = (runtime.array(vector, n) for _ in range(5))
        self.far, self.stiffness, self.history = (runtime.array(fp, k) for k in (n, n, self.most_rounds + 1))
        self.J, self._stiffness_there = runtime.array(a.fp, points), None
        self._sizes = dict(chunks=cg.chunks, length=cg.length, nodes=n)
        self._sizes |= dict(points=points, points_length=-(-points // cg.chunks), count=detection.count)
        own = dict(cg=cg, at=potential, newton=self)
        of_potential = dict(scene=a, pass_=potential, at=potential, out=potential)
        trial, swept = [(kernels.wanted["round"], own, None), (kernels.direction, own, None)], []
        if contact:
            own |= dict(newton=(self, detection.way), out=detection.found, barriers=potential.barriers)
            trial[1] = kernels.direction, own, None
            of_way = dict(scene=a, way=detection.way, at=potential, out=detection.found)
            swept = [(detection.kernels.shares, of_way, dict(count=detection.count, most=1.0, kept=detection.kept))]
            swept += [(kernels.bound, own, None)]
        trial += [*swept, (kernels.move, own, None), (potential.kernels.energy, of_potential, None)]
        trial += [(kernels.choose, own, None), (potential.kernels.forces, of_potential, None)]
        if contact:
            barriers = of_potential | dict(out=potential.barriers)
            trial.append((potential.kernels.contact_blocks, barriers, None))
        trial.append((kernels.judge, own | dict(barriers=potential.barriers if contact else None), None))
        parts, hard = preconditioner.updating()
        self._updates = bool(parts)
        update = [(kernels.wanted["update"], own, None), *parts, (kernels.ready, own | dict(body=hard), None)]
        solve = [(kernels.wanted["solve"], own, None), *cg.parts(False)[1:]]
        groups = [trial, *([update] if parts else []), solve]
        self._whole = lanes and not cg.parallel
        groups = dict(newton=groups) if self._whole else dict(trial=[trial], update=[update], solve=[solve])
        self._launches = [self._launch(name, some) for name, some in groups.items()]

    def _launch(self, name: str, groups: list):
        repeated = Repeated(name, [[part[:2] for part in g] for g in groups], self.cg.parallel, runs_on_cpu())
        numbers = [part[2] for g in groups for part in g]
        return lambda times, common: repeated(times, *(common if own is None else own for own in numbers))

    def _begin(self, newton, most: int) -> np.ndarray:
        """Tell the device what is solved, from where the potential stands."""
        cg, state = self.cg, np.zeros(nk.ROOM)
        cg.put_mass(newton.mass)
        runtime.fill(self.inertial, newton.inertial)
        runtime.fill(self.loads, newton.loads)
        if newton.stiffness is not self._stiffness_there:
            runtime.fill(self.stiffness, newton.stiffness[:, 0])
            self._stiffness_there = newton.stiffness
        state[nk.TOLERANCE], state[nk.EPS] = newton.tolerance, newton.eps
        state[nk.MOST] = min(most, self.most_rounds)
        state[nk.LIMIT] = min(10 * cg.nodes, self.preconditioner.patience)
        state[nk.INSIST], state[nk.SHORTEST] = newton.insist, newton.shortest
        state[nk.INEXACT], state[nk.ROUGHEST], state[nk.FRACTION] = newton.inexact, newton.rough, 1.0
        if self.potential.arrays.contacts:
            self.detection.put(newton.collisions.rows[::3])
        runtime.fill(cg.state, state)
        return state

    def __call__(self, newton, most: int) -> tuple[np.ndarray, np.ndarray]:
        """(displacement, numbers of newton_kernels.py) after at most so many rounds from where the potential stands, which
        the report of `newton` has; solved where the phase is DONE."""
        cg, state, tried = self.cg, self._begin(newton, most), False
        common = self.potential.sizes() | self._sizes | dict(rounding=10 * newton.eps)
        while state[nk.PHASE] < nk.DONE and self._is_going_well(state):
            phase = state[nk.PHASE]
            if phase == nk.UPDATE and (tried or not self._updates):
                self.preconditioner.update(self.potential.held_at)
                state[nk.PHASE] = nk.SOLVE
                runtime.fill(cg.state, state)
            elif self._whole:
                self._launches[0](self.many, common)
            elif phase == nk.UPDATE:
                self._launches[1](1, common)
            elif phase == nk.SOLVE and not state[nk.STOPPED]:
                done = int(state[nk.COUNT])
                self._launches[2](min(cg.next_look(done), int(state[nk.LIMIT]) - done), common)
            else:
                self._launches[0](1, common)
            state = runtime.fetch(cg.state)
            tried = state[nk.PHASE] == nk.UPDATE and (self._whole or phase == nk.UPDATE)
            if state[nk.STOPPED]:
                cg.took(int(state[nk.COUNT]))
        solved, report = state[nk.PHASE] == nk.DONE, newton.report
        self.preconditioner.spent += int(state[nk.PRODUCTS])
        report.residuals += runtime.fetch(self.history)[: int(state[nk.ROUND])].tolist()
        report.products, report.trials = (
            report.products + int(state[nk.PRODUCTS]),
            report.trials + int(state[nk.TRIALS]),
        )
        report.halvings, report.cuts = report.halvings + int(state[nk.HALVINGS]), report.cuts + int(state[nk.CUTS])
        if state[nk.CUTS]:
            report.met = self.detection.read()
        newton.upright = state[nk.UPRIGHT] == 1
        u = runtime.fetch(self.potential.u)[0] if solved else runtime.fetch(self.u)
        if solved:
            self.potential.held_at = u.astype(np.float64)
        return u.astype(np.float64), state

    @staticmethod
    def _is_going_well(state: np.ndarray) -> bool:
        """Whether a linear solve is not at its limit, and has met no negative curvature and nothing that is not finite."""
        fails = state[nk.STOPPED] > 1 or not np.isfinite(state[nk.SQUARE])
        fails = fails or (not state[nk.STOPPED] and state[nk.COUNT] >= state[nk.LIMIT])
        return not (state[nk.PHASE] == nk.SOLVE and fails)
