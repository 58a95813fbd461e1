"""One picture of each example that can save one, as assets/pictures/gallery_<example>.png: those of the README.

Examples run in their small form where the full one takes long, each in its own process, as Taichi's settings are global.

    python examples/gallery.py [--only NAME] [--folder assets/pictures]
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image

HERE = Path(__file__).resolve().parent
PICTURES = HERE.parent / "assets" / "pictures"
WIDTH = 720  # [pixels], at most
# {example: arguments of its main, as Python; `folder` is where its picture goes}
EXAMPLES = {
    "identify_beam": "folder",
    "throw_at_target": "folder",
    "inverse_rest_shape": "folder",
    "sag_into_shape": "folder, quick=True",
    "least_compliance": "folder, quick=True",
    "cantilever": "quick=True, picture_folder=folder",
    "stack": "picture_folder=folder",
    "incline": "folder",
    "gripper": "folder",
    "wall_shot": "folder",
}
RUN = "import diffsim_ti as ds, {name} as example; folder = {folder!r}; ds.init(precision='f64'); example.main({arguments})"


def make(name: str, folder: Path) -> Path:
    """Run an example and keep its picture, no wider than WIDTH, in 256 colours; RuntimeError if there is none."""
    with tempfile.TemporaryDirectory() as temporary:
        code = RUN.format(name=name, folder=temporary, arguments=EXAMPLES[name])
        search = f"import sys; sys.path[:0] = [{str(HERE)!r}, {str(HERE.parent)!r}]; "
        done = subprocess.run([sys.executable, "-c", search + code], capture_output=True, text=True)
        made = Path(temporary) / f"{name}.png"
        if done.returncode or not made.exists():
            raise RuntimeError(f"{name}: saved no picture (exit status {done.returncode})\n{done.stderr[-2000:]}")
        image = Image.open(made).convert("RGB")
        if image.width > WIDTH:
            image = image.resize((WIDTH, round(image.height * WIDTH / image.width)), Image.Resampling.LANCZOS)
        out = folder / f"gallery_{name}.png"
        image.quantize(256, dither=Image.Dither.NONE).save(out, optimize=True)
    return out


def main(only: str | None = None, folder=PICTURES) -> dict:
    """{example: its picture's path}; ValueError for an example that saves no picture."""
    if only is not None and only not in EXAMPLES:
        raise ValueError(f"--only: must be one of {', '.join(EXAMPLES)}, got {only!r}")
    folder, out = Path(folder), {}
    folder.mkdir(parents=True, exist_ok=True)
    for name in [only] if only else EXAMPLES:
        start = time.perf_counter()
        out[name] = make(name, folder)
        size = out[name].stat().st_size
        print(f"{out[name].name}: {size / 1000:.0f} kB, {time.perf_counter() - start:.0f} s", flush=True)
    return out


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", metavar="NAME", help="make this one: " + ", ".join(EXAMPLES))
    parser.add_argument("--folder", default=PICTURES, help="where pictures go")
    options = parser.parse_args()
    main(options.only, options.folder)
