"""Gases in chambers among a scene's forces."""

from dataclasses import dataclass

from diffsim_ti.mechanics.interaction import ItemForce


@dataclass(frozen=True)
class GasForce(ItemForce):
    """Corners of chambers, whose forces are written by launches of their own before each pass (gases.py)."""

    per_step: bool
    name, apart, reads_rest, asks_for_steps = "gases", True, True, True
