"""A scene: what is simulated, and nothing about how."""

from diffsim_ti.scene.scene import Scene as Scene
