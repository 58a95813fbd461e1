"""Input decks of Abaqus and CalculiX: nodes, elements, sets and surfaces of parts, instances and assemblies.

Abaqus Keywords Reference Manual: *NODE, *ELEMENT, *NSET, *ELSET, *SURFACE, *PART, *ASSEMBLY, *INSTANCE, *INCLUDE.
"""

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from diffsim_ti.mesh.geometry import rotation_matrix
from diffsim_ti.mesh.readers.file_mesh import FileMesh, beside

TETRAHEDRON = re.compile(r"^[A-Z]*3D(4|10)(?!\d)")  # C3D4, C3D4H, DC3D4, C3D10M ...
TRIANGLE = re.compile(r"^(?:S|STRI|CPS|CPE|CPEG|CAX|M3D|SFM3D|R3D|DS|SFMGAX|F3D)(3|6|65)(?!\d)")
LINE = re.compile(r"^(?:T3D|B3|B2|FRAME3D|DC1D|LS|T2D)(\d)")
FACES = {"S1": (0, 1, 2), "S2": (0, 3, 1), "S3": (1, 3, 2), "S4": (2, 3, 0)}
SILENT = "HEADING PREPRINT END ASSEMBLY STEP RESTART OUTPUT FILE EL PRINT NODE ELEMENT MONITOR".split()
MAKES_MESH = ("NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "SYSTEM", "SUBSTRUCTURE", "SYMMETRIC", "IMPORT")
DEEPEST = 16  # decks that include each other


@dataclass
class Part:
    """Nodes, elements and sets as a deck numbers them; sets hold numbers, and names of other sets."""

    nodes: dict[int, tuple] = field(default_factory=dict)
    elements: dict[int, tuple] = field(default_factory=dict)  # number -> (kind, nodes)
    node_sets: dict[str, list] = field(default_factory=dict)
    element_sets: dict[str, list] = field(default_factory=dict)
    surfaces: dict[str, list] = field(default_factory=dict)
    spelled: dict[str, str] = field(default_factory=dict)  # capitals -> as the deck writes a name


def read(path: Path) -> FileMesh:
    """The mesh of a deck. Raises ValueError for keywords that make nodes or elements of others, and for what is missing."""
    return _Deck(path).mesh()


def _blocks(path: Path, depth: int = 0):
    """(keyword, parameters, data lines) of a deck and of those that it includes."""
    if depth > DEEPEST:
        raise ValueError(f"{path.name} is included {DEEPEST} decks deep; a deck must not include itself")
    text = path.read_bytes().decode("utf-8", errors="replace")
    block, lines, head = None, [], ""
    for line in text.splitlines():
        line = line.strip()
        if not line or line.startswith("**"):
            continue
        if head or line.startswith("*"):
            head += line
            if head.endswith(","):
                continue
            if block:
                yield (*block, lines)
            keyword, parameters = _keyword(head)
            block, lines, head = (keyword, parameters), [], ""
            if keyword == "INCLUDE":
                name, remedy = parameters.get("INPUT", ""), "put it beside the deck"
                yield from _blocks(beside(path, name, "*INCLUDE names", remedy), depth + 1)
                block = None
        elif block:
            lines.append(line)
    if block:
        yield (*block, lines)


def _keyword(line: str) -> tuple[str, dict]:
    first, *rest = (part.strip() for part in line[1:].split(","))
    pairs = (part.partition("=") for part in rest if part)
    return first.upper(), {name.strip().upper(): value.strip().strip('"') for name, _, value in pairs}


def _fields(line: str) -> list[str]:
    return [word.strip().strip('"') for word in line.split(",")]


class _Deck:
    def __init__(self, path: Path):
        self.parts: dict[str, Part] = {}
        self.instances: list[tuple] = []  # name, part, rotation, shift, what the instance adds
        self.root = Part()  # of a flat deck, or of the assembly
        self.ignored: dict[str, int] = {}
        self.other: dict[str, int] = {}
        scope = self.root
        for keyword, parameters, lines in _blocks(path):
            first = keyword.split()[0]
            if keyword == "PART":
                scope = self.parts.setdefault(parameters.get("NAME", "").upper(), Part())
            elif keyword in ("END PART", "END INSTANCE"):
                scope = self.root
            elif keyword == "INSTANCE":
                scope = self._instance(parameters, lines)
            elif first in MAKES_MESH or (keyword == "NODE" and parameters.get("SYSTEM", "R").upper() != "R"):
                raise ValueError(
                    f"*{keyword} makes nodes or elements of others, which is not read; write the deck with all of them "
                    "listed in rectangular coordinates (Abaqus/CAE and Gmsh do so)"
                )
            elif keyword == "NODE":
                self._nodes(scope, parameters, lines)
            elif keyword == "ELEMENT":
                self._elements(scope, parameters, lines)
            elif keyword in ("NSET", "ELSET"):
                self._set(scope, keyword, parameters, lines)
            elif keyword == "SURFACE":
                self._surface(scope, parameters, lines)
            elif first not in SILENT:
                self.ignored[keyword] = self.ignored.get(keyword, 0) + 1

    # ---- reading -------------------------------------------------------------------------------------------------------

    def _instance(self, parameters: dict, lines: list) -> Part:
        name, of = parameters.get("NAME", ""), parameters.get("PART", "").upper()
        if of not in self.parts:
            raise ValueError(f"*INSTANCE {name!r} is of part {of!r}; parts are {', '.join(self.parts) or 'none'}")
        numbers = [[float(word) for word in _fields(line) if word] for line in lines]
        rotation, shift = np.eye(3), np.zeros(3)
        if numbers and len(numbers[0]) <= 3:
            shift = np.pad(numbers[0], (0, 3 - len(numbers[0])))
        elif numbers:
            raise ValueError(f"*INSTANCE {name!r}: a translation has three numbers, got {lines[0]!r}")
        if len(numbers) > 1:
            if len(numbers[1]) != 7:
                raise ValueError(f"*INSTANCE {name!r}: a rotation has two points and an angle, got {lines[1]!r}")
            a, b, angle = np.array(numbers[1][:3]), np.array(numbers[1][3:6]), np.radians(numbers[1][6])
            rotation = rotation_matrix(b - a, angle)
            shift = rotation @ (shift - a) + a  # translation first
        part = self.parts[of]
        own = Part()  # what an instance adds to its part
        self.instances.append((name or of, part, rotation, shift, own))
        return own

    def _nodes(self, scope: Part, parameters: dict, lines: list) -> None:
        own = []
        for line in lines:
            number, *place = _fields(line)
            place = tuple(float(x) if x else 0.0 for x in place[:3])
            number, place = int(number), place + (0.0,) * (3 - len(place))
            if scope.nodes.setdefault(number, place) != place:
                raise ValueError(
                    f"node {number} is listed twice, at {scope.nodes[number]} and at {place}; number it anew"
                )
            own.append(number)
        if "NSET" in parameters:
            self._extend(scope, scope.node_sets, parameters["NSET"], own)

    def _elements(self, scope: Part, parameters: dict, lines: list) -> None:
        kind, given = None, parameters.get("TYPE", "").upper()
        for pattern, names in (
            (TETRAHEDRON, {"4": ("tetra", 4), "10": ("tetra10", 10)}),
            (TRIANGLE, {"3": ("triangle", 3), "6": ("triangle6", 6), "65": ("triangle6", 6)}),
            (LINE, {"1": ("line", 2), "2": ("line", 2), "3": ("line", 2)}),
        ):
            if found := pattern.match(given):
                kind, count = names.get(found.group(1), (None, 0))
                break
        if LINE.match(given) and given.startswith(("B32", "T3D3")):
            kind, count = "line3", 3
        if kind is None:
            self.other[given] = self.other.get(given, 0) + len(lines)
            if re.match(r"^[A-Z]*3D(6|8|15|20|27)", given):
                raise ValueError(
                    f"elements of type {given} are no tetrahedra, and would be lost; mesh the body with C3D4 or C3D10 alone"
                )
            self._extend(scope, scope.element_sets, parameters.get("ELSET", ""), [])
            return
        words = [int(word) for line in lines for word in _fields(line) if word]
        if len(words) % (count + 1):
            raise ValueError(f"*ELEMENT, TYPE={given}: {len(words)} numbers, where each element has {count + 1}")
        rows = np.array(words, np.int64).reshape(-1, count + 1)
        for number, *nodes in rows.tolist():
            element = kind, tuple(nodes)
            if scope.elements.setdefault(number, element) != element:
                raise ValueError(f"element {number} is listed twice, with other nodes; number it anew")
        if "ELSET" in parameters:
            self._extend(scope, scope.element_sets, parameters["ELSET"], rows[:, 0].tolist())

    def _extend(self, scope: Part, sets: dict, name: str, members: list) -> None:
        if name:
            scope.spelled.setdefault(name.upper(), name)
            sets.setdefault(name.upper(), []).extend(members)

    def _set(self, scope: Part, keyword: str, parameters: dict, lines: list) -> None:
        name, sets = parameters.get(keyword, ""), scope.node_sets if keyword == "NSET" else scope.element_sets
        instance, members = parameters.get("INSTANCE", "").upper(), []
        if keyword == "NSET" and "ELSET" in parameters:
            members.append(("nodes of", parameters["ELSET"].upper(), instance))
        for line in lines:
            words = [word for word in _fields(line) if word]
            if "GENERATE" in parameters:
                first, last, step = (int(word) for word in (words + ["1"])[:3])
                if step <= 0:
                    raise ValueError(f"*{keyword} {name!r}: GENERATE needs a step above 0, got {step}")
                members += [(n, instance) for n in range(first, last + 1, step)]
            else:
                members += [(int(word) if word.isdigit() else word.upper(), instance) for word in words]
        self._extend(scope, sets, name, members)

    def _surface(self, scope: Part, parameters: dict, lines: list) -> None:
        name, kind = parameters.get("NAME", ""), parameters.get("TYPE", "ELEMENT").upper()
        if kind not in ("ELEMENT", "NODE"):
            self.ignored[f"SURFACE, TYPE={kind}"] = 1
            return
        rows = [_fields(line) for line in lines]
        if kind == "NODE":
            self._set(scope, "NSET", {"NSET": name}, [row[0] for row in rows])
        else:
            scope.spelled.setdefault(name.upper(), name)
            scope.surfaces.setdefault(name.upper(), []).extend(rows)

    # ---- putting together ----------------------------------------------------------------------------------------------

    def mesh(self) -> FileMesh:
        out = FileMesh(np.zeros((0, 3)))
        copies = list(self.instances)
        if copies and self.root.elements:
            raise ValueError("elements stand in the assembly beside instances of parts; put them into a part")
        if not copies:
            if self.parts:
                raise ValueError(
                    f"parts {', '.join(self.parts)} have no instance, so that nothing says where they are; write an assembly"
                )
            copies = [("", self.root, np.eye(3), np.zeros(3), Part())]
        elif self.root.nodes:  # reference points of the assembly
            copies.append(("", Part(nodes=self.root.nodes), np.eye(3), np.zeros(3), Part()))
        self.where = {}  # instance -> (nodes by number, elements by number), as indices of all
        points, elements = [], []
        for name, part, rotation, shift, own in copies:
            nodes, cells = part.nodes | own.nodes, part.elements | own.elements
            index = {number: len(points) + k for k, number in enumerate(nodes)}
            points += (np.array([*nodes.values()]).reshape(-1, 3) @ rotation.T + shift).tolist()
            rows = {}
            for number, (kind, corners) in cells.items():
                rows[number] = len(elements)
                try:
                    elements.append((kind, [index[n] for n in corners]))
                except KeyError as error:
                    raise ValueError(
                        f"element {number} has node {error}, which is not listed; export the deck again"
                    ) from error
            self.where[name.upper()] = index, rows
        out.points = np.array(points).reshape(-1, 3)
        self.elements = elements
        self.places = self._blocks_of(out)
        self._named_sets(out, copies)
        if self.other:
            out.left_out.append("elements of types " + ", ".join(f"{kind} ({n})" for kind, n in self.other.items()))
        if self.ignored:
            out.left_out.append(
                "what is no mesh (state it in Python): " + ", ".join(f"*{keyword}" for keyword in self.ignored)
            )
        return out

    def _blocks_of(self, out: FileMesh) -> list[tuple[int, int]]:
        """Elements as blocks of one kind each; where each of them went: (block, row)."""
        names, places = {}, []
        for kind, nodes in self.elements:
            block = names.setdefault(kind, len(names))
            if block == len(out.blocks):
                out.blocks.append((kind, []))
            places.append((block, len(out.blocks[block][1])))
            out.blocks[block][1].append(nodes)
        out.blocks = [(kind, np.array(cells, np.int64)) for kind, cells in out.blocks]
        return places

    def _named_sets(self, out: FileMesh, copies: list) -> None:
        several = len([name for name, *_ in copies if name]) > 1
        for name, part, _, _, own in copies:
            scopes = (part, own) if part is not self.root else (part,)
            for scope in scopes:
                self._put(out, scope, name, f"{name}." if several else "")
            if several and name:
                rows = [*self.where[name.upper()][1].values()]
                self._put_elements(out, name, rows)
        if copies[0][1] is not self.root:
            self._put(out, self.root, "", "")
        if several:  # a name that parts have, and the assembly has not, stands for the sets of all
            known = {*self.root.node_sets, *self.root.element_sets, *self.root.surfaces}
            for sets, merged in ((out.groups, lambda a, b: a + b), (out.point_sets, np.union1d)):
                for key, plain in [(key, key.split(".", 1)[1]) for key in sets if "." in key]:
                    if plain.upper() not in known:
                        sets[plain] = merged(sets[plain], sets[key]) if plain in sets else sets[key]

    def _put(self, out: FileMesh, scope: Part, instance: str, prefix: str) -> None:
        for key in scope.node_sets:
            rows, name = self._members(scope, scope.node_sets, key, instance, 0, ()), prefix + scope.spelled[key]
            if rows:
                out.point_sets[name] = np.unique(rows)
            else:
                out.left_out.append(f"the set {name}, which is empty")
        for key in scope.element_sets:
            rows = self._members(scope, scope.element_sets, key, instance, 1, ())
            self._put_elements(out, prefix + scope.spelled[key], rows)
        for key, lines in scope.surfaces.items():
            faces = [face for line in lines for face in self._faces(scope, line, instance)]
            if faces:
                out.faces[prefix + scope.spelled[key]] = np.array(faces, np.int64)
            else:
                out.left_out.append(f"the surface {prefix + scope.spelled[key]}, which has no faces of tetrahedra")

    def _put_elements(self, out: FileMesh, name: str, rows: list) -> None:
        if not rows:
            out.left_out.append(f"the set {name}, which holds no elements that are read")
        where = {}
        for row in sorted(set(rows)):
            block, at = self.places[row]
            where.setdefault(block, []).append(at)
        for block, own in where.items():
            out.group(name, block, np.array(own))

    def _members(self, scope: Part, sets: dict, key: str, instance: str, kind: int, above: tuple) -> list[int]:
        """Indices of the nodes (kind 0) or elements (kind 1) of a set, and of sets that it names."""
        if key in above:
            raise ValueError(f"the set {scope.spelled.get(key, key)!r} names itself")
        out = []
        for member in sets[key]:
            what, at = member if isinstance(member, tuple) and len(member) == 2 else (member, "")
            if isinstance(what, tuple):  # the nodes of an element set
                _, name, at = what
                own = self._by_name(scope, 1, name, at or instance, above)
                out += [node for row in own for node in self.elements[row][1]]
            elif isinstance(what, str):
                out += self._by_name(scope, kind, what, at or instance, (*above, key))
            else:
                index = self.where.get((at or instance).upper())
                if index is None or (what not in index[kind] and not (kind and self.other)):
                    noun = ("node", "element")[kind]
                    raise ValueError(
                        f"the set {scope.spelled.get(key, key)!r} names {noun} {what}, which is not there; export the deck "
                        "again"
                    )
                if what in index[kind]:
                    out.append(index[kind][what])
        return out

    def _by_name(self, scope: Part, kind: int, name: str, instance: str, above: tuple) -> list[int]:
        """Members of a set of the same scope, of an instance's part, or 'Instance.Set'."""
        own = (scope.node_sets, scope.element_sets)[kind]
        if name in own and not (scope is self.root and instance and name in above):
            return self._members(scope, own, name, instance, kind, above)
        head, _, tail = name.partition(".")
        for of, part, _, _, more in self.instances:
            if of.upper() == (head if tail else instance.upper()):
                if (tail or name).isdigit():
                    return [self.where[of.upper()][kind][int(tail or name)]]
                for where in (part, more):
                    sets = (where.node_sets, where.element_sets)[kind]
                    if (tail or name) in sets:
                        return self._members(where, sets, tail or name, of, kind, above)
        noun = ("node", "element")[kind]
        raise ValueError(
            f"a set names the {noun} set {name!r}, which is not there; {noun} sets: {', '.join(own) or 'none'}"
        )

    def _faces(self, scope: Part, line: list, instance: str) -> list:
        """Triangles of a line of *SURFACE: an element or a set, and the face of each; without one, those on the outside."""
        what, side = line[0], (line[1] if len(line) > 1 else "").upper()
        if what.isdigit():
            rows = [self.where[instance.upper()][1][int(what)]]
        else:
            rows = self._by_name(scope, 1, what.upper(), instance, ())
        own = [self.elements[row] for row in rows]
        if side in FACES:
            return [[nodes[k] for k in FACES[side]] for kind, nodes in own if kind.startswith("tetra")]
        if side and side not in ("SPOS", "SNEG"):
            raise ValueError(f"*SURFACE: face {side!r} of a tetrahedron; there are {', '.join(FACES)}")
        if side or not own or own[0][0].startswith("triangle"):
            return [list(nodes[:3]) for kind, nodes in own if kind.startswith("triangle")]
        seen = {}
        for kind, nodes in self.elements:
            if kind.startswith("tetra"):
                for face in FACES.values():
                    key = tuple(sorted(nodes[k] for k in face))
                    seen[key] = seen.get(key, 0) + 1
        faces = [[nodes[k] for k in face] for kind, nodes in own if kind.startswith("tetra") for face in FACES.values()]
        return [face for face in faces if seen[tuple(sorted(face))] == 1]
