"""Numbers of named sets as tensors."""

from collections.abc import Mapping

import numpy as np

from diffsim_ti.batch.set_values import own_sets
from diffsim_ti.rollout.set_values import per_tetrahedron, rows_of_sets
from diffsim_ti.scene import Scene
from diffsim_ti.torch_bridge.autograd import torch


def spread_tensors(
    scene: Scene, name: str, base: np.ndarray, numbers: Mapping, scenes: int | None = None
) -> torch.Tensor:
    """The values of all tetrahedra from tensors of named sets, whose gradients torch sums.

    scenes: of a batch, where numbers of sets may have that axis in front; the values have it if one has.
    """
    rows = rows_of_sets(scene, name, numbers)
    given = [x for x in numbers.values() if isinstance(x, torch.Tensor) and x.is_floating_point()]
    like = given[0] if given else torch.zeros((), dtype=torch.float64)
    numbers = {key: x if isinstance(x, torch.Tensor) else like.new_tensor(x) for key, x in numbers.items()}
    own = own_sets(scene, name, base, numbers, scenes) if scenes else ()
    out = torch.as_tensor(per_tetrahedron(scene, name, base)).to(like)
    if own:
        out = out.expand(scenes, *out.shape)
    first = 1 if own else 0  # the axis of tetrahedra
    for key, places in rows.items():
        at = torch.tensor(places.tolist(), device=out.device)
        number = numbers[key].to(out)
        number = number.unsqueeze(1) if key in own else number
        out = out.index_copy(first, at, number.expand(*out.shape[:first], len(at), *out.shape[first + 1 :]))
    return out
