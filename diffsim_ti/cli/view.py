"""The commands that show a run: `diffsim-ti render` writes a film of a series, `diffsim-ti view` opens a window."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from diffsim_ti import runtime
from diffsim_ti.cli import options as opt
from diffsim_ti.terms import ExternalForce
from diffsim_ti.writers import View, writer_for
from diffsim_ti.writers.adaptive_run import ForwardRun


def render(
    series: Annotated[Path, Argument(help="the .pvd of a run", exists=True, dir_okay=False)],
    output: Annotated[Path, Option("--output", "-o", help=f"file, by its suffix: {opt.SUFFIXES}")] = Path(
        "output/film.mp4"
    ),
    colour: Annotated[str, Option(help="displacement, speed, von_mises, energy_density or J")] = "von_mises",
    fps: Annotated[float, Option(help="frames per second of the film")] = 30.0,
    size: Annotated[tuple[int, int], Option(help="width and height [pixels]")] = (640, 480),
    ground: Annotated[float | None, Option(help="height of a floor to draw [m]; default the run's own")] = None,
    azimuth: Annotated[float, Option(help="of the eye, about y [degrees]")] = 32.0,
    elevation: Annotated[float, Option(help="of the eye, above the floor [degrees]")] = 14.0,
    wireframe: Annotated[bool, Option("--wireframe", help="draw the edges of the triangles")] = False,
    backend: Annotated[str, Option(help="vulkan, software, or auto: Vulkan where there is a driver")] = "auto",
    arrows: Annotated[
        list[str] | None,
        Option(help="vectors at vertices that the series contains, such as forces, to draw as arrows; may be repeated"),
    ] = None,
) -> None:
    """Draw a saved series as a film, coloured by a field, without a display."""
    from diffsim_ti.film import render_series

    eye = dict(azimuth=azimuth, elevation=elevation, wireframe=wireframe, arrows=arrows or ())
    count = render_series(series, output, colour, fps, size, ground, backend=backend, say=print, **eye)
    print(f"{count} frame{'s' * (count != 1)}: {output}")


def view(
    source: Annotated[
        Path, Argument(help="the .pvd of a run, or a mesh, which is then simulated", exists=True, dir_okay=False)
    ],
    colour: Annotated[str, Option(help="displacement, speed, von_mises, energy_density or J")] = "von_mises",
    ground: Annotated[float | None, Option(help="height of a floor to draw [m]; default the run's own")] = None,
    material: opt.MaterialName = "StableNeoHookean",
    youngs_modulus: opt.Youngs = 1e5,
    poissons_ratio: opt.Poisson = 0.4,
    density: opt.Density = 1000.0,
    size: opt.Size = None,
    up: opt.UpAxis = opt.Up.y,
    fix_orientation: opt.FixOrientation = False,
    fps: Annotated[float, Option(help="of a live run: frames per simulated second")] = 60.0,
    solver: Annotated[str, Option(help="verlet, semi-implicit, implicit-euler or bdf2")] = "verlet",
    gravity: Annotated[float, Option(help="along y [m/s^2]")] = -9.81,
    drag: Annotated[float, Option(help="rate at which velocities fall [1/s]")] = 0.0,
    fixed: opt.Fixed = None,
    floor: Annotated[bool, Option(help="a floor at y = 0, the body above it")] = True,
    friction: Annotated[float, Option(help="Coulomb's coefficient of the floor")] = 0.0,
    arrows: opt.Arrows = None,
    output: Annotated[
        Path | None, Option("--output", "-o", help=f"file that the key S writes, by its suffix: {opt.SUFFIXES}")
    ] = None,
) -> None:
    """Look at a saved series in a window, or at a mesh as it falls: play, step, scrub, turn, colour by a field, pull."""
    from diffsim_ti.visual.frame_sources import LiveFrames, SavedFrames
    from diffsim_ti.visual.viewer import NO_DISPLAY, Viewer, has_display

    if not has_display():
        raise RuntimeError(NO_DISPLAY)
    saving = None if output is None else writer_for(output, View(ground=ground, arrows=tuple(arrows or ())))
    if source.suffix == ".pvd":
        frames = SavedFrames(source)
    else:
        if not fps > 0:
            raise ValueError(f"--fps must be > 0, got {fps:g}")
        runtime.init()
        body = opt.load_body(source, size, up, fix_orientation)
        law, pull = opt.make_material(material, youngs_modulus, poissons_ratio), ExternalForce([0.0, 0.0, 0.0])
        more = dict(fixed=fixed, floor=floor, friction=friction, extra=[pull])
        scene, _ = opt.fall_scene(body, law, density, gravity, drag, **more)
        frames = LiveFrames(
            ForwardRun(scene, opt.solver_class(solver), 1 / fps, outputs=opt.forces_named(arrows or (), scene))
        )
    look = {} if ground is None else dict(ground=ground)
    Viewer(frames, colour, playing=source.suffix != ".pvd", output=saving, arrows=arrows or (), **look).run()
