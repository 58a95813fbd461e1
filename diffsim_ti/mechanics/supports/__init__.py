"""Vertices that are fixed or constrained in some directions."""
