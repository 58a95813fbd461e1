"""SimulationVisualizer: a window that shows a moving body, or a picture file where there is no display."""

import os
import sys
from pathlib import Path

import numpy as np

from diffsim_ti import runtime


class SimulationVisualizer:
    """Shows a mesh whose positions change: `update(positions)` while it runs, `show()` at the end.

    With a display and a Vulkan driver: a Taichi window (right button turns, W A S D move, Escape closes). Otherwise
    `show()` writes a PNG to `path` and prints where. `has_window` says which.
    """

    def __init__(self, mesh, path="output/simulation.png", title: str = "diffsim_ti", ground: float | None = None):
        self.mesh, self.path, self.ground = mesh, Path(path), ground
        self.positions = np.array(mesh.vertices)
        self.window = _open(title)
        if self.window is not None:
            self._scene = _Scene(self.window, mesh)

    @property
    def has_window(self) -> bool:
        return self.window is not None

    def update(self, positions) -> None:
        """Show these positions [m], shape (num_vertices, 3), a NumPy array or what becomes one."""
        positions = np.asarray(positions, np.float64)
        if positions.shape != self.mesh.vertices.shape:
            raise ValueError(f"positions: expected shape {self.mesh.vertices.shape}, got {positions.shape}")
        self.positions = positions.copy()
        if self.has_window and self.window.running:
            self._scene.draw(self.positions)

    def show(self) -> None:
        """Keep the window open until it is closed; without one, write the picture and print its path."""
        if not self.has_window:
            from diffsim_ti.picture import save_picture

            self.path.parent.mkdir(parents=True, exist_ok=True)
            save_picture(self.path, self.mesh, self.positions, ground=self.ground)
            print(f"no display: picture written to {self.path}")
            return
        while self.window.running:
            self._scene.draw(self.positions)


def _open(title: str):
    """A window, or None where none can be had."""
    has_display = sys.platform in ("win32", "darwin") or any(os.environ.get(n) for n in ("DISPLAY", "WAYLAND_DISPLAY"))
    if not has_display or "vulkan" not in runtime.available_archs():
        return None
    import taichi as ti

    runtime.program()
    try:
        return ti.ui.Window(title, (1024, 768), vsync=True)
    except RuntimeError:  # a display that cannot be reached
        return None


class _Scene:
    """The window's camera, light and arrays."""

    def __init__(self, window, mesh):
        import taichi as ti

        self.window, self.canvas, self.scene, self.camera = window, window.get_canvas(), window.get_scene(), ti.ui.Camera()
        self.at = ti.Vector.field(3, ti.f32, mesh.num_vertices)
        triangles = np.ascontiguousarray(mesh.surface_triangles, np.int32).reshape(-1)
        self.triangles = ti.field(ti.i32, triangles.size)
        self.triangles.from_numpy(triangles)
        low, high = mesh.bounding_box
        center, size = (low + high) / 2, float(np.linalg.norm(high - low))
        self.camera.position(*(center + size * np.array([0.8, 0.5, 1.6])))
        self.camera.lookat(*center)
        self.light = tuple(center + 3 * size * np.array([-0.5, 1.0, 0.6]))
        self.speed = 0.02 * size

    def draw(self, positions: np.ndarray) -> None:
        import taichi as ti

        if self.window.is_pressed(ti.ui.ESCAPE):
            self.window.running = False
        self.at.from_numpy(positions.astype(np.float32))
        self.camera.track_user_inputs(self.window, movement_speed=self.speed, hold_key=ti.ui.RMB)
        self.scene.set_camera(self.camera)
        self.scene.ambient_light((0.4, 0.4, 0.4))
        self.scene.point_light(self.light, (0.8, 0.8, 0.8))
        self.scene.mesh(self.at, indices=self.triangles, color=(0.33, 0.55, 0.80), two_sided=True)
        self.canvas.set_background_color((0.97, 0.97, 0.98))
        self.canvas.scene(self.scene)
        self.window.show()
