"""The viewer's window on a virtual display, driven by mouse and keys; needs Xvfb, xdotool and a Vulkan driver."""

import os
import shutil
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from saved_series import Series

from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.visual.painters import has_vulkan

ROOT = Path(__file__).parents[1]
missing = [name for name in ("Xvfb", "xdotool") if shutil.which(name) is None] + ([] if has_vulkan() else ["Vulkan"])
pytestmark = pytest.mark.skipif(bool(missing), reason=f"no {', '.join(missing)} here")

SCRIPT = """
import sys
from diffsim_ti.visual.frame_sources import SavedFrames
from diffsim_ti.visual.viewer import Viewer
view, last = Viewer(SavedFrames(sys.argv[1]), "speed", size=(640, 480)), None
while view.window.running:
    view.draw()
    state = f"{view.at} {view.colour} {view.playing} {view.drawing.camera.position[0]:.3f}"
    if state != last:
        print(state, flush=True)
        last = state
"""


@pytest.fixture(scope="module")
def series(tmp_path_factory):
    """A cube that rises, while its stress goes from nothing to the most."""
    cube = TetrahedralMesh.create_cube(3, 0.2)
    out, ones = Series(tmp_path_factory.mktemp("series"), cube, "cube"), np.ones(cube.num_tetrahedra)
    for k in range(3):
        offset = np.zeros(cube.vertices.shape) + [0, 0.1 * k, 0]
        out.write(
            0.1 * k,
            cube.vertices + offset,
            offset,
            0 * offset,
            SimpleNamespace(von_mises=1e3 * k * ones, energy_density=k * ones, J=ones),
        )
    return out.path


class Screen:
    """A virtual display, the viewer on it, and hands."""

    def __init__(self, folder, series):
        read, write = os.pipe()
        self.folder, self.said = folder, []
        self.server = subprocess.Popen(
            ["Xvfb", "-displayfd", str(write), "-screen", "0", "640x480x24", "-fbdir", folder],
            pass_fds=[write],
            stderr=subprocess.DEVNULL,
        )
        os.close(write)
        with os.fdopen(read) as told:  # to the end of the line: without a reader the server stops
            self.env = os.environ | {"DISPLAY": ":" + told.readline().strip(), "PYTHONPATH": str(ROOT)}
        self.viewer = subprocess.Popen(
            [sys.executable, "-c", SCRIPT, series],
            env=self.env,
            cwd=folder,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        threading.Thread(
            target=lambda: self.said.extend(line.split() for line in self.viewer.stdout), daemon=True
        ).start()
        self.until(lambda state: state[:2] == ["0", "speed"], 60)
        self.window = self.xdotool("search", "--name", "diffsim_ti").split()[0]
        self.xdotool("windowmove", self.window, 0, 0)

    def xdotool(self, *words) -> str:
        return subprocess.run(
            ["xdotool", *map(str, words)], env=self.env, capture_output=True, text=True, check=True
        ).stdout

    def until(self, good, seconds: float = 15.0) -> list:
        """Wait for what the viewer says."""
        end = time.monotonic() + seconds
        while not (self.said and good(self.said[-1])):
            assert self.viewer.poll() is None, f"{self.said} {self.viewer.stderr.read()}"
            assert time.monotonic() < end, f"the viewer said {self.said}"
            time.sleep(0.05)
        return self.said[-1]

    def press(self, x: int, y: int, button: int = 1, to=None) -> None:
        """Press where the window has (x, y), drag, let go; the window must see each."""
        self.xdotool("mousemove", "--window", self.window, x, y, "sleep", 0.3, "mousedown", button, "sleep", 0.3)
        if to:
            self.xdotool("mousemove", "--window", self.window, *to, "sleep", 0.3)
        self.xdotool("mouseup", button)

    def picture(self) -> np.ndarray:
        """What the screen shows, RGB, from the display's xwd file."""
        time.sleep(0.5)
        raw = (Path(self.folder) / "Xvfb_screen0").read_bytes()
        head = struct.unpack(">25I", raw[:100])
        start, width, height, row = head[0] + 12 * head[19], head[4], head[5], head[12]
        pixels = np.frombuffer(raw[start:], np.uint8)[: height * row].reshape(height, row)[:, : 4 * width]
        return pixels.reshape(height, width, 4)[..., 2::-1].astype(float)

    def close(self) -> None:
        for process in (self.viewer, self.server):
            process.kill()
            process.wait()


@pytest.fixture
def screen(series, tmp_path):
    out = Screen(str(tmp_path), str(series))
    yield out
    out.close()


def body(picture) -> np.ndarray:
    """Coloured pixels right of the panel and left of the legend."""
    coloured = np.ptp(picture, axis=-1) > 50
    coloured[:, :210], coloured[:, 470:] = False, False
    return coloured


def test_play_scrub_and_colour_by_stress(screen):
    violet = screen.picture()
    assert body(violet).sum() > 2000
    screen.xdotool("mousemove", "--window", screen.window, 400, 400, "key", "--window", screen.window, "Right")
    screen.until(lambda state: state[0] == "1")
    screen.press(20, 82, to=(138, 82))  # the frame's slider, to its end
    screen.until(lambda state: state[0] == "2")
    screen.press(60, 196)  # the button of von Mises stress
    screen.until(lambda state: state[1] == "von_mises")
    yellow = screen.picture()
    seen = body(yellow)
    assert np.nonzero(seen)[0].mean() < np.nonzero(body(violet))[0].mean() - 20  # it has risen
    before, after = violet[body(violet)].mean(0), yellow[seen].mean(0)
    assert before[2] > before[1] and after[1] > 2 * after[2]  # from nothing to the most of viridis
    eye = float(screen.said[-1][3])
    screen.press(300, 400, button=3, to=(420, 400))
    assert abs(float(screen.until(lambda state: float(state[3]) != eye)[3]) - eye) > 0.05  # it has turned
    screen.press(30, 61)  # play
    screen.until(lambda state: state[2] == "True" and state[0] != "2")
