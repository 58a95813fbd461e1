"""Viewer: a window on a body's frames, saved or being computed: play, step, scrub, colour, turn, pull.

Space plays and pauses, the arrows step, R goes to the first frame, W shows edges, C changes the colours, S saves; the right
button turns, the left one pulls a body that is being simulated, + and - zoom, Escape closes. Frames are drawn as pictures
are (`Drawing`), so the window shows what a film would. At the end: what takes hold of a body with the mouse.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti import runtime
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.visual.colouring import field_named
from diffsim_ti.visual.drawing import Drawing
from diffsim_ti.visual.frame import results_as_arrows
from diffsim_ti.visual.surface import Soup, marks

if TYPE_CHECKING:
    from taichi.ui import Window

    from diffsim_ti.visual.frame_sources import FrameSource
    from diffsim_ti.writers import Writer


STRIDE = 2  # the backdrop is drawn this much smaller and stretched
NO_DISPLAY = "there is no display with a Vulkan driver; use `diffsim-ti render` to draw a film instead"
PANEL = (0.01, 0.01, 0.3)  # left, top and width of the panel, as shares of the window
RATE, FASTEST = 15.0, 150.0  # of the whole body on the spring, and at most of what is held [1/s]
REACH = 0.2  # radius of what is held, as a share of the body's size
NEAR = 1e-12  # a ray along a triangle does not meet it


class Viewer:
    """Shows a source's frames (frame_sources.py) in a Taichi window; RuntimeError where there is none to be had.

    colour: the field to begin with; playing: whether to play at once; output: what `save` writes the frames with
    (writers/); arrows: names of forces that frames hold, to be drawn as arrows; look: what `Drawing` takes, instead of
    the source's. Raises ValueError for a force that they have not.
    """

    def __init__(
        self,
        source: "FrameSource",
        colour: str = "von_mises",
        title: str = "diffsim_ti",
        size: tuple[int, int] = (1024, 768),
        playing: bool = False,
        output: "Writer | None" = None,
        arrows: Sequence[str] = (),
        **look,
    ):
        field_named(colour)
        self.window = open_window(title, size)
        if self.window is None:
            raise RuntimeError(NO_DISPLAY)
        from diffsim_ti.visual.painters import Canvas

        self.source, self.colour, self.size, self.output, self._saved = source, colour, tuple(size), output, ""
        self.arrows, self._drawn = tuple(arrows), (None, [])
        look = source.look | look
        self.drawing, self._canvas = Drawing(source.mesh, size, backend="software", **look), Canvas(self.window)
        self._small = Drawing(source.mesh, tuple(n // STRIDE for n in size), backend="software", **look)
        self.at, self.playing, self.speed = 0, playing, 1.0
        self._cursor, self._clock, self._rate, self._panel_height = np.full(2, np.nan), time.perf_counter(), 0.0, 0.0
        # the vertex that the mouse holds, how far from the eye [m]
        self.held, self._depth, self._pressed = None, 0.0, False

    def run(self) -> None:
        """Until the window is closed."""
        while self.window.running:
            self.draw()

    def draw(self) -> None:
        """One refresh: keys, mouse, time, picture, panel."""
        self._keys()
        self._mouse()
        self._play()
        frame, drawing = self.source.frame(self.at), self.drawing
        values = frame.colours.get(self.colour)
        if values is not None:
            drawing.colouring = self.source.colouring(self.colour)
        soup, shapes = drawing.soup(frame.positions, values, None, frame.obstacles, self._marks(frame))
        if self.held is not None:
            ends = np.stack([frame.positions[self.held], self._under_cursor()])
            soup = Soup.joined([soup, marks(ends, drawing.camera, self.size, 0.008 * self.size[1], 0.5 * self._depth)])
        self._canvas.draw(soup, self._behind(shapes, values is not None), self.size)
        self._panel(frame)
        self.window.show()

    def _marks(self, frame) -> list:
        """What is drawn of its loads and forces, made once."""
        if self._drawn[0] is not frame:
            self._drawn = frame, [*frame.marks, *results_as_arrows(frame, self.source.mesh, self.arrows)]
        return self._drawn[1]

    def _behind(self, shapes, coloured: bool) -> np.ndarray:
        """The floor with its shadows, and the legend."""
        self._small.camera, self._small.colouring = self.drawing.camera, self.drawing.colouring
        image = np.array(self._small.backdrop(shapes))
        if coloured:
            self._small.add_legend(image)
        return image

    # ---- input ------------------------------------------------------------------------------------------------------

    def _keys(self) -> None:
        import taichi as ti

        for event in self.window.get_events(ti.ui.PRESS):
            if event.key == ti.ui.ESCAPE:
                self.window.running = False
            elif event.key == ti.ui.SPACE:
                self.playing = not self.playing
            elif event.key in (ti.ui.LEFT, ti.ui.RIGHT):
                self.go(self.at + (1 if event.key == ti.ui.RIGHT else -1))
            elif event.key == "r":
                self.go(0)
            elif event.key == "w":
                self.drawing.wireframe = not self.drawing.wireframe
            elif event.key == "c":
                names = list(self.source.frame(self.at).colours)
                self.colour = names[(names.index(self.colour) + 1) % len(names)] if self.colour in names else names[0]
            elif event.key == "s" and self.output is not None:
                self.save()
            elif event.key in ("+", "=", "-"):
                self.drawing.camera = self.drawing.camera.zoomed(1 / 1.1 if event.key == "-" else 1.1)

    def _mouse(self) -> None:
        import taichi as ti

        before, self._cursor = self._cursor, np.array(self.window.get_cursor_pos())
        move = self._cursor - before
        if self.window.is_pressed(ti.ui.RMB) and np.any(move) and np.all(np.isfinite(move)):
            self.drawing.camera = self.drawing.camera.orbited(-180 * move[0], -120 * move[1])
        pressed = self.window.is_pressed(ti.ui.LMB)
        left, top, width = PANEL
        x, y = self._cursor[0] - left, 1 - self._cursor[1] - top
        on_panel = 0 <= x <= width and 0 <= y <= self._panel_height
        if pressed and not self._pressed and not on_panel:
            self.grab()
        elif not pressed and self.held is not None:
            self.held = None
            self.source.release()
        if self.held is not None:
            self.source.grab(self.held, self._under_cursor())
        self._pressed = pressed

    def _ray(self) -> np.ndarray:
        """Unit direction from the eye through the cursor, which counts from the lower left, in shares of the window."""
        column, row = self._cursor[0] * self.size[0], (1 - self._cursor[1]) * self.size[1]
        return self.drawing.camera.rays(np.array([column]), np.array([row]), self.size)[0]

    def grab(self) -> None:
        """Take hold of the vertex under the cursor, if the source can be pulled and there is one."""
        if not self.source.can_drag:
            return
        self.at = len(self.source) - 1  # only the present can be pulled
        positions, camera = self.source.frame(self.at).positions, self.drawing.camera
        self.held = picked_vertex(camera.position, self._ray(), positions, self.source.mesh.surface_triangles)
        if self.held is not None:
            self._depth = float((camera.position - positions[self.held]) @ camera.axes[2])

    def _under_cursor(self) -> np.ndarray:
        """The point under the cursor as far from the picture plane as the vertex was when it was grabbed [m]."""
        ray, camera = self._ray(), self.drawing.camera
        return camera.position + ray * (self._depth / -(ray @ camera.axes[2]))

    # ---- time -------------------------------------------------------------------------------------------------------

    def go(self, k: int) -> None:
        """Stop at frame k; one step beyond the last makes another, if the source can."""
        if k == len(self.source) and self.source.advance():
            k = len(self.source) - 1
        self.playing, self.at = False, int(np.clip(k, 0, len(self.source) - 1))

    def _play(self) -> None:
        now = time.perf_counter()
        if self.playing and now - self._clock >= 1 / (30 * self.speed):
            self._rate = 0.9 * self._rate + 0.1 / max(now - self._clock, 1e-9)
            self._clock = now
            if self.at == len(self.source) - 1:
                self.at = len(self.source) - 1 if self.source.advance() else 0
            else:
                self.at += 1

    # ---- saving -----------------------------------------------------------------------------------------------------

    def save(self) -> None:
        """Write the source's frames, with the present camera and colours if the format has such."""
        out, drawing, last = self.output, self.drawing, len(self.source) - 1
        look = dict(colour=self.colour, camera=drawing.camera, wireframe=drawing.wireframe, arrows=self.arrows)
        if last:  # a film keeps the run's time
            look["fps"] = last / (self.source.frame(last).time - self.source.frame(0).time)
        out.view = replace(out.view, **look)
        out.open(self.source.setting)
        with out:
            for k in range(len(self.source)):
                out.write(self.source.frame(k))
        self._saved = f"saved {out.describe()}"

    # ---- panel ------------------------------------------------------------------------------------------------------

    def _panel(self, frame) -> None:
        left, top, width = PANEL
        saving = self.output is not None
        key = [text for text, _ in self.drawing.key(self._marks(frame))]
        notes = [*frame.notes, *key, *filter(None, [self._saved])]
        self._panel_height = 0.02 + 0.032 * (7 + saving + len(frame.colours)) + 0.024 * len(notes)
        with self.window.get_gui().sub_window("diffsim_ti", left, top, width, self._panel_height) as gui:
            gui.text(f"t = {frame.time:.4f} s, frame {self.at} of {len(self.source) - 1}, {self._rate:.0f} a second")
            if gui.button("pause" if self.playing else "play"):
                self.playing = not self.playing
            chosen = gui.slider_int("frame", self.at, 0, max(len(self.source) - 1, 1))
            if chosen != self.at:
                self.go(min(chosen, len(self.source) - 1))
            self.speed = gui.slider_float("speed", self.speed, 0.1, 4.0)
            self.drawing.wireframe = gui.checkbox("edges", self.drawing.wireframe)
            for name in frame.colours:
                if gui.button(("* " if name == self.colour else "  ") + field_named(name).label):
                    self.colour = name
            if self.colour in frame.fields:
                low, high = self.source.colouring(self.colour).limits
                gui.text(f"colours from {low:.3g} to {high:.3g}")
            for line in notes:
                gui.text(line)
            if saving and gui.button("save"):
                self.save()


def has_display() -> bool:
    """Whether there seem to be a screen and a Vulkan driver."""
    import os
    import sys

    screen = sys.platform in ("win32", "darwin") or any(os.environ.get(n) for n in ("DISPLAY", "WAYLAND_DISPLAY"))
    return screen and "vulkan" in runtime.available_archs()


def open_window(title: str, size: tuple[int, int]) -> "Window | None":
    """A window, or None where none can be had."""
    if not has_display():
        return None
    import taichi as ti

    runtime.program()
    try:
        return ti.ui.Window(title, tuple(size), vsync=True)
    except RuntimeError:  # a display that cannot be reached
        return None


def picked_vertex(origin: ArrayLike, ray: ArrayLike, points: np.ndarray, triangles: np.ndarray) -> int | None:
    """The corner next to where a ray first enters a surface, or None if it misses.

    origin [m] and ray (unit), shape (3,); points [m], shape (k, 3); triangles, shape (n, 3), seen from outside only.
    Moller, Trumbore, Fast, minimum storage ray-triangle intersection, doi:10.1080/10867651.1997.10487468.
    """
    a, b, c = (points[triangles[:, k]] for k in range(3))
    p = np.cross(ray, c - a)
    determinant = np.einsum("nd,nd->n", b - a, p)  # > 0: the triangle faces the eye
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.einsum("nd,nd->n", origin - a, p) / determinant
        q = np.cross(origin - a, b - a)
        v = q @ ray / determinant
        along = np.einsum("nd,nd->n", c - a, q) / determinant
        hit = (determinant > NEAR * np.ptp(points, 0).max() ** 2) & (u >= 0) & (v >= 0) & (u + v <= 1) & (along > 0)
    if not hit.any():
        return None
    first = np.flatnonzero(hit)[np.argmin(along[hit])]
    corners = triangles[first]
    return int(corners[np.argmin(np.linalg.norm(points[corners] - (origin + along[first] * ray), axis=1))])


class Grip:
    """A spring between a vertex, with the matter around it, and a point that the mouse moves.

    mesh: the body; mass [kg], shape (num_vertices,); vertex: the one that was picked; target [m]: where it is pulled to.
    Forces on the vertices are those of a critically damped spring on what is held, w m (r^2 (target - x_vertex) - 2 r v),
    w = exp(-(distance / reach)^2) at rest; r follows from sum(w m) r^2 = RATE^2 times the body's mass, up to FASTEST: any
    body can be lifted, and no step that animates it is too long.
    """

    def __init__(self, mesh: TetrahedralMesh, mass: np.ndarray, vertex: int):
        size = float(np.ptp(mesh.bounding_box, 0).max())
        away = np.linalg.norm(mesh.vertices - mesh.vertices[vertex], axis=1)
        self.vertex, self.longest, self.target = vertex, size, None
        self.held = mass * np.exp(-((away / (REACH * size)) ** 2))
        self.rate = min(RATE * float(np.sqrt(mass.sum() / self.held.sum())), FASTEST)

    def forces(self, positions: np.ndarray, velocities: np.ndarray) -> np.ndarray:
        """Forces [N], shape (num_vertices, 3); zero without a target, and those of at most the body's size when further."""
        if self.target is None:
            return np.zeros(positions.shape)
        pull = self.target - positions[self.vertex]
        pull = pull * min(1.0, self.longest / max(np.linalg.norm(pull), 1e-300))
        return self.held[:, None] * (self.rate**2 * pull - 2 * self.rate * velocities)
