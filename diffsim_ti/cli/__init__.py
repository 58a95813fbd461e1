"""The command line: `diffsim-ti` or `python -m diffsim_ti`."""

from diffsim_ti.cli.app import main

__all__ = ["main"]
