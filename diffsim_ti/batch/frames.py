"""Saved states of many scenes."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, overload

import numpy as np
from numpy.typing import ArrayLike

from diffsim_ti.common.brief import brief
from diffsim_ti.common.checked import as_numbers
from diffsim_ti.common.names import no_such
from diffsim_ti.common.public import Public
from diffsim_ti.outputs.output import Frames
from diffsim_ti.rollout.run import Run
from diffsim_ti.state.watch import ContactResolution
from diffsim_ti.terms import Robot

if TYPE_CHECKING:
    from diffsim_ti.batch.batch import Batch
    from diffsim_ti.scene import Scene


class LazyFrames(Sequence):
    """Frames of each scene, made by `make(b)` when they are asked for."""

    def __init__(self, count: int, make: Callable[[int], Frames]):
        self._made: list[Frames | None] = [None] * count
        self._make = make

    def __len__(self) -> int:
        return len(self._made)

    def __getitem__(self, b):
        if isinstance(b, slice):
            return [self[k] for k in range(len(self))[b]]
        if self._made[b] is None:
            self._made[b] = self._make(range(len(self))[b])
        return self._made[b]

    def __reduce__(self):
        return list, (list(self),)


def check_goes_on(scene: "Scene") -> None:
    """Raise ValueError unless a run may start from where another one ended, by positions and velocities."""
    if scene.law.state_names or scene.term(Robot):
        raise ValueError(
            "a run does not start from joints of robots that have moved, nor from what a law remembers: take a "
            "Simulator for each scene, whose steps go on from there"
        )


class BatchFrames(Sequence, metaclass=Public):
    """Saved states of many scenes: positions [m], velocities [m/s], displacements [m], (scenes, frames, n, 3).

    `frames[b]` are those of scene b (`Frames`), `frames["name"]` any output of all scenes, (scenes, ...). alive: (scenes,),
    whether the scene came to its end; the frames of one that did not hold its last good state from there on, and
    `error(b)` is what a run of it alone raises. `contact_resolution`: one for each scene.
    Made by a `batch`, from `values` of its inputs, `frames`, `errors` and `last_good` frames of each scene, and `states`,
    the three above, where they are known of all together.
    """

    def __init__(
        self,
        batch: "Batch",
        values: dict,
        frames: Sequence[Frames],
        last_good: np.ndarray,
        run: Run | None,
        errors: dict | list | None = None,
        states: tuple | None = None,
    ):
        self._batch, self.values, self._frames, self.run = batch, values, frames, run
        names = "positions", "velocities", "displacements"
        states = states or tuple(np.stack([getattr(one, name) for one in frames]) for name in names)
        self.positions, self.velocities, self.displacements = states
        self.times, self.last_good = batch.one.times, last_good
        self.alive = last_good == len(self.times) - 1
        self.outputs = {name: np.stack([one.outputs[name] for one in frames]) for name in batch.one.computed}
        self.sets: dict = {}  # inputs that were given by named sets
        self._errors: dict[int, Exception] = errors or {}
        self.alone: tuple[int, ...] = ()  # scenes that were run by themselves (joined_newton.py)

    def __len__(self) -> int:
        return len(self._frames)

    def __repr__(self) -> str:
        dead = len(self) - int(self.alive.sum())
        own = [f"{len(self)} scenes", f"times={brief(self.times)}", f"positions={brief(self.positions)}"]
        own += [f"outputs={brief(self.outputs)}"] * bool(self.outputs) + [f"{dead} stopped before the end"] * bool(dead)
        return f"BatchFrames({', '.join(own)})"

    @overload
    def __getitem__(self, key: str) -> np.ndarray: ...

    @overload
    def __getitem__(self, key: int) -> Frames: ...

    @overload
    def __getitem__(self, key: slice) -> Sequence[Frames]: ...

    def __getitem__(self, key):
        if isinstance(key, str):
            known = dict(positions=self.positions, velocities=self.velocities, displacements=self.displacements)
            known |= self.outputs
            if key not in known:
                raise KeyError(no_such("output", key, known, "this run"))
            return known[key]
        return self._frames[key]

    @property
    def end(self) -> dict[str, np.ndarray]:
        """The last states as inputs of a run that goes on from there, in float64: initial_positions, initial_velocities.

        `reset` restarts some scenes. What is given over time begins again with that run, and BDF2 with backward Euler.
        Raises ValueError for scenes with robots, and laws that remember, whose states no input of a run has.
        """
        check_goes_on(self._batch.scene)
        rest = self.values["rest_positions"]
        rest = np.stack(rest) if isinstance(rest, tuple) else rest
        return dict(
            initial_positions=rest + self.displacements[:, -1].astype(np.float64),
            initial_velocities=self.velocities[:, -1].astype(np.float64),
        )

    def reset(
        self, mask: ArrayLike | None = None, positions: ArrayLike | None = None, velocities: ArrayLike | None = None
    ) -> dict[str, np.ndarray]:
        """`end`, where the scenes of a mask (scenes,), default those that did not come to their end, restart.

        positions [m], velocities [m/s]: where and how, (n, 3) for all of these or (how many they are, n, 3); default the
        start of the scene. Raises ValueError for other shapes, and for numbers that are not finite.
        """
        mask = ~self.alive if mask is None else np.asarray(mask)
        if mask.shape != (len(self),) or mask.dtype != bool:
            raise ValueError(
                f"mask: expected {len(self)} booleans, one for each scene, got {mask.dtype} of {mask.shape}"
            )
        out, start = self.end, self._batch.scene.inputs.values
        for name, given in (("initial_positions", positions), ("initial_velocities", velocities)):
            rows = as_numbers(name, start[name] if given is None else given)
            shape = out[name].shape[1:]
            if rows.shape not in (shape, (int(mask.sum()), *shape)) or not np.isfinite(rows).all():
                raise ValueError(
                    f"{name.removeprefix('initial_')}: expected finite numbers of shape {shape} or "
                    f"{(int(mask.sum()), *shape)}, for the scenes that restart, got {rows.shape}"
                )
            out[name][mask] = rows
        return out

    @property
    def contact_resolution(self) -> list[ContactResolution]:
        """How near each scene came to obstacles, and how finely the substeps resolve that."""
        return [one.contact_resolution for one in self._frames]

    def error(self, b: int) -> Exception | None:
        """What stopped scene b: the error of a run of it alone; None if it lives."""
        if self.alive[b]:
            return None
        if b not in self._errors:
            self._errors[b] = self._batch.error_alone(self, b)
        return self._errors[b]
