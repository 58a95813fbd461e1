"""Soft bodies as environments of Gymnasium: `import diffsim_ti.envs` registers them, and starts nothing.

    gymnasium.make("diffsim_ti/Jumper-v0")
    gymnasium.make_vec("diffsim_ti/Crawler-v0", num_envs=64)

`make_vec` gives many scenes in one `diffsim_ti.Batch`, computed side by side; `make` gives one of them.
"""

try:
    import gymnasium
except ImportError:
    raise ImportError('diffsim_ti.envs: Gymnasium is missing; pip install "diffsim-ti[envs]"') from None

TASKS = {"Jumper": "jumper:SoftJumper", "Crawler": "crawler:SoftCrawler", "Grasp": "grasp:SoftGrasp"}
for _name, _place in TASKS.items():
    _one = f"diffsim_ti.envs.{_place}"
    if f"diffsim_ti/{_name}-v0" not in gymnasium.registry:
        gymnasium.register(f"diffsim_ti/{_name}-v0", entry_point=_one, vector_entry_point=f"{_one}s")
