"""Yield stress and hardening of a metal from one tensile test: the force while a tapered bar is drawn out, with noise.

python examples/plasticity/identify_yield.py
"""

import numpy as np

import diffsim_ti as ds

TRUE = {"yield_stress": 250.0, "hardening": 900.0}  # [MPa]
GUESS = {"yield_stress": 400.0, "hardening": 300.0}
DRAWN, STEPS, NOISE = 2.0, 16, 0.005  # [mm], -, of the largest force


def test_bar(resolution=(5, 2, 2)) -> ds.Rollout:
    """A bar of 20 mm, 4 mm wide in the middle of its length and 5 mm at its ends, in mm, N and MPa."""
    box = ds.TetrahedralMesh.create_box(resolution, (20.0, 1.0, 1.0))
    x = box.vertices.copy()
    x[:, 1:] *= (4 + np.abs(x[:, :1] - 10) / 10)[:, [0, 0]]
    mesh = ds.TetrahedralMesh(x, box.elements, vertex_sets={n: box.vertex_indices(n) for n in ("xmin", "xmax")})
    scene = ds.Scene(
        mesh,
        ds.J2Plasticity(E=70e3, nu=0.33, **GUESS),
        fixed=dict(xmin="xyz", xmax="xyz"),
        motion=dict(xmax=lambda t: [DRAWN * t / STEPS, 0, 0]),
        volume="patches",
        precision="f64",
    )
    return ds.Rollout(ds.StaticSolver(scene, tolerance=1e-10), STEPS, save_every=1, outputs=ds.Reaction("xmax"))


def main() -> dict:
    """{name: (found, standard error, true)} [MPa]."""
    rollout = test_bar()
    force = rollout.forward(**TRUE)["reaction"]
    noise = NOISE * abs(force).max()
    seen = force + noise * np.random.default_rng(1).standard_normal(force.shape)
    seen[0], seen[:, 1:] = np.nan, np.nan  # at rest nothing is measured, and along the bar alone
    found = ds.identify(
        rollout,
        ds.Measurement("reaction", seen, noise),
        {name: ds.Unknown(GUESS[name], range=(20.0, 3000.0)) for name in TRUE},
        check_mesh=False,  # data are of this very mesh
    )
    print(found)
    return {name: (found.estimates[name], found.standard_errors[name], TRUE[name]) for name in TRUE}


if __name__ == "__main__":
    for name, (value, error, true) in main().items():
        print(f"{name}: {value:.2f} +- {error:.2f} MPa (true {true:.0f}; error {100 * error / true:.2f} % of it)")
