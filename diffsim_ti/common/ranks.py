"""The processes of a task that torchrun started: which one this is, and what all of them learn from each other.

One process alone is such a group, too: then nothing is sent and torch is not imported.
"""

import os
import sys


def _started_by_torchrun() -> bool:
    return int(os.environ.get("WORLD_SIZE", 1)) > 1 and "RANK" in os.environ and "MASTER_ADDR" in os.environ


def is_first() -> bool:
    """Whether this process is the one that writes files and shows progress."""
    return not _started_by_torchrun() or os.environ["RANK"] == "0"


def share_of_cores() -> int | None:
    """How many of this machine's cores each of its ranks may keep busy; None in one process, which takes all."""
    local = int(os.environ.get("LOCAL_WORLD_SIZE", 1))
    return max(1, (os.cpu_count() or 1) // local) if _started_by_torchrun() and local > 1 else None


def _group():
    """torch.distributed, once its processes have met; None in one process alone."""
    if not _started_by_torchrun() and "torch.distributed" not in sys.modules:
        return None
    import torch.distributed as dist

    if not dist.is_available():
        return None
    if not dist.is_initialized() and _started_by_torchrun():
        _meet(dist)
    return dist if dist.is_initialized() and dist.get_world_size() > 1 else None


def _meet(dist) -> None:
    """Start the group. What is sent are numbers of the host, on cards too: gloo.

    On one machine torchrun keeps its store over restarts, and with it the addresses of ranks that are dead: each start
    writes under a name of its own. Several machines count their starts apart (README: a store for each start).
    """
    store, rank, world = next(dist.rendezvous("env://"))
    if os.environ.get("GROUP_WORLD_SIZE") == "1":
        store = dist.PrefixStore("start " + os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"), store)
    dist.init_process_group("gloo", store=store, rank=rank, world_size=world)


def rank() -> int:
    """The number of this process."""
    group = _group()
    return 0 if group is None else group.get_rank()


def world() -> int:
    """How many processes there are."""
    group = _group()
    return 1 if group is None else group.get_world_size()


def gathered(value) -> list:
    """What every rank gives here, in their order, on all of them."""
    group = _group()
    if group is None:
        return [value]
    out = [None] * group.get_world_size()
    group.all_gather_object(out, value)
    return out


def from_first(value):
    """What the first rank gives here, on all of them."""
    group = _group()
    if group is None:
        return value
    box = [value]
    group.broadcast_object_list(box, src=0)
    return box[0]
