"""A client of the public interface that mypy and basedpyright check in CI: `mypy --strict tests/typed_client.py`."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from typing_extensions import assert_type

import diffsim_ti as ds
from diffsim_ti.outputs import Output
from diffsim_ti.picture import Camera
from diffsim_ti.terms import Term

SLIDER = """<robot name="slider"><link name="base"/><link name="head"><inertial><mass value="1"/><inertia ixx="1" iyy="1"
izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="slide" type="prismatic"><parent link="base"/>
<child link="head"/><axis xyz="1 0 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""


def fall() -> float:
    """The height of a cube after a fall, and what one reads off on the way."""
    ds.init(precision="f64", threads=2, debug=False)
    mesh = ds.TetrahedralMesh.create_cube(resolution=3, size=0.5)
    assert_type(mesh.num_vertices, int)
    assert_type(mesh.vertices, np.ndarray)
    assert_type(mesh.at_stress_points(mesh.vertices[:, 0]), np.ndarray)
    material = ds.StableNeoHookean(youngs_modulus=1e5, poissons_ratio=0.3)
    terms = [ds.Gravity(), ds.Drag(1.0), ds.Ground(height=-0.1)]
    scene = ds.Scene(mesh, material, density=1e3, terms=terms, fixed="xmin", precision="f64")
    limit: float = ds.stable_dt(scene)
    solver = ds.VelocityVerletSolver(scene, dt=0.01, substeps=max(1, round(0.02 / limit)))
    simulator = ds.Simulator(solver)
    simulator.step()
    simulator.run(2)
    simulator.set_state(positions=mesh.vertices, velocities=np.zeros((mesh.num_vertices, 3)))
    energy = simulator.compute_energy()
    parts: dict[str, float] = energy.parts
    rollout = ds.Rollout(solver, steps=4, save_every=2, outputs=[ds.Stress(), ds.Reaction("xmin")], gradients="all")
    frames = rollout.forward(youngs_modulus=1.1e5)
    assert_type(frames, ds.Frames)
    gradients = rollout.vjp(frames, positions=np.ones(frames.positions.shape))
    number: np.ndarray = gradients["youngs_modulus"]
    report = ds.check_gradients(rollout)
    passed: bool = report.passed
    found = ds.modes(scene, 3)
    assert_type(found, ds.Modes)
    path = ds.load_path(scene.replace(terms=ds.Gravity()), "gravity", steps=1)
    assert_type(path, ds.LoadPath)
    limits: list[ds.CriticalPoint] = path.critical
    try:
        ds.Rollout(ds.BDF2Solver(scene, dt=0.01, tolerance=1e-6), 2).forward()
    except (ds.Divergence, ds.NotConverged) as error:
        print(str(error))
    return float(simulator.positions[:, 1].mean()) + sum(parts.values()) + float(number.sum()) + passed + len(limits)


def parts() -> int:
    """How many laws, terms, solvers and outputs there are; made, and not run."""
    mesh = ds.TetrahedralMesh.create_box((3, 3, 3), size=0.5, pattern="five")
    soft = ds.StableNeoHookean(E=1e4, nu=0.3, J_floor=0.02)
    laws: list[ds.Material] = [
        soft,
        ds.SmithNeoHookean(1e4, 0.3),
        ds.LinearElastic(mu=4e3, lam=6e3),
        ds.Corotated(1e4, nu=0.3),
        ds.StVenantKirchhoff(1e4, 0.3),
        ds.MooneyRivlin(1e4, 0.3, c01_share=0.1),
        ds.Yeoh(2e3, 0.0, 0.0, 1e4),
        ds.Gent(4e3, 30.0, 1e4),
        ds.Ogden([4e3], [2.0], 1e4),
        ds.Grown(soft, 0.01),
        ds.FibreReinforced(soft, 1e3, 1.0, (1.0, 0.0, 0.0)),
        ds.Orthotropic(E1=9e5, E2=1e5, nu12=0.3, nu23=0.4, G12=1e5, direction_1=(1.0, 1.0, 0.0)),
        ds.InitialStress(soft, (1e3, 0.0, 0.0, 0.0, 0.0, 0.0)),
        ds.KelvinVoigt(soft, time=1e-3),
        ds.Prony(soft, [0.5], [0.1]),
        ds.J2Plasticity(1e4, 0.3, 100.0, hardening=50.0, kinematic_hardening=20.0),
    ]
    spring = ds.Spring(0, ds.Anchor((0.0, 0.0, -1.0)), stiffness=10.0, name="spring")
    cable = ds.Cable([0, 1], tension=lambda t: 2 * t, name="cable")
    ball = ds.Sphere((0.0, -2.0, 0.0), 0.5, friction=0.3, path=lambda t: (t, 0.0, 0.0), name="ball")
    loads: list[Term] = [
        ds.Gravity((0.0, -9.81, 0.0)),
        ds.Drag(0.5),
        ds.ExternalForce((0.0, 0.0, 1.0), "xmax"),
        ds.Traction((0.0, 0.0, 10.0), surface="xmax", name="pull"),
        ds.Pressure(([0.0, 1.0], [0.0, 5.0]), surface="ymax"),
        ds.BodyForce((0.0, 1.0, 0.0), per="mass"),
        ds.RotatingFrame((0.0, 1.0, 0.0)),
        ds.Robot.from_urdf(SLIDER, positions=(0.1,), drive_stiffness=50.0, name="arm", attached={"head": "xmin"}),
        ds.SurfaceDrag(normal=1.2),
        ds.ElasticFoundation(1e3, surface="xmin"),
        ds.Growth(0.01),
        ds.Muscle((1.0, 0.0, 0.0), 1e3, activation=0.5),
        ds.SelfContact(width=1e-3),
        ds.Tie("xmax", "xmin", tolerance=1e-4),
        ds.RemoteLoad((0, 0, 0, 0.1, 0, 0), "xmax", point=(1.0, 0, 0)),
        ds.MultiPointConstraint.mean(mesh, "xmax", (0, 1, 0), 0.01, stiffness=1e6),
        spring,
        cable,
        ball,
        ds.Ground(-3.0, friction=0.5, stiffness_per_area=1e6),
        ds.HalfSpace((0.0, -4.0, 0.0), (0.0, 1.0, 0.0), width=0.02),
        ds.Box((5.0, 0.0, 0.0), size=(1.0, 1.0, 1.0)),
        ds.Capsule((5.0, 0.0, 0.0), (6.0, 0.0, 0.0), 0.2),
        ds.Cylinder((5.0, 0.0, 0.0), (6.0, 0.0, 0.0), radius=0.2),
    ]
    scene = ds.Scene(
        mesh, soft, terms=[ds.Gravity(), spring, cable, ball], fixed={"xmin": "xyz"}, motion=ds.Pose(turning)
    )
    names: list[str] = list(scene.inputs)
    solvers = [
        ds.SemiImplicitSolver(scene, dt=1e-4, contact="force", viscous_stages=1),
        ds.VelocityVerletSolver(scene, dt=1e-4, contact_damping=0.1),
        ds.ImplicitEulerSolver(scene, preconditioner="multigrid"),
        ds.ImplicitMidpointSolver(scene, dt=0.01),
        ds.BDF2Solver(scene, max_iterations=20),
        ds.StaticSolver(scene, load_steps=2),
    ]
    outputs: list[Output] = [
        ds.MaterialPoints(mesh.centroids[:2]),
        ds.CenterOfMass("xmax"),
        ds.ContactForce("ball", part="friction", on="xmin"),
        ds.ContactTraction(ball),
        ds.CenterOfPressure(ball),
        ds.ContactSlip(ball, "share"),
        ds.PixelTracks(Camera.framing(mesh.vertices), [[0.0, 0.0, 0.0]]),
        ds.TactilePad(ball, "palm", size=(8, 8)),
        ds.JointPositions("arm"),
        ds.JointVelocities("arm"),
        ds.JointEfforts("arm"),
        ds.LinkMotion("head", "arm"),
        ds.LinkEnergy("arm"),
        ds.SelfContactForce("xmin", part="normal"),
        ds.Stress(kind="first_piola"),
        ds.Strain(principal=True),
        ds.Reaction("xmin", per_vertex=True),
        ds.Length("cable"),
        ds.Tension(spring),
        ds.EnclosedVolume(),
        ds.ElasticEnergy(),
        ds.Dissipation(),
        ds.PlasticStrain(at="vertices"),
        ds.KineticEnergy(["xmax"]),
        ds.WorkOfLoads(),
        ds.SectionForce((0.2, 0, 0), (1, 0, 0)),
        ds.SmoothMaximum(ds.Stress(von_mises=True), 8.0),
        ds.CenterOfMass(),
    ]
    assert_type(ds.Rollout(solvers[0], ds.UnequalSteps([1e-4, 2e-4])).on(solvers[1], save_every=1), ds.Rollout)
    assert_type(scene.replace(density=900.0, precision="f32"), ds.Scene)
    return len(laws) + len(loads) + len(names) + len(solvers) + len(outputs)


class Cubic(ds.EnergyLaw):
    """The energy of a law is what a user writes of it."""

    coefficient_names = ("mu", "lam")


def turning(time: float) -> tuple[float, ...]:
    """A quarter of a turn about y each second."""
    return 0.0, 0.0, 0.0, 0.0, 1.5 * time, 0.0


if TYPE_CHECKING:  # what takes longer than types are worth: checked, and run by the tests of each

    def runs(solver: ds.VelocityVerletSolver, hollow: ds.TetrahedralMesh) -> None:
        """Batches, fits, checks of gradients and the errors of runs."""
        chambers = [ds.GasChamber(1e5, "cavity", name="gas"), ds.FilledChamber(1e-3, surface="cavity")]
        wall = ds.MeshObstacle(hollow.vertices, hollow.surface_triangles, name="wall")
        pressure = ds.ChamberPressure("gas")
        assert_type(ds.Simulator(hollow, ds.Gent(4e3, 30.0, 1e4), ds.SemiImplicitSolver(dt=0.01)), ds.Simulator)
        steps = ds.adaptive_steps(solver, steps=10, tolerance=1e-3)
        assert_type(steps, ds.UnequalSteps)
        rollout = ds.Rollout(solver, steps, outputs=[pressure])
        batch = ds.Batch(solver, 10, scenes=4, lanes=None)
        frames = batch.forward(youngs_modulus=[1e4, 2e4, 3e4, 4e4])
        assert_type(frames, ds.BatchFrames)
        assert_type(frames[0], ds.Frames)
        seen = ds.Measurement("positions", np.zeros((11, 8, 3)), noise=1e-3, at=[1, 2])
        unknown = ds.Unknown(1e4, range=(1e3, 1e5))
        priors = {"youngs_modulus": ds.Normal(1e4, 1e3), "density": ds.Smooth(0.1)}
        found = ds.identify(rollout, seen, {"youngs_modulus": unknown}, prior=priors, starts=3)
        assert_type(found, ds.Identification)
        heard = ds.ModalTest(solver.scene, 4)
        ds.expected(heard, ["frequencies"], {"density": 900.0}, noise=1.0)
        ds.compare(rollout, {"all": seen}, {"youngs_modulus": unknown})
        ds.identifiability(rollout, ["youngs_modulus"])
        assert_type(ds.dot_product_test(rollout, seed=3), float)
        ds.taylor_test(lambda x: float(x @ x), np.ones(3), 2 * np.ones(3))
        bar = rollout.accuracy("pressure", weights=[1.0], finer=ds.TetrahedralMesh.refined, youngs_modulus=1e4)
        assert_type(bar, ds.Accuracy)
        assert_type(bar.corrected, float)
        refined = ds.refine(rollout, "pressure", tolerance=0.01)
        assert_type(refined, ds.Refined)
        assert_type(refined.mesh, ds.TetrahedralMesh)
        ensemble = ds.Ensemble([1e4, 2e4], make=lambda E: ds.Rollout(solver, 4))
        report: ds.SolveReport = rollout.report
        errors: Iterable[type[Exception]] = (ds.Crossing, ds.Tunnelling, ds.EnergyGained, ds.Buckled)
        print(chambers, wall, ensemble, report, errors)


if __name__ == "__main__":
    print(fall(), parts())
