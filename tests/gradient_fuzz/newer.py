"""What joins configurations by draws of its own: unequal steps, scaled masses, muscles, growth, poses, rough surfaces."""

import numpy as np

import diffsim_ti as ds
from diffsim_ti.mechanics.reduced.body_checks import check_bodies

from .loads import over_time, some_faces
from .structures import CELL


def unequal_steps(kind, seed: int, steps: int, dt: float, substeps: int) -> ds.UnequalSteps | None:
    """Lengths up to dt, in explicit runs with substeps of their own; None for most."""
    rng = np.random.default_rng([24, seed])
    if kind.static or rng.random() > 0.35:
        return None
    lengths = dt * rng.uniform(0.5, 1.0, steps)
    return ds.UnequalSteps(lengths, rng.integers(substeps, substeps + 3, steps) if kind.explicit else substeps)


def mass_scaling(kind, seed: int) -> float | None:
    rng = np.random.default_rng([25, seed])
    return rng.uniform(0.005, 0.1) if kind.explicit and kind.order == 1 and rng.random() < 0.3 else None


def reduced(kind, seed: int, mesh, fixed, deformed: bool) -> dict | None:
    """A set that moves by few numbers, where runs have one of which nothing is held: affinely or rigidly in explicit ones,
    where obstacles push; affinely, rigidly, by functions of each component, or by fields in implicit ones."""
    rng = np.random.default_rng([36, seed])
    stages = kind.explicit and kind.obstacles and kind.contact == "stage"
    if deformed or stages or rng.random() > (1.0 if kind.explicit else 0.5):
        return None
    how = ("affine", "rigid")[rng.integers(2)]
    held = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), fixed=fixed).held
    for name in ("part", "body_1", *(("body_0",) if kind.explicit else ())):
        own = (
            mesh.elements[mesh.tetrahedron_sets[name]] if name in mesh.tetrahedron_sets else mesh.vertex_sets.get(name)
        )
        if own is not None and not np.isin(own, held).any():
            if kind.explicit:
                return {name: how}
            return {name: motions(np.random.default_rng([40, seed]), mesh, len(np.unique(own)))}
    return None


def motions(rng, mesh, count: int):
    """Rigid translations and a little more, at random, for a set of so many vertices."""
    n, more = mesh.num_vertices, int(rng.integers(1, max(2, min(6, count - 1))))
    which = rng.integers(4)
    if which in (0, 3):
        return "rigid" if which == 3 else "affine"
    if which == 1:
        return np.column_stack([np.ones(n), rng.standard_normal((n, more))])
    rigid = np.eye(3)[:, None] * np.ones((n, 1))
    return np.concatenate([rigid, 0.3 * rng.standard_normal((more, n, 3))])


def accepted(kind, scene):
    """The scene, without reduced sets where explicit steps refuse them: by chambers, narrow obstacles, rough surfaces."""
    if kind.explicit and scene.reduced:
        try:
            check_bodies(scene, kind.contact)
        except ValueError:
            return scene.replace(reduced=None)
    return scene


def plastic(kind, seed: int, law, mesh, E: float):
    """A metal so soft that it flows, in a tenth of the structures behind those of golden.py, instead of the law."""
    if kind.number < 60 or np.random.default_rng([41, kind.number]).random() > 0.1:
        return law
    own, rng = np.random.default_rng([42, kind.number]), np.random.default_rng([43, seed])
    first = E * rng.uniform(0.002, 0.01) * (1 if kind.uniform else rng.uniform(1, 2, mesh.num_tetrahedra))
    more = dict(saturation_stress=2.5 * first, saturation_exponent=rng.uniform(5, 50)) if own.random() < 0.5 else {}
    more |= dict(kinematic_hardening=E * rng.uniform(0.01, 0.1)) if own.random() < 0.5 else {}
    return ds.J2Plasticity(E, 0.3, first, E * rng.uniform(0, 0.1), **more)


def directed(kind, seed: int, law, mesh, E: float):
    """Behind the structures of golden.py, in a tenth of those without patches Hooke's law with three planes of symmetry
    instead of the law, and in a tenth a stress at rest on an elastic one."""
    draw, rng = np.random.default_rng([44, kind.number]).random(), np.random.default_rng([45, seed])
    elastic = law.law("f64").reads == ("H",) and not law.law("f64").state_names
    if kind.number < 60 or draw > 0.2 or kind.volume == "patches" or not elastic:
        return law
    if draw > 0.1:
        return ds.InitialStress(law, 0.01 * E * rng.standard_normal((mesh.num_tetrahedra, 6)))
    stiff = dict(zip(("E1", "E2", "E3", "G12", "G23", "G13"), E * rng.uniform(0.5, 1.5, 6) / [1, 1, 1, 2, 2, 2]))
    ratios = dict(zip(("nu12", "nu23", "nu13"), rng.uniform(0.1, 0.3, 3)))
    directions = dict(zip(("direction_1", "direction_2"), rng.standard_normal((2, mesh.num_tetrahedra, 3))))
    return ds.Orthotropic(**stiff, **ratios, **directions)


def muscles(kind, seed: int, mesh, steps: int, duration: float, E: float) -> list[ds.Muscle]:
    """In a fifth of the structures."""
    if np.random.default_rng([26, kind.number]).random() > 0.2:
        return []
    rng, m = np.random.default_rng([27, seed]), mesh.num_tetrahedra
    some = np.sort(rng.permutation(m)[: rng.integers(1, m + 1)])
    fibre = rng.standard_normal((len(some), 3) if rng.random() < 0.5 else 3)
    stress = 0.02 * E * rng.uniform(0.2, 1.0)
    if rng.random() < 0.3:
        return [ds.Muscle(fibre, stress, rng.random((steps, len(some))), some, per="tetrahedron")]
    how = ("constant", "per step", "keyed")[rng.integers(3)]
    return [ds.Muscle(fibre, stress, over_time(rng, steps, duration, how)(1.0), some)]


def couplings(kind, seed: int, mesh, steps: int, duration: float, E: float, start, held) -> list:
    """Loads at remote points and relations, in a quarter of the structures behind those of golden.py: in implicit ones half
    of them with a stiffness; those that are held exactly of vertices that are free, in explicit steps from where they start.
    """
    if kind.number < 60 or np.random.default_rng([44, kind.number]).random() > 0.25:
        return []
    rng = np.random.default_rng([45, seed])
    size = 0.01 * E * CELL**2 * np.array([1.0, 1, 1, CELL, CELL, CELL]) * rng.standard_normal(6)
    how = ("constant", "per step", "keyed")[rng.integers(3)]
    over = over_time(rng, steps, duration, how)(1.0)
    if callable(over):
        load = lambda t: over(t) * size  # noqa: E731
    elif isinstance(over, tuple):
        load = over[0], np.multiply.outer(over[1], size)
    else:
        load = np.multiply.outer(over, size)
    point = None if rng.random() < 0.5 else mesh.vertices[0] + CELL * rng.standard_normal(3)
    out = [ds.RemoteLoad(load, some_faces(rng, mesh), point)]
    which = rng.permutation(mesh.num_vertices)[: rng.integers(1, 6)]
    value = over_time(rng, steps, duration, how)(1e-3 * CELL)
    c, stiffness = rng.standard_normal((len(which), 3)), E * CELL * rng.uniform(0.1, 10)
    exact = kind.explicit or np.random.default_rng([46, kind.number]).random() < 0.5
    if exact and (kind.rollers or np.isin(which, held).all()):
        return out
    if exact:
        c, which, stiffness = c[~np.isin(which, held)], which[~np.isin(which, held)], None
    if kind.explicit:
        value = float((c * (start - mesh.vertices)[which]).sum())
    return [*out, ds.MultiPointConstraint(which, c, value, stiffness=stiffness)]


def grown(kind, seed: int, law, mesh):
    """The material, in a sixth of the structures grown a little."""
    elastic = law.law("f64").reads == ("H",) and not law.law("f64").state_names
    chosen = np.random.default_rng([28, kind.number]).random() < 1 / 6
    if not (elastic and chosen and kind.volume == "tetrahedra"):
        return law
    rng = np.random.default_rng([29, seed])
    shape = () if rng.random() < 0.5 else (mesh.num_tetrahedra, *(4,) * (mesh.order == 2 and kind.number >= 60))
    return ds.Grown(law, rng.uniform(-0.01, 0.02, shape))


def pose(kind, seed: int, number: int, path, x, duration: float, calm: float) -> dict:
    """Arguments of obstacle `number` that follows a path: in two fifths of the structures it turns too, about a point near
    the points x, by rotation vectors or quaternions."""
    if path is None or np.random.default_rng([30, kind.number]).random() > 0.4:
        return dict(path=path)
    rng, size = np.random.default_rng([31, seed, number]), 0.1 * calm
    about = x[rng.integers(len(x))] + 0.1 * np.ptp(x, 0).max() * rng.standard_normal(3)
    vectors, start = rng.random() < 0.5, np.array([1.0, 0, 0, 0]) * rng.uniform(0.5, 2.0)
    a, b = size * rng.standard_normal((2, 3))

    def turns(rotation):
        # the start plus a pure quaternion of half the rotation, of a length that is not one
        return rotation if vectors else start + start[0] * np.concatenate([[0.0], 0.5 * rotation])

    if not callable(path):
        times, places = path
        return dict(path=(times, np.array([[*p, *turns(k * a + k**2 * b)] for k, p in enumerate(places)])), about=about)
    return dict(
        path=lambda t: np.concatenate([path(t), turns(a * np.sin(2 * t / duration) + b * t / duration)]), about=about
    )


def comes_late(obstacle, seed: int, number: int) -> bool:
    """A third of what moves begins where it acts in some passes alone."""
    return obstacle.path and np.random.default_rng([41, seed, number]).random() < 1 / 3


def rough(kind, seed: int, mesh, duration: float) -> dict:
    """Friction of surfaces with each other, in three fifths of the structures with self-contact; bodies by their names."""
    if np.random.default_rng([32, kind.number]).random() > 0.6:
        return {}
    rng = np.random.default_rng([33, seed])
    mu, speed = rng.uniform(0.1, 0.8), 0.05 * CELL / duration * 10.0 ** rng.uniform(-0.5, 0.7)
    named = mesh.num_pieces == 2 and rng.random() < 0.5
    friction = {("body_0", "body_1"): mu, ("body_1", "body_1"): rng.uniform(0.1, 0.8)} if named else mu
    return dict(friction=friction, friction_speed=speed)
