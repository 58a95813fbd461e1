"""What takes long says how far it is: a bar on stderr where that is a terminal, else records of the logger "diffsim_ti"."""

import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from diffsim_ti.common import interrupts, ranks

LOG = logging.getLogger("diffsim_ti")
EVERY = 5.0  # seconds between two records


class Steady:
    """Records of one work: at level INFO one every EVERY seconds, the first that long after the beginning; else at DEBUG."""

    def __init__(self):
        self.last = time.perf_counter()

    def log(self, message: str, *values: object) -> None:
        """A record of how far the work is."""
        now = time.perf_counter()
        is_due = now - self.last >= EVERY
        self.last = now if is_due else self.last
        LOG.log(logging.INFO if is_due else logging.DEBUG, message, *values)


@contextmanager
def progress(title: str, total: int, bar: bool = True) -> Iterator[Callable[..., None]]:
    """Yields a function to tell what is done; shows it as a bar after two seconds, without a terminal or a bar as records.

    Of several ranks the first one shows it.
    """
    if not ranks.is_first():
        yield lambda done, note="": interrupts.check()
        return
    steady = Steady()

    def record(done: int, note: str = "") -> None:
        interrupts.check()
        steady.log("%s: %s of %s%s", title, done, total, f", {note}" * bool(note))

    if not (bar and sys.stderr.isatty()):
        yield record
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[note]}"), TimeRemainingColumn()
    shown = Progress(*columns, console=Console(stderr=True), transient=True)
    task, start = shown.add_task(title, total=total, note=""), time.perf_counter()

    def update(done: int, note: str = "") -> None:
        interrupts.check()
        if time.perf_counter() - start > 2 and not shown.live.is_started:
            shown.start()
        shown.update(task, completed=done, note=note)

    try:
        yield update
    finally:
        shown.stop()
