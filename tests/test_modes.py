"""Matrices of a scene and its modes, against the same elements assembled in another way, and against closed forms."""

import numpy as np
import pytest
from scipy.linalg import eigh

import diffsim_ti as ds
from diffsim_ti import verify
from diffsim_ti.mechanics.interactions import host_forces

E, NU, RHO = 3e6, 0.3, 1200.0


def strain_displacement(mesh):
    """(B, V): the textbook's 6 x 12 matrices in Voigt's notation, from the coefficients of N_a = a + b x + c y + d z."""
    X = mesh.vertices[mesh.tetrahedra]
    N = np.linalg.inv(np.concatenate([np.ones((len(X), 4, 1)), X], 2))[:, 1:]  # columns: grad N_a
    B = np.zeros((len(X), 6, 12))
    for a in range(4):
        x, y, z = N[:, 0, a], N[:, 1, a], N[:, 2, a]
        for row, column, value in (
            (0, 0, x),
            (1, 1, y),
            (2, 2, z),
            (3, 1, z),
            (3, 2, y),
            (4, 0, z),
            (4, 2, x),
            (5, 0, y),
            (5, 1, x),
        ):
            B[:, row, 3 * a + column] = value
    return B, np.linalg.det(X[:, 1:] - X[:, :1]) / 6


def dense(mesh):
    """(K, M) of linear elasticity."""
    B, V = strain_displacement(mesh)
    mu, lam = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
    C = np.diag([2 * mu] * 3 + [mu] * 3)
    C[:3, :3] += lam
    K, m = np.zeros((3 * mesh.num_vertices,) * 2), np.zeros(mesh.num_vertices)
    for e, tet in enumerate(mesh.tetrahedra):
        rows = (3 * tet[:, None] + np.arange(3)).ravel()
        K[np.ix_(rows, rows)] += V[e] * B[e].T @ C @ B[e]
        m[tet] += RHO * V[e] / 4
    return K, np.diag(np.repeat(m, 3))


def scene_of(mesh, law=ds.StableNeoHookean, **options):
    return ds.Scene(mesh, law(youngs_modulus=E, poissons_ratio=NU), RHO, **dict(precision="f64") | options)


@pytest.mark.parametrize("law", [ds.StableNeoHookean, ds.Corotated, ds.LinearElastic])
def test_matrices_are_the_textbooks(law):
    mesh = ds.TetrahedralMesh.create_box(3, size=0.2)
    scene, (K, M) = scene_of(mesh, law), dense(mesh)
    assert np.abs(scene.stiffness_matrix().toarray() - K).max() <= 1e-12 * np.abs(K).max()
    assert np.abs(scene.mass_matrix().toarray() - M).max() <= 1e-14 * M.max()


def test_a_free_cube():
    """Six rigid motions, then the eigenvalues of the dense pencil."""
    mesh = ds.TetrahedralMesh.create_box(4, size=0.2)
    found, (K, M) = ds.modes(scene_of(mesh), 14), dense(mesh)
    values, _ = eigh(K, M)
    assert np.abs(found.eigenvalues[:6]).max() <= 1e-10 * values[-1]
    assert found.frequencies[6:] == pytest.approx(np.sqrt(values[6:14]) / (2 * np.pi), rel=1e-8)
    flat = found.shapes.reshape(14, -1)
    assert flat @ M @ flat.T == pytest.approx(np.eye(14), abs=1e-9)
    assert np.abs(K @ flat.T - M @ flat.T * found.eigenvalues).max() <= 1e-9 * np.abs(K).max() * np.abs(flat).max()


def test_a_clamped_beam_by_both_eigensolvers():
    """Of 600 and more unknowns the lowest modes alone are computed."""
    mesh = ds.TetrahedralMesh.create_box((12, 5, 5), size=(0.4, 0.1, 0.08))
    scene, (K, M) = scene_of(mesh, fixed="xmin"), dense(mesh)
    keep = np.setdiff1d(np.arange(mesh.num_vertices), scene.fixed)
    rows = (3 * keep[:, None] + np.arange(3)).ravel()
    assert len(rows) > 600
    values = eigh(K[np.ix_(rows, rows)], M[np.ix_(rows, rows)], eigvals_only=True, subset_by_index=[0, 5])
    found = ds.modes(scene, 6)
    assert found.frequencies == pytest.approx(np.sqrt(values) / (2 * np.pi), rel=1e-8)
    assert not found.shapes[:, scene.fixed].any()


def test_of_a_state_that_is_unstable_the_lowest_modes_are_found():
    """Of a column that is pressed by a hundredth of its length, with 960 unknowns: the eigenvalues of the dense pencil."""
    mesh = ds.TetrahedralMesh.create_box((4, 21, 4), size=(0.1, 1.0, 0.1))
    scene, u = scene_of(mesh, fixed="ymin"), mesh.vertices * [0, -0.01, 0]
    free = np.setdiff1d(np.arange(3 * mesh.num_vertices), 3 * scene.fixed[:, None] + np.arange(3))
    K, M = (x.toarray()[np.ix_(free, free)] for x in (scene.stiffness_matrix(u), scene.mass_matrix()))
    values = eigh(K, M, eigvals_only=True, subset_by_index=[0, 4])
    assert values[0] < 20 * values[2] < 0
    assert ds.modes(scene, 5, u).eigenvalues == pytest.approx(values, rel=1e-8)


def test_scikit_fem_has_the_same_elements():
    """Its stiffness by its own quadrature; its mass lumped by row sums."""
    skfem = pytest.importorskip("skfem")
    from skfem.models.elasticity import lame_parameters, linear_elasticity

    mesh = ds.TetrahedralMesh.create_box(4, size=(0.2, 0.1, 0.15))
    theirs = skfem.MeshTet(mesh.vertices.T.copy(), mesh.tetrahedra.T.copy())
    basis = skfem.Basis(theirs, skfem.ElementVector(skfem.ElementTetP1()))
    K = linear_elasticity(*lame_parameters(E, NU)).assemble(basis).toarray()
    place = basis.nodal_dofs.T.ravel()  # of unknown 3 i + d
    K = K[np.ix_(place, place)]
    assert np.abs(scene_of(mesh).stiffness_matrix().toarray() - K).max() <= 1e-11 * np.abs(K).max()
    found = ds.modes(scene_of(mesh, fixed="xmin"), 5)
    keep = np.setdiff1d(np.arange(mesh.num_vertices), mesh.vertex_indices("xmin"))
    rows = (3 * keep[:, None] + np.arange(3)).ravel()
    values = eigh(K[np.ix_(rows, rows)], dense(mesh)[1][np.ix_(rows, rows)], eigvals_only=True, subset_by_index=[0, 4])
    assert found.frequencies == pytest.approx(np.sqrt(values) / (2 * np.pi), rel=1e-8)


def timoshenko(L, h, n):
    """First n frequencies [Hz] of a clamped beam of square section h, shear and rotary inertia counted, by nu = 0: the roots
    of the determinant of four boundary conditions on exp(k x) solutions. Shear coefficient 5/6."""
    from scipy.linalg import expm
    from scipy.optimize import brentq

    A, inertia, G = h**2, h**4 / 12, E / 2

    def determinant(f):  # of (moment, shear) at the free end by those at the clamped one, states (w, phi, M, Q)
        w2 = (2 * np.pi * f) ** 2
        D = np.array(
            [
                [0, 1, 0, 1 / (5 / 6 * G * A)],
                [0, 0, 1 / (E * inertia), 0],
                [0, -RHO * inertia * w2, 0, -1],
                [-RHO * A * w2, 0, 0, 0],
            ]
        )
        return np.linalg.det(expm(D * L)[2:, 2:])

    base, out, f = 0.16 * h / L**2 * np.sqrt(E / RHO), [], 0.0
    while len(out) < n:
        while determinant(f + 0.2 * base) * determinant(f) > 0:
            f += 0.2 * base
        out.append(brentq(determinant, f, f + 0.2 * base))
        f = out[-1] * (1 + 1e-9)
    return np.array(out)


def test_a_clamped_beam_converges_to_the_beams_frequencies():
    """Two pairs of bending modes of a square section, nu = 0: errors fall by h^2, and extrapolated to h = 0 they are 1 %."""
    L, h, found = 1.0, 0.1, []
    for n in (2, 4, 6):
        mesh = ds.TetrahedralMesh.create_box((10 * n + 1, n + 1, n + 1), size=(L, h, h), pattern="five")
        scene = ds.Scene(mesh, ds.LinearElastic(E, 0.0), RHO, fixed="xmin", precision="f64")
        found.append(ds.modes(scene, 2).frequencies.mean())
    exact = timoshenko(L, h, 1)[0]
    assert exact == pytest.approx(
        1.8751**2 / (2 * np.pi) * np.sqrt(E / RHO / 12) * h / L**2, rel=0.02
    )  # Euler's, slender
    errors = np.array(found) ** 2 / exact**2 - 1  # stiffness is what is too large
    assert np.all(errors > 0) and errors[0] / errors[1] == pytest.approx(4, rel=0.15)
    limit = errors[2] - (errors[1] - errors[2]) * (1 / 36) / (1 / 16 - 1 / 36)
    assert abs(limit) < 0.02


def test_a_bar_in_a_smooth_tube_has_the_exact_frequencies():
    """Rollers on all sides leave motion along x alone: f = (2 i - 1) c / 4 L, c^2 = (lambda + 2 mu) / rho, by order 2."""
    L, c = 0.6, np.sqrt(E * (1 - NU) / ((1 + NU) * (1 - 2 * NU)) / RHO)
    exact, off = (2 * np.arange(3) + 1) * c / (4 * L), []
    for n in (8, 16, 32):
        box = ds.TetrahedralMesh.create_box((n + 1, 2, 2), size=(L, 0.05, 0.05))
        sets = dict(box.vertex_sets) | {"all": np.arange(box.num_vertices)}
        mesh = ds.TetrahedralMesh(box.vertices, box.tetrahedra, vertex_sets=sets)
        scene = ds.Scene(mesh, ds.LinearElastic(E, NU), RHO, fixed={"all": "yz", "xmin": "x"}, precision="f64")
        found = ds.modes(scene, 3)
        assert np.abs(found.shapes[:, :, 1:]).max() == 0 and not found.shapes[:, scene.fixed].any()
        off.append(np.abs(found.frequencies / exact - 1))
    assert (
        np.all(off[2] < 4e-3)
        and off[0] / off[1] == pytest.approx(4, rel=0.1)
        and off[1] / off[2] == pytest.approx(4, rel=0.1)
    )


def test_rollers_in_any_direction_leave_what_they_leave():
    """Supports that are turned with the body change no frequency, and nothing moves as they hold it."""
    mesh, turn = (
        ds.TetrahedralMesh.create_box((4, 3, 3), size=(0.3, 0.11, 0.08)),
        np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0],
    )
    turn *= np.sign(np.linalg.det(turn))
    straight = ds.modes(scene_of(mesh, fixed={"xmin": "x", "zmin": "yz"}), 5)
    turned = ds.TetrahedralMesh(mesh.vertices @ turn.T, mesh.tetrahedra, vertex_sets=dict(mesh.vertex_sets))
    found = ds.modes(scene_of(turned, fixed={"xmin": turn[:, 0], "zmin": turn[:, 1:].T}), 5)
    assert found.frequencies == pytest.approx(straight.frequencies, rel=1e-9)
    held = np.einsum(
        "kij,mkj->mki",
        scene_of(turned, fixed={"xmin": turn[:, 0], "zmin": turn[:, 1:].T}).supports.held,
        found.shapes[:, np.union1d(mesh.vertex_indices("xmin"), mesh.vertex_indices("zmin"))],
    )
    assert np.abs(held).max() <= 1e-9 * np.abs(found.shapes).max()
    by = np.array([1.0, 0, 0, 0, 0])
    slope = float(found.gradients(by)["youngs_modulus"])
    assert slope == pytest.approx(0.5 * found.frequencies[0] / E, rel=1e-8)


def bent(mesh):
    x = mesh.vertices
    return 0.02 * np.sin(9 * x[:, [1, 2, 0]] + 1) * np.array([1.0, 0.7, -0.8])


@pytest.mark.parametrize("volume", ["tetrahedra", "patches"])
def test_stiffness_is_the_slope_of_forces(volume):
    """At a bent state; that of patches reaches beyond their tetrahedra."""
    mesh = ds.TetrahedralMesh.create_box(3, size=0.2)
    scene = scene_of(mesh, volume=volume)
    from diffsim_ti.outputs.forces_at_frames import BodyForces

    body, u = BodyForces(scene), bent(mesh)
    body.load(scene.inputs.values)
    w, h = np.random.default_rng(0).normal(size=u.shape), 1e-6

    def forces(t):
        body.place(u + t * w, 0 * u)
        return body.forces()

    slope = (forces(-h) - forces(h)) / (2 * h)
    assert (scene.stiffness_matrix(u) @ w.ravel()).reshape(-1, 3) == pytest.approx(
        slope, abs=1e-7 * np.abs(slope).max()
    )


@pytest.mark.parametrize("state", ["rest", "bent"])
def test_gradients_of_frequencies_agree_with_differences(state):
    mesh = ds.TetrahedralMesh.create_box(3, size=(0.3, 0.11, 0.08))
    scene = scene_of(mesh, fixed="xmin")
    u = bent(mesh) * (mesh.vertices[:, :1] > 0) if state == "bent" else np.zeros_like(mesh.vertices)
    found, by, rng = ds.modes(scene, 4, u), np.array([1.0, -0.5, 0.3, 0.2]), np.random.default_rng(3)
    assert found.groups == [[0], [1], [2], [3]]
    gradients = found.gradients(by)

    def loss(key, value):
        if key == "displacements":
            return by @ ds.modes(scene, 4, value).frequencies
        if key == "rest_positions":
            moved = ds.TetrahedralMesh(value, mesh.tetrahedra)
            fixed = scene.fixed
            return by @ ds.modes(ds.Scene(moved, scene.material, RHO, fixed=fixed, precision="f64"), 4, u).frequencies
        if key == "density":
            return by @ ds.modes(scene.replace(density=value), 4, u).frequencies
        numbers = dict(youngs_modulus=E, poissons_ratio=NU) | {key: float(value)}
        return by @ ds.modes(scene.replace(material=ds.StableNeoHookean(**numbers)), 4, u).frequencies

    for key in ("youngs_modulus", "poissons_ratio", "density", "rest_positions", "displacements"):
        base = u if key == "displacements" else scene.inputs.values[key]
        scale = 0.01 if base.ndim else 0.1 * float(base)
        direction = scale * rng.normal(size=base.shape)
        if key == "displacements":
            direction[scene.fixed] = 0
        slope, s = (gradients[key] * direction).sum(), 1e-3 if key == "displacements" else 1e-2
        coarse, fine = (
            (loss(key, base + t * direction) - loss(key, base - t * direction)) / (2 * t) for t in (s, s / 2)
        )
        assert slope == pytest.approx((4 * fine - coarse) / 3, rel=2e-6), key


def test_coinciding_frequencies_have_the_gradient_of_their_mean():
    """A free cube, whose cells are cut alike about a diagonal of space, has pairs; moduli that differ part them."""
    mesh = ds.TetrahedralMesh.create_box(3, size=0.1)
    material = ds.StableNeoHookean(youngs_modulus=np.full(mesh.num_tetrahedra, E), poissons_ratio=NU)
    scene = ds.Scene(mesh, material, RHO, precision="f64")
    found = ds.modes(scene, 12)
    assert found.groups[0] == [0, 1, 2, 3, 4, 5]
    pairs = [group for group in found.groups if len(group) == 2]
    assert pairs, found.frequencies
    by = np.zeros(12)
    by[pairs[0]] = 0.5
    direction = E * np.random.default_rng(0).uniform(-1, 1, mesh.num_tetrahedra)
    slope = (found.gradients(by)["youngs_modulus"] * direction).sum()

    def mean(t):
        moved = ds.StableNeoHookean(youngs_modulus=E + t * direction, poissons_ratio=NU)
        return by @ ds.modes(scene.replace(material=moved), 12).frequencies

    differences, _ = verify.central_difference(lambda t: mean(0.1 * t) / 0.1)
    assert slope == pytest.approx(differences, rel=1e-6)
    with pytest.raises(ValueError, match="of which only the mean has a gradient"):
        found.gradients(np.eye(12)[pairs[0][0]])


def held_up(mesh, **numbers) -> ds.Scene:
    """A block between springs, tendons with and without stiffness, a spring without length, and two foundations."""
    top = mesh.with_surface_set("lid", lambda x, n: n[:, 1] > 0.9)
    given = dict(stiffness=9e3, tension=400.0, length=0.3, elastic=8e3, normal=3e6, tangential=1e6) | numbers
    inner = numbers.get("inner", np.array([0.11, 0.05, 0.03]))
    terms = [
        ds.Spring([0, 1], [20, 14], given["stiffness"], tension=5.0),
        ds.Spring(4, ds.Anchor(BLOCK.vertices[4]), 3e3),
        ds.Cable([3, inner, 26, ds.Anchor([0.5, 0.3, 0.2])], given["tension"], name="tendon"),
        ds.Cable([2, 15, 8], length=given["length"], stiffness=given["elastic"], name="rope"),
        ds.Cable([2, 21], length=9.0, stiffness=1e4, name="slack"),
        ds.ElasticFoundation(given["normal"], given["tangential"], "lid"),
        ds.ElasticFoundation(2e4, 0.0, name="bed"),
    ]
    return scene_of(top, terms=terms)


BLOCK = ds.TetrahedralMesh.create_box(3, size=(0.3, 0.11, 0.08))


def test_stiffness_of_what_holds_a_body():
    """The slope of all forces on it, and one mass on a spring, or between two pulls, as the textbook has them."""
    scene, u = held_up(BLOCK), bent(BLOCK)
    attached = host_forces(scene).take(scene.inputs.derive(scene.inputs.values))
    w, h = np.random.default_rng(0).normal(size=u.shape), 1e-6
    slope = (attached.forces(u - h * w) - attached.forces(u + h * w)) / (2 * h)
    bare = scene.replace(terms=())
    found = ((scene.stiffness_matrix(u) - bare.stiffness_matrix(u)) @ w.ravel()).reshape(-1, 3)
    assert found == pytest.approx(slope, abs=1e-8 * np.abs(slope).max())
    soft = ds.TetrahedralMesh.create_box(2, size=0.1)
    mass, k, T, d = RHO * soft.volume, 700.0, 50.0, 0.4
    middle = soft.vertices.mean(0)
    spring = ds.Spring(middle, ds.Anchor(middle + [d, 0, 0]), k)
    strings = ds.Cable([ds.Anchor(middle - [0, d, 0]), middle, ds.Anchor(middle + [0, d, 0])], T)
    still = {"xmin": "yz"} | {"xmax": "yz"}  # which leaves the motion along x
    for term, stiffness in ((spring, k), (strings, 2 * T / d)):
        scene = ds.Scene(soft, ds.LinearElastic(1e9, 0.0), RHO, term, still, precision="f64")
        assert ds.modes(scene, 1).frequencies[0] == pytest.approx(np.sqrt(stiffness / mass) / (2 * np.pi), rel=1e-5)


def test_gradients_by_what_holds_a_body():
    """By every number of springs, cables and foundations, the rest shape, and the state that is bent."""
    by, rng, u = np.array([1.0, -0.5, 0.3]), np.random.default_rng(3), bent(BLOCK)
    scenes = [held_up(BLOCK), held_up(BLOCK, inner=13)]  # material points stay where they are if the rest shape moves
    found = [ds.modes(scene, 3, u).gradients(by) for scene in scenes]
    assert found[0]["slack.stiffness"] == 0 and found[0]["slack.length"] == 0
    names = dict(
        stiffness="spring_stiffness",
        tension="tendon.tension",
        length="rope.length",
        elastic="rope.stiffness",
        normal="foundation_normal",
        tangential="foundation_tangential",
    )

    def loss(argument, value):
        if argument == "displacements":
            return by @ ds.modes(scenes[0], 3, value).frequencies
        if argument == "rest_positions":
            moved = ds.TetrahedralMesh(value, BLOCK.tetrahedra)
            return by @ ds.modes(held_up(moved, inner=13), 3, u).frequencies
        return by @ ds.modes(held_up(BLOCK, **{argument: value}), 3, u).frequencies

    for argument in [*names, "displacements", "rest_positions"]:
        name, fixed = names.get(argument, argument), argument == "rest_positions"
        base = u if argument == "displacements" else scenes[fixed].inputs.values[name]
        direction = (1e-3 if base.ndim else 0.1 * float(base)) * rng.normal(size=base.shape)
        if fixed:
            direction[4] = 0  # its anchor does not move with it
        slope, s = (found[fixed][name] * direction).sum(), 2e-2 if base.ndim else 0.1
        coarse, fine = (
            (loss(argument, base + t * direction) - loss(argument, base - t * direction)) / (2 * t) for t in (s, s / 2)
        )
        assert slope == pytest.approx((4 * fine - coarse) / 3, rel=2e-6), argument


def test_what_does_not_fit_is_refused():
    scene = scene_of(ds.TetrahedralMesh.create_box(2))
    for k in (0, 25, 1.5):
        with pytest.raises(ValueError, match="k must be a whole number of 1 .. 24"):
            ds.modes(scene, k)
    with pytest.raises(ValueError, match="of shape"):
        scene.stiffness_matrix(np.zeros((3, 3)))
    with pytest.raises(ValueError, match="frequency 0 has no gradient"):
        ds.modes(scene, 8).gradients(np.ones(8))
