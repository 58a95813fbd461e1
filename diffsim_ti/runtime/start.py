"""Start-up of Taichi, its backends and precisions, and whether the program that gave something still lives."""

import atexit
import contextlib
import io
import multiprocessing
import os
import shutil
import tempfile
import weakref
from typing import Literal, TypedDict

import numpy as np
import taichi as ti
from taichi._lib import core as _core
from taichi.lang import impl
from taichi.lang.misc import _SpecialConfig
from typing_extensions import Unpack

from diffsim_ti.common import ranks
from diffsim_ti.common.deprecated import renamed_arguments
from diffsim_ti.common.names import nearest
from diffsim_ti.common.warn import warn
from diffsim_ti.runtime.device import count_cards
from diffsim_ti.runtime.threads import LOCK, current_program, materialize

PRECISIONS = {"f32": ti.f32, "f64": ti.f64}
NUMPY = {"f32": np.float32, "f64": np.float64}
_ARCHS = {"cpu": ti.cpu, "cuda": ti.cuda, "vulkan": ti.vulkan}
_PARENT = "DIFFSIM_TI_PARENT"  # process and backend that its spawned workers start on
_FORM = "DIFFSIM_TI_FORM"
_OF_TAICHI = "default_ip", "require_version", *vars(_SpecialConfig())  # options of ti.init besides its compiler's
_settings = {"precision": "f32"}


class TaichiOptions(TypedDict, total=False):
    """Options of `ti.init` that are of use here; it takes its others, too."""

    advanced_optimization: bool
    debug: bool
    device_memory_fraction: float
    device_memory_GB: float
    gdb_trigger: bool
    kernel_profiler: bool
    log_level: str
    num_compile_threads: int
    offline_cache: bool
    offline_cache_file_path: str
    print_ir: bool
    random_seed: int
    verbose: bool


def available_archs() -> list[str]:
    """Names of the backends this machine and this Taichi build can run, always with "cpu"."""
    ti.set_logging_level(ti.ERROR)  # a missing driver is an answer here, not a warning
    return [name for name in _ARCHS if _has_arch(name)]


def _has_arch(name: str) -> bool:
    return {"cpu": lambda: True, "cuda": lambda: count_cards() > 0, "vulkan": _core.with_vulkan}[name]()


@renamed_arguments(arch="backend")
def init(
    backend: Literal["cpu", "cuda", "vulkan"] = "cpu",
    precision: Literal["f32", "f64"] = "f32",
    threads: int | None = None,
    **options: Unpack[TaichiOptions],
) -> None:
    """Start Taichi for this process: a thin front of `ti.init`, and the only place that calls it.

    backend: "cpu", "cuda" or "vulkan", as --backend of the command line; one that is not there is an error, never a
    fall-back.
    precision: "f32" or "f64", what a Scene uses unless it says otherwise.
    threads: CPU threads, default all; of several ranks on one machine each takes its share.
    options: handed to `ti.init`. `fast_math` stays False because it erases NaNs before anyone can see them, and
    `default_fp` stays f64 so that both precisions can live in one process.

    Used before `init`, the library calls `init()` itself: CPU, f32. A `ti.init` of the host program is respected.
    Called again with the same settings it sets the precision alone; with others it starts anew, which drops every array
    of earlier scenes: they say so when used.
    Raises ValueError for an unknown name, TypeError for an unknown option, RuntimeError for a backend that is not available.
    """
    if backend not in _ARCHS:
        raise ValueError(f"backend must be one of {', '.join(_ARCHS)}, got {backend!r}")
    check_precision(precision)
    ti.set_logging_level(ti.ERROR)
    if not _has_arch(backend):
        cardless = backend == "cuda" and _core.with_cuda()
        raise RuntimeError(
            f"the {backend} backend is not available here (available: {', '.join(available_archs())}"
            + ("; CUDA's driver is installed, but sees no card" if cardless else "")
            + "); pass one of those to diffsim_ti.init"
            + ("" if cardless else f", or install the driver that {backend} needs")
        )
    for name in options:
        if name in ("default_fp", "fast_math"):
            raise ValueError(f"{name} cannot be chosen: diffsim_ti needs default_fp=f64 and fast_math=False")
        if name not in _OF_TAICHI and not hasattr(impl.default_cfg(), name):
            near = nearest(name, ["arch", "precision", "threads", *TaichiOptions.__annotations__])
            meant = f" (did you mean {near!r}?)" if near else ""
            raise TypeError(
                f"init has no argument {name!r}, and neither has ti.init{meant}: pass "
                f"backend={', '.join(map(repr, _ARCHS))}, precision, threads, or an option of ti.init such as debug=True"
            )
    asked = backend, threads, options.copy(), {name: x for name, x in os.environ.items() if name.startswith("TI_")}
    if (
        _settings.get("asked") == asked
        and current_program() is not None
        and _settings["started"]() is current_program()
    ):
        ti.set_logging_level(options.get("log_level", ti.ERROR).lower())
        set_precision(precision)
        return
    options.setdefault("log_level", ti.ERROR)
    if not _can_write_cache(options.get("offline_cache_file_path") or os.environ.get("TI_OFFLINE_CACHE_FILE_PATH")):
        # Taichi makes the folder even then, and crashes at exit if it cannot
        folder = _settings.get("folder") or tempfile.mkdtemp(prefix="ticache-")
        _settings["folder"] = folder  # until the end of this process
        options |= dict(offline_cache=False, offline_cache_file_path=folder)
        os.environ.pop("TI_OFFLINE_CACHE_FILE_PATH", None)
    threads = ranks.share_of_cores() if threads is None else threads
    if threads is not None:
        options["cpu_max_num_threads"] = int(threads)
    set_precision(precision)
    with LOCK, contextlib.redirect_stdout(io.StringIO()):
        ti.init(arch=_ARCHS[backend], default_fp=ti.f64, fast_math=False, enable_fallback=False, **options)
        materialize()  # in this thread, so that others can compile
    _settings["asked"], _settings["started"] = asked, weakref.ref(current_program())


def _can_write_cache(path: str | None) -> bool:
    folder = os.path.expanduser(path or "~/.cache/taichi/ticache")
    try:
        os.makedirs(folder, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)


def set_precision(precision: str) -> None:
    """Set the precision, "f32" or "f64", of scenes that do not name one."""
    _settings["precision"] = check_precision(precision)


def check_precision(precision: str | None) -> str:
    """Return a valid precision name; None means the process-wide default."""
    if precision is None:
        return _settings["precision"]
    if precision not in PRECISIONS:
        raise ValueError(f"precision must be 'f32' or 'f64', got {precision!r}")
    return precision


def _after_fork() -> None:
    _settings["forked"] = current_program() is not None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


@atexit.register
def _end_program() -> None:
    """Taichi writes the kernels that it compiled to its cache when its program ends, and an interpreter that exits does not
    end it where anything, such as the callback above, still leads to it."""
    if _settings.get("forked"):
        return
    if current_program() is not None:
        ti.reset()
    if "folder" in _settings:
        shutil.rmtree(_settings["folder"], ignore_errors=True)


def refuse_fork() -> None:
    if _settings.get("forked"):
        raise RuntimeError(
            "this process was forked after Taichi had started, and Taichi's threads do not survive a fork: start workers "
            "with multiprocessing.get_context('spawn'), or DataLoader(..., multiprocessing_context='spawn')"
        )


def program() -> weakref.ref:
    """The live Taichi program; starts the stated default (CPU, f32; a spawned worker where its parent runs) if nothing did.

    A weak reference: a program that is still held would outlive `ti.init`, and at its end free memory of the next one.
    """
    refuse_fork()
    if current_program() is None:
        with LOCK:
            if current_program() is None:
                init(_arch_of_parent())
    _tell_workers()
    return weakref.ref(current_program())


def _tell_workers() -> None:
    """Processes that multiprocessing spawns inherit the environment: they start where this one runs."""
    arch = impl.current_cfg().arch
    if _settings.get("told") != arch:
        _settings["told"] = arch
        os.environ[_PARENT] = f"{os.getpid()} {arch_name()}"


def _arch_of_parent() -> str:
    """The backend of the process that spawned this one as a worker; the default for any other process."""
    parent = multiprocessing.parent_process()
    pid, _, arch = os.environ.get(_PARENT, "").partition(" ")
    return arch if parent is not None and pid == str(parent.pid) else "cpu"


def is_alive(owner: weakref.ref) -> bool:
    """Whether the program `owner` is the one that runs."""
    running = owner()
    return running is not None and running is current_program()


def check_host_init() -> None:
    """Warn once about a host program's `ti.init` that weakens the library's promises."""
    program()
    config = impl.current_cfg()
    if config.fast_math and not _settings.get("warned"):
        _settings["warned"] = True
        warn(
            "ti.init was called with fast_math=True, which can erase NaNs before they are seen; "
            "use diffsim_ti.init(), or ti.init(fast_math=False, default_fp=ti.f64)"
        )


def check_alive(owner: weakref.ref) -> None:
    """Raise if `ti.init` was called after the program `owner`, or if this process was forked since."""
    running = owner()  # looked up here, without calls: every look at an array comes by
    if running is not None and running is current_program() and not _settings.get("forked"):
        return
    refuse_fork()
    if not is_alive(owner):
        raise RuntimeError("ti.init was called again, which destroys all Taichi data: build the scene and solver again")


def arch_name() -> str:
    """Name of the running backend."""
    owner, name = _settings.get("runs", (None, ""))
    if owner is not None and owner() is current_program() is not None and not _settings.get("forked"):
        return name  # the usual way, as short as can be
    owner, arch = program(), impl.current_cfg().arch
    for name, value in _ARCHS.items():
        if value == arch:
            _settings["runs"] = owner, name
            return name
    raise RuntimeError(
        f"Taichi was started on {_core.arch_name(arch)}, which diffsim_ti does not support: "
        f"use one of {', '.join(_ARCHS)}, by diffsim_ti.init or ti.init"
    )


def runs_on_cpu() -> bool:
    """Whether kernels and arrays take the form for a CPU: lanes, serial loops, memory that NumPy sees.

    DIFFSIM_TI_FORM=gpu in the environment gives them the form for a GPU all the same, to test it.
    """
    form = os.environ.get(_FORM, "cpu")
    if form not in ("cpu", "gpu"):
        raise ValueError(f"{_FORM} must be cpu or gpu, got {form!r}")
    return arch_name() == "cpu" and form == "cpu"


def moves_vectors() -> bool:
    """Whether kernels of tetrahedra load and store whole vectors: lanes of a CPU, the four numbers of a vertex on CUDA."""
    return runs_on_cpu() or arch_name() == "cuda"


def check_backend(precision: str) -> None:
    """Raise ValueError if the running backend cannot compute in this precision."""
    if arch_name() == "vulkan" and precision == "f64":
        raise ValueError(
            "Vulkan has no float64 logarithm, which energies and contacts need: use precision='f32' there, "
            "or diffsim_ti.init('cpu') or ('cuda') for float64"
        )
