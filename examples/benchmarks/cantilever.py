"""Equilibria of cantilevers against beam theory: the deflection under its own weight, and the elastica.

Two tables. First, small strains (linear elasticity): the tip's drop over that of a beam with shear, for both patterns of
cutting cells and several refinements. Linear tetrahedra lock: they bend too little, most of all when nearly incompressible.
Second, large rotations: a slender bar with nu = 0 against the elastica, under its own weight and under a load at the tip.
What is missing there is locking too, of order h^2: two meshes extrapolate it away to some thousandths of L. Under strong
loads the bar then hangs lower than the elastica by about P / (E A), a hundredth: it stretches and shears, the elastica
does not.

    python examples/benchmarks/cantilever.py [--quick] [folder for a picture]
"""

import sys
import time
from pathlib import Path

import numpy as np

import diffsim_ti as ds
from diffsim_ti.picture import save_picture

E, G = 1e6, 9.81
# Timoshenko's beam, L = 1 m, W = H = 0.2 m, 1000 kg/m^3: the tip's drop [m]
BEAM = {0.3: 0.38288, 0.45: 0.38450}
# Shares of it that linear tetrahedra reach, from an independent code: {(pattern, nu): {cells across: share}}
KNOWN = {
    ("kuhn", 0.3): {1: 0.241, 2: 0.509, 4: 0.780, 6: 0.877},
    ("kuhn", 0.45): {1: 0.138, 2: 0.309, 4: 0.583, 6: 0.730},
    ("five", 0.3): {2: 0.660, 4: 0.871, 6: 0.928},
    ("five", 0.45): {2: 0.580, 4: 0.810, 6: 0.880},
}
# The elastica, (tip drop / L, reach / L); weight: rho g A L^3 / (E I), load: P L^2 / (E I)
ELASTICA = {
    ("weight", 1.0): (0.123471, 0.991246),
    ("weight", 2.0): (0.238507, 0.966893),
    ("weight", 20.0): (0.829881, 0.445232),
    ("load", 1.0): (0.301721, 0.943567),
    ("load", 5.0): (0.713792, 0.612372),
    ("load", 10.0): (0.810609, 0.445004),
}
SLENDERNESS = 12  # length over height of the elastica's bar


def tip(scene: ds.Scene, load_steps: int = 1) -> np.ndarray:
    """Displacement of the middle of the end face at equilibrium [m]."""
    frames = ds.Rollout(ds.StaticSolver(scene, load_steps), 1).forward()
    return frames.displacements[-1][scene.mesh.vertex_sets["xmax"]].mean(0)


def small_strain_drop(pattern: str, nu: float, cells: int) -> float:
    """Drop of the tip under its own weight, linear elasticity, cubic cells [m]."""
    mesh = ds.TetrahedralMesh.create_box((5 * cells + 1, cells + 1, cells + 1), (1.0, 0.2, 0.2), pattern=pattern)
    material = ds.LinearElastic(E, nu)
    return -tip(ds.Scene(mesh, material, 1000.0, [ds.Gravity(-G)], "xmin", precision="f64"))[1]


def elastica_scene(kind: str, number: float, cells: int) -> ds.Scene:
    """A bar of cubic cells, nu = 0, L = 1 m, at a dimensionless load."""
    height = 1.0 / SLENDERNESS
    mesh = ds.TetrahedralMesh.create_box((SLENDERNESS * cells + 1, cells + 1, cells + 1), (1.0, height, height), "five")
    bending = E * height**4 / 12  # E I [N m^2]
    end = mesh.vertex_sets["xmax"]
    if kind == "weight":
        density, terms = number * bending / (G * height**2), [ds.Gravity(-G)]
    else:
        inner = (mesh.vertices[end, 1:] > 0) & (mesh.vertices[end, 1:] < height)
        share = (1 + inner).prod(1) / (4 * cells**2)  # an even traction's share of each vertex of the end face
        density, terms = 1.0, [ds.ExternalForce(np.outer(share, [0, -number * bending, 0]), end)]
    return ds.Scene(mesh, ds.StableNeoHookean(E, 0.0), density, terms, "xmin", precision="f64")


def elastica_tip(kind: str, number: float, cells: int) -> np.ndarray:
    """(tip drop, reach) over L."""
    u = tip(elastica_scene(kind, number, cells), load_steps=4 if number > 2 else 1)
    return np.array([-u[1], 1 + u[0]])


def save_bent(path, numbers=(0.0, 1.0, 2.0, 5.0), cells: int = 3) -> None:
    """A picture of the bar bent by ever larger loads at its tip."""
    places, drops = [], []
    for number in numbers:
        scene = elastica_scene("load", max(number, 1e-6), cells)
        frames = ds.Rollout(ds.StaticSolver(scene, 4), 1).forward()
        places.append(frames.positions[-1])
        drops.append(-frames.displacements[-1][:, 1])
    bars = ds.TetrahedralMesh.joined([scene.mesh] * len(numbers))
    save_picture(
        path,
        bars,
        np.concatenate(places),
        np.concatenate(drops),
        "deflection [m]",
        azimuth=20,
        elevation=8,
        box=[[0, -0.75, 0], [1.2, 0.1, 0.1]],
        title="loads P L²/(E I) = " + ", ".join(f"{number:g}" for number in numbers),
    )


def small_strains(cells: dict) -> dict:
    """{(pattern, nu, cells across): (share of the beam's drop, the known share)}, printed as a table."""
    print("own weight, small strains: share of the beam's drop (known share)")
    out = {}
    for (pattern, nu), known in KNOWN.items():
        for n in cells[pattern]:
            out[pattern, nu, n] = small_strain_drop(pattern, nu, n) / BEAM[nu], known[n]
        row = "  ".join(f"{n} cells {out[pattern, nu, n][0]:.3f} ({known[n]:.3f})" for n in cells[pattern])
        print(f"  {pattern}, nu {nu:4.2f}: {row}")
    return out


def elasticas(cases, coarse: int, fine: int) -> dict:
    """{(kind, number): errors of (drop, reach) over L on the fine mesh, and extrapolated}, printed as a table."""
    print(f"elastica, nu 0, five, {coarse} and {fine} cells across: drop / L, reach / L")
    out = {}
    for case in cases:
        a, b = elastica_tip(*case, coarse), elastica_tip(*case, fine)
        limit = b + (b - a) / ((fine / coarse) ** 2 - 1)
        out[case] = b - ELASTICA[case], limit - ELASTICA[case]
        print(
            f"  {case[0]} {case[1]:4.1f}: exact {ELASTICA[case][0]:.4f} {ELASTICA[case][1]:.4f}, "
            f"computed {b[0]:.4f} {b[1]:.4f}, extrapolated {limit[0]:.4f} {limit[1]:.4f}"
        )
    return out


def main(quick: bool = False, picture_folder: str | None = None) -> dict:
    """Returns the shares of `small_strains`, the errors of `elasticas`, and seconds."""
    start = time.perf_counter()
    shares = small_strains({"kuhn": [1, 2], "five": [2]} if quick else {"kuhn": [1, 2, 4, 6], "five": [2, 4, 6]})
    cases = [("load", 1.0)] if quick else list(ELASTICA)
    errors = elasticas(cases, *((2, 3) if quick else (4, 6)))
    seconds = time.perf_counter() - start
    if picture_folder:
        save_bent(Path(picture_folder) / "cantilever.png")
    off = max(abs(share - known) for share, known in shares.values())
    print(f"the shares are those of the other code to {off:.2g}; {seconds:.1f} s")
    return {"shares": shares, "elastica": errors, "seconds": seconds}


if __name__ == "__main__":
    ds.init(precision="f64")
    main("--quick" in sys.argv, *[folder for folder in sys.argv[1:] if folder != "--quick"])
