"""A configuration: a structure with numbers, drawn from one seed."""

import re
from dataclasses import dataclass, replace

import numpy as np

import diffsim_ti as ds
from diffsim_ti.inputs.surface_areas import SurfaceAreas

from . import bodies, newer
from .chambers import chamber, hollow, outer_triangles
from .loads import load, rollers
from .obstacles import MESH_WIDTH, Placed, place, push_direction
from .open_materials import open_material
from .structures import CELL, LAWS, PER_STRUCTURE, Structure, structure
from .ties import tie


@dataclass
class Configuration:
    """What one seed stands for."""

    seed: int
    structure: Structure
    solver: object
    steps: int
    options: dict  # of the Rollout
    placed: list[Placed]
    schedule: ds.UnequalSteps | None  # of steps that are not all dt
    paths: list  # of the obstacles in `placed`, None for those that stand still
    terms: list
    calm: float  # what moves it and presses is that share of what was drawn

    @property
    def scene(self):
        return self.solver.scene

    def rollout(self, **changes) -> ds.Rollout:
        return self.part(0, self.steps, **self.options | changes)

    def part(self, first: int, steps: int, **options) -> ds.Rollout:
        """Of some of its steps."""
        own = self.schedule
        if own is not None:
            own = ds.UnequalSteps(own.lengths[first:][:steps], own.substeps[first:][:steps])
        return ds.Rollout(self.solver, steps if own is None else own, **options)

    def rng(self, salt: int):
        return np.random.default_rng([self.seed, salt])


def smooth_path(rng, size: float, duration: float):
    """A function of time that starts at zero, or keyframes."""
    if rng.random() < 0.3:
        times = duration * np.array([0.0, rng.uniform(0.2, 0.8), 1.0])
        return times, size * np.vstack([np.zeros(3), rng.standard_normal((2, 3))])
    a, b = rng.standard_normal((2, 3))
    return lambda t: size * (a * np.sin(2 * t / duration) + b * (t / duration) ** 2)


def path_at(path, t: float) -> np.ndarray:
    """The displacement alone."""
    if callable(path):
        return np.asarray(path(t))[:3]
    return np.array([np.interp(t, path[0], column) for column in path[1].T[:3]])


def material(kind: Structure, rng, mesh):
    """In one of its spellings; moduli uniform, per set or per tetrahedron."""
    m = mesh.num_tetrahedra
    E, nu = 10 ** rng.uniform(4.0, 4.6), rng.uniform(0.15, 0.42)

    def spread(x, share):
        if kind.uniform:
            return x
        if "part" in mesh.tetrahedron_sets:
            return {"part": x, "default": x * (1 + share)}
        return x * (1 + share * rng.random(m))

    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    if kind.law not in LAWS:
        return open_material(kind.law, rng, mesh, E, nu, spread), E
    if kind.law is ds.MooneyRivlin and rng.random() < 0.5:
        own = next(names for names in kind.law.spellings if names[0] not in ("youngs_modulus", "mu"))
        numbers = dict(zip(own, (0.3 * mu, 0.2 * mu, lam + 2 / 3 * mu)))
        return kind.law(**{name: spread(x, 0.5) for name, x in numbers.items()}), E
    if rng.random() < 0.3:
        return kind.law(mu=spread(mu, 0.5), lam=spread(lam, 0.5)), E
    return kind.law(E=spread(E, 1.0), nu=spread(nu, 0.1) if rng.random() < 0.5 else nu), E


def build(seed: int, precision: str | None = None, calm: float = 1.0) -> Configuration:
    """The configuration of a seed, or the same in another precision or calmer; raises what the package raises."""
    kind, rng = structure(seed // PER_STRUCTURE), np.random.default_rng([10, seed])
    kind = replace(kind, precision=precision or kind.precision)
    way = None
    if kind.self_contact:
        mesh, start, way = (bodies.pair if rng.random() < 0.6 else bodies.fold)(rng)
    else:
        mesh = hollow(rng) if kind.chamber else bodies.body(rng)
        if rng.random() < 0.25:
            other = bodies.body(rng)
            mesh = ds.TetrahedralMesh.joined([mesh, other.translated([6 * CELL, 0, 0])])
        start = np.array(mesh.vertices)
        if rng.random() < 0.5:
            middle = start.mean(0)
            start = middle + (start - middle) @ (np.eye(3) + 0.05 * rng.standard_normal((3, 3)))
            start = start + 0.02 * CELL * rng.standard_normal(start.shape)
    mesh = mesh.translated(shift := CELL * rng.uniform(-3, 3, 3))
    start = start + shift
    mesh = bodies.with_part(mesh, rng) if rng.random() < 0.5 else mesh
    if kind.order == 2:
        bent = 0.08 if kind.self_contact else 0.03  # so that surfaces that meet are curved
        mesh, start = bodies.with_middles(mesh, start, np.random.default_rng([23, seed]), bent)
    law, E = material(kind, rng, mesh)
    law = newer.directed(kind, seed, newer.plastic(kind, seed, law, mesh, E), mesh, E)
    law = newer.grown(kind, seed, law, mesh)
    density = rng.uniform(600, 1200) * (1 + 0.3 * rng.random(mesh.num_tetrahedra) if rng.random() < 0.4 else 1.0)
    fixed = _fixed(kind, rng, mesh) if kind.fixed else None
    if kind.rollers:
        mesh, supports = rollers(np.random.default_rng([20, seed]), mesh, fixed)
    steps, substeps, dt = _schedule(
        kind, rng, mesh, E, np.min(density), np.abs(start - mesh.vertices).max() > 0.1 * CELL
    )
    schedule = newer.unequal_steps(kind, seed, steps, dt, substeps)
    duration = steps * dt if schedule is None else float(schedule.time(steps))

    mass = np.bincount(mesh.elements.ravel(), np.outer(density * mesh.volumes, mesh.reference.lumped).ravel())
    beat = 2e-3 if kind.static else dt / substeps if kind.explicit else duration / 25
    stiff = mass.min() * (rng.uniform(0.15, 0.4) / beat) ** 2 / 35  # omega dt at a fifth of the width
    placed, paths, push = _obstacles(kind, seed, rng, mesh, start, fixed, stiff, duration, calm)

    terms = [p.term for p in placed]
    if kind.gravity:
        terms.append(ds.Gravity(calm * 9.81 * (rng.uniform(0.5, 1.5) * -push + 0.3 * rng.standard_normal(3))))
    if kind.drag:
        terms.append(ds.Drag(rng.uniform(0.2, 5.0)))
    if kind.forces != "none":
        terms.append(_forces(kind, rng, mesh, steps, mass.mean()))
    if kind.self_contact:
        stiffness, rough = calm * stiff * rng.uniform(0.05, 0.3), newer.rough(kind, seed, mesh, duration)
        terms.append(ds.SelfContact(stiffness=stiffness, width=bodies.SELF_WIDTH, **rough))
    terms = [terms[k] for k in rng.permutation(len(terms))]
    more = np.random.default_rng([21, seed])
    for name in kind.loads:
        own = load(name, more, mesh, steps, duration, mass.sum())
        terms.insert(int(more.integers(0, len(terms) + 1)), own)
    more = np.random.default_rng([22, seed])
    for name in kind.lines:
        terms.append(tie(name, more, mesh, steps, duration, mass, beat))

    terms += newer.muscles(kind, seed, mesh, steps, duration, E)
    terms += newer.couplings(kind, seed, mesh, steps, duration, E, start, [] if fixed is None else fixed)
    if kind.chamber:
        own = chamber(kind.chamber, more, mesh, start, steps, duration, E)
        terms.insert(int(more.integers(0, len(terms) + 1)), own)

    velocities = None
    if not kind.static and rng.random() < 0.9:
        speed = calm * 0.05 * CELL / duration * rng.uniform(0.3, 1.5)
        velocities = speed * (rng.standard_normal(3) - push + 0.3 * rng.standard_normal(start.shape))
        if way is not None and mesh.num_pieces == 2:
            velocities[mesh.vertex_sets["body_1"]] -= speed * way
    motion = smooth_path(rng, calm * 0.05 * CELL, duration) if kind.motion else None
    deformed = start if np.any(start != mesh.vertices) else None
    scene = ds.Scene(
        mesh,
        law,
        density,
        terms,
        fixed=supports if kind.rollers else fixed,
        motion=motion,
        initial_positions=deformed,
        initial_velocities=velocities,
        precision=kind.precision,
        volume=kind.volume,
        mass_scaling=newer.mass_scaling(kind, seed),
        reduced=newer.reduced(kind, seed, mesh, supports if kind.rollers else fixed, deformed is not None),
    )
    scene = newer.accepted(kind, scene)
    options = dict(save_every=int(rng.choice([k for k in range(1, steps + 1) if steps % k == 0])), gradients="all")
    solver = _solver(kind, scene, dt, substeps)
    return Configuration(seed, kind, solver, steps, options, placed, schedule, paths, terms, calm)


def _fixed(kind, rng, mesh):
    """Vertices to hold; for statics three of every piece."""
    pieces = [mesh.vertex_sets[name] for name in mesh.vertex_sets if re.fullmatch(r"body_\d+", name)] or [
        np.arange(mesh.num_vertices)
    ]
    if kind.static:
        return np.sort(np.concatenate([np.sort(rng.permutation(piece)[:3]) for piece in pieces]))
    return np.sort(rng.permutation(mesh.num_vertices)[: rng.integers(1, 4)])


def _schedule(kind, rng, mesh, E, density, bent) -> tuple[int, int, float]:
    if kind.static:
        return int(rng.integers(1, 3)), int(rng.integers(1, 3)), 1.0
    corners = mesh.vertices[mesh.tetrahedra]
    D = np.moveaxis(corners[:, 1:] - corners[:, :1], 1, 2)
    B = np.linalg.inv(D)
    altitude = 1 / np.linalg.norm(np.concatenate([B, B.sum(1, keepdims=True)], 1), axis=2).max()
    substep = rng.uniform(0.2, 0.4) * altitude / np.sqrt(5 * E / density) * (0.5 if bent else 1.0)
    substep *= 0.35 if mesh.order == 2 else 1.0  # whose nodes are nearer and lighter
    if kind.explicit:
        steps, substeps = int(rng.integers(2, 13)), int(rng.integers(1, 4))
        return steps, substeps, float(substep * substeps)
    steps, substeps = int(rng.integers(2, 5)), int(rng.integers(1, 3))
    return steps, substeps, float(5 * substep * substeps)


def _obstacles(kind, seed, rng, mesh, start, fixed, stiff, duration, calm) -> tuple[list, list, np.ndarray]:
    """(obstacles, their paths, the direction in which the first of them pushes)."""
    free = np.setdiff1d(np.arange(len(start)), [] if fixed is None else fixed)
    placed, paths, push = [], [], None
    for o in kind.obstacles:
        for _ in range(20):  # so that the lowest vertex is free to move
            n = push_direction(o.name, rng)
            if np.argmin(start @ n) in free:
                break
        below = None
        if o.narrow:  # a face of free corners, if there is one
            faces = outer_triangles(mesh) if kind.chamber else mesh.surface_triangles
            loose = faces[np.isin(faces, free).all(1)] if np.isin(faces, free).all(1).any() else faces
            corners = start[loose[rng.integers(0, len(loose))]]
            across = np.cross(corners[1] - corners[0], corners[2] - corners[0])
            below, n = corners.mean(0), -across / np.linalg.norm(across)
        push = n if push is None else push
        width = MESH_WIDTH if o.name == "MeshObstacle" else CELL * rng.uniform(0.25, 0.5)
        options = dict(stiffness=stiff * rng.uniform(0.3, 1.0) * (10 if o.narrow else 1))  # of few points
        if o.per_area:  # no vertex's barrier is stiffer
            largest = SurfaceAreas(mesh).value(mesh.vertices)[0].max()
            options = dict(stiffness_per_area=options["stiffness"] / largest)
        if o.friction:
            typical = 0.05 * CELL / duration
            options |= dict(friction=rng.uniform(0.1, 0.8), friction_speed=typical * 10 ** rng.uniform(-1.0, 0.8))
        path = smooth_path(rng, calm * 0.05 * CELL, duration) if o.path else None
        moved = newer.pose(kind, seed, len(placed), path, start, duration, calm)
        late = newer.comes_late(o, seed, len(placed))
        placed.append(place(o, rng, start, n, width, options | moved, below, calm, late))
        paths.append(moved["path"])
    return placed, paths, rng.standard_normal(3) if push is None else push


def _forces(kind, rng, mesh, steps, mass):
    chosen = np.sort(rng.permutation(mesh.num_vertices)[: rng.integers(1, mesh.num_vertices + 1)])
    if kind.forces == "constant" and rng.random() < 0.3:
        return ds.ExternalForce(5 * mass * rng.standard_normal(3))
    shape = (len(chosen), 3) if kind.forces == "constant" else (steps, len(chosen), 3)
    return ds.ExternalForce(5 * mass * rng.standard_normal(shape), chosen)


def _solver(kind, scene, dt, substeps):
    tolerance = 1e-11 if kind.precision == "f64" else 1e-6
    if kind.static:
        return ds.StaticSolver(scene, load_steps=substeps, tolerance=tolerance, parallel=kind.parallel)
    if kind.explicit:
        how = dict(contact=kind.contact, contact_damping=kind.contact_damping)
        if (
            kind.solver is ds.SemiImplicitSolver
            and scene.law.viscous
            and not (scene.holds_volumes or scene.reduced or scene.term(ds.MultiPointConstraint))
        ):
            how["viscous_stages"] = 1 + kind.number % 4
        return kind.solver(scene, dt=dt, substeps=substeps, parallel=kind.parallel, **how)
    return kind.solver(scene, dt=dt, substeps=substeps, tolerance=tolerance, parallel=kind.parallel)
