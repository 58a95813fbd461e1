"""Tensor calculus that the laws share."""
