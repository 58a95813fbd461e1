"""Work that is done on vertices from outside, for the energy that monitor/energy_balance.py follows.

There are two accounts where a scene has cables or muscles: rows [0, n) take what they do as work of loads, rows [n, 2 n) as
that of forces which are the body's own.
"""

import taichi as ti

from diffsim_ti.mechanics.obstacles.obstacle_stages import PLANE, PUSH, ROWS, VELOCITY
from diffsim_ti.runtime import A, Bundle, at, let, traced


@ti.func
def add_work(step: A, i, done, state: A, plan: A):
    """To every account of vertex i [J]."""
    state.work[i] = state.work[i] + done
    if ti.static(step.features.pulled):
        own = plan.num_vertices + i
        state.work[own] = state.work[own] + done


@traced
def with_drag(step, now, scene):
    """A pass with `kept`, what drag leaves of a velocity of 1 in its time, where work is counted: once for all vertices."""
    if not step.counts_work or step.features.drag < 0:
        return now
    return Bundle(**vars(now), kept=let(ti.exp(-now.h * at(scene.parameters, step.features.drag))))


@ti.func
def add_work_of_pass(step: A, i, u, v, v_plus, f, u_next, v_next, now: A, scene: A, state: A, plan: A):
    """That of all but contact stages, to each account what is its own."""
    state.work[i] = state.work[i] + work_of_pass(step, i, u, v, v_plus, f, u_next, v_next, now, scene, plan, True)
    if ti.static(step.features.pulled):
        own = plan.num_vertices + i
        done = work_of_pass(step, i, u, v, v_plus, f, u_next, v_next, now, scene, plan, False)
        state.work[own] = state.work[own] + done


@ti.func
def work_of_own_forces(step: A, i, v, v_plus, f, v_next, now: A, scene: A, plan: A):
    """Work [J] of weight and of what the body itself does on vertex i in the kick from v to v_plus, without loads, cables:
    what kinetic energy gains by it. Stages, drag and friction come after the kick."""
    done, inverse, own = ti.cast(0, step.fp), scene.inverse_mass[i], f
    if ti.static(step.features.forces):
        own += -1 * step.given.force(i, now, scene, scene.forces)
    if ti.static(step.features.loaded_corners):
        own += -1 * step.given.gathered(i, scene, plan, True)
    led = now.pre * v + now.post * v_next
    if inverse > 0:
        if ti.static(step.features.gravity >= 0):
            own += step.gravity(scene.parameters) / inverse
        if ti.static(step.features.partly_fixed):
            done += own.dot(step.sliding_supports.held(i, led, scene))
            own, v = step.sliding_supports.free(i, own, scene), step.sliding_supports.free(i, v, scene)
            v_plus = step.sliding_supports.free(i, v_plus, scene)
        done += step.half() * (now.pre + now.post) * own.dot(v + v_plus)
    elif ti.static(step.features.motion):
        done += own.dot(led)
    return done


@ti.func
def work_of_pass(step: A, i, u, v, v_plus, f, u_next, v_next, now: A, scene: A, plan: A, pulls: A):
    """Work [J] done on vertex i in the pass, less what drag takes, but for a contact stage's. v_plus: its velocity after the
    kick alone. pulls: whether cables are loads, or forces of the body's own."""
    done, inverse, load = ti.cast(0, step.fp), scene.inverse_mass[i], step.vector(0)
    half, pre, post = step.half(), now.pre, now.post
    if post >= now.h:  # a whole kick is two halves
        pre, post = half * now.h, half * now.h
    if ti.static(step.features.forces):
        load = step.given.force(i, now, scene, scene.forces)
    if ti.static(step.features.loaded_corners):
        load += step.given.gathered(i, scene, plan, pulls)
    own = f - load  # the body's
    if inverse > 0:
        if ti.static(step.features.gravity >= 0):
            own += step.gravity(scene.parameters) / inverse
        if ti.static(step.features.partly_fixed):  # what holds it takes what the body does there
            done += -own.dot(step.sliding_supports.held(i, pre * v + post * v_next, scene))
            own, v, v_plus = (
                step.sliding_supports.free(i, own, scene),
                step.sliding_supports.free(i, v, scene),
                step.sliding_supports.free(i, v_plus, scene),
            )
            u_next, v_next = (
                u + step.sliding_supports.free(i, u_next - u, scene),
                step.sliding_supports.free(i, v_next, scene),
            )
        if ti.static(step.features.forces or step.features.loaded_corners):
            done += half * load.dot((pre + post) * (v + v_plus) + (pre * pre - post * post) * inverse * own)
        if ti.static(step.features.drag >= 0):
            lost = 1 - now.kept
            done += half * lost * own.dot(now.post * v_plus - now.pre / now.kept * v)
            if now.alpha > 0:
                drift = (u_next - u) / now.alpha
                done += -lost * drift.dot(v_next + half * lost * drift) / inverse
    elif ti.static(step.features.motion):
        done += -own.dot(pre * v + post * v_next)
    if ti.static(step.features.moving > 0 and len(step.features.pressing) > 0):
        if now.alpha > 0 and scene.surface[i] > 0:
            done += step.obstacles.work_of_forces(i, u, v_plus, now, scene)
    return done


@ti.func
def work_of_stage(contact: A, i, v, now: A, scene: A, state: A):
    """What each moving obstacle acts on vertex i with, friction included, times its own velocity [J]; v: before friction.

    Pushes and planes are those that the stage has noted. As the obstacles see it, friction and the stage only take energy.
    """
    inverse, work = scene.inverse_mass[i], ti.cast(0, contact.fp)
    for c in range(ti.static(contact.features.num_staged)):
        row = ROWS * (ti.static(contact.features.first_staged) + c)
        v_obstacle, after = state.stage[row + VELOCITY, i], v
        if ti.static(len(contact.features.staged_rough) > 0):
            after = contact.slide(ti.static(contact.features.first_staged) + c, i, v, now.h * inverse, scene, state)
        pushed = now.h * state.stage[row + PUSH, i].x * contact.normal(state.stage[row + PLANE, i])
        after = contact.led(i, v, after, scene)
        work += (pushed + (after - v) / inverse).dot(v_obstacle)
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
