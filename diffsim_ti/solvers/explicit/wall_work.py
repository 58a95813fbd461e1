"""Work that moving obstacles do on a body in a contact stage."""

import taichi as ti

from diffsim_ti.solvers.explicit.obstacle_stages import PLANE, PUSH, ROWS, WALL

A = ti.template()  # an array or Bundle handed to a Taichi function


@ti.func
def work_of_stage(contact: A, i, v, now: A, scene: A, state: A):
    """What each moving obstacle pushes and rubs vertex i with, times its own velocity [J]; v: before friction.

    Pushes and planes are those that the stage has noted. As the obstacles see it, friction and the stage only take energy.
    """
    inverse, work = scene.inverse_mass[i], ti.cast(0, contact.fp)
    for c in range(ti.static(contact.features.num_staged)):
        row = ROWS * (ti.static(contact.features.first_staged) + c)
        wall, after = state.stage[row + WALL, i], v
        if ti.static(len(contact.features.staged_rough) > 0):
            after = contact.slide(ti.static(contact.features.first_staged) + c, i, v, now.h * inverse, scene, state)
        pushed = now.h * state.stage[row + PUSH, i].x * contact.normal(state.stage[row + PLANE, i])
        after = contact.led(i, v, after, scene)
        work += (pushed + (after - v) / inverse).dot(wall)
        v = after
    return work


@ti.func
def work_of_lead(contact: A, i, lead, state: A):
    """What holds vertex i takes the pushes there, on the way `lead` that it goes [J]."""
    work = ti.cast(0, contact.fp)
    for c in range(ti.static(contact.features.num_staged)):
        row = ROWS * (ti.static(contact.features.first_staged) + c)
        normal = contact.normal(state.stage[row + PLANE, i])
        work += -state.stage[row + PUSH, i].x * normal.dot(lead)
    return work
