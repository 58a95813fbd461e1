"""The dumb-bell of a tensile test (ASTM D412) in three dimensions: what the crosshead's strain is, and what it is taken for.

Its narrow part has 33 x 6 x 3 mm, and widens to tabs of 25 mm. The force is that of the middle, whose stretch only a camera
sees: the machine divides the way of its crosshead by 33 mm, whatever lies between its grips. An eighth of the specimen, in
ten-node tetrahedra, is pulled by statics. From force and way of the crosshead `identify` finds its stiffness.

    python examples/identify/dumbbell.py [name of a rubber]
"""

import sys

import numpy as np

import diffsim_ti as ds

LENGTH, WIDTH, THICKNESS, TAB = 0.033, 0.006, 0.003, 0.025  # [m]
RADIUS = 0.014  # of the shoulders [m]
NOISE = 0.002  # of the largest force


def specimen(shoulder: float, cells: tuple[int, int, int]) -> ds.TetrahedralMesh:
    """An eighth, its middle at x = 0, with so much of the shoulder [m] outside the grip."""
    end = LENGTH / 2 + shoulder
    mesh = ds.TetrahedralMesh.create_box(np.array(cells) + 1, (end, WIDTH / 2, THICKNESS / 2))
    x, y, z = mesh.vertices.T
    out = np.clip(x - LENGTH / 2, 0, RADIUS)
    half = np.minimum(WIDTH / 2 + RADIUS - np.sqrt(RADIUS**2 - out**2), TAB / 2)
    widened = np.stack([x, y * half / (WIDTH / 2), z], 1)
    return ds.TetrahedralMesh(widened, mesh.tetrahedra, vertex_sets=mesh.vertex_sets).quadratic()


def pulled(material, shoulder: float, top: float, steps: int, cells: tuple[int, int, int]) -> ds.Rollout:
    """Statics to a crosshead strain of top - 1, by frames."""
    sides = {"xmin": "x", "ymin": "y", "zmin": "z", "xmax": "xyz"}
    motion = {"xmax": lambda t: [(top - 1) * LENGTH / 2 * t / steps, 0, 0]}
    scene = ds.Scene(specimen(shoulder, cells), material, fixed=sides, motion=motion, precision="f64", volume="patches")
    outputs = [ds.Reaction("xmax", name="force"), ds.MaterialPoints([[0.002, 0, 0]], name="mark")]
    return ds.Rollout(ds.StaticSolver(scene), steps, save_every=1, outputs=outputs)


def curve(frames) -> tuple[np.ndarray, np.ndarray]:
    """(nominal stress [Pa], stretch of the middle) of each frame."""
    stress = 4 * frames["force"][..., 0].reshape(len(frames.times)) / (WIDTH * THICKNESS)
    return stress, frames["mark"][:, 0, 0] / 0.002


def main(name: str = "Ecoflex 00-30", steps: int = 4, cells: tuple = (8, 2, 1), top: float = 1.4) -> dict:
    """For grips at the ends of the narrow part and 12 mm farther out: largest error of the closed form at the stretch of the
    middle, share of the crosshead's strain that the middle has, and by how much the closed form at the crosshead's strain
    makes the rubber too stiff or too soft. And what `identify` found of the law's first number from the second curve."""
    material = ds.materials.library[name].up_to(1.5 * top, volume_change=0.05)
    crosshead, out = 1 + (top - 1) * np.arange(1, steps + 1) / steps, {}
    for said, shoulder in (("at the narrow part", 0.0), ("12 mm farther out", 0.012)):
        rollout = pulled(material, shoulder, top, steps, cells)
        frames = rollout.forward()
        stress, stretch = (x[1:] for x in curve(frames))
        errors, share = stress / material.nominal_stress(stretch) - 1, (stretch - 1) / (crosshead - 1)
        modulus = stress[0] / material.nominal_stress(crosshead)[0]
        out[said] = dict(error=np.abs(errors).max(), share=share, modulus=modulus)
        print(f"grips {said}: force within {out[said]['error']:.2%} of the closed form at the stretch of the middle;")
        print(f"  the middle has {share[0]:.3f} to {share[-1]:.3f} of the crosshead's strain, which makes the rubber")
        print(f"  {modulus:.3f} as stiff as it is")
    noise = NOISE * np.abs(frames["force"]).max()
    seen = frames["force"] + noise * np.random.default_rng(0).standard_normal(frames["force"].shape)
    first = material.inputs[0]
    truth = np.asarray(frames.inputs[first])
    found = ds.identify(rollout, {"force": seen}, {first: 0.7 * truth}, noise, starts=1, check_mesh=False)
    print(found)
    return out | dict(found=found.estimates[first], deviation=found.standard_errors[first], truth=truth)


if __name__ == "__main__":
    ds.init(precision="f64")
    main(*sys.argv[1:])
