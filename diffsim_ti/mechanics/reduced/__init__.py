"""Sets that move by few numbers: rigid and affine sets."""
