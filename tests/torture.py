"""What a simulator must survive, and the tests that see to it. `python tests/torture.py` writes the tables of README.md."""

import re
from pathlib import Path

HERE = Path(__file__).parent
PAGE = HERE / "README.md"
HEADING = "## What must hold where methods fail"

# what must hold -> the tests, as file:name without "test_"
ROWS = {
    "Inputs": {
        "indices out of range, negative or not whole are named": "mesh:bad_tetrahedra_refused",
        "no vertices, wrong shapes, coordinates that are not finite are named": "mesh:bad_vertices_refused",
        "inside-out tetrahedra are counted and the worst named; turning them is a choice": "mesh:inside_out_refused_with_count_and_worst mesh:fix_orientation_turns_all_and_changes_nothing_else",
        "flat tetrahedra and repeated vertices are refused": "mesh:bad_tetrahedra_refused",
        "a built box is filled exactly and conforming": "mesh:cube_is_filled_exactly mesh:box_is_conforming",
        "slivers warn once and still pass the patch test": "mesh:sliver_is_accepted_with_one_warning reference_motion:affine_patch",
        "millimetres, metres and kilometres give the same": "scene:scaling mesh:nothing_depends_on_the_unit",
        "impossible moduli, densities, steps and barriers are refused with their range": "materials:wrong_numbers_are_refused_with_rule_value_and_remedy scene:refused step_limit:dt_must_be_positive",
        "wrong lengths and types from torch name expected and got; strided tensors work": "torch:wrong_shapes_and_types_name_expected_and_got torch:non_contiguous_inputs",
        "starting below or on an obstacle is refused, inside its barrier is not": "scene:refused contact:a_body_in_an_obstacle_is_refused contact:touching_exactly_is_refused_and_a_path_counts",
        "unused vertices and separate pieces are no division by zero": "mesh:orphan_vertices_warn_with_count_and_first scene:unused_vertex_stays",
        "files without linear tetrahedra say what they hold": "mesh:files_that_are_refused",
        "all vertices held stay; statics of a free body names its rigid motions": "scene:all_pinned_is_constant implicit:statics_of_a_free_body_name_the_rigid_modes",
    },
    "Materials": {
        "rotations are free of stress and energy": "materials:rotated_rest_is_free_of_stress_and_energy",
        "compressed to nothing and beyond, the logarithm stays finite, smooth and pushes out": "materials:logarithm_is_exact_above_the_floor_and_c2_finite_and_outward_below",
        "inverted states recover or are refused": "materials:inverted_and_collapsed_states_give_finite_results",
        "equal and nearly equal stretches": "materials:corotated_rotation_is_proper_and_exact_for_every_state",
        "collapsed starts come back": "implicit:collapsed_and_mirrored_starts_come_back",
        "nearly incompressible: locks as documented, with a warning": "implicit:cantilever_under_its_own_weight_locks_as_documented reference_motion:lame_mode_converges "
        "materials:nearly_incompressible_materials_warn_once_of_locking",
        "energy, stress and its differential belong together": "materials:stress_and_differential_are_the_derivatives_of_the_documented_energy",
        "moduli over six decades side by side": "implicit:series_of_bars_with_stiffnesses_over_six_decades scene:series_bar_of_moduli_over_six_decades",
    },
    "Explicit steps": {
        "bounded just below the limit, refused just above, and divergence beyond it is named in time": "step_limit:bounded_below_the_limit step_limit:refused_above_the_limit "
        "step_limit:divergence_above_the_limit_is_named "
        "study_stability:boundary_is_the_theoretical_limit",
        "ten times the limit is refused with the substeps it takes": "step_limit:ten_times_the_limit_says_how_many_substeps",
        "squeezing is noticed before anything is NaN": "step_limit:compression_outgrows_the_step_before_any_nan",
        "what gains energy below the limit says so, work from outside is not blamed on it": "energy_watch:a_gain_below_the_stable_step_is_said_and_the_advice_helps "
        "energy_watch:work_from_outside_is_counted",
        "free fall is exact, damping is none unless asked for": "reference_motion:free_fall_is_exact reference_motion:default_is_undamped_and_unloaded",
        "a tumbling block keeps momentum and energy over 100 000 steps": "reference_motion:momentum_of_a_tumbling_block_over_1e5_steps "
        "reference_motion:energy_of_a_tumbling_block_stays_in_its_band",
        "large shear follows its closed form": "reference_motion:large_amplitude_over_ten_thousand_steps",
        "the worst tetrahedron sets the limit and is named": "step_limit:worst_tetrahedron_is_named",
        "damping decays by its rate whatever the step": "reference_motion:drag_is_a_rate",
        "no step, stiffness, Poisson's ratio or element is wrong without a word": "study_stability:no_explicit_solver_is_wrong_silently "
        "study_stability:no_solver_is_wrong_silently_where_steps_meet_their_end "
        "study_stability:no_muscle_outgrows_an_explicit_step_in_silence",
    },
    "Implicit steps": {
        "where a body hangs at last does not depend on the step": "implicit:where_a_hanging_body_comes_to_rest_does_not_depend_on_the_step",
        "a crushing load never inverts an iterate": "implicit:every_iterate_of_a_compression_keeps_its_orientation",
        "too few rounds raise, with their history, and leave the state": "implicit:not_converged_carries_its_history_and_leaves_the_state",
        "a fast spin is lost at the rate of the formula": "implicit:backward_euler_loses_spin_by_its_formula",
        "very stiff steps stay finite; where the midpoint rule gains energy it says so": "implicit:stiff_steps_stay_finite_where_the_explicit_step_is_far_exceeded "
        "torture:midpoint_says_where_it_gains_energy",
        "an indefinite Hessian is reported": "implicit:an_indefinite_hessian_is_reported",
        "errors fall with the tolerance": "implicit_gradients:errors_fall_with_the_tolerance",
        "a column bends beyond its buckling load": "implicit:a_column_beyond_its_buckling_load_bends",
    },
    "Contact and friction": {
        "beyond the barrier no force acts": "reference_motion:ground_beyond_its_width_does_not_act",
        "the barrier is smooth down to its end": "contact:barrier_near_its_ends",
        "weights rest where the barrier carries them": "reference_motion:weight_at_rest_on_the_ground "
        "implicit_contact:weight_rests_at_the_gap_where_the_barrier_carries_it",
        "fast impacts are never below the floor in silence": "contact_crossing:speed_table implicit_contact:no_step_is_too_large_for_the_barrier",
        "bounces keep energy and their gradient": "reference_motion:barrier_bounce contact_gradients:bounce_sweep",
        "inclines hold and let slide": "contact_friction:incline implicit_contact:incline",
        "stopping distances": "contact_friction:stopping_distance implicit_contact:stopping_distance",
        "friction never adds energy": "contact_friction:friction_never_adds_energy",
        "two bodies collide head-on": "self_contact:head_on_collision_exchanges_velocities "
        "self_contact:head_on_collision_ends_where_rigid_bodies_would",
        "slow impact of a ball as by Hertz": "hertz:slow_impact_of_a_ball_converges_to_hertz",
        "symmetric contact stays symmetric; no force on a face exactly where the barrier begins": "contact:symmetric_contact_stays_symmetric torture:no_force_acts_on_a_face_exactly_at_the_width",
    },
    "Gradients": {
        "Taylor's test of every input": "gradients:every_input_by_itself gradients:a_smooth_thousand_steps",
        "identities that need no second code": "gradients:stiffness_and_density_scale_together gradients:free_flight gradients:rotation "
        "gradients:scaling_of_time",
        "wrong adjoints fail": "gradient_faults:mutated_results gradient_faults:mutated_laws gradient_faults:mutated_contact",
        "updating a state in place is caught": "gradient_faults:state_updated_in_place_is_caught_by_a_taylor_test",
        "two backwards, two simulators, backward after an error": "checkpoints:two_sweeps_of_the_same_frames checkpoints:two_rollouts_interleaved "
        "checkpoints:backward_after_an_exception",
        "checkpoints give the same bits, and memory falls as theory says": "checkpoints:budgets_give_the_same_bits checkpoints:memory_falls_as_the_theory_says",
        "implicit gradients agree with differences, and with the hanging bar's closed form": "implicit_gradients:every_input_agrees_with_differences torture:tip_of_a_hanging_bar_by_its_modulus",
        "moduli per region are recovered; what cannot be told apart is named": "identification:recovery_per_region identification:stiffness_and_density_together_are_not_seen",
        "chaotic runs are finite, their growth reported": "gradient_faults:health_of_a_bouncing_block gradient_faults:an_adjoint_that_explodes_says_so "
        "study_stability:growth_beyond_the_limit_is_the_fastest_modes_and_has_a_horizon",
        "first contact and none": "gradient_faults:across_first_contact gradient_faults:never_touching",
        "a loss that is not finite names its step": "gradient_faults:a_loss_gradient_that_is_not_finite",
        "float32 against float64": "gradients:f32_gradients_agree_with_f64",
    },
    "Precision, long runs, faults": {
        "float32 keeps small strains": "materials:float32_keeps_its_digits_near_rest",
        "a body a million metres from the origin": "torture:strains_keep_their_digits_far_from_the_origin",
        "a million steps in float32": "torture:a_million_steps_in_float32",
        "the same bits twice, and on any number of threads": "scene:two_runs_give_the_same_bits scene:threads_do_not_change_a_bit",
        "killed at any moment, an optimisation resumes": "optimization:kill_at_random_moments",
        "damaged or foreign checkpoints are refused": "optimization:damaged_files_are_refused_and_the_previous_one_used optimization:another_mesh_is_refused",
        "a full disk leaves the old file": "optimization:a_full_disk_leaves_the_old_file",
        "NaN in one vertex is found in its step": "step_limit:nan_in_one_vertex_is_found_in_its_step",
        "an optimiser that leaves the range is told": "torch:an_optimiser_that_leaves_the_range_is_told",
        "interrupting leaves what was written": "cli:interrupted_run_says_where_and_keeps_its_frames cli:interrupt_exits_130",
        "no torch, no GPU, no such backend": "resources:torch_is_not_needed resources:init_refuses_what_is_not_there",
        "a host program that starts Taichi itself": "resources:host_s_init_is_respected resources:second_init_is_noticed",
        "documented snippets run": "readme:code_block_runs_and_prints_what_is_shown seed_snippets:every_block_is_run",
    },
}


def missing() -> list[str]:
    """Named tests that do not exist."""
    names = [name for rows in ROWS.values() for tests in rows.values() for name in tests.split()]
    known = {}
    for file in {name.split(":")[0] for name in names}:
        path = HERE / f"test_{file}.py"
        known[file] = set(re.findall(r"def test_(\w+)", path.read_text())) if path.exists() else set()
    return [name for name in names if name.split(":")[1] not in known[name.split(":")[0]]]


def table() -> str:
    """Markdown: a table for each group; rows without a test are said to be open."""
    lines = [HEADING, "", "Written by `python tests/torture.py`; a test sees to it that all named tests exist."]
    for group, rows in ROWS.items():
        lines += ["", f"### {group}", "", "| | tests |", "| --- | --- |"]
        for words, tests in rows.items():
            cells = [f"`test_{f}.py::test_{name}`" for f, name in (test.split(":") for test in tests.split())]
            lines.append(f"| {words} | {'<br>'.join(cells) or 'open'} |")
    return "\n".join(lines) + "\n"


def page() -> str:
    """README.md with its last section, the table, as it should be."""
    return PAGE.read_text().partition(HEADING)[0] + table()


if __name__ == "__main__":
    PAGE.write_text(page())
