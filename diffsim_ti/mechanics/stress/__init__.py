"""The body's own stress: tetrahedra of four and ten nodes, patches of them, growth, viscosity and state of laws."""
