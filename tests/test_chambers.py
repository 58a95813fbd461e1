"""Chambers: gases and held volumes, their laws, closed forms, and every derivative of theirs."""

import numpy as np
import pytest
from chamber_meshes import eighth_sphere, hollow_cube, pitted_cube
from test_every_adjoint import assert_transposed
from test_term_order import IMPLICIT, SOLVERS

import diffsim_ti as ds
from diffsim_ti.mechanics.chambers.multipliers import Multipliers
from diffsim_ti.mechanics.chambers.pressures import ChamberPressure
from diffsim_ti.monitor.stability import Stiffness
from diffsim_ti.terms import Chamber

STEPS = 2
PLANES = dict(x0="x", y0="y", z0="z")


def gas(**options) -> ds.GasChamber:
    given = dict(pressure=1.1 * 101325, exponent=1.3, name="gas") | options
    return ds.GasChamber(surface="cavity", **given)


def hollow(terms, precision="f64", **options) -> ds.Scene:
    """A hollow cube on its bottom."""
    mesh, rng = hollow_cube(), np.random.default_rng(2)
    law = ds.StableNeoHookean(1e5 * rng.uniform(0.7, 1.3, mesh.num_tetrahedra), 0.3)
    given = dict(fixed="bottom", precision=precision) | options
    return ds.Scene(mesh, law, 1000.0, [*terms, ds.Gravity(), ds.Drag(2.0)], **given)


def pitted(terms, precision="f64", **options) -> ds.Scene:
    """A cube with a pit, on a plane that its rim slides on."""
    mesh = pitted_cube()
    mesh = mesh.with_vertex_set("wall", mesh.vertices[:, 0] < 0.02)
    given = dict(fixed={"cut": "z", "wall": "xy"}, precision=precision) | options
    law = ds.StableNeoHookean(1e5 * np.random.default_rng(5).uniform(0.7, 1.3, mesh.num_tetrahedra), 0.3)
    return ds.Scene(mesh, law, 1000.0, terms, **given)


def solver_of(kind, of: ds.Scene):
    if kind.explicit:
        return kind(of, dt=2e-4, substeps=2)
    exact = dict(tolerance=1e-12 if of.precision == "f64" else 1e-6)
    return kind(of, load_steps=2, **exact) if kind is ds.StaticSolver else kind(of, dt=4e-3, substeps=2, **exact)


def rollout_of(kind, of: ds.Scene, steps=STEPS, **options) -> ds.Rollout:
    outputs = [ds.ChamberPressure(term, name=f"p_{k}") for k, term in enumerate(of.terms_of(Chamber))]
    return ds.Rollout(solver_of(kind, of), steps, **dict(save_every=1, outputs=outputs, gradients="all") | options)


def filled(of=pitted, *terms, grown=(1.02, 1.05), **options) -> ds.Scene:
    """Two steps of a volume; the scene is made twice, for the volume at rest."""
    made = of([ds.FilledChamber(1.0, "cavity", name="oil"), *terms], **options)
    volume = made.chamber_volume("oil") * np.array(grown)
    return of([ds.FilledChamber(volume, "cavity", name="oil"), *terms], **options)


# ---- gradients -------------------------------------------------------------------------------------------------------

GAS = [(kind, "f64") for kind in SOLVERS] + [
    (kind, "f32") for kind in (ds.VelocityVerletSolver, ds.ImplicitEulerSolver)
]


@pytest.mark.executed_ptx
@pytest.mark.parametrize("kind, precision", GAS)
def test_every_number_of_a_gas(kind, precision):
    """By a dot product each; the pressure is given for each step (the fuzz has keyframes)."""
    terms = [gas(pressure=1.1 * 101325 * np.array([1.0, 1.1]))]
    without = ("drag_rate",) if kind is ds.StaticSolver else ()
    gate = (1e-12 if kind.explicit else 1e-8) if precision == "f64" else (3e-5 if kind.explicit else 2e-3)
    assert_transposed(rollout_of(kind, hollow(terms, precision)), gate, without)


@pytest.mark.parametrize("kind", [*IMPLICIT, ds.StaticSolver], ids=lambda s: s.__name__)
def test_every_number_of_a_held_volume(kind):
    without = ("density",) if kind is ds.StaticSolver else ()
    assert_transposed(rollout_of(kind, filled()), 1e-8, without)


def assert_outputs_transposed(rollout, gate=1e-8) -> None:
    """Of outputs, input by input, and tangents against differences along one direction of all."""
    rng, frames = np.random.default_rng(1), rollout.forward()
    seeds = {name: rng.normal(size=frames[name].shape) for name in rollout.computed}
    gradients, directions = rollout.vjp(frames, **seeds), {}
    for key in rollout.inputs:
        direction = rng.normal(size=rollout.values[key].shape) * ds.verify.input_scale(rollout, key)
        if "velocities" in key or "initial_positions" in key:
            direction = rollout.scene.supports.free(direction)
        directions[key] = direction
        tangents = rollout.tangents(frames, **{key: direction})
        pushed = sum((tangents[name] * seed).sum() for name, seed in seeds.items())
        pulled = (gradients[key] * direction).sum()
        size = max(abs(pushed), np.linalg.norm([np.linalg.norm(tangents[n] * s) for n, s in seeds.items()]), 1e-9)
        assert abs(pushed - pulled) <= gate * size, key
    return directions


def assert_tangents(rollout, keys, gate=1e-6) -> None:
    frames = rollout.forward()
    directions = assert_outputs_transposed(rollout)
    for key in keys:
        tangents, s, base = rollout.tangents(frames, **{key: directions[key]}), 1e-3, rollout.values[key]
        for name in rollout.computed:
            coarse, fine = (
                (rollout.forward(**{key: base + t * directions[key]})[name]
                 - rollout.forward(**{key: base - t * directions[key]})[name]) / (2 * t)
                for t in (s, s / 2)
            )  # fmt: off
            exact = (4 * fine - coarse) / 3
            size = max(
                np.abs(exact).max(), 3e-5 * np.abs(frames[name]).max()
            )  # no modulus changes a gas of held volume
            assert tangents[name] == pytest.approx(exact, rel=gate, abs=gate * size), (key, name)


@pytest.mark.parametrize("kind", [ds.StaticSolver, ds.ImplicitEulerSolver], ids=lambda s: s.__name__)
def test_reactions_know_held_volumes(kind):
    """With gradients; in equilibrium the plane that a rim slides on is pulled by the pressure on what the rim encloses."""
    outputs = [ds.Reaction("cut"), ds.Reaction("wall", name="moment", about=(0.1, 0.2, 0.3)), ds.ChamberPressure("oil")]
    rollout = rollout_of(kind, filled(pitted, gas(), grown=(1.05,)), steps=1, outputs=outputs)
    if kind is ds.ImplicitEulerSolver:
        assert_tangents(rollout, ("youngs_modulus", "oil.volume"))
    else:
        assert_outputs_transposed(rollout)
        of, x = rollout.scene, rollout.forward().positions[-1]
        rim = np.flatnonzero(
            (x[:, 2] < 1e-9) & np.isin(np.arange(len(x)), of.mesh.surface_triangles[of.mesh.surface_indices("cavity")])
        )
        around = x[rim[np.argsort(np.arctan2(*(x[rim, :2] - x[rim, :2].mean(0)).T))], :2]
        ahead = np.roll(around, -1, 0)
        area = abs((around[:, 0] * ahead[:, 1] - around[:, 1] * ahead[:, 0]).sum()) / 2
        found = rollout.forward()
        inside = of.chamber_volume("gas", x)
        p = found["chamber_pressure"][-1] + 1.1 * 101325 * (of.chamber_volume("gas") / inside) ** 1.3 - 101325
        assert found["reaction"][-1][2] == pytest.approx(-p * area, rel=1e-8) and p > 1e3


@pytest.mark.parametrize("kind", [ds.StaticSolver, ds.BDF2Solver], ids=lambda s: s.__name__)
def test_the_pressure_is_a_result_with_gradient(kind):
    """Of a held volume beside a gas in one cavity: by moduli, volume, gas, rest shape."""
    steps = 1 if kind is ds.StaticSolver else 2
    rollout = rollout_of(kind, filled(pitted, gas(), grown=(1.02, 1.05)[-steps:]), steps=steps)
    assert_tangents(rollout, ("youngs_modulus", "oil.volume", "gas.pressure", "gas.outside", "rest_positions"))


def test_a_gas_pressure_is_a_result_with_gradient():
    keys = "gas.pressure", "gas.exponent", "youngs_modulus", "rest_positions"
    assert_tangents(rollout_of(ds.ImplicitMidpointSolver, hollow([gas()])), keys)


def test_a_forgotten_multiplier_would_be_found(monkeypatch):
    """The mutation that the dot products of held volumes are there for."""
    rollout = rollout_of(ds.StaticSolver, filled())
    rollout.forward()
    monkeypatch.setattr(Multipliers, "adjoint", lambda self, x, y, by_pressure, solve: (y, 0 * by_pressure))
    assert ds.dot_product_test(rollout) > 1e-3


# ---- laws ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", SOLVERS, ids=lambda s: s.__name__)
def test_pressure_times_volume_stays(kind):
    p0 = 1.3 * 101325
    of = hollow([gas(pressure=p0, exponent=1.0)])
    frames = rollout_of(kind, of).forward()
    inside = [of.chamber_volume("gas", x) for x in frames.positions]
    assert max(inside) > (1.0002 if kind.explicit else 1.01) * of.chamber_volume("gas")
    assert (frames["p_0"][1:] + 101325) * inside[1:] == pytest.approx(p0 * of.chamber_volume("gas"), rel=1e-12)


@pytest.mark.parametrize("kind", [*IMPLICIT, ds.StaticSolver], ids=lambda s: s.__name__)
def test_a_volume_is_held(kind):
    of = filled(hollow)
    frames = rollout_of(kind, of).forward()
    wanted, inside = of.inputs.values["oil.volume"], [of.chamber_volume("oil", x) for x in frames.positions[1:]]
    if kind is not ds.ImplicitMidpointSolver:  # which holds it in the middle of substeps
        assert inside == pytest.approx(wanted, rel=1e-11)
    assert kind is not ds.StaticSolver or np.all(np.diff(frames["p_0"]) > 1e3)


def test_a_held_volume_and_its_pressure_are_one():
    """The pressure that was found, given as Pressure, leads to the same place, and so does a gas of that amount."""
    of = filled(pitted, grown=(1.2,))
    frames = rollout_of(ds.StaticSolver, of, steps=1).forward()
    p, V, V0 = frames["p_0"][-1], of.chamber_volume("oil", frames.positions[-1]), of.chamber_volume("oil")
    for term in (ds.Pressure(p, "cavity"), ds.GasChamber((p + 101325) * V / V0, "cavity")):
        other = ds.Rollout(solver_of(ds.StaticSolver, pitted([term])), 1).forward()
        assert other.positions[-1] == pytest.approx(frames.positions[-1], rel=0, abs=1e-9)


def test_forces_of_a_chamber_add_up_to_nothing():
    of = hollow([gas()])
    x = of.mesh.vertices + 0.01 * np.random.default_rng(3).normal(size=of.mesh.vertices.shape)
    pressures = ChamberPressure(of, of.terms_of(Chamber)).at(of.inputs.derive(of.inputs.values).follower[0, :, 0])
    f, v = pressures.forces(x), np.random.default_rng(4).normal(size=x.shape)
    assert np.abs(f.sum(0)).max() < 1e-10 > np.abs(np.cross(x, f).sum(0)).max()
    step = 1e-3 * v
    middle = np.linspace(0, 1, 2001)
    path = np.array([(pressures.forces(x + s * step) * step).sum() for s in middle])
    assert pressures.work(x, step) == pytest.approx(np.trapezoid(path, middle), rel=1e-8)
    difference = (pressures.forces(x + 1e-6 * v) - pressures.forces(x - 1e-6 * v)) / 2e-6
    assert pressures.jvp(x, v) == pytest.approx(difference, rel=1e-6, abs=1e-6 * np.abs(difference).max())


@pytest.mark.parametrize("holds", [False, True])
def test_the_tangent_that_products_use_is_the_derivative_both_ways(holds):
    of = filled(pitted, grown=(1.2,)) if holds else hollow([gas()])
    rng = np.random.default_rng(3)
    x, v = of.mesh.vertices + 0.01 * rng.normal(size=(2, *of.mesh.vertices.shape))
    pressures = ChamberPressure(of, of.terms_of(Chamber)).at(of.inputs.derive(of.inputs.values).follower[0, :, 0])
    for law in pressures.laws:
        law.gamma = 3e4
    tangent = pressures.tangent(x)
    for found, expected in ((tangent(v), pressures.jvp(x, v)), (tangent.T(v), pressures.vjp(x, v)[0])):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13 * np.abs(expected).max())


# ---- closed forms ----------------------------------------------------------------------------------------------------


def sphere(term, nu, start=1.0, layers=3, around=10, **options) -> ds.Scene:
    """An eighth of a thick-walled sphere, B / A = 1.2, grown from a stretch `start` of its inside; mu = 1e5 Pa."""
    mesh = eighth_sphere(1.0, 1.2, layers, around)
    radius = np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    grown = mesh.vertices * (1 + (start**3 - 1) / radius**3) ** (1 / 3)
    law = ds.StableNeoHookean(2e5 * (1 + nu), nu)
    given = dict(fixed=PLANES, precision="f64", volume="patches", initial_positions=grown)
    return ds.Scene(mesh, law, 1000.0, [term], **given | options)


def closed_form(la: float, B=1.2) -> float:
    """p / mu of a thick sphere of incompressible neo-Hookean material, la being the stretch inside."""
    lb = ((la**3 - 1) / B**3 + 1) ** (1 / 3)
    return 2 / lb + 1 / (2 * lb**4) - 2 / la - 1 / (2 * la**4)


@pytest.mark.parametrize("la", [1.47, 1.8])
def test_a_sphere_at_and_beyond_its_largest_pressure(la):
    """By its volume: no pressure alone leads there. The largest is at la = 1.470."""
    assert closed_form(1.47) == pytest.approx(0.22514, rel=1e-4) and closed_form(1.8) < closed_form(1.47)
    made = sphere(ds.FilledChamber(1.0, "inside", name="oil"), 0.4995, la)
    term = ds.FilledChamber(la**3 * made.chamber_volume("oil"), "inside", name="oil")
    of = sphere(term, 0.4995, la)
    rollout = ds.Rollout(ds.StaticSolver(of), 1, outputs=ds.ChamberPressure("oil"))
    frames = rollout.forward()
    assert frames["chamber_pressure"][-1] / 1e5 == pytest.approx(closed_form(la), rel=0.01)
    gradients = rollout.vjp(frames, chamber_pressure=np.array([0.0, 1.0]))
    slope = (closed_form(la + 1e-4) - closed_form(la - 1e-4)) / 2e-4 * 1e5  # dp/dla
    by_la = gradients["oil.volume"] * 3 * la**2 * made.chamber_volume("oil")
    assert by_la == pytest.approx(slope, rel=0.05, abs=0.005e5)
    E = of.inputs.values["youngs_modulus"]  # p is as large as the moduli, at nu that stays
    assert gradients["youngs_modulus"] * E == pytest.approx(frames["chamber_pressure"][-1], rel=1e-5)


# ---- what is refused -------------------------------------------------------------------------------------------------

MISTAKES = {
    "open": (lambda: pitted([gas()], fixed="wall"), "is open at the edge of vertices"),
    "outside": (lambda: hollow([ds.GasChamber(2e5)]), r"GasChamber: the surface encloses -0.0.* normals .* into"),
    "no such set": (lambda: hollow([ds.GasChamber(2e5, "roof")]), "no surface set is called 'roof'"),
    "pressure": (lambda: gas(pressure=-1.0), r"pressure must be > 0 \[Pa\]"),
    "exponent": (lambda: gas(exponent=0.0), "exponent must be > 0"),
    "volume": (lambda: ds.FilledChamber([[1.0]]), r"FilledChamber: volume must have shape \(\) or \(steps,\)"),
    "moved planes": (
        lambda: sphere(ds.FilledChamber(1.0, "inside"), 0.3, layers=1, around=2, motion=lambda t: [t, 0, 0]),
        "rim lies in several planes, which must not be moved",
    ),
    "no such chamber": (
        lambda: ds.Rollout(ds.StaticSolver(hollow([gas()])), 1, outputs=ds.ChamberPressure("oil")),
        "this scene has no chamber 'oil'; it has 'gas'",
    ),
}


def grooved() -> ds.Scene:
    """A groove along x whose rim slides in three planes: the ends x = 0 and x = 0.3, which are parallel, and the top."""
    mesh = ds.TetrahedralMesh.create_box((4, 4, 3), (0.3, 0.3, 0.2))
    mesh = ds.TetrahedralMesh(
        mesh.vertices, mesh.tetrahedra[(np.abs(mesh.centroids[:, 1:] - [0.15, 0.2]) > [0.05, 0.1]).any(1)]
    )
    X = mesh.vertices
    mesh = mesh.with_vertex_set("ends", np.isin(X[:, 0], [0.0, X[:, 0].max()])).with_vertex_set("top", X[:, 2] > 0.199)
    walls = lambda x, n: (np.abs(x[:, 1] - 0.15) < 0.0501) & (x[:, 2] > 0.0999) & (np.abs(n[:, 0]) < 0.5)  # noqa: E731
    mesh = mesh.with_surface_set("groove", walls)
    return ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, gas_in("groove"), {"ends": "x", "top": "z"})


def gas_in(surface) -> ds.GasChamber:
    return ds.GasChamber(1.1e5, surface)


def two_eighths() -> ds.Scene:
    """Two eighths of spheres as one chamber, each with a rim in three planes of its own."""
    one = eighth_sphere(layers=1, around=2)
    n = one.num_vertices
    X = np.concatenate([one.vertices, one.vertices + [0, 0, 3.0]])
    mesh = ds.TetrahedralMesh(X, np.concatenate([one.tetrahedra, one.tetrahedra + n]))
    for name in PLANES:
        own = one.vertex_indices(name)
        mesh = mesh.with_vertex_set(name, np.concatenate([own, own + n]))
    middle = np.where(np.arange(2 * n)[:, None] < n, 0.0, [0, 0, 3.0])
    inside = np.linalg.norm(X - middle, axis=1) < 1.0001
    mesh = mesh.with_surface_set("inside", np.flatnonzero(inside[mesh.surface_triangles].all(1)))
    return ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), 1000.0, gas_in("inside"), PLANES)


MISTAKES |= {
    "planes without a common point": (grooved, "the rim of the surface lies in planes that share no point"),
    "rims without a common point": (
        two_eighths,
        "two rims lie in planes that share no point: name the cavities one by",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_are_refused(mistake):
    make, message = MISTAKES[mistake]
    with pytest.raises(ValueError, match=message):
        make()


def test_a_simulator_takes_the_volumes_of_each_step():
    """And keeps the pressure of the last pass alone, from which the next one starts."""
    of = filled(grown=(1.02, 1.05, 1.1))
    frames = ds.Rollout(solver_of(ds.ImplicitEulerSolver, of), 3, outputs=ds.ChamberPressure("oil")).forward()
    sim = ds.Simulator(solver_of(ds.ImplicitEulerSolver, of))
    sim.run(3)
    assert sim.positions == pytest.approx(frames.positions[-1], rel=0, abs=1e-11)
    kept = sim.workspace.multipliers
    assert len(kept) == 3 and kept[5] == pytest.approx(frames["chamber_pressure"][-1:], rel=1e-9)


def test_a_stiff_gas_counts_in_the_stable_step_and_forces_of_loads_do_not():
    """By forces that passes left in corners, before and after a run; the bound lies below the exact limit."""
    thin, stiff = (hollow([gas(pressure=p, outside=p)]) for p in (1.0, 3e7))
    soft, hard = (ds.VelocityVerletSolver(of, dt=2e-5) for of in (thin, stiff))
    assert hard.stable_dt(tight=True) < 0.6 * soft.stable_dt(tight=True)
    for solver in (soft, hard):
        assert solver.stable_dt() <= solver.stable_dt(tight=True)
    pumped = [hollow([gas(pressure=how, outside=3e7)]) for how in ([1.0, 3e7], ([0.0, 1.0], [1.0, 3e7]))]
    for of in pumped:  # in a later step
        assert ds.stable_dt(of) == pytest.approx(hard.stable_dt(tight=True), rel=1e-6)
        assert ds.stable_dt(of, tight=False) == pytest.approx(hard.stable_dt(), rel=1e-9)
    solver = ds.VelocityVerletSolver(hollow([ds.Pressure(1e3, "cavity"), gas()]), dt=1e-4)
    sim = ds.Simulator(solver)
    sim.run(2)
    stiffness = Stiffness(sim.workspace)
    nothing = np.zeros((solver.scene.mesh.num_vertices, 3))
    assert not stiffness.product(nothing).any()
    v, w = np.random.default_rng(0).normal(size=(2, *nothing.shape))
    assert (v * stiffness.product(w)).sum() == pytest.approx((w * stiffness.product(v)).sum(), rel=1e-9)


# ---- other faces -----------------------------------------------------------------------------------------------------


def test_torch_and_tape_agree_with_arrays():
    """Gradients of a held volume's pressure and of positions, in one loss."""
    import taichi as ti
    import torch

    from diffsim_ti.diff_simulator import rollout_frames

    rollout = rollout_of(ds.StaticSolver, filled(grown=(1.1,)), steps=1)
    frames = rollout.forward()
    weight = np.zeros(frames.positions.shape)
    weight[-1, :, 2] = 1e3
    expected = rollout.vjp(frames, weight, p_0=2 * frames["p_0"])["oil.volume"]
    volume = torch.tensor(rollout.values["oil.volume"], requires_grad=True)
    made = rollout_frames(rollout, **{"oil.volume": volume})
    assert made["p_0"].detach().numpy() == pytest.approx(frames["p_0"])
    ((made["p_0"] ** 2).sum() + 1e3 * made.positions[-1, :, 2].sum()).backward()
    assert volume.grad.numpy() == pytest.approx(expected, rel=1e-7)
    loss = ti.field(ti.f64, (), needs_grad=True)
    p, x, own = rollout.field("p_0"), rollout.positions, rollout.field("oil.volume")

    @ti.kernel
    def measure():
        for k in p:
            loss[None] += p[k] ** 2
        for i in range(x.shape[1]):
            loss[None] += 1e3 * x[1, i][2]

    with ti.ad.Tape(loss):
        rollout.run()
        measure()
    assert own.grad.to_numpy() == pytest.approx(expected, rel=1e-7)


@pytest.mark.parametrize("kind", [ds.ImplicitEulerSolver, ds.StaticSolver], ids=lambda s: s.__name__)
def test_a_simulator_tells_the_pressure_of_a_held_volume(kind):
    rollout = rollout_of(kind, filled())
    frames, simulator = rollout.forward(), ds.Simulator(rollout.solver)
    pressure = ds.ChamberPressure("oil")
    assert simulator.output(pressure) == 0
    for k in range(1, STEPS + 1):
        simulator.step()
        if kind is not ds.StaticSolver or k == 1:  # whose load steps begin anew in each step of a simulator
            assert simulator.output(pressure) == pytest.approx(frames["p_0"][k], rel=1e-6) and frames["p_0"][k] != 0
    simulator.set_substeps(3)
    simulator.reset()
    assert simulator.output(pressure) == 0
