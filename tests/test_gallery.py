"""The gallery: its commands are those of the examples, its pictures are there, and making one small keeps what it shows."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

ROOT = Path(__file__).parents[1]


STRIPED = """
import sys, numpy as np
from pathlib import Path
from PIL import Image
Path("output").mkdir()
rows = np.zeros((60, int(sys.argv[2]), 3), np.uint8)
rows[::8] = 255
Image.fromarray(rows).save("output/striped.png")
"""


@pytest.fixture(scope="module")
def gallery():
    spec = importlib.util.spec_from_file_location("gallery", ROOT / "examples" / "gallery.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def pictures():
    return sorted((ROOT / "assets" / "pictures").glob("gallery_*"))


def test_every_picture_is_there_small_and_not_blank(gallery):
    made = {f"gallery_{Path(name).name}{Path(file).suffix}" for name, (_, file) in gallery.EXAMPLES.items()}
    assert {p.name for p in pictures()} == made
    assert sum(p.stat().st_size for p in (ROOT / "assets" / "pictures").iterdir()) < 5e6
    for path in pictures():
        with Image.open(path) as image:
            frames = [np.asarray(frame.convert("RGB"), float) for frame in ImageSequence.Iterator(image)]
        assert frames[0].shape[1] <= 600 and frames[0].std() > 8, path.name
        if path.suffix == ".gif":
            assert len(frames) >= 20 and np.abs(frames[0] - frames[-1]).max(-1).mean() > 1, path.name  # it moves


def test_pages_show_each_with_its_command(gallery):
    readme = "".join((ROOT / "examples" / page).read_text() for page in ("README.md", "benchmarks/README.md"))
    shown = set(re.findall(r"assets/pictures/(gallery_\w+\.\w+)", readme))
    assert shown == {p.name for p in pictures()}
    for name in gallery.EXAMPLES:
        assert gallery.command(name) in readme


def test_commands_run_the_examples(gallery, tmp_path, monkeypatch):
    """In a process of its own, in a folder of its own, with the arguments of the table; by a script that only draws."""
    monkeypatch.setattr(gallery, "HERE", tmp_path)
    monkeypatch.setitem(gallery.EXAMPLES, "striped", ("--width 900", "striped.png"))
    (tmp_path / "striped.py").write_text(STRIPED)
    made = gallery.make("striped", tmp_path)
    with Image.open(made) as image:
        assert made.name == "gallery_striped.png" and image.width <= 600 and len(image.getcolors()) >= 2
    (tmp_path / "striped.py").write_text("raise SystemExit('no driver')")
    with pytest.raises(RuntimeError, match=r"(?s)saved no picture \(exit status 1\).*no driver"):
        gallery.make("striped", tmp_path)


def test_a_film_made_small_keeps_colours_and_time(gallery, tmp_path):
    frames = []
    for k in range(8):
        frame = np.full((90, 800, 3), 240, np.uint8)
        frame[20:60, 80 * k : 80 * k + 100] = [60, 130, 220]
        frames.append(Image.fromarray(frame))
    frames[0].save(tmp_path / "a.gif", save_all=True, append_images=frames[1:], duration=80)
    gallery.shrink_film(tmp_path / "a.gif", tmp_path / "b.gif")
    with Image.open(tmp_path / "b.gif") as film:
        assert film.n_frames == 8 and film.size == (400, 45) and film.info["duration"] == 80
        for k, frame in enumerate(ImageSequence.Iterator(film)):
            seen = np.asarray(frame.convert("RGB"), float)
            blue = np.nonzero(seen[20, :, 2] - seen[20, :, 0] > 80)[0]
            assert blue.mean() == pytest.approx(40 * k + 25, abs=2)
            assert np.abs(seen[20, 40 * k + 25] - [60, 130, 220]).max() < 12


def test_unknown_names_and_failures_are_told(gallery, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="must be one of"):
        gallery.main("nothing", tmp_path)
    monkeypatch.setitem(gallery.EXAMPLES, "gallery", ("--only nothing", "nothing.png"))
    with pytest.raises(RuntimeError, match="saved no picture"):
        gallery.make("gallery", tmp_path)
    done = subprocess.run([sys.executable, ROOT / "examples" / "gallery.py", "--list"], capture_output=True, text=True)
    assert "python examples/control/gripper.py output" in done.stdout.splitlines()
