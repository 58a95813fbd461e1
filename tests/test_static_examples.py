"""The examples of equilibria and implicit steps find what they look for, on small meshes."""

import numpy as np
import pytest
from example_files import EXAMPLES, example


def test_cooks_membrane(capsys):
    """Plane strain is met, the corner rises towards the reference from below, as linear tetrahedra do."""
    membrane = example("benchmarks/cooks_membrane")
    numbers, limit = membrane.main(quick=True), membrane.limit
    for name in ("linear", "large"):
        case = numbers[name]
        rise, exact = np.array(case["corner"]), case["exact"][0]
        assert np.all(np.diff(rise) > 0) and case["left"] < 1e-6
        assert 0.9 * exact < rise[-1] < exact  # linear tetrahedra lock
        assert case["limit"] == (None, None)  # three meshes carry none
    assert limit([1 - 0.5**k for k in range(4)]) == pytest.approx(1)
    assert limit([13.0, 18.0, 21.5, 22.5]) is None  # the rate still changes
    assert "corner rises" in capsys.readouterr().out


def test_sag_into_shape(tmp_path, capsys):
    numbers = example("design/sag_into_shape").main(tmp_path, quick=True)
    assert numbers["ratio"] >= 1000 and numbers["iterations"] <= 7
    assert numbers["before"] > 0.1 and numbers["lift"] > numbers["before"]  # cast higher, by more than the mean sag
    assert (tmp_path / "sag_into_shape.png").stat().st_size > 10_000
    assert "times less" in capsys.readouterr().out


def test_tuning_fork(tmp_path, capsys):
    """Both frequencies are met; the Jacobian by the shape's gradient agrees with differences; lower modes are no fork's."""
    fork = example("design/tuning_fork")
    numbers = fork.main(tmp_path, quick=True)
    assert numbers["after"] == pytest.approx([440, 2640], rel=1e-6) and numbers["iterations"] <= 5
    assert numbers["before"][0] > 500 and 6.1 < numbers["before"][1] / numbers["before"][0] < 6.25
    length, taper = numbers["p"]
    assert 0.09 < length < 0.105 and 0.05 < taper < 0.12
    assert np.all(numbers["finer"] < numbers["after"])  # linear tetrahedra are too stiff
    assert (tmp_path / "tuning_fork.png").stat().st_size > 10_000
    body, p = fork.Fork(16, 2), np.array([0.085, 0.05])
    _, jacobian, modes, chosen = body.ring(p)
    for k, s in enumerate((1e-5, 1e-3)):
        step = s * np.eye(2)[k]
        slope = (body.ring(p + step)[0] - body.ring(p - step)[0]) / (2 * s)
        assert jacobian[:, k] == pytest.approx(slope, rel=1e-5)
    assert chosen[0] > 0  # prongs that swing together are lower
    assert "finer mesh" in capsys.readouterr().out


def test_tendon_finger(tmp_path, capsys):
    """Newton's method is quadratic with a right slope."""
    numbers = example("control/tendon_finger").main(tmp_path, quick=True)
    assert numbers["miss"] < 1e-8 and numbers["iterations"] <= 7
    assert 7.0 < numbers["tension"] < 12.0 and 0.010 < numbers["pulled"] < 0.025
    assert numbers["tip"][1] == pytest.approx(-0.05, abs=1e-8) and abs(numbers["tip"][2] - 0.008) < 2e-3
    assert (tmp_path / "tendon_finger.png").stat().st_size > 10_000
    assert "of the tendon" in capsys.readouterr().out


def test_stiffness_from_picture(capsys):
    """Within 2 %, and within three times the spread that the noise of the picture leaves."""
    numbers = example("identify/stiffness_from_picture").main(quick=True)
    truth = {"upper": 2e6, "elbow": 2.5e5, "lower": 8e5}
    for part, E in numbers["E"].items():
        assert E == pytest.approx(truth[part], rel=0.02)
    assert numbers["error"] < 3 * numbers["spread"] and numbers["evaluations"] <= 60
    assert 0.09 <= numbers["residual_mm"] <= 0.11  # nothing is left but the noise of 0.1 mm
    assert "E = " in capsys.readouterr().out


def test_least_compliance(tmp_path, capsys):
    numbers = example("design/least_compliance").main(tmp_path, quick=True)
    assert numbers["by_even"] >= 6.5 and numbers["volume"] == pytest.approx(0.4, abs=1e-6)
    assert numbers["best"] <= min(numbers["history"]) * (1 + 1e-9) and numbers["clear"] > 0.8
    assert (tmp_path / "least_compliance.png").stat().st_size > 10_000
    assert "times less" in capsys.readouterr().out


def test_cantilever_shape(tmp_path, capsys):
    """Twice the load, no more drop, no more material, within the envelope; the gradient by twelve numbers."""
    module = example("design/cantilever_shape")
    for order, numbers in module.main(tmp_path, quick=True).items():
        held = 1e-6 if order == 1 else 3e-3  # the volume of straight tetrahedra is; edges of six long cells are curved
        assert numbers["ratio"] < 1 and abs(numbers["volume"]) < held
        assert numbers["deeper"] < 1.35 + 1e-6 and numbers["wider"] < 1 + 1e-6
        assert numbers["smallest_J"] > 0.2 and numbers["simulations"] <= 60
    assert (tmp_path / "cantilever_shape.png").stat().st_size > 10_000
    assert (tmp_path / "cantilever_shape_ten_nodes.png").stat().st_size > 10_000
    assert "twice the load" in capsys.readouterr().out
    beam, rng = module.Beam((5, 2, 2), 2), np.random.default_rng(3)
    x, change = 0.1 * rng.standard_normal((2, 2 * module.STATIONS))
    for f, gate in ((lambda x: beam.drop(x, 2.0), 1e-5), (beam.swell, 1e-8)):
        difference = (f(x + 1e-3 * change)[0] - f(x - 1e-3 * change)[0]) / 2e-3
        assert f(x)[1] @ change == pytest.approx(difference, rel=gate)


def test_pneumatic_finger(tmp_path, capsys):
    """Newton's method with derivatives of the equilibrium: few steps, the last of them quadratic."""
    numbers = example("control/pneumatic_finger").main(tmp_path, quick=True)
    history = numbers["history"]
    assert history[-1] < 1e-6 < 2e-4 < history[0] and len(history) <= 7
    assert numbers["moved"][1:] == pytest.approx([-0.002, 0.0003], abs=1e-6)
    assert numbers["over"][0] > numbers["over"][1] > 1e3 and np.all(
        numbers["gas"] > 101325 + numbers["over"]
    )  # it grew
    assert (tmp_path / "pneumatic_finger.png").stat().st_size > 10_000
    assert "um from the target" in capsys.readouterr().out


def test_derivatives_of_the_compliance():
    """By E they are -f . u shares: E dc/dE adds up to -c; and they equal differences."""
    module = example("design/least_compliance")
    panel = module.Panel((4, 2, 1), tolerance=1e-12)
    E = module.E0 * (1 + np.random.default_rng(0).random(panel.mesh.num_tetrahedra))
    c, by_E = panel.compliance(E)
    assert (E * by_E).sum() == pytest.approx(-c, rel=1e-9) and by_E.max() <= 0
    change = 1e-3 * E * np.random.default_rng(1).standard_normal(len(E))
    difference = (panel.compliance(E + change)[0] - panel.compliance(E - change)[0]) / 2
    assert by_E @ change == pytest.approx(difference, rel=1e-4)

    rng, volumes = np.random.default_rng(2), panel.mesh.volumes / panel.mesh.volume
    y, by_x, way = rng.random((3, len(volumes)))
    ends = [module.Projection(y + h * way, 4.0, volumes, 0.4).x for h in (1e-6, -1e-6)]
    exact = module.Projection(y, 4.0, volumes, 0.4).vjp(by_x) @ way
    assert exact == pytest.approx(by_x @ (ends[0] - ends[1]) / 2e-6, rel=1e-6)


def test_equilibria_of_peers(capsys, monkeypatch):
    """Newton's method with factors finds what ours does; a peer that cannot answer is said and left out."""
    monkeypatch.syspath_prepend(EXAMPLES / "benchmarks")
    benchmark, gone = example("benchmarks/static_peers"), {"torch-fem": ("static_torch_fem.py", "/bin/false")}
    ((tetrahedra, ours, lu, *_, other),) = benchmark.main([160], gone, repeats=1)
    assert tetrahedra == 168 and ours > 0 and float(lu.split(", ")[1].rstrip(")")) < 1e-5 and other == ""
    assert "static_torch_fem.py:" in capsys.readouterr().out


def test_benchmark_of_implicit_steps(capsys):
    """Every part runs; the direct solver takes the same steps."""
    benchmark = example("benchmarks/implicit_steps")
    ((tetrahedra, ours, theirs, ratio, differ),) = benchmark.direct([160], 2)
    assert tetrahedra == 168 and ratio == pytest.approx(theirs / ours) and differ < 1e-6
    rows, exponent = benchmark.growth([60, 400], 1)
    assert np.isfinite(exponent) and rows[-1][2] > 10
    ((_, iterations, *_, cost),) = benchmark.backward([160], 1)
    assert iterations >= 1 and cost > 0
    rows = benchmark.crossing(benchmark.beam(24), [1e6], 20)
    assert {row[:3] for row in rows} >= {("carried", 1e6, "BDF2Solver"), ("falls", 1e6, "ImplicitEulerSolver")}
    assert all(row[4] <= 0.01 and row[5] > 0 for row in rows)
    assert benchmark._where_one([1.0, 100.0], [100.0, 10.0]) == "E = 1e+04 Pa"
    assert "| tetrahedra |" in capsys.readouterr().out
