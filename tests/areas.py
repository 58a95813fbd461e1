"""What the test files are about, by area, and the table of README.md that says how many minutes each area takes."""

import re
from pathlib import Path

PAGE = Path(__file__).parent / "README.md"
HEAD = "| area | files test_*.py | minutes |\n| --- | --- | ---: |\n"

# area -> files, without test_ and .py
AREAS = {
    "meshes, scenes, materials": "mesh exchange files locate scene inputs named_sets loads chambers springs muscles "
    "loads_together held_volumes supports materials tensor_calculus open_laws growth growth_over_time surface_drag "
    "rotating_frame step_inputs laws_with_state orthotropic initial_stress plasticity viscosity viscous_stages deprecated "
    "rubber_library",
    "motion against closed forms": "reference_motion step_limit mass_scaling unequal_steps energy_watch hertz torture",
    "every adjoint, order, fuzz": "every_adjoint term_order gradient_fuzz",
    "gradients": "gradients batch batch_tape gradient_clip gradient_faults checkpoints tape outputs "
    "contact_force reaction tensor_outputs work modes identification identify identify_experiments",
    "implicit steps and equilibria": "implicit implicit_cycle linear_solves implicit_gradients implicit_contact "
    "swept solve_report load_path couplings reduced reduced_explicit reduced_rigid tie",
    "patches against locking": "locking",
    "ten-node tetrahedra": "reference_element quadratic quadratic_mesh quadratic_loads quadratic_outputs quadratic_solvers "
    "quadratic_answers nafems curved_contact",
    "obstacles and friction": "contact mesh_obstacle contact_area contact_stage contact_rollers "
    "contact_crossing contact_friction contact_gradients obstacle_pairs own_obstacle poses far_from_origin robots",
    "self-contact": "self_contact self_contact_implicit self_contact_near self_contact_pairs self_contact_friction "
    "contact_corpus",
    "PyTorch, optimisations": "ensemble torch torch_physics torch_solvers seed_snippets step_sizes optimization designs",
    "charts, maps, advice": "accuracy sweep study study_stability peers public_benchmarks",
    "pictures, films, the window": "picture_drawing picture_film camera marks "
    "optimization_picture writers viewer viewer_window gallery",
    "examples and pages": "types release reference words examples environment contact_examples static_examples "
    "torch_examples readme",
    "command line, resources, backends": "cli manners calls advice hard_use strength layout resources devices launch "
    "executed_ptx single_precision fewer_variables kernel_sizes tracer",
}
# files of a minute or so, or that go together, the longest first: in several processes they come before all others
LONGEST = (
    "examples contact_stage term_order gradients reduced_explicit readme curved_contact muscles contact_examples swept "
    "contact_force quadratic gradient_fuzz implicit_cycle chambers batch mesh_obstacle laws_with_state "
    "self_contact_friction open_laws contact_corpus torch_examples plasticity implicit springs quadratic_answers "
    "resources torch energy_watch obstacle_pairs poses implicit_gradients static_examples loads locking implicit_contact "
    "viscosity self_contact_implicit optimization"
).split()
# files that start Taichi anew, the longest first: whatever comes after them compiles again what others have compiled
LAST = "identify_experiments cli study_stability hard_use strength sweep exchange types marks identify".split()
AREA_OF = {name: area for area, names in AREAS.items() for name in names.split()}
# files whose scenes are the same, so that one process compiles their kernels once
TOGETHER = [
    names.split()
    for names in (
        "gradients outputs unequal_steps gradient_faults checkpoints tape term_order every_adjoint",
        "muscles growth_over_time rotating_frame surface_drag",
        "quadratic quadratic_solvers",
        "quadratic_outputs tensor_outputs",
        "reduced_explicit reduced reduced_rigid",
        "contact_stage contact_gradients contact contact_crossing contact_friction",
        "implicit solve_report",
        "swept contact_area",
        "self_contact_implicit self_contact",
        "chambers held_volumes",
        "loads supports",
        "viscosity viscous_stages",
    )
]


def place(stem: str) -> int:
    """Where a file comes when processes share the suite: the longest first, and last those that start Taichi anew."""
    name = stem.removeprefix("test_")
    if name in LAST:
        return len(LONGEST) + 1 + LAST.index(name)
    return LONGEST.index(name) if name in LONGEST else len(LONGEST)


def together(path: str) -> str:
    """What stands for a file when processes share the suite: the first of those that go to one process with it."""
    name = Path(path).stem.removeprefix("test_")
    return next((names[0] for names in TOGETHER if name in names), path)


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
