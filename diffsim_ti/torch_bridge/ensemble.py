"""Scenes of different meshes, and batches, spread over processes and machines; the bits of sums do not depend on how."""

import pickle
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from diffsim_ti.common import ranks
from diffsim_ti.common.public import Public

if TYPE_CHECKING:
    import torch


class Ensemble(metaclass=Public):
    """Members (rollouts, batches, experiments, of any meshes) that the ranks of `torch.distributed` share among them.

    members: one after the other; with make, what it makes them from: `make(member)` is called where the member is worked on,
    and once. costs: what each takes, in any unit, for shares that end together; default all alike.

    The same calls serve one process and, under torchrun, many on many machines (`torchrun --nproc_per_node=2
    --max-restarts=3 train.py`). Each rank works on its own members; what they give is gathered on all ranks and summed in
    the order of members, so results have the same bits on any number of ranks:

        total = sum_k l_k,    d total / dp = sum_k d l_k / dp        (k = 0, 1, ... in this order)

    Every rank holds what all members gave, for the time of the sum. An error of a member is raised on every rank.
    A `diffsim_ti.optimization.Optimization` of a total writes its state on the first rank only. When a rank dies, torchrun
    starts all of them again from that state, and at most one iteration is done twice. Random numbers: from a generator
    seeded by the member, for ranks draw apart. Each rank takes its share of the machine's cores.

    Paszke et al. 2019, PyTorch, arXiv:1912.01703; torchrun: docs.pytorch.org/docs/stable/elastic/run.html.
    Raises ValueError for no members, and for costs that are not as many, or not > 0.
    """

    def __init__(
        self, members: Iterable, make: Callable[[Any], Any] | None = None, costs: Sequence[float] | None = None
    ):
        self._given, self._make, self._made = list(members), make, {}
        if not self._given:
            raise ValueError("members: there are none; give rollouts, batches, or what `make` makes them from")
        costs = np.ones(len(self)) if costs is None else np.asarray(costs, np.float64)
        if costs.shape != (len(self),) or not (costs > 0).all() or not np.isfinite(costs).all():
            rule = f"expected {len(self)} finite numbers > 0, one for each member"
            raise ValueError(f"costs: {rule}, got {costs.tolist()}")
        self.rank, self.num_ranks, self.is_first = ranks.rank(), ranks.world(), ranks.rank() == 0
        self.own = shares(costs, self.num_ranks)[self.rank]

    def __len__(self) -> int:
        return len(self._given)

    def __repr__(self) -> str:
        return f"Ensemble({len(self)} members, {len(self.own)} of them on rank {self.rank} of {self.num_ranks})"

    def member(self, k: int):
        """Member k as this rank has it."""
        if self._make is None:
            return self._given[k]
        if k not in self._made:
            self._made[k] = self._make(self._given[k])
        return self._made[k]

    def map(self, function: Callable[[Any], Any]) -> list:
        """function(member) of every member, in their order, on every rank. What it returns must pickle.

        Raises the error of the first member in which there was one, on every rank, with a note that names the member.
        """
        results: dict[int, Any] = {}
        for k in self.own:
            try:
                results[k] = function(self.member(k)), None
            except Exception as error:
                results[k] = None, _sendable(error)
                break  # the others learn of it, and nobody waits for a sum that will not be
        everything: dict[int, Any] = {}
        for part in ranks.gathered(results):
            everything |= part
        for k, (_, error) in sorted(everything.items()):
            if error is not None:
                if hasattr(error, "add_note"):  # since Python 3.11
                    error.add_note(f"in member {k} of the ensemble")
                raise error
        return [everything[k][0] for k in range(len(self))]

    def total(self, function: Callable[[Any], tuple[float, dict]]) -> tuple[float, dict[str, np.ndarray]]:
        """(sum of losses, sums of gradients by name) of function(member) -> (loss, gradients), as `Rollout.vjp` has them.

        A name that a member does not have counts as zero there. Raises ValueError for shapes that differ.
        """
        total, out = 0.0, {}
        for k, (loss, gradients) in enumerate(self.map(function)):
            total += float(loss)
            for name, gradient in gradients.items():
                gradient = np.asarray(gradient)
                if name in out and out[name].shape != gradient.shape:
                    raise ValueError(
                        f"gradient by {name}: shape {gradient.shape} of member {k}, {out[name].shape} of those before it: "
                        "return from the function what all members have in common"
                    )
                out[name] = out[name] + gradient if name in out else gradient.copy()
        return total, out

    def loss(
        self, function: Callable[[Any], "torch.Tensor"], parameters: "torch.nn.Module | Iterable[torch.Tensor]"
    ) -> "torch.Tensor":
        """Sum of function(member), scalar tensors, as a tensor whose `backward()` adds its gradients to the parameters.

        parameters: a module, or tensors from which the function computes again at each call.
        """
        from diffsim_ti.torch_bridge.ensemble_node import total_of

        return total_of(self, function, parameters)


def shares(costs: np.ndarray, ranks: int) -> list[list[int]]:
    """Members of each rank: the dearest first, each to the rank that has least to do (Graham 1969, doi:10.1137/0117039)."""
    load, out = np.zeros(ranks), [[] for _ in range(ranks)]
    for k in np.argsort(-costs, kind="stable"):
        rank = int(load.argmin())
        out[rank].append(int(k))
        load[rank] += costs[k]
    return [sorted(part) for part in out]


def _sendable(error: Exception) -> Exception:
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error
