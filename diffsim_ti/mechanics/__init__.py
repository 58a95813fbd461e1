"""The physical things of a scene, a folder for each: what kernels and the host compute, with tangents and adjoints."""
