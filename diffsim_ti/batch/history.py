"""States of many scenes on the device, in slots."""

import taichi as ti

from diffsim_ti import runtime
from diffsim_ti.runtime.slots import copy_slot


class BatchHistory:
    """States of a batch in `num_slots` slots, forces and what vertices met with them if recorded, and the law's states."""

    def __init__(self, workspace, num_slots: int, record: bool = False):
        layout, n, self.num_slots = workspace.layout, workspace.arrays.num_vertices, num_slots
        self.u, self.v = (layout.vectors(num_slots, n) for _ in range(2))
        self.f = layout.vectors(num_slots, n) if record else runtime.array(layout.vector, 1, 1)
        self.z = layout.numbers(num_slots, workspace.law_rows) if workspace.law_rows else None
        calm = record and layout.in_lanes and workspace.some_special
        self.calm = runtime.array(ti.i32, num_slots * n * layout.num_blocks if calm else 1)

    def copy(self, slot: int, target: "BatchHistory", to: int) -> None:
        for name in ("u", "v") if self.z is None else ("u", "v", "z"):
            copy_slot(getattr(self, name), slot, getattr(target, name), to)
