"""Chambers: gases and held volumes in cavities."""
