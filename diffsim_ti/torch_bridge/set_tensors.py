"""Inputs of runs as tensors: numbers of named sets spread over tetrahedra, and the way to arrays of the host."""

from collections.abc import Mapping

import numpy as np

from diffsim_ti.batch.batch_inputs import own_sets
from diffsim_ti.common.checked import numbers as as_array
from diffsim_ti.rollout.set_values import per_tetrahedron, rows_of_sets
from diffsim_ti.scene import Scene
from diffsim_ti.torch_bridge.autograd import torch


def as_tensors(scene: Scene, values: dict, given: dict, scenes: int | None = None) -> dict[str, torch.Tensor]:
    """Inputs as tensors, those of named sets spread; scenes: as in `spread_tensors`.

    Raises ValueError for what is no floating point number, and for displacements beside another rest shape.
    """
    if "rest_positions" in given and "initial_displacements" in given:
        raise ValueError("with rest_positions, give initial_positions: initial_displacements are those from the mesh")
    out = {}
    for name, x in given.items():
        x = spread_tensors(scene, name, values.get(name), x, scenes) if isinstance(x, Mapping) else x
        out[name] = x if isinstance(x, torch.Tensor) else torch.from_numpy(as_array(name, x))
        if not out[name].is_floating_point():
            raise ValueError(f"{name}: expected a floating point tensor, got {out[name].dtype}")
    return out


def on_host(name: str, tensor: torch.Tensor, rest: np.ndarray) -> tuple[str, np.ndarray]:
    """(name of an input, its value) of a tensor; rest: places that "initial_displacements" are from."""
    value = tensor.detach().to("cpu", torch.promote_types(tensor.dtype, torch.float32)).numpy()
    return ("initial_positions", rest + value) if name == "initial_displacements" else (name, value)


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
