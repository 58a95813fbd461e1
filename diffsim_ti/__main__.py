"""`python -m diffsim_ti` is `diffsim-ti`."""

from diffsim_ti.cli import main

main()
