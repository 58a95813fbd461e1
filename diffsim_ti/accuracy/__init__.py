"""How accurate a result is: what its mesh, its steps, its solver and rounding cost, and meshes refined by that."""
