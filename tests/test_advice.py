"""Advice that works: each error or warning that names an argument or a number to take is provoked, and its advice followed.

All such messages are collected from the source of the package. One that is in no table fails, and so does a row of a table
whose message is gone.
"""

import ast
import re
import warnings
from functools import lru_cache

import numpy as np
import pytest
import torch
from package_source import PACKAGE, modules

import diffsim_ti as ds
from diffsim_ti.cli.identify import numbers_of
from diffsim_ti.diff_simulator import rollout_frames
from diffsim_ti.scene.strength import check_strength
from diffsim_ti.study import recommend
from diffsim_ti.verify import gradient_health

ARGUMENT = re.compile(r"\b[a-z_]{3,}=")
NUMBER = re.compile(r"(?:^|[;:,] |or )(?:take|reduce|raise|lower|shorten|pass|let)\b[^;:{]*\{\}")
LAW, CUBE = ds.StableNeoHookean(1e5, 0.3), ds.TetrahedralMesh.create_cube(2)


def words(node) -> str:
    """The text of an expression, {} where a value stands."""
    if isinstance(node, ast.JoinedStr):
        return "".join(part.value if isinstance(part, ast.Constant) else "{}" for part in node.values)
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else ""


@lru_cache
def messages() -> list[tuple[str, str]]:
    """(file, text) of all that is raised or warned of, and of parts of it that are put together before, with advice."""
    out = []

    def look(node, said: bool) -> None:
        if text := words(node):
            if " " in text and (NUMBER.search(text) or ARGUMENT.search(text) and said):
                out.append((file, text))
            return
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):  # a docstring
            return
        said = said or _says(node)
        for child in ast.iter_child_nodes(node):
            look(child, said)

    for path, tree in modules().items():
        file = str(path.relative_to(PACKAGE))
        look(tree, False)
    return out


def _says(node) -> bool:
    if isinstance(node, ast.Call):
        name = getattr(node.func, "attr", getattr(node.func, "id", ""))
        return name == "warn" or name.endswith("Error")
    return isinstance(node, ast.Raise)


def scene(**options) -> ds.Scene:
    return ds.Scene(options.pop("mesh", CUBE), options.pop("law", LAW), precision="f64", **options)


def related_path(**stiffness) -> None:
    """Modes and a path with a relation, which ends where an exact one does."""
    held = lambda **how: [ds.Gravity(), ds.MultiPointConstraint([7], [[0, 1, 0]], **how)]  # noqa: E731
    ds.modes(scene(terms=held(**stiffness), fixed="xmin"), 1)
    path = ds.load_path(scene(terms=held(**stiffness), fixed="xmin"), "gravity", steps=1)
    exact = scene(terms=[ds.Gravity((0, -9.81 * path.factors[-1], 0)), *held()[1:]], fixed="xmin")
    u = ds.Rollout(ds.StaticSolver(exact), 1).forward().displacements[-1]
    np.testing.assert_allclose(path.displacements[-1], u, atol=1e-3 * abs(u).max())


def verlet(**options):
    own = {name: options.pop(name) for name in ("contact", "dt", "substeps", "allow_unstable") if name in options}
    return ds.VelocityVerletSolver(scene(**options), dt=own.pop("dt", 1e-3), **own)


TORCH_E = torch.tensor(1e5, dtype=torch.float64, requires_grad=True)
JOINED = ds.TetrahedralMesh.joined([CUBE, CUBE.translated([3, 0, 0])])
BLOCK = ds.TetrahedralMesh.create_box(4)
HOLLOW = ds.TetrahedralMesh(BLOCK.vertices, BLOCK.tetrahedra[(np.abs(BLOCK.centroids - 0.5) > 1 / 6).any(1)])
HOLLOW = HOLLOW.with_surface_set("inside", lambda x, n: (np.abs(x - 0.5) < 0.3).all(1))
GROUND = ds.Ground(-0.1, stiffness=1e3, width=0.01)
WIDE = dict(law=ds.StableNeoHookean(1e5, 0.48))
RIGID = dict(mesh=JOINED, terms=[GROUND], reduced={"body_0": "rigid"})


def advised(wrong) -> float:
    """The number that an error advises."""
    with pytest.raises(ValueError) as said:
        wrong()
    return float(re.search(r"(?:substeps=|modulus to |width below )([0-9.e+-]+)", str(said.value))[1])


def strong(E: float) -> None:
    check_strength(scene(law=ds.StableNeoHookean(E, 0.3), terms=[ds.Gravity(), ds.Ground(-0.01)]))


def stiff(**options):
    return verlet(law=ds.StableNeoHookean(1e9, 0.3), **options)


def bent(width: float) -> None:
    """Two bars of ten-node tetrahedra, one upon the other, bent by far more than contact between them cuts faces."""
    bar = ds.TetrahedralMesh.create_box([3, 2, 2], [1.0, 0.2, 0.2])
    mesh = ds.TetrahedralMesh.joined([bar, bar.translated([0, 0.20002, 0])]).quadratic()
    start = mesh.vertices + np.outer(0.4 * (mesh.vertices[:, 0] - 0.5) ** 2, [0, 1, 0])
    terms = [ds.SelfContact(1e3, width)]
    ds.Simulator(ds.SemiImplicitSolver(scene(mesh=mesh, terms=terms, initial_positions=start), dt=1e-5)).step()


def health(**options) -> None:
    rollout = ds.Rollout(verlet(), 2, **options)
    frames = rollout.forward()
    rollout.vjp(frames, np.ones(frames.positions.shape))
    gradient_health(rollout)


def rigid(precision: str) -> None:
    """Steel on the scale of atoms, whose numbers are beyond float32's range."""
    mesh = ds.TetrahedralMesh.create_cube(2, size=1e-12)
    ds.stable_dt(ds.Scene(mesh, ds.StableNeoHookean(1e-30, 0.3), precision=precision))


def globe(precision: str, radius: float) -> None:
    ball = ds.Sphere([0.5, -radius - 0.1, 0.5], radius, stiffness=1e3, width=0.01)
    ds.Scene(CUBE, LAW, terms=[ball], precision=precision)


def weighed(output=None) -> None:
    asked = dict(gradients=False, elements=False, output=output, weights=(0, 1, 0))
    recommend(scene(terms=[ds.Gravity()], fixed="ymin"), 0.0, **asked)


def recommended(tolerance: float) -> None:
    recommend(scene(terms=[ds.Gravity()], fixed="ymin"), 0.01, tolerance, gradients=False, budget=0.5, elements=False)


def fitted(gradients) -> None:
    """Young's modulus from where a falling cube is, by a rollout with these gradients."""
    rollout = ds.Rollout(verlet(terms=[ds.Gravity()], fixed="ymax"), 2, gradients=gradients)
    data = ds.Measurement("positions", rollout.forward().positions, 1e-9)
    ds.identify(rollout, data, {"youngs_modulus": 1.1e5}, method="L-BFGS-B")


def relaxing(*outputs) -> None:
    solver = verlet(law=ds.Prony(LAW, [0.5], [0.1]))
    frames = ds.Rollout(solver, 1, outputs=outputs).forward()
    ds.Stress().settled(solver.scene).value(frames)


# (file, part of the message): (what provokes it, the same as it advises)
FOLLOWED = {
    ("batch/batch.py", "leave out lanes=True"): (
        lambda: ds.Batch(ds.BDF2Solver(scene(terms=[ds.SelfContact()]), dt=1e-3), 2, 2, lanes=True),
        lambda: ds.Batch(ds.BDF2Solver(scene(terms=[ds.SelfContact()]), dt=1e-3), 2, 2),
    ),
    ("scene/locking.py", "where {} tetrahedra lock"): (lambda: scene(**WIDE), lambda: scene(**WIDE, volume="patches")),
    ("materials/patch_law.py", "averages energies, but"): (
        lambda: scene(law=ds.KelvinVoigt(LAW, time=0.1), volume="patches"),
        lambda: scene(law=ds.KelvinVoigt(LAW, time=0.1), volume="tetrahedra"),
    ),
    ("materials/grown.py", "does not support it"): (
        lambda: scene(terms=[ds.Growth(0.1)], volume="patches"),
        lambda: (scene(terms=[ds.Growth(0.1)]), scene(terms=[ds.Growth(0.1)], mesh=CUBE.quadratic())),
    ),
    ("mesh/checks.py", "pass fix_orientation=True"): (
        lambda: ds.TetrahedralMesh(CUBE.vertices, CUBE.tetrahedra[:, [1, 0, 2, 3]]),
        lambda: ds.TetrahedralMesh(CUBE.vertices, CUBE.tetrahedra[:, [1, 0, 2, 3]], fix_orientation=True),
    ),
    ("mesh/locate.py", "lie outside the mesh"): (
        lambda: ds.Rollout(verlet(), 1, outputs=[ds.Stress(at=[[2.0, 0.5, 0.5]])]),
        lambda: ds.Rollout(verlet(), 1, outputs=[ds.Stress(at=CUBE.locate([[2.0, 0.5, 0.5]], nearest=True).points)]),
    ),
    ("outputs/modes.py", "has no modes here"): (
        lambda: ds.modes(scene(mesh=JOINED, reduced={"body_0": "rigid"}), 1),
        lambda: ds.modes(scene(mesh=JOINED), 1),
    ),
    ("outputs/contact_force.py", "give about= or per_vertex=True"): (
        lambda: ds.ContactForce("a", about=(0, 0, 0), per_vertex=True),
        lambda: (ds.ContactForce("a", about=(0, 0, 0)), ds.ContactForce("a", per_vertex=True)),
    ),
    ("outputs/output.py", "these frames do not have what {} remembers"): (relaxing, lambda: relaxing(ds.Stress())),
    ("outputs/reaction.py", "give about= or per_vertex=True"): (
        lambda: ds.Reaction(about=(0, 0, 0), per_vertex=True),
        lambda: (ds.Reaction(about=(0, 0, 0)), ds.Reaction(per_vertex=True)),
    ),
    ("outputs/reaction.py", "must be among the fixed vertices"): (
        lambda: ds.Rollout(verlet(), 1, outputs=[ds.Reaction("xmin")]),
        lambda: ds.Rollout(verlet(fixed="xmin"), 1, outputs=[ds.Reaction("xmin")]),
    ),
    ("outputs/self_contact_force.py", "give on="): (
        lambda: ds.SelfContactForce(),
        lambda: (ds.SelfContactForce("xmin"), ds.SelfContactForce(per_vertex=True)),
    ),
    ("outputs/energies.py", "the scene has no load"): (
        lambda: ds.Rollout(verlet(terms=[ds.Gravity()]), 1, outputs=[ds.WorkOfLoads()]),
        lambda: ds.Rollout(verlet(terms=[ds.Gravity()]), 1, outputs=[ds.WorkOfLoads(weight=True)]),
    ),
    ("outputs/output.py", "pass others to Rollout"): (
        lambda: ds.Rollout(verlet(), 0).forward()["kinetic"],
        lambda: ds.Rollout(verlet(), 0, outputs=[ds.KineticEnergy(name="kinetic")]).forward()["kinetic"],
    ),
    ("scene/scene.py", "pass fixed=..."): (
        lambda: scene(motion=lambda t: (0, t, 0)),
        lambda: scene(motion=lambda t: (0, t, 0), fixed="xmin"),
    ),
    ("rollout/simulator.py", "make the simulator with"): (
        lambda: ds.Simulator(verlet(terms=[GROUND])).output(ds.ContactForce(GROUND)),
        lambda: ds.Simulator(verlet(terms=[GROUND]), contact_forces=True).output(ds.ContactForce(GROUND)),
    ),
    ("rollout/simulator.py", "counts from the start of a run"): (
        lambda: ds.Simulator(verlet()).output(ds.WorkOfLoads(weight=True)),
        lambda: ds.Rollout(verlet(terms=[ds.Gravity()]), 0, outputs=[ds.WorkOfLoads(weight=True)]).forward(),
    ),
    ("mechanics/reduced/body_checks.py", "take obstacles as a force"): (
        lambda: verlet(**RIGID),
        lambda: verlet(**RIGID, contact="force"),
    ),
    ("solvers/explicit/solver.py", "are of obstacles that act as a stage"): (
        lambda: ds.Rollout(verlet(terms=[GROUND], contact="force"), 1, outputs=[ds.ContactForce(GROUND)]),
        lambda: ds.Rollout(verlet(terms=[GROUND], contact="stage"), 1, outputs=[ds.ContactForce(GROUND)]),
    ),
    ("solvers/implicit/solver.py", 'takes "block_jacobi"'): (
        lambda: ds.BDF2Solver(scene(**RIGID), preconditioner="multigrid"),
        lambda: [ds.BDF2Solver(scene(**RIGID), preconditioner=p) for p in ("block_jacobi", "auto")],
    ),
    ("solvers/semi_implicit.py", "has no viscosity"): (
        lambda: ds.SemiImplicitSolver(scene(), dt=1e-3, viscous_stages=3),
        lambda: (
            ds.SemiImplicitSolver(scene(), dt=1e-3),
            ds.SemiImplicitSolver(scene(law=ds.KelvinVoigt(LAW, time=1e-4)), dt=1e-4, viscous_stages=3),
        ),
    ),
    ("solvers/solver.py", "exceeds the stable step"): (
        lambda: stiff(substeps=1),
        lambda: (stiff(allow_unstable=True), stiff(substeps=int(advised(lambda: stiff(substeps=1))))),
    ),
    ("solvers/substeps.py", "if they are meant"): (
        lambda: stiff(dt=10.0),
        lambda: stiff(dt=10.0, substeps=int(advised(lambda: stiff(dt=10.0)))),
    ),
    ("terms/over_time.py", "names of sets"): (
        lambda: ds.Muscle((1, 0, 0), 1.0, [1.0], tetrahedra="left", per="set"),
        lambda: ds.Muscle((1, 0, 0), 1.0, [1.0, 1.0], tetrahedra=["left", "right"], per="set"),
    ),
    ("mesh/seed_names.py", "F varies within ten-node tetrahedra"): (
        lambda: CUBE.quadratic().compute_deformation_gradient(CUBE.quadratic().vertices),
        lambda: ds.Strain(stretches=True).settled(scene(mesh=CUBE.quadratic())),
    ),
    ("outputs/contact_force.py", "give on=, a set whose sum"): (
        lambda: ds.ContactForce("floor", on="xmin", per_vertex=True),
        lambda: (ds.ContactForce("floor", on="xmin"), ds.ContactForce("floor", per_vertex=True)),
    ),
    ("terms/obstacles/mesh_obstacle.py", "float32 cannot count"): (
        lambda: ds.MeshObstacle(CUBE.vertices, CUBE.surface_triangles).kernel("f32", 2**24),
        lambda: ds.MeshObstacle(CUBE.vertices, CUBE.surface_triangles).kernel("f64", 2**24),
    ),
    ("solvers/semi_implicit.py", "give it fixed=vertices"): (
        lambda: ds.SemiImplicitSolver(scene(), dt=1e-4).set_fixed_vertices("ymin"),
        lambda: ds.SemiImplicitSolver(scene(fixed="ymin"), dt=1e-4),
    ),
    ("runtime/start.py", "init has no argument"): (lambda: ds.init(device="cpu"), lambda: None),
    ("runtime/start.py", "cannot be chosen"): (lambda: ds.init("cpu", fast_math=True), lambda: None),
    ("torch_bridge/rollout_node.py", "but this rollout computes"): (
        lambda: rollout_frames(ds.Rollout(verlet(), 1, gradients=["initial_positions"]), density=TORCH_E),
        lambda: [
            rollout_frames(ds.Rollout(verlet(), 1, gradients=names), density=TORCH_E) for names in (["density"], "all")
        ],
    ),
    ("torch_bridge/rollout_node.py", "requires a gradient"): (
        lambda: rollout_frames(ds.Batch(verlet(), 1, 2, gradients=["initial_positions"]), youngs_modulus=TORCH_E),
        lambda: rollout_frames(ds.Batch(verlet(), 1, 2, gradients="all"), youngs_modulus=TORCH_E),
    ),
    ("scene/strength.py", "raise Young's modulus to"): (
        lambda: strong(100.0),
        lambda: strong(advised(lambda: strong(100.0))),
    ),
    ("cli/identify.py", "expected input=guess"): (
        lambda: numbers_of(["youngs_modulus"]),
        lambda: numbers_of(["youngs_modulus=1e5"]),
    ),
    ("identification/problem.py", "has no gradient by"): (
        lambda: fitted(["initial_positions"]),
        lambda: (fitted(["youngs_modulus"]), fitted("all")),
    ),
    ("monitor/stability.py", "in this precision"): (lambda: rigid("f32"), lambda: rigid("f64")),
    ("state/bending.py", "refine the mesh, or take a width of"): (lambda: bent(5e-5), lambda: bent(9.8e-5)),
    ("study/trials.py", "nothing tried meets"): (lambda: recommended(1e-7), lambda: recommended(0.05)),
    ("study/trials.py", "pass output="): (lambda: weighed(), lambda: weighed(ds.MaterialPoints([[0, 0, 0]]))),
    ("common/origin.py", "of the barrier's width"): (
        lambda: globe("f32", 1e7),
        lambda: (globe("f64", 1e7), globe("f32", 10.0)),
    ),
    ("mesh/enclosure.py", "the surface is open at the edge"): (
        lambda: scene(terms=[ds.FilledChamber(1.0, "ymin")], fixed="xmin"),
        lambda: scene(terms=[ds.FilledChamber(1.0, "inside")], mesh=HOLLOW),
    ),
    ("terms/growth.py", "takes growth of shape"): (
        lambda: scene(terms=[ds.Growth(np.zeros(2), per="tetrahedron")]),
        lambda: scene(terms=[ds.Growth(np.zeros(CUBE.num_tetrahedra), per="tetrahedron")]),
    ),
    ("terms/muscle.py", "takes activations of shape"): (
        lambda: scene(terms=[ds.Muscle((1, 0, 0), 1.0, np.ones(2), per="tetrahedron")]),
        lambda: scene(terms=[ds.Muscle((1, 0, 0), 1.0, np.ones(CUBE.num_tetrahedra), per="tetrahedron")]),
    ),
    ("scene/scene.py", "give them a name="): (
        lambda: ds.Rollout(verlet(terms=[ds.Spring(0, 1, 9.0)]), 1, outputs=ds.Length("rope")),
        lambda: ds.Rollout(verlet(terms=[ds.Spring(0, 1, 9.0, name="rope")]), 1, outputs=ds.Length("rope")),
    ),
    ("mechanics/constraints.py", "give it a stiffness="): (
        lambda: ds.StaticSolver(scene(terms=[ds.MultiPointConstraint([0], [[1, 0, 0]])], fixed="xmin")),
        lambda: ds.StaticSolver(scene(terms=[ds.MultiPointConstraint([0], [[1, 0, 0]], stiffness=1e9)], fixed="xmin")),
    ),
    ("outputs/modes.py", "give it a stiffness="): (related_path, lambda: related_path(stiffness=1e8)),
    ("outputs/load_path.py", "reduced=; leave it out"): (
        lambda: ds.load_path(
            scene(mesh=JOINED, reduced={"body_1": "affine"}, terms=[ds.Gravity()]), "gravity", steps=1
        ),
        lambda: ds.load_path(scene(terms=[ds.Gravity()], fixed="xmin"), "gravity", steps=1),
    ),
    ("outputs/smooth_maximum.py", "of must be an output"): (
        lambda: ds.SmoothMaximum("stress"),
        lambda: ds.SmoothMaximum(ds.Stress(von_mises=True)),
    ),
    ("outputs/smooth_maximum.py", "goes with kind="): (
        lambda: ds.SmoothMaximum(ds.Stress(), kind="ks"),
        lambda: ds.SmoothMaximum(ds.Stress(), kind="ks", scale=1e3),
    ),
    ("verify.py", "no health report"): (health, lambda: health(health=True)),
    ("mesh/grid.py", "vertices; take at most"): (
        lambda: ds.TetrahedralMesh.create_box(10**4, 1.0),
        lambda: ds.TetrahedralMesh.create_box(3, 1.0),
    ),
}

ANOTHER_MACHINE = "needs another machine, process, backend or build"
ELSEWHERE = {  # (file, part of the message): the test that provokes it and follows it, or why none does
    ("batch/taped.py", "its field is already"): "test_batch_tape.py",
    ("common/checked.py", "is a tensor with a graph"): "test_calls.py",
    ("mechanics/surfaces/surface_pairs.py", "take a width below"): "test_self_contact.py",
    ("mechanics/surfaces/contact_stage.py", "take substeps of {} s"): "test_self_contact.py, battery_of_throws.py",
    ("diff_simulator.py", "a two-step method"): "test_torch_solvers.py",
    ("identification/search.py", "take smaller steps"): "names neither an argument nor a number",
    ("inputs/inputs.py", "none of its inputs says that it is a place"): "test_far_from_origin.py",
    ("materials/patch_law.py", "does not say what its theta is"): "test_open_laws.py, with a law of one's own",
    ("mesh/checks.py", "in no tetrahedron"): "test_mesh.py",
    ("mesh/enclosure.py", "must not be moved"): "test_chambers.py",
    ("outputs/contact_slip.py", "pass friction= to it"): "test_contact_force.py",
    ("outputs/points.py", "take frames.computed"): "test_camera.py",
    ("monitor/guard.py", "vibrates at {} m/s"): "test_contact_friction.py",
    ("outputs/contact_slip.py", "a robot moves the obstacle"): "test_robots.py",
    ("mechanics/robots.py", "far from the origin in float32"): "test_robots.py",
    ("mechanics/robots.py", "leave out reduced= and Tie"): "test_robots.py",
    ("mechanics/robots.py", 'leave out contact="force"'): "test_robots.py",
    ("mechanics/robots.py", "whose steps end in half a kick"): "test_robots.py",
    ("mechanics/robots.py", "does not go with SelfContact"): "test_robots.py",
    ("mechanics/robots.py", "are held by two links"): "test_robots.py",
    ("mechanics/joints/joints.py", "needs forces with symmetric derivatives"): "test_robots.py",
    ("terms/robots/robot.py", "give a lower below the upper"): "test_robots.py",
    ("terms/robots/robot.py", "beyond its limits"): "test_robots.py",
    ("terms/robots/urdf.py", "has dry friction"): "test_robots.py",
    ("rollout/adaptive_steps.py", "errors of robots' joints"): "test_robots.py",
    ("rollout/simulator.py", "hold some vertices"): "test_robots.py",
    ("monitor/guard.py", "has gained {} J"): "test_energy_watch.py",
    ("monitor/guard.py", "reduce the substep to {} s"): "test_contact_crossing.py, battery_of_impacts.py",
    ("monitor/guard.py", "the barrier cannot stop it"): "test_contact_crossing.py, battery_of_impacts.py",
    ("monitor/guard.py", "the substep has outgrown"): "battery_of_impacts.py",
    ("state/bending.py", "acts at their nodes alone"): "test_curved_contact.py",
    ("batch/batch.py", "act at their nodes alone"): "test_curved_contact.py, from the start",
    ("terms/obstacles/obstacle.py", "from the triangles of their nodes"): "test_curved_contact.py",
    ("terms/obstacles/obstacle.py", "at their vertices alone"): "test_own_obstacle.py",
    ("monitor/guard.py", "are squeezed: take substeps of"): "test_obstacle_pairs.py",
    ("monitor/guard.py", "take substeps of {} s ({}"): "test_step_limit.py",
    ("monitor/guard.py", "pass substeps={}, or reduce dt"): "test_step_limit.py",
    ("rollout/simulator.py", "for the same number from the start"): "test_step_limit.py",
    ("inputs/step_values.py", "is a tensor with a graph"): "test_step_inputs.py",
    ("solvers/solver.py", "the stable step of these values"): "test_step_limit.py",
    ("terms/glued.py", "move vertices that lie in no glued face"): "test_tie.py",
    ("terms/reduced.py", "leave its faces out of the tie"): "test_tie.py",
    ("terms/tie.py", "move the parts together"): "test_tie.py",
    ("monitor/guard.py", "was stiffer than the substep"): "test_contact.py",
    ("rollout/sweep.py", "gradients through contacts"): "test_contact_gradients.py",
    ("rollout/sweep.py", "the adjoint grew"): "test_gradient_faults.py; a chaotic run has no better gradient",
    ("rollout/taped.py", "already ran in this tape"): "test_tape.py",
    ("runtime/launch.py", "install taichi"): ANOTHER_MACHINE,
    ("runtime/device.py", "needs Taichi on CUDA"): ANOTHER_MACHINE,
    ("runtime/repeated_loops.py", "install taichi"): ANOTHER_MACHINE,
    ("runtime/start.py", "was forked"): ANOTHER_MACHINE,
    ("runtime/start.py", "fast_math=True"): ANOTHER_MACHINE,
    ("runtime/start.py", "Vulkan has no float64"): ANOTHER_MACHINE,
    ("solvers/explicit/solver.py", "lends a kernel too few arrays"): ANOTHER_MACHINE,
    ("solvers/implicit/closing.py", "but for contact {}"): "test_supports.py",
    ("solvers/implicit/newton.py", "pass max_iterations={}"): "test_implicit.py",
    ("mechanics/obstacles/blocked.py", "finds no room"): "test_swept.py, battery_of_impacts.py",
    ("mechanics/obstacles/blocked.py", "the barrier cannot stop it"): "battery_of_impacts.py",
    ("mechanics/obstacles/blocked.py", "take substeps of"): "battery_of_impacts.py",
    ("solvers/solver.py", "pass substeps="): "above, as a part of what exceeds the stable step",
    ("scene/strength.py", "or let it fall"): "test_strength.py",
    ("torch_bridge/step_sizes.py", "parameter_groups(relative=...)"): "test_step_sizes.py",
    ("torch_bridge/step_sizes.py", "parameter_groups(relative=0.05)"): "test_step_sizes.py",
    ("torch_bridge/tensors.py", "sees no card"): ANOTHER_MACHINE,
    ("verify.py", "or take fewer than its {} steps"): "test_gradients.py",
    ("visual/drawing.py", "no Vulkan driver"): ANOTHER_MACHINE,
}


def test_all_advice_is_in_a_table():
    tables = [*FOLLOWED, *ELSEWHERE]
    missing = [m for m in messages() if not any(m[0] == file and part in m[1] for file, part in tables)]
    gone = [key for key in tables if not any(key[0] == file and key[1] in text for file, text in messages())]
    assert not missing, "\n".join(map(str, missing))
    assert not gone, gone


@pytest.mark.parametrize("key", FOLLOWED, ids=lambda key: f"{key[0]}: {key[1]}")
def test_advice_works(key):
    wrong, right = FOLLOWED[key]
    said = re.escape(key[1]).replace(r"\{\}", ".*")
    with warnings.catch_warnings(action="error"):
        with pytest.raises((ValueError, TypeError, KeyError, FloatingPointError, UserWarning), match=said):
            wrong()
        right()
