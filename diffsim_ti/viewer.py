"""Viewer: a window on a body's frames, saved or being computed: play, step, scrub, colour, turn.

Space plays and pauses, the arrows step, R resets, W shows edges; the right button turns, + and - zoom, Escape
closes. Frames are drawn as pictures are (`Drawing`), so the window shows what a film would.
"""

import time

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.colouring import Colouring
from diffsim_ti.drawing import Drawing
from diffsim_ti.film import extent, read_frame, rest_of
from diffsim_ti.series_fields import field_named, values_of

STRIDE = 2  # the backdrop is drawn this much smaller and stretched


class Viewer:
    """Shows frames in a Taichi window; RuntimeError where there is none to be had.

    source: what gives frames: `len(source)`, `source.frame(k)` -> (time [s], positions [m], {field: values}, notes), where
    notes are lines of text, and `source.colouring(field)`, the same for all frames.
    look: what `Drawing` takes (ground, obstacles, fixed, box, wireframe ...).
    """

    def __init__(self, mesh, source, colour: str = "von_mises", title: str = "diffsim_ti", size=(1024, 768), **look):
        field_named(colour)
        self.window = open_window(title, size)
        if self.window is None:
            raise RuntimeError("there is no display with a Vulkan driver; use `diffsim-ti render` to draw a film instead")
        from diffsim_ti.vulkan_painter import Canvas

        self.source, self.colour, self.size = source, colour, size
        self._drawing, self._canvas = Drawing(mesh, size, backend="software", **look), Canvas(self.window)
        self._small = Drawing(mesh, tuple(n // STRIDE for n in size), backend="software", **look)
        self.at, self.playing, self.speed = 0, False, 1.0
        self._colourings, self._cursor, self._clock, self._rate = {}, None, time.perf_counter(), 0.0

    def run(self) -> None:
        """Until the window is closed."""
        while self.window.running:
            self.draw()

    def draw(self) -> None:
        """One refresh: keys, mouse, time, picture, panel."""
        self._keys()
        self._mouse()
        self._play()
        when, positions, fields, notes = self.source.frame(self.at)
        drawing = self._drawing
        values = fields.get(self.colour)
        if values is not None:
            if self.colour not in self._colourings:
                self._colourings[self.colour] = self.source.colouring(self.colour)
            drawing.colouring = self._colourings[self.colour]
        soup, shapes = drawing.soup(positions, values)
        self._small.camera = drawing.camera
        self._canvas.draw(soup, self._small._backdrop.image(drawing.camera, shapes), self.size)
        self._panel(when, fields, notes)
        self.window.show()

    def _keys(self) -> None:
        import taichi as ti

        for event in self.window.get_events(ti.ui.PRESS):
            if event.key == ti.ui.ESCAPE:
                self.window.running = False
            elif event.key == ti.ui.SPACE:
                self.playing = not self.playing
            elif event.key in (ti.ui.LEFT, ti.ui.RIGHT):
                self._go(self.at + (1 if event.key == ti.ui.RIGHT else -1))
            elif event.key == "r":
                self._go(0)
            elif event.key == "w":
                self._drawing.wireframe = not self._drawing.wireframe
            elif event.key in ("+", "=", "-"):
                self._drawing.camera = self._drawing.camera.zoomed(1 / 1.1 if event.key == "-" else 1.1)

    def _mouse(self) -> None:
        import taichi as ti

        cursor = np.array(self.window.get_cursor_pos())
        if self.window.is_pressed(ti.ui.RMB) and self._cursor is not None:
            move = cursor - self._cursor
            if np.any(move):
                self._drawing.camera = self._drawing.camera.orbited(-180 * move[0], -120 * move[1])
        self._cursor = cursor

    def _go(self, k: int) -> None:
        self.playing, self.at = False, int(np.clip(k, 0, len(self.source) - 1))

    def _play(self) -> None:
        now = time.perf_counter()
        if self.playing and now - self._clock >= 1 / (30 * self.speed):
            self._rate = 0.9 * self._rate + 0.1 / max(now - self._clock, 1e-9)
            self._clock, self.at = now, self.at + 1
            if self.at >= len(self.source):
                self.at = 0

    def _panel(self, when: float, fields: dict, notes) -> None:
        height = 0.02 + 0.032 * (7 + len(fields) + len(notes))
        with self.window.get_gui().sub_window("diffsim_ti", 0.01, 0.01, 0.3, height) as gui:
            gui.text(f"t = {when:.4f} s, frame {self.at} of {len(self.source) - 1}, {self._rate:.0f} a second")
            if gui.button("pause" if self.playing else "play"):
                self.playing = not self.playing
            chosen = gui.slider_int("frame", self.at, 0, max(len(self.source) - 1, 1))
            if chosen != self.at:
                self._go(chosen)
            self.speed = gui.slider_float("speed", self.speed, 0.1, 4.0)
            self._drawing.wireframe = gui.checkbox("edges", self._drawing.wireframe)
            for name in fields:
                if gui.button(("* " if name == self.colour else "  ") + field_named(name).label):
                    self.colour = name
            if self.colour in self._colourings:
                low, high = self._colourings[self.colour].limits
                gui.text(f"colours from {low:.3g} to {high:.3g}")
            for line in notes:
                gui.text(line)


def open_window(title: str, size):
    """A window, or None where none can be had."""
    import os
    import sys

    has_display = sys.platform in ("win32", "darwin") or any(os.environ.get(n) for n in ("DISPLAY", "WAYLAND_DISPLAY"))
    if not has_display or "vulkan" not in runtime.available_archs():
        return None
    import taichi as ti

    runtime.program()
    try:
        return ti.ui.Window(title, tuple(size), vsync=True)
    except RuntimeError:  # a display that cannot be reached
        return None


class SavedFrames:
    """Frames of a .pvd series, read when they are asked for."""

    def __init__(self, series):
        from diffsim_ti.series import frames_of

        self._frames, self._last, self._mesh = frames_of(series), (-1, None), None
        if not self._frames:
            raise ValueError(f"{series}: must list at least one frame, lists none; run the simulation first")

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def mesh(self):
        """The body at rest."""
        self._mesh = self._mesh or rest_of(self._frames[0][1])
        return self._mesh

    def box(self) -> np.ndarray:
        """What all frames lie in, shape (2, 3) [m]."""
        return extent(self.mesh, self._frames, "displacement", field_named("displacement"))[0]

    def colouring(self, name: str) -> Colouring:
        """Colours whose limits span all frames."""
        field = field_named(name)
        return Colouring(field.label, extent(self.mesh, self._frames, name, field)[1], field.colours)

    def frame(self, k: int):
        if self._last[0] != k:
            when, path = self._frames[k]
            frame = read_frame(path)
            names = ("displacement", "speed", "von_mises", "energy_density", "J")
            fields = {name: values_of(frame, name) for name in names}
            self._last = k, (when, frame.points, fields, [f"smallest J {fields['J'].min():.3g}"])
        return self._last[1]
