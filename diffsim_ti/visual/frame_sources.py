"""Where a viewer's frames come from: a saved series, or a run that goes on while one looks.

A source has `mesh`, `look` (what `Drawing` takes: floor, obstacles, fixed vertices, box), `len`, `frame(k)`,
`colouring(field)` and `advance()`, which makes another frame and returns whether it could.
"""

import time
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from diffsim_ti.film import extent, fixed_of, read_frame, rest_of
from diffsim_ti.obstacles import floor_of, obstacle_surfaces
from diffsim_ti.visual.colouring import Colouring, field_of, to_vertices
from diffsim_ti.visual.dragging import Grip
from diffsim_ti.visual.fields import field_named, values_of
from diffsim_ti.visual.series import Surroundings, frames_of

SAVED = ("displacement", "speed", "von_mises", "energy_density", "J")


@dataclass
class Frame:
    """A moment: time [s], positions [m], fields by name, points of the obstacles [m], and lines of text for the panel."""

    time: float
    positions: np.ndarray
    fields: dict
    obstacles: list = field(default_factory=list)
    notes: list = field(default_factory=list)


class SavedFrames:
    """Frames of a .pvd series, read when they are asked for."""

    can_drag = False

    def __init__(self, series):
        self._frames, self._last, self._colourings = frames_of(series), (-1, None), {}
        if not self._frames:
            raise ValueError(f"{series}: must list at least one frame, lists none; run the simulation first")
        self.mesh, self._around = rest_of(self._frames[0][1]), Surroundings(series)
        self.look = dict(
            ground=self._around.ground,
            obstacles=self._around.shapes(0),
            box=self.box(),
            fixed=fixed_of(read_frame(self._frames[0][1])),
        )

    def __len__(self) -> int:
        return len(self._frames)

    def advance(self) -> bool:
        return False

    def box(self) -> np.ndarray:
        """What all frames lie in, shape (2, 3) [m]."""
        return extent(self.mesh, self._frames, "displacement", field_named("displacement"))[0]

    def colouring(self, name: str) -> Colouring:
        """Colours whose limits span all frames."""
        if name not in self._colourings:
            kind = field_named(name)
            limits = extent(self.mesh, self._frames, name, kind)[1]
            self._colourings[name] = Colouring(kind.label, limits, kind.colours)
        return self._colourings[name]

    def frame(self, k: int) -> Frame:
        if self._last[0] != k:
            when, path = self._frames[k]
            saved = read_frame(path)
            fields = {name: values_of(saved, name) for name in SAVED}
            obstacles = [points for points, _ in self._around.shapes(k)]
            notes = [f"smallest J {fields['J'].min():.3g}"]
            self._last = k, Frame(when, saved.points, fields, obstacles, notes)
        return self._last[1]


class LiveFrames:
    """Frames of a `ForwardRun`, made when asked to advance; the last `keep` can be looked at again.

    The scene must have an `ExternalForce` on all vertices for the body to be dragged (`can_drag`); its forces are added to.
    """

    def __init__(self, run, keep: int = 300):
        self.run, self.mesh, sim = run, run.scene.mesh, run.simulator
        self._frames, self._limits, self._grip = deque(maxlen=keep), {}, None
        given = run.scene.inputs.values.get("external_forces")
        self.can_drag = given is not None and given.shape == self.mesh.vertices.shape
        self._given, self._mass = given, run.scene.inputs.derive(run.scene.inputs.values).mass
        shown = sim.positions[self.mesh.surface_vertices]
        box, ground = np.stack([shown.min(0), shown.max(0)]), floor_of(run.scene)
        if ground is not None:
            box[0, 1] = min(box[0, 1], ground)
        self.look = dict(ground=ground, obstacles=obstacle_surfaces(run.scene), fixed=run.scene.fixed, box=box)
        self._driven, self.run.before_part = run.driven, self._pull
        self._note(0.0)

    def __len__(self) -> int:
        return len(self._frames)

    def frame(self, k: int) -> Frame:
        return self._frames[k]

    def colouring(self, name: str) -> Colouring:
        """Colours whose limits span all frames so far, with some room."""
        kind = field_named(name)
        return Colouring(kind.label, kind.limits(*self._limits[name]), kind.colours)

    def advance(self) -> bool:
        """Simulate one frame more."""
        begin = time.perf_counter()
        self.run.advance()
        self._note(self.run.seen.substeps[-1] / (time.perf_counter() - begin))
        return True

    def grab(self, vertex: int, target) -> None:
        """Pull a vertex towards a point [m] by a spring, from the next part of a frame on."""
        if not self.can_drag:
            raise ValueError(
                "dragging needs an ExternalForce of zeros on all vertices in the scene; add it to the terms"
            )
        if self._grip is None or self._grip.vertex != vertex:
            self._grip = Grip(self.mesh, self._mass, vertex)
        self._grip.target, self.run.driven = np.asarray(target, np.float64), True

    def release(self) -> None:
        """Let go."""
        if self._grip is not None:
            self._grip.target, self.run.driven = None, self._driven
            self._pull()
            self._grip = None
            self.run.balance_anew()

    def _pull(self) -> None:
        if self._grip is not None:
            sim = self.run.simulator
            sim.set_forces(self._given + self._grip.forces(sim.positions, sim.velocities))

    def _note(self, rate: float) -> None:
        sim, seen = self.run.simulator, self.run.seen
        energy, measured = sim.compute_energy(), sim.tetrahedron_fields()
        fields = {name: field_of(sim, name) for name in ("displacement", "speed", "stiffness")}
        fields |= {name: getattr(measured, name) for name in ("von_mises", "energy_density", "J")}
        for name, values in fields.items():
            shown = to_vertices(self.mesh, values)[self.mesh.surface_vertices]
            low, high = np.percentile(shown, [0.5, 99.5])
            least, most = self._limits.get(name, (low, high))
            if low < least or high > most:  # seldom, so that colours do not flicker
                room = 0.3 * (max(high, most) - min(low, least))
                least, most = (low - room if low < least else least), (high + room if high > most else most)
            self._limits[name] = least, most
        notes = [f"energy {energy:.4g} J", *(f"  {name} {part:.4g} J" for name, part in energy.parts.items())]
        notes.append(f"smallest J {measured.J.min():.3g}")
        if np.isfinite(seen.gap):
            notes.append(f"smallest gap so far {1000 * seen.gap:.3g} mm")
        notes.append(f"{rate:.0f} steps a second")
        obstacles = [points for points, _ in obstacle_surfaces(self.run.scene, sim.time)]
        self._frames.append(Frame(sim.time, sim.positions.astype(np.float64), fields, obstacles, notes))
