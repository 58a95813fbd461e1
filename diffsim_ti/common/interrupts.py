"""Ctrl-C in the command line, at any moment: one line with the word "interrupted", exit code 130, no traceback.

While the package is imported, the signal ends the process at once. While a command runs it raises KeyboardInterrupt, and
again where a destructor or an `except:` of others has swallowed it. Programs that import the package keep their own
handler. In the first hundredths of a second Python has not come here yet, and shows a traceback of its own.
"""

import _thread
import contextlib
import os
import signal
import sys
import threading
from os import _exit as end_process  # at once

_is_command = os.path.basename(sys.argv[0] if sys.argv else "").startswith("diffsim-ti") or (
    sys.argv[:1] == ["-m"] and "diffsim_ti" in getattr(sys, "orig_argv", ())
)
_seen = {"interrupted": False, "ended": False}


def guard_import() -> None:
    """Until `commands_may_run`: end at once, if this process is the command line."""
    if _is_command and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)


def commands_may_run() -> None:
    """From now on the signal raises KeyboardInterrupt."""
    _seen.update(interrupted=False, ended=False)
    if _is_command and signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # of jobs in the background
        signal.signal(signal.SIGINT, _raise)
        sys.unraisablehook = _raise_again


def command_ended() -> bool:
    """Whether the signal came since `commands_may_run`, even if something swallowed it. From now on it does nothing."""
    _seen["ended"] = True
    while _is_command:
        with contextlib.suppress(KeyboardInterrupt):  # of a signal that came just before
            if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
                break
            signal.signal(signal.SIGINT, signal.SIG_IGN)
    exec("pass")  # Python notes an interrupt within exec of text (dataclasses), and would end by it what has caught it
    return _seen["interrupted"]


def check() -> None:
    """Raise KeyboardInterrupt if the signal came and was swallowed on its way: loops of commands call this."""
    if _seen["interrupted"]:
        raise KeyboardInterrupt


def _end(*_) -> None:
    os.write(2, b"error: interrupted\n")
    end_process(130)


def _raise(*_) -> None:
    _seen["interrupted"] = True
    if not _seen["ended"]:
        raise KeyboardInterrupt


def _raise_again(unraisable) -> None:
    if issubclass(unraisable.exc_type, KeyboardInterrupt):
        threading.Timer(0.02, _thread.interrupt_main).start()  # when the destructor has returned
    else:
        sys.__unraisablehook__(unraisable)
