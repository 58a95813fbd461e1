"""What a notebook shows: tables, pictures and films in place of lines of text (`_repr_html_` of the package's classes).

Drawing is imported when something is drawn, in software, small, and for a few seconds at most.
"""

import base64
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from html import escape
from io import BytesIO
from pathlib import Path

import numpy as np

from diffsim_ti.batch import Batch, BatchFrames
from diffsim_ti.common.brief import brief
from diffsim_ti.identification import Identification
from diffsim_ti.identification.result import ends
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.outputs.modes import Modes
from diffsim_ti.rollout import Frames, Rollout
from diffsim_ti.rollout.simulator import Simulator
from diffsim_ti.scene import Scene
from diffsim_ti.state.solve_report import SolveReport
from diffsim_ti.verify import GradientReport

SIZE, MOST, PATIENCE = (480, 360), 24, 3.0  # pixels; frames of a film; seconds after which no more are drawn
MANY = 200_000  # tetrahedra of which no picture is drawn by itself


def table(rows: Iterable[Sequence], head: Sequence[str] = ()) -> str:
    """Rows of text as an HTML table."""

    def line(cells: Iterable, kind: str) -> str:
        begin, end = f'<{kind} style="text-align:left">', f"</{kind}>"
        return f"<tr>{''.join(begin + escape(str(x)) + end for x in cells)}</tr>"

    return f"<table>{line(head, 'th') if head else ''}{''.join(line(row, 'td') for row in rows)}</table>"


def of_lines(text: str) -> str:
    """What `describe` says, "name: value" by lines, as a table; its first lines are the mesh, the material and the mass."""
    rows, unnamed = [], iter(("mesh", "material"))
    for line in text.splitlines():
        name, colon, value = line.partition(": ")
        named = colon and "(" not in name
        rows.append((name, value) if named else (next(unnamed, ""), line))
    return table(rows)


def _film(scene: Scene, moments: Iterable, suffix: str) -> str:
    """An <img> of frames (visual/frame.py) of a scene, as many as are drawn within PATIENCE."""
    from diffsim_ti.writers import View, open_writer

    if scene.mesh.num_tetrahedra > MANY:
        return ""
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"shown{suffix}"
        with open_writer(path, scene, View(size=SIZE, colour="displacement", fps=10.0)) as out:
            for moment in moments:
                out.write(moment)
                if time.perf_counter() - begin > PATIENCE:
                    break
        return _img(path.read_bytes(), suffix)


def _img(data: bytes, suffix: str) -> str:
    return f'<img src="data:image/{suffix[1:]};base64,{base64.b64encode(data).decode()}" width="{SIZE[0]}"/>'


def _still(scene: Scene, positions: np.ndarray, at: float = 0.0, step: int = 0, values: dict | None = None) -> str:
    """A picture of a scene with the body at positions [m], coloured by displacement."""
    from diffsim_ti.obstacles import obstacle_surfaces
    from diffsim_ti.visual.frame import Frame, marks_of

    u = positions - scene.inputs.values["rest_positions"]
    around = [points for points, _ in obstacle_surfaces(scene, at)] if scene.moving else None
    fields = dict(displacement=np.linalg.norm(u, axis=1))
    marks = marks_of(scene, positions, at, step, values)
    return _film(scene, [Frame(at, positions, u, np.zeros_like(u), fields, around, marks)], ".png")


def of_mesh(self: TetrahedralMesh) -> str:
    """Counts, sizes, sets; a picture."""
    from PIL import Image

    from diffsim_ti.visual.drawing import Drawing

    text = of_lines(self.describe())
    if self.num_tetrahedra > MANY:
        return text
    buffer = BytesIO()
    with Drawing(self, SIZE, backend="software", wireframe=self.num_tetrahedra < 20_000) as drawing:
        Image.fromarray(drawing.image(self.vertices)).save(buffer, "PNG")
    return text + _img(buffer.getvalue(), ".png")


def of_scene(self: Scene) -> str:
    """What is simulated; the start as a picture."""
    return of_lines(self.describe()) + _still(self, self.inputs.values["initial_positions"])


def of_simulator(self: Simulator) -> str:
    """What is simulated, how, how far; the present state as a picture."""
    text = of_lines(f"{self.describe()}\ntime: {self.time:.6g} s, step {self.step_count}")
    return text + _still(self.scene, self.positions.astype(np.float64), self.time, self.step_count, self.values)


def of_rollout(self: Rollout) -> str:
    """What is run and what is kept."""
    rows = [
        ("solver", self.solver.describe()),
        ("steps", f"{self.steps}, {self.num_frames} frames, to {float(self.times[-1]):.6g} s"),
        ("outputs", ", ".join(self.outputs)),
        ("gradients", ", ".join(self.wanted) or "none"),
        ("kept for them", f"{self.memory:.3g} MB"),
    ]
    return table(rows) + of_lines(self.scene.describe())


def _of_outputs(states: dict) -> str:
    return table([(name, brief(x)) for name, x in states.items()], ("output", "shape and range"))


STATES = "positions", "velocities", "displacements"


def of_frames(self: Frames) -> str:
    """What the frames hold; a film, or a picture of the end."""
    text = f"{len(self.times)} frames, t = {self.times[0]:.6g} to {self.times[-1]:.6g} s"
    text += "" if self.alive else f"; stopped: {self.error}"
    text = escape(text) + _of_outputs({name: getattr(self, name) for name in STATES} | self.outputs)
    if self.scene is None:
        return text
    from diffsim_ti.visual.frame import Frame

    shown = np.unique(np.linspace(0, len(self.times) - 1, MOST).round().astype(int))
    chosen, suffix = (shown, ".gif") if len(self.times) > 2 else (shown[-1:], ".png")
    return text + _film(self.scene, (Frame.of_run(self.scene, self, int(k)) for k in chosen), suffix)


def of_batch(self: Batch) -> str:
    """How many scenes, and what each is."""
    how = "side by side" if self.lanes else f"one after another: {self.why_not}"
    return table([("scenes", f"{self.num_scenes}, {how}")]) + of_rollout(self.one)


def of_batch_frames(self: BatchFrames) -> str:
    """What the frames of all scenes hold, and which stopped."""
    dead = np.flatnonzero(~self.alive)
    text = f"{len(self)} scenes, {len(self.times)} frames, to {self.times[-1]:.6g} s"
    text += f"; stopped before the end: {brief(dead)}" if dead.size else ""
    return escape(text) + _of_outputs({name: getattr(self, name) for name in STATES} | self.outputs)


def of_identification(self: Identification) -> str:
    """Numbers with intervals, after what is to be known first."""
    *_, last = str(self).splitlines()
    head = f"<p><b>{escape(self.headline)}</b></p>" if self.headline else ""
    rows = [(label, f"{x:.6g}") for label, x in zip(self.labels, self.numbers)]
    if self.intervals is not None and self.residuals_fit:
        errors = np.concatenate([np.atleast_1d(x) for x in self.standard_errors.values()])
        rows = [(*r, f"{e:.2g}", f"{a:.6g} .. {b:.6g}") for r, e, a, b in zip(rows, errors, *ends(self.intervals))]
    return f"{head}{table(rows, ('unknown', 'estimate', 'standard error', '95 %'))}<p>{escape(last)}</p>"


def of_modes(self: Modes) -> str:
    """Frequencies."""
    return table([(k, f"{f:.6g}") for k, f in enumerate(self.frequencies)], ("mode", "frequency [Hz]"))


def of_report(self: SolveReport) -> str:
    """The latest steps, after what all took."""
    rows = [(s.step, s.iterations, f"{s.residual:.2g}", s.cuts, f"{s.seconds:.3g}") for s in list(self.steps)[-10:]]
    head = ("step", "Newton iterations", "residual", "cuts", "seconds")
    return f"<p>{escape(str(self))}</p>" + (table(rows, head) if rows else "")


def of_gradient_report(self: GradientReport) -> str:
    """A row for each input."""
    rows = [
        (r.input, f"{r.analytic:.8g}", f"{r.differences:.8g}", f"{r.relative_error:.1e}", r.verdict) for r in self.rows
    ]
    notes = "".join(f"<p>{escape(note)}</p>" for note in self.notes)
    return table(rows, ("input", "analytic", "differences", "relative error", "verdict")) + notes


FORMS: dict[type, Callable] = {
    TetrahedralMesh: of_mesh,
    Scene: of_scene,
    Simulator: of_simulator,
    Rollout: of_rollout,
    Frames: of_frames,
    Batch: of_batch,
    BatchFrames: of_batch_frames,
    Identification: of_identification,
    Modes: of_modes,
    SolveReport: of_report,
    GradientReport: of_gradient_report,
}
METHOD = "_repr_html_"  # what IPython asks an object for
for kind, form in FORMS.items():
    setattr(kind, METHOD, form)
