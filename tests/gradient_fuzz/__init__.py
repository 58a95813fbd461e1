"""A fuzz of gradients: random scenes over the public surface, judged by tangents, differences, other faces and schedules."""
