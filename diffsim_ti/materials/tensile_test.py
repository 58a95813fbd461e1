"""Tensile tests from files: stretch and nominal stress of the first loading, and what was left out."""

import csv
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from diffsim_ti.common.brief import brief_fields

UNITS = {"mpa": 1e6, "n/mm2": 1e6, "kpa": 1e3, "pa": 1.0, "n/m2": 1.0, "n/cm2": 1e4, "psi": 6894.757, "bar": 1e5}
UNITS |= {"kgf/cm2": 98066.5, "kgf/mm2": 9.80665e6}
UNIT = r"(?:mm/mm|m/m|(?:kgf|n)\s*/\s*[cm]?m\s*(?:\^?2|²)|[mk]?pa|psi|bar|%|percent|kn|n|mm|cm|m|s|-|1)"
STRETCH, STRAIN, STRESS = (
    r"stretch|lambda|λ|extension ratio",
    r"strain|elongation|dehnung|d[ée]formation",
    r"stress|spannung|contrainte",
)
TRUE, WAY, FORCE = r"true|log|hencky|cauchy|wahre|vraie", r"extension|displacement|crosshead|weg\b", r"force|load|kraft"
FEWEST = 10  # rows
REMEDY = 'write titles with units above the numbers, such as "strain [%];stress [MPa]" or "stretch;stress [kPa]"'


@dataclass(repr=False)
class TensileTest:
    """stretch [-] > 1, rising, and nominal stress [Pa], force over the area at rest, in a test of this kind: "uniaxial",
    "equibiaxial" or "planar" (pure shear), whose stretch is that in the direction that is pulled.

    header: what stands above the numbers, by lower-case names; said: what was left out or changed on the way, in words.
    """

    stretch: np.ndarray
    stress: np.ndarray
    kind: str = "uniaxial"
    header: dict[str, str] = field(default_factory=dict)
    said: list[str] = field(default_factory=list)

    __repr__ = brief_fields

    @classmethod
    def from_file(cls, path: str | Path, kind: str = "uniaxial") -> "TensileTest":
        """A table of numbers below a line of titles, which say what they are and their unit: a stretch, or an engineering or
        true strain (in % where the title says so), or a displacement; and an engineering or true stress, or a force. A
        displacement needs the length, and a force the cross-section, in lines "Length (mm);33", "Width (mm);6" and
        "Thickness (mm);3", or "Cross-section (mm2);18", above. Rows that follow each other with the same stretch count as
        one, with the mean of their stresses.

        Cells stand between semicolons, tabs, commas or blanks; decimals follow a point or a comma; any encoding. What goes
        back from a larger stretch, what follows the largest stress, and slack before the first one are left out, and said.
        Raises ValueError with file, rule and remedy.
        """
        rows = _cells(path)
        numeric = [k for k, row in enumerate(rows) if _numbers(row) is not None]
        first = next((k for k, m in zip(numeric, numeric[2:]) if m == k + 2), None)
        if first is None:
            raise ValueError(f"{path}: no three lines with two numbers or more follow each other: {REMEDY}")
        titled = [k for k, row in enumerate(rows[:first]) if re.search(f"{STRESS}|{FORCE}", " ".join(row[1:]).lower())]
        if titled:  # what lies between is damaged
            first = titled[-1] + 1 + _are_units(rows[titled[-1] + 1])
        titles, header = _titles(rows[:first], path)
        table = [_numbers(row) for row in rows[first:]]
        kept = [row for row in table if row is not None and len(row) >= len(titles)]
        if not kept or len(kept) < sum(row is not None for row in table) / 2 or len(kept[0]) > len(titles):
            raise ValueError(
                f"{path}: lines have {len(kept[0]) if kept else 'too few'} cells and the titles {len(titles)}: give each "
                "column one; where commas part the cells, decimals need points"
            )
        columns = {title: np.array([row[k] for row in kept]) for k, title in reversed(list(enumerate(titles))) if title}
        lost = len(table) - len(kept)
        said = [f"{lost} lines that are no row of numbers are left out"] if lost else []
        stretch = _stretch(columns, header, path)
        stress = _stress(columns, header, stretch, path)
        return cls(*_first_loading(stretch, stress, said, path), kind, header, said)

    @property
    def rate(self) -> float | None:
        """Nominal rate of strain at the beginning [1/s], from the header's speed [mm/min or mm/s] and length [mm]."""
        length = of_header(self.header, "length", "mm")
        for time, seconds in (("min(?:ute)?", 60), ("s(?:ec(?:ond)?)?", 1)):
            speed = of_header(self.header, "speed", rf"mm\s*/\s*{time}")
            if speed and length:
                return speed / seconds / length
        return None


def _cells(path) -> list[list[str]]:
    """The cells of each line that has any, parted by what makes most lines rows of numbers."""
    raw = Path(path).read_bytes()
    encodings = ("utf-16",) if raw[:2] in (b"\xff\xfe", b"\xfe\xff") else ("utf-8-sig", "cp1252", "latin-1")
    for encoding in encodings:
        try:
            text = raw.decode(encoding)
            break
        except UnicodeDecodeError:
            continue
    else:
        raise ValueError(f"{path}: is not a text file; save the table as CSV")
    lines = [line for line in text.splitlines() if line.strip(' \t;,"')]
    parted = [[next(csv.reader([line], delimiter=mark)) for line in lines] for mark in ";\t,"] + [
        [line.split() for line in lines]
    ]
    return max(parted, key=lambda rows: sum(_numbers(row) is not None for row in rows))


def _number(cell: str) -> float:
    text = cell.strip().strip('"').replace("\u2212", "-").replace("\xa0", "")
    if "," in text:  # of both marks the last is the decimal one
        text = text.replace(".", "").replace(",", ".") if text.rfind(",") > text.rfind(".") else text.replace(",", "")
    return float(text)


def _numbers(row: list[str]) -> list[float] | None:
    """Two numbers or more, nan for an empty cell before the last; None of any other row."""
    while row and not row[-1].strip():
        row = row[:-1]
    try:
        numbers = [_number(cell) if cell.strip() else np.nan for cell in row]
    except ValueError:
        return None
    return numbers if np.isfinite(numbers).sum() >= 2 else None


def _are_units(row: list[str]) -> bool:
    return all(re.fullmatch(rf"[(\[]?{UNIT}?[)\]]?", cell.strip().lower()) for cell in row)


def _titles(above: list[list[str]], path) -> tuple[list[str], dict[str, str]]:
    """Titles of the columns in lower case, with units, and {name: value} of the other lines."""
    while above and sum(bool(cell.strip()) for cell in above[-1]) < 2:
        above = above[:-1]
    if not above:
        raise ValueError(f"{path}: nothing says what the columns are: {REMEDY}")
    titles, above = [cell.strip().lower() for cell in above[-1]], above[:-1]
    if above and _are_units(titles):
        titles, above = [f"{a.strip().lower()} {b}" for a, b in zip(above[-1], titles)], above[:-1]
    while titles and not titles[-1]:
        titles.pop()
    header = {row[0].strip().lower(): row[1].strip() for row in above if len(row) > 1 and row[0].strip()}
    return titles, header


def of_header(header: dict[str, str], word: str, unit: str) -> float | None:
    """The first number of the header whose name has this word and unit."""
    for name, value in header.items():
        if word in name and re.search(rf"\b{unit}(\b|[23²³])", name):
            try:
                return _number(value)
            except ValueError:
                continue
    return None


def _find(columns: dict, pattern: str, true: bool | None = None) -> str | None:
    names = [name for name in columns if re.search(pattern, name) and not re.search(r"rate|energy|time", name)]
    return next((n for n in reversed(names) if true is None or bool(re.search(TRUE, n)) == true), None)


def _unit(title: str) -> str:
    """The unit that a title ends with, or ""."""
    found = re.search(rf"[\s(\[,_]({UNIT})\s*[)\]]?$", title)
    return re.sub(r"[\s^]", "", found[1]).replace("²", "2") if found else ""


def _stretch(columns: dict, header: dict, path) -> np.ndarray:
    for pattern, true in ((STRETCH, None), (STRAIN, False), (STRAIN, True), (WAY, None)):
        if (title := _find(columns, pattern, true)) is None:
            continue
        values, unit = columns[title], _unit(title)
        if unit in ("mm", "cm", "m"):
            length = of_header(header, "length", unit)
            if length is None:
                raise ValueError(
                    f'{path}: the column {title!r} needs the length at rest: a line "Length ({unit});33" above'
                )
            return 1 + values / length
        values = values / 100 if unit in ("%", "percent") else values
        if pattern == WAY and unit not in ("%", "percent"):
            continue
        if np.nanmax(values) > 30:
            raise ValueError(
                f'{path}: {title!r} goes to {np.nanmax(values):.4g}: if these are per cent, write "strain [%]"'
            )
        return values if pattern == STRETCH else np.exp(values) if true else 1 + values
    raise ValueError(
        f"{path}: no column is a stretch, a strain or a displacement [mm] ({', '.join(columns)}): {REMEDY}"
    )


def _stress(columns: dict, header: dict, stretch: np.ndarray, path) -> np.ndarray:
    for true in (False, True):
        if title := _find(columns, STRESS, true):
            unit = _unit(title)
            if unit not in UNITS:
                raise ValueError(f"{path}: the column {title!r} needs its unit, one of {', '.join(UNITS)}: {REMEDY}")
            return columns[title] * UNITS[unit] / (stretch if true else 1)
    title = _find(columns, FORCE)
    if title is None or _unit(title) not in ("n", "kn"):
        raise ValueError(f"{path}: no column is a stress, or a force [N] ({', '.join(columns)}): {REMEDY}")
    sides = [of_header(header, word, "mm") for word in ("width", "thickness")]
    area = None if None in sides else 1e-6 * sides[0] * sides[1]
    for unit, factor in (("mm", 1e-6), ("cm", 1e-4)):
        given = of_header(header, "section", unit)
        area = factor * given if area is None and given else area
    if area is None:
        raise ValueError(
            f'{path}: {title!r} needs the cross-section: lines "Width (mm);6" and "Thickness (mm);3", or '
            '"Cross-section (mm2);18", above'
        )
    return columns[title] * (1e3 if _unit(title) == "kn" else 1) / area


def _first_loading(stretch: np.ndarray, stress: np.ndarray, said: list[str], path) -> tuple[np.ndarray, np.ndarray]:
    from scipy.ndimage import median_filter

    known = np.isfinite(stretch) & np.isfinite(stress)
    stretch, stress = stretch[known], stress[known]
    strange = np.abs(stretch - median_filter(stretch, 5, mode="nearest")) > 0.05 * np.ptp(stretch)
    if strange.any():
        said.append(f"{strange.sum()} spikes of the stretch are left out")
        stretch, stress = stretch[~strange], stress[~strange]
    if len(stretch) < FEWEST:
        raise ValueError(
            f"{path}: {len(stretch)} rows have stretch and stress; {FEWEST} are the fewest that are fitted"
        )
    first = np.flatnonzero(np.diff(stretch, prepend=np.nan) != 0)  # of rows that say the same stretch
    stretch, stress = stretch[first], np.add.reduceat(stress, first) / np.diff(first, append=len(stress))
    largest = np.maximum.accumulate(np.concatenate([[1.0], stretch[:-1]]))
    rising = stretch > largest
    back = int((~rising & (largest > 1)).sum())
    if back > 2:
        said.append(f"{back} of {len(stretch)} rows, where the stretch is not above all before, are left out")
    stretch, stress = stretch[rising], stress[rising]
    end = int(np.argmax(median_filter(stress, 5, mode="nearest"))) + 1 if len(stress) else 0
    if end < len(stress):
        said.append(
            f"{len(stress) - end} rows after the largest stress, at stretch {stretch[end - 1]:.3g}, are left out"
        )
    stretch, stress = stretch[:end], stress[:end]
    if end < FEWEST or stretch[-1] < 1.05 or stress[-1] <= 0:
        raise ValueError(
            f"{path}: of {len(known)} rows {end} are left before the largest stress, to stretch "
            f"{max(stretch, default=1):.3g}: a test in tension needs {FEWEST}, to 1.05 or more, with stresses above zero"
        )
    typical = median_filter(stress, 5, mode="nearest")
    spikes = np.abs(stress - typical) > 0.05 * typical.max()
    if spikes.any():
        said.append(f"{spikes.sum()} spikes of the stress are left out")
        stretch, stress = stretch[~spikes], stress[~spikes]
    strain = np.concatenate([[0.0], stretch - 1])  # without slack half of the stress is there at half of the strain
    none = stress < 0.05 * np.interp(2 * strain[1:], strain, np.concatenate([[0.0], stress]))
    slack = strain[np.flatnonzero(none).max(initial=-1) + 1]
    if slack > 0.05:
        said.append(f"slack: the stress begins at stretch {1 + slack:.3g}, which is taken as the length at rest")
        taut = stretch > 1 + slack
        stretch, stress = stretch[taut] / (1 + slack), stress[taut]
    return stretch, stress
