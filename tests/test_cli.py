"""The command line, its series and its pictures, by what they write and say."""

import re
import sys

import battery_of_falls
import meshio
import numpy as np
import pytest
import saved_series as series
from open_laws.relaxing import RelaxingRubber
from open_laws.viscous import ViscousRubber

import diffsim_ti
from diffsim_ti import picture
from diffsim_ti.cli import app as cli
from diffsim_ti.cli import options, selftest
from diffsim_ti.materials import StableNeoHookean
from diffsim_ti.mechanics.surfaces.surface_pairs import Overlap
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.monitor.quantities import Energy, TetrahedronFields
from diffsim_ti.rollout.simulator import Simulator
from diffsim_ti.scene import Scene
from diffsim_ti.solvers import BDF2Solver, ImplicitEulerSolver, SemiImplicitSolver, VelocityVerletSolver
from diffsim_ti.terms import Gravity, Ground, Sphere
from diffsim_ti.writers import adaptive_run as forward


def fails(capsys, *arguments) -> str:
    """The one line of an error, with exit code 2 and nothing on stdout."""
    with pytest.raises(SystemExit) as stop:
        cli.main([str(a) for a in arguments])
    said = capsys.readouterr()
    lines = [line for line in said.err.splitlines() if not line.startswith("warning:")]
    assert stop.value.code == 2 and said.out == "" and len(lines) == 1 and lines[0].startswith("error: "), said
    return lines[0]


def printed(capsys, *arguments) -> str:
    """By a command that does what it should."""
    try:
        with pytest.raises(SystemExit) as stop:
            cli.main([str(a) for a in arguments])
    finally:
        diffsim_ti.runtime.set_precision("f64")
    said = capsys.readouterr()
    assert stop.value.code == 0, said
    return said.out


@pytest.fixture(scope="module")
def cube():
    return TetrahedralMesh.create_cube(3, 0.2)


@pytest.fixture(scope="module")
def cube_file(cube, tmp_path_factory):
    path = tmp_path_factory.mktemp("mesh") / "cube.vtu"
    cube.save(path)
    return path


def falling(mesh, height=0.02, E=2e4, solver=SemiImplicitSolver, kind=forward.ForwardRun, dt=None, **how):
    body, law = mesh.translated([0, height, 0]), StableNeoHookean(E, 0.3)
    ground = options.make_ground(body, law, 1000.0, -9.81, np.sqrt(2 * 9.81 * height))
    return kind(Scene(body, law, 1000.0, [Gravity(), ground], **how), solver, 1 / 30, dt)


# ---- series -----------------------------------------------------------------------------------------------------------


def test_series_holds_what_the_simulator_has(cube, tmp_path):
    run = falling(cube)
    forward.run_and_write(run, 4, tmp_path, "body")
    frames = series.frames_of(tmp_path / "body.pvd")
    assert [t for t, _ in frames] == pytest.approx(np.arange(5) / 30)
    last, sim = meshio.read(frames[-1][1]), run.simulator
    assert np.array_equal(last.points, sim.positions.astype(np.float64))
    assert np.array_equal(last.cells_dict["tetra"], cube.tetrahedra)
    assert np.array_equal(last.point_data["displacement"], sim.displacements)
    assert np.array_equal(last.point_data["velocity"], sim.velocities)
    fields = sim.tetrahedron_fields()
    for name in ("von_mises", "energy_density", "J"):
        assert last.cell_data[name][0] == pytest.approx(getattr(fields, name), rel=1e-6)


def test_series_is_valid_after_each_frame_and_replaces_an_older_one(cube, tmp_path):
    rest, J = np.zeros((cube.num_vertices, 3)), np.ones(cube.num_tetrahedra)
    for count in (5, 2):
        out = series.Series(tmp_path, cube, "a")
        for k in range(count):
            out.write(0.1 * k, cube.vertices, rest, rest, TetrahedronFields(J, J, J))
            assert len(series.frames_of(out.path)) == k + 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.pvd", "a_0000.vtu", "a_0001.vtu"]


def test_series_names_a_broken_list(cube, tmp_path):
    (tmp_path / "a.pvd").write_text("<VTKFile><Coll")
    with pytest.raises(ValueError, match="not a ParaView series"):
        series.Series(tmp_path, cube, "a")


def test_interrupted_run_says_where_and_keeps_its_frames(cube, tmp_path, monkeypatch):
    run = falling(cube)
    advance = run.advance

    def advance_once():
        if run.simulator.step_count:
            raise KeyboardInterrupt
        advance()

    monkeypatch.setattr(run, "advance", advance_once)
    with pytest.raises(forward.Interrupted, match=r"interrupted at t = 0\.03333 s; 2 frames are in .*body\.pvd"):
        forward.run_and_write(run, 9, tmp_path, "body")
    assert all(path.exists() for _, path in series.frames_of(tmp_path / "body.pvd"))


# ---- the run whose step follows the state -----------------------------------------------------------------------------


@pytest.mark.parametrize("solver", [SemiImplicitSolver, VelocityVerletSolver])
def test_fall_keeps_energy_and_stays_above_the_floor(cube, solver):
    run = falling(cube, height=0.05, solver=solver)
    for _ in range(12):
        run.advance()
    assert run.simulator.time == pytest.approx(0.4)
    assert run.seen.crossed == 0 and 0 < run.seen.gap < 0.002 and 0 < run.seen.J < 1
    assert abs(run.energies[-1] - run.energies[0]) < 0.03 * run.largest_energy
    assert min(run.seen.substeps) < max(run.seen.substeps)  # contact asks for finer steps


class Careless(forward.ForwardRun):
    def _choose_substeps(self):
        return max(1, super()._choose_substeps() // 8)  # beyond the stable step


def test_an_unstable_part_is_run_again_more_finely_and_counted(cube):
    run = falling(cube, E=1e8, kind=Careless)
    for _ in range(6):
        run.advance()
    reference = falling(cube, E=1e8)
    for _ in range(6):
        reference.advance()
    assert len(run.seen.retries) > len(reference.seen.retries)
    assert run.simulator.time == reference.simulator.time
    heights = [r.simulator.positions[:, 1].mean() for r in (run, reference)]
    assert heights[0] == pytest.approx(heights[1], abs=2e-3)


def test_part_that_stays_unstable_is_an_error(cube):
    run = falling(cube, E=1e8, kind=Careless)
    run.attempts, run._advance_part_implicitly = 1, lambda why: False
    with pytest.raises(FloatingPointError, match="unstable even with a substep"):
        for _ in range(6):
            run.advance()


def test_where_explicit_steps_collapse_implicit_euler_goes_on(cube):
    """And that is said; the motion is that of a run whose steps hold, but for what implicit Euler damps."""
    run, reference = falling(cube, E=1e8, kind=Careless), falling(cube, E=1e8)
    run.attempts = 1
    for _ in range(3):
        run.advance()
        reference.advance()
    assert run.seen.implicit_parts > 0 and "of implicit Euler" in run.seen.retries[1]
    assert run.simulator.time == reference.simulator.time and run.seen.gap > 0
    heights = [r.simulator.positions[:, 1].mean() for r in (run, reference)]
    assert heights[0] == pytest.approx(heights[1], abs=2e-2)  # it damps the bounce


def test_a_part_by_implicit_euler_hands_on_what_a_law_remembers(cube):
    """Bit by bit, there and back, in float32: no position is rounded on the way."""
    body, law = cube.translated([0, 0.02, 0]), RelaxingRubber(mu=4e4, lam=6e4, g=2e4, tau=0.01)
    scene = Scene(body, law, 1000.0, [Gravity(), Ground(stiffness=1e3, width=0.01)], precision="f32")
    run = forward.ForwardRun(scene, VelocityVerletSolver, 1 / 30)
    run.advance()
    run.advance()
    sim, other = run.simulator, Simulator(ImplicitEulerSolver(scene, dt=run.simulator.solver.dt))
    assert np.abs(sim.law_state).max() > 0
    forward.hand_on(sim, other)
    for name in ("positions", "velocities", "law_state"):
        assert np.array_equal(getattr(other, name), getattr(sim, name)), name
    before = sim.law_state
    assert run._advance_part_implicitly("asked for") and not np.array_equal(sim.law_state, before)


def test_only_overlaps_let_implicit_parts_try_again(cube, monkeypatch):
    """A face that explicit steps brought into an obstacle; any other error is one."""
    run = falling(cube)

    def refuse(error):
        def hand_on(source, target):
            raise error

        monkeypatch.setattr(forward, "hand_on", hand_on)

    refuse(Overlap("a face is in the floor"))
    assert not run._advance_part_implicitly("asked for") and run.seen.implicit_parts == 0
    refuse(ValueError("something else"))
    with pytest.raises(ValueError, match="something else"):
        run._advance_part_implicitly("asked for")


@pytest.mark.parametrize("solver", [SemiImplicitSolver, VelocityVerletSolver])
def test_energy_that_only_ever_rises_is_refused_once_it_has_drifted(cube, solver, monkeypatch):
    """A passing error is let through part by part, but the parts together may not gain more than its size."""
    run = falling(cube, solver=solver)
    for _ in range(3):
        run.advance()
    (part, _, drift), scale = forward.ENERGY_RISE[run.simulator.solver.order], run._fastest
    before, gained = run.simulator.compute_energy(), 0.0
    for _ in range(200):
        gained += 0.4 * part * scale
        monkeypatch.setattr(run.simulator, "compute_energy", lambda: Energy(before.parts | dict(other=gained)))
        if run._complaint(look_up=False):
            break
        run._check()
    assert 0 < gained <= (drift + part) * scale
    assert "the energy rose by" in run._complaint(look_up=False)


def test_what_no_implicit_step_lowers_is_rounding_while_nothing_is_gained_on_the_whole(cube, monkeypatch):
    run = falling(cube, solver=BDF2Solver)
    run.advance()
    told, sim = run._energy, run.simulator
    monkeypatch.setattr(sim, "compute_energy", lambda: Energy(told.parts | dict(other=1.0)))
    begin = sim.step_count
    run._begun = told + 2.0  # of which half has gone
    run._advance_part(last=False)
    assert sim.step_count == begin + 1 and len(run.seen.retries) == 3
    assert "the energy rose by 1 J; shorter ones do not lower that" in run.seen.retries[-1]
    run._begun = told
    with pytest.raises(FloatingPointError, match="unstable even with a substep.*the energy rose by 1 J"):
        run._advance_part(last=False)


def test_a_law_that_implicit_solvers_do_not_know_ends_in_the_error(cube):
    scene = Scene(
        cube.translated([0, 0.02, 0]), ViscousRubber(2e4, 0.3, 10.0), 1000.0, [Gravity(), Ground(stiffness=1e3)]
    )
    run = Careless(scene, SemiImplicitSolver, 1 / 30)
    assert not run._advance_part_implicitly("asked for")


@pytest.mark.parametrize("solver", ["verlet", "bdf2"])
def test_a_fall_of_the_battery(solver):
    """One of those that `python tests/battery_of_falls.py` draws; and its judge notices what is wrong."""
    beam = next(path for path in battery_of_falls.ASSETS if path.stem == "beam")
    case = dict(mesh=str(beam), size=0.05, youngs_modulus=1e4, height=0.05, solver=solver)
    fallen = battery_of_falls.fall(case)
    assert battery_of_falls.judge(fallen) == "good", fallen
    for wrong in (dict(gap=-1e-6), dict(rise=0.02), dict(ended=False, said="so")):
        assert battery_of_falls.judge(fallen | wrong) != "good"


def test_the_summary_names_its_lines(cube, capsys):
    """Each line of `describe` under its own name; what stands in brackets is printed."""
    ball = Sphere((0, -1, 0), 1.0, width=0.01)
    scene = Scene(cube.translated([0, 0.02, 0]), StableNeoHookean(2e4, 0.3), 1000.0, [Gravity(), ball])
    run = forward.ForwardRun(scene, SemiImplicitSolver, 1 / 30)
    run.advance()
    run.seen.retries.append("t = 1 s: behind HalfSpace(half_space_point=[m])")
    options.print_summary(run, 0.0, 0.0, ["a[s].npz"])
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("solver ") and "SemiImplicitSolver: dt" in line for line in lines)
    assert any(line.startswith("inputs ") and "initial_velocities [m/s], youngs_modulus [Pa]" in line for line in lines)
    assert any(line.startswith("chosen from weight and speed ") and "N/m^3 of Sphere" in line for line in lines)
    assert any(line.startswith("solves ") and "none: explicit steps" in line for line in lines)
    assert any("half_space_point=[m])" in line for line in lines) and any("a[s].npz" in line for line in lines)


def test_given_dt_is_used_as_it_is(cube):
    run = falling(cube, dt=2e-4)
    run.advance()
    assert run.seen.shortest == run.seen.longest == pytest.approx(2e-4)
    assert run.simulator.time == pytest.approx(1 / 30, abs=2e-4)
    with pytest.raises(ValueError, match="exceeds the stable step"):
        falling(cube, dt=1 / 30)


# ---- commands ---------------------------------------------------------------------------------------------------------


def test_simulate_free_fall(cube_file, tmp_path, capsys):
    said = printed(
        capsys,
        "simulate",
        cube_file,
        "-o",
        tmp_path,
        "--duration",
        0.2,
        "--fps",
        20,
        "--height",
        1,
        "--precision",
        "f64",
        "--velocity",
        1,
        0,
        0,
        "--size",
        0.5,
    )
    frames = series.frames_of(tmp_path / "cube.pvd")
    assert len(frames) == 5
    last = meshio.read(frames[-1][1])
    fall = last.point_data["displacement"]
    assert np.ptp(last.points[:, 0]) == pytest.approx(0.5)
    assert fall[:, 1].mean() == pytest.approx(-0.5 * 9.81 * 0.04, rel=0.05) and fall[:, 0].mean() == pytest.approx(0.2)
    assert (tmp_path / "cube.png").read_bytes().startswith(b"\x89PNG")
    for word in ("f64, cpu", "0.2 s in 4 frames", "retries", "none crossed", "energy drift", "substeps/s", "ns per"):
        assert word in said, said


@pytest.mark.parametrize("solver", ["bdf2", pytest.param("verlet", marks=pytest.mark.thorough)])
def test_simulate_says_how_accurate_the_end_is(solver, cube_file, tmp_path, capsys):
    out = tmp_path / "end.npz"
    options = ["simulate", cube_file, "--duration", 0.02, "--fps", 50, "--fixed", "xmin", "-o", out, "--accuracy"]
    said = printed(capsys, *options, "--solver", solver)
    assert "center_of_mass: " in said and "  mesh +" in said and "rounding " in said
    assert (tmp_path / "cube_accuracy.png").exists() == (solver == "bdf2")  # explicit steps have no shares


def test_simulate_lasts_as_long_as_asked_where_frames_are_no_multiples_of_a_step(cube_file, tmp_path, capsys):
    out = tmp_path / "end.npz"
    options = ["--duration", 0.03, "--fps", 100, "--dt", 0.004, "--solver", "bdf2", "--fixed", "xmin", "-o", out]
    printed(capsys, "simulate", cube_file, *options)
    with np.load(out) as found:
        assert found["time"][-1] == pytest.approx(0.032)


def test_simulate_refuses_an_unstable_step_in_one_line(cube_file, tmp_path, capsys):
    run = ["simulate", str(cube_file), "-o", str(tmp_path), "--dt", "0.03"]
    assert "exceeds the stable step" in fails(capsys, *run)
    with pytest.raises(ValueError, match="exceeds the stable step"):
        cli.main(["--traceback", *run])


def test_errors_are_one_line(cube_file, tmp_path, capsys):
    run = ("simulate", cube_file, "-o", tmp_path)
    assert "nothing.msh" in fails(capsys, "info", tmp_path / "nothing.msh")
    assert "StableNeoHookean" in fails(capsys, *run, "--material", "Rubber")
    assert "poissons_ratio" in fails(capsys, *run, "--nu", "0.5")
    assert "cpu, cuda, vulkan" in fails(capsys, *run, "--backend", "abacus")
    assert "longer than a frame, 0.0333333 s" in fails(capsys, *run, "--dt", "0.1")
    assert "longer than a frame, 0.01 s" in fails(capsys, *run, "--dt", "0.03", "--duration", "0.01")
    assert "no floor, of which friction would be" in fails(capsys, *run, "--no-ground", "--ground-friction", "0.5")
    assert "name what is by --fixed" in fails(capsys, *run, "--arrows", "reaction")
    assert "precision" in fails(capsys, *run, "--precision", "f16")
    assert "--solver" in fails(capsys, *run, "--solver", "magic")
    assert "patches" in fails(capsys, *run, "--volume", "vertices")
    assert "duration" in fails(capsys, *run, "--duration", "0")
    assert "size" in fails(capsys, *run, "--size", "-1")
    assert "--colour" in fails(capsys, *run, "--colour")
    assert "conquer" in fails(capsys, "conquer")


def test_interrupt_exits_130(cube_file, capsys, monkeypatch):
    def stop(*_):
        raise forward.Interrupted("interrupted at t = 0.1 s")

    monkeypatch.setattr(options, "load_body", stop)
    with pytest.raises(SystemExit) as ended:
        cli.main(["info", str(cube_file)])
    assert ended.value.code == 130 and "interrupted at t = 0.1 s" in capsys.readouterr().err


def test_info(cube_file, cube, capsys):
    steps = []
    for size in ("0.2", "0.4"):
        with pytest.raises(SystemExit) as ended:
            cli.main(["info", str(cube_file), "--size", size, "-E", "2e5"])
        said = capsys.readouterr().out
        assert ended.value.code == 0 and f"{cube.num_tetrahedra} tetrahedra" in said and "xmin (9)" in said
        steps.append(float(said.split("at rest:")[1].split()[0]))
    assert steps[1] == pytest.approx(2 * steps[0], rel=1e-3)


def test_demo(tmp_path, capsys):
    said = printed(capsys, "demo", "--quick", "-o", tmp_path)
    assert sorted(p.name for p in tmp_path.glob("*.png")) == ["column_0.png", "column_1.png", "column_2.png"]
    gradient, difference = (float(part.split()[-2]) for part in said.strip().splitlines()[-1].split(";"))
    assert gradient == pytest.approx(difference, rel=1e-3)


def test_help_names_every_command(capsys):
    said = printed(capsys, "--help")
    assert all(name in said for name in ("simulate", "info", "demo"))


@pytest.mark.parametrize("up, axis", [("x", 0), ("y", 1), ("z", 2), ("-x", 0), ("-y", 1), ("-z", 2)])
def test_up_turns_the_body(tmp_path, up, axis):
    mesh = TetrahedralMesh.create_box(2, (1.0, 2.0, 3.0))
    mesh.save(tmp_path / "box.vtu")
    body = options.load_body(tmp_path / "box.vtu", up=options.Up(up))
    sign = -1 if up[0] == "-" else 1
    assert body.vertices[:, 1] == pytest.approx(sign * mesh.vertices[:, axis])
    assert body.volume == pytest.approx(6)


def test_fixed_by_set_or_side(cube):
    assert np.array_equal(options.fixed_vertices(cube, ["ymin"]), cube.vertex_sets["ymin"])
    bare = TetrahedralMesh(cube.vertices, cube.tetrahedra)
    both = options.fixed_vertices(bare, ["ymin", "xmax"])
    assert np.array_equal(both, np.union1d(cube.vertex_sets["ymin"], cube.vertex_sets["xmax"]))
    with pytest.raises(ValueError, match="middle"):
        options.fixed_vertices(bare, ["middle"])


# ---- pictures ---------------------------------------------------------------------------------------------------------

VIEW = dict(box=[[-0.2, -0.2, -0.2], [0.6, 0.6, 0.6]], size=(160, 120))


def body_pixels(image):
    """Where a picture without values shows the body, which is blue."""
    return image[..., 2] - image[..., 0] > 0.1


def test_body_is_where_it_should_be(cube):
    seen = body_pixels(picture.draw(cube, cube.vertices + 0.1, azimuth=0.0, elevation=0.0, **VIEW))
    row, column = (x.mean() for x in np.nonzero(seen))
    assert row == pytest.approx(60, abs=3) and column == pytest.approx(160 / 2, abs=3)
    assert np.ptp(np.nonzero(seen)[0]) == pytest.approx(np.ptp(np.nonzero(seen)[1]), abs=2)  # a cube looks square
    assert 0.01 < seen.mean() < 0.2 and not seen[:10].any()


def test_moved_body_moves_in_the_picture(cube):
    for shift, direction in (((0, 0.2, 0), (-1, 0)), ((0.2, 0, 0), (0, 1))):
        rows = []
        for offset in (np.zeros(3), np.array(shift)):
            seen = body_pixels(picture.draw(cube, cube.vertices + offset, azimuth=0.0, elevation=0.0, **VIEW))
            rows.append([x.mean() for x in np.nonzero(seen)])
        moved = np.subtract(rows[1], rows[0])
        assert np.dot(moved, direction) > 10 and np.linalg.norm(moved) == pytest.approx(np.dot(moved, direction), abs=1)


def test_nearer_triangles_hide_farther_ones(cube):
    two = TetrahedralMesh(
        np.vstack([cube.vertices, cube.vertices + [0, 0, -0.3]]),
        np.vstack([cube.tetrahedra, cube.tetrahedra + cube.num_vertices]),
    )
    value = np.repeat([0.0, 1.0], cube.num_vertices)
    view = VIEW | dict(azimuth=0.0, elevation=0.0)
    image = picture.draw(two, two.vertices, value, **view)
    alone = picture.draw(cube, cube.vertices, np.zeros(cube.num_vertices), **view)
    inside = body_pixels(picture.draw(cube, cube.vertices, **view))
    assert np.abs(image - alone)[inside].mean() < 0.02


def test_colours_span_the_limits(cube, tmp_path):
    y = cube.vertices[:, 1] / 0.2
    view = VIEW | dict(azimuth=0.0, elevation=0.0)
    image = picture.draw(cube, cube.vertices, y, **view)
    inside = body_pixels(picture.draw(cube, cube.vertices, **view))
    rows = np.nonzero(inside.sum(1) > 10)[0]
    top, bottom = image[rows[2]][inside[rows[2]]].mean(0), image[rows[-3]][inside[rows[-3]]].mean(0)
    assert (
        top[1] > top[2] + 0.3 and top[0] > 0.5 and bottom[2] > bottom[1] + 0.1
    )  # viridis: yellow at the top, violet below
    per_tetrahedron = picture.to_vertices(cube, np.full(cube.num_tetrahedra, 7.0))
    assert per_tetrahedron == pytest.approx(7)
    with pytest.raises(ValueError, match="per tetrahedron"):
        picture.draw(cube, cube.vertices, np.zeros(3), **view)


def test_floor_grid_and_shadow(cube):
    view = VIEW | dict(elevation=20.0)
    without, empty = (
        picture.draw(cube, cube.vertices + [0, h, 0], ground=g, **view) for h, g in ((0.1, None), (0.1, 0.0))
    )
    body = body_pixels(without)
    difference = np.abs(without - empty).max(-1)
    assert difference[~body].max() > 0.2  # the shadow
    assert difference[body].max() < 1e-12 or np.mean(difference[body] > 0.05) < 0.1  # the floor lies behind


def test_saved_picture(cube, tmp_path):
    from matplotlib.image import imread

    values = np.arange(cube.num_tetrahedra)
    picture.save_picture(
        tmp_path / "a.png", cube, cube.vertices, values, "stress [Pa]", 0.0, "t = 0 s", size=(320, 240)
    )
    image = imread(tmp_path / "a.png")
    assert image.shape[:2] == (240, 320) and image[..., :3].std() > 0.02
    with pytest.raises(ValueError, match="finite"):
        picture.draw(cube, np.full(cube.vertices.shape, np.nan))


def test_check_gradients_prints_the_table_for_a_mesh(cube_file, capsys):
    said = printed(capsys, "check-gradients", cube_file, "--steps", 5)
    rows = [line for line in said.splitlines() if line.endswith("right")]
    assert len(rows) == 11 and "WRONG" not in said, said


def test_order_makes_ten_nodes_of_four(tmp_path):
    path = tmp_path / "cube.vtu"
    TetrahedralMesh.create_cube(2).save(path)
    assert options.load_body(path).order == 1 and options.load_body(path, order=2).order == 2
    with pytest.raises(ValueError, match="--order must be 1 or 2, got 3"):
        options.load_body(path, order=3)


@pytest.mark.parametrize("option", ["--duration", "--fps"])
def test_endless_runs_are_refused(capsys, tmp_path, option):
    path = tmp_path / "cube.vtu"
    TetrahedralMesh.create_cube(2).save(path)
    assert f"{option} must be > 0 and finite" in fails(capsys, "simulate", path, option, "inf")


def test_inside_out_meshes_name_the_option(tmp_path):
    path = tmp_path / "turned.vtu"
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
    meshio.Mesh(points, [("tetra", [[0, 1, 2, 3], [2, 1, 3, 4]])]).write(path)
    with pytest.raises(ValueError, match="--fix-orientation") as error:
        options.load_body(path)
    assert "fix_orientation=True" not in str(error.value)


@pytest.mark.parametrize("content", [None, "<VTKFile type='UnstructuredGrid'"])
def test_broken_frames_of_a_series_are_named(capsys, tmp_path, content):
    entry = '<DataSet timestep="0" part="0" file="a_0000.vtu"/>'
    (tmp_path / "a.pvd").write_text(f'<VTKFile type="Collection"><Collection>{entry}</Collection></VTKFile>')
    if content:
        (tmp_path / "a_0000.vtu").write_text(content)
    said = fails(capsys, "render", tmp_path / "a.pvd", "-o", tmp_path / "a.png")
    assert "a_0000.vtu" in said and "cannot be read" in said


# ---- options in a file, what help says --------------------------------------------------------------------------------


def test_options_go_to_a_file_and_back_to_the_bit(tmp_path, cube_file, monkeypatch, capsys):
    def taken(*arguments) -> dict:
        """The options that `simulate` runs with."""
        seen = {}
        with monkeypatch.context() as patched:
            patched.setattr(options, "check_length", lambda *_: seen.update(sys._getframe(1).f_locals) or sys.exit(0))
            with pytest.raises(SystemExit):
                cli.main(["simulate", *map(str, arguments)])
        return {name: x for name, x in seen.items() if name not in ("begin", "context", "config")}

    typed = [cube_file, "--nu", 0.1 + 0.2, "-E", 1 / 3e-5, "--velocity", 0.1, 1e-300, -2, "--up", "-z", "--no-ground"]
    typed += ["--fixed", 'say "so" \\ #1', "--fixed", "ymin", "-o", "a.glb", "--order", 2]
    first, second = tmp_path / "made" / "run.toml", tmp_path / "again.toml"
    for source, path in ((typed, first), (["--config", first], second)):
        with pytest.raises(SystemExit) as stop:
            cli.main(["simulate", *map(str, source), "--write-config", str(path)])
        assert stop.value.code == 0 and str(path) in capsys.readouterr().out
    assert first.read_bytes() == second.read_bytes() and "# Poisson's ratio [-]" in first.read_text()
    assert taken(*typed) == taken("--config", first) and taken(*typed)["poissons_ratio"] == 0.1 + 0.2
    assert taken("--config", first, "--nu", 0.2, "--ground") == taken(*typed) | dict(poissons_ratio=0.2, ground=True)


def test_mistakes_in_a_file_of_options(tmp_path, cube_file, capsys):
    path = tmp_path / "run.toml"
    for text, words in (
        ("youngs_modulus = 1e4", "'youngs_modulus': did you mean 'youngs-modulus'? there are mesh, output, material, "),
        ("qqq = 1", "no option is called 'qqq': there are mesh, "),
        ("config = 'a'", "no option is called 'config'"),
        ("duration = 'long'", "Invalid value for '--duration'"),
        ("duration =", "--config .*: .*--write-config writes one to begin with"),
    ):
        path.write_text(text)
        assert re.search(words.replace("?", "."), fails(capsys, "simulate", cube_file, "--config", path))
    assert "no such file; --write-config" in fails(capsys, "simulate", "--config", tmp_path / "none.toml")
    path.write_text("fixed = 'ymin'\nduration = -1")
    assert "--duration must be > 0" in fails(capsys, "simulate", cube_file, "--config", path)


def test_help_says_units_exit_codes_and_the_version(capsys):
    for arguments, words in (
        (
            ["simulate", "--help"],
            ("simulated time [s]", "[kg/m^3]", "scale the longest side", "[m]", "[N/m^3]", "[1/s]"),
        ),
        (["--help"], ("Exit codes: 0 done; 1 check-gradients", "130 interrupted")),
        (["--version"], (f"diffsim_ti {diffsim_ti.__version__}, taichi 1.", "torch 2.")),
    ):
        with pytest.raises(SystemExit) as stop:
            cli.main(arguments)
        said = " ".join(capsys.readouterr().out.split())
        assert stop.value.code == 0 and all(word in said for word in words), said


# ---- selftest ---------------------------------------------------------------------------------------------------------


def test_selftest_tells_right_from_wrong(monkeypatch, capsys):
    """All of its scenes run from the wheel alone, by release.py; here three verdicts, without a clock."""

    def no_solver():
        raise OSError("no such library")

    first, *others = selftest.STORED
    beam = selftest._scenes()[first]
    scenes = {first: beam, others[0]: beam, others[1]: (no_solver, 1, "density")}
    assert {*selftest._scenes()} == {*selftest.STORED}
    monkeypatch.setattr(selftest, "_scenes", lambda: scenes)
    monkeypatch.setattr(selftest, "_speed", lambda: (1.0, 100.0))
    with pytest.raises(SystemExit) as stop:
        cli.main(["selftest"])
    said = capsys.readouterr().out
    verdicts = re.findall(r"(?<=  )(right|WRONG|SLOW|as it should be)$", said, re.MULTILINE)
    assert stop.value.code == 1 and verdicts == ["right", "WRONG", "WRONG", "as it should be", "SLOW"]
    assert "OSError: no such library" in said and "3 not as stored" in said and "taichi 1.7.4" in said
