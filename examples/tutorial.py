# %% [markdown]
# A first walk through diffsim_ti, in cells: ten minutes in an editor that knows `# %%`, or `python examples/tutorial.py`.
# A soft column falls; its gradient is checked, its modulus identified, its stress drawn. Units are SI.

# %% Start. float64 for looking at gradients; training is done in float32.
from pathlib import Path

import numpy as np

import diffsim_ti as ds
from diffsim_ti.picture import save_picture

ds.init(precision="f64")
out = Path("output")
out.mkdir(exist_ok=True)

# %% A mesh: vertices and tetrahedra, with named sets of vertices. Files come in by `ds.TetrahedralMesh.from_file`.
mesh = ds.TetrahedralMesh.create_box(resolution=(4, 7, 4), size=(0.1, 0.2, 0.1), pattern="five").translated(
    (0, 0.02, 0)
)
print(mesh.num_vertices, "vertices,", mesh.num_tetrahedra, "tetrahedra; sets:", ", ".join(mesh.vertex_sets))

# %% A scene says what is simulated: a law with Young's modulus and Poisson's ratio, a density, and a list of terms.
material = ds.StableNeoHookean(E=3e4, nu=0.35)
terms = [ds.Gravity(), ds.Ground(height=0.0, stiffness=2e4, width=0.01, friction=0.4)]
scene = ds.Scene(mesh, material, density=1000.0, terms=terms)
print(scene.describe())

# %% A solver says how it goes on. Explicit solvers know their stable step beforehand and divide dt by it.
# Gradients through an impact want a third of it: a rollout warns where it has coarser ones, and says what it needs.
solver = ds.VelocityVerletSolver(scene, dt=0.01)
print(f"stable step {solver.stable_dt(tight=True)}; {solver.substeps} substeps to a step of 10 ms")
print(f"{solver.choose_substeps(share=1 / 3)} of a third of it")

# %% Let it fall, step by step.
simulator = ds.Simulator(solver)
for _ in range(20):
    simulator.step()
lowest = float(simulator.positions[:, 1].min())
print(f"after {simulator.time:.2f} s the lowest point is {1e3 * lowest:.1f} mm above the floor")
print({name: f"{energy:.3g} J" for name, energy in simulator.compute_energy().parts.items()})

# %% A rollout says what is kept and what it is differentiated by. Its gradients are those of the discrete run, exactly.
rollout = ds.Rollout(solver, steps=20, save_every=5, gradients=["youngs_modulus", "ground_height", "friction"])
frames = rollout.forward()
top = mesh.vertex_sets["ymax"]
seed = np.zeros_like(frames.positions)
seed[-1, top, 1] = 1 / len(top)  # of the mean height of the top at the end
gradients = rollout.vjp(frames, positions=seed)
print({name: f"{float(value):.4g}" for name, value in gradients.items()})

# %% Trust, but check: against differences, which the package does for you. It says right, WRONG or NOT RESOLVED.
report = ds.check_gradients(rollout)  # prints its table
assert report.passed

# %% Turn it round: E from what a camera sees, with a noise of half a millimetre, and how far to trust it.
seen = rollout.forward(youngs_modulus=4.5e4).positions[:, top]
seen = seen + 5e-4 * np.random.default_rng(0).standard_normal(seen.shape)
found = ds.identify(
    rollout,
    ds.Measurement("positions", seen, noise=5e-4, at=top),
    {"youngs_modulus": ds.Unknown(3e4, range=(1e4, 6e4))},
    check_mesh=False,  # data of this very mesh know nothing of its error; those of a real body do
)
low, high = found.intervals["youngs_modulus"]
print(f"E = {found.estimates['youngs_modulus']:.4g} Pa, 95 % within {low:.4g} and {high:.4g}; the truth was 4.5e4")

# %% And a picture of where it is strained.
stress = simulator.tetrahedron_fields().von_mises
save_picture(out / "tutorial.png", mesh, simulator.positions, stress, "von Mises stress [Pa]", ground=0.0)
print("output/tutorial.png")
