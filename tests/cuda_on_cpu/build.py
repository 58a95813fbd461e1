"""Builds the stand-in: `python tests/cuda_on_cpu/build.py` prints the folder of its libcuda.so.

Libraries lie in a folder that is named by the sources, below CUDA_ON_CPU_CACHE or ~/.cache/cuda_on_cpu, so that nothing
made by other sources is ever used.
"""

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

_HERE = Path(__file__).parent


class CannotBuild(RuntimeError):
    """No compiler, another processor, or a compiler that fails."""


def build() -> Path:
    """Folder of libcuda.so, made if it is not there."""
    compiler = shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        raise CannotBuild("no C compiler was found: install gcc or clang")
    if os.uname().sysname != "Linux" or os.uname().machine != "x86_64":
        raise CannotBuild("the stand-in for the driver needs Linux on x86-64")
    sources = sorted(path for path in _HERE.iterdir() if path.suffix in (".c", ".h", ".py"))
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources) + str(_HERE).encode()).hexdigest()[:16]
    cache = Path(os.environ.get("CUDA_ON_CPU_CACHE") or Path.home() / ".cache" / "cuda_on_cpu")
    folder = cache / digest
    modules = folder / "modules"
    modules.mkdir(parents=True, exist_ok=True)
    library = folder / "libcuda.so"
    if not library.exists():
        places = {"FOLDER": modules, "PYTHON": sys.executable, "TRANSLATOR": _HERE / "module.py"}
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            made = Path(scratch) / "libcuda.so"
            command = [compiler, "-O2", "-shared", "-fPIC", *(f'-D{name}="{value}"' for name, value in places.items())]
            command += [*map(str, (p for p in sources if p.suffix == ".c")), "-o", str(made), "-ldl", "-lpthread"]
            result = subprocess.run(command, capture_output=True, text=True)
            if result.returncode:
                raise CannotBuild(result.stderr)
            made.rename(library)
    return folder


def environment(**options) -> dict[str, str]:
    """Variables of a process that finds the stand-in; options are CUDA_ON_CPU_..., by their last word."""
    folder = str(build())
    paths = [folder, *filter(None, [os.environ.get("LD_LIBRARY_PATH")])]
    return {
        **os.environ,
        "LD_LIBRARY_PATH": os.pathsep.join(paths),
        "DIFFSIM_TI_ARCH": "cuda",
        **{f"CUDA_ON_CPU_{name.upper()}": str(value) for name, value in options.items()},
    }


if __name__ == "__main__":
    print(build())
