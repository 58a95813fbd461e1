"""Writers of runs, one format per file: a series for ParaView, pictures, films, arrays."""

from diffsim_ti.visual.frame import Frame, Setting
from diffsim_ti.writers.arrays import ArraysWriter
from diffsim_ti.writers.film import FilmWriter
from diffsim_ti.writers.gltf import GltfWriter
from diffsim_ti.writers.paraview import ParaViewWriter
from diffsim_ti.writers.picture import PictureWriter
from diffsim_ti.writers.writer import WRITERS, View, Writer, open_writer, register, save_frames, writer_for

__all__ = ["ArraysWriter", "FilmWriter", "Frame", "GltfWriter", "ParaViewWriter", "PictureWriter", "Setting", "View"]
__all__ += ["WRITERS", "Writer", "open_writer", "register", "save_frames", "writer_for"]
