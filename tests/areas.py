"""What the test files are about, by area, and the table of README.md that says how many minutes each area takes."""

import re
from pathlib import Path

PAGE = Path(__file__).parent / "README.md"
HEAD = "| area | files test_*.py | minutes |\n| --- | --- | ---: |\n"

# area -> files, without test_ and .py. Neighbours have kinds of scenes in common, and short files stand in the middle: of
# two processes one begins with the first file, and the other with the last.
AREAS = {
    "obstacles and friction": "contact_stage contact_gradients contact contact_crossing contact_friction contact_force "
    "contact_rollers mesh_obstacle obstacle_pairs poses own_obstacle contact_area far_from_origin robots",
    "self-contact": "self_contact_friction self_contact self_contact_pairs self_contact_near self_contact_implicit "
    "contact_corpus curved_contact",
    "implicit steps and equilibria": "swept implicit_contact couplings tie reduced_explicit reduced reduced_rigid implicit "
    "solve_report implicit_cycle linear_solves implicit_gradients load_path",
    "examples and pages": "contact_examples readme examples torch_examples static_examples long_examples environment "
    "reference release words types",
    "pictures, films, the window": "gallery picture_drawing picture_film camera marks optimization_picture writers viewer "
    "viewer_window",
    "command line, resources, backends": "cli manners calls advice hard_use strength layout resources devices launch "
    "executed_ptx single_precision fewer_variables kernel_sizes tracer",
    "charts, maps, advice": "accuracy sweep study study_stability peers public_benchmarks",
    "PyTorch, optimisations": "designs step_sizes optimization torch_physics torch_solvers seed_snippets ensemble torch",
    "gradients": "identify identify_experiments identification modes work batch_tape batch gradient_clip gradient_faults "
    "checkpoints tape outputs reaction tensor_outputs gradients",
    "every adjoint, order, fuzz": "gradient_fuzz term_order every_adjoint",
    "motion against closed forms": "torture hertz step_limit mass_scaling reference_motion energy_watch unequal_steps",
    "patches against locking": "locking",
    "ten-node tetrahedra": "reference_element quadratic_mesh nafems quadratic_outputs quadratic_answers quadratic_loads "
    "quadratic quadratic_solvers",
    "meshes, scenes, materials": "mesh exchange files locate scene inputs named_sets deprecated materials tensor_calculus "
    "rubber_library orthotropic initial_stress step_inputs loads supports loads_together chambers held_volumes springs "
    "muscles growth_over_time rotating_frame surface_drag growth viscosity viscous_stages open_laws laws_with_state "
    "plasticity",
}
AREA_OF = {name: area for area, names in AREAS.items() for name in names.split()}
ORDER = {name: k for k, name in enumerate(AREA_OF)}
# files that start Taichi anew, the longest first: whatever comes after them compiles again what others have compiled
LAST = "identify_experiments cli study_stability hard_use strength sweep exchange types marks identify".split()


def place(path: str) -> int:
    """Where a file comes when processes share the suite: those that start Taichi anew are the last."""
    name = Path(path).stem.removeprefix("test_")
    return len(ORDER) + LAST.index(name) if name in LAST else ORDER.get(name, 0)


def minutes_of(reports) -> dict[str, float]:
    """Minutes of each area from pytest's reports; files that are in no area go by their own name."""
    minutes = {}
    for report in reports:
        name = Path(report.nodeid.split("::")[0]).stem.removeprefix("test_")
        area = AREA_OF.get(name, name)
        minutes[area] = minutes.get(area, 0.0) + report.duration / 60
    return minutes


def table(minutes: dict) -> str:
    """Markdown; areas whose minutes are not known keep an empty cell."""
    cells = {area: minutes.get(area, "") for area in AREAS}
    return HEAD + "".join(
        f"| {area} | {', '.join(AREAS[area].split())} | {spent if spent == '' else format(spent, '.1f')} |\n"
        for area, spent in cells.items()
    )


def write(minutes: dict) -> None:
    """Put the table into README.md."""
    PAGE.write_text(re.sub(re.escape(HEAD) + r"(\|.*\n)*", lambda _: table(minutes), PAGE.read_text()))
