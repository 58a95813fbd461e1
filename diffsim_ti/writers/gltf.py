"""Animated surfaces in one binary glTF file, for Blender and viewers of the web."""

import json

import numpy as np

from diffsim_ti.common.origin import middle_far_part
from diffsim_ti.writers.surfaces import BODY, OBSTACLE, SurfacesWriter
from diffsim_ti.writers.writer import register

FLOAT, UNSIGNED, ARRAY, ELEMENTS = 5126, 5125, 34962, 34963  # numbers of glTF
TYPES = {1: "SCALAR", 3: "VEC3"}
# what turns the axis that is up to y: a quaternion, and where it brings the axes
TURNS = {
    0: ([0, 0, 0.5**0.5, 0.5**0.5], [1, 0, 2], [-1, 1, 1]),
    2: ([-(0.5**0.5), 0, 0, 0.5**0.5], [0, 2, 1], [1, 1, -1]),
}


@register
class GltfWriter(SurfacesWriter):
    """Writes the body's surface and the obstacles when it is closed; until then their places are kept in memory.

    Each frame is a morph target, whose weight the animation brings to 1 at the frame's time [s] and leads linearly to the
    next. Places are those of the first frame, of what is far from the origin less a translation (origin.py), and float32
    differences to it [m]. In glTF y is up: nodes are turned where the scene's gravity acts along x or z. A body has one
    colour: colours of a field cannot move in glTF.
    Khronos Group 2021, glTF 2.0 Specification, sections 3.7.2 (morph targets) and 3.11 (animations).
    """

    suffixes = (".glb",)
    coloured = False

    def close(self) -> None:
        if self._places:
            self.path.write_bytes(self._file())

    def _file(self) -> bytes:
        content, times = Content(self.setting.up), np.array(self._times) - self._times[0]
        at = content.add(times, limits=True) if len(times) > 1 else None
        for name, triangles, places, _ in self.surfaces():
            content.add_surface(name, triangles, places, at, BODY if name == "body" else OBSTACLE)
        return content.packed()


class Content:
    """What a file holds: the parts of its JSON, and the numbers that they name; up: the axis that is."""

    def __init__(self, up: int):
        self.turn, self.axes, self.signs = TURNS.get(up, ([], [0, 1, 2], [1, 1, 1]))
        self.parts = {name: [] for name in ("nodes", "meshes", "materials", "accessors", "bufferViews")}
        self.channels, self.samplers, self.bytes = [], [], bytearray()

    def add(self, numbers: np.ndarray, target: int | None = None, limits: bool = False) -> int:
        """The accessor of an array, float32 or unsigned; limits: with its least and largest numbers."""
        kind = FLOAT if np.issubdtype(numbers.dtype, np.floating) else UNSIGNED
        data = np.ascontiguousarray(numbers, "<f4" if kind == FLOAT else "<u4")
        view = dict(buffer=0, byteOffset=len(self.bytes), byteLength=data.nbytes)
        self.bytes += data.tobytes()
        self.parts["bufferViews"].append(view | (dict(target=target) if target else {}))
        columns = data.shape[1] if data.ndim > 1 else 1
        last = len(self.parts["bufferViews"]) - 1
        own = dict(bufferView=last, componentType=kind, count=len(data), type=TYPES[columns])
        if limits:
            rows = data.reshape(len(data), columns)
            own |= dict(min=rows.min(0).tolist(), max=rows.max(0).tolist())
        self.parts["accessors"].append(own)
        return len(self.parts["accessors"]) - 1

    def add_surface(self, name: str, triangles: np.ndarray, places: list, times: int | None, colour: tuple) -> None:
        """Triangles that go through `places`, at the times of an accessor."""
        changes, away = [x - places[0] for x in places[1:]], middle_far_part(places[0])
        shape = dict(attributes=dict(POSITION=self.add(places[0] - away, ARRAY, limits=True)))
        shape["indices"] = self.add(triangles.ravel().astype(np.uint32), ELEMENTS)
        shape["material"] = len(self.parts["materials"])
        if changes:
            shape["targets"] = [dict(POSITION=self.add(x, ARRAY, limits=True)) for x in changes]
        node = len(self.parts["nodes"])
        weights = dict(weights=[0.0] * len(changes)) if changes else {}
        self.parts["meshes"].append(dict(name=name, primitives=[shape]) | weights)
        turn = dict(rotation=self.turn) if self.turn else {}
        moved = dict(translation=(away[self.axes] * self.signs).tolist()) if away.any() else {}
        self.parts["nodes"].append(dict(name=name, mesh=node) | turn | moved)
        look = dict(baseColorFactor=[*colour, 1.0], metallicFactor=0.0, roughnessFactor=0.8)
        self.parts["materials"].append(dict(name=name, pbrMetallicRoughness=look, doubleSided=True))
        if changes:
            weights = np.eye(len(places))[:, 1:].astype(np.float32)  # the first frame is where all are zero
            self.samplers.append(dict(input=times, output=self.add(weights.ravel()), interpolation="LINEAR"))
            self.channels.append(dict(sampler=len(self.samplers) - 1, target=dict(node=node, path="weights")))

    def packed(self) -> bytes:
        """The file: a header, the JSON, the numbers."""
        whole = dict(asset=dict(version="2.0", generator="diffsim_ti"), scene=0) | self.parts
        whole["scenes"] = [dict(nodes=list(range(len(self.parts["nodes"]))))]
        whole["buffers"] = [dict(byteLength=len(self.bytes))]
        if self.channels:
            whole["animations"] = [dict(name="run", channels=self.channels, samplers=self.samplers)]
        text = json.dumps(whole, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        numbers = bytes(self.bytes) + b"\0" * (-len(self.bytes) % 4)
        chunks = b"".join(len(x).to_bytes(4, "little") + kind + x for kind, x in ((b"JSON", text), (b"BIN\0", numbers)))
        return b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunks)).to_bytes(4, "little") + chunks
