"""Drag and lift of a fluid on the surface."""
