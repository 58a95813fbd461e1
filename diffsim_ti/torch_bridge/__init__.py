"""What the PyTorch interface is made of; users import `diff_simulator` and `diff_physics`."""
