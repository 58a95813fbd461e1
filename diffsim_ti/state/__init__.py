"""A scene on the device: its numbers, the states of a run, and what watches them."""
