"""Articulated robots of URDF files: the file, kinematics and dynamics by Pinocchio, links as obstacles."""
