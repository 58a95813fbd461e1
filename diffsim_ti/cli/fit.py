"""The command fit: laws of rubber for tensile tests, and libraries of them."""

import json
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from diffsim_ti.materials.measured import Library
from diffsim_ti.materials.rubber_fit import fit_rubber
from diffsim_ti.materials.tensile_test import TensileTest, of_header

PUBLISHED = {  # words of headers, and what of them is said of the source
    "lab": "{}",
    "standard": "{}",
    "type of test": "{}",
    "speed (mm/min)": "{} mm/min",
    "machine": "{}",
    "strain calculation": "strain {}",
    "material supplier": "rubber of {}",
}
TESTS = (
    "CSV of a tensile test with a line of titles, such as stretch;stress [MPa]; several, or a folder, make a library"
)


def fit(
    tests: Annotated[list[Path], Argument(help=TESTS)],
    equibiaxial: Annotated[list[Path] | None, Option(help="of the same material, in equibiaxial tension")] = None,
    planar: Annotated[list[Path] | None, Option(help="of the same material, in planar tension (pure shear)")] = None,
    name: Annotated[str | None, Option(help="of the material; default from the file's name")] = None,
    density: Annotated[float | None, Option(help="[kg/m^3]; default what a header says, else that of silicone")] = None,
    source: Annotated[str, Option(help="who published the data, and under which licence")] = "",
    output: Annotated[Path, Option("--output", "-o", help="library to write")] = Path("output/fit.json"),
) -> None:
    """Find the law, its numbers with 95 % intervals and where it is valid, from tensile tests; write them as a library.

    `diffsim_ti.materials.Library(output)[name]` is the material. Exit code 1 if a file gave none.
    """
    found = (file for path in tests for file in (path.iterdir() if path.is_dir() else [path]))
    files = sorted(file for file in found if file in tests or file.suffix.lower() == ".csv")
    if not files:
        raise ValueError(f"{', '.join(map(str, tests))}: there is no CSV file")
    others = [(file, "equibiaxial") for file in equibiaxial or []] + [(file, "planar") for file in planar or []]
    if len(files) > 1 and (others or name or density):
        raise ValueError("--equibiaxial, --planar, --name and --density are of one material: give one file")
    entries, failed = {}, []
    for file in files:
        try:
            own = [TensileTest.from_file(path, kind) for path, kind in ((file, "uniaxial"), *others)]
            entry = fit_rubber(own) | _about(own, source)
        except ValueError as error:
            if len(files) == 1:
                raise
            failed.append(str(error))
            continue
        if density:
            entry["density"] = density
        own_name = name or title(file.stem)
        entries[str(file) if own_name in entries else own_name] = _rounded(entry)
    output.parent.mkdir(parents=True, exist_ok=True)
    lines = ",\n".join(f" {json.dumps(key)}: {json.dumps(entry, ensure_ascii=False)}" for key, entry in entries.items())
    output.write_text(f'{{"materials": {{\n{lines}\n}}}}\n', encoding="utf-8")
    library = Library(output)
    print(library.describe() if len(files) > 1 else next(iter(library.values())).describe())
    for text in failed:
        print(f"left out: {text}")
    kept = sum(entry["kept"] for entry in entries.values())
    print(f"{kept} of {len(files)} keep held-out errors of 3 % up to stretch 3 and 6 % of all; written: {output}")
    if failed:
        raise typer.Exit(1)


def title(stem: str) -> str:
    """A name from that of a file: "dragon_skin_fx_20t" is "Dragon Skin FX 20T"."""
    words = stem.replace("_", " ").split()
    short = [any(x.isdigit() for x in w) or not set(w) & set("aeiouy") for w in words]  # no word that is said
    return " ".join(
        w if w != w.lower() else w.upper() if letters else w.capitalize() for w, letters in zip(words, short)
    )


def _about(tests: list[TensileTest], source: str) -> dict:
    header = tests[0].header
    parts = [form.format(header[key].strip()) for key, form in PUBLISHED.items() if header.get(key, "").strip()]
    parts += [source] if source else []
    out = dict(source="; ".join(parts), said=[text for test in tests for text in test.said])
    for unit, factor in (("g/cm", 1e3), ("g/cc", 1e3), ("kg/m", 1.0)):
        known = of_header(header, "density", unit)
        if known and factor * known > 100:
            out["density"] = factor * known
    return out | ({"rate": tests[0].rate} if tests[0].rate else {})


def _rounded(x):
    """Numbers with six digits."""
    if isinstance(x, dict):
        return {key: _rounded(value) for key, value in x.items()}
    if isinstance(x, list):
        return [_rounded(value) for value in x]
    return float(f"{x:.6g}") if isinstance(x, float) else x
