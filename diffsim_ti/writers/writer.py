"""What writes the frames of a run, chosen by the suffix of the file: one class per format, registered by its suffixes."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from diffsim_ti.common.public import Public, public
from diffsim_ti.rollout import Frames
from diffsim_ti.scene import Scene
from diffsim_ti.visual.camera import Camera
from diffsim_ti.visual.colouring import field_named
from diffsim_ti.visual.drawing import BACKENDS
from diffsim_ti.visual.frame import Frame, Setting

WRITERS: dict[str, type["Writer"]] = {}


@dataclass(frozen=True)
class View(metaclass=Public):
    """How a run is shown, for formats that draw it.

    colour: a name in visual/colouring.py; None for von Mises stress where frames hold it, else displacement. fps: frames per
    second of a film; size: width and height [pixels], None for what suits the format. camera, or azimuth and elevation
    [degrees] of one that sees all; ground: height of a floor [m] instead of the setting's own; wireframe: draw edges;
    backend: "software", "vulkan" or "auto"; title: words before the time. arrows: names of fields that are vectors of
    vertices, such as forces, to draw as arrows.
    fit: what camera and colours of a picture of the end are chosen by: the whole "run", or the "end" alone.
    say: called once with what draws.
    Raises ValueError for what is out of range.
    """

    colour: str | None = None
    fps: float = 30.0
    size: tuple[int, int] | None = None
    camera: Camera | None = None
    azimuth: float = 32.0
    elevation: float = 14.0
    ground: float | None = None
    wireframe: bool = False
    backend: str = "software"
    title: str = ""
    arrows: tuple[str, ...] = ()
    fit: str = "run"
    say: Callable[[str], object] | None = None

    def __post_init__(self):
        if self.colour is not None:
            field_named(self.colour)
        if not 0.01 <= self.fps <= 1e6:
            raise ValueError(f"fps: must be from 0.01 to 1e6 frames per second, got {self.fps:g}; 30 is usual")
        if self.size is not None and min(self.size) < 16:
            raise ValueError(f"size: must be at least 16 pixels a side, got {tuple(self.size)}; try 640 480")
        if not abs(self.elevation) < 90:
            raise ValueError(
                f"elevation must lie between -90 and 90 degrees, got {self.elevation:g}; use 89 to look down"
            )
        for name, value, known in (("backend", self.backend, BACKENDS), ("fit", self.fit, ("run", "end"))):
            if value not in known:
                raise ValueError(f"{name} must be one of {', '.join(known)}, got {value!r}")


class Writer(metaclass=Public):
    """Writes the frames of a run to `path`: made before anything runs, then `open`, `write` each frame, `close`.

    A format of one's own: a subclass with `suffixes` and these methods, given to `register`. The constructor raises what
    can be known without a run, such as a package that is missing. `count`: frames that the file has got.
    """

    suffixes: tuple[str, ...] = ()

    def __init__(self, path: str | Path, view: View | None = None):
        self.path, self.view, self.count = Path(path), view or View(), 0

    def open(self, setting: Setting) -> None:
        """Begin, or begin again; makes the folder. A subclass that does more calls this, too."""
        self.setting, self.count = setting, 0
        self.path.parent.mkdir(parents=True, exist_ok=True)

    @abstractmethod
    def write(self, frame: Frame) -> None:
        """Add a frame."""

    def close(self) -> None:
        """Finish, also after an error, with the frames there are."""

    def describe(self) -> str:
        """What was written, in a line."""
        return f"{self.path}, {self.count} frame{'s' * (self.count != 1)}"

    def __enter__(self) -> "Writer":
        return self

    def __exit__(self, *_) -> None:
        self.close()


class LastOrAll(Writer):
    """A part of writers whose files hold one frame: the last one, or, for a name such as "run_%04d.png", a file for each
    frame, numbered from 0. Raises ValueError for a name with a % that is no place for a number."""

    def __init__(self, path: str | Path, view: View | None = None):
        super().__init__(path, view)
        try:
            self.numbered = "%" in self.path.name and bool(self.path.name % 0)
        except (TypeError, ValueError) as error:
            raise ValueError(f"output: {self.path.name!r} has no place for one number; write it as %04d") from error

    def file_of(self, k: int) -> Path:
        """The file that frame k is in."""
        return self.path.with_name(self.path.name % k) if self.numbered else self.path

    def describe(self) -> str:
        return super().describe() if self.numbered else str(self.path)


def register(kind: type[Writer]) -> type[Writer]:
    """Make `writer_for` know a class by its suffixes. Raises ValueError for none, or one that another class has."""
    if not kind.suffixes or not all(s.startswith(".") and s == s.lower() for s in kind.suffixes):
        raise ValueError(f"{kind.__name__}.suffixes: must be like ('.abc',), in small letters, got {kind.suffixes!r}")
    for suffix in kind.suffixes:
        if WRITERS.setdefault(suffix, kind) is not kind:
            raise ValueError(f"{suffix} is written by {WRITERS[suffix].__name__} already; choose another suffix")
    return kind


@public
def writer_for(path: str | Path, view: View | None = None) -> Writer:
    """The writer for a file, by its suffix. Raises ValueError for one that is not known, naming those that are."""
    suffix = Path(path).suffix.lower()
    if suffix not in WRITERS:
        raise ValueError(f"output: must end in {', '.join(sorted(WRITERS))}, got {Path(path).name!r}; rename it")
    return WRITERS[suffix](path, view)


@public
def open_writer(path: str | Path, scene: Scene, view: View | None = None) -> Writer:
    """The writer for a file, opened for runs of a scene: `with open_writer("run.mp4", scene) as out: out.write(...)`."""
    writer = writer_for(path, view)
    writer.open(Setting.of(scene))
    return writer


def save_frames(path: str | Path, frames: Frames, view: View | None = None) -> Writer:
    """Write all frames of a Rollout's run to a file, in the format of its suffix: `save_frames("run.mp4", frames)`.

    The last one alone is `open_writer("end.png", scene)` with `write(Frame.of_run(scene, frames))`.
    Raises ValueError for a suffix that is not known, and for frames without their scene: a copy by pickle.
    """
    scene = frames.scene
    if scene is None:
        remedy = "write each by open_writer(path, scene) and Frame.of_run(scene, frames, k)"
        raise ValueError(f"frames: a copy by pickle has no scene: {remedy}")
    with open_writer(path, scene, view) as writer:
        for k in range(len(frames.times)):
            writer.write(Frame.of_run(scene, frames, k))
    return writer
