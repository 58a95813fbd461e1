"""Chambers: gases and incompressible fluids in cavities."""
