"""Writers of runs: series for ParaView and renderers, animated surfaces, pictures, films, arrays."""

from diffsim_ti.visual.frame import Frame, Setting
from diffsim_ti.writers.arrays import ArraysWriter
from diffsim_ti.writers.drawn import FilmWriter, PictureWriter
from diffsim_ti.writers.gltf import GltfWriter
from diffsim_ti.writers.paraview import ParaViewWriter
from diffsim_ti.writers.surfaces import PlyWriter
from diffsim_ti.writers.usd import UsdWriter
from diffsim_ti.writers.writer import WRITERS, View, Writer, open_writer, register, save_frames, writer_for

__all__ = ["ArraysWriter", "FilmWriter", "Frame", "GltfWriter", "open_writer", "ParaViewWriter", "PictureWriter"]
__all__ += ["PlyWriter", "register", "save_frames", "Setting", "UsdWriter", "View", "Writer", "writer_for", "WRITERS"]
