"""Writers of runs, a format or formats that share how they are made per file: series for ParaView and renderers, animated surfaces, pictures, films, arrays."""

from diffsim_ti.visual.frame import Frame, Setting
from diffsim_ti.writers.arrays import ArraysWriter
from diffsim_ti.writers.drawn import FilmWriter, PictureWriter
from diffsim_ti.writers.gltf import GltfWriter
from diffsim_ti.writers.paraview import ParaViewWriter
from diffsim_ti.writers.ply import PlyWriter
from diffsim_ti.writers.usd import UsdWriter
from diffsim_ti.writers.writer import WRITERS, View, Writer, open_writer, register, save_frames, writer_for

__all__ = [
    "ArraysWriter",
    "FilmWriter",
    "Frame",
    "GltfWriter",
    "ParaViewWriter",
    "PictureWriter",
    "PlyWriter",
    "Setting",
]
__all__ += ["UsdWriter", "View", "WRITERS", "Writer", "open_writer", "register", "save_frames", "writer_for"]
