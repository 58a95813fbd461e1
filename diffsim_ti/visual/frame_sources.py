"""Where a viewer's frames come from: a saved series, or a run that goes on meanwhile."""

import time
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.terms import ExternalForce
from diffsim_ti.visual.colouring import Colouring, field_named, field_of, to_vertices
from diffsim_ti.visual.extent import Extent
from diffsim_ti.visual.frame import Frame, Setting
from diffsim_ti.visual.series import SavedSeries
from diffsim_ti.visual.viewer import Grip

if TYPE_CHECKING:
    from diffsim_ti.writers.adaptive_run import ForwardRun


@dataclass
class ShownFrame(Frame):
    """A frame with lines of text for the viewer's panel."""

    notes: list[str] = field(default_factory=list)


class FrameSource(ABC):
    """Frames to be shown; `setting`: what they share; `can_drag`: whether the body can be pulled."""

    setting: Setting
    can_drag = False

    @property
    def mesh(self) -> TetrahedralMesh:
        return self.setting.mesh

    @property
    def look(self) -> dict:
        """What `Drawing` takes: floor, obstacles, fixed vertices, box."""
        own = {name: getattr(self.setting, name) for name in ("ground", "obstacles", "fixed", "held")}
        return own | dict(box=self.box())

    @abstractmethod
    def box(self) -> np.ndarray:
        """What is to be seen, shape (2, 3) [m]."""

    @abstractmethod
    def __len__(self) -> int:
        """Frames there are."""

    @abstractmethod
    def frame(self, k: int) -> ShownFrame:
        """Frame k."""

    @abstractmethod
    def colouring(self, name: str) -> Colouring:
        """Colours of a field whose limits span all frames."""

    def advance(self) -> bool:
        """Make another frame; whether that can be done."""
        return False


class SavedFrames(FrameSource):
    """Frames of a .pvd series, read when they are asked for; its box is what all of them lie in."""

    def __init__(self, series: str | Path):
        self._series, self._last, self._extents = SavedSeries(series), (-1, None), {}
        self.setting = self._series.setting

    def __len__(self) -> int:
        return len(self._series)

    def box(self) -> np.ndarray:
        return self._extent("displacement").box

    def colouring(self, name: str) -> Colouring:
        return self._extent(name).colouring

    def _extent(self, name: str) -> Extent:
        if not self._extents:
            for frame in map(self._series.frame, range(len(self))):
                for known, values in frame.colours.items():
                    self._extents.setdefault(known, Extent(self.mesh, known)).add(frame.positions, values)
        return self._extents[name]

    def frame(self, k: int) -> ShownFrame:
        if self._last[0] != k:
            frame = self._series.frame(k)
            self._last = k, ShownFrame(**vars(frame), notes=[f"smallest J {frame.fields['J'].min():.3g}"])
        return self._last[1]


class LiveFrames(FrameSource):
    """Frames of a `ForwardRun`, made when asked to advance; the last `keep` can be looked at again. Its box is the start's.

    The scene must have an `ExternalForce` on all vertices for the body to be dragged (`can_drag`); its forces are added to.
    """

    def __init__(self, run: "ForwardRun", keep: int = 300):
        self.run, self.setting, sim = run, Setting.of(run.scene), run.simulator
        self._frames, self._limits, self._grip = deque(maxlen=keep), {}, None
        loads = run.scene.term(ExternalForce)
        given = None if loads is None else loads.values.get("external_forces")
        self.can_drag = given is not None and given.shape == self.mesh.vertices.shape
        self._given, self._mass = given, run.scene.inputs.derive(run.scene.inputs.values).mass
        shown = sim.positions[self.mesh.surface_vertices]
        self._box = np.stack([shown.min(0), shown.max(0)])
        if self.setting.ground is not None:
            self._box[0, 1] = min(self._box[0, 1], self.setting.ground)
        self._driven, self.run.before_part = run.driven, self._pull
        self._note(0.0)

    def __len__(self) -> int:
        return len(self._frames)

    def box(self) -> np.ndarray:
        return self._box

    def frame(self, k: int) -> ShownFrame:
        return self._frames[k]

    def colouring(self, name: str) -> Colouring:
        """Their limits span all frames so far, with some room."""
        kind = field_named(name)
        return Colouring(kind.label, kind.limits(*self._limits[name]), kind.colours)

    def advance(self) -> bool:
        """Simulate one frame more."""
        begin = time.perf_counter()
        self.run.advance()
        self._note(self.run.seen.substeps[-1] / (time.perf_counter() - begin))
        return True

    def grab(self, vertex: int, target: ArrayLike) -> None:
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
            self.run.restart_balance()

    def _pull(self) -> None:
        if self._grip is not None:
            sim = self.run.simulator
            sim.set_forces(self._given + self._grip.forces(sim.positions, sim.velocities))

    def _note(self, rate: float) -> None:
        sim, seen = self.run.simulator, self.run.seen
        frame, energy = ShownFrame(**vars(self.run.frame())), sim.compute_energy()
        frame.fields["stiffness"] = field_of(sim, "stiffness")
        for name, values in frame.colours.items():
            shown = to_vertices(self.mesh, values)[self.mesh.surface_vertices]
            low, high = np.percentile(shown, [0.5, 99.5])
            least, most = self._limits.get(name, (low, high))
            if low < least or high > most:  # seldom, so that colours do not flicker
                room = 0.3 * (max(high, most) - min(low, least))
                least, most = (low - room if low < least else least), (high + room if high > most else most)
            self._limits[name] = least, most
        notes = [f"energy {energy:.4g} J", *(f"  {name} {part:.4g} J" for name, part in energy.parts.items())]
        notes.append(f"smallest J {frame.fields['J'].min():.3g}")
        if np.isfinite(seen.gap):
            notes.append(f"smallest gap so far {1000 * seen.gap:.3g} mm")
        notes.append(f"{rate:.0f} steps a second")
        frame.notes = notes
        self._frames.append(frame)
