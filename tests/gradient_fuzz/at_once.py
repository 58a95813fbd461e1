"""Scenes at once, some numbers of each its own: bits of each alone, gradients of each, their sums, tangents."""

import numpy as np

import diffsim_ti as ds

from .structures import CELL

RIGHT = "right"


def solver_of(configuration):
    """The configuration's solver, of an explicit one without what keeps scenes from being computed side by side."""
    solver, scene = configuration.solver, configuration.scene
    if not configuration.structure.explicit:
        return solver

    def taken(**parts) -> bool:
        return ds.Batch(solver.for_scene(plain.replace(**parts)), 1, 1).lanes

    plain = scene.replace(reduced=None, terms=())
    if not taken():
        plain = plain.replace(material=ds.StableNeoHookean(1e4, 0.3))
    return solver.for_scene(plain.replace(terms=[term for term in scene.terms if taken(terms=[term])]))


def scenes_at_once(it) -> str:
    """Against the scenes one by one; those that die, die alone as well."""
    from .judge import scale_of

    configuration, kind, rng = it.configuration, it.configuration.structure, it.configuration.rng(9)
    explicit = kind.explicit
    save = configuration.options["save_every"]
    steps = configuration.steps if explicit or configuration.schedule is None else configuration.schedule
    solver, lanes = solver_of(configuration), True if explicit else None
    for scenes in rng.permutation([2, 3, 9]).tolist():
        batch = ds.Batch(solver, steps, scenes, save, gradients="all", lanes=lanes)
        one, duration, along = batch.one, max(float(batch.one.times[-1]), 1e-300), {}
        for name in (str(name) for name in rng.permutation(list(batch.inputs))):
            base = one.values[name]
            shape = (scenes, *base.shape) if len(along) < 4 else base.shape  # the others are shared
            along[name] = scale_of(name, base, duration) * rng.standard_normal(shape)
        own = {name: one.values[name] + 0.03 * along[name] for name in list(along)[:4]}
        try:
            frames = batch.forward(**own)
            break
        except ValueError as error:
            if "may be one value for all scenes or one for each" not in str(error):  # as many vertices as scenes, say
                raise

    alone = []
    for b in range(scenes):
        try:
            alone.append(one.forward(**{name: x[b] for name, x in own.items()}))
        except FloatingPointError:
            alone.append(None)
        if (alone[b] is not None) != frames.alive[b]:
            return f"scene {b} of {scenes}: alive {frames.alive[b]} among others, {alone[b] is not None} alone"
        for name in ("displacements", "velocities"):
            if frames.alive[b] and np.any(getattr(frames, name)[b] != getattr(alone[b], name)):
                return f"scene {b} of {scenes}: {name} have other bits than alone"

    w = rng.standard_normal(frames.positions.shape) / CELL
    z = 0 * w if kind.static else rng.standard_normal(w.shape) * duration / CELL
    w, z = (x.astype(frames.positions.dtype).astype(np.float64) * frames.alive[:, None, None, None] for x in (w, z))
    found, expected = batch.vjp(frames, w, z), {name: np.zeros(one.values[name].shape) for name in along}
    expected |= {name: np.zeros(x.shape) for name, x in own.items()}
    for b in np.flatnonzero(frames.alive):
        for name, by in one.vjp(alone[b], w[b], z[b]).items():
            if name in own:
                expected[name][b] = by
            else:
                expected[name] += by
    of = {name: np.abs(d).max() for name, d in along.items()}
    largest = max(of[name] * np.abs(g).max(initial=0.0) for name, g in expected.items())
    gate = 1e-10 if kind.precision == "f64" else 1e-4
    for name, by in expected.items():
        off, size = np.abs(found[name] - by).max(initial=0.0), np.abs(by).max(initial=0.0)
        if found[name].shape != by.shape or not off <= gate * max(size, 1e-2 * largest / of[name]):
            return f"gradient by {name} of {scenes} scenes: off by {off:.3g} of {size:.3g}"

    if not frames.alive.all():
        return RIGHT
    changes = batch.tangents(frames, **along)
    there = [(changes[name] * seed).ravel() for name, seed in (("positions", w), ("velocities", z))]
    here = [(found[name] * d).ravel() for name, d in along.items()]
    size = sum(np.abs(part).sum() for part in (*there, *here))
    off = abs(sum(part.sum() for part in there) - sum(part.sum() for part in here))
    return RIGHT if off <= it.gates[0] * size else f"dot product of {scenes} scenes off by {off:.3g} of {size:.3g}"
