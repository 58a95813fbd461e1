"""The commands that show a saved series: `diffsim-ti render` writes a film, `diffsim-ti view` opens a window."""

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add this module's commands to the command line."""
    app.command()(render)
    app.command()(view)


def render(
    series: Annotated[Path, typer.Argument(help="the .pvd of a run", exists=True, dir_okay=False)],
    output: Annotated[Path, typer.Option("--output", "-o", help=".mp4, .gif, or .png of the end")] = Path("output/film.mp4"),
    colour: Annotated[str, typer.Option(help="displacement, speed, von_mises, energy_density or J")] = "von_mises",
    fps: Annotated[float, typer.Option(help="frames per second of the film")] = 30.0,
    size: Annotated[tuple[int, int], typer.Option(help="width and height [pixels]")] = (640, 480),
    ground: Annotated[float | None, typer.Option(help="height of a floor to draw [m]")] = None,
    azimuth: Annotated[float, typer.Option(help="of the eye, about y [degrees]")] = 32.0,
    elevation: Annotated[float, typer.Option(help="of the eye, above the floor [degrees]")] = 14.0,
    wireframe: Annotated[bool, typer.Option("--wireframe", help="draw the edges of the triangles")] = False,
    backend: Annotated[str, typer.Option(help="vulkan, software, or auto: Vulkan where there is a driver")] = "auto",
):
    """Draw a saved series as a film, coloured by a field, without a display."""
    from diffsim_ti.film import render_series

    count = render_series(series, output, colour, fps, size, ground, azimuth, elevation, backend, print,
                          wireframe=wireframe)  # fmt: skip
    print(f"{count} frame{'s' * (count != 1)}: {output}")


def view(
    series: Annotated[Path, typer.Argument(help="the .pvd of a run", exists=True, dir_okay=False)],
    colour: Annotated[str, typer.Option(help="displacement, speed, von_mises, energy_density or J")] = "von_mises",
    ground: Annotated[float | None, typer.Option(help="height of a floor to draw [m]")] = None,
):
    """Look at a saved series in a window: play, step, scrub, turn, colour by a field."""
    from diffsim_ti.viewer import SavedFrames, Viewer

    source = SavedFrames(series)
    Viewer(source.mesh, source, colour, box=source.box(), ground=ground).run()
