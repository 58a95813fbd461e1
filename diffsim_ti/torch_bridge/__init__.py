"""What the PyTorch face is made of; users import `diff_simulator` and `diff_physics`."""
