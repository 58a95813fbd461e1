"""Work of a study in this process, or by any executor: pools of processes here, Dask's on a cluster."""

import multiprocessing
from collections.abc import Callable, Iterable
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from contextlib import nullcontext


def pool(workers: int) -> ProcessPoolExecutor:
    """Processes that start by spawn, for Taichi's threads do not survive a fork."""
    return ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))


def workers_of(count: int):
    """A context with `pool(count)`, or with None for one process. Raises ValueError for less."""
    if count < 1:
        raise ValueError(f"--workers must be >= 1, got {count}")
    return pool(count) if count > 1 else nullcontext()


def each(
    executor: Executor | None,
    function: Callable,
    calls: Iterable[tuple],
    show: Callable[..., None] = lambda done, note="": None,
) -> list:
    """function(*call) of each call, in their order; show(done) as they end. Of an executor only `submit` is used.

    The first error ends it, and cancels what has not begun.
    """
    calls = list(calls)
    if executor is None:
        out = []
        for call in calls:
            out.append(function(*call))
            show(len(out))
        return out
    futures = [executor.submit(function, *call) for call in calls]
    try:
        for done, future in enumerate(as_completed(futures)):
            future.result()
            show(done + 1)
    finally:
        for future in futures:
            future.cancel()
    return [future.result() for future in futures]
