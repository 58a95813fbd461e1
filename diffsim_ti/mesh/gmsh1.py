"""Gmsh's first format ($NOD, $ELM), which meshio does not read.

$NOD: number of nodes; number x y z of each. $ELM: number of elements; number, type, physical group, entity, number of
nodes, nodes of each. Gmsh reference manual, "MSH file format version 1 (legacy)".
"""

from pathlib import Path

import numpy as np

KINDS = {1: "line", 2: "triangle", 3: "quad", 4: "tetra", 5: "hexahedron", 6: "wedge", 7: "pyramid", 8: "line3"}
KINDS |= {9: "triangle6", 11: "tetra10", 15: "vertex"}
TEN_NODES = [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]  # Gmsh's edges in meshio's order


def is_gmsh1(path: Path) -> bool:
    """Whether a file begins as one of this format."""
    with open(path, "rb") as file:
        return file.read(4) == b"$NOD"


def read(path: Path):
    """The meshio mesh of a file; physical groups as cell data "gmsh:physical", where there are some. Raises ValueError for
    what is incomplete."""
    import meshio

    try:
        words = path.read_text().split()
        at = words.index("$NOD") + 2
        count = int(words[at - 1])
        nodes = np.array(words[at : at + 4 * count], float).reshape(count, 4)
        place = {int(number): k for k, number in enumerate(nodes[:, 0])}
        at = words.index("$ELM") + 2
        cells, groups = {}, {}
        for _ in range(int(words[at - 1])):
            _, kind, group, _, size = (int(word) for word in words[at : at + 5])
            if kind not in KINDS:
                raise ValueError(f"elements of type {kind} are not known")
            own = [place[int(word)] for word in words[at + 5 : at + 5 + size]]
            if len(own) < size:
                raise ValueError("it ends within an element")
            cells.setdefault(KINDS[kind], []).append([own[i] for i in TEN_NODES] if kind == 11 else own)
            groups.setdefault(KINDS[kind], []).append(group)
            at += 5 + size
        if words[at : at + 1] != ["$ENDELM"]:
            raise ValueError("$ENDELM does not follow the elements that it counts")
    except KeyError as error:
        raise ValueError(f"an element has node {error}, which $NOD does not list") from error
    except (ValueError, IndexError) as error:
        raise ValueError(f"it is no complete Gmsh 1 file ({error})") from error
    tags = {"gmsh:physical": list(groups.values())} if any(map(any, groups.values())) else {}
    return meshio.Mesh(nodes[:, 1:], list(cells.items()), cell_data=tags)
