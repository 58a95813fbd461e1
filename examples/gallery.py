"""Pictures and films of the examples, gallery_<example>.png or .gif, and guides, guide_<guide>.png, in assets/pictures.

Each example runs by the command that the pages show, in a process and a folder of its own, and so do a guide's code
blocks, one after the other; pictures are then made small enough for a repository. `--list` prints the commands.

    python examples/gallery.py [--only NAME] [--folder assets/pictures] [--list]
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image, ImageSequence

HERE = Path(__file__).resolve().parent
PICTURES = HERE.parent / "assets" / "pictures"
WIDTH, FILM_WIDTH, COLOURS = 600, 400, 128  # [pixels], at most; of a film's palette
# {folder/example: (its arguments, the file it writes)}
EXAMPLES = {
    "identify/stiffness_field": ("", "stiffness_field.png"),
    "identify/learned_material": ("", "learned_material.png"),
    "identify/identify_beam": ("output", "identify_beam.png"),
    "identify/indentation": ("output", "indentation.png"),
    "identify/identify_torch": ("", "identify_both.png"),
    "identify/stiffness_from_picture": ("output", "stiffness_from_picture.png"),
    "identify/train_distributed": ("", "train_distributed.png"),
    "design/least_compliance": ("output", "least_compliance.png"),
    "design/sag_into_shape": ("output", "sag_into_shape.png"),
    "design/inverse_rest_shape": ("output", "inverse_rest_shape.png"),
    "design/tuning_fork": ("output", "tuning_fork.png"),
    "design/cantilever_shape": ("output", "cantilever_shape.png"),
    "design/finger_shape": ("output", "finger_shape.png"),
    "control/gripper": ("output", "gripper.gif"),
    "control/soft_hand": ("output", "soft_hand.gif"),
    "control/arm": ("output", "arm.png"),
    "control/grasp_and_lift": ("--ppo 0", "grasp_and_lift.gif"),
    "control/swimmer": ("", "swimmer.gif"),
    "control/pneumatic_finger": ("output", "pneumatic_finger.png"),
    "control/train_controller": ("", "train_controller.gif"),
    "control/wall_shot": ("output", "wall_shot.png"),
    "control/throw_at_target": ("output", "throw_at_target.png"),
    "control/tendon_finger": ("output", "tendon_finger.png"),
    "contact/bowl": ("--cells 4 --frames 60 --film output/bowl.gif", "bowl.gif"),
    "contact/incline": ("output", "incline.png"),
    "contact/stack": ("output", "stack.png"),
    "benchmarks/cantilever": ("--quick output", "cantilever.png"),
    "benchmarks/cooks_membrane": ("--quick output", "cooks_membrane.png"),
}
GUIDES = {
    f"guides/{path.stem}": path for path in sorted((HERE / "guides").glob("*.md")) if "/guide_" in path.read_text()
}
TORCHRUN = {"identify/train_distributed": "--nproc_per_node=2"}  # examples of several processes


def command(name: str) -> str:
    """What makes an example's picture, in the folder output."""
    start = f"torchrun {TORCHRUN[name]}" if name in TORCHRUN else "python"
    return f"{start} examples/{name}.py {EXAMPLES[name][0]}".strip()


def code(guide: str) -> str:
    """The code blocks of a guide's text as one script."""
    return "\n".join(re.findall(r"```python\n(.*?)```", guide, re.DOTALL))


def make(name: str, folder: Path) -> Path:
    """Run an example or a guide and keep its picture, made small; RuntimeError with what it said if there is none."""
    stem, is_guide = Path(name).name, name in GUIDES
    arguments, made = ("", f"{stem}.png") if is_guide else EXAMPLES[name]
    with tempfile.TemporaryDirectory() as temporary:
        script = Path(temporary) / "guide.py" if is_guide else HERE / f"{name}.py"
        if is_guide:
            script.write_text(code(GUIDES[name].read_text()))
        paths = os.pathsep.join([str(HERE.parent), os.environ.get("PYTHONPATH", "")])
        start = ["-m", "torch.distributed.run", "--standalone", *TORCHRUN[name].split()] if name in TORCHRUN else []
        done = subprocess.run(
            [sys.executable, *start, script, *arguments.split()],
            cwd=temporary,
            text=True,
            capture_output=True,
            env=os.environ | {"PYTHONPATH": paths},
        )
        made = Path(temporary) / ("" if is_guide else "output") / made
        if done.returncode or not made.exists():
            raise RuntimeError(f"{name}: saved no picture (exit status {done.returncode})\n{done.stderr[-2000:]}")
        out = folder / f"{'guide' if is_guide else 'gallery'}_{stem}{made.suffix}"
        (shrink_film if made.suffix == ".gif" else shrink_picture)(made, out)
    return out


def shrunk(image: Image.Image, width: int) -> Image.Image:
    """No wider than `width`."""
    if image.width <= width:
        return image
    return image.resize((width, round(image.height * width / image.width)), Image.Resampling.LANCZOS)


def shrink_picture(source: Path, target: Path) -> None:
    """A PNG in 256 colours."""
    image = shrunk(Image.open(source).convert("RGB"), WIDTH)
    image.quantize(256, dither=Image.Dither.NONE).save(target, optimize=True)


def shrink_film(source: Path, target: Path) -> None:
    """A GIF whose frames share their colours, not dithered, so that what stands still costs nothing."""
    with Image.open(source) as film:
        duration = film.info["duration"]
        frames = [shrunk(frame.convert("RGB"), FILM_WIDTH) for frame in ImageSequence.Iterator(film)]
    shown = [frames[k * (len(frames) - 1) // 3] for k in range(4)]
    sheet = Image.new("RGB", (shown[0].width, 4 * shown[0].height))
    for k, frame in enumerate(shown):
        sheet.paste(frame, (0, k * frame.height))
    # half for what covers most of the picture, half for what differs most
    halves = [sheet.quantize(COLOURS // 2, method=m) for m in (Image.Quantize.MEDIANCUT, Image.Quantize.MAXCOVERAGE)]
    palette = Image.new("P", (1, 1))
    palette.putpalette(sum((half.getpalette()[: 3 * (COLOURS // 2)] for half in halves), []))
    first, *rest = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    first.save(target, save_all=True, append_images=rest, duration=duration, loop=0, optimize=True)


def main(only: str | None = None, folder=PICTURES) -> dict:
    """{example or guide: its picture's path}; ValueError for one that saves no picture."""
    names = [*EXAMPLES, *GUIDES]
    if only is not None and only not in names:
        raise ValueError(f"--only: must be one of {', '.join(names)}, got {only!r}")
    folder, out = Path(folder), {}
    folder.mkdir(parents=True, exist_ok=True)
    for name in [only] if only else names:
        start = time.perf_counter()
        out[name] = make(name, folder)
        size = out[name].stat().st_size
        print(f"{out[name].name}: {size / 1000:.0f} kB, {time.perf_counter() - start:.0f} s", flush=True)
    return out


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", metavar="NAME", help="make this one: " + ", ".join([*EXAMPLES, *GUIDES]))
    parser.add_argument("--folder", default=PICTURES, help="where pictures go")
    parser.add_argument("--list", action="store_true", help="print the commands that make them")
    options = parser.parse_args()
    if options.list:
        print("\n".join(map(command, EXAMPLES)))
    else:
        main(options.only, options.folder)
