"""Stress, strain and enclosed volume, as a loss names them."""

from functools import lru_cache

import numpy as np
import pytest
from open_laws.viscous import ViscousRubber

import diffsim_ti as ds
from diffsim_ti import verify
from diffsim_ti.mesh.patches import volume_patches

POINTS = np.array([[0.02, 0.03, 0.05], [0.15, 0.07, 0.03]])


def mesh():
    return ds.TetrahedralMesh.create_box((3, 2, 2), size=(0.2, 0.1, 0.1))


def bent(X):
    return X + 0.02 * np.sin(11 * X[:, [1, 2, 0]] + 1) * np.array([1.0, 0.7, -0.8])


def outputs():
    return [
        ds.Stress(),
        ds.Stress("nodal", at="vertices", principal=True),
        ds.Stress("piola", at=POINTS, kind="first_piola"),
        ds.Strain("nodal_strain", at="vertices"),
        ds.Strain("marked", at=POINTS, principal=True),
        ds.Stress("mises", von_mises=True),
        ds.Stress("nodal_mises", at="vertices", von_mises=True),
        ds.Strain("stretches", stretches=True),
        ds.Stress("recovered", at="recovered"),
        ds.SmoothMaximum(ds.Stress("mises", von_mises=True), 8.0, name="norm"),
        ds.SmoothMaximum(ds.Stress(at="recovered", principal=True), 8.0, "ks", 1e3, name="ks"),
        ds.EnclosedVolume(),
        ds.ElasticEnergy(),
        ds.ElasticEnergy([[0, 3, 4], [1, 2]], name="parts"),
        ds.KineticEnergy(["xmax", "ymin"]),
    ]


def sections():
    """Where inertia makes them: in equilibrium they are the loads beyond, whatever the moduli."""
    plane = (0.11, 0.0, 0.0), (1.0, 0.2, 0.1)
    return [ds.SectionForce(*plane), ds.SectionForce(*plane, name="section_moment", about=(0.1, 0.2, 0.0))]


@lru_cache(maxsize=None)
def rollout_of(kind):
    body = mesh()
    if kind == "patches":  # a law whose last coefficient is not lam alone, with moduli of each tetrahedron
        E = np.linspace(4e4, 8e4, body.num_tetrahedra)
        scene = ds.Scene(
            body,
            ds.SmithNeoHookean(E, 0.45),
            900.0,
            ds.Gravity((3.0, -9.81, 2.0)),
            "xmin",
            precision="f64",
            initial_positions=bent(body.vertices),
            volume="patches",
        )
        return ds.Rollout(
            ds.VelocityVerletSolver(scene, dt=3e-4), 2, save_every=1, outputs=outputs() + sections(), gradients="all"
        )
    E = np.linspace(4e4, 8e4, body.num_tetrahedra) if kind == "verlet" else 5e4
    law = ds.Corotated if kind == "verlet" else ds.StableNeoHookean
    start = dict(initial_positions=bent(body.vertices)) if kind == "verlet" else {}
    scene = ds.Scene(body, law(E, 0.3), 900.0, ds.Gravity((3.0, -9.81, 2.0)), "xmin", precision="f64", **start)
    solver = ds.VelocityVerletSolver(scene, dt=5e-4) if kind == "verlet" else ds.StaticSolver(scene, tolerance=1e-12)
    own = outputs() + (sections() if kind == "verlet" else [])
    return ds.Rollout(solver, 2, save_every=1, outputs=own, gradients="all")


def symmetric(seed):
    return 0.5 * (seed + np.swapaxes(seed, -1, -2))


@pytest.mark.parametrize("kind", ["verlet", "static", "patches"])
def test_derivatives(kind):
    """Seeds are the transpose of tangents, and gradients agree with differences, for each output and input by itself."""
    assert_derivatives(rollout_of(kind), kind != "static", 1e-8 if kind == "static" else 1e-11)


def assert_derivatives(rollout, moving, gate):
    """moving: whether the first frame is deformed, so that no principal values coincide."""
    rng, frames = np.random.default_rng(1), rollout.forward()
    seeds = {name: rng.normal(size=frames[name].shape) for name in rollout.computed}
    for seed in seeds.values():
        seed[0] *= moving
    gradients = {name: rollout.vjp(frames, **{name: seed}) for name, seed in seeds.items()}
    tangents, directions = {}, {}
    for key in rollout.inputs:
        directions[key] = rng.normal(size=rollout.values[key].shape) * verify.input_scale(rollout, key)
        if key in ("initial_velocities", "initial_positions"):
            directions[key][rollout.scene.fixed] = 0
        tangents[key] = rollout.tangents(frames, **{key: directions[key]})
        for name, seed in seeds.items():
            terms = tangents[key][name] * seed
            pushed, pulled = terms.sum(), (gradients[name][key] * directions[key]).sum()
            assert abs(pushed - pulled) <= gate * max(
                abs(pushed), np.linalg.norm(terms), 1e-9 * np.abs(frames[name]).max()
            ), (key, name)
    keys = ("youngs_modulus", "poissons_ratio", "density", "rest_positions")
    for key in keys:
        base, s = rollout.values[key], 1e-4
        got = [rollout.forward(**{key: base + t * directions[key]}) for t in (s, -s, s / 2, -s / 2)]
        for name, seed in seeds.items():
            d = [(got[k][name] * seed).sum() for k in range(4)]
            difference = (4 * (d[2] - d[3]) / s - (d[0] - d[1]) / (2 * s)) / 3
            size = np.abs(frames[name]).max()
            assert (tangents[key][name] * seed).sum() == pytest.approx(difference, rel=1e-6, abs=1e-7 * size), (
                key,
                name,
            )


def test_a_homogeneous_stretch_has_its_closed_form():
    """F = diag(a, b, c), turned: sigma by the law's formula in the turned frame, E = (F^T F - I) / 2, V as det F."""
    body, (a, b, c), E, nu = mesh(), (1.3, 0.9, 1.1), 5e4, 0.3
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    F = turn @ np.diag([a, b, c])
    scene = ds.Scene(body, ds.StableNeoHookean(E, nu), initial_positions=body.vertices @ F.T, precision="f64")
    frames = ds.Rollout(ds.VelocityVerletSolver(scene, dt=1e-5), 1, outputs=outputs()).forward()
    mu, lam, J = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu)), a * b * c
    own = (
        mu * (np.array([a, b, c]) ** 2 - 1) + lam * (J - 1) * J
    ) / J  # psi = mu/2 (I_C - 3) - mu log J + lam/2 (J-1)^2
    sigma = turn @ np.diag(own) @ turn.T
    assert frames["stress"][0] == pytest.approx(np.tile(sigma, (body.num_tetrahedra, 1, 1)), rel=1e-9, abs=1e-9 * E)
    assert frames["nodal"][0] == pytest.approx(np.tile(np.sort(own), (body.num_vertices, 1)), rel=1e-9)
    assert frames["piola"][0] == pytest.approx(np.tile(J * sigma @ np.linalg.inv(F).T, (2, 1, 1)), abs=1e-9 * E)
    green = 0.5 * (np.array([a, b, c]) ** 2 - 1)
    assert frames["nodal_strain"][0] == pytest.approx(np.tile(np.diag(green), (body.num_vertices, 1, 1)), abs=1e-12)
    assert frames["marked"][0] == pytest.approx(np.tile(np.sort(green), (2, 1)), abs=1e-12)
    mises = np.sqrt(0.5 * ((own[0] - own[1]) ** 2 + (own[1] - own[2]) ** 2 + (own[2] - own[0]) ** 2))
    assert frames["mises"][0] == pytest.approx(np.full(body.num_tetrahedra, mises), rel=1e-9)
    assert frames["nodal_mises"][0] == pytest.approx(np.full(body.num_vertices, mises), rel=1e-9)
    assert frames["stretches"][0] == pytest.approx(np.tile(np.sort([a, b, c]), (body.num_tetrahedra, 1)), rel=1e-12)
    psi = 0.5 * mu * (a**2 + b**2 + c**2 - 3) - mu * np.log(J) + 0.5 * lam * (J - 1) ** 2
    assert frames["elastic_energy"][0] == pytest.approx(psi * body.volumes.sum(), rel=1e-9)
    assert frames["volume"][0] == pytest.approx(J * body.volumes.sum(), rel=1e-12)


def test_patches_have_their_energy_and_its_derivative():
    """sum V psi(F; lam = 0) + sum W lam/2 theta^2 by hand, and sum V P : grad w as its change for a change w of u."""
    body, E, nu = mesh(), np.linspace(4e4, 8e4, 96)[: mesh().num_tetrahedra], 0.45
    scene = ds.Scene(
        body, ds.StableNeoHookean(E, nu), initial_positions=bent(body.vertices), precision="f64", volume="patches"
    )
    named = [ds.ElasticEnergy(), ds.Stress("piola", kind="first_piola")]
    rollout = ds.Rollout(ds.VelocityVerletSolver(scene, dt=1e-5), 1, outputs=named, gradients=["initial_positions"])
    frames = rollout.forward()
    corners = bent(body.vertices)[body.tetrahedra]
    edges, rest = (np.swapaxes(x[:, 1:] - x[:, :1], 1, 2) for x in (corners, body.vertices[body.tetrahedra]))
    B = np.linalg.inv(rest)
    F = edges @ B
    mu, lam, J = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu)), np.linalg.det(F)
    own = 0.5 * mu * ((F**2).sum((1, 2)) - 3) - mu * np.log(J)
    patches, V = volume_patches(body), body.volumes
    W, stiff, swollen = (np.bincount(patches, x * V) for x in (np.ones(len(V)), lam, J - 1))
    assert len(W) < len(V) and (own * V).sum() + (0.5 * stiff * swollen**2 / W**2).sum() == pytest.approx(
        frames["elastic_energy"][0], rel=1e-12
    )
    by = rollout.vjp(frames, elastic_energy=np.array([1.0, 0.0]))["initial_positions"]
    columns = (frames["piola"][0] * V[:, None, None]) @ np.swapaxes(B, 1, 2)
    nodal = np.zeros_like(by)
    np.add.at(nodal, body.tetrahedra[:, 1:], np.swapaxes(columns, 1, 2))
    np.add.at(nodal, body.tetrahedra[:, 0], -columns.sum(2))
    assert nodal == pytest.approx(by, abs=1e-9 * np.abs(by).max())


def test_where_principal_values_coincide():
    """At rest von Mises stress is 0 and has the gradient 0; a sum of principal values has that of the trace."""
    body = mesh()
    scene = ds.Scene(body, ds.StableNeoHookean(5e4, 0.3), precision="f64")
    named = [ds.Stress("mises", von_mises=True), ds.Stress("each", principal=True), ds.Strain("wide", stretches=True)]
    rollout = ds.Rollout(ds.SemiImplicitSolver(scene, dt=1e-5), 1, outputs=named, gradients=["initial_positions"])
    frames = rollout.forward()
    assert not frames["mises"].any() and frames["wide"] == pytest.approx(np.ones_like(frames["wide"]))
    by = rollout.vjp(frames, mises=np.ones_like(frames["mises"]))["initial_positions"]
    assert not by.any()
    seed = np.zeros_like(frames["each"])
    seed[0] = body.volumes[:, None]
    swollen = (rollout.vjp(frames, each=seed)["initial_positions"] * body.vertices).sum()
    bulk = 3 * 5e4 / (3 * (1 - 2 * 0.3))  # d tr sigma / d scale of x = (1 + scale) X: 3 K times 3
    assert swollen == pytest.approx(3 * bulk * body.volumes.sum(), rel=1e-9)


def test_what_does_not_fit_is_refused():
    scene = ds.Scene(mesh(), ViscousRubber(5e4, 0.3, 10.0), precision="f64")
    solver = ds.SemiImplicitSolver(scene, dt=1e-4)
    for output in (ds.Stress(), ds.ElasticEnergy()):
        with pytest.raises(ValueError, match="take a law without rates"):
            ds.Rollout(solver, 1, outputs=output)
    ds.Rollout(solver, 1, outputs=ds.Strain())
    with pytest.raises(ValueError, match="open, or turned two ways, at the edge"):
        ds.Rollout(solver, 1, outputs=ds.EnclosedVolume(scene.mesh.surface_triangles[1:]))
    with pytest.raises(ValueError, match='kind must be "cauchy"'):
        ds.Stress(kind="second")
    with pytest.raises(ValueError, match="P is not symmetric"):
        ds.Stress(kind="first_piola", principal=True)
    with pytest.raises(ValueError, match="principal and von_mises exclude each other"):
        ds.Stress(principal=True, von_mises=True)
    with pytest.raises(ValueError, match='at must be "tetrahedra"'):
        ds.Strain(at="nodes")
