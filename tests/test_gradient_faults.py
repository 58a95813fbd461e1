"""What must be noticed: wrong adjoints, numbers that are not finite, chaos, Taichi code that overwrites its state."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import taichi as ti
from contact_scenes import with_options
from test_gradients import by_solver, final_loss_gradient, free_scene, full_scene, random_mesh, rollout_of

import diffsim_ti as ds
from diffsim_ti import verify
from diffsim_ti.materials.stable_neo_hookean import StableNeoHookeanLaw
from diffsim_ti.mechanics.obstacles.contact_stage import ContactStage
from diffsim_ti.runtime import traced
from diffsim_ti.solvers.explicit import vertex_parts
from diffsim_ti.solvers.explicit.sweeps import ExplicitAdjoint
from diffsim_ti.terms.obstacles.ground import GroundForce

# ---- mutations: each must fail the dot-product test or the table of gradients -----------------------------------------


@dataclass(frozen=True)
class TransposedBlock(StableNeoHookeanLaw):
    @traced
    def stress_differential_and_products(self, H, dH, p):
        dP, products = super().stress_differential_and_products(H, dH, p)
        return dP.transpose(), products


@dataclass(frozen=True)
class WithoutVolumetricCurvature(StableNeoHookeanLaw):
    """Symmetric still, so only differences can see it."""

    @ti.func
    def curvatures(self, j, s, q, p):
        return p[1], 0, 0


def with_law(law):
    class Mutated(ds.StableNeoHookean):
        def law(self, precision):
            return law(precision)

    return Mutated


@dataclass(frozen=True)
class GroundWithoutCurvature(GroundForce):
    @ti.func
    def force_vjp(self, parameters: ti.template(), first, X, u, v, w):
        return 0 * w, 0 * w


class StageWithoutMove(ContactStage):
    @ti.func
    def by_move(self, i, state: ti.template()):
        return self.vector(0)


class StageWithoutPush(ContactStage):
    @ti.func
    def push_all_vjp(
        self,
        i,
        u,
        z,
        total_adj,
        now: ti.template(),
        scene: ti.template(),
        state: ti.template(),
        adjoint: ti.template(),
        plan: ti.template(),
    ):
        return self.vector(0), self.vector(0)


def scaled(adjoint, derived):
    for name in ("displacement", "velocity", "coefficients", "mass", "parameters", "forces", "motion"):
        setattr(derived, name, getattr(derived, name) * 1.001)


def without(name, part=slice(None)):
    def mutate(adjoint, derived):
        getattr(derived, name)[part] = 0

    return mutate


def barely_scaled(name, factor=1.001):
    def mutate(adjoint, derived):
        getattr(derived, name)[...] *= factor

    return mutate


COLLECTED = {
    "all times 1.001": scaled,
    "no mass": without("mass"),
    "no drag": without("parameters", 0),
    "no ground width": without("parameters", 6),
    "one force row lost": without("forces", 1),
    "motion 0.1 % off": barely_scaled("motion"),
    "shape 0.1 % off": barely_scaled("gradients"),
    "no volumes": without("volumes"),
    "velocity 0.1 % off": barely_scaled("velocity"),
    "a modulus 0.1 % off": lambda adjoint, derived: derived.coefficients[:, 0].__imul__(1.001),
    "coefficients transposed": lambda adjoint, derived: derived.coefficients.__setitem__(
        ..., derived.coefficients[:, ::-1]
    ),
}


def gates_passed(rollout) -> tuple[bool, bool]:
    return verify.dot_product_test(rollout) <= 1e-12, ds.check_gradients(rollout, verbose=False).passed


@by_solver
def test_gates_pass_without_mutation(solver):
    assert gates_passed(rollout_of(full_scene(), solver, 3)) == (True, True)


@pytest.mark.parametrize("name", COLLECTED)
@by_solver
def test_mutated_results(monkeypatch, solver, name):
    collect = ExplicitAdjoint.collect

    def mutated(self):
        derived = collect(self)
        COLLECTED[name](self, derived)
        return derived

    monkeypatch.setattr(ExplicitAdjoint, "collect", mutated)
    rollout = rollout_of(full_scene(), solver, 3)
    assert gates_passed(rollout) == (False, False)


@pytest.mark.parametrize("law, dot_product_sees_it", [(TransposedBlock, True), (WithoutVolumetricCurvature, False)])
def test_mutated_laws(law, dot_product_sees_it):
    """The dot product compares with the tangent, which shares dP: a symmetric mistake is for differences to find."""
    symmetric, right = gates_passed(rollout_of(free_scene(with_law(law)), steps=3))
    assert not right and symmetric != dot_product_sees_it


def test_mutated_contact(monkeypatch):
    monkeypatch.setattr(ds.Ground, "kernel", lambda self, precision: GroundWithoutCurvature(precision))
    force = with_options(ds.SemiImplicitSolver, contact="force")
    assert gates_passed(rollout_of(full_scene(), force, steps=3)) == (False, False)


@pytest.mark.parametrize("stage", [StageWithoutMove, StageWithoutPush])
def test_mutated_stage(monkeypatch, stage):
    """The adjoint of the move that obstacles push, and that of the pushes."""
    own = type(f"Ground{stage.__name__}", (GroundForce,), {})  # compiles anew
    monkeypatch.setattr(ds.Ground, "kernel", lambda self, precision: own(precision))
    monkeypatch.setattr(vertex_parts, "ContactStage", stage)
    assert gates_passed(rollout_of(full_scene(), steps=3)) == (False, False)


@pytest.mark.parametrize("field", ["alpha_by_rate", "decay_by_rate"])
@by_solver
def test_mutated_drag(monkeypatch, solver, field):
    """Tangent and mirror share these numbers: again differences find it."""
    weights = solver.weights

    def mutated(self, *arguments):
        w = weights(self, *arguments)
        return replace(w, **{field: 1.001 * getattr(w, field)})

    monkeypatch.setattr(solver, "weights", mutated)
    report = ds.check_gradients(rollout_of(full_scene(), solver, 3), inputs=["drag_rate"], verbose=False)
    assert not report.passed


def test_forgotten_velocities(monkeypatch):
    start = ExplicitAdjoint.start
    monkeypatch.setattr(ExplicitAdjoint, "start", lambda self, x, v, last: start(self, x, 0 * v, last))
    assert gates_passed(rollout_of(full_scene(), steps=3)) == (False, False)


# ---- not finite -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("part, frame, step", [("positions", 2, 4), ("velocities", 1, 2)])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_loss_gradient_that_is_not_finite(part, frame, step, bad):
    rollout = rollout_of(full_scene(), steps=6, save_every=2)
    frames = rollout.forward()
    before = {name: value.copy() for name, value in rollout.values.items()}
    w = np.ones(frames.positions.shape)
    right = rollout.vjp(frames, **{part: w})
    w[frame, 5, 1] = bad
    with pytest.raises(FloatingPointError, match=f"{part} is not finite at step {step}.*parameters are unchanged"):
        rollout.vjp(frames, **{part: w})
    assert all(np.array_equal(rollout.values[name], before[name]) for name in before)
    again = rollout.vjp(frames, **{part: np.ones(w.shape)})
    assert all(np.array_equal(again[name], right[name]) for name in right)


@by_solver
@pytest.mark.parametrize("options", [{}, {"checkpoint_every": 3}, {"memory": 0.02}, {"health": True}])
def test_an_adjoint_that_becomes_nan_names_its_step(monkeypatch, solver, options):
    """... and the next sweep is right, although the one before stopped halfway."""
    from diffsim_ti import runtime

    rollout = rollout_of(full_scene(), solver, 12, **options)
    frames = rollout.forward()
    w = np.ones(frames.positions.shape)
    right = rollout.vjp(frames, w)
    reverse, bad_step = ExplicitAdjoint.reverse, 5

    def poisoned(self, base, last, num_passes, save_every, stop, to_state=False):
        reverse(self, base, last, num_passes, save_every, stop, to_state)
        if stop < (bad_step + 1) * rollout.solver.substeps:
            runtime.fill(self.v, np.nan)

    monkeypatch.setattr(ExplicitAdjoint, "reverse", poisoned)
    with pytest.raises(FloatingPointError, match=f"not finite in step {bad_step} .*parameters are unchanged"):
        rollout.vjp(frames, w)
    monkeypatch.setattr(ExplicitAdjoint, "reverse", reverse)
    again = rollout.vjp(frames, w)
    assert all(np.array_equal(again[name], right[name]) for name in right)


@pytest.mark.filterwarnings("ignore:overflow encountered:RuntimeWarning")
def test_an_adjoint_that_overflows():
    rollout = rollout_of(full_scene(), steps=6)
    frames = rollout.forward()
    with pytest.raises(FloatingPointError, match="the adjoint became not finite in step [0-5] "):
        rollout.vjp(frames, np.full(frames.positions.shape, 1e308))


def test_a_run_that_diverges_leaves_older_frames_their_gradient():
    rollout = rollout_of(free_scene(), steps=10)
    frames = rollout.forward()
    w = np.ones(frames.positions.shape)
    right = rollout.vjp(frames, w)
    with pytest.raises(FloatingPointError):
        rollout.forward(youngs_modulus=rollout.values["youngs_modulus"] * 1e300)
    again = rollout.vjp(frames, w)
    assert all(np.array_equal(again[name], right[name]) for name in right)


# ---- contact ----------------------------------------------------------------------------------------------------------


def falling(steps, solver=ds.SemiImplicitSolver, height=0.25, **options):
    """A cube that falls on the ground: its barrier is reached after about 0.2 s."""
    mesh = random_mesh()
    m = mesh.num_tetrahedra
    scene = ds.Scene(
        mesh,
        ds.StableNeoHookean(np.full(m, 1e5), 0.3),
        terms=[ds.Gravity(), ds.Ground(-0.05 - height, 1e5, 0.05)],
        precision="f64",
    )
    return ds.Rollout(solver(scene, dt=1e-3), steps, **options)


GROUND = ("ground_height", "barrier_stiffness", "barrier_width")


@by_solver
def test_never_touching(solver):
    """Zero, not small, by everything about the ground; and I6: no stiffness acts in free fall."""
    rollout = falling(50, solver)
    frames = rollout.forward()
    w = np.ones(frames.positions[-1].shape)
    g = final_loss_gradient(rollout, w)
    assert all(g[name] == 0.0 for name in GROUND)
    fallen = np.abs(frames.positions[-1] - frames.positions[0]).sum()
    assert np.abs(g["youngs_modulus"]).max() <= 1e-12 * fallen / 1e5


@by_solver
@pytest.mark.parametrize("steps", range(180, 300, 20))
def test_across_first_contact(solver, steps):
    rollout = falling(steps, solver)
    report = ds.check_gradients(rollout, inputs=["initial_velocities", "youngs_modulus", *GROUND], verbose=False)
    assert report.passed, str(report)


def test_first_contact_is_among_those_steps():
    touched = [abs(final_loss_gradient(falling(s), np.ones((27, 3)))["ground_height"]) > 0 for s in range(180, 300, 20)]
    assert not touched[0] and touched[-1]


# ---- long and wild ----------------------------------------------------------------------------------------------------


def test_health_of_a_bouncing_block():
    """Five seconds of tumbling and bouncing: the report tells how fast the gradient grows and when it is of no more use."""
    mesh = ds.TetrahedralMesh.create_cube(2).rotated([0.3, 1.0, 0.2], 0.7)
    scene = ds.Scene(
        mesh,
        ds.StableNeoHookean(np.full(mesh.num_tetrahedra, 2e5), 0.3),
        terms=[ds.Gravity(), ds.Ground(-1.0, 2e6, 0.1)],
        initial_velocities=np.cross([1.0, 0.5, 3.0], mesh.vertices),
        precision="f64",
    )
    rollout = ds.Rollout(ds.SemiImplicitSolver(scene, dt=1e-3, substeps=2), 5000, health=True)
    frames = rollout.forward()
    w = np.zeros(frames.positions.shape)
    w[-1] = 1
    gradients = rollout.vjp(frames, w)
    assert all(np.all(np.isfinite(g)) for g in gradients.values())
    health = verify.gradient_health(rollout, limit=1e6)
    assert len(health.steps) == 5000 and health.steps[0] == 4999 and health.steps[-1] == 0
    assert np.all(np.isfinite(health.norms)) and health.growth_rate > 0.5
    assert health.exceeded_at is not None and 0 < health.exceeded_at < 5000
    assert health.norms[4999 - health.exceeded_at] > 1e6 * health.norms[0]
    assert f"going back past step {health.exceeded_at}" in str(health)


def test_an_adjoint_that_explodes_says_so():
    """A step beyond the stable one at rest: the motion is still, the adjoint is not."""
    mesh = random_mesh()
    still = np.zeros(mesh.vertices.shape)
    scene = free_scene(gravity=(0.0, 0.0, 0.0), initial_positions=mesh.vertices, initial_velocities=still)
    limit = ds.SemiImplicitSolver(scene, dt=1e-4).stable_dt(tight=True).dt
    solver = ds.SemiImplicitSolver(scene, dt=1.1 * limit, allow_unstable=True)
    rollout = ds.Rollout(solver, 40, health=True)
    frames = rollout.forward()
    assert np.array_equal(frames.positions[0], frames.positions[1])
    with pytest.warns(UserWarning, match="the adjoint grew by .*truncate=, or see gradient_health"):
        rollout.vjp(frames, np.random.default_rng(0).normal(size=frames.positions.shape))
    # omega dt = 2.2 grows by 2.43 a step
    health = verify.gradient_health(rollout)
    assert health.growth_rate == pytest.approx(np.log(2.43) / (1.1 * limit), rel=0.1) and health.exceeded_at is not None


def test_health_of_a_damped_body():
    rollout = rollout_of(full_scene(), steps=100, health=True)
    rollout.vjp(rollout.forward(), np.ones((2, 27, 3)))
    health = verify.gradient_health(rollout)
    assert health.exceeded_at is None and "never" in str(health)
    with pytest.raises(ValueError, match="health=True"):
        verify.gradient_health(rollout_of(full_scene(), steps=1))


# ---- clip and truncate ------------------------------------------------------------------------------------------------


def test_clip_that_is_never_reached_changes_nothing():
    plain, clipped = (rollout_of(full_scene(), steps=20, clip=clip) for clip in (None, 1e12))
    w = np.ones((2, 27, 3))
    a, b = (r.vjp(r.forward(), w) for r in (plain, clipped))
    assert all(np.array_equal(a[name], b[name]) for name in a)
    assert len(clipped.health) == 20 and all(h["scaled"] == 1.0 for h in clipped.health)


def test_clip_holds_the_adjoint_back():
    limit = 5.0
    rollout = rollout_of(full_scene(), steps=20, clip=limit)
    rollout.vjp(rollout.forward(), np.ones((2, 27, 3)))
    norms = np.array([np.hypot(h["norm_position"], h["norm_velocity"]) for h in rollout.health])
    scales = np.array([h["scaled"] for h in rollout.health])
    assert norms.max() > limit and np.all(norms * scales <= limit * (1 + 1e-12))
    assert np.all(scales[norms <= limit] == 1.0)


def last_steps(scene, solver, frames, k, steps):
    """A rollout of the last k of `steps` steps, from the frame where they begin."""
    at = steps - k
    moved = scene.motion

    def motion(t):
        return moved(t + at * 2e-3) - moved(at * 2e-3)

    start = scene.replace(
        initial_positions=frames.positions[at],
        initial_velocities=frames.velocities[at],
        motion=motion,
        terms=[*scene.terms[:3], ds.ExternalForce(scene.inputs.values["external_forces"][at:])],
    )
    return rollout_of(start, solver, k)


TRUNCATED = ("youngs_modulus", "poissons_ratio", "density", "gravity", "drag_rate", "ground_height", "barrier_width")


@pytest.mark.parametrize("k", [1, 7])
@pytest.mark.parametrize("options", [{}, {"checkpoint_every": 3}, {"memory": 0.02}])
def test_truncate_is_the_gradient_of_the_last_steps(k, options):
    steps, w = 20, np.random.default_rng(2).normal(size=(27, 3))
    scene = full_scene(steps=steps)
    frames = rollout_of(scene, steps=steps, save_every=1).forward()
    truncated = rollout_of(scene, steps=steps, truncate=k, **options)
    g = final_loss_gradient(truncated, w, w)
    expected = final_loss_gradient(last_steps(scene, ds.SemiImplicitSolver, frames, k, steps), w, w)
    for name in TRUNCATED:  # round-off: the state goes through positions
        np.testing.assert_allclose(g[name], expected[name], rtol=1e-8, atol=1e-10 * np.abs(expected[name]).max())
    np.testing.assert_allclose(g["external_forces"][-k:], expected["external_forces"], rtol=1e-8, atol=1e-14)
    assert not g["external_forces"][:-k].any()
    assert not g["initial_positions"].any() and not g["initial_velocities"].any()


@by_solver
def test_truncate_of_all_steps_is_the_whole_gradient(solver):
    whole, all_steps, more = (rollout_of(full_scene(), solver, 10, truncate=k) for k in (None, 10, 99))
    w = np.ones((2, 27, 3))
    a, b, c = (r.vjp(r.forward(), w) for r in (whole, all_steps, more))
    assert all(np.array_equal(a[name], b[name]) and np.array_equal(a[name], c[name]) for name in a)


@by_solver
def test_truncated_gradients_approach_the_whole(solver):
    """With damping both forget the past."""
    scene = full_scene()
    w = np.random.default_rng(2).normal(size=(27, 3))
    gradients = [
        final_loss_gradient(rollout_of(scene, solver, 100, truncate=k), w)["gravity"] for k in (None, 100, 99, 50)
    ]
    distance = [np.linalg.norm(g - gradients[0]) for g in gradients]
    assert distance[1] == 0 < distance[2] < distance[3]


# ---- what a tape does with state that is overwritten ---------------------------------------------------------------------


def test_state_updated_in_place_is_caught_by_a_taylor_test():
    """A cubic spring written in the obvious way: Taichi's tape reads the overwritten state, without a word."""
    x, v, k, loss = (ti.field(ti.f64, (), needs_grad=True) for _ in range(4))

    @ti.kernel
    def start():
        x[None] = 1.0
        v[None] = 0.0

    @ti.kernel
    def step():
        v[None] -= 0.02 * k[None] * x[None] ** 3
        x[None] += 0.02 * v[None]

    @ti.kernel
    def end():
        loss[None] += x[None]

    def run(stiffness):
        k[None] = float(stiffness)
        with ti.ad.Tape(loss):
            start()
            for _ in range(60):
                step()
            end()
        return loss[None]

    run(3.0)
    naive = k.grad[None]
    differences, _ = verify.central_difference(lambda t: run(3.0 + t))
    assert abs(naive - differences) > 0.1 * abs(differences)  # wrong, and nothing was said
    assert ds.taylor_test(run, 3.0, naive, 1.0, epsilon=1e-2).rate < 1.1
    assert ds.taylor_test(run, 3.0, differences, 1.0, epsilon=1e-2).rate > 1.9  # the function itself is smooth
