"""What all of the package shares and what knows nothing of bodies: checks, differences, progress, interrupts."""
