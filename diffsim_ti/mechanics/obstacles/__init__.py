"""Obstacles: contact at vertices and within faces, friction, and the motion of obstacles."""
