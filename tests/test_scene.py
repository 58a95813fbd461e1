"""Scenes: what is refused and how it is said, scaling, heterogeneity, fixed vertices, determinism (TORTURE 7-10, 13, 62)."""

# ruff: noqa: E501 - a table reads best with a case a line

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import diffsim_ti as ds
from diffsim_ti.materials import MATERIALS
from diffsim_ti.solvers import SOLVERS as ALL_SOLVERS

SOLVERS = [s for s in ALL_SOLVERS if s.explicit]  # the implicit ones: test_implicit*.py
ROOT = Path(__file__).parents[1]
E, RHO = 1e5, 1000.0
MESH = ds.TetrahedralMesh.create_box(3, pattern="five")
N, M = MESH.num_vertices, MESH.num_tetrahedra
SOFT = ds.StableNeoHookean(E, 0.3)
solvers = pytest.mark.parametrize("solver", SOLVERS)


def scene(**options):
    return ds.Scene(**dict(mesh=MESH, material=SOFT, density=RHO) | options)


def masses(of):
    return of.inputs.derive(of.inputs.values).mass


def rollout(steps=10, solver=ds.SemiImplicitSolver, options=None, **scene_options):
    return ds.Rollout(solver(scene(**scene_options), dt=1e-3), steps, **options or {})


# ---- what is refused: rule, value, remedy -------------------------------------------------------------------------------


def spoiled(shape, value=np.nan):
    out = np.ones(shape)
    out.flat[1] = value
    return out


REFUSED = {
    # material
    "E zero": (lambda: ds.StableNeoHookean(0.0, 0.3), r"youngs_modulus must be > 0, got 0: a stiffness \[Pa\]"),
    "E negative": (lambda: ds.StableNeoHookean(-1.0, 0.3), "youngs_modulus must be > 0, got -1"),
    "nu half": (lambda: ds.StableNeoHookean(E, 0.5), r"poissons_ratio must lie in \(-1, 0.5\), got 0.5: .*take 0.45"),
    "nu minus one": (lambda: ds.StableNeoHookean(E, -1.0), r"poissons_ratio must lie in \(-1, 0.5\), got -1"),
    "E nan": (lambda: ds.StableNeoHookean(np.nan, 0.3), "youngs_modulus must be finite, got nan"),
    "E of the wrong length": (
        lambda: scene(material=ds.StableNeoHookean(np.full(M + 1, E), 0.3)),
        f"youngs_modulus.*{M}.*{M + 1}",
    ),
    "E in one tetrahedron": (
        lambda: scene(material=ds.StableNeoHookean(spoiled(M, -2.0), 0.3)),
        "got -2 in tetrahedron 1",
    ),
    # density
    "density zero": (lambda: scene(density=0.0), r"density must be > 0 \[kg/m\^3\], got 0"),
    "density negative in one": (lambda: scene(density=spoiled(M, -3.0)), r"density must be > 0 .*got -3"),
    "density nan": (lambda: scene(density=np.nan), "density must be finite: 1 of 1 values"),
    "density of the wrong length": (
        lambda: scene(density=np.ones(M - 1)),
        rf"density: expected one number or shape \({M},\), got \({M - 1},\)",
    ),
    # start
    "positions' shape": (
        lambda: scene(initial_positions=np.zeros((N + 1, 3))),
        rf"initial_positions: expected shape \({N}, 3\), got \({N + 1}, 3\)",
    ),
    "positions nan": (
        lambda: scene(initial_positions=spoiled((N, 3))),
        f"initial_positions must be finite: 1 of {3 * N}",
    ),
    "velocities inf": (lambda: scene(initial_velocities=spoiled((N, 3), np.inf)), "initial_velocities must be finite"),
    "velocities' shape": (
        lambda: scene(initial_velocities=np.zeros((2, 3))),
        rf"initial_velocities.*\({N}, ?3\)|broadcast",
    ),
    "precision": (lambda: scene(precision="f16"), "precision must be 'f32' or 'f64', got 'f16'"),
    # terms
    "not a term": (lambda: scene(terms=[9.81]), r"terms must be diffsim_ti terms such as Gravity\(\), got 9.81"),
    "two gravities": (
        lambda: scene(terms=[ds.Gravity(), ds.Gravity()]),
        "a scene takes one Gravity, got several; add their numbers",
    ),
    "two drags": (lambda: scene(terms=[ds.Drag(1), ds.Drag(2)]), "a scene takes one Drag"),
    "two self-contacts": (lambda: scene(terms=[ds.SelfContact()] * 2), "a scene takes one SelfContact"),
    "gravity's shape": (
        lambda: ds.Gravity([1, 2]),
        r"acceleration must be a number \(along up\) or 3 numbers, got shape \(2,\)",
    ),
    "gravity nan": (lambda: ds.Gravity(np.nan), "Gravity: gravity must be finite"),
    "drag negative": (lambda: ds.Drag(-1.0), r"Drag: rate must be one number >= 0 \[1/s\], got -1"),
    "drag per vertex": (lambda: ds.Drag([1.0, 2.0]), "Drag: rate must be one number"),
    "ground kappa": (lambda: ds.Ground(stiffness=0.0), r"Ground: stiffness \[N/m\] must be > 0, got 0"),
    "ground kappa negative": (lambda: ds.Ground(stiffness=-1.0), r"Ground: stiffness \[N/m\] must be > 0, got -1"),
    "ground per area": (
        lambda: ds.Ground(stiffness_per_area=0.0),
        r"Ground: stiffness_per_area \[N/m\^3\] must be > 0, got 0",
    ),
    "ground twice": (
        lambda: ds.Ground(stiffness=1e4, stiffness_per_area=1e6),
        r"stiffness \[N/m\] of each vertex and stiffness_per_area \[N/m\^3\] exclude each other, got 10000.0 and 1000000.0",
    ),
    "ground width": (lambda: ds.Ground(width=0.0), r"Ground: width \[m\] must be > 0, got 0"),
    "ground nan": (lambda: ds.Ground(height=np.nan), "Ground: ground_height must be finite"),
    "starts below the ground": (
        lambda: scene(terms=[ds.Ground(height=0.25, stiffness=1e4)]),
        r"vertex \d+ is at -0.25 m above y = 0.25 \(9 vertices\); lift the body",
    ),
    "starts on the ground": (
        lambda: scene(terms=[ds.Ground(height=0.0, stiffness=1e4)]),
        r"starts below or on the ground: vertex \d+ is at 0 m",
    ),
    "moved below the ground": (
        lambda: scene(terms=[ds.Ground(height=-0.5, stiffness=1e4)], initial_positions=MESH.vertices - [0, 1, 0]),
        "at -0.5 m above y = -0.5",
    ),
    "forces' shape": (
        lambda: ds.ExternalForce(np.zeros((2, 2))),
        r"forces must have shape \(3,\), \(k, 3\) or \(steps, k, 3\), got \(2, 2\)",
    ),
    "forces' count": (
        lambda: scene(terms=[ds.ExternalForce(np.zeros((4, 3)), [0, 1])]),
        r"expected forces for 2 vertices, shape \(..., 2, 3\), got \(4, 3\)",
    ),
    "forces' set": (
        lambda: scene(terms=[ds.ExternalForce([0, 0, 1], "top")]),
        "no vertex set is called 'top'; there are: xmin",
    ),
    # fixed vertices and their motion
    "fixed name": (lambda: scene(fixed="bottom"), "no vertex set is called 'bottom'; there are: xmin, xmax"),
    "fixed index": (lambda: scene(fixed=[0, N]), f"indices must lie in 0..{N - 1}, got {N}"),
    "fixed negative": (lambda: scene(fixed=[-1]), f"indices must lie in 0..{N - 1}, got -1"),
    "fixed mask": (lambda: scene(fixed=np.zeros(N - 1, bool)), rf"a mask must have shape \({N},\), got \({N - 1},\)"),
    "fixed floats": (lambda: scene(fixed=[0.0, 1.0]), "indices must be integers, got dtype float64"),
    "motion of none": (
        lambda: scene(motion=lambda t: [0, 0, 0]),
        "motion moves the fixed vertices, but none is fixed; pass fixed=",
    ),
    "motion nan": (
        lambda: scene(fixed="xmin", motion=lambda t: [np.nan, 0, 0]),
        "motion: displacements must be finite",
    ),
    "keyframes": (
        lambda: scene(fixed="xmin", motion=([0, 1, 1], np.zeros((3, 3)))),
        "motion: keyframe times must increase",
    ),
    # rollouts
    "steps negative": (lambda: rollout(-1), r"steps must be a whole number >= 0, got -1"),
    "steps broken": (lambda: rollout(1.5), r"steps must be a whole number >= 0, got 1.5"),
    "save_every": (lambda: rollout(options=dict(save_every=3)), "save_every = 3 must be >= 1 and divide steps = 10"),
    "save_every zero": (lambda: rollout(options=dict(save_every=0)), "save_every = 0 must be >= 1"),
    "gradients": (
        lambda: rollout(options=dict(gradients=["stiffness"])),
        "no input named 'stiffness'; this rollout has initial_positions, .*youngs_modulus",
    ),
    "memory": (
        lambda: rollout(options=dict(memory=1e-6)),
        r"memory = 1e-06 MB is too little to differentiate at all: .* MB is the least",
    ),
    "unknown value": (lambda: rollout().forward(stiffness=1.0), "no input named 'stiffness'; this rollout has"),
    "value's shape": (
        lambda: rollout().forward(initial_positions=np.zeros((3, 3))),
        r"initial_positions: expected shape",
    ),
    "value's range": (lambda: rollout().forward(youngs_modulus=-1.0), "youngs_modulus must be > 0, got -1"),
    "value's nan": (lambda: rollout().forward(density=np.nan), "density must be finite"),
    "inside out": (
        lambda: rollout().forward(rest_positions=-MESH.vertices),
        r"rest_positions turn tetrahedron \d+ inside out .*take a smaller step",
    ),
    "too few forces": (
        lambda: rollout(terms=[ds.ExternalForce(np.zeros((9, N, 3)))]).forward(),
        "external_forces: 10 steps need as many rows, got 9",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused(case):
    build, message = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        build()


@pytest.mark.parametrize(
    "build",
    [
        lambda: scene(initial_velocities=[1.0, 2.0, 3.0]),
        lambda: scene(terms=ds.Gravity()),
        lambda: scene(density=np.full(M, 2.0)),
        lambda: scene(terms=[ds.Ground(stiffness=1e4, height=-0.005)]),  # within the barrier's width: allowed
        lambda: scene(
            terms=[ds.Ground(stiffness=1e4, height=-1.0), ds.Ground(stiffness=1e4, height=-2.0)]
        ),  # contacts may be several
        lambda: scene(fixed=[]),
        lambda: scene(fixed="xmin", motion=lambda t: np.zeros((9, 3))),
        lambda: scene(material=ds.StableNeoHookean(np.linspace(1e4, 1e5, 2 * M)[::2], 0.3)),  # not contiguous
    ],
)
def test_accepted(build):
    ds.Simulator(ds.SemiImplicitSolver(build(), dt=1e-4)).run(2)


# ---- what is simulated --------------------------------------------------------------------------------------------------


def test_mass_is_density_times_volume():
    density = np.random.default_rng(0).uniform(1, 10, M)
    assert masses(scene()).sum() == pytest.approx(RHO, rel=1e-14)  # a cube of 1 m^3
    assert masses(scene(density=density)).sum() == pytest.approx((density * MESH.volumes).sum(), rel=1e-14)
    expected = np.zeros(N)
    for corners, m in zip(MESH.tetrahedra, density * MESH.volumes):
        expected[corners] += m / 4
    assert masses(scene(density=density)) == pytest.approx(expected, rel=1e-14)


def test_density_moves_as_it_should():
    """A tetrahedron of its own density: two pieces in one mesh accelerate by force / mass each."""
    X = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    mesh = ds.TetrahedralMesh(np.vstack([X, X + 5]), [[0, 1, 2, 3], [4, 5, 6, 7]])
    of = ds.Scene(mesh, SOFT, np.array([10.0, 1000.0]), terms=[ds.ExternalForce([0, 0, 1.0])])
    frames = ds.Rollout(ds.SemiImplicitSolver(of, dt=1e-3), 10).forward()
    assert frames.velocities[-1, :, 2] == pytest.approx(1e-2 / (np.repeat([10.0, 1000.0], 4) / 24), rel=1e-12)


def test_fixed_in_every_spelling():
    by_name = scene(fixed="xmin").fixed
    mask = np.zeros(N, bool)
    mask[MESH.vertex_sets["xmin"]] = True
    assert len(by_name) == 9
    for spelling in (mask, list(by_name), by_name[::-1], ["xmin"], np.flatnonzero(mask).astype(np.int32)):
        assert np.array_equal(scene(fixed=spelling).fixed, by_name)
    assert len(scene(fixed=["xmin", "xmax"]).fixed) == 18
    assert len(scene().fixed) == 0


@solvers
def test_all_pinned_is_constant(solver):
    """TORTURE 13, and long enough for the watch over the step to look."""
    of = scene(fixed=range(N), terms=[ds.Gravity()], initial_positions=1.1 * MESH.vertices)
    frames = ds.Rollout(solver(of, dt=1e-3), 1000).forward()
    assert np.array_equal(frames.positions[0], frames.positions[-1]) and not frames.velocities.any()


def test_unused_vertex_stays():
    with pytest.warns(UserWarning, match="1 vertex in no tetrahedron"):
        mesh = ds.TetrahedralMesh(np.vstack([MESH.vertices, [9, 9, 9]]), MESH.tetrahedra)
    for solver in SOLVERS:
        frames = ds.Rollout(solver(ds.Scene(mesh, SOFT, RHO, terms=[ds.Gravity()]), dt=1e-3), 100).forward()
        assert np.array_equal(frames.positions[-1, -1], [9, 9, 9]) and np.isfinite(frames.positions).all()


def test_replace_changes_only_what_it_names():
    first = scene(terms=[ds.Gravity()], fixed="xmin", initial_velocities=[1.0, 0, 0])
    second = first.replace(density=2 * RHO, terms=[])
    assert second.fixed is not None and np.array_equal(first.fixed, second.fixed)
    assert masses(second).sum() == pytest.approx(2 * masses(first).sum())
    assert second.terms == () and len(first.terms) == 1
    assert np.array_equal(first.inputs.values["initial_velocities"], second.inputs.values["initial_velocities"])
    assert scene(precision="f32").replace(density=1.0).precision == "f32"
    with pytest.raises(TypeError):
        first.replace(colour="red")


def test_describe():
    of = scene(terms=[ds.Gravity(), ds.Drag(0.5)], fixed="xmin", motion=lambda t: [0, 0, 0], precision="f64")
    text = of.describe()
    for part in (
        repr(MESH),
        repr(SOFT),
        "mass 1000 kg, precision f64",
        "Gravity(gravity=[ 0.  , -9.81,  0.  ])",
        "Drag(drag_rate=0.5)",
        "fixed vertices: 9, moving",
        "inputs: initial_positions [m], initial_velocities [m/s], youngs_modulus [Pa], poissons_ratio [-], density [kg/m^3], "
        "gravity [m/s^2], drag_rate [1/s], rest_positions [m], prescribed_motion [m]",
    ):
        assert part in text, text
    assert "terms: none" in scene().describe() and "fixed vertices: 0" in scene().describe()
    simulator = ds.Simulator(ds.VelocityVerletSolver(of, dt=1e-3, substeps=2))
    for part in (
        text,
        "VelocityVerletSolver: dt 0.001 s, 2 substeps of 0.0005 s",
        "built: StableNeoHookeanLaw (f64",
        "one set of moduli",
        "terms Gravity, Drag, prescribed motion",
        "MB on the device",
    ):
        assert part in simulator.describe(), simulator.describe()
    varied = scene(material=ds.StableNeoHookean(np.linspace(1e4, 1e5, M), 0.3))
    assert "moduli per tetrahedron" in ds.Simulator(ds.SemiImplicitSolver(varied, dt=1e-3)).describe()


def test_inputs_are_named_after_the_scene():
    of = scene(terms=[ds.Gravity(), ds.Ground(stiffness=1e4, height=-1), ds.Ground(stiffness=1e4, height=-2)])
    assert of.inputs.names[:5] == (
        "initial_positions",
        "initial_velocities",
        "youngs_modulus",
        "poissons_ratio",
        "density",
    )
    assert {"gravity", "ground_height", "ground_height_2", "rest_positions"} <= set(of.inputs.names)


def test_user_s_arrays_are_not_kept():
    """Changing an array after it was handed over changes nothing."""
    positions, density = np.array(MESH.vertices), np.full(M, RHO)
    of = scene(initial_positions=positions, density=density)
    before = ds.Rollout(ds.SemiImplicitSolver(of, dt=1e-3), 5).forward().positions
    positions += 1
    density *= 3
    assert np.array_equal(ds.Rollout(ds.SemiImplicitSolver(of, dt=1e-3), 5).forward().positions, before)
    assert masses(of).sum() == pytest.approx(RHO)


# ---- scales -------------------------------------------------------------------------------------------------------------


@solvers
@pytest.mark.parametrize("size", [1e-3, 1e3])
def test_scaling(solver, size):
    """TORTURE 7: lengths by `size`, times kept: E, g and the ground go along, x / L stays."""

    def final(L):
        of = ds.Scene(
            MESH.scaled(L),
            ds.StableNeoHookean(E * L**2, 0.3),
            RHO,
            fixed="ymax",
            initial_velocities=np.array([0.5, 0, 0.2]) * L,
            terms=[ds.Gravity(-9.81 * L), ds.Drag(0.1), ds.Ground(-0.05 * L, stiffness=1e6 * L**3, width=0.1 * L)],
        )
        frames = ds.Rollout(solver(of, dt=1e-3), 300, save_every=100).forward()
        return frames.positions / L, frames.velocities / L

    for scaled, plain in zip(final(size), final(1.0)):
        # 300 steps at omega dt ~ 0.1 carry round-off some thousandfold
        assert np.abs(scaled - plain).max() <= 1e-10 * np.abs(plain).max()


@pytest.mark.parametrize("material", MATERIALS)
def test_series_bar_of_moduli_over_six_decades(material):
    """TORTURE 21: layers stretched so that all carry one stress are in balance (nu = 0, so that sides stay)."""
    cells = 7
    mesh = ds.TetrahedralMesh.create_box((cells + 1, 2, 2), (cells, 1, 1), "five")
    layer = np.floor(mesh.centroids[:, 0]).astype(int)
    decades = 10.0 ** np.array([0, 3, -1, 5, 2, 6, 4])
    stress = 1e-4  # strains from 1e-4 to 1e-10 of it
    strain = stress / decades
    ends = np.concatenate([[0], np.cumsum(1 + strain)])
    x = mesh.vertices.copy()
    x[:, 0] = ends[np.round(x[:, 0]).astype(int)]
    of = ds.Scene(mesh, material(decades[layer], 0.0), 1e9, initial_positions=x)
    solver = ds.SemiImplicitSolver(of, dt=1e-2, allow_unstable=True)
    simulator = ds.Simulator(solver)
    simulator.step()
    force = masses(of)[:, None] * simulator.velocities / 1e-2
    inner = (mesh.vertices[:, 0] > 0.5) & (mesh.vertices[:, 0] < cells - 0.5)
    end = force[mesh.vertices[:, 0] > cells - 0.5, 0].sum()
    assert end == pytest.approx(-stress, rel=1e-3)  # nonlinear laws: by their strain of 1e-4
    if material is ds.LinearElastic:
        # positions near 7 round by 4e-16, which the stiffest layer turns into 1e6 * 4e-16 of force: 4e-6 of the stress
        assert np.abs(force[inner]).max() <= 1e-5 * stress
        u = simulator.displacements[mesh.vertices[:, 0] > cells - 0.5, 0]
        assert u == pytest.approx(np.full(4, (stress / decades).sum()), rel=1e-9)  # springs in series


# ---- the same bits ------------------------------------------------------------------------------------------------------


@solvers
@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_two_runs_give_the_same_bits(solver, precision):
    def run(parallel):
        of = scene(
            terms=[ds.Gravity(), ds.Ground(-0.1, stiffness=1e6, width=0.1)],
            precision=precision,
            initial_velocities=[0.3, -1.0, 0.1],
        )
        return ds.Rollout(solver(of, dt=1e-3, parallel=parallel), 200, save_every=50).forward()

    serial, again, parallel = run(False), run(False), run(True)
    assert np.array_equal(serial.positions, again.positions) and np.array_equal(serial.velocities, again.velocities)
    assert np.array_equal(serial.positions, parallel.positions) and np.array_equal(
        serial.velocities, parallel.velocities
    )


def test_rerun_of_a_rollout_gives_the_same_bits():
    run = rollout(50, terms=[ds.Gravity()], fixed="ymax", options=dict(save_every=10))
    first = run.forward()
    run.forward(youngs_modulus=2 * E)
    again = run.forward()
    assert np.array_equal(first.positions, again.positions) and np.array_equal(first.velocities, again.velocities)


THREADS = """
import hashlib, numpy as np, diffsim_ti as ds
for threads in (1, 2):
    ds.init("cpu", precision="f64", threads=threads)
    mesh, start = ds.TetrahedralMesh.create_box(6), dict(fixed="ymax", initial_velocities=[1.0, 0, 0.5])
    scene = ds.Scene(mesh, ds.StableNeoHookean(1e5, 0.3), terms=[ds.Gravity()], **start)
    rollout = ds.Rollout(ds.VelocityVerletSolver(scene, dt=1e-3, parallel=True), 100)
    frames = rollout.forward()
    gradients = rollout.vjp(frames, positions=frames.positions)
    print(hashlib.sha256(frames.positions.tobytes() + frames.velocities.tobytes()
                         + b"".join(gradients[k].tobytes() for k in sorted(gradients))).hexdigest())
"""


def test_threads_do_not_change_a_bit():
    """TORTURE 62: gather, not atomics, forwards and backwards."""
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": path}
    done = subprocess.run([sys.executable, "-c", THREADS], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    digests = done.stdout.split()[-2:]
    assert len(digests) == 2 and digests[0] == digests[1] and len(digests[0]) == len(hashlib.sha256().hexdigest())
