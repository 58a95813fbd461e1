"""Wrong calls: of public constructors, and wrong numbers of runs. Only errors of the package come out, in one line."""

import traceback
from contextlib import nullcontext
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from fuzz_calls import LAWS, OPTIONS, TERMS, TETRAHEDRON, body, combination

import diffsim_ti as ds
from diffsim_ti.common.checked import shown
from diffsim_ti.diff_simulator import rollout_frames
from diffsim_ti.materials import Material

PACKAGE = str(Path(ds.__file__).parent)
WRONG = (
    *(None, "a", "", b"x", 0, -1, 3, 2.5, np.nan, np.inf, -np.inf, 1e300, 10**400, True, 1j, object(), type),
    *([], [1], [1, 2, 3], ["a"], [None], [[1, 2], [3]], {}, {"a": 1}, {1: 2}, (), set(), lambda: 3, lambda t: "x"),
    *(np.zeros(0), np.zeros((2, 3)), np.zeros((8, 3)), np.full((8, 3), np.nan), np.zeros(5, bool), np.array("x")),
    *(
        np.zeros((0, 3)),
        np.zeros((3, 8)),
        np.zeros((8, 3), "f4"),
        np.zeros((8, 3), int),
        np.zeros(8, complex),
        range(0),
    ),
    *([[]], [()], {"xmin": []}, {"xmin": ""}, frozenset(), np.zeros((1, 8, 3)), np.zeros((2, 8, 3)), np.zeros((8, 0))),
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
        "Orthotropic": (ds.Orthotropic, dict(E1=9.0, E2=2.0, nu12=0.3, nu23=0.4, G12=1.0, direction_1=[1, 0, 0])),
        "InitialStress": (ds.InitialStress, dict(material=ds.StableNeoHookean(1e5, 0.3), stress=[1, 0, 0, 0, 0, 0])),
        "KelvinVoigt": (ds.KelvinVoigt, dict(material=ds.StableNeoHookean(1e5, 0.3), time=0.01)),
        "Prony": (ds.Prony, dict(material=ds.StableNeoHookean(1e5, 0.3), shares=[0.5], times=[0.1])),
        "J2Plasticity": (
            ds.J2Plasticity,
            dict(youngs_modulus=1e5, poissons_ratio=0.3, yield_stress=1e3, hardening=1e2, kinematic_hardening=1e2),
        ),
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
        "create_box": (ds.TetrahedralMesh.create_box, dict(resolution=2, size=1.0, origin=(0, 0, 0), pattern="kuhn")),
        "Growth": (ds.Growth, dict(growth=0.1, tetrahedra=None, per="all", name=None)),
        "RotatingFrame": (ds.RotatingFrame, dict(angular_velocity=[0, 1, 0], center=[0, 0, 0], name=None)),
        "SurfaceDrag": (ds.SurfaceDrag, dict(density=1.0, normal=1.0, tangential=0.1, stream=[0, 0, 0], surface=None)),
        "Tie": (tied, dict(a="body_0_xmax", b="body_1_xmin", tolerance=None, name=None)),
        "MeshObstacle": (
            ds.MeshObstacle,
            dict(vertices=[[0, -3, 0], [1, -3, 0], [0, -3, 1], [0, -4, 0]], triangles=TETRAHEDRON, resolution=4) | wall,
        ),
        "Pose": (of_motion, dict(path=lambda t: [0, t, 0, 0, 0, t], about=[0, 0, 0])),
        "Strain": (output_of(ds.Strain), dict(name="s", at="tetrahedra", principal=False)),
        "KineticEnergy": (output_of(ds.KineticEnergy), dict(sets=None, name="e")),
        "WorkOfLoads": (output_of(ds.WorkOfLoads), dict(weight=True, name="w")),
        "UnequalSteps": (ds.UnequalSteps, dict(lengths=[1e-3], substeps=1)),
        "MaterialPoints": (ds.MaterialPoints, dict(points=[[0.5, 0.5, 0.5]], name="x", nearest=False)),
    }


# also of what runs take: letters, what is imaginary, tensors, and arrays of frames
OF_RUNS = WRONG + (
    *(np.full((8, 3), 1j), np.full((8, 3), "1"), np.array([1, "a"], object), torch.zeros(8, 3, requires_grad=True)),
    *(np.full((3, 8, 3), np.nan), np.zeros((2, 3, 8, 3)), [[[1]]], torch.zeros(3)),
)


@lru_cache
def runs() -> dict:
    """{name: what is called with one wrong argument}"""
    mesh = objects()["mesh"]
    terms = [ds.Gravity(), ds.Ground(-0.1, friction=0.3), ds.Muscle((0, 1, 0), 1e3, np.ones(2))]
    terms += [ds.ExternalForce(np.zeros((8, 3))), ds.Spring([0, 1], [5, 7], 9.0)]
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), terms=terms, precision="f64")
    solver = ds.SemiImplicitSolver(scene, dt=1e-3)
    simulator, out = ds.Simulator(solver.for_scene(scene)), {}
    for run in (ds.Rollout(solver, 2, 1, gradients="all"), ds.Batch(solver, 2, 2, 1, gradients="all")):
        kind, frames = type(run).__name__, run.forward()
        for name in run.inputs:
            out[f"{kind}.forward({name})"] = lambda x, run=run, name=name: run.forward(**{name: x})
            out[f"{kind}.tangents({name})"] = lambda x, f=frames, run=run, name=name: run.tangents(f, **{name: x})
            out[f"rollout_frames({kind}, {name})"] = lambda x, run=run, name=name: rollout_frames(run, **{name: x})
        for name in ("positions", "velocities"):
            out[f"{kind}.vjp({name})"] = lambda x, f=frames, run=run, name=name: run.vjp(f, **{name: x})
        out[f"{kind}.vjp(frames)"] = lambda x, run=run, seed=0 * frames.positions: run.vjp(x, seed)
        out[f"{kind}.tangents(frames)"] = lambda x, run=run: run.tangents(x, density=1.0)
        out[f"{kind}.field"] = run.field
    for name in ("positions", "velocities"):
        out[f"set_state({name})"] = lambda x, name=name: simulator.set_state(**{name: x})
    out |= dict(set_forces=simulator.set_forces, set_substeps=simulator.set_substeps, simulator_run=simulator.run)
    for name in ("translated", "scaled", "rotated", "locate", "vertex_indices", "tetrahedron_indices", "faces_of"):
        out[f"mesh.{name}"] = getattr(mesh, name)
    return out | dict(joined=ds.TetrahedralMesh.joined, from_file=ds.TetrahedralMesh.from_file)


def of_motion(**arguments):
    """A motion as a scene takes it, which asks it for places."""
    return objects()["scene"].replace(fixed="xmin", motion=ds.Pose(**arguments))


def tied(**arguments):
    """Two cubes that a scene glues."""
    mesh = objects()["mesh"]
    both = ds.TetrahedralMesh.joined([mesh, mesh.translated([1, 0, 0])])
    return objects()["scene"].replace(mesh=both, terms=[ds.Tie(**arguments)])


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
    if isinstance(out, ds.Rollout):
        out.forward()
    if isinstance(out, Material):
        return ds.Scene(objects()["mesh"], out, precision="f64")
    if hasattr(out, "check") and hasattr(out, "described"):
        return ds.Scene(objects()["mesh"], ds.StableNeoHookean(1e5, 0.3), terms=[out], precision="f64")
    return out


def complaint(make, arguments: dict) -> str | None:
    """What is wrong with how a call fails; None if it does not, or as it should."""
    try:
        made(make, arguments)
    except (ValueError, TypeError, FloatingPointError) as error:  # the last: a run that such numbers break
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
def test_wrong_arguments_of_runs():
    """Numbers of a run, seeds, tangents, states: refused by the package in one message, or a run that says where it ends.

    Of a rollout, as of a batch, every other input gets a wrong number: by a run, a tangent or torch in turn.
    """
    by_turns = [f"{call}(" for call in ("Rollout.forward", "Rollout.tangents", "Batch.forward", "Batch.tangents")]
    bad = [
        f"{name}({shown(wrong)}): {said}"
        for k, (name, call) in enumerate(runs().items())
        for j, wrong in enumerate(OF_RUNS)
        if (k + j) % 6 == 0 or name.endswith("(frames)") or not name.startswith((*by_turns, "rollout_frames("))
        if (said := complaint(lambda x: call(x), dict(x=wrong))) is not None and "does not exist" not in said
    ]
    assert not bad, "\n".join(bad)


@pytest.mark.parametrize("wrong", [np.full((8, 3), 1j), np.full((8, 3), "1")], ids=["imaginary", "letters"])
def test_numbers_are_not_read_from_what_is_none(wrong):
    for name in (
        "Rollout.forward(initial_velocities)",
        "Batch.forward(rest_positions)",
        "set_state(positions)",
        "set_forces",
    ):
        with pytest.raises(ValueError, match="must be numbers"):
            runs()[name](wrong)


def test_tensors_with_a_graph_are_not_cut_off():
    with pytest.raises(ValueError, match=r"youngs_modulus is a tensor with a graph.*rollout_frames"):
        runs()["Rollout.forward(youngs_modulus)"](torch.tensor(1e5, requires_grad=True))


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


@pytest.mark.filterwarnings("ignore")
def test_what_does_not_go_together_is_refused_in_our_words():
    """Combinations of laws, terms, solvers, elements and outputs, as they are made; `fuzz_calls.py` runs them, too."""
    for known in (TERMS, OPTIONS):
        for make in known.values():  # else nothing below means anything
            ds.Scene(body(1), LAWS["stable"], terms=make()) if callable(make) else ds.Scene(
                body(1), LAWS["stable"], **make
            )
    assert not [said for said in (combination(seed, runs=False) for seed in range(60)) if said]


@pytest.mark.parametrize("volume", ["tetrahedra", "patches"])
def test_laws_that_patches_do_not_support_are_refused_with_the_scene(volume):
    with pytest.raises(ValueError, match='take volume="tetrahedra"') if volume == "patches" else nullcontext():
        ds.Scene(objects()["mesh"], LAWS["kelvin_voigt"], volume=volume)


@pytest.mark.parametrize("steps", [[], (), np.zeros(0), ds.UnequalSteps])
def test_no_lengths_of_steps_are_refused(steps):
    with pytest.raises(ValueError, match="expected one number"):
        ds.UnequalSteps([]) if steps is ds.UnequalSteps else ds.Rollout(objects()["solver"], steps)


def test_unknown_options_of_init_are_refused():
    for name in ("architecture", "device", "fp"):
        with pytest.raises(TypeError, match=f"init has no argument '{name}'"):
            ds.init(**{name: "cpu"})


@pytest.mark.parametrize("suffix, package", [("xdmf", "h5py"), ("med", "h5py"), ("e", "netCDF4")])
def test_formats_name_the_package_that_they_need(tmp_path, suffix, package):
    if find_spec(package):
        return  # and works
    (tmp_path / f"b.{suffix}").write_bytes(b"")
    save, read = objects()["mesh"].save, ds.TetrahedralMesh.from_file
    for call in (lambda: save(tmp_path / f"a.{suffix}"), lambda: read(tmp_path / f"b.{suffix}")):
        with pytest.raises((ImportError, ValueError), match=f"pip install {package}|cannot read"):
            call()
