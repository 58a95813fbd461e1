"""Answers to names that torch-diffsim's documents teach and that are something else here: what to use in their place."""

from importlib import import_module
from typing import TypeVar

C = TypeVar("C", bound=type)

_FIXED = (
    "what is fixed is part of a scene: Scene(mesh, material, terms=[Gravity()], fixed=vertices), then "
    "Simulator(SemiImplicitSolver(scene, dt=...)); or solver.set_fixed_vertices(vertices) before Simulator(mesh, material, "
    "solver)"
)
_STRESS = "the stress of a run is an output: Rollout(solver, steps, outputs=[Stress(kind='first_piola')])"
_DEVICE = "init(backend='cuda') says where it is simulated"
_SURFACES = (
    "surfaces push each other apart by a term of a scene: Scene(mesh, material, terms=[Gravity(), SelfContact()])"
)
_EDGES = "mesh.shape_gradients has grad N of each corner, of which compute_deformation_gradient(positions) makes F"

# of a class, or of the package, {name of an attribute or of an argument: what to use}
ANSWERS: dict[str, dict[str, str]] = {
    "SeedNames": dict(Dm=_EDGES, Dm_inv=_EDGES, device=f"a mesh lives in NumPy; {_DEVICE}"),
    "Material": dict(
        energy_density="in torch DifferentiableMaterial(E, nu).energy_density(F); of a run, the output ElasticEnergy",
        first_piola_kirchhoff_stress=_STRESS,
        first_piola_kirchhoff_stress_analytic=_STRESS,
        compute_elastic_forces="what holds a body is an output, Reaction(support); stress is another, Stress()",
        mu="material.lame(material.values(mesh)) gives mu and lam",
        lam="material.lame(material.values(mesh)) gives mu and lam",
    ),
    "SemiImplicitSolver": dict(
        step="a solver says how, a simulator steps: Simulator(solver).step()",
        enable_self_collision=_SURFACES,
        collision_method=_SURFACES,
        gravity_value="gravity is a term of its scene: solver.scene.inputs.values['gravity']",
    ),
    "Simulator": dict(
        set_fixed_vertices=_FIXED,
        fix_bottom_vertices=_FIXED.replace("fixed=vertices", "fixed='ymin'"),
        fixed_vertices="simulator.scene.fixed",
        add_velocity="simulator.set_state(velocities=simulator.velocities + change)",
        masses="simulator.scene.mass_matrix()",
        warmstart="simulator.run(steps); what comes to rest is found by StaticSolver",
        get_surface_mesh="simulator.positions with simulator.scene.mesh.surface_triangles",
        mesh="simulator.scene.mesh",
        material="simulator.scene.material",
        density="give it to Scene(mesh, material, density), or to SemiImplicitSolver(dt=..., density=...)",
        device=_DEVICE,
        use_compile="kernels are always compiled: leave it out",
    ),
    "DifferentiableSimulator": dict(
        compute_loss="write it in torch, such as torch.mean((simulator.positions - target) ** 2)",
        masses="simulator.last_rollout.scene.mass_matrix()",
    ),
    "DifferentiableSolver": dict(
        step="a solver says how, a simulator steps: DifferentiableSimulator(mesh, material, solver).step()",
        contact_handler="contact is an argument of DifferentiableSimulator, contact=DifferentiableBarrierContact(...)",
        use_implicit_diff="gradients are exact without it; for implicit steps take method=ImplicitEulerSolver",
    ),
    "SimulationVisualizer": dict(
        run="call simulator.step() and update(positions) in a loop; or `diffsim-ti view` on a mesh",
        animate_offline="save_film of diffsim_ti.film writes a film without a window",
    ),
    "diffsim_ti": dict(
        IPCCollisionHandler=_SURFACES,
        SimplifiedCollisionHandler=_SURFACES,
        collision=_SURFACES,
        PolyscopeVisualizer="from diffsim_ti.visualizer import SimulationVisualizer",
    ),
}

# names of the package that need torch -> where they are; torch is imported when one is asked for
OF_TORCH = {"rollout_frames": "torch_bridge.rollout_node", "TorchSimulator": "torch_bridge.simulator"}
OF_TORCH |= dict.fromkeys(["DifferentiableSimulator", "DifferentiableSolver"], "diff_simulator")
_PHYSICS = (
    "DifferentiableBarrierContact ImplicitDifferentiation CheckpointedRollout DifferentiableMaterial TorchMaterial"
)
_PHYSICS += " SpatiallyVaryingMaterial conjugate_gradient smooth_step log_barrier"
OF_TORCH |= dict.fromkeys(_PHYSICS.split(), "diff_physics")


def package_attribute(name: str) -> object:
    """A name of the package that needs torch; AttributeError, with what to use if there is such, for any other."""
    if name in OF_TORCH:
        return getattr(import_module(f"diffsim_ti.{OF_TORCH[name]}"), name)
    if said := answer("diffsim_ti", name):
        raise AttributeError(f"diffsim_ti has no {name!r}: {said}")
    package = import_module("diffsim_ti")
    raise AttributeError(f"module 'diffsim_ti' has no attribute {name!r}", name=name, obj=package)


def answer(owner: type | str, name: str) -> str | None:
    """What to use in the place of a name that a class (or one of its bases), or the package, does not have."""
    owners = [owner] if isinstance(owner, str) else [base.__name__ for base in owner.__mro__]
    return next((ANSWERS[own][name] for own in owners if name in ANSWERS.get(own, {})), None)


def answered(cls: C) -> C:
    """Decorator of a class: an attribute that is not there and has an answer raises AttributeError with it."""

    def __getattr__(self, name: str):
        if said := answer(type(self), name):
            raise AttributeError(f"{type(self).__name__} has no {name!r}: {said}")
        return object.__getattribute__(self, name)  # the error that it is, of a property too

    cls.__getattr__ = __getattr__
    return cls
