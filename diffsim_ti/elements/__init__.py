"""What a tetrahedron adds to forces, to their differential and to the adjoint."""
