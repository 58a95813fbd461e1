"""Meshes of files: own readers of what others read wrongly or not at all, and meshio for the rest."""
