"""Drawing triangles through Vulkan: a Taichi window that no display shows.

Triangles go through `canvas.triangles`, sorted from far to near: `scene.mesh` has a depth buffer, but keeps 0.3 MB of
memory for every mesh of every frame (Taichi 1.7.4), where this keeps none.
"""

import atexit
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.visual.surface import Soup

if TYPE_CHECKING:
    from taichi.ui import Window


SUPERSAMPLING = 2
_open: "list[VulkanPainter]" = []  # two hidden windows at once end in a crash when the process exits


def has_vulkan() -> bool:
    """Whether a Vulkan driver can be had (Mesa's lavapipe is one in software)."""
    return "vulkan" in runtime.available_archs()


class Canvas:
    """A Taichi window's canvas with arrays for a background and for triangles, made once and reused."""

    def __init__(self, window: "Window"):
        self.window, self.canvas = window, window.get_canvas()
        self._room, self._image = 0, None

    def draw(self, soup: Soup, background: np.ndarray, size: tuple[int, int]) -> None:
        """Put triangles, in pixels of a picture of `size`, over a background of any size (it is stretched)."""
        import taichi as ti

        height, width = background.shape[:2]
        if self._image is None or self._image.shape != (width, height):
            self._image = ti.Vector.field(3, ti.f32, (width, height))
        self._image.from_numpy(np.ascontiguousarray(background[::-1].transpose(1, 0, 2), np.float32))
        self.canvas.set_image(self._image)
        if len(soup.corners) > self._room:
            self._room = max(1024, 2 * len(soup.corners))
            self._at, self._colours = (ti.Vector.field(k, ti.f32, 3 * self._room) for k in (2, 3))
        order = np.argsort(-soup.distance, kind="stable")
        at, colours = (np.zeros((3 * self._room, k), np.float32) for k in (2, 3))
        at[: 3 * len(order)] = (soup.corners[order, :, :2] / size).reshape(-1, 2)
        at[:, 1] = 1 - at[:, 1]
        colours[: 3 * len(order)] = soup.colours[order].reshape(-1, 3)
        self._at.from_numpy(at)
        self._colours.from_numpy(colours)
        self.canvas.triangles(self._at, per_vertex_color=self._colours)


class VulkanPainter:
    """Paints triangles over a background in a hidden window. Making another closes it; RuntimeError without Vulkan."""

    name = "Vulkan"

    def __init__(self, size: tuple[int, int]):
        import taichi as ti

        while _open:
            _open[0].close()
        self.size = tuple(size)
        runtime.program()
        with settings_elsewhere():
            window = ti.ui.Window("diffsim_ti", tuple(SUPERSAMPLING * n for n in size), show_window=False)
        self._window, self._canvas = window, Canvas(window)
        _open.append(self)

    def paint(self, soup: Soup, background: np.ndarray) -> np.ndarray:
        """RGB in [0, 1], float32 (height, width, 3); soup in pixels of this size."""
        if self._window is None:
            raise RuntimeError("this drawing was closed, or another took the one hidden window; make a new one")
        self._canvas.draw(soup, background, self.size)
        s, (width, height) = SUPERSAMPLING, self.size
        seen = self._window.get_image_buffer_as_numpy()
        seen = sum(seen[i::s, j::s, :3] for i in range(s) for j in range(s)) / s**2
        return seen.reshape(width, height, 3).transpose(1, 0, 2)[::-1]

    def close(self) -> None:
        """Destroy the window."""
        if self._window is not None:
            with settings_elsewhere():
                self._window.destroy()
            self._window = self._canvas = None
            _open.remove(self)


@atexit.register
def _close_all() -> None:
    while _open:
        _open[0].close()


@contextmanager
def settings_elsewhere() -> Iterator[None]:
    """The window's toolkit leaves an imgui.ini in the working directory; let that be a temporary one."""
    here = os.getcwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            yield
        finally:
            os.chdir(here)
