"""Obstacles, one shape per file, and what they share: barrier, friction, path."""
