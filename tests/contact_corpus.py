"""The scenes that contact codes are judged by, and a table of what becomes of them.

    python tests/contact_corpus.py [--meshes FOLDER ...] [--scene NAME ...] [--steps N] [--list]

FOLDERs hold the meshes of the IPC paper's repository (spike.msh, wedge.msh, cube.msh, tet.msh, mat20x20.msh,
mat40x40.msh, arch/01.msh ..., and surfaces *.obj), and Armadillo13K.msh, which goes through the funnel in place of the
paper's dolphin; coarser ones of our own stand for all without them, and balls and rods for the paper's always. Each scene
runs once. The table says how many steps were done, what an exact judge found at the end of each step (exact_predicates.py:
edges that pierce triangles and points within tetrahedra) and at three places on the straight way to it, which Newton's
method need not have taken, Newton's rounds, processor seconds of a step, microseconds of a step and tetrahedron beside the
paper's, and whether bodies went where they were to go.

Li, Ferguson, Schneider, Langlois, Zorin, Panozzo, Jiang, Kaufman 2020, Incremental Potential Contact,
doi:10.1145/3386569.3392425. Erleben 2018, Methodology for Assessing Mesh-Based Contact Point Methods, doi:10.1145/3096239.
"""

import argparse
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from exact_predicates import ExactJudge

import diffsim_ti as ds

G = 9.81
NONE = np.zeros((0, 3), int)


# ---- meshes ----------------------------------------------------------------------------------------------------------


class Meshes:
    """Meshes by their names in the paper's repository, of the first folder that has them, or of our own."""

    def __init__(self, *folders: str):
        self.folders = [Path(f) for f in folders]

    def __call__(self, name: str) -> ds.TetrahedralMesh:
        for folder in self.folders:
            if (file := folder / f"{name}.msh").exists():
                return ds.TetrahedralMesh.from_file(file, fix_orientation=True, drop_orphans=True)
        if self.folders:
            raise ValueError(f"no {name}.msh in {', '.join(map(str, self.folders))}")
        return getattr(self, f"_{name}")()

    def arch(self) -> list[ds.TetrahedralMesh]:
        """Blocks, one after the other from foot to foot."""
        for folder in self.folders:
            if found := sorted((folder / "arch").glob("*.msh")):
                return [shrunk(self(f"arch/{path.stem}"), 0.005) for path in found]  # they touch each other
        if self.folders:
            raise ValueError(f"no arch/*.msh in {', '.join(map(str, self.folders))}")
        return _half_ring(blocks=7, inner=1.0, outer=1.4, gap=0.004)

    def surface(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """(vertices, triangles) of NAME.obj."""
        if not self.folders:
            if name == "funnel":
                return _funnel()
            mesh = self(name)
            return mesh.vertices, mesh.surface_triangles
        file = next((f for folder in self.folders if (f := folder / f"{name}.obj").exists()), None)
        if file is None:
            raise ValueError(f"no {name}.obj in {', '.join(map(str, self.folders))}")
        vertices, triangles = [], []
        for line in file.read_text().splitlines():
            words = line.split()
            if words[:1] == ["v"]:
                vertices.append([float(x) for x in words[1:4]])
            if words[:1] == ["f"]:
                corners = [int(word.split("/")[0]) - 1 for word in words[1:]]
                triangles += [[corners[0], corners[k], corners[k + 1]] for k in range(1, len(corners) - 1)]
        return np.array(vertices), np.array(triangles, int).reshape(-1, 3)

    def _cube(self):
        return ds.TetrahedralMesh.create_box(2, size=1.0)

    def _tet(self):
        return ds.TetrahedralMesh(np.vstack([np.zeros(3), np.eye(3)]), [[0, 1, 2, 3]], fix_orientation=True)

    def _spike(self):
        base = np.array([[0.5, 0, -0.5], [0.5, 0, 0.5], [-0.5, 0, 0.5], [-0.5, 0, -0.5], [0, 3, 0]])
        return ds.TetrahedralMesh(base, [[0, 1, 2, 4], [0, 2, 3, 4]], fix_orientation=True)

    def _wedge(self):
        ends = np.array([[-0.5, 0, -1], [0.5, 0, -1], [0, 3, -1], [-0.5, 0, 1], [0.5, 0, 1], [0, 3, 1.0]])
        return ds.TetrahedralMesh(ends, [[0, 1, 2, 3], [1, 2, 3, 4], [2, 3, 4, 5]], fix_orientation=True)

    def _mat20x20(self):
        return ds.TetrahedralMesh.create_box((9, 2, 9), size=(1, 0.013, 1)).translated([-0.5, -0.0065, -0.5])

    def _mat40x40(self):
        return ds.TetrahedralMesh.create_box((11, 2, 11), size=(1, 0.008, 1)).translated([-0.5, -0.004, -0.5])


def _funnel(around: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """An open sheet: a tube with a mouth."""
    profile = np.array([[0.5, 0.12], [0.4565, 0.048], *([y, 0.02] for y in np.linspace(0.413, -0.5, 8))])
    angle = 2 * np.pi * np.arange(around) / around
    ring = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], 1)
    vertices = np.concatenate([r * ring + [0, y, 0] for y, r in profile])
    k, row = np.arange(around), around * np.arange(len(profile) - 1)[:, None]
    a, b = row + k, row + (k + 1) % around
    corners = [[a, b, a + around], [b, b + around, a + around]]
    return vertices, np.concatenate([np.stack(three, -1).reshape(-1, 3) for three in corners])


def _ball(cells: int, radius: float) -> ds.TetrahedralMesh:
    """A cube's grid drawn onto shells about its middle."""
    cube = ds.TetrahedralMesh.create_box(2 * cells + 1, size=2.0)
    x = cube.vertices - cube.vertices.mean(0)
    length = np.linalg.norm(x, axis=1, keepdims=True)
    x = radius * x * np.abs(x).max(1, keepdims=True) / np.where(length > 0, length, 1)
    return ds.TetrahedralMesh(x, cube.tetrahedra)


def _half_ring(blocks: int, inner: float, outer: float, gap: float) -> list[ds.TetrahedralMesh]:
    cube = ds.TetrahedralMesh.create_box(2, size=1.0)
    out = []
    for k in range(blocks):
        radius, share = inner + (outer - inner) * cube.vertices[:, 0], (k + cube.vertices[:, 1]) / blocks
        angle = np.pi * share
        tangent = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], 1)
        x = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.4 * (cube.vertices[:, 2] - 0.5)], 1)
        x -= gap * (cube.vertices[:, 1] - 0.5)[:, None] * tangent
        out.append(ds.TetrahedralMesh(x, cube.tetrahedra, fix_orientation=True))
    return out


def moved(mesh: ds.TetrahedralMesh, by=(0, 0, 0), turned=None) -> ds.TetrahedralMesh:
    """A body, turned about its axes' origin by `turned` = (axis, angle), then moved."""
    mesh = mesh if turned is None else mesh.rotated(*turned)
    return mesh.translated(np.asarray(by, float))


def shrunk(mesh: ds.TetrahedralMesh, by: float) -> ds.TetrahedralMesh:
    """A body smaller about its middle by a length on each side, at its corners in all directions alike."""
    x = mesh.vertices
    middle, half = 0.5 * (x.max(0) + x.min(0)), 0.5 * np.ptp(x, 0)
    return ds.TetrahedralMesh(middle + (x - middle) * (1 - by / half.min()), mesh.tetrahedra)


def set_on(mesh: ds.TetrahedralMesh, height: float) -> ds.TetrahedralMesh:
    """A body moved up or down so that its lowest vertex is at y = height."""
    return mesh.translated([0, height - mesh.vertices[:, 1].min(), 0])


# ---- a scene with its judge ------------------------------------------------------------------------------------------


@dataclass
class Surface:
    """What an obstacle consists of, for the judge; path: its displacement at a time, or that and how far it has turned
    about a point [rad]."""

    vertices: np.ndarray
    triangles: np.ndarray = field(default_factory=lambda: NONE)
    segments: np.ndarray = field(default_factory=lambda: NONE[:, :2])
    points: np.ndarray = field(default_factory=lambda: NONE[:, 0])
    path: Callable[[float], np.ndarray] = staticmethod(lambda t: np.zeros(3))
    about: np.ndarray | None = None

    def at(self, t: float) -> np.ndarray:
        """Its vertices at a time."""
        shift, turn = np.split(self.path(t), [3])
        if self.about is None:
            return self.vertices + shift
        angle = float(np.linalg.norm(turn))
        k, r = turn / (angle or 1.0), self.vertices - self.about
        r = r * np.cos(angle) + np.cross(k, r) * np.sin(angle) + np.outer(r @ k, k) * (1 - np.cos(angle))
        return self.about + r + shift

    def obstacle(self, **options) -> ds.MeshObstacle:
        parts = {name: getattr(self, name) for name in ("triangles", "segments", "points")}
        return ds.MeshObstacle(self.vertices, **{k: v for k, v in parts.items() if len(v)}, **options)


@dataclass
class Posed:
    """A scene with its solver, how many steps it takes, and what is expected of it.

    expected(run): None, or what is wrong. paper: (seconds a step, tetrahedra, Newton's rounds a step), None unknown.
    """

    solver: object
    steps: int
    surfaces: list[Surface] = field(default_factory=list)
    expected: Callable[["Run"], str | None] = staticmethod(lambda run: None)
    paper: tuple | None = None

    def judge(self) -> tuple[ExactJudge, Callable[[np.ndarray, float], np.ndarray]]:
        """(judge, places(positions of the mesh, time) -> what it judges)."""
        mesh = self.solver.scene.mesh
        x, first = [mesh.vertices], mesh.num_vertices
        triangles, segments, points = [mesh.surface_triangles], [NONE[:, :2]], [mesh.surface_vertices]
        for s in self.surfaces:
            x.append(s.vertices)
            triangles.append(s.triangles + first)
            segments.append(s.segments + first)
            named = np.unique(np.concatenate([s.triangles.ravel(), s.segments.ravel(), s.points]))
            points.append(named + first)
            first += len(s.vertices)
        asked = np.arange(first) < mesh.num_vertices
        parts = (np.concatenate(part) for part in (triangles, segments))
        judge = ExactJudge(
            np.concatenate(x), *parts, tetrahedra=mesh.tetrahedra, points=np.concatenate(points), asked=asked
        )

        def places(body: np.ndarray, t: float) -> np.ndarray:
            return np.concatenate([body, *(s.at(t) for s in self.surfaces)])

        return judge, places


@dataclass
class Run:
    """What became of a scene: positions after each step, shape (steps + 1, n, 3), and what each step took."""

    name: str
    posed: Posed
    positions: list = field(default_factory=list)
    seconds: list = field(default_factory=list)
    rounds: list = field(default_factory=list)
    intersections: int = 0
    on_the_way: int = 0
    turned: int = 0
    error: str | None = None

    @property
    def mesh(self) -> ds.TetrahedralMesh:
        return self.posed.solver.scene.mesh

    @property
    def done(self) -> int:
        return len(self.seconds)

    def body(self, k: int) -> np.ndarray:
        """Positions of body k after each step."""
        return np.array(self.positions)[:, self.mesh.vertex_sets[f"body_{k}"]]

    def speed(self, steps: int = 1) -> float:
        """The largest of any vertex over the last steps [m/s]."""
        way = self.positions[-1] - self.positions[-1 - steps]
        return float(np.linalg.norm(way, axis=1).max()) / (steps * self.posed.solver.dt)

    @property
    def verdict(self) -> str:
        if self.error:
            return self.error
        if self.done < self.posed.steps:
            return "stopped"
        if self.name.endswith(".obj") and not any(self.rounds):
            return "never touches"
        return self.posed.expected(self) or "as expected"


def run(name: str, posed: Posed, steps: int | None = None, judged: bool = True, samples: int = 4, say=None) -> Run:
    out, steps = Run(name, posed), posed.steps if steps is None else min(steps, posed.steps)
    try:
        simulator = ds.Simulator(posed.solver)
    except (ValueError, RuntimeError, TypeError) as error:
        out.error = f"{type(error).__name__}: {error}"
        return out
    judge, places = posed.judge()
    t, x = 0.0, simulator.positions
    out.positions.append(x)
    out.intersections += judge.count(places(x, t))
    for _ in range(steps):
        before, begin = simulator.report.iterations, time.process_time()
        try:
            simulator.step()
        except (FloatingPointError, ValueError) as error:
            out.error = f"step {out.done + 1}: {type(error).__name__}: {error}"
            break
        out.seconds.append(time.process_time() - begin)
        out.rounds.append(simulator.report.iterations - before)
        x, t, x_before, t_before = simulator.positions, simulator.time, x, t
        out.positions.append(x)
        if judged:
            before, after = places(x_before, t_before), places(x, t)
            out.intersections += judge.count(after)
            last = before + (after - before) * (1 - 1 / samples)
            out.on_the_way += judge.count_along(before, last, samples - 1)
            out.turned += len(judge.turned(after))
        if say:
            say(out)
    return out


# ---- scenes ----------------------------------------------------------------------------------------------------------

SCENES: dict[str, Callable[[Meshes], Posed]] = {}


def scene(name: str):
    def note(make):
        SCENES[name] = make
        return make

    return note


def posed(bodies, E, nu, dt, steps, terms=(), density=1000.0, fixed=None, motion=None, contact=None, **more) -> Posed:
    """Bodies in one scene under gravity; E and density: numbers, or one of each body."""
    mesh = ds.TetrahedralMesh.joined(bodies)

    def each(value):
        return value if np.isscalar(value) else np.repeat(value, [body.num_tetrahedra for body in bodies])

    more_of_scene = {k: more.pop(k) for k in ("initial_velocities", "initial_positions") if k in more}
    tolerance = more.pop("tolerance", 1e-4)
    built = ds.Scene(
        mesh,
        ds.StableNeoHookean(each(E), nu),
        each(density),
        [*([ds.Gravity()] if more.pop("gravity", True) else []), *([contact] if contact else []), *terms],
        fixed=fixed,
        motion=motion,
        precision="f64",
        **more_of_scene,
    )
    return Posed(ds.ImplicitEulerSolver(built, dt=dt, tolerance=tolerance, max_iterations=200), steps, **more)


def comes_to_rest(run: Run) -> str | None:
    """Slower in the end than a hundredth of what a fall of its own size gives, and without jitter."""
    size = float(np.ptp(run.mesh.vertices, 0).max())
    speed = run.speed(5)
    return None if speed < 0.003 * np.sqrt(2 * G * size) else f"still moves at {speed:.2g} m/s"


def _lies(run: Run) -> str | None:
    """The same of the last body, up and down alone: without friction it may slide."""
    height = run.body(3)[[-6, -1], :, 1].mean(1)
    speed = abs(float(np.diff(height)[0])) / (5 * run.posed.solver.dt)
    return None if speed < 0.003 * np.sqrt(2 * G) else f"still moves up or down at {speed:.2g} m/s"


def _upside_down(mesh: ds.TetrahedralMesh, height: float) -> ds.TetrahedralMesh:
    return set_on(moved(mesh, turned=([0, 0, 1], np.pi)), height)


ERLEBEN = dict(E=1e5, nu=0.4, dt=5e-3)
FIRM = ds.SelfContact(stiffness=1e6, width=5e-3)


def _pair(upper: str, lower: str, gap: float = 0.05, by=(0.0, 0.0)):
    """A soft body upside down on another, whose lowest vertices are held."""

    def make(meshes: Meshes) -> Posed:
        below = meshes(lower)
        above = moved(_upside_down(meshes(upper), below.vertices[:, 1].max() + gap), [by[0], 0, by[1]])
        fixed = np.flatnonzero(below.vertices[:, 1] <= below.vertices[:, 1].min() + 1e-9)
        return posed([below, above], steps=120, contact=FIRM, fixed=fixed, **ERLEBEN)

    return make


for _upper in ("spike", "wedge", "cube"):
    for _lower in ("spike", "wedge"):
        SCENES[f"{_upper} on soft {_lower}"] = _pair(_upper, _lower)


@scene("slots")
def slots(meshes: Meshes) -> Posed:
    """A tetrahedron among three boxes, 1 mm from two and 5 um from the third."""
    cube, tet = meshes("cube"), meshes("tet")
    bodies = [moved(cube, by) for by in ([-1.001, 0, 0], [1.000005, 0, 0], [0, -1.001, 0])] + [tet]
    return posed(
        bodies,
        contact=ds.SelfContact(1e7, 1e-4),
        fixed=np.arange(3 * cube.num_vertices),
        steps=300,
        expected=_lies,
        **ERLEBEN,
    )


def _stack(side: float, mass_ratio_density: float, E: float, steps: int = 120):
    def make(meshes: Meshes) -> Posed:
        cube = meshes("cube")
        small = cube.translated([-0.5, 0.01, -0.5])
        large = ds.TetrahedralMesh(cube.vertices * side, cube.tetrahedra).translated([-side / 2, 1.02, -side / 2])
        return posed(
            [small, large],
            E=[1e6, E],
            nu=0.4,
            density=[1000.0, mass_ratio_density],
            dt=0.025,
            steps=steps,
            contact=ds.SelfContact(1e7 * max(1.0, side**3 * mass_ratio_density / 1e6), 0.01, friction=0.5),
            terms=[ds.Ground(0.0, friction=0.5)],
            expected=comes_to_rest,
        )

    return make


SCENES["stack of two"] = _stack(1.0, 1000.0, 1e6)
SCENES["mass ratio 10 000"] = _stack(10.0, 1e4, 1e8, steps=200)


def _arch(friction: float, stands: bool):
    """Stones on a rough ground, which holds the feet by friction alone."""

    def make(meshes: Meshes) -> Posed:
        stones = meshes.arch()
        n, width = len(stones), 5e-4 * abs(float(stones[-1].vertices[:, 0].mean()))
        stiffness = 0.1 * G * 1000 * sum(stone.volumes.sum() for stone in stones) / width
        low = min(stone.vertices[:, 1].min() for stone in stones) - width

        def expected(run: Run) -> str | None:
            fall = float((run.body(n // 2)[0, :, 1] - run.body(n // 2)[-1, :, 1]).mean())
            fell = fall > 0.02 * run.mesh.vertices[:, 1].max()
            return None if fell != stands else f"its key stone went down by {fall:.3g} m"

        return posed(
            stones,
            E=2e10 if meshes.folders else 1e7,
            nu=0.4,
            dt=0.01,
            steps=500,
            contact=ds.SelfContact(stiffness, width, friction=friction),
            terms=[ds.Ground(low, stiffness=stiffness, width=width, friction=friction)],
            expected=expected,
        )

    return make


SCENES["arch, friction 0.5"] = _arch(0.5, True)
SCENES["arch, friction 0.2"] = _arch(0.2, False)


def _cards(friction: float):
    def make(meshes: Meshes) -> Posed:
        card = meshes("mat20x20")
        lean, half, gap = np.radians(75), 0.0065, 2e-3
        reach = np.cos(lean)

        def pair(x: float, floor: float) -> list[ds.TetrahedralMesh]:
            """Two that lean against each other about x."""
            out = []
            for sign in (1, -1):  # the left one rises to the right
                leaning = set_on(moved(card, turned=([0, 0, 1], sign * lean)), floor + gap)
                edge = sign * leaning.vertices[:, 0]
                out.append(leaning.translated([x - sign * (edge.max() + 0.5 * gap), 0, 0]))
            return out

        across = reach + half  # of the ground that one of a pair covers
        bodies = pair(-across - 0.02, 0.0) + pair(across + 0.02, 0.0)
        top = max(body.vertices[:, 1].max() for body in bodies)
        bodies.append(card.translated([0, top + gap + half, 0]))
        bodies += pair(0.0, top + 2 * half + gap)
        return posed(
            bodies,
            E=1e8,
            nu=0.4,
            dt=0.025,
            steps=80,
            contact=ds.SelfContact(1e5, 1.5e-3, friction=friction),
            terms=[ds.Ground(0.0, width=1.5e-3, friction=friction)],
        )

    return make


SCENES["house of cards, friction 0.2"] = _cards(0.2)
SCENES["house of cards, friction 0.1"] = _cards(0.1)


def _slope(friction: float):
    """A cube that lies on a board, by a gravity that is turned. It leans forward by a share of the width; the steepest slope
    that holds it is less by as much, so that the width is small."""

    def make(meshes: Meshes) -> Posed:
        angle, speed, steps, dt, width = np.arctan(0.5), 1e-3, 60, 0.01, 1e-4
        board = ds.TetrahedralMesh.create_box((5, 2, 3), size=(4, 0.2, 2)).translated([-1, -0.2, -0.5])
        cube = meshes("cube").translated([-0.4, 0.8 * width, 0.03])
        down = G * np.array([np.sin(angle), -np.cos(angle), 0])

        def expected(run: Run) -> str | None:
            x = run.body(1)[:, :, 0].mean(1)
            v = (x[-1] - x[-11]) / (10 * dt)
            a, end = down[0] + friction * down[1], steps * dt
            if friction >= 0.5:
                return None if abs(v) <= 1.01 * speed else f"creeps at {v:.3g} m/s"
            law = 0.5 * a * end * (end + dt)  # of backward Euler
            way = x[-1] - x[0]
            return None if abs(way / law - 1) < 0.02 else f"slides {way:.4g} m, Coulomb's law says {law:.4g} m"

        def pose(friction: float, start=None) -> Posed:
            return posed(
                [board, cube],
                E=1e9,
                nu=0.4,
                dt=dt,
                steps=steps,
                gravity=False,
                contact=ds.SelfContact(1e8, width, friction=friction, friction_speed=speed),
                terms=[ds.Gravity(down)],
                fixed=np.arange(board.num_vertices),
                initial_positions=start,
                expected=expected,
            )

        held = ds.Simulator(pose(0.51).solver)  # until it lies still
        held.run(100)
        return pose(friction, held.positions)

    return make


SCENES["slope 0.5, friction 0.49"] = _slope(0.49)
SCENES["slope 0.5, friction 0.5"] = _slope(0.5)


@scene("mat twist")
def twist(meshes: Meshes) -> Posed:
    """Both ends turn against each other, 0.4 turns a second together, for two turns of each end against the other."""
    mat = meshes("mat40x40")
    return _twisted([mat], mat.vertices, rate=0.4, dt=0.04, steps=125, contact=ds.SelfContact(1e4, 1e-3), E=2e4)


def _twisted(bodies, x: np.ndarray, rate: float, dt: float, steps: int, E: float = 1e4, **more) -> Posed:
    """Ends of bodies along x that turn about that axis, by so many turns a second against each other."""
    low, high = x[:, 0].min() + 1e-9, x[:, 0].max() - 1e-9
    held = np.flatnonzero((x[:, 0] <= low) | (x[:, 0] >= high))
    (_, y, z), sign = x[held].T, np.sign(x[held, 0])

    def motion(t: float) -> np.ndarray:
        angle = np.pi * rate * t * sign
        cos, sin = np.cos(angle), np.sin(angle)
        return np.stack([0 * y, cos * y - sin * z - y, sin * y + cos * z - z], 1)

    return posed(bodies, E, 0.4, dt, steps, gravity=False, fixed=held, motion=motion, **more)


# ---- scenes with obstacle surfaces -----------------------------------------------------------------------------------


def _on_surface(upper: str, surface: str, by=(0.0, 0.0), scale: float = 1.0):
    """A soft body upside down on a surface that does not move."""

    def make(meshes: Meshes) -> Posed:
        vertices, triangles = meshes.surface(surface)
        vertices = scale * vertices
        under = np.flatnonzero(np.abs(vertices[:, [0, 2]] - by).max(1) < 0.6)
        top = float(vertices[under if len(under) else slice(None), 1].max())
        above = moved(_upside_down(meshes(upper), top + 0.05), [by[0], 0, by[1]])
        fixed = Surface(vertices, triangles)
        return posed([above], steps=120, contact=FIRM, terms=[fixed.obstacle(width=5e-3)], surfaces=[fixed], **ERLEBEN)

    return make


for _upper, _lower in (("spike", "spike"), ("wedge", "spike"), ("spike", "wedge"), ("wedge", "wedge")):
    SCENES[f"{_upper} on {_lower}.obj"] = _on_surface(_upper, _lower)
SCENES["cube on spike.obj"] = _on_surface("cube", "spike", by=(0.5, -0.5))
for _lower in ("crack", "hole", "cliff", "internal_edges"):
    for _upper in ("spike", "wedge"):
        SCENES[f"{_upper} on {_lower}.obj"] = _on_surface(_upper, _lower)


def _hangs(run: Run) -> str | None:
    low, high = np.quantile(run.positions[-1][:, 1], [0.1, 0.9])
    return None if low > 0 and high < 1 else f"lies between {low:.3g} and {high:.3g} m"


@scene("mat on knives")
def knives(meshes: Meshes) -> Posed:
    """Nine single triangles on edge, whose slopes rise to one side and to the other in turn, above the ground.

    Newton's method ends where that of the paper does, or a round or two later: there at steps below 0.01 l h [m], l the
    diagonal of the scene.
    """
    up, down = ([[x, 0, z], [x, 1, z], [x, 0, -0.4 - z]] for x, z in ((0, -0.7), (0, 0.3)))
    corners = np.array([np.add(down if k % 2 else up, [0.1 * k, -0.1, 0]) for k in range(1, 10)])
    blades = Surface(corners.reshape(-1, 3), np.arange(27).reshape(9, 3))
    mat = meshes("mat40x40")
    return posed(
        [ds.TetrahedralMesh(1.2 * mat.vertices + [0.513, 1.0, 0.107], mat.tetrahedra)],
        E=2e4,
        nu=0.4,
        dt=0.04,
        steps=150,
        contact=ds.SelfContact(1e4, 1e-3),
        terms=[blades.obstacle(width=1e-3), ds.Ground(-0.1, width=1e-3)],
        surfaces=[blades],
        tolerance=1e-2,
        expected=_hangs,
        paper=(1.4, 9126, 5.5),
    )


def _cushion(as_segments: bool):
    def make(meshes: Meshes) -> Posed:
        n, ball = (21, 10) if meshes.folders else (5, 3)
        body = _ball(ball, radius=0.4)
        grid = np.stack(np.meshgrid(*[np.linspace(-0.4, 0.4, n)] * 2, indexing="ij"), -1).reshape(-1, 2)
        beds = []
        for sign in (-1, 1):
            tips = np.stack([grid[:, 0], np.full(len(grid), 0.45 * sign), grid[:, 1]], 1)
            feet = tips + [0, 0.3 * sign, 0]
            k = np.arange(len(tips))
            close = lambda t, s=sign: np.array([0, -s * min(0.2 * t, 0.15), 0])  # noqa: E731
            if as_segments:
                beds.append(Surface(np.concatenate([tips, feet]), segments=np.stack([k, k + len(k)], 1), path=close))
            else:
                beds.append(Surface(tips, points=k, path=close))
        return posed(
            [body],
            E=1e4,
            nu=0.4,
            dt=0.02,
            steps=50,
            gravity=False,
            contact=ds.SelfContact(1e4, 1e-3),
            terms=[bed.obstacle(width=1e-3, path=bed.path) for bed in beds],
            surfaces=beds,
            paper=(2.8, 28000, None),
        )

    return make


SCENES["pin cushion of points"] = _cushion(False)
SCENES["pin cushion of segments"] = _cushion(True)


@scene("funnel")
def funnel(meshes: Meshes) -> Posed:
    """A body is pulled into a tube of 40 mm by what of it is lowest."""
    vertices, triangles = meshes.surface("funnel")
    tube, speed = Surface(vertices, triangles), 0.06
    if meshes.folders:
        body = meshes("Armadillo13K")
        body = ds.TetrahedralMesh(body.vertices * (0.15 / np.ptp(body.vertices, 0).max()), body.tetrahedra)
    else:
        body = _ball(3, radius=0.06)
    x = body.vertices
    body = body.translated(np.array([0, 0.505, 0]) - x[x[:, 1].argmin()])
    held = np.flatnonzero(np.linalg.norm(body.vertices - [0, 0.505, 0], axis=1) < 0.015)

    def expected(run: Run) -> str | None:
        low = run.positions[-1][held, 1].max()
        return None if low < 0.505 + 0.02 - 0.9 * speed * run.done * 0.04 else f"what is pulled is at {low:.3g} m"

    return posed(
        [body],
        E=1e4,
        nu=0.4,
        dt=0.04,
        steps=100,
        contact=ds.SelfContact(1e4, 2e-4),
        terms=[tube.obstacle(width=2e-4, stiffness_per_area=1e9)],
        surfaces=[tube],
        fixed=held,
        motion=lambda t: np.tile([0, -speed * t, 0], (len(held), 1)),
        gravity=False,
        tolerance=1e-2,
        expected=expected,
        paper=(27.9, 36304, None),
    )


@scene("rollers")
def rollers(meshes: Meshes) -> Posed:
    """A ball that falls is drawn through two pairs of rollers, each of segments around a circle."""
    radius, gap, width, rate = 0.15, 0.25, 2e-3, 1.5
    body = _ball(10 if meshes.folders else 3, radius=0.25)
    angle = 2 * np.pi * np.arange(24) / 24
    circle = radius * np.stack([np.cos(angle), np.sin(angle)], 1)
    pairs = []
    for along, height in ((2, 0.0), (0, -0.5)):
        across = 2 - along
        for sign in (-1, 1):
            ends = np.zeros((2, len(angle), 3))
            ends[:, :, across], ends[:, :, 1] = circle.T
            ends[0, :, along], ends[1, :, along] = -0.4, 0.4
            middle = np.zeros(3)
            middle[across], middle[1] = sign * (radius + 0.5 * gap), height
            k = np.arange(len(angle))
            turn = np.zeros(3)
            # what faces the other roller goes down
            turn[along] = rate * sign * (1 if along == 2 else -1)
            path = lambda t, turn=turn: np.concatenate([np.zeros(3), turn * t])  # noqa: E731
            segments = np.stack([k, k + len(k)], 1)
            pairs.append(Surface(ends.reshape(-1, 3) + middle, segments=segments, path=path, about=middle))
    above = np.sqrt((0.25 + radius) ** 2 - (radius + 0.5 * gap) ** 2) + 0.02
    body = body.translated([0.003, above, 0.002])

    def expected(run: Run) -> str | None:
        way = run.positions[0][:, 1].mean() - run.positions[-1][:, 1].mean()
        return None if way > 0.5 else f"the ball went {way:.3g} m down"

    return posed(
        [body],
        E=1e4,
        nu=0.4,
        dt=0.01,
        steps=300,
        contact=ds.SelfContact(1e4, width),
        terms=[r.obstacle(width=width, path=r.path, about=r.about, friction=0.5) for r in pairs],
        surfaces=pairs,
        expected=expected,
        paper=(63.3, 27792, None),
    )


@scene("rods")
def rods(meshes: Meshes) -> Posed:
    """Four rods side by side, both ends of all turned against each other about what is between them, 0.2 turns a second."""
    n, long = (5, 41) if meshes.folders else (3, 17)
    rod = ds.TetrahedralMesh.create_box((long, n, n), size=(1.0, 0.08, 0.08)).translated([-0.5, -0.04, -0.04])
    bodies = [rod.translated([0, 0.045 * y, 0.045 * z]) for y in (-1, 1) for z in (-1, 1)]
    x = np.concatenate([body.vertices for body in bodies])
    return _twisted(
        bodies, x, rate=0.4, dt=0.025, steps=400, contact=ds.SelfContact(1e4, 1e-3), paper=(141.5, 202000, None)
    )


# ---- the table -------------------------------------------------------------------------------------------------------

HEAD = (
    "scene",
    "tetrahedra",
    "steps",
    "intersections",
    "on straight ways",
    "rounds",
    "most",
    "s/step",
    "us/tet",
    "paper's us/tet",
    "verdict",
)


def row(run: Run) -> list[str]:
    n, seconds = run.mesh.num_tetrahedra, np.array(run.seconds[1:] or [np.nan])  # the first one compiles
    paper = run.posed.paper
    return [
        run.name,
        str(n),
        f"{run.done}/{run.posed.steps}",
        str(run.intersections) + (f" ({run.turned} turned)" if run.turned else ""),
        str(run.on_the_way),
        f"{np.mean(run.rounds or [np.nan]):.1f}",
        str(max(run.rounds, default=0)),
        f"{seconds.mean():.3g}",
        f"{1e6 * seconds.mean() / n:.3g}",
        f"{1e6 * paper[0] / paper[1]:.3g}" if paper else "",
        run.verdict,
    ]


def main(arguments=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--meshes", nargs="+", default=(), help="folders of meshes, searched in this order")
    parser.add_argument("--scene", nargs="+", default=None, help="names, or what they begin with")
    parser.add_argument("--steps", type=int, default=None, help="at most so many of each scene")
    parser.add_argument("--list", action="store_true", help="print names and end")
    parser.add_argument("--every", type=int, default=0, help="say after so many steps how far a scene is")
    given = parser.parse_args(arguments)
    names = [n for n in SCENES if given.scene is None or any(n.startswith(s) for s in given.scene)]
    if given.list:
        print("\n".join(names))
        return 0
    meshes, good = Meshes(*given.meshes), True
    print("| " + " | ".join(HEAD) + " |\n|" + " --- |" * len(HEAD), flush=True)

    def say(run: Run) -> None:
        if given.every and run.done % given.every == 0:
            print(f"  {run.name}: {run.done}, {run.rounds[-1]} rounds, {run.seconds[-1]:.2g} s", file=sys.stderr)

    for name in names:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                found = run(name, SCENES[name](meshes), given.steps, say=say)
            except (ValueError, TypeError, RuntimeError) as error:
                print(f"| {name} | | | | | | | | | | not posed: {error} |", flush=True)
                good = False
                continue
        good &= found.verdict == "as expected" and found.intersections == 0
        print("| " + " | ".join(row(found)) + " |", flush=True)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
