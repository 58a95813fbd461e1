"""URDF files: what of them is not supported is refused, and collision geometry becomes obstacles."""

import os
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from diffsim_ti.common import rotations
from diffsim_ti.mesh.filling import read_surface
from diffsim_ti.terms.obstacles.ball import Sphere
from diffsim_ti.terms.obstacles.box import Box, Cylinder
from diffsim_ti.terms.obstacles.mesh_obstacle import MeshObstacle
from diffsim_ti.terms.obstacles.obstacle import Obstacle

MOVING = "revolute", "continuous", "prismatic"
SHAPES = dict(sphere=("radius",), box=("size",), cylinder=("radius", "length"), mesh=("filename",))


def numbers_of(element, name: str, default: str) -> np.ndarray:
    """Numbers of an attribute."""
    return np.array([float(x) for x in (default if element is None else element.get(name, default)).split()])


def pose_of(element) -> tuple[np.ndarray, np.ndarray]:
    """(unit quaternion, translation [m]) of an element's origin."""
    origin = element.find("origin")
    roll, pitch, yaw = numbers_of(origin, "rpy", "0 0 0")
    turns = [rotations.quaternion(np.array(a)) for a in ((0, 0, yaw), (0, pitch, 0), (roll, 0, 0))]
    return rotations.product(rotations.product(turns[0], turns[1]), turns[2]), numbers_of(origin, "xyz", "0 0 0")


def _still(time: float) -> np.ndarray:
    """The pose of what is not turned."""
    return np.eye(1, 7, 3)[0]


class Urdf:
    """A file, or its text, as read. Raises ValueError for what is not supported, with the joint or link."""

    def __init__(self, path: str | Path):
        text = str(path)
        self.folder = None if text.lstrip().startswith("<") else Path(text).parent
        if self.folder is not None and not os.path.isfile(text):
            raise ValueError(f"Robot.from_urdf: there is no file {text!r}")
        self.text = text if self.folder is None else Path(text).read_text(encoding="utf-8")
        try:
            self.root = ElementTree.fromstring(self.text)
        except ElementTree.ParseError as error:
            raise ValueError(f"Robot.from_urdf: {text if self.folder else 'the text'!r} is not XML: {error}") from error
        if self.root.tag != "robot":
            raise ValueError(f"Robot.from_urdf: expected an element <robot>, got <{self.root.tag}>")
        self._check()

    def _check(self) -> None:
        children: dict[str, str] = {}
        for joint in self.root.findall("joint"):
            name, kind = joint.get("name"), joint.get("type")
            if joint.find("parent") is None or joint.find("child") is None:
                raise ValueError(f"Robot.from_urdf: joint {name!r} needs a <parent> and a <child>")
            child = joint.find("child").get("link")
            if kind not in (*MOVING, "fixed"):
                raise ValueError(
                    f"Robot.from_urdf: joint {name!r} is {kind!r}; revolute, continuous, prismatic and fixed joints are "
                    "supported: replace it by several of these with links of little mass between them"
                )
            if joint.find("mimic") is not None:
                raise ValueError(
                    f"Robot.from_urdf: joint {name!r} mimics another, which is not supported: take <mimic> out of the file "
                    "and give both joints the same targets"
                )
            if child in children:
                raise ValueError(
                    f"Robot.from_urdf: link {child!r} hangs on joints {children[child]!r} and {name!r}, a closed loop, "
                    "which is not supported: cut the loop by taking one of them out"
                )
            children[child] = name
            if float(numbers_of(joint.find("dynamics"), "friction", "0")[0]):
                raise ValueError(
                    f'Robot.from_urdf: joint {name!r} has dry friction, which is not supported: set friction="0" in its '
                    "<dynamics>, and damping in its place"
                )

    def dampings(self, joints: tuple[str, ...]) -> np.ndarray:
        """Viscous damping that the file gives to joints [N m s/rad or N s/m]."""
        found = {j.get("name"): numbers_of(j.find("dynamics"), "damping", "0")[0] for j in self.root.findall("joint")}
        return np.array([found[name] for name in joints])

    def obstacles(self, robot: str, links: tuple[str, ...] | None, options: dict) -> list[tuple[str, tuple, Obstacle]]:
        """(link, pose of the obstacle in the link's frame, obstacle) of all collision geometry, or of that of some links."""
        known = [link.get("name") for link in self.root.findall("link")]
        for name in links or ():
            if name not in known:
                raise ValueError(f"Robot.from_urdf: no link {name!r}; the file has {', '.join(known)}")
        out = []
        for link in self.root.findall("link"):
            name = link.get("name")
            shapes = link.findall("collision") if links is None or name in links else []
            for k, collision in enumerate(shapes):
                own = f"{robot}_{name}" if len(shapes) == 1 else f"{robot}_{name}_{k + 1}"
                if not own.isidentifier():
                    own = "".join(c if c.isidentifier() or c.isdigit() else "_" for c in own)
                placed = options | dict(name=own, by_pairs=False, path=_still)
                out.append((name, pose_of(collision), self._shape(collision.find("geometry"), name, placed)))
        return out

    def _shape(self, geometry, link: str, options: dict) -> Obstacle:
        """An obstacle in the frame of its geometry."""
        shape = None if geometry is None or not len(geometry) else geometry[0]
        kind = None if shape is None else shape.tag
        if kind not in SHAPES or not all(shape.get(name) for name in SHAPES[kind]):
            needs = ", ".join(f"{kind} with {' and '.join(names)}" for kind, names in SHAPES.items())
            raise ValueError(f"Robot.from_urdf: link {link!r}: collision geometry must be one of {needs}")
        if kind == "sphere":
            return Sphere(np.zeros(3), float(shape.get("radius")), **options)
        if kind == "box":
            return Box(np.zeros(3), numbers_of(shape, "size", ""), **options)
        if kind == "cylinder":
            half = np.array([0, 0, 0.5 * float(shape.get("length"))])
            return Cylinder(-half, half, float(shape.get("radius")), **options)
        points, triangles, _ = read_surface(self._file(shape.get("filename"), link))
        scale = numbers_of(shape, "scale", "1 1 1")
        return MeshObstacle(points * scale, triangles[:, ::-1] if np.prod(scale) < 0 else triangles, **options)

    def _file(self, name: str, link: str) -> Path:
        """Where a mesh lies: beside the file, and of package://name/path in the nearest folder above that has `path`."""
        folder = Path.cwd() if self.folder is None else self.folder.resolve()
        inner, packaged = name.removeprefix("file://").removeprefix("package://"), name.startswith("package://")
        inner = inner.split("/", 1)[-1] if packaged else inner
        tried = [above / inner for above in ([folder, *folder.parents] if packaged else [folder])]
        for path in tried:
            if path.is_file():
                return path
        raise ValueError(f"Robot.from_urdf: link {link!r}: no mesh {str(tried[0])!r}, for {name!r}: put it there")
