"""Marks (terms/marks.py) in a series: part 2 of a moment, which ParaView shows as lines, and as arrows by its filter Glyph.

A .vtu of lines and of vertices; point data "vector" and "onto" (of arrows; 0 elsewhere), cell data "mark": the number of the
label in the list's attribute `marks`, and "kind": 0 arrow, 1 line, 2 point.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from diffsim_ti.terms.marks import Arrows, Lines, Mark, Points

ARROW, LINE, POINT = range(3)


def write_marks(path: Path, drawn: Sequence[Mark], labels: list[str]) -> None:
    """Write marks, adding labels that are new to the list."""
    import meshio

    points, vectors, onto, rows, count = [], [], [], {}, 0  # rows: (cells, numbers, kinds) of each form of cells
    for mark in drawn:
        if mark.label not in labels:
            labels.append(mark.label)
        kind = LINE if isinstance(mark, Lines) else ARROW if isinstance(mark, Arrows) else POINT
        x = mark.ends.reshape(-1, 3) if kind == LINE else mark.points
        points.append(x)
        vectors.append(mark.vectors if kind == ARROW else np.zeros_like(x))
        onto.append(mark.onto if kind == ARROW else np.zeros(len(x), bool))
        cells = np.arange(count, count + len(x)).reshape(-1, 2 if kind == LINE else 1)
        own = cells, np.full(len(cells), labels.index(mark.label)), np.full(len(cells), kind)
        rows.setdefault("line" if kind == LINE else "vertex", []).append(own)
        count += len(x)
    joined = [[np.concatenate(part) for part in zip(*of)] for of in rows.values()]
    cells, numbers, kinds = map(list, zip(*joined))
    point_data = dict(vector=np.concatenate(vectors).astype(float), onto=np.concatenate(onto).astype(np.uint8))
    saved = meshio.Mesh(np.concatenate(points), list(zip(rows, cells)), point_data, dict(mark=numbers, kind=kinds))
    saved.write(path, file_format="vtu", binary=True)


def read_part(path: Path, *names: str):
    """The meshio mesh of one file of a series. Raises ValueError, with its name, if it is missing or damaged, or holds no
    data of those names."""
    import meshio

    try:
        saved = meshio.vtu.read(path)  # meshio.read prints and exits
        for name in names:
            if name not in saved.point_data and name not in saved.cell_data:
                raise ValueError(f"must hold {name!r}, has {sorted([*saved.point_data, *saved.cell_data])}")
        return saved
    except Exception as error:  # meshio lets those of its parsers through
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{path}, a file of the series, cannot be read: {reason}; write the series again") from error


def read_marks(path: Path, labels: Sequence[str]) -> list[Mark]:
    """What `write_marks` wrote; those of one label and kind are one."""
    saved, out = read_part(path, "vector", "mark", "kind"), []
    for block, number, kind in zip(saved.cells, saved.cell_data["mark"], saved.cell_data["kind"]):
        for which, how in np.unique(np.stack([number, kind], 1), axis=0):
            own = block.data[(number == which) & (kind == how)]
            label, x = labels[which], saved.points[own]
            if how == LINE:
                out.append(Lines(label, x))
            elif how == POINT:
                out.append(Points(label, x[:, 0]))
            else:
                own = own[:, 0]
                onto = saved.point_data["onto"][own].astype(bool)
                out.append(Arrows(label, x[:, 0], saved.point_data["vector"][own], onto))
    return out
