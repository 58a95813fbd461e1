"""Random wrong calls of public constructors: python tests/fuzz_calls.py --count 20000

One argument to four of each call are wrong, or another call's. Only ValueError and TypeError may come out, raised by a line
of the package, in one message. `--combinations 100` runs as many random scenes of laws, volumes, solvers, elements,
supports, outputs and pairs of terms, forwards, in reverse and in tangents: what does not go together is refused by the
constructor of the scene, the solver or the rollout, and not by the run. Prints every other; exit code 1 if there is one.
"""

import argparse
import sys
import traceback
import warnings
from functools import lru_cache
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from chamber_meshes import hollow_cube  # noqa: E402

import diffsim_ti as ds  # noqa: E402

NEO = ds.StableNeoHookean(1e5, 0.3)
LAWS = dict(
    stable=NEO,
    smith=ds.SmithNeoHookean(1e5, 0.3),
    linear=ds.LinearElastic(1e5, 0.3),
    corotated=ds.Corotated(1e5, 0.3),
    st_venant=ds.StVenantKirchhoff(1e5, 0.3),
    mooney=ds.MooneyRivlin(c10=2e4, c01=1e3, bulk_modulus=2e5),
    yeoh=ds.Yeoh(2e4, 1e3, 1e2, 2e5),
    gent=ds.Gent(2e4, 30.0, 2e5),
    ogden=ds.Ogden([2e4], [2.0], 2e5),
    fibres=ds.FibreReinforced(NEO, 1e4, 1.0, [1, 0, 0]),
    grown=ds.Grown(NEO, 0.01),
    orthotropic=ds.Orthotropic(9e5, 2e5, 1e5, 0.4, 0.5, 0.3, 1e5, 3e4, 1e5),
    tensioned=ds.InitialStress(NEO, [1e3, 0, 0, 0, 0, 0]),
    kelvin_voigt=ds.KelvinVoigt(NEO, time=1e-3),
    prony=ds.Prony(NEO, [0.5], [0.1]),
)
TETRAHEDRON = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]


@lru_cache
def body(order: int) -> ds.TetrahedralMesh:
    """A cube with a cavity, and a set of nine tetrahedra."""
    mesh = hollow_cube(3, 0.3)
    surface = {name: mesh.surface_triangles[rows] for name, rows in mesh.surface_sets.items()}
    sets = dict(vertex_sets=dict(mesh.vertex_sets), surface_sets=surface, tetrahedron_sets={"part": np.arange(9)})
    mesh = ds.TetrahedralMesh(mesh.vertices, mesh.tetrahedra, **sets)
    return mesh if order == 1 else mesh.quadratic()


LOW = float(body(1).vertices[:, 1].min())
WALLS = body(1).vertices[body(1).surface_triangles[body(1).surface_sets["cavity"]]]
CAVITY = -float(np.einsum("ti,ti->t", WALLS[:, 0], np.cross(WALLS[:, 1], WALLS[:, 2])).sum()) / 6  # its volume [m^3]
THIN = dict(width=0.005, stiffness=1e3)
TERMS = dict(
    gravity=lambda: ds.Gravity(),
    drag=lambda: ds.Drag(1.0),
    force=lambda: ds.ExternalForce([0, 0.1, 0], "bottom"),
    traction=lambda: ds.Traction(lambda t: (0, t, 0)),
    remote=lambda: ds.RemoteLoad((0, 0.1, 0, 0.01, 0, 0), "cavity"),
    relation=lambda: ds.MultiPointConstraint([0, 40], [[0, 1, 0], [0, -1, 0]], stiffness=1e4),
    pressure=lambda: ds.Pressure(10.0, "cavity"),
    gas=lambda: ds.GasChamber(1e3, "cavity"),
    filled=lambda: ds.FilledChamber(CAVITY, "cavity"),
    of_volume=lambda: ds.BodyForce([0, 1.0, 0], "part"),
    spring=lambda: ds.Spring(0, 40, 10.0),
    cable=lambda: ds.Cable([0, 40], 1.0),
    muscle=lambda: ds.Muscle((0, 1, 0), 1e3, lambda t: t, "part"),
    foundation=lambda: ds.ElasticFoundation(1e4, 0.0, "cavity"),
    fluid=lambda: ds.SurfaceDrag(10.0),
    turntable=lambda: ds.RotatingFrame((0, 1.0, 0)),
    growth=lambda: ds.Growth(lambda t: 0.1 * t),
    ground=lambda: ds.Ground(LOW - 0.01, friction=0.3, **THIN),
    turning=lambda: ds.HalfSpace((0, LOW - 0.01, 0), (0, 1, 0), path=lambda t: [0, 0, t, 0, t, 0], **THIN),
    sphere=lambda: ds.Sphere((0, LOW - 0.2, 0), 0.15, **THIN),
    mesh=lambda: ds.MeshObstacle(np.array([[0, -1, 0], [1, -1, 0], [0, -1, 1], [0, -2, 0.0]]), TETRAHEDRON, **THIN),
    itself=lambda: ds.SelfContact(1e3, 0.002, friction=0.2),
)
SOLVERS = dict(
    symplectic=lambda scene: ds.SemiImplicitSolver(scene, dt=1e-4),
    verlet=lambda scene: ds.VelocityVerletSolver(scene, dt=1e-4),
    euler=lambda scene: ds.ImplicitEulerSolver(scene, dt=1e-3),
    midpoint=lambda scene: ds.ImplicitMidpointSolver(scene, dt=1e-3),
    bdf2=lambda scene: ds.BDF2Solver(scene, dt=1e-3),
    static=lambda scene: ds.StaticSolver(scene),
)
OPTIONS = dict(
    none={},
    scaled=dict(mass_scaling=0.01),
    affine=dict(reduced={"part": "affine"}),
    rigid=dict(reduced={"part": "rigid"}),
    held=dict(fixed="bottom"),
    rollers=dict(fixed={"bottom": "y"}),
    motion=dict(fixed="bottom", motion=lambda t: (0, 0, 0.01 * t)),
)
OUTPUTS = dict(
    none=lambda terms: [],
    stress=lambda terms: [ds.Stress()],
    strain=lambda terms: [ds.Strain()],
    elastic=lambda terms: [ds.ElasticEnergy()],
    kinetic=lambda terms: [ds.KineticEnergy()],
    volume=lambda terms: [ds.EnclosedVolume("cavity")],
    contact=lambda terms: [ds.ContactForce(term) for term in terms if term.acts_on_surface][:1],
    reaction=lambda terms: [ds.Reaction("bottom")],
    work=lambda terms: [ds.WorkOfLoads(weight=True)],
    skin=lambda terms: [ds.SelfContactForce("part")],
)


def combination(seed: int, runs: bool = True) -> str | None:
    """What is wrong with how a random combination is refused, or runs; None if nothing is. runs: else it is only made."""
    rng = np.random.default_rng(seed)
    pick = lambda known: list(known)[rng.integers(len(known))]  # noqa: E731
    law, solver, support, output, pair = (
        pick(LAWS),
        pick(SOLVERS),
        pick(OPTIONS),
        pick(OUTPUTS),
        [pick(TERMS), pick(TERMS)],
    )
    order, volume = 1 + (rng.random() < 0.2), ("tetrahedra", "patches")[int(rng.random() < 0.25)]
    precision, made = ("f64", "f32")[int(rng.random() < 0.2)], False
    try:
        terms = [TERMS[name]() for name in pair]
        scene = ds.Scene(body(order), LAWS[law], 1000.0, terms, volume=volume, precision=precision, **OPTIONS[support])
        rollout = ds.Rollout(SOLVERS[solver](scene), 2, 1, outputs=OUTPUTS[output](terms), gradients="all")
        made = True
        if runs:
            frames = rollout.forward()
            rollout.vjp(frames, np.ones(frames.positions.shape))
            rollout.tangents(frames, initial_velocities=np.ones(scene.mesh.vertices.shape))
    except FloatingPointError as error:  # of a run alone
        said = None if made else error
    except (ValueError, TypeError) as error:
        ours = traceback.extract_tb(error.__traceback__)[-1].filename.startswith(str(Path(ds.__file__).parent))
        said = error if made or not ours else None
    except Exception as error:
        said = error
    else:
        said = None
    what = law, solver, support, output, *pair, order, volume, precision
    return said and f"seed {seed}, {what}: {type(said).__name__} of the {'run' if made else 'constructors'}: {said}"


def main() -> int:
    from test_calls import drawn

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=2000, help="calls; default 2000")
    parser.add_argument("--combinations", type=int, default=0, help="scenes that are run instead; half a minute each")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    ds.init(precision="f64")
    warnings.simplefilter("ignore")
    bad, first, combinations = 0, arguments.seed, arguments.combinations
    scenes = (combination(seed) for seed in range(first, first + combinations))
    for said in filter(None, scenes) if combinations else drawn(arguments.count, first):
        bad += 1
        print(said, flush=True)
    what = f"{combinations} combinations" if combinations else f"{arguments.count} calls"
    print(f"{bad} of {what} failed in words that are not ours, or too late")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
