"""Beside equal steps of the scene as it is: mass scaling, stiff parts that move affinely, steps where they are needed."""

import time
from dataclasses import dataclass

import numpy as np

from diffsim_ti.rollout import Rollout
from diffsim_ti.rollout.adaptive_steps import adaptive_steps
from diffsim_ti.solvers import stable_dt

SHARES = (0.01,)  # of the mass
GAIN = 1.5  # in the stable step, below which mass scaling is not tried
STIFFER = 100.0  # times the rest, from which on a named set is tried as one that moves affinely
TOLERANCES = (1.0, 0.3)  # of adaptive steps, in shares of what the advice may be off


@dataclass
class Alternative:
    """A way to run the scene otherwise: `how` to ask for it, `steps` of the whole duration, its error relative to
    the largest displacement, wall time [s] with its gradient if asked for, and that of finding its steps once, `search`
    [s], which `seconds` leaves out. `times`: seconds over those of the advice, timed back to back."""

    how: str
    steps: int
    error: float
    seconds: float
    times: float
    search: float = 0.0

    def __str__(self) -> str:
        once = f", once {self.search:.2g} s to find them" if self.search else ""
        return f"{self.how}: {self.steps} steps, error {self.error:.2g}, {self.times:.2g} times as long{once}"


def alternatives(trials, best) -> tuple[list[Alternative], list[str]]:
    """(what keeps to the tolerance, why the others are left out), of the advised option `best` of `Trials`."""
    found, notes = [], []
    longer, scene = trials.duration / trials.span, trials.scene.replace(precision=best.precision)
    base = trials.rollout(best.solver, best.precision, best.substeps, scene, **_unchecked(best))
    tried = [lambda how=how: how for how in _scaled(trials, best, scene, notes)]
    tried += _affine(trials, best, notes)
    tried += [lambda share=share: _adaptive(trials, best, scene, share) for share in TOLERANCES]
    for make in tried:
        try:
            how, rollout, search = make()
            error = _error(trials, rollout)
        except (FloatingPointError, ValueError) as problem:
            notes.append(f"a trial beside equal steps: {type(problem).__name__}")
            continue
        if not error <= trials.tolerance:
            notes.append(f"{how}: error {error:.2g}")
            continue
        own, other = [], []
        for _ in range(3):
            other.append(trials.time(base))
            own.append(trials.time(rollout))
        steps = int(np.ceil((rollout.sweep.num_passes - rollout.solver.explicit) * longer))  # explicit: one pass more
        times = min(own) / min(other)
        found.append(Alternative(how, steps, error, best.seconds * times, times, search * longer))
        if search:
            break
    return found, notes


def _scaled(trials, best, scene, notes):
    """Runs with mass added, at as many steps fewer as the stable step allows."""
    if not best.solver.explicit or scene.mass_scaling or scene.mesh.order > 1:
        return
    for share in SHARES:
        heavier = scene.replace(mass_scaling=share)
        gain = heavier.mass_scaling.gain
        if gain < GAIN:
            notes.append(f"mass_scaling={share:g}: steps only {gain:.2g} times as long, the mesh has no slivers")
            continue
        substeps = int(np.ceil(best.substeps / gain))
        rollout = trials.rollout(best.solver, best.precision, substeps, heavier, **_unchecked(best))
        yield f"mass_scaling={share:g}", rollout, 0.0


def stiff_sets(scene) -> list[str]:
    """Named sets of tetrahedra that are at least a hundred times stiffer, by their shear modulus, than all outside them."""
    mesh, material = scene.mesh, scene.material
    mu = np.broadcast_to(material.lame(material.values(mesh))[0], mesh.num_tetrahedra)
    softest = {name: mu[rows].min() for name, rows in mesh.tetrahedron_sets.items() if len(rows)}
    for least in sorted(softest.values()):
        names = [name for name, own in softest.items() if own >= least]
        rest = np.delete(mu, np.concatenate([mesh.tetrahedron_sets[name] for name in names]))
        if len(rest) and least >= STIFFER * rest.max():
            return names
    return []


def _affine(trials, best, notes):
    """What makes runs whose stiff parts move by twelve numbers: of the advised solver, and of an implicit one."""
    names = [] if trials.scene.reduced else stiff_sets(trials.scene)
    options = [best] if names else []
    known = [o for o in trials.tried if not o.solver.explicit and np.isfinite(o.error)]
    if options and best.solver.explicit and known:
        good = [o for o in known if o.error <= trials.tolerance]
        options.append(min(good, key=lambda o: o.seconds) if good else min(known, key=lambda o: o.error))
    for option in options:
        reduced = dict.fromkeys(names, "affine")
        how = ("" if option is best else f"{option.solver.__name__}, ") + f"reduced={reduced}"
        try:
            scene = trials.scene.replace(precision=option.precision, reduced=reduced)
            option.solver(scene, dt=trials.span, **_unchecked(option))
        except ValueError as error:
            notes.append(f"{how} was not tried: {error}")
            continue
        yield lambda how=how, scene=scene, option=option: (how, _affine_run(trials, scene, option), 0.0)


def _affine_run(trials, scene, option) -> Rollout:
    """A run at as many steps as its stable step allows; an implicit one at as many as its order asks for."""
    substeps = option.substeps
    if option.solver.explicit:
        substeps = int(np.ceil(substeps * trials.stable / stable_dt(scene).dt))
    for _ in range(4):
        rollout = trials.rollout(option.solver, option.precision, substeps, scene, **_unchecked(option))
        error = _error(trials, rollout)
        if error <= trials.tolerance:
            break
        finer = np.clip((2 * error / trials.tolerance) ** (1 / option.solver.order), 1.3, 8)
        substeps = int(np.ceil(finer * substeps))
    return rollout


def _adaptive(trials, best, scene, share):
    """A run over steps that are found by looking."""
    solver = best.solver(scene, dt=trials.span / trials.frames, **_unchecked(best))
    base = trials.rollout(best.solver, best.precision, best.substeps, scene, **_unchecked(best))
    moved = base.forward().displacements
    size = np.linalg.norm(moved - moved[0], axis=-1).max()
    tolerance = float(f"{share * trials.tolerance * size * trials.span / trials.duration:.2g}")
    begin = time.perf_counter()
    steps = adaptive_steps(solver, trials.frames, tolerance)
    search = time.perf_counter() - begin
    how = f"adaptive_steps(solver, steps={trials.frames}, tolerance={tolerance:g})"
    return how, trials.quantity.rollout(solver, steps, memory=trials.memory), search


def _error(trials, rollout: Rollout) -> float:
    """Of a run, carried on to the whole duration."""
    return trials.error(trials.quantity.of(rollout, rollout.forward())) * trials.duration / trials.span


def _unchecked(best) -> dict:
    """Options of a solver whose step is chosen by trials."""
    return {"check_start": False} if best.solver.explicit else {}
