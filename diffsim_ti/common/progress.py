"""A bar on stderr for what takes long."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from diffsim_ti.common import interrupts, ranks


@contextmanager
def progress(title: str, total: int) -> Iterator[Callable[..., None]]:
    """Yields a function to tell what is done; shows it on stderr after two seconds, as lines if that is no terminal.

    Of several ranks the first one shows it.
    """
    if not ranks.is_first():
        yield lambda done, note="": interrupts.check()
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[note]}"), TimeRemainingColumn()
    bar = Progress(*columns, console=console, transient=True)
    task, start, said = bar.add_task(title, total=total, note=""), time.perf_counter(), [time.perf_counter()]

    def update(done: int, note: str = "") -> None:
        interrupts.check()
        now = time.perf_counter()
        if console.is_terminal and now - start > 2 and not bar.live.is_started:
            bar.start()
        elif not console.is_terminal and now - said[0] > 5:
            said[0] = now
            print(f"{title}: {done} of {total}, {note}", file=sys.stderr, flush=True)
        bar.update(task, completed=done, note=note)

    try:
        yield update
    finally:
        bar.stop()
