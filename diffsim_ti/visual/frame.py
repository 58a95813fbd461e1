"""A moment of a run, what is drawn of it, and what all of its moments share: what writers, films and windows are given."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from diffsim_ti.common.brief import brief_fields
from diffsim_ti.common.public import Public, public
from diffsim_ti.inputs import ratios_at_corners
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.obstacles import floor_of, link_rows, obstacle_surfaces
from diffsim_ti.outputs import Output, Stress
from diffsim_ti.outputs.deformation import displacement_gradients
from diffsim_ti.outputs.forces_at_frames import AppliedLoads
from diffsim_ti.outputs.output import Frames
from diffsim_ti.rollout.simulator import Simulator
from diffsim_ti.scene import Scene
from diffsim_ti.terms import Gravity
from diffsim_ti.terms.marks import Arrows, Mark, Moment, arrows
from diffsim_ti.terms.obstacles.shapes import Triangles
from diffsim_ti.visual.colouring import FIELDS, measured_fields

OF_A_RESULT = 200  # arrows that are drawn of one


@dataclass(repr=False)
class Setting(metaclass=Public):
    """What all frames share: the mesh at rest, the floor's height [m], fixed vertices, obstacles as they first stand.

    held: of fixed vertices the projectors onto the directions in which each is fixed, shape (len(fixed), 3, 3), where some
    are fixed in some directions only; else None. up: 0, 1 or 2, the axis that gravity acts along; 1 without gravity.
    """

    mesh: TetrahedralMesh
    ground: float | None = None
    fixed: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    obstacles: list[Triangles] = field(default_factory=list)
    held: np.ndarray | None = None
    up: int = 1

    __repr__ = brief_fields

    @classmethod
    def of(cls, scene: Scene) -> "Setting":
        """A scene's."""
        held = scene.supports.held if len(scene.supports.partly_fixed) else None
        gravity = scene.term(Gravity)
        acts = gravity is not None and gravity.values["gravity"].any()
        up = int(np.argmax(np.abs(gravity.values["gravity"]))) if acts else 1
        return cls(scene.mesh, floor_of(scene), scene.held, obstacle_surfaces(scene), held, up)


@dataclass(repr=False)
class Frame(metaclass=Public):
    """A moment of a run.

    time [s]; positions, displacements [m], velocities [m/s]: shape (num_vertices, 3).
    fields: numbers to colour by, one per vertex or per tetrahedron, under the names in colouring.py: "displacement" [m],
    "speed" [m/s], "von_mises" [Pa], "energy_density" [J/m^3], "J" [-] ...; where the scene has loads, "loads" [N]: what
    tractions, pressures, gases, body and external forces, springs, cables and foundations do to each vertex, shape
    (num_vertices, 3).
    obstacles: points of each obstacle [m], or None where the setting has them. marks: arrows, lines and points that show
    the scene's terms (`marks_of`). units: {name of a field: its unit}, where known.
    """

    time: float
    positions: np.ndarray
    displacements: np.ndarray
    velocities: np.ndarray
    fields: dict[str, np.ndarray]
    obstacles: list[np.ndarray] | None = None
    marks: list[Mark] = field(default_factory=list)
    units: dict[str, str] = field(default_factory=dict)

    __repr__ = brief_fields

    @property
    def colours(self) -> dict[str, np.ndarray]:
        """The fields that pictures can be coloured by."""
        return {name: values for name, values in self.fields.items() if name in FIELDS}

    def colour_values(self, name: str) -> np.ndarray:
        """The field that is called so. Raises ValueError for one that the frame does not hold, naming those that it does."""
        if name not in self.colours:
            known = ", ".join(self.colours)
            raise ValueError(f"colour: the frame must hold {name}, it holds {known}; choose one of these")
        return np.asarray(self.fields[name])

    @classmethod
    def of_run(cls, scene: Scene, frames: Frames, k: int = -1) -> "Frame":
        """Frame k, default the last, of a Rollout's run of a scene; its fields are displacement, speed, J, von Mises stress
        where `Stress` supports the law, and the outputs that each vertex or each tetrahedron has: vectors such as
        ContactForce(per_vertex=True), tensors and principal values such as Stress(at="vertices"). What some vertices have,
        such as Reaction(per_vertex=True), is zero at the others.

        Raises IndexError for a frame that there is not.
        """
        u, v = frames.displacements[k], frames.velocities[k]
        fields = dict(displacement=np.linalg.norm(u, axis=1), speed=np.linalg.norm(v, axis=1))
        fields |= _strained(scene, frames, k)
        given = [(name, frames.computed.get(name), y[k]) for name, y in frames.outputs.items()]
        shown, units = _of_items(given, scene)
        step = int(frames.steps[k])
        shown |= _loads(scene, frames.positions[k], step, frames.inputs)
        drawn = marks_of(scene, frames.positions[k], float(frames.times[k]), step, frames.inputs)
        rows = {name: frames.inputs[name][step] for name in scene.inputs.paths if name in frames.inputs}
        links = link_rows(scene, None if frames.joint_states is None else frames.joint_states[k])
        surfaces = obstacle_surfaces(scene, float(frames.times[k]), rows | links)
        moved = [points for points, _ in surfaces] if scene.moving or links else None
        return cls(float(frames.times[k]), frames.positions[k], u, v, fields | shown, moved, drawn, units)

    @classmethod
    def of(cls, simulator: Simulator, outputs: Iterable[Output] = (), last: Simulator | None = None) -> "Frame":
        """The present state of a simulator, in its scene's precision.

        outputs: become fields as in `of_run`; last: the simulator that took the last step to this state, if another did.
        """
        u, v, scene = simulator.displacements, simulator.velocities, simulator.scene
        fields = dict(displacement=np.linalg.norm(u, axis=1), speed=np.linalg.norm(v, axis=1))
        fields |= measured_fields(simulator)
        x, values = simulator.positions, simulator.values
        rows = {name: values[name][-1] for name in scene.inputs.paths}
        rows |= link_rows(scene, simulator.joint_states)
        moved = [points for points, _ in obstacle_surfaces(scene, simulator.time, rows)] if rows else None
        drawn = marks_of(scene, x, simulator.time, simulator.step_count, values)
        by = last or simulator
        shown, units = _of_items([(output.name, by.settled(output), by.output(output)) for output in outputs], scene)
        shown |= _loads(scene, x, simulator.step_count, simulator.values_of_step)
        return cls(simulator.time, x, u, v, fields | shown, moved, marks=drawn, units=units)


def _strained(scene: Scene, frames: Frames, k: int) -> dict[str, np.ndarray]:
    """Of each tetrahedron in a frame: J, the smallest of its points and of ten nodes' corners, and the mean von Mises stress
    of its points [Pa]."""
    mesh, derived = scene.mesh, scene.inputs.derive(frames.inputs)
    one = {name: getattr(frames, name)[[k]] for name in ("positions", "velocities", "displacements", "times", "steps")}
    one = replace(frames, **one, law_state=None if frames.law_state is None else frames.law_state[[k]], outputs={})
    F = np.eye(3) + displacement_gradients(one, derived, mesh, np.arange(mesh.num_tetrahedra))
    J = np.linalg.det(F).reshape(mesh.num_tetrahedra, -1).min(1)
    if mesh.order == 2:
        u = one.displacements[0].astype(np.float64)
        J = np.minimum(J, ratios_at_corners(mesh.elements, derived.rest, u).min(1))
    if scene.law.state_names and frames.law_state is None:  # which no output of the run reads
        return dict(J=J)
    try:
        stress = Stress(von_mises=True).settled(scene)
    except ValueError:  # of laws that read more than places
        return dict(J=J)
    stress.means = None  # at each point, as of a simulator's frames
    at_points = stress.value(one)[0].reshape(len(J), -1)
    return dict(J=J, von_mises=np.average(at_points, 1, derived.volumes.reshape(len(J), -1)))


def _of_items(values: Iterable[tuple], scene: Scene) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Of (name, settled output or None, its value at a moment) what each vertex or tetrahedron has, and units. What some
    vertices have, those that the output names as its `vertices`, is zero at the others."""
    shown, units, n = {}, {"loads": "N"}, scene.mesh.num_vertices
    for name, output, y in values:
        units[name], places = getattr(output, "unit", ""), getattr(output, "vertices", None)
        y = np.asarray(y)
        if (y.ndim > 1 or getattr(output, "per_item", False)) and y.shape[0] in (n, scene.mesh.num_tetrahedra):
            shown[name] = y
        elif y.ndim and places is not None and getattr(output, "per_vertex", False):
            shown[name] = np.zeros((n, *y.shape[1:]), y.dtype)
            shown[name][places] = y
    return shown, units


def _loads(scene: Scene, positions: np.ndarray, step: int, values: dict) -> dict[str, np.ndarray]:
    """{"loads": forces of loads on each vertex}, of the step that ends there; nothing in a scene without, or where they are
    not known (a chamber's volume is held)."""
    loads = AppliedLoads(scene, weight=False)
    if scene.holds_volumes or not loads.any:
        return {}
    return {"loads": loads.forces(scene.inputs.derive(values), positions.astype(np.float64), step)}


@public
def marks_of(
    scene: Scene, positions: np.ndarray, time: float = 0.0, step: int = 0, values: Mapping | None = None
) -> list[Mark]:
    """What the terms of a scene say that is drawn of them (`Term.drawn`) at positions [m], shape (num_vertices, 3).

    time [s]; step: how many steps were done, for what is given for each: it shows those of the step that ends there.
    values: {name of an input: value} of the run, default the scene's own.
    """
    x = np.asarray(positions, np.float64)
    known, out = scene.inputs.at_times([time]) if values is None else values, []
    for k, term in enumerate(scene.terms):
        now = {}
        for plain, name in scene.inputs.names_of(k).items():
            if name in known:
                now[plain] = _at(np.asarray(known[name]), scene.inputs.described[name].shapes, step)
        out += term.drawn(Moment(scene.mesh, x, float(time), now))
    return [mark for mark in out if not isinstance(mark, Arrows) or len(mark.points)]


def _at(value: np.ndarray, shapes, step: int) -> np.ndarray:
    """What of a value holds after so many steps."""
    for rule in shapes:
        if len(rule) == value.ndim and rule and rule[0] in ("steps", "steps + 1"):
            return value[min(max(step - (rule[0] == "steps"), 0), len(value) - 1)]
    return value


def results_as_arrows(frame: "Frame", mesh, names: Sequence[str]) -> list[Mark]:
    """Arrows of some of a frame's fields, vectors of all vertices. Raises ValueError for another name or shape."""
    vectors = [name for name, value in frame.fields.items() if np.shape(value) == (mesh.num_vertices, 3)]
    out = []
    for name in names:
        if name not in vectors:
            known = ", ".join(vectors) or "none: pass such outputs to the Rollout"
            raise ValueError(f"arrows: {name!r} must be a vector of each vertex that frames hold; they hold {known}")
        unit = frame.units.get(name)
        label = name.replace("_", " ") + (f" [{unit}]" if unit else "")
        x, each = np.asarray(frame.positions, np.float64), range(mesh.num_vertices)
        out.append(replace(arrows(label, mesh, x, each, frame.fields[name], OF_A_RESULT), through=True))
    return [mark for mark in out if len(mark.points)]
