"""Obstacles: contact at vertices, friction, and the motion of obstacles."""
