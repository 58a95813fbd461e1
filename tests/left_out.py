"""Single tests that are left out like those marked `thorough`, and what proves the same; a table of README.md says it, too.

Of a product of parameters a mark would leave out a whole row or column. Ids are those of pytest, without tests/ and .py.
"""

# what proves the same -> tests
LEFT_OUT = {
    "distances, forces and gradients of meshes in `test_mesh_obstacle.py`": """
        test_contact_gradients::test_every_input[mesh]
        test_contact::test_distance_and_force[mesh]
    """,
    "transposes of the same; other places, laws and curves": """
        test_far_from_origin::test_it_does_not_matter_where_a_scene_is[SemiImplicitSolver-far]
        test_identify_experiments::test_a_force_curve_tells_two_numbers_of_a_law
        test_open_laws::test_everything_follows_from_the_energy[tissue-f64-lanes]
    """,
    "the same in f64, and its other solvers and places": """
        test_far_from_origin::test_it_does_not_matter_where_a_scene_is[ImplicitEulerSolver-far]
        test_cli::test_a_fall_of_the_battery[bdf2]
        test_quadratic::test_explicit_adjoints_are_the_transposes_of_tangents[tetrahedra-SemiImplicitSolver]
        test_quadratic::test_explicit_adjoints_are_the_transposes_of_tangents[patches-VelocityVerletSolver]
        test_reduced_explicit::test_tangent_and_adjoint_agree[rigid-SemiImplicitSolver-f32-1e-05]
        test_reduced_explicit::test_tangent_and_adjoint_agree[affine-SemiImplicitSolver-f32-1e-05]
        test_reduced_explicit::test_tangent_and_adjoint_agree[affine-VelocityVerletSolver-f32-1e-05]
    """,
    "mesh, sphere; transposes of all shapes in `test_contact_stage.py`": """
        test_contact_gradients::test_every_input[cylinder]
        test_contact_gradients::test_every_input[capsule]
        test_contact_gradients::test_every_input[box]
        test_contact_gradients::test_tangent_and_mirror[box-SemiImplicitSolver]
        test_contact_gradients::test_tangent_and_mirror[box-VelocityVerletSolver]
    """,
    "every input of them in `test_contact_gradients.py`": """
        test_contact_stage::test_every_shape[ground]
        test_contact_stage::test_every_shape[sphere]
        test_contact_stage::test_every_shape[half_space]
        test_contact_stage::test_every_shape[bowl]
    """,
    "capsules and thin boxes; obstacles that move and turn; transposes of the same": """
        test_contact_force::test_gradients_agree_with_differences[euler round]
    """,
    "every number and force of the same in `test_contact_rollers.py`": """
        test_contact_force::test_seeds_are_the_transpose_of_tangents[verlet belt]
        test_contact_force::test_gradients_agree_with_differences[semi belt]
        test_contact_force::test_gradients_agree_with_differences[verlet belt]
    """,
    "two balls in velocity Verlet": """
        test_contact_force::test_gradients_agree_with_differences[semi round]
    """,
    "the same with friction": """
        test_curved_contact::test_curved_faces_press_on_each_other[VelocityVerletSolver-f64]
    """,
    "BDF2 in a bowl, velocity Verlet before a capsule; the same in f64": """
        test_curved_contact::test_curved_faces_rub_on_each_other[VelocityVerletSolver-f32]
        test_curved_contact::test_curved_faces_press_on_each_other[VelocityVerletSolver-f32]
    """,
    "the same laws in f64; other laws of the same kind": """
        test_implicit_gradients::test_moduli_and_state_of_every_law[MooneyRivlin]
        test_open_laws::test_gradients_on_patches[gent]
        test_open_laws::test_everything_follows_from_the_energy[ogden-f32-single]
        test_open_laws::test_everything_follows_from_the_energy[tissue-f32-single]
        test_open_laws::test_gradients_by_every_number[yeoh-SemiImplicitSolver]
        test_open_laws::test_gradients_by_every_number[knowles-SemiImplicitSolver]
        test_open_laws::test_uniaxial_force_is_that_of_the_closed_form[yeoh]
        test_open_laws::test_gradients_on_patches[tissue]
        test_open_laws::test_gradients_by_every_number[tissue-ImplicitEulerSolver]
        test_viscosity::test_gradients_by_every_number[dashpots-VelocityVerletSolver]
        test_viscosity::test_gradients_by_every_number[time-ImplicitEulerSolver]
        test_viscosity::test_gradients_by_every_number[both-VelocityVerletSolver]
        test_viscous_stages::test_gradients_by_every_number[dashpots]
        test_implicit_gradients::test_moduli_and_state_of_every_law[SmithNeoHookean]
        test_quadratic::test_forces_and_stiffness_are_derivatives_of_the_energy[SmithNeoHookean-tetrahedra]
        test_quadratic::test_forces_and_stiffness_are_derivatives_of_the_energy[Corotated-tetrahedra]
        test_quadratic::test_forces_and_stiffness_are_derivatives_of_the_energy[MooneyRivlin-tetrahedra]
        test_quadratic::test_forces_and_stiffness_are_derivatives_of_the_energy[LinearElastic-tetrahedra]
        test_gradients::test_one_step_is_the_transpose_of_its_tangent[f32-1e-05-StVenantKirchhoff-SemiImplicitSolver]
        test_gradients::test_one_step_is_the_transpose_of_its_tangent[f32-1e-05-StVenantKirchhoff-VelocityVerletSolver]
        test_gradients::test_one_step_is_the_transpose_of_its_tangent[f32-1e-05-SmithNeoHookean-SemiImplicitSolver]
        test_gradients::test_one_step_is_the_transpose_of_its_tangent[f32-1e-05-SmithNeoHookean-VelocityVerletSolver]
        test_gradients::test_one_step_is_the_transpose_of_its_tangent[f32-1e-05-MooneyRivlin-SemiImplicitSolver]
        test_gradients::test_one_step_is_the_transpose_of_its_tangent[f32-1e-05-MooneyRivlin-VelocityVerletSolver]
        test_gradients::test_one_step_is_the_transpose_of_its_tangent[f32-1e-05-LinearElastic-SemiImplicitSolver]
        test_gradients::test_one_step_is_the_transpose_of_its_tangent[f32-1e-05-LinearElastic-VelocityVerletSolver]
        test_gradients::test_one_step_is_the_transpose_of_its_tangent[f32-1e-05-Corotated-SemiImplicitSolver]
        test_gradients::test_one_step_is_the_transpose_of_its_tangent[f32-1e-05-Corotated-VelocityVerletSolver]
    """,
    "each law by itself in `test_materials.py`, its moduli by scaling; two laws in a scene of everything": """
        test_gradients::test_one_step_is_the_transpose_of_its_tangent[f64-1e-13-StVenantKirchhoff-VelocityVerletSolver]
        test_gradients::test_one_step_is_the_transpose_of_its_tangent[f64-1e-13-SmithNeoHookean-VelocityVerletSolver]
        test_gradients::test_one_step_is_the_transpose_of_its_tangent[f64-1e-13-MooneyRivlin-VelocityVerletSolver]
        test_gradients::test_one_step_is_the_transpose_of_its_tangent[f64-1e-13-LinearElastic-VelocityVerletSolver]
        test_gradients::test_f32_gradients_agree_with_f64[StVenantKirchhoff-VelocityVerletSolver]
        test_gradients::test_f32_gradients_agree_with_f64[SmithNeoHookean-VelocityVerletSolver]
        test_gradients::test_f32_gradients_agree_with_f64[MooneyRivlin-VelocityVerletSolver]
        test_gradients::test_f32_gradients_agree_with_f64[LinearElastic-VelocityVerletSolver]
        test_implicit_gradients::test_moduli_and_state_of_every_law[StVenantKirchhoff]
        test_implicit_gradients::test_moduli_and_state_of_every_law[LinearElastic]
    """,
    "forces and products of all laws on patches": """
        test_locking::test_the_reverse_sweep_is_the_transpose_of_the_tangent[StVenantKirchhoff-f64-1e-13]
        test_locking::test_constant_strain_is_as_without_patches[StVenantKirchhoff]
        test_locking::test_constant_strain_is_as_without_patches[SmithNeoHookean]
        test_locking::test_constant_strain_is_as_without_patches[MooneyRivlin]
        test_locking::test_constant_strain_is_as_without_patches[LinearElastic]
    """,
    "an obstacle in `test_contact_gradients.py`; crowds in float32 by forms for other backends": """
        test_contact_stage::test_single_precision_follows[SemiImplicitSolver]
        test_contact_stage::test_single_precision_follows[VelocityVerletSolver]
    """,
    "the same in f64; springs in f32 by velocity Verlet, and host forms, which implicit steps take, have float64": """
        test_springs::test_every_number[StaticSolver-f32]
    """,
    "the same in f64; by velocity Verlet in f32": """
        test_laws_with_state::test_a_saved_run_goes_on_with_the_same_bits[True-BDF2Solver-f32]
    """,
    "statics in f64, backward Euler in f32": """
        test_implicit_gradients::test_float32_gradients_are_near_float64_ones[StaticSolver]
    """,
    "nearer to what cannot be compressed, and larger displacements": """
        test_quadratic_solvers::test_lame_mode[0.45]
        test_quadratic_answers::test_elastica_under_its_own_weight[5.0]
    """,
    "the same in f64; in f32 near the origin and far from it in `test_far_from_origin.py`": """
        test_reaction::test_seeds_are_the_transpose_of_tangents[static-f32]
    """,
    "the same in f64; steps and gradients by multigrid in f32": """
        test_implicit_cycle::test_what_joins_products_on_the_device_is_what_joins_them_on_the_host[f32-0.0002]
    """,
    "multigrid and blocks on a beam, rounds on slides; threads before a floor and with self-contact": """
        test_implicit_cycle::test_all_preconditioners_and_threads_find_the_same_steps[fixed]
        test_implicit_cycle::test_all_preconditioners_and_threads_find_the_same_steps[slides]
        test_implicit_cycle::test_all_preconditioners_and_threads_find_the_same_steps[foundation]
    """,
    "ties, which move by few numbers alike; surfaces push rigid sets": """
        test_reduced_explicit::test_a_narrow_obstacle_pushes_a_set[affine]
        test_reduced_explicit::test_a_narrow_obstacle_pushes_a_set[rigid]
    """,
    "other seeds and scenes": """
        test_batch::test_scenes_are_bit_for_bit_those_alone[2]
        test_implicit_contact::test_weight_rests_at_the_gap_where_the_barrier_carries_it[1.0-ImplicitEulerSolver]
        test_implicit_contact::test_weight_rests_at_the_gap_where_the_barrier_carries_it[1.0-BDF2Solver]
        test_reduced_rigid::test_nothing_passes_through_them[6]
        test_reduced_rigid::test_nothing_passes_through_them[16]
        test_loads_together::test_and_beside_patches_and_self_contact[SemiImplicitSolver-False-options1]
        test_batch_tape::test_a_tape_gives_what_vjp_gives[side by side]
        test_batch::test_scenes_are_bit_for_bit_those_alone[1]
        test_batch::test_scenes_are_bit_for_bit_those_alone[3]
        test_batch::test_scenes_are_bit_for_bit_those_alone[4]
        test_batch::test_what_acts_on_bodies[0]
        test_batch::test_what_acts_on_bodies[1]
        test_batch::test_what_acts_on_bodies[3]
        test_batch::test_what_acts_on_bodies[4]
    """,
    "four-node fibres; gradients by ten-node ones": """
        test_muscles::test_eight_fibres_at_once_are_eight_fibres[SemiImplicitSolver-2-f32]
    """,
    "affine sets in f32, rigid ones in f64": """
        test_reduced_explicit::test_tangent_and_adjoint_agree[rigid-SemiImplicitSolver-f32-1e-05]
        test_reduced_explicit::test_tangent_and_adjoint_agree[rigid-VelocityVerletSolver-f32-1e-05]
        test_reduced_explicit::test_tangent_and_adjoint_agree[affine-SemiImplicitSolver-f64-1e-13]
        test_reduced_explicit::test_tangent_and_adjoint_agree[affine-VelocityVerletSolver-f64-1e-13]
    """,
    "rigid ones": """
        test_reduced_explicit::test_all_threads_do_what_one_does[affine]
    """,
    "rigid sets with friction; sets of a basis that slide": """
        test_reduced_explicit::test_surfaces_push_a_set[rigid-0.0]
    """,
    "its shape, place and width in `test_mesh_obstacle.py`; paths and friction of other shapes": """
        test_contact_stage::test_every_shape[mesh]
    """,
    "semi-implicit steps": """
        test_contact_force::test_all_threads_give_what_one_gives[VelocityVerletSolver]
    """,
    "explicit steps; implicit ones in `test_outputs.py` and `test_implicit_gradients.py`": """
        test_laws_with_state::test_a_tape_finds_the_same_gradients[ImplicitEulerSolver]
    """,
    "a bent state; the greatest pressure in `test_load_path.py`": """
        test_modes::test_gradients_of_frequencies_agree_with_differences[rest]
        test_chambers::test_a_sphere_at_and_beyond_its_largest_pressure[1.47]
    """,
    "the same in f32, whose rounding is the larger": """
        test_energy_watch::test_a_bounce_at_the_usual_step_is_not_blamed[f64]
    """,
    "what is held in one direction, before the same ball": """
        test_energy_watch::test_work_from_outside_is_counted[supports above a ball by pairs-SemiImplicitSolver]
        test_energy_watch::test_work_from_outside_is_counted[supports above a ball by pairs-VelocityVerletSolver]
    """,
    "explicit steps; the midpoint rule's period in `test_implicit.py`": """
        test_springs::test_period_of_a_mass_on_a_spring[ImplicitMidpointSolver]
    """,
    "each by itself": """
        test_energy_watch::test_work_from_outside_is_counted[motion, drag-SemiImplicitSolver]
        test_energy_watch::test_work_from_outside_is_counted[motion, drag-VelocityVerletSolver]
        test_energy_watch::test_bdf2_is_not_blamed_for_work_from_outside[motion, drag]
    """,
    "by velocity Verlet; where solves do not converge by backward Euler": """
        test_unequal_steps::test_the_search_puts_substeps_where_the_impact_is[BDF2Solver]
    """,
    "obstacles as forces; in implicit steps the gap under a cube": """
        test_contact_area::test_equal_areas_are_equal_stiffnesses[ImplicitEulerSolver]
        test_contact_area::test_equal_areas_are_equal_stiffnesses[SemiImplicitSolver]
        test_contact_area::test_equal_areas_are_equal_stiffnesses[VelocityVerletSolver]
    """,
    "every input of a floor and a wall by area in `test_contact_force.py`; obstacles as forces": """
        test_contact_area::test_tangents_and_adjoints_belong_together[SemiImplicitSolver]
        test_contact_area::test_tangents_and_adjoints_belong_together[VelocityVerletSolver]
        test_contact_area::test_tangents_and_adjoints_belong_together[ImplicitEulerSolver]
        test_contact_area::test_tangents_and_adjoints_belong_together[StaticSolver]
        test_contact_area::test_gradients_are_slopes[SemiImplicitSolver]
        test_contact_area::test_gradients_are_slopes[VelocityVerletSolver]
        test_contact_area::test_gradients_are_slopes[ImplicitEulerSolver]
        test_contact_area::test_gradients_are_slopes[StaticSolver]
    """,
    "statics far away, and semi-implicit steps": """
        test_far_from_origin::test_it_does_not_matter_where_a_scene_is[ImplicitEulerSolver-exact]
    """,
    "a body that twists": """
        test_study::test_advice_overlooks_nothing_twice_as_cheap[drop]
        test_study::test_advice_keeps_its_promise[drop]
    """,
    "dashpots beside relaxing parts": """
        test_viscosity::test_gradients_by_every_number[dashpots-ImplicitMidpointSolver]
    """,
    "tetrahedra without patches; patches in equilibria": """
        test_quadratic::test_explicit_adjoints_are_the_transposes_of_tangents[patches-SemiImplicitSolver]
        test_quadratic::test_explicit_adjoints_are_the_transposes_of_tangents[patches-VelocityVerletSolver]
    """,
    "the same by another solver of the family": """
        test_contact_force::test_seeds_are_the_transpose_of_tangents[semi belt]
        test_contact_force::test_seeds_are_the_transpose_of_tangents[semi round]
        test_contact_force::test_seeds_are_the_transpose_of_tangents[middle moved]
        test_contact_force::test_seeds_are_the_transpose_of_tangents[verlet between]
        test_poses::test_a_turning_table_holds_below_the_speed_of_friction[ImplicitEulerSolver]
        test_self_contact_friction::test_with_everything_else[VelocityVerletSolver-0.0001-1e-13]
        test_quadratic_solvers::test_kinetic_energy_is_of_the_masses_in_use[VelocityVerletSolver]
        test_every_adjoint::test_frames_and_schedules_do_not_matter[ImplicitEulerSolver]
        test_springs::test_every_number[ImplicitEulerSolver-f32]
        test_every_adjoint::test_frames_and_schedules_do_not_matter[ImplicitMidpointSolver]
        test_term_order::test_any_order_gives_the_same_bits[ImplicitMidpointSolver-f64]
        test_term_order::test_any_order_gives_the_same_bits[BDF2Solver-f64]
        test_implicit_contact::test_gradients_through_friction_on_a_moving_obstacle[BDF2Solver]
        test_chambers::test_the_pressure_is_a_result_with_gradient[BDF2Solver]
        test_curved_contact::test_curved_faces_rub_on_each_other[BDF2Solver-f64]
    """,
    "velocity Verlet or BDF2; transposes in all solvers, and differences in all of `test_implicit_gradients.py`": """
        test_contact_force::test_gradients_agree_with_differences[static]
        test_springs::test_gradients_against_differences[StaticSolver]
        test_loads_together::test_gradients_are_those_of_differences[ImplicitEulerSolver]
        test_unequal_steps::test_gradients_are_those_of_differences[BDF2Solver]
        test_surface_drag::test_gradients_against_differences[BDF2Solver-names1]
        test_swept::test_gradients_where_ways_are_cut_and_obstacles_come_in_parts[ImplicitEulerSolver]
        test_contact_force::test_gradients_agree_with_differences[bdf]
        test_reaction::test_gradients_agree_with_differences[euler]
        test_supports::test_gradients_against_differences[SemiImplicitSolver]
        test_rotating_frame::test_gradients_against_differences[BDF2Solver-1]
        test_rotating_frame::test_gradients_against_differences[StaticSolver-2]
        test_growth_over_time::test_gradients_against_differences[ImplicitMidpointSolver]
    """,
    "a C in implicit steps, a slit in explicit ones": """
        test_self_contact_near::test_gradients_of_closing_parts[ImplicitEulerSolver-slit]
    """,
    "velocity Verlet; linear tetrahedra in all of them": """
        test_quadratic_outputs::test_derivatives[midpoint]
        test_quadratic_outputs::test_derivatives[static]
    """,
    "the same in f64": """
        test_contact_force::test_single_precision[semi f32]
        test_chambers::test_every_number_of_a_gas[ImplicitEulerSolver-f32]
        test_implicit::test_backward_euler_follows_the_oscillators_recursion[0.0-f32-0.0001]
        test_implicit::test_backward_euler_follows_the_oscillators_recursion[0.3-f32-0.0001]
        test_implicit::test_backward_euler_follows_the_oscillators_recursion[0.45-f32-0.0001]
        test_laws_with_state::test_a_saved_run_goes_on_with_the_same_bits[False-BDF2Solver-f32]
        test_laws_with_state::test_a_saved_run_goes_on_with_the_same_bits[False-ImplicitEulerSolver-f32]
        test_laws_with_state::test_a_saved_run_goes_on_with_the_same_bits[False-ImplicitMidpointSolver-f32]
        test_laws_with_state::test_a_saved_run_goes_on_with_the_same_bits[True-ImplicitMidpointSolver-f32]
        test_loads::test_every_number_of_a_load[StaticSolver-f32]
        test_step_inputs::test_steps_have_the_states_of_a_run[ImplicitEulerSolver-f32-True]
        test_self_contact_near::test_nothing_passes_through[f32-SemiImplicitSolver-1e-05-slit]
        test_self_contact_near::test_nothing_passes_through[f32-SemiImplicitSolver-1e-05-c]
        test_self_contact_near::test_nothing_passes_through[f32-VelocityVerletSolver-1e-05-slit]
        test_self_contact_near::test_nothing_passes_through[f32-VelocityVerletSolver-1e-05-c]
        test_self_contact_near::test_nothing_passes_through[f32-ImplicitEulerSolver-0.002-slit]
        test_self_contact_near::test_nothing_passes_through[f32-ImplicitEulerSolver-0.002-c]
        test_self_contact_near::test_nothing_passes_through[f32-BDF2Solver-0.002-slit]
        test_self_contact_near::test_nothing_passes_through[f32-BDF2Solver-0.002-c]
        test_self_contact_implicit::test_large_steps_keep_bodies_apart_and_their_momentum[ImplicitEulerSolver-f32]
        test_self_contact_implicit::test_large_steps_keep_bodies_apart_and_their_momentum[ImplicitMidpointSolver-f32]
        test_self_contact_implicit::test_large_steps_keep_bodies_apart_and_their_momentum[BDF2Solver-f32]
    """,
    "boxes and capsules": """
        test_contact_crossing::test_thin_obstacles_are_not_jumped_over[cylinder-SemiImplicitSolver_force]
        test_contact_crossing::test_thin_obstacles_are_not_jumped_over[cylinder-VelocityVerletSolver_force]
    """,
    "BDF2 through the command line; the advice's own fall, by velocity Verlet": """
        test_cli::test_a_fall_of_the_battery[verlet]
    """,
    "viscosity of four nodes in all solvers; ten nodes by other laws": """
        test_viscosity::test_gradients_of_ten_nodes[BDF2Solver]
    """,
    "workers of a loader, and of spawned processes in `test_devices.py`": """
        test_torch::test_multiprocessing_spawn
    """,
    "obstacles that turn as a stage and in implicit steps": """
        test_poses::test_gradients_are_right[a force]
    """,
    "a larger stretch": """
        test_implicit_cycle::test_nearly_incompressible_cubes_are_stretched_and_squashed_in_one_load_step[0.3]
    """,
    "the midpoint rule": """
        test_reduced_rigid::test_gradients_beside_all_loads[BDF2Solver]
    """,
    "ten nodes on patches by stable neo-Hookean; the law on tetrahedra": """
        test_quadratic::test_forces_and_stiffness_are_derivatives_of_the_energy[Corotated-patches]
    """,
    "explicit transposes in `test_quadratic.py`; the same outputs in other solvers": """
        test_quadratic_outputs::test_derivatives[verlet]
    """,
    "tetrahedra of ten nodes without patches, and patches in implicit steps": """
        test_quadratic_solvers::test_adjoints_are_the_transposes_of_tangents[StaticSolver-patches]
    """,
    "Ogden without lanes, and other laws with them": """
        test_open_laws::test_everything_follows_from_the_energy[ogden-f64-lanes]
    """,
    "the same beside other loads": """
        test_loads_together::test_and_beside_patches_and_self_contact[ImplicitEulerSolver-True-options2]
    """,
    "patches of what is nearly incompressible, the hardest; steps of tetrahedra by multigrid": """
        test_quadratic_solvers::test_multigrid_takes_as_many_iterations_as_for_linear_tetrahedra[0.3-tetrahedra]
        test_quadratic_solvers::test_multigrid_takes_as_many_iterations_as_for_linear_tetrahedra[0.3-patches]
        test_quadratic_solvers::test_multigrid_takes_as_many_iterations_as_for_linear_tetrahedra[0.49-tetrahedra]
    """,
    "a slit in f32; the same in f64": """
        test_self_contact_near::test_no_force_at_rest[f32-shaken_1]
    """,
    "velocity Verlet; gradients of steps in implicit ones": """
        test_step_inputs::test_a_control_loop_has_the_gradient_of_its_gain[ImplicitEulerSolver]
    """,
    "patches; functions of the same law by themselves": """
        test_open_laws::test_a_law_by_its_energy_moves_like_the_one_written_by_hand[tetrahedra]
    """,
    "explicit steps; a beam in implicit ones in `test_implicit_cycle.py`": """
        test_laws_with_state::test_a_saved_run_goes_on_with_the_same_bits[False-ImplicitEulerSolver-f64]
    """,
    "derivatives of each law by its numbers in `everything_follows_from_the_energy`; other laws in scenes": """
        test_open_laws::test_gradients_by_every_number[gent-SemiImplicitSolver]
        test_open_laws::test_gradients_by_every_number[swollen-SemiImplicitSolver]
    """,
    "BDF2 with all terms; velocity Verlet with these": """
        test_unequal_steps::test_reverse_gradients_are_the_transpose_of_tangents[loaded_scene-BDF2Solver]
    """,
    "a ball by pairs and a belt in BDF2; a ball in explicit steps": """
        test_energy_watch::test_bdf2_is_not_blamed_for_work_from_outside[a ball]
    """,
    "other scenes of the corpus, all by `contact_corpus.py`; slabs that hold at 0.51; plates that come": """
        test_contact_corpus::test_arch_stands
        test_contact_corpus::test_pins_come_in_few_parts_of_a_step
    """,
    "explicit steps; in implicit ones free turns by Euler's equations, friction of vertices, transposes of both": """
        test_reduced_rigid::test_a_ball_rolls_down_a_slope
    """,
    "explicit steps; slabs on slopes and what balances supports, which fail where weights of pairs are wrong": """
        test_self_contact_friction::test_angular_momentum_but_for_the_couple_of_friction_across_the_gap[ImplicitMidpointSolver-60-options1]
    """,
    "explicit steps; two plates in implicit ones in `test_swept.py`": """
        test_term_order::test_two_of_one_kind_swapped[implicit_euler]
    """,
    "equilibria and explicit steps": """
        test_work::test_derivatives[euler]
    """,
    "explicit steps in lanes; laws in implicit ones by their closed forms": """
        test_laws_with_state::test_lanes_change_nothing[ImplicitEulerSolver]
    """,
    "linear tetrahedra; ten nodes in contact in `test_curved_contact.py`": """
        test_supports::test_contact_holds_what_supports_leave[2]
    """,
    "implicit steps over the same land; points that come round in explicit ones": """
        test_obstacle_pairs::test_a_run_has_what_is_near_alone_and_finds_what_it_would_find_with_all[SemiImplicitSolver-0.001-50]
    """,
    "one ball in semi-implicit steps": """
        test_curved_contact::test_a_ball_acts_on_curved_faces_where_they_are[ImplicitEulerSolver]
    """,
    "the same obstacles by velocity Verlet; the others of backward Euler": """
        test_contact_force::test_seeds_are_the_transpose_of_tangents[euler round]
    """,
    "cases with the same values: each value of every parameter stands in one that stays": """
        test_chambers::test_every_number_of_a_gas[VelocityVerletSolver-f32]
        test_contact_crossing::test_forward_runs_divide_the_step[capsule-SemiImplicitSolver]
        test_contact_crossing::test_forward_runs_divide_the_step[capsule-SemiImplicitSolver_force]
        test_contact_crossing::test_forward_runs_divide_the_step[half_space-SemiImplicitSolver]
        test_contact_crossing::test_forward_runs_divide_the_step[half_space-SemiImplicitSolver_force]
        test_contact_force::test_an_even_pressure_has_an_even_traction[1-five-cells0-10000000.0]
        test_contact_force::test_an_even_pressure_has_an_even_traction[2-five-cells1-10000000.0]
        test_contact_friction::test_stopping_distance[f32-0.2-1.019368-SemiImplicitSolver_force]
        test_contact_friction::test_stopping_distance[f64-0.2-1.019368-SemiImplicitSolver_1.0]
        test_contact_friction::test_stopping_distance[f64-0.2-1.019368-SemiImplicitSolver_force]
        test_contact_gradients::test_bounce_sweep[0.2-SemiImplicitSolver_0.0]
        test_contact_gradients::test_bounce_sweep[0.2-SemiImplicitSolver_force]
        test_contact_gradients::test_bounce_sweep[3.0-VelocityVerletSolver_force]
        test_contact_stage::test_every_input_in_a_crowd[0.0-SemiImplicitSolver]
        test_contact_stage::test_every_input_in_a_crowd[0.4-VelocityVerletSolver]
        test_energy_watch::test_work_from_outside_is_counted[a ball-VelocityVerletSolver]
        test_energy_watch::test_work_from_outside_is_counted[a belt-VelocityVerletSolver]
        test_energy_watch::test_work_from_outside_is_counted[a muscle-VelocityVerletSolver]
        test_energy_watch::test_work_from_outside_is_counted[motion-VelocityVerletSolver]
        test_every_adjoint::test_torch_gives_the_same_gradients[ImplicitEulerSolver-1]
        test_every_adjoint::test_torch_gives_the_same_gradients[SemiImplicitSolver-None]
        test_gradients::test_f32_gradients_agree_with_f64[Corotated-SemiImplicitSolver]
        test_gradients::test_f32_gradients_agree_with_f64[LinearElastic-SemiImplicitSolver]
        test_gradients::test_f32_gradients_agree_with_f64[MooneyRivlin-SemiImplicitSolver]
        test_gradients::test_f32_gradients_agree_with_f64[SmithNeoHookean-SemiImplicitSolver]
        test_gradients::test_f32_gradients_agree_with_f64[StVenantKirchhoff-SemiImplicitSolver]
        test_gradients::test_one_step_is_the_transpose_of_its_tangent[f64-1e-13-Corotated-SemiImplicitSolver]
        test_gradients::test_one_step_is_the_transpose_of_its_tangent[f64-1e-13-LinearElastic-SemiImplicitSolver]
        test_gradients::test_one_step_is_the_transpose_of_its_tangent[f64-1e-13-MooneyRivlin-SemiImplicitSolver]
        test_gradients::test_one_step_is_the_transpose_of_its_tangent[f64-1e-13-SmithNeoHookean-SemiImplicitSolver]
        test_gradients::test_one_step_is_the_transpose_of_its_tangent[f64-1e-13-StVenantKirchhoff-SemiImplicitSolver]
        test_gradients::test_stiffness_and_density_scale_together[Corotated-SemiImplicitSolver]
        test_gradients::test_stiffness_and_density_scale_together[LinearElastic-SemiImplicitSolver]
        test_gradients::test_stiffness_and_density_scale_together[MooneyRivlin-SemiImplicitSolver]
        test_gradients::test_stiffness_and_density_scale_together[SmithNeoHookean-SemiImplicitSolver]
        test_gradients::test_stiffness_and_density_scale_together[StVenantKirchhoff-SemiImplicitSolver]
        test_implicit_contact::test_stopping_distance[f32-0.2-1.019368-ImplicitEulerSolver]
        test_implicit_contact::test_stopping_distance[f64-0.2-1.019368-ImplicitEulerSolver]
        test_laws_with_state::test_a_saved_run_goes_on_with_the_same_bits[True-ImplicitEulerSolver-f32]
        test_laws_with_state::test_a_saved_run_goes_on_with_the_same_bits[True-ImplicitEulerSolver-f64]
        test_laws_with_state::test_a_saved_run_goes_on_with_the_same_bits[True-SemiImplicitSolver-f32]
        test_laws_with_state::test_a_saved_run_goes_on_with_the_same_bits[True-SemiImplicitSolver-f64]
        test_laws_with_state::test_gradients_by_every_number[SemiImplicitSolver-each]
        test_laws_with_state::test_gradients_by_every_number[VelocityVerletSolver-uniform]
        test_loads::test_every_number_of_a_load[VelocityVerletSolver-f32]
        test_materials::test_stress_and_differential_are_the_derivatives_of_the_documented_energy[Corotated-random]
        test_open_laws::test_everything_follows_from_the_energy[gent-f64-lanes]
        test_open_laws::test_everything_follows_from_the_energy[grown-f32-single]
        test_open_laws::test_everything_follows_from_the_energy[knowles-f64-lanes]
        test_open_laws::test_everything_follows_from_the_energy[orthotropic-f64-lanes]
        test_open_laws::test_everything_follows_from_the_energy[swollen-f64-lanes]
        test_open_laws::test_everything_follows_from_the_energy[tensioned-f64-lanes]
        test_open_laws::test_everything_follows_from_the_energy[yeoh-f64-lanes]
        test_open_laws::test_gradients_by_every_number[tensioned-SemiImplicitSolver]
        test_outputs::test_gradients_agree_with_differences[kinetic_energy-density-tight_bdf2]
        test_outputs::test_gradients_agree_with_differences[kinetic_energy-gravity-tight_bdf2]
        test_outputs::test_gradients_agree_with_differences[kinetic_energy-rest_positions-tight_bdf2]
        test_outputs::test_gradients_agree_with_differences[markers-youngs_modulus-tight_bdf2]
        test_outputs::test_numpy_tape_and_torch_agree[free-ImplicitEulerSolver]
        test_outputs::test_numpy_tape_and_torch_agree[prescribed motion-SemiImplicitSolver]
        test_reduced::test_tangent_and_adjoint_agree_with_contact_and_friction[BDF2Solver-affine]
        test_reduced::test_tangent_and_adjoint_agree_with_contact_and_friction[BDF2Solver-rigid]
        test_reduced::test_tangent_and_adjoint_agree_with_contact_and_friction[ImplicitEulerSolver-affine]
        test_reduced::test_tangent_and_adjoint_agree_with_contact_and_friction[ImplicitMidpointSolver-rigid]
        test_reduced_rigid::test_several_sets_beside_supports[ImplicitEulerSolver-0]
        test_reduced_rigid::test_several_sets_beside_supports[ImplicitMidpointSolver-0]
        test_reduced_rigid::test_several_sets_beside_supports[ImplicitMidpointSolver-2]
        test_reduced_rigid::test_several_sets_beside_supports[ImplicitMidpointSolver-3]
        test_reduced_rigid::test_several_sets_beside_supports[StaticSolver-1]
        test_reduced_rigid::test_several_sets_beside_supports[StaticSolver-2]
        test_reduced_rigid::test_several_sets_beside_supports[StaticSolver-3]
        test_reduced_rigid::test_tangent_and_adjoint_agree_beside_all_loads[BDF2Solver-ten nodes]
        test_reduced_rigid::test_tangent_and_adjoint_agree_beside_all_loads[ImplicitEulerSolver-grown]
        test_reduced_rigid::test_tangent_and_adjoint_agree_beside_all_loads[ImplicitEulerSolver-patches]
        test_reduced_rigid::test_tangent_and_adjoint_agree_beside_all_loads[ImplicitEulerSolver-relaxing]
        test_reduced_rigid::test_tangent_and_adjoint_agree_beside_all_loads[ImplicitEulerSolver-ten nodes]
        test_reduced_rigid::test_tangent_and_adjoint_agree_beside_all_loads[ImplicitEulerSolver-viscous]
        test_reference_motion::test_momentum_of_a_tumbling_block_over_1e5_steps[Corotated-SemiImplicitSolver]
        test_reference_motion::test_momentum_of_a_tumbling_block_over_1e5_steps[MooneyRivlin-SemiImplicitSolver]
        test_reference_motion::test_momentum_of_a_tumbling_block_over_1e5_steps[SmithNeoHookean-SemiImplicitSolver]
        test_reference_motion::test_momentum_of_a_tumbling_block_over_1e5_steps[StVenantKirchhoff-SemiImplicitSolver]
        test_self_contact_near::test_energy_is_that_of_all_pairs[0.3-shaken_0]
        test_self_contact_near::test_energy_is_that_of_all_pairs[0.3-slit]
        test_self_contact_near::test_nothing_passes_through[f64-BDF2Solver-0.002-slit]
        test_self_contact_near::test_nothing_passes_through[f64-ImplicitEulerSolver-0.002-slit]
        test_self_contact_near::test_nothing_passes_through[f64-SemiImplicitSolver-1e-05-c]
        test_self_contact_near::test_nothing_passes_through[f64-VelocityVerletSolver-1e-05-slit]
        test_springs::test_every_number[StaticSolver-f64]
        test_springs::test_every_number[VelocityVerletSolver-f32]
        test_step_inputs::test_steps_have_the_states_of_a_run[SemiImplicitSolver-f64-True]
        test_strength::test_the_advice_works[BDF2Solver-weight]
        test_strength::test_the_advice_works[VelocityVerletSolver-speed]
        test_study_stability::test_no_solver_is_wrong_silently_where_steps_meet_their_end[activation-values2-BDF2Solver]
        test_study_stability::test_no_solver_is_wrong_silently_where_steps_meet_their_end[activation-values2-ImplicitEulerSolver]
        test_study_stability::test_no_solver_is_wrong_silently_where_steps_meet_their_end[activation-values2-ImplicitMidpointSolver]
        test_study_stability::test_no_solver_is_wrong_silently_where_steps_meet_their_end[compression-values1-ImplicitMidpointSolver]
        test_study_stability::test_no_solver_is_wrong_silently_where_steps_meet_their_end[impact-values0-BDF2Solver]
        test_study_stability::test_no_solver_is_wrong_silently_where_steps_meet_their_end[impact-values0-ImplicitEulerSolver]
        test_study_stability::test_no_solver_is_wrong_silently_where_steps_meet_their_end[impact-values0-SemiImplicitSolver]
        test_supports::test_every_number_is_transposed[ImplicitEulerSolver-held]
        test_supports::test_every_number_is_transposed[ImplicitMidpointSolver-by set]
        test_supports::test_every_number_is_transposed[ImplicitMidpointSolver-of all]
        test_supports::test_every_number_is_transposed[SemiImplicitSolver-by set]
        test_supports::test_every_number_is_transposed[SemiImplicitSolver-held]
        test_supports::test_every_number_is_transposed[VelocityVerletSolver-of all]
        test_swept::test_a_thin_wall_stops_a_cube[3.0-0.01-BDF2Solver]
        test_swept::test_a_thin_wall_stops_a_cube[3.0-0.01-ImplicitEulerSolver]
        test_swept::test_a_thin_wall_stops_a_cube[3.0-0.05-BDF2Solver]
        test_unequal_steps::test_reverse_gradients_are_the_transpose_of_tangents[loaded_scene-ImplicitEulerSolver]
        test_unequal_steps::test_reverse_gradients_are_the_transpose_of_tangents[loaded_scene-ImplicitMidpointSolver]
        test_unequal_steps::test_reverse_gradients_are_the_transpose_of_tangents[loaded_scene-SemiImplicitSolver]
    """,
}
# those that the forms of the suite for other backends run, where this one proves the same in float64, or in other scenes
OF_BACKENDS = """
    test_implicit::test_a_block_dropped_on_the_ground_comes_to_rest_above_it[ImplicitEulerSolver-f32]
    test_implicit::test_a_block_dropped_on_the_ground_comes_to_rest_above_it[BDF2Solver-f32]
    test_examples::test_gpu_gate[reference explicit f32]
    test_batch::test_backends[elastic]
    test_batch::test_backends[relaxing]
    test_batch::test_backend_of_implicit_scenes
    test_contact_area::test_backend_transpose_of_areas[SemiImplicitSolver]
    test_contact_area::test_backend_transpose_of_areas[VelocityVerletSolver]
    test_contact_area::test_backend_transpose_of_areas[SemiImplicitSolver_force]
    test_contact_area::test_backend_of_areas_in_implicit_steps
    test_quadratic::test_explicit_adjoints_in_single_precision[True]
    test_contact_rollers::test_contact_forces_have_gradients
    test_tape::test_backend_tape[SemiImplicitSolver]
    test_tape::test_backend_tape[VelocityVerletSolver]
    test_reference_motion::test_affine_patch[f32-StableNeoHookean]
    test_reference_motion::test_affine_patch[f32-StVenantKirchhoff]
    test_reference_motion::test_affine_patch[f32-SmithNeoHookean]
    test_reference_motion::test_affine_patch[f32-MooneyRivlin]
    test_reference_motion::test_affine_patch[f32-LinearElastic]
    test_reference_motion::test_affine_patch[f32-Corotated]
    test_reference_motion::test_rotated_rest_shape_is_free_of_force[f32-StableNeoHookean]
    test_reference_motion::test_rotated_rest_shape_is_free_of_force[f32-StVenantKirchhoff]
    test_reference_motion::test_rotated_rest_shape_is_free_of_force[f32-SmithNeoHookean]
    test_reference_motion::test_rotated_rest_shape_is_free_of_force[f32-MooneyRivlin]
    test_reference_motion::test_rotated_rest_shape_is_free_of_force[f32-Corotated]
    test_gradients::test_backend_transpose[SemiImplicitSolver]
    test_gradients::test_backend_transpose[VelocityVerletSolver]
    test_gradients::test_backend_identities
    test_gradients::test_backend_oscillator[None]
    test_gradients::test_backend_oscillator[6]
    test_implicit_cycle::test_single_precision_takes_as_many_iterations_on_every_backend
    test_single_precision::test_gradients_are_the_slopes_of_runs_and_checkpoints_change_no_bit[ImplicitEulerSolver]
    test_self_contact::test_collision_in_single_precision
    test_implicit_contact::test_stopping_distance[f32-0.2-1.019368-BDF2Solver]
    test_implicit_contact::test_stopping_distance[f32-0.4-0.509684-BDF2Solver]
    test_implicit_contact::test_stopping_distance[f32-0.4-0.509684-ImplicitEulerSolver]
"""


def left_out(plain: bool) -> set[str]:
    """Ids of tests; plain: on the CPU in its own form."""
    texts = [*LEFT_OUT.values(), *[OF_BACKENDS] * plain]
    return {test.strip() for text in texts for test in text.strip().splitlines()}
