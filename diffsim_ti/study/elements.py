"""Which elements a scene needs: the error of its mesh by linear tetrahedra, patches and ten-node tetrahedra, these also on a
coarser mesh of the body."""

import time
from dataclasses import dataclass

import numpy as np

from diffsim_ti.accuracy.estimate import COARSE
from diffsim_ti.accuracy.finer import HELD, is_named, on_finer, on_ten_nodes
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.grid import PATTERNS, box
from diffsim_ti.rollout import Rollout
from diffsim_ti.scene import Scene
from diffsim_ti.solvers import BDF2Solver, StaticSolver, VelocityVerletSolver
from diffsim_ti.study.problem import ELEMENTS
from diffsim_ti.study.quantity import MOTION, Quantity


def halved_grid(mesh: TetrahedralMesh) -> TetrahedralMesh | None:
    """A mesh of `create_box`, moved or stretched, with every other plane of each direction that has an even number of cells;
    None for other meshes. Sets are carried along by their vertices."""
    axes = [np.unique(np.round(x, 12)) for x in mesh.vertices.T]
    counts = [len(axis) for axis in axes]
    pattern = _pattern(mesh, axes, counts)
    kept = [slice(None, None, 2 if n > 2 and n % 2 else 1) for n in counts]
    if pattern is None or all(part.step == 1 for part in kept):
        return None
    fine = np.arange(mesh.num_vertices).reshape(counts)[tuple(kept)]
    _, tetrahedra, _ = box(fine.shape, 1.0, pattern, 0.0)
    own = fine.ravel()
    place = np.full(mesh.num_vertices, -1)
    place[own] = np.arange(len(own))
    sets = {name: place[rows][place[rows] >= 0] for name, rows in mesh.vertex_sets.items()}
    out = TetrahedralMesh(mesh.vertices[own], tetrahedra, vertex_sets=sets)
    for name, rows in mesh.surface_sets.items():
        within = np.isin(own[out.surface_triangles], mesh.surface_triangles[rows]).all(1)
        out = out.with_surface_set(name, np.flatnonzero(within)) if within.any() else out
    return out


def _pattern(mesh: TetrahedralMesh, axes: list[np.ndarray], counts: list[int]) -> str | None:
    """The pattern of create_box whose tetrahedra a mesh has, its vertices being a grid of axes; else None."""
    if mesh.order != 1 or np.prod(counts) != mesh.num_vertices:
        return None
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    if not np.allclose(grid, mesh.vertices, rtol=0, atol=1e-9 * np.ptp(grid, 0).max()):
        return None
    return next((p for p in PATTERNS if np.array_equal(box(counts, 1.0, p, 0.0)[1], mesh.tetrahedra)), None)


def on_coarser(scene: Scene, mesh: TetrahedralMesh) -> Scene:
    """The scene with ten-node tetrahedra of another linear mesh of its body, which has the named sets that the scene names.
    What is held by indices is held where the other mesh's vertices lie between such vertices alone.

    Raises ValueError for what cannot be carried over: numbers for each tetrahedron, terms on vertices by their indices.
    """
    given = dict(scene.arguments)
    several = [n for n in (*scene.material.inputs, "density") if np.ndim(scene.inputs.values[n])]
    if several:
        raise ValueError(f"{several[0]} is given for each tetrahedron")
    fixed, at = given["fixed"], scene.mesh.locate(mesh.vertices, nearest=True).matrix
    if not is_named(fixed):
        held = np.zeros(scene.mesh.num_vertices)
        held[scene.mesh.vertex_indices(fixed)] = 1
        if not np.any(own := at @ held > 1 - 1e-6):
            raise ValueError(
                "none of its vertices lies between vertices that are fixed by their indices: name them as a set"
            )
        mesh, given["fixed"] = mesh.with_vertex_set(HELD, own), HELD
    for term in scene.terms:
        named = [getattr(term, kind, None) for kind in ("vertices", "tetrahedra")]
        if not all(map(is_named, [*named, *(getattr(term, "attached", None) or {}).values()])):
            raise ValueError(f"{type(term).__name__} is on vertices or tetrahedra by their indices: name them as a set")
    nodes = mesh.quadratic()
    for name, origin in (("initial_positions", scene.mesh.vertices), ("initial_velocities", 0.0)):
        if np.ndim(given[name]) == 2:
            own = at @ (np.asarray(given[name], np.float64) - origin)
            given[name] = nodes.from_corners @ (own + (mesh.vertices if name == "initial_positions" else 0.0))
    return Scene(**given | dict(mesh=nodes, volume="tetrahedra"))


STEP = 0.1  # of a number's change: what steps may make wrong where its error by the mesh is asked for
MOST_SUBSTEPS = 64


@dataclass
class ElementTrial:
    """A kind of element (ELEMENTS) on a scene's own mesh, or a coarser one: the largest distance of its motion from that of
    finer elements at the scene's vertices over the largest displacement, or the error of a number over its change (NaN: not
    known), and the wall time [s] of the run. bar: whether it is the estimate of `Rollout.accuracy`.
    """

    element: str
    error: float
    seconds: float
    bar: bool = False

    def __str__(self) -> str:
        how = " as estimated" if self.bar else ""
        error = "error not known" if np.isnan(self.error) else f"error {self.error:.2g}{how}"
        return f"{self.element} {error} in {self.seconds:.2g} s"


def own_element(scene: Scene) -> str:
    """The kind that a scene has."""
    how = {"order": 2} if scene.mesh.order == 2 else {}
    how |= {"volume": scene.volume} if scene.volume != "tetrahedra" else {}
    return next(name for name, own in ELEMENTS.items() if own == how)


def advised(trials: list[ElementTrial], tolerance: float, scene: Scene) -> str:
    """The cheapest kind that keeps to the tolerance, or the one that is nearest; the scene's own if none was tried."""
    known = [trial for trial in trials if np.isfinite(trial.error)]
    good = [trial for trial in known if trial.error <= tolerance]
    if good:
        return min(good, key=lambda trial: trial.seconds).element
    if any(np.isnan(trial.error) for trial in trials):
        return "quadratic"
    return min(known, key=lambda trial: trial.error).element if known else own_element(scene)


def _with_volume(scene: Scene, how: dict) -> Scene:
    return scene.replace(volume=how.get("volume", "tetrahedra"))


class ElementTrials:
    """Runs of a scene by kinds of elements over `duration` [s], 0 of an equilibrium, for at most about `budget` [s] of wall
    time.

    coarser: another mesh for those of ten nodes; None: a grid of half the cells, where the scene's mesh is a grid.
    quantity: what errors are of. Those of a number are its estimates by `Rollout.accuracy`, in equilibria and steps of BDF2,
    if all of these can be trusted; else runs of all kinds are compared with one of the finest elements, as those of motion
    are.
    """

    def __init__(
        self,
        scene: Scene,
        duration: float,
        frames: int,
        budget: float,
        coarser: TetrahedralMesh | None = None,
        quantity: Quantity = MOTION,
    ):
        self.coarser, self.quantity = coarser or halved_grid(scene.mesh), quantity
        self.scene, self.duration, self.frames, self.budget = scene.replace(precision="f64"), duration, frames, budget
        self.notes: list[str] = []

    def run(self) -> list[ElementTrial]:
        """Trials of all kinds, by time; none if the scene cannot be had of ten-node tetrahedra."""
        scene, motions, seconds = self.scene, {}, {}
        if scene.mesh.order == 2:
            self.notes.append("elements were not compared: the mesh has ten nodes already")
            return []
        try:
            on_mesh = {1: scene, 2: on_ten_nodes(scene)}
            scenes = {name: _with_volume(on_mesh[how.get("order", 1)], how) for name, how in ELEMENTS.items()}
        except ValueError as error:
            self.notes.append(f"ten-node tetrahedra were not tried: {error}")
            return []
        coarser = self.on_coarser_mesh()
        if self.quantity.output is not None and (found := self._by_bars(scenes | coarser)):
            return found
        for name, made in (scenes | coarser).items():
            motions[name], seconds[name] = self._motion(made)
        for name, made in coarser.items() if self.quantity.output is None else ():  # as the scene's own vertices see it
            at = made.mesh.locate(scene.mesh.vertices, nearest=True).matrix
            motions[name] = np.stack([at @ u for u in motions[name]])
        finest, error_of_finest = self._finest(seconds["quadratic"])
        if finest is None:
            finest = motions["quadratic"]
        n, largest = scene.mesh.num_vertices, np.linalg.norm(finest, axis=2).max()
        found = []
        for name, moved in motions.items():
            apart = np.linalg.norm(moved[:, :n] - finest[:, :n], axis=2).max() / largest
            unknown = name.startswith("quadratic") and name not in coarser and not error_of_finest
            found.append(ElementTrial(name, np.nan if unknown else float(apart), seconds[name]))
        return sorted(found, key=lambda trial: trial.seconds)

    def _by_bars(self, scenes: dict[str, Scene]) -> list[ElementTrial]:
        """The same by error bars; none, and a note that says why, where one is not to be trusted."""
        found, substeps = [], 1
        for name, made in scenes.items():
            seconds = self._timed(self._implicit(made, substeps))[1]
            error, doubts = np.nan, ()
            if made.mesh.order == 1 or 40 * seconds <= self.budget:  # of ten nodes the finer mesh has more
                try:
                    bar = self.quantity.accuracy(self._implicit(made, substeps))
                    while not abs(bar.step) <= STEP * bar.size and substeps < MOST_SUBSTEPS:
                        substeps *= 2
                        bar = self.quantity.accuracy(self._implicit(made, substeps))
                    error = abs(bar.mesh) / max(bar.size, np.finfo(float).tiny)  # by the finer mesh, whatever cancels
                    doubts = [bar.doubts[name] for name in bar.doubts if name != "mesh cancels"]
                    doubts = doubts if error < COARSE else ()  # others are out of the question anyway
                except (ValueError, FloatingPointError) as problem:
                    doubts = (str(problem),)
            if doubts:
                self.notes.append(
                    f"error bars of {self.quantity.output.name} were not used, runs of the finest elements were: {name}: "
                    f"{'; '.join(doubts)}"
                )
                return []
            found.append(ElementTrial(name, float(error), seconds, True))
        return sorted(found, key=lambda trial: trial.seconds)

    def _implicit(self, scene: Scene, substeps: int) -> Rollout:
        if not self.duration:
            return self.quantity.rollout(StaticSolver(scene), 1)
        return self.quantity.rollout(BDF2Solver(scene, dt=self.duration / self.frames, substeps=substeps), self.frames)

    def on_coarser_mesh(self) -> dict[str, Scene]:
        """Scenes of ten-node tetrahedra on the coarser mesh, by name."""
        if self.coarser is None:
            return {}
        try:
            made = on_coarser(self.scene, self.coarser)
            kinds = {name: how for name, how in ELEMENTS.items() if how.get("order") == 2}
            return {f"{name}, coarser mesh": _with_volume(made, how) for name, how in kinds.items()}
        except ValueError as error:
            self.notes.append(f"a coarser mesh was not tried: {error}")
            return {}

    def _finest(self, seconds: float) -> tuple:
        """(motion of ten-node tetrahedra on the mesh that is refined once, whether there is one); it takes some 16 times as
        long."""
        if 40 * seconds > self.budget:
            return None, False
        try:
            return self._motion(on_ten_nodes(on_finer(self.scene, TetrahedralMesh.refined)))[0], True
        except (ValueError, FloatingPointError):
            return None, False

    def _motion(self, scene: Scene) -> tuple[np.ndarray, float]:
        solver = VelocityVerletSolver(scene, dt=self.duration / self.frames) if self.duration else StaticSolver(scene)
        return self._timed(self.quantity.rollout(solver, self.frames))

    def _timed(self, rollout: Rollout) -> tuple[np.ndarray, float]:
        rollout.forward()  # compiles
        begin = time.perf_counter()
        frames = rollout.forward()
        return self.quantity.of(rollout, frames), time.perf_counter() - begin
