"""Materials by tensile tests: files as laboratories write them, fits, intervals, the library, runs beyond what is known."""

import json
import warnings

import battery_of_fits
import numpy as np
import pytest
from example_files import EXAMPLES
from test_cli import fails

import diffsim_ti as ds
from diffsim_ti.cli import app as cli
from diffsim_ti.materials import Library, Measured, library, rubber_fit
from diffsim_ti.materials.evaluate import LawOnArrays
from diffsim_ti.materials.tensile_test import TensileTest

YEOH = np.array([1.6e5, 1.4e4, 900.0])
STRETCH = np.linspace(1.02, 3.0, 100)


def stress(stretch=STRETCH, law="Yeoh", p=YEOH, kind="uniaxial"):
    return rubber_fit.nominal_stress(law, np.array(p), stretch, kind)


# ---- files ---------------------------------------------------------------------------------------------------------------


def table(head, *columns, mark=";", decimal="."):
    rows = [mark.join(f"{x:.9g}".replace(".", decimal) for x in row) for row in zip(*columns)]
    return "\n".join([*head, *rows, ""])


STRESS, STRAIN, TIME = stress() / 1e6, STRETCH - 1, np.arange(len(STRETCH)) / 10
RAW = ["Par archive data", "PARAMETER;INFO;URL;;", "Specimen Length (mm);33;;;", "Speed (mm/min);450;;;", ";;;;"]
TITLES = "Time (s);True Strain;True Stress (MPa);Engineering Strain;Engineering Stress (MPa)"
FORMS = {
    "two columns": table(["stretch,stress [kPa]"], STRETCH, 1e3 * STRESS, mark=","),
    "the database": table([*RAW, TITLES], TIME, np.log(STRETCH), STRESS * STRETCH, STRAIN, STRESS),
    "true values alone": table(["True strain;True stress (MPa)"], np.log(STRETCH), STRESS * STRETCH),
    "decimal commas, tabs": table(["Dehnung [%]\tSpannung [N/mm²]"], 100 * STRAIN, STRESS, mark="\t", decimal=","),
    "decimal commas, semicolons": table(["strain;stress (MPa)"], STRAIN, STRESS, decimal=","),
    "blanks": table(["strain stress_mpa"], STRAIN, STRESS, mark="  "),
    "units in a line of their own": table(
        ["Time;Tensile strain;Tensile stress", "(s);(%);(kPa)"], TIME, 100 * STRAIN, 1e3 * STRESS
    ),
    "force and way": table(
        ["Width (mm);6", "Thickness (mm);3", "Length (mm);33", "", "Extension (mm);Load (N)"], 33 * STRAIN, 18 * STRESS
    ),
    "rows that come twice": table(["strain;stress (kgf/cm²)"], *np.repeat([STRAIN, STRESS / 0.0980665], 2, axis=1)),
    "force over an area": table(
        ["Length (mm);33", "Cross-section (cm^2);0.18", "Extension (mm);Force (kN)"], 33 * STRAIN, 0.018 * STRESS
    ),
    "empty lines and remarks": "\n\n".join(
        ["strain;stress (MPa)", *table([], STRAIN, STRESS).splitlines(), "end of test;;"]
    ),
    "empty cells": table(["strain;;stress (MPa)"], STRAIN, STRAIN, STRESS).replace(";0.5;", ";;"),
    "quoted": "\n".join(
        ['"strain","stress (MPa)"', *(f'"{a:.9g}","{b:.9g}"'.replace(".", ",") for a, b in zip(STRAIN, STRESS))]
    ),
    "unloaded afterwards": table(["strain;stress (MPa)"], [*STRAIN, *STRAIN[::-1]], [*STRESS, *0.5 * STRESS[::-1]]),
    "ruptured": table(["strain;stress (MPa)"], [*STRAIN, 2.05, 2.1, 2.15], [*STRESS, 0.1, 0.02, 0.01]),
    "a spike": table(["strain;stress (MPa)"], STRAIN, np.where(np.arange(100) == 50, 9.0, STRESS)),
    "slack": table(["strain;stress (MPa)"], [*np.linspace(0, 0.2, 9), *(1.2 * STRETCH - 1)], [*np.zeros(9), *STRESS]),
    "utf-16": table(["strain;stress (MPa)"], STRAIN, STRESS),
    "latin-1": table(["Opérateur;Émile", "déformation;contrainte (MPa)"], STRAIN, STRESS),
}


@pytest.mark.parametrize("form", FORMS)
def test_files_of_many_forms_give_the_same_curve(form, tmp_path):
    path = tmp_path / "test.csv"
    path.write_bytes(FORMS[form].encode(form if form in ("utf-16", "latin-1") else "utf-8"))
    test = TensileTest.from_file(path)
    assert len(test.stretch) >= 95
    np.testing.assert_allclose(test.stress, stress(test.stretch), rtol=2e-6 if form != "slack" else 0.03)
    assert bool(test.said) == (
        form in ("empty lines and remarks", "unloaded afterwards", "ruptured", "a spike", "slack")
    )
    assert form != "the database" or test.rate == pytest.approx(450 / 60 / 33)


def test_rates_by_minutes_and_seconds_and_the_modulus_of_small_strains():
    for unit, speed in (("mm/min", "450"), ("mm/s", "7,5"), ("mm / sec", "7.5"), ("mm/minute", "450"), ("in/s", "7.5")):
        rate = TensileTest(STRETCH, stress(), header={f"speed ({unit})": speed, "length (mm)": "33"}).rate
        assert rate is None if unit == "in/s" else rate == pytest.approx(450 / 60 / 33)
    assert rubber_fit.shear_modulus("MooneyRivlin", np.array([4e4, 1e4])) == pytest.approx(1e5, rel=1e-9)


@pytest.mark.parametrize(
    "text, words",
    [
        (
            "strain;stress\n" + table([], STRAIN, STRESS),
            r"'stress' needs its unit, one of mpa.*strain \[%\];stress \[MPa\]",
        ),
        ("strain;stress (MPa)\n" + table([], 100 * STRAIN, STRESS), r"if these are per cent, write \"strain \[%\]\""),
        (table([], STRAIN, STRESS), r"nothing says what the columns are: write titles"),
        ("time;stress (MPa)\n" + table([], STRAIN, STRESS), r"no column is a stretch, a strain or a displacement"),
        (
            "extension (mm);load (N)\n" + table([], STRAIN, STRESS),
            r"needs the length at rest: a line \"Length \(mm\);33\"",
        ),
        ("strain;load (N)\n" + table([], STRAIN, STRESS), r"needs the cross-section: lines \"Width \(mm\);6\""),
        ("strain;stress (MPa)\n0.1;0.2\n0.2;0.3\n0.3;0.4\n", r"3 rows have stretch and stress; 10 are the fewest"),
        ("strain;stress (MPa)\n" + table([], -STRAIN / 4, -STRESS), r"a test in tension needs 10"),
        ("strain,stress (MPa)\n" + table([], STRAIN, STRESS, mark=",", decimal=","), r"decimals need points"),
        ("nothing here\n", r"no three lines with two numbers"),
    ],
)
def test_files_that_are_no_test_are_refused_with_a_remedy(text, words, tmp_path):
    path = tmp_path / "test.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=words):
        TensileTest.from_file(path)


# ---- fits ----------------------------------------------------------------------------------------------------------------


def test_a_fit_finds_its_law_again():
    noise = 1 + 0.002 * np.random.default_rng(0).standard_normal(len(STRETCH))
    found = rubber_fit.fit_rubber(TensileTest(STRETCH, stress() * noise))
    assert found["law"] == "Yeoh" and found["kept"] and found["valid_to"] == pytest.approx(3.0)
    assert list(found["numbers"].values()) == pytest.approx(YEOH, rel=0.1)
    assert all(found["intervals"][n][0] <= x <= found["intervals"][n][1] for n, x in zip(("c10", "c20", "c30"), YEOH))
    assert found["errors"]["fitted"]["all"] < found["errors"]["held_out"]["all_largest"] < 0.02


def test_another_kind_of_test_decides_between_laws():
    """Uniaxial tension hardly tells Mooney's second number, equibiaxial tension does, and says what was foreseen of it."""
    p = [4e4, 1e4]
    x = np.linspace(1.02, 2.5, 60)
    tests = [TensileTest(x, stress(x, "MooneyRivlin", p, kind), kind) for kind in ("uniaxial", "equibiaxial", "planar")]
    found = rubber_fit.fit_rubber(tests)
    assert found["law"] == "MooneyRivlin" and list(found["numbers"].values()) == pytest.approx(p, rel=1e-6)
    assert found["errors"]["equibiaxial from the others"]["all"] < 1e-6


@pytest.mark.parametrize(
    "law, p, stable_to, unstable_to",
    [
        ("Yeoh", [1e5, 0.0, 0.0], 10.0, None),
        ("Yeoh", [1e5, -5e3, 0.0], 1.8, 5.0),  # softens as i grows
        ("MooneyRivlin", [1e5, -2e4], 1.2, 3.0),  # loses its stiffness in equibiaxial tension
        ("Ogden", [1e5, 5e4, 3.0, -2.0], 1.4, 1.7),  # a term that softens: mu a < 0
        ("Gent", [1e5, 30.0], 3.9, 4.1),  # of which i = 30 is reached in equibiaxial tension at stretch 4.06
    ],
)
def test_laws_are_stable_as_far_as_it_is_said(law, p, stable_to, unstable_to):
    for top, stable in ((stable_to, True), (unstable_to, False)):
        assert top is None or rubber_fit.is_stable(law, np.array(p), top) == stable


def test_intervals_hold_as_often_as_they_claim():
    """In 95 %, within five; a sample of tests/battery_of_fits.py, whose binomial spread for 40 cases is 3.5 %."""
    assert battery_of_fits.held("StableNeoHookean", 0.01, 40).min() >= 0.85
    assert battery_of_fits.held("Yeoh", 0.01, 40).min() >= 0.9


# ---- the library ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", library)
def test_every_rubber_of_the_library_keeps_what_it_promises(name):
    """Errors, stability of the compressible law in any direction of waves, the closed form, and a Scene that takes it."""
    material = library[name]
    held_out = material.errors["held_out"]
    assert held_out["low"] <= 0.03 and held_out["all"] <= 0.06 and material.valid_to >= min(3.0, material.measured_to)
    assert "Open Database License" in material.source and "D412" in material.source and name in material.describe()
    ends = material.intervals["shear_modulus"]
    assert ends is None or ends[0] < material.shear_modulus < ends[1]
    scene = ds.Scene(ds.TetrahedralMesh.create_cube(2), material, volume="patches")
    assert scene.inputs.values["density"] == 1070
    mu, lam = material.lame({n: scene.inputs.values[n] for n in material.inputs})
    assert mu == pytest.approx(material.shear_modulus, rel=1e-4) and lam + 2 / 3 * mu == pytest.approx(1e9)


@pytest.mark.parametrize(
    "name", ["RTV615", "Dragon Skin 10 Medium", "Dragon Skin 30", "Platsil Gel 10", "Dragon Skin FX Pro Slacker"]
)
def test_laws_as_they_run_are_elliptic_and_follow_the_closed_form(name):
    """The acoustic tensor n . d2psi/dF2 . n is positive in every direction, in every kind of tension up to `valid_to`."""
    material, rng = library[name], np.random.default_rng(1)
    law = LawOnArrays(material.law("f64"))
    p = material.coefficients({n: np.asarray(x) for n, x in material.material._numbers.items()})
    tops = np.linspace(1.0, material.valid_to, 12)[1:]
    for kind in ("uniaxial", "equibiaxial", "planar"):
        F = np.stack([np.diag(x) for x in rubber_fit.principal_stretches(tops, kind).T])
        P = law.stress(F - np.eye(3), p)  # without volume change; the pressure is that of the free side
        nominal = P[:, 0, 0] - P[:, 2, 2] * F[:, 2, 2] / F[:, 0, 0]
        np.testing.assert_allclose(nominal, material.nominal_stress(tops, kind), rtol=1e-6)
        n = rng.standard_normal((40, 3))
        n /= np.linalg.norm(n, axis=1)[:, None]
        for f in F:
            waves = [np.einsum("i,j->ij", a, m) for m in n for a in np.eye(3)]
            H = np.tile(f - np.eye(3), (len(waves), 1, 1))
            A = law.jvp(H, np.array(waves), np.tile(p, (len(waves), 1)), np.zeros((len(waves), len(p))))
            acoustic = np.einsum("kaij,kj->kai", A.reshape(len(n), 3, 3, 3), n)
            assert np.linalg.eigvalsh(acoustic + np.swapaxes(acoustic, 1, 2)).min() > 0


def test_names_are_answered_and_nothing_is_read_on_import():
    assert len(library) == 15 and library["ecoflex_00-30"].title == library["Ecoflex 0030"].title == "Ecoflex 00-30"
    with pytest.raises(KeyError, match=r"did you mean 'Dragon Skin 30'\? There are Bodydouble"):
        library["Dragonskin 3O"]
    fresh = Library(library.path)
    assert "_entries" not in vars(fresh) and len(fresh) == 15 and "_entries" in vars(fresh)
    assert library.describe() in (EXAMPLES / "guides" / "which_material.md").read_text()


def test_viscosity_goes_around_a_rubber_and_keeps_its_density_and_range():
    around = ds.KelvinVoigt(library["Dragon Skin 30"], 10.0)
    assert around.density == 1070 and around.valid_to == library["Dragon Skin 30"].valid_to
    assert ds.Scene(ds.TetrahedralMesh.create_cube(2), ds.StableNeoHookean(1e5, 0.3)).inputs.values["density"] == 1000


def test_up_to_a_stretch_the_volume_hardly_changes():
    material = library["Ecoflex 00-30"].up_to(2.0)
    bulk = float(material.material._numbers["bulk_modulus"])
    assert material.valid_to == 2 and 1e5 < bulk < 1e8
    x = np.array([2.0])
    assert 2 / 3 * x * material.nominal_stress(x, "equibiaxial") <= 0.0101 * bulk
    with pytest.raises(ValueError, match=r"RTV615 is valid to stretch 2.93, got 4"):
        library["RTV615"].up_to(4)


RUNS = {
    "rollout": lambda solver: ds.Rollout(solver, 1).forward(),
    "simulator": lambda solver: ds.Simulator(solver).step(),
    "lanes": lambda solver: ds.Batch(solver, 1, 2, lanes=True).forward(),
    "turns": lambda solver: ds.Batch(solver, 1, 2, lanes=False).forward(),
}


@pytest.mark.parametrize("run", RUNS)
@pytest.mark.parametrize("stretch, warned", [(1.9, False), (2.1, True)])
def test_a_run_beyond_the_range_warns(run, stretch, warned):
    mesh = ds.TetrahedralMesh.create_cube(2)
    start = mesh.vertices * [stretch, stretch**-0.5, stretch**-0.5]
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        scene = ds.Scene(mesh, library["Ecoflex 00-30"].up_to(2.0), initial_positions=start)
        RUNS[run](ds.SemiImplicitSolver(scene, dt=1e-5))
    assert any("is valid to stretch 2, and tetrahedron" in str(w.message) for w in said) == warned


# ---- the command ---------------------------------------------------------------------------------------------------------


def fit(*arguments) -> int:
    with pytest.raises(SystemExit) as stop:
        cli.main(["fit", *map(str, arguments)])
    return stop.value.code


def test_fit_writes_a_library_that_gives_materials(tmp_path, capsys):
    (tmp_path / "my_rubber_20.csv").write_text(
        "Density (g/cm3);1.12\nLab;Ours\n" + FORMS["two columns"].replace(",", ";")
    )
    assert fit(tmp_path / "my_rubber_20.csv", "-o", tmp_path / "own.json", "--source", "ours") == 0
    out = capsys.readouterr().out
    assert "My Rubber 20: Yeoh, valid to stretch 3" in out and "density 1120 kg/m^3\n" in out and "1 of 1 keep" in out
    material = Library(tmp_path / "own.json")["my rubber 20"]
    assert isinstance(material, Measured) and material.source == "Ours; ours" and material.density == 1120
    assert list(json.loads((tmp_path / "own.json").read_text())["materials"]) == ["My Rubber 20"]


def test_a_folder_goes_on_after_a_file_that_is_no_test(tmp_path, capsys):
    (tmp_path / "a.csv").write_text(FORMS["blanks"])
    (tmp_path / "b.csv").write_text("nothing\n")
    assert fit(tmp_path, "-o", tmp_path / "own.json") == 1
    out = capsys.readouterr().out
    assert "| A | Yeoh |" in out and "left out: " in out and "1 of 2 keep" in out


def test_fit_refuses_what_it_cannot_read(tmp_path, capsys):
    (tmp_path / "b.csv").write_text("nothing\n")
    assert "no three lines with two numbers" in fails(capsys, "fit", tmp_path / "b.csv")
    (tmp_path / "empty").mkdir()
    assert "there is no CSV file" in fails(capsys, "fit", tmp_path / "empty")
