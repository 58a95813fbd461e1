"""Springs, cables, muscles and elastic foundations."""
