"""What a law remembers: in implicit passes, where it moves on once, from the state before and where the pass ends; and in
the frames of a run."""

from dataclasses import dataclass

import numpy as np
import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.mechanics.stress.patched_tetrahedron import ElementKernels
from diffsim_ti.mechanics.stress.tetrahedron import Onwards
from diffsim_ti.runtime import A, Bundle, Kernel, as_kernel, traced
from diffsim_ti.runtime.slots import add_slot, copy_slot
from diffsim_ti.state.numbers import OF_TETRAHEDRA, SCENE, TANGENT

AT = dict(u="vectors2", z="blocks2")
NUMBERS = dict(num_items="int", num_vertices="int", slot="int", end="int", h="float")


@dataclass(frozen=True)
class LawStateKernels(ElementKernels):
    """From z in slot `slot` and u in slot `end`, over the length h [s]: forward, tangent and adjoint."""

    @traced
    def onwards(self, plan) -> Onwards:
        return Onwards(h=plan.h, moves=None)

    @as_kernel("law_state", at=AT)
    def forward(self, scene: A, at: A, plan: A):
        """The state after the pass, in the place of that before."""
        ti.loop_config(serialize=not self.parallel)
        for e in range(plan.num_items):
            self.element.move_on(e, scene, at, plan.slot, plan.slot, self.onwards(plan), plan.end)

    @as_kernel("law_state_jvp", at=AT, tangent=TANGENT | dict(w="vectors2", z="blocks2"))
    def jvp(self, scene: A, at: A, tangent: A, plan: A):
        """The change tangent.z of the state, for a change tangent.w of the displacement."""
        ti.loop_config(serialize=not self.parallel)
        for e in range(plan.num_items):
            change = Bundle(u=tangent.w, z=tangent.z)
            self.element.move_on_jvp(e, scene, at, plan.slot, change, tangent, self.onwards(plan), plan.end)

    @as_kernel("law_state_vjp", at=AT, adjoint=OF_TETRAHEDRA | dict(z="blocks2", corner="vectors", y="vectors2"))
    def vjp(self, scene: A, at: A, adjoint: A, plan: A):
        """From the adjoint.z of the state after to that before; adjoint.y of u; adds those of all else."""
        ti.loop_config(serialize=not self.parallel)
        for e in range(plan.num_items):
            on = self.onwards(plan)
            self.element.move_on_vjp(
                e, scene, at, plan.slot, on, adjoint.corner, adjoint, self.features.shape, plan.end
            )
        ti.loop_config(serialize=not self.parallel)
        for i in range(plan.num_vertices):
            adjoint.y[0, i] = self.element.gather(i, scene, adjoint.corner)

    def _kernel(self, name: str, body, **arrays) -> Kernel:
        return Kernel(name, body, self.law.precision, dict(scene=SCENE) | arrays, NUMBERS)


class LawFrames:
    """Blocks of each frame, as those of a state; frame -1 is none."""

    def __init__(self, workspace):
        self.arrays = workspace.arrays
        self.z = self.arrays.law_states(workspace.frames.frames_u.shape[0])

    def note(self, frame: int, z, slot: int = 0) -> None:
        """A frame has what is in a slot of z."""
        if frame >= 0:
            copy_slot(z, slot, self.z, frame)

    def noted_before(self, launches, z, base: int = 0, stride: int = 0):
        """Launches (`ExplicitWorkspace.launches`), before each of which the frame that it shows has what is in z; slots of z
        as in `Passes`."""
        for numbers in launches:
            self.note(numbers["shown"], z, (numbers["first"] - base) * stride)
            yield numbers

    def added_after(self, launches, z):
        """Launches of a reverse sweep, after each of which what the frame has that it shows is added to z."""
        for numbers in launches:
            yield numbers
            self.add_to(z, numbers["shown"])

    def values(self) -> np.ndarray:
        """Shape (frames, num_tetrahedra, S), or (frames, num_tetrahedra, 4, S) at the points of ten nodes, in float64."""
        return np.stack([self.arrays.law_state_of(blocks) for blocks in runtime.fetch(self.z)])

    def put(self, values: np.ndarray | None) -> None:
        """The same of others; None: zero."""
        runtime.fill(self.z, 0 if values is None else np.stack([self.arrays.to_blocks(rows) for rows in values]))

    def add_to(self, z, frame: int) -> None:
        """Add what a frame has to slot 0 of z."""
        if frame >= 0:
            add_slot(self.z, frame, z, 0)
