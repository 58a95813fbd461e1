"""What monitors a run: energies and stresses, the largest stable step, and the guard that stops a run gone wrong."""
