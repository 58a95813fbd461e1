"""Pressures that follow the surface they act on."""
