"""Error bars against true errors: `Rollout.accuracy` on problems with known answers, each on three coarse meshes.

Effectivity is the estimated error over the true one: 1 is perfect. Where the mesh has no error, the estimate is to be as
small as the solver's tolerance.

    python examples/benchmarks/error_bars.py [names of problems]
    python examples/benchmarks/error_bars.py refine     # meshes refined by the estimate, and uniformly
"""

import sys
import time
from functools import partial

import numpy as np
from scipy.linalg import expm

import diffsim_ti as ds
from diffsim_ti.accuracy.finer import rollout_on_finer
from diffsim_ti.study.problems import lame_mode, lame_omega, lame_scene


def statics(mesh, material, output, order, density=1000.0, finer=None, **options):
    """(rollout of the equilibrium, how its finer mesh is made)"""
    mesh = mesh.quadratic() if order == 2 and mesh.order == 1 else mesh
    scene = ds.Scene(mesh, material, density, precision="f64", **options)
    return ds.Rollout(ds.StaticSolver(scene, load_steps=2), 1, outputs=output), finer


def hanging_bar(n, order):
    """Elastic energy of a bar of 2 m that hangs, nu 0: (rho g)^2 L^3 A / (6 E) in Joule."""
    mesh = ds.TetrahedralMesh.create_box((2 * n + 1, n + 1, n + 1), (2, 1, 1), "five")
    options = dict(terms=ds.Gravity((9.81, 0, 0)), fixed="xmin")
    return *statics(mesh, ds.LinearElastic(1e6, 0.0), ds.ElasticEnergy(), order, **options), None, 9810**2 * 8 / 6e6


def uniaxial(n, order):
    """Half the width of a block that is drawn to 1.5 times its length, nu 0.3: the mesh has no error."""
    mesh = ds.TetrahedralMesh.create_cube(n + 1)
    fixed = {"xmin": "x", "xmax": "x", "ymin": "y", "zmin": "z"}
    motion = {"xmax": (np.array([0.0, 1.0]), np.array([[0.0, 0, 0], [0.5, 0, 0]]))}
    side = ds.MaterialPoints([[1.0, 1.0, 0.0]], name="side")
    options = dict(fixed=fixed, motion=motion)
    mu, lam, s = 1e5 / 2.6, 0.3e5 / 1.3 / 0.4, 1.5
    width = np.sqrt(np.max(np.roots([lam * s * s, mu - lam * s, -mu])))
    return *statics(mesh, ds.StableNeoHookean(1e5, 0.3), side, order, **options), (0, 1, 0), width


def stretched_bar(n, order):
    """Where the end of a bar of 2 m is that hangs by its weight, rho g L = 2.4 E, nu 0.3: at 6.66 m (meshes of 96 and 320
    ten-node tetrahedra)."""
    mesh = ds.TetrahedralMesh.create_box((n + 1, n // 2 + 1, n // 2 + 1), (2.0, 0.5, 0.5), "five")
    options = dict(terms=ds.Gravity((12.0, 0, 0)), fixed="xmin")
    end = ds.MaterialPoints([[2.0, 0.25, 0.25]], name="end")
    return *statics(mesh, ds.StableNeoHookean(1e4, 0.3), end, order, **options), (1, 0, 0), 6.66


def beam(n, order):
    """Drop of a clamped beam of 1 x 0.2 x 0.2 m under its own weight, nu 0, small strains: 0.37957 m of ten
    nodes on 4 and 6 cells across, extrapolated; Timoshenko's beam 0.37965 m."""
    mesh = ds.TetrahedralMesh.create_box((5 * n + 1, n + 1, n + 1), (1.0, 0.2, 0.2), "five")
    end = ds.MaterialPoints([[1.0, 0.1, 0.1]], name="end")
    options = dict(terms=ds.Gravity(), fixed="xmin")
    return *statics(mesh, ds.LinearElastic(1e6, 0.0), end, order, **options), (0, 1, 0), 0.1 - 0.37957


def cook(n, order):
    """Rise of the corner of Cook's membrane, large strains, plane strain, N, mm, MPa."""
    box = ds.TetrahedralMesh.create_box((n + 1, n + 1, 2), (1, 1, 4 / 48), "five")
    s, r, q = box.vertices.T
    vertices = np.stack([48 * s, 44 * s + r * (44 - 28 * s), 48 * q], 1)
    faces = {name: box.surface_triangles[rows] for name, rows in box.surface_sets.items()}
    sets = {"all": np.arange(len(vertices)), "xmin": box.vertex_sets["xmin"]}
    mesh = ds.TetrahedralMesh(vertices, box.tetrahedra, vertex_sets=sets, surface_sets=faces)
    options = dict(terms=ds.Traction((0, 1 / 16, 0), "xmax"), fixed={"xmin": "xyz", "all": "z"})
    corner, material = ds.MaterialPoints([[48.0, 60.0, 2.0]], name="corner"), ds.StableNeoHookean(0.845 * 1.3, 0.3)
    return *statics(mesh, material, corner, order, **options), (0, 1, 0), 60 + 13.577


def elastica(n, order):
    """Drop of a strip of 1 m and 1 cm under its own weight, rho g A L^3 / (E I) = 1, nu 0, large turns."""
    h = 0.01
    mesh = ds.TetrahedralMesh.create_box((2 * n + 1, 2, 2), (1.0, h, h), "five")
    options = dict(terms=ds.Gravity(), fixed="xmin", density=1e7 * h**2 / 12 / 9.81)
    end = ds.MaterialPoints([[1.0, h / 2, h / 2]], name="end")
    return *statics(mesh, ds.StableNeoHookean(1e7, 0.0), end, order, **options), (0, 1, 0), h / 2 - 0.123471


def onto_sphere(x):
    """Places near the two spheres on them."""
    r = np.linalg.norm(x, axis=1)
    return x * (np.where(r < 1.02, 1.0, np.where(r > 1.96, 2.0, r)) / r)[:, None]


def round_edges(mesh):
    """Ten nodes with mid-edge vertices as far from the centre as the ends of their edges are in the mean."""
    nodes = mesh.quadratic()
    x, (middle, i, j) = np.array(nodes.vertices), nodes.middles.T
    radius = np.linalg.norm(x, axis=1)
    x[middle] *= ((radius[i] + radius[j]) / 2 / radius[middle])[:, None]
    faces = {name: nodes.surface_triangles[rows] for name, rows in nodes.surface_sets.items()}
    return ds.TetrahedralMesh(x, nodes.elements, vertex_sets=dict(nodes.vertex_sets), surface_sets=faces)


def thick_sphere(n, order):
    """How far the inside of an eighth of a sphere, radii 1 and 2 m, goes out under pressure (Lame). The finer mesh of linear
    tetrahedra has curved edges, so that the estimate knows of the sphere."""
    parts, a, b, E, nu, p = [], 1.0, 2.0, 1e6, 0.3, 10.0
    for k in range(3):
        box = ds.TetrahedralMesh.create_box((n + 1, n + 1, n + 1))
        s, t, r = box.vertices.T
        way = np.roll(np.stack([np.ones_like(s), np.tan(np.pi / 4 * s), np.tan(np.pi / 4 * t)], 1), k, 1)
        x = (a + (b - a) * r)[:, None] * way / np.linalg.norm(way, axis=1)[:, None]
        x[np.abs(x) < 1e-12] = 0.0
        parts.append(ds.TetrahedralMesh(x, box.tetrahedra, fix_orientation=True))
    mesh = ds.TetrahedralMesh.joined(parts).merged()
    for axis, name in enumerate("xyz"):
        mesh = mesh.with_vertex_set(f"{name}min", mesh.vertices[:, axis] == 0)
    inside = np.linalg.norm(mesh.vertices[mesh.surface_triangles], axis=2).max(1) < a + 1e-9
    mesh = mesh.with_surface_set("inside", inside)
    exact = p * a**3 / (E * (b**3 - a**3)) * ((1 - 2 * nu) * a + (1 + nu) * b**3 / (2 * a**2))
    options = dict(terms=ds.Pressure(p, "inside"), fixed={f"{x}min": x for x in "xyz"}, finer=round_edges)
    if order == 2:
        mesh, options["finer"] = round_edges(mesh), lambda mesh: mesh.refined(onto=onto_sphere)
    point = ds.MaterialPoints([[a, 0.0, 0.0]], name="inside")
    return *statics(mesh, ds.LinearElastic(E, nu), point, order, **options), (1, 0, 0), a + exact


def plate_deflection(a=10.0, h=1.0, q=1e4, E=1e9, nu=0.3, terms=15):
    """At the middle of a square plate whose sides do not move along themselves, under q on its top: Fourier series whose
    terms are exact in the thickness (Srinivas, Rao 1970, doi:10.1016/0020-7683(70)90076-4)."""
    lam, mu, out = E * nu / (1 + nu) / (1 - 2 * nu), E / 2 / (1 + nu), 0.0
    for m in range(1, 2 * terms, 2):
        for n in range(1, 2 * terms, 2):
            x, y = m * np.pi / a, n * np.pi / a
            c, k = lam + 2 * mu, lam / (lam + 2 * mu)
            f = c - lam * k  # of y' = A y for (u, v, w, sxz, syz, szz), u ~ cos sin, v ~ sin cos, w ~ sin sin
            A = np.zeros((6, 6))
            A[0, [2, 3]], A[1, [2, 4]], A[2, [0, 1, 5]] = (-x, 1 / mu), (-y, 1 / mu), (k * x, k * y, 1 / c)
            A[3, [0, 1, 5]] = f * x * x + mu * y * y, (lam - lam * k + mu) * x * y, -k * x
            A[4, [0, 1, 5]] = (lam - lam * k + mu) * x * y, f * y * y + mu * x * x, -k * y
            A[5, [3, 4]] = x, y
            half, whole = expm(A * h / 2), expm(A * h)
            load = 16 * q / (np.pi**2 * m * n)
            bottom = np.linalg.solve(whole[3:, :3], [0, 0, -load])
            out += (half[:3, :3] @ bottom)[2] * np.sin(m * np.pi / 2) * np.sin(n * np.pi / 2)
    return out


def thick_plate(n, order):
    """Deflection of a plate of 10 x 10 x 1 m in its middle, sides held along themselves, under pressure on its top."""
    mesh = ds.TetrahedralMesh.create_box((2 * n + 1, 2 * n + 1, 3), (10.0, 10.0, 1.0), "five")
    held = {"xmin": "yz", "xmax": "yz", "ymin": "xz", "ymax": "xz"}
    middle = ds.MaterialPoints([[5.0, 5.0, 0.5]], name="middle")
    options = dict(terms=ds.Traction((0, 0, -1e4), "zmax"), fixed=held)
    return *statics(mesh, ds.LinearElastic(1e9, 0.3), middle, order, **options), (0, 0, 1), 0.5 + plate_deflection()


class ModeShare(ds.MaterialPoints):
    """The share of the Lame mode in a motion, over that at the start, weighed by mass."""

    def __init__(self):
        super().__init__(np.zeros((1, 3)), name="share")

    def settled(self, scene):
        out, mode = ModeShare(), lame_mode(scene.mesh.vertices)
        weights = (scene.mass_matrix() @ mode.ravel()).reshape(-1, 3)
        out.weights = weights / (weights * (scene.inputs.values["initial_positions"] - scene.mesh.vertices)).sum()
        return out

    def shape(self, num_frames):
        return (num_frames,)

    def value(self, frames):
        return np.tensordot(frames.displacements, self.weights, 2)

    def vjp(self, frames, seed):
        return ds.outputs.Change(positions=seed[:, None, None] * self.weights)


def lame(n, order, kind=ds.BDF2Solver, periods=0.2, steps=24, **options):
    """Share of the Lame mode of a free cube after some periods, which is cos(2 pi periods). After a half, a small error of
    the frequency has no effect to first order."""
    scene = lame_scene(0.3, n, "kuhn", "f64", order)
    solver = kind(scene, dt=2 * np.pi * periods / lame_omega(0.3) / steps, **options)
    return ds.Rollout(solver, steps, outputs=ModeShare()), None, None, np.cos(2 * np.pi * periods)


PROBLEMS = {  # name: (problem, sizes of linear meshes, of ten nodes)
    "hanging bar": (hanging_bar, (1, 2, 3), (1, 2, 3)),
    "uniaxial": (uniaxial, (1, 2, 3), (1, 2, 3)),
    "beam": (beam, (1, 2, 3), (1, 2, 3)),
    "cook": (cook, (3, 5, 8), (2, 3, 4)),
    "elastica": (elastica, (8, 12, 20), (1, 2, 3)),
    "thick sphere": (thick_sphere, (2, 3, 4), (2, 3, 4)),
    "thick plate": (thick_plate, (3, 4, 5), (1, 2, 3)),
    "stretched bar": (stretched_bar, (2, 3, 5), ()),
    "lame": (partial(lame, tolerance=1e-8), (3, 4, 6), (1, 2, 3)),
    "lame, half a period": (partial(lame, periods=0.5, tolerance=1e-8), (3, 4, 6), (1, 2)),
    "lame, midpoint": (partial(lame, kind=ds.ImplicitMidpointSolver, tolerance=1e-8), (3, 4, 6), (1, 2)),
    "lame, backward Euler": (partial(lame, kind=ds.ImplicitEulerSolver, tolerance=1e-8), (3, 4, 6), (1, 2)),
    "lame, explicit": (partial(lame, kind=ds.VelocityVerletSolver), (3, 4, 6), (1, 2)),
}


def measured(name: str, order: int, size: int) -> tuple:
    """(what accuracy found, true error of the value)"""
    rollout, finer, weights, exact = PROBLEMS[name][0](size, order)
    found = rollout.accuracy(next(iter(rollout.computed)), weights, finer=finer)
    return found, found.value - exact


def l_body(n, order):
    """Where the foot of an L of 2 x 2 x 0.5 m goes that is held on its top and sheared at the foot, large strains: -0.380 m
    (ds.refine and uniform refinement, extrapolated)."""
    box = ds.TetrahedralMesh.create_box((2 * n + 1, 2 * n + 1, 2), (2, 2, 0.5))
    kept = box.tetrahedra[(box.centroids[:, :2] < 1).any(1)]
    used, corners = np.unique(kept, return_inverse=True)
    mesh = ds.TetrahedralMesh(box.vertices[used], corners.reshape(-1, 4))
    mesh = mesh.with_vertex_set("top", mesh.vertices[:, 1] == 2)
    mesh = mesh.with_surface_set("side", lambda x, normal: (normal[:, 0] > 0.5) & (x[:, 0] > 1.9))
    options = dict(terms=ds.Traction((0, -1e4, 0), "side"), fixed="top")
    foot = ds.MaterialPoints([[2.0, 0.0, 0.25]], name="foot")
    return *statics(mesh, ds.StableNeoHookean(1e6, 0.3), foot, order, **options), (0, 1, 0), -0.380


def refine() -> None:
    """Unknowns until the estimate, and the error itself of uniform meshes, is below a tolerance."""
    for problem, order, tolerance in ((cook, 1, 0.01), (cook, 2, 0.01), (l_body, 2, 0.005)):
        rollout, _, weights, exact = problem(2, order)
        begin = time.perf_counter()
        print(f"{problem.__name__}, {(4, 10)[order - 1]} nodes, to {tolerance:g}:")
        print(ds.refine(rollout, next(iter(rollout.computed)), tolerance, weights))
        print(f"  in {time.perf_counter() - begin:.0f} s; uniformly:")
        for _ in range(5):
            frames = rollout.forward()
            y = (frames[next(iter(rollout.computed))] * weights).sum((1, 2))
            error = abs(y[-1] - exact) / abs(exact - y[0])
            print(f"{3 * rollout.scene.mesh.num_vertices:>9} unknowns: {y[-1]:.7g}, error {error:.2g}", flush=True)
            if error < tolerance:
                break
            rollout = rollout_on_finer(rollout, ds.TetrahedralMesh.refined)


def main(names) -> None:
    print("| problem | nodes | mesh | value | estimate | bar | true error | effectivity | doubts | s |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for name in names or PROBLEMS:
        for order in (1, 2):
            for size in PROBLEMS[name][order]:
                begin = time.perf_counter()
                found, true = measured(name, order, size)
                cells = [name, {1: 4, 2: 10}[order], size, f"{found.value:.7g}", f"{abs(found.error):.3g}"]
                cells += [
                    f"{found.bar:.3g}",
                    f"{true:.3g}",
                    f"{found.error / true:.2f}",
                    ", ".join(found.doubts),
                    f"{time.perf_counter() - begin:.1f}",
                ]
                print("|", " | ".join(map(str, cells)), "|", flush=True)


if __name__ == "__main__":
    refine() if sys.argv[1:] == ["refine"] else main(sys.argv[1:])
