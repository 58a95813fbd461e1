"""What positions tell of a material: recovery of the true one from twenty starts, and the direction nobody can see."""

import numpy as np
import pytest
import torch

import diffsim_ti as ds
from diffsim_ti import verify
from diffsim_ti.diff_simulator import rollout_frames

MESH = ds.TetrahedralMesh.create_box([4, 2, 2], [0.6, 0.2, 0.2])
REGIONS = (MESH.centroids[:, 0] > 0.3).astype(int) + (MESH.centroids[:, 1] > 0.1)  # three of them
TRUE = np.array([4e4, 1e5, 2e5])


def body(solver=ds.SemiImplicitSolver, E=TRUE[REGIONS], **options) -> ds.Rollout:
    """A beam held at one end that sags under its weight."""
    scene = ds.Scene(
        MESH, ds.StableNeoHookean(E, 0.3), density=1000.0, terms=[ds.Gravity()], fixed="xmin", precision="f64"
    )
    if solver is ds.StaticSolver:
        return ds.Rollout(solver(scene, tolerance=1e-11), 1)
    return ds.Rollout(solver(scene, dt=1e-2, substeps=8), 20, save_every=5)


@pytest.fixture(scope="module")
def swing():
    return body()


@pytest.mark.parametrize("seed", range(20))
def test_recovery_per_region(swing, seed):
    """From a start off by up to a factor of three: each region's E to 1 %, with positions measured to 10 micrometres."""
    rng = np.random.default_rng(seed)
    exact = torch.from_numpy(swing.forward(youngs_modulus=TRUE[REGIONS]).displacements.copy())
    measured = exact + 1e-5 * torch.from_numpy(rng.standard_normal(exact.shape))
    log_E = torch.tensor(np.log(TRUE) + rng.uniform(-np.log(3), np.log(3), 3), requires_grad=True)
    optimizer = torch.optim.LBFGS([log_E], max_iter=40, line_search_fn="strong_wolfe", tolerance_change=1e-14)

    def closure():
        optimizer.zero_grad()
        frames = rollout_frames(swing, youngs_modulus=log_E.exp()[torch.from_numpy(REGIONS)])
        loss = (frames.displacements - measured).square().sum() / measured.square().sum() * 100
        loss.backward()
        return loss

    optimizer.step(closure)
    error = np.abs(log_E.detach().exp().numpy() / TRUE - 1)
    assert error.max() < 0.01


def test_bounds_of_the_regions_hold(swing):
    """The errors that the Fisher matrix foretells at that noise are below the 1 % that recovery keeps."""
    found = verify.identifiability(
        swing, "youngs_modulus", groups={"youngs_modulus": REGIONS}, youngs_modulus=TRUE[REGIONS]
    )
    assert found.eigenvalues.shape == (3,) and found.num_singular == 0
    assert 1e-5 / np.sqrt(found.eigenvalues[0]) < 0.01
    assert found.directions[0]["youngs_modulus"].shape == (3,)


@pytest.mark.parametrize("solver", [ds.SemiImplicitSolver, ds.StaticSolver], ids=lambda s: s.__name__)
def test_stiffness_and_density_together_are_not_seen(solver, swing):
    """Under gravity alone only E / rho acts: a relative change of both by the same share moves nothing."""
    rollout = swing if solver is ds.SemiImplicitSolver else body(solver)
    found = verify.identifiability(rollout, ["youngs_modulus", "density"], youngs_modulus=8e4)
    assert found.num_singular == 1 and "NOT SEEN" in str(found).splitlines()[0]
    blind = np.array([found.directions[0][name][0] for name in ("youngs_modulus", "density")])
    np.testing.assert_allclose(blind / blind[0], [1, 1], atol=1e-6)
    alone = verify.identifiability(rollout, "youngs_modulus", youngs_modulus=8e4)
    assert alone.num_singular == 0
    # columns j and -j: the other direction has twice the eigenvalue of E alone
    assert found.eigenvalues[1] == pytest.approx(2 * alone.eigenvalues[0], rel=1e-6)


def test_the_eigenvalue_is_what_moves(swing):
    """A relative change eps along a direction moves the frames by eps sqrt(eigenvalue), to first order."""
    start = dict(youngs_modulus=np.array(8e4), poissons_ratio=np.array(0.3))
    found, eps = verify.identifiability(swing, list(start), **start), 1e-5
    for value, direction in zip(found.eigenvalues, found.directions):
        ends = [
            swing.forward(**{n: x * (1 + s * eps * direction[n][0]) for n, x in start.items()}).displacements
            for s in (1, -1)
        ]
        moved = np.linalg.norm((ends[0] - ends[1]) / (2 * eps))
        assert moved == pytest.approx(np.sqrt(value), rel=1e-5)


def test_refusals(swing):
    for arguments, expected in (
        (("stiffness",), "no input named 'stiffness'"),
        (("initial_velocities",), "initial_velocities is zero"),
        (("youngs_modulus", {"youngs_modulus": [1, 2]}), r"groups of youngs_modulus: expected shape \(18|groups of"),
    ):
        with pytest.raises(ValueError, match=expected):
            verify.identifiability(swing, *arguments)
