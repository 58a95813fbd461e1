"""Wrong calls of public constructors: only ValueError and TypeError come out, raised by the package, in one line."""

import traceback
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

import diffsim_ti as ds
from diffsim_ti.checked import shown
from diffsim_ti.materials import Material

PACKAGE = str(Path(ds.__file__).parent)
WRONG = (
    *(None, "a", "", b"x", 0, -1, 3, 2.5, np.nan, np.inf, -np.inf, 1e300, 10**400, True, 1j, object(), type),
    *([], [1], [1, 2, 3], ["a"], [None], [[1, 2], [3]], {}, {"a": 1}, {1: 2}, (), set(), lambda: 3, lambda t: "x"),
    *(np.zeros(0), np.zeros((2, 3)), np.zeros((8, 3)), np.full((8, 3), np.nan), np.zeros(5, bool), np.array("x")),
)


@lru_cache
def objects() -> dict:
    mesh = ds.TetrahedralMesh.create_cube(2)
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), terms=[ds.Gravity()], precision="f64")
    return dict(mesh=mesh, scene=scene, solver=ds.BDF2Solver(scene, dt=1e-3))


def calls() -> dict:
    """{name: (what is called, its right arguments)}"""
    mesh, scene, solver = objects().values()
    body = dict(mesh=mesh, material=ds.StableNeoHookean(1e5, 0.3))
    wall = dict(stiffness_per_area=1e6, width=0.01, friction=0.3, friction_speed=1e-3, path=None, name=None)
    steps = dict(scene=scene, dt=1e-4, substeps=1, parallel=None)
    optional = dict(density=1e3, terms=(), fixed=None, motion=None, initial_positions=None, initial_velocities=None)
    return {
        "Scene": (
            ds.Scene,
            body | optional | dict(precision=None, volume="tetrahedra", mass_scaling=None, reduced=None),
        ),
        "create_cube": (ds.TetrahedralMesh.create_cube, dict(resolution=2, size=1.0, pattern="kuhn")),
        "TetrahedralMesh": (ds.TetrahedralMesh, dict(vertices=mesh.vertices, tetrahedra=mesh.tetrahedra)),
        "StableNeoHookean": (ds.StableNeoHookean, dict(youngs_modulus=1e5, poissons_ratio=0.3)),
        "Yeoh": (ds.Yeoh, dict(c10=1e4, c20=0.0, c30=0.0, bulk_modulus=1e5)),
        "Ogden": (ds.Ogden, dict(moduli=[1e4], exponents=[2.0], bulk_modulus=1e5)),
        "FibreReinforced": (
            ds.FibreReinforced,
            dict(matrix=ds.StableNeoHookean(1e5, 0.3), k1=1e4, k2=1.0, fibre=[1, 0, 0]),
        ),
        "KelvinVoigt": (ds.KelvinVoigt, dict(material=ds.StableNeoHookean(1e5, 0.3), time=0.01)),
        "Prony": (ds.Prony, dict(material=ds.StableNeoHookean(1e5, 0.3), shares=[0.5], times=[0.1])),
        "Gravity": (ds.Gravity, dict(acceleration=-9.81)),
        "Drag": (ds.Drag, dict(rate=1.0)),
        "Ground": (ds.Ground, dict(height=-1.0) | wall),
        "Sphere": (ds.Sphere, dict(center=[0, -3, 0], radius=1.0, inside=False) | wall),
        "Box": (ds.Box, dict(center=[0, -3, 0], size=[1, 1, 1]) | wall),
        "HalfSpace": (ds.HalfSpace, dict(point=[0, -1, 0], normal=[0, 1, 0]) | wall),
        "Capsule": (ds.Capsule, dict(start=[0, -3, 0], end=[1, -3, 0], radius=1.0) | wall),
        "Cylinder": (ds.Cylinder, dict(start=[0, -3, 0], end=[1, -3, 0], radius=1.0) | wall),
        "SelfContact": (ds.SelfContact, dict(stiffness=1e4, width=1e-3, name=None, friction=0.3, friction_speed=1e-3)),
        "ExternalForce": (ds.ExternalForce, dict(forces=[0, 1, 0], vertices="xmax", name=None)),
        "Traction": (ds.Traction, dict(traction=[0, 1, 0], surface="xmax", name=None)),
        "BodyForce": (ds.BodyForce, dict(force=[0, 1, 0], tetrahedra=None, per="volume", name=None)),
        "ElasticFoundation": (ds.ElasticFoundation, dict(surface="ymin", normal=1e4, tangential=1.0, name=None)),
        "Anchor": (ds.Anchor, dict(position=[0, 0, 0])),
        "Gent": (ds.Gent, dict(mu=1e4, limit=30.0, bulk_modulus=1e5)),
        "Grown": (ds.Grown, dict(material=ds.StableNeoHookean(1e5, 0.3), growth=0.1)),
        "Stress": (
            output_of(ds.Stress),
            dict(name="s", at="tetrahedra", principal=False, kind="cauchy", von_mises=False),
        ),
        "Reaction": (output_of(ds.Reaction), dict(support=None, name="r", about=None, per_vertex=False)),
        "EnclosedVolume": (output_of(ds.EnclosedVolume), dict(triangles=None, name="v")),
        "ElasticEnergy": (output_of(ds.ElasticEnergy), dict(sets=None, name="e")),
        "Unknown": (ds.Unknown, dict(start=1.0, range=None, regions=None, input=None, scale=None, experiments=None)),
        "Measurement": (ds.Measurement, dict(output="positions", values=[1.0], noise=1.0, at=None, times=None)),
        "Batch": (ds.Batch, dict(solver=solver, steps=2, scenes=2, save_every=1, lanes=None)),
        "stable_dt": (ds.stable_dt, dict(scene=scene)),
        "modes": (ds.modes, dict(scene=scene, k=1, displacements=None)),
        "Spring": (ds.Spring, dict(start=0, end=7, stiffness=1.0, rest_length=None, tension=None, name=None)),
        "Cable": (ds.Cable, dict(points=[0, 7], tension=1.0, length=None, stiffness=None)),
        "Muscle": (ds.Muscle, dict(fibre=[1, 0, 0], stress=1.0, activation=1.0, tetrahedra=None, per="all")),
        "Pressure": (ds.Pressure, dict(pressure=1.0, surface=None)),
        "VelocityVerletSolver": (ds.VelocityVerletSolver, steps | dict(contact="stage", contact_damping=0.01)),
        "BDF2Solver": (ds.BDF2Solver, steps | dict(tolerance=1e-6, max_iterations=9, preconditioner="auto")),
        "StaticSolver": (ds.StaticSolver, dict(scene=scene.replace(fixed="xmin"), load_steps=1, tolerance=1e-8)),
        "Simulator": (ds.Simulator, dict(solver=solver)),
        "Rollout": (
            ds.Rollout,
            dict(solver=solver, steps=4, save_every=2, checkpoint_every=None, memory=None, gradients=None)
            | dict(clip=None, truncate=None, health=False, outputs=(), runs=None),
        ),
        "UnequalSteps": (ds.UnequalSteps, dict(lengths=[1e-3], substeps=1)),
        "MaterialPoints": (ds.MaterialPoints, dict(points=[[0.5, 0.5, 0.5]], name="x", nearest=False)),
    }


def output_of(kind):
    """An output as a rollout of a held body takes it, which looks at it."""

    def make(**arguments):
        held = ds.BDF2Solver(objects()["scene"].replace(fixed="xmin"), dt=1e-3)
        return ds.Rollout(held, 1, outputs=[kind(**arguments)])

    return make


def made(make, arguments: dict):
    """What a call makes; of terms also the scene, whose mesh they see later."""
    if make is ds.Simulator:
        return make(*arguments.values())
    out = make(**arguments)
    if isinstance(out, Material):
        return ds.Scene(objects()["mesh"], out, precision="f64")
    if hasattr(out, "check") and hasattr(out, "described"):
        return ds.Scene(objects()["mesh"], ds.StableNeoHookean(1e5, 0.3), terms=[out], precision="f64")
    return out


def complaint(make, arguments: dict) -> str | None:
    """What is wrong with how a call fails; None if it does not, or as it should."""
    try:
        made(make, arguments)
    except (ValueError, TypeError) as error:
        last = traceback.extract_tb(error.__traceback__)[-1].filename
        if not last.startswith(PACKAGE):
            return f"{type(error).__name__} of {last}: {error}"
        return None if len(str(error)) < 700 and str(error).strip() else f"message of {len(str(error))} letters"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return None


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", calls())
def test_wrong_arguments(name):
    make, right = calls()[name]
    made(make, right)  # else nothing below means anything
    bad = [
        f"{argument}={shown(wrong)}: {said}"
        for argument in right
        for wrong in WRONG
        if (said := complaint(make, right | {argument: wrong})) is not None
    ]
    assert not bad, "\n".join(bad)


@pytest.mark.filterwarnings("ignore")
def test_several_wrong_arguments_at_once():
    """Three hundred of what `fuzz_calls.py` draws."""
    assert not list(drawn(300, 0))


def drawn(count: int, seed: int):
    """What is wrong with random calls, in which one argument to four are replaced by wrong ones or another's."""
    rng, kinds = np.random.default_rng(seed), list(calls().items())
    others = [value for _, right in calls().values() for value in right.values()]
    for _ in range(count):
        name, (make, right) = kinds[rng.integers(len(kinds))]
        arguments = dict(right)
        for argument in rng.permutation(list(right))[: rng.integers(1, 5)]:
            pool = WRONG if rng.random() < 0.7 else others
            arguments[str(argument)] = pool[rng.integers(len(pool))]
        if (said := complaint(make, arguments)) is not None:
            changed = {key: shown(x) for key, x in arguments.items() if x is not right[key]}
            yield f"{name}({changed}): {said}"


def test_states_and_sizes_are_checked_at_once():
    with pytest.raises(ValueError, match="makes 1e"):
        ds.TetrahedralMesh.create_cube(10**9)
    simulator = ds.Simulator(objects()["solver"])
    before = simulator.positions
    with pytest.raises(ValueError, match="positions: expected finite numbers"):
        simulator.set_state(positions=np.full((8, 3), np.nan))
    assert np.array_equal(simulator.positions, before)
