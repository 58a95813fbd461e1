"""The reverse sweep of implicit passes: one linear solve per pass with the exact Hessian.

A pass solves R(u*, theta) = 0 with -dR/du = A = c M + d2E/du2, which is symmetric. So du* = A^-1 dR for a change of
theta, and for the adjoint p of u* the adjoint of theta is lambda . dR/dtheta with A lambda = p.
"""

from types import SimpleNamespace

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.common.blas_threads import one_blas_thread
from diffsim_ti.differentiation.arrays import add_transposed
from diffsim_ti.inputs import Derived
from diffsim_ti.mechanics.chambers.volume_constraints import ChamberRecord
from diffsim_ti.mechanics.joints.sweeps import JointAdjoint
from diffsim_ti.mechanics.obstacles.contact_record import ContactRecord, SharesAdjoint
from diffsim_ti.mechanics.stress.law_state import LawFrames
from diffsim_ti.solvers.implicit.recorded_passes import RecordedPasses
from diffsim_ti.state.numbers import Adjoint


def plus(x: np.ndarray, *more: np.ndarray | None) -> np.ndarray:
    """x and what there is of others."""
    for y in more:
        x = x if y is None else x + y
    return x


class ImplicitAdjoint(RecordedPasses):
    """Adjoints of one run, in float64 on the host, except those of tetrahedra.

    density, shape: also the adjoints by vertex masses and by the rest shape, which cost extra.
    """

    transposed = True

    def __init__(self, workspace, density: bool, shape: bool):
        super().__init__(workspace)
        a = workspace.arrays
        self.features = a.features(density, shape)
        self.numbers, p = Adjoint(a, self.features), workspace.potential
        self.kernels = p.kernels_for(self.features, workspace.parallel)
        n, num_obstacles = a.num_vertices, len(a.obstacles)
        self.potential = p
        self.lag = runtime.array(a.vector, 2, n if p.has_friction else 1)
        self.poses = runtime.array(a.vector, a.poses.size, n if num_obstacles else 1)
        used = (self.lag, p.has_friction), (self.poses, num_obstacles)
        self._cleared = [array for array, some in used if some]  # in each pass
        self.z, own = a.law_states(1), dict(scene=a, pass_=p, at=p, out=p, adjoint=(self, self.numbers))
        if self.z is not None:  # the state of the law
            corner, y = runtime.array(a.vector, *a.corner.shape), runtime.array(a.vector, 1, n)
            runtime.fill(corner, 0)  # also where surfaces in contact have theirs
            self._law = SimpleNamespace(z=self.z, corner=corner, y=y)
        self.law_frames = LawFrames(workspace) if workspace.law_frames else None
        self.held = a.frozen_numbers()  # in a pass, by the law
        self._vjp = self.kernels.vjp.bind(a.in_vectors, **own)
        self.chamber_record = ChamberRecord(workspace.solver, workspace.constrained_chambers)
        self.joints = JointAdjoint(workspace, self.features, self.numbers) if workspace.joints else None
        self.contacts = None
        if workspace.impulses:
            self.contacts = ContactRecord(workspace)
            self._shares = SharesAdjoint(workspace, self.features, self.numbers) if num_obstacles else None

    def fits(self, workspace) -> bool:
        """Whether kernels and arrays are still those of the run."""
        features = workspace.arrays.features(self.features.density, self.features.shape)
        return (self.features is features or self.features == features) and workspace.potential is self.potential

    def start(self, positions_adj: np.ndarray, velocities_adj: np.ndarray, last_frame_is_input: bool) -> None:
        """Set the adjoints of the frames, shape (frames, n, 3), and clear the rest."""
        self.numbers.clear()
        if self.z is not None:
            runtime.fill(self.z, 0)
        if self.ws.pairs:
            self.ws.pairs.clear_sums()
        a = self.ws.arrays
        self.frames = tuple(np.asarray(x, np.float64) for x in (positions_adj, velocities_adj))
        self.p, self.q = self.frames[0][-1].copy(), self.frames[1][-1].copy()
        self.pending = [None, None]  # adjoints of the state before
        self.by_weight, self.by_inertia = np.zeros((2, *self.p.shape))  # sums over passes (mass_adj, gravity_adj)
        self.gravity, self.rate = np.zeros(3), 0.0
        masses = a.values.element_masses
        self.element_masses = None if masses is None else np.zeros(masses.shape)
        self.growth = None if a.values.growths is None else np.zeros_like(a.values.growths)
        self.by_hosts = a.values.zeros() if self.ws.hosts or self.joints else Derived()  # of the numbers of host forces
        self.rest_adj = np.zeros(self.p.shape)
        self.forces = None if a.values.forces is None else np.zeros_like(a.values.forces)
        self.motion = None if a.values.motion is None else np.zeros_like(a.values.motion)
        self.path = None if a.values.path is None else np.zeros_like(a.values.path)
        self.anchor = np.zeros((len(a.held), 3))
        if self.joints:
            self.joints.seed_frames(None)

    def seed_contacts(self, forces_adj: np.ndarray | None, frame_time: np.ndarray) -> None:
        """Set the adjoints of the frames' contact forces (None: zero)."""
        self.contacts.forces = np.zeros_like(self.contacts.forces) if forces_adj is None else forces_adj

    @one_blas_thread
    def reverse(
        self, base: int, last: int, num_passes: int, save_every: int, stop: int, to_state: bool = False
    ) -> None:
        """Go back through passes last - 1 .. stop; slot 0 of the record holds the state before pass `base`.

        to_state: stop at the state that pass `stop` shows, which is the one before it.
        """
        for j in range(last - 1, stop - 1, -1):
            self.open(j, base)
            if self.z is not None:
                self._pull_back_law(j, j - base)
            self._pull_back(j, save_every)
            if self.growth is not None:
                self._pull_back_growth(j)
            frame = int(self.ws.solver.schedule.shown(j, save_every))
            if 0 <= frame < len(self.frames[0]) - 1:
                self.p += self.frames[0][frame]
                self.q += self.frames[1][frame]
                if self.law_frames:
                    self.law_frames.add_to(self.z, frame)
                if self.joints:
                    self.joints.add_frame(frame)

    def _pull_back_growth(self, j: int) -> None:
        """The adjoint of growth by tetrahedra in pass j goes to its step."""
        by_blocks = self.ws.arrays.from_growth_blocks(runtime.fetch(self.numbers.growths).astype(np.float64))
        add_transposed(self.growth, lambda rows: self.ws.growth_of(rows, j, self.stage), by_blocks[0].sum(0))
        runtime.fill(self.numbers.growths, 0)

    def _pull_back_law(self, j: int, slot: int) -> None:
        """The state of the law after pass j comes from that before, in a slot of the record, and from where it ends."""
        own = dict(at=self.ws.record, adjoint=(self._law, self.numbers))
        self.ws.launch_law_state("vjp", self.features, j, slot, slot + 1, **own)
        self.p = self.p + runtime.fetch_row(self._law.y, 0)

    def _pull_back_contacts(self, j: int, save_every: int) -> tuple[tuple | None, tuple | None]:
        """Adjoints of what the forces of obstacles in pass j depend on (SharesAdjoint), and of what pairs do
        (PairShares.vjp), where a loss names them."""
        seed = self.contacts.seed(j, save_every, self.stage.static)
        seen = by_pairs = None
        if seed is not None and self._shares:
            seen = self._shares.pull_back(seed[: self._shares.num_obstacles], self._sum_of_poses)
        if seed is not None and self.ws.pair_shares:
            by_pairs = tuple(self.ws.pair_shares.vjp(seed))
            self.potential.place(self.u_star)
        return seen, by_pairs

    def _pull_back(self, j: int, save_every: int) -> None:
        ws, s, p, q, held = self.ws, self.stage, self.p, self.q, self.ws.arrays.held
        seen, from_pairs = self._pull_back_contacts(j, save_every) if self.contacts else (None, None)
        by_contacts, by_x, by_lag = (None, None, None) if from_pairs is None else from_pairs
        by_contacts = by_contacts if seen is None else plus(seen[0], by_contacts)
        if s.static:
            q = np.zeros(q.shape)
        # the equation
        by_speed = None if s.static else s.e0 / s.gamma * q
        by_ends = plus(p if s.c0 == 1 else s.c0 * p, by_speed, by_contacts)
        seed, q_free = by_ends * ws.linear, q if s.static else q * ws.linear
        if np.vdot(seed, seed) < 1e-36 * np.vdot(p, p):  # rounding of what is held, no direction of ours
            seed = 0 * seed
        if self.joints:
            seed = self.joints.begin(seed, 0.0 if seen is None else seen[2], by_ends)
            q_free = self.joints.with_held(q_free, q)
        by_star = self.solve(seed)
        if ws.volumes:
            by_pressure = self.chamber_record.adjoint(j, save_every)
            by_star, nu = ws.volumes.adjoint(ws.potential.held_at, by_star, by_pressure, self.solve)
        if self.joints:
            by_star = self.joints.follow(by_star)
        runtime.fill(ws.potential.w, by_star[None])
        runtime.clear(self._cleared)
        if ws.pairs:
            ws.pairs.vjp(ws.potential.u, 0, ws.potential.w, ws.arrays.corner)
        self._vjp(**ws.potential.sizes())
        reaction = plus(runtime.fetch_row(ws.potential.y, 0), by_contacts)
        if ws.hosts:
            by_place, by_speed = ws.hosts.vjp(ws.potential.held_at, by_star, self.by_hosts)
            reaction, by_x = reaction + by_place + by_speed / self.gamma, plus(-by_speed / self.gamma, by_x)
        if ws.volumes:
            reaction = reaction + ws.volumes.add_targets(nu, ws.potential.held_at, self.by_hosts)
        if ws.potential.surface_friction:
            by_place, by_friction, by_begin = ws.potential.surface_friction.vjp(ws.potential.held_at, by_star)
            reaction, by_x, by_lag = reaction + by_place, plus(by_friction, by_x), plus(by_begin, by_lag)
        by_joints = self.joints.pull_back(by_star) if self.joints else (None, None, None)
        if self.joints:
            reaction, self.rest_adj = reaction + by_joints[0], self.rest_adj + self.joints.by_rest
        share = ws.load_share(j, s)
        self.by_weight += share * by_star
        if self.features.density and self.element_masses is not None:
            at, weight = ws.arrays.mesh.elements, self.weight(share)
            self.element_masses += by_star[at] @ np.swapaxes(weight[at], 1, 2)
        elif self.features.density and not s.static:
            self.by_inertia += by_star * self.acceleration
        if self.forces is not None:
            ws.add_loads(self.forces, j, s, share * by_star)
        # where inertia starts from
        x_adj = inertial = q if s.static else self.mass * by_star
        if not s.static:
            reaction = reaction - inertial  # the inertia of neighbours acts on fixed vertices, too
            x_adj = inertial - s.e0 / s.gamma * q_free
        x_adj = plus(x_adj, by_x)
        if ws.potential.has_friction:
            by_first, by_first_x = plus(runtime.fetch(self.lag).astype(np.float64), None if seen is None else seen[1])
            by_lag, x_adj = plus(by_first, by_lag), x_adj + by_first_x
        if self.joints:
            by_lag, x_adj = plus(by_joints[1][0], by_lag), x_adj + by_joints[1][1]
            by_poses = self._sum_of_poses(runtime.fetch(self.poses).astype(np.float64)) + by_joints[2]
            self.gravity = self.gravity + self.joints.end(by_poses, self.by_hosts)
            by_places = by_ends + reaction if by_contacts is None else by_ends + reaction - by_contacts
            self.rest_adj[ws.joints.at] -= self.joints.hand_on(by_places)
        if self.path is not None:
            by_poses = self._sum_of_poses(runtime.fetch(self.poses).astype(np.float64))
            by_poses = plus(by_poses, by_joints[2], None if seen is None else seen[2])
            if ws.pairs and ws.pairs.obstacles:
                by_poses = by_poses + ws.pairs.obstacles.take_rows()
            ws.collisions.vjp(by_poses, j, s, self.path)
        y_adj = s.gamma * inertial + s.e1 * q_free if s.e1 else s.gamma * inertial
        if self.features.drag >= 0:
            db0, db1, de0, de1 = s.by_rate
            by_rate = db0 * y_adj * self.v + de0 * q_free * self.v_star + de1 * q_free * self.y
            if self.before is not None:
                by_rate += db1 * y_adj * self.before[1]
            self.rate = self.rate + self._sum(by_rate).sum(-1)
        u_adj = plus(s.a0 * x_adj, None if s.c0 == 1 else (1 - s.c0) * p * ws.linear, by_lag)
        v_adj = s.b0 * y_adj
        if ws.rigid:
            turned = ws.rigid.turned_vjp(by_star)
            self.rest_adj = self.rest_adj + turned
            ws.rigid.held_vjp(s.c0 * p + s.e0 / s.gamma * q + reaction + turned, u_adj, self.rest_adj)
        # prescribed places
        if len(held):
            self._pull_back_held(j, p, q, reaction, u_adj, v_adj)
        self.p, self.q = plus(u_adj, self.pending[0]), plus(v_adj, self.pending[1])
        self.pending = [None, None] if self.before is None else [s.a1 * x_adj, s.b1 * y_adj]
        if ws.strains:
            by_u, by_before = ws.strains.vjp(s, self.u, self.before, self)
            self.p, self.pending[0] = self.p + by_u, plus(by_before, self.pending[0])

    @staticmethod
    def _sum(x: np.ndarray) -> np.ndarray:
        """Of vectors of all vertices."""
        return x.sum(0)

    @staticmethod
    def _sum_of_poses(rows: np.ndarray) -> np.ndarray:
        """Of what each vertex has of the rows of obstacles."""
        return rows.sum(1)

    @property
    def mass_adj(self) -> np.ndarray:
        """By lumped masses."""
        a = self.ws.arrays
        return (self.by_weight * a.gravity_of(a.values) - self.by_inertia).sum(1)

    @property
    def gravity_adj(self) -> np.ndarray:
        return self.gravity + self._sum(self.ws.mass * self.by_weight)

    def _pull_back_held(self, j, p, q, reaction, u_adj, v_adj) -> None:
        """Adds what comes by the held parts, of which nothing is in u_adj and v_adj of the equation."""
        ws, held, s = self.ws, self.ws.arrays.held, self.stage
        if self.motion is None:
            u_adj[held] += ws.of_held((p + reaction)[held])
            if not s.static:
                v_adj[held] += ws.of_held(q[held])
            return
        schedule = ws.solver.schedule
        pull, p, q = (ws.of_held(x[held]) for x in (reaction, p, q))
        place = p + pull / s.c0
        u_adj[held] += (1 - 1 / s.c0) * pull
        add_transposed(self.motion, lambda rows: schedule.place(rows, j, schedule.end(j)), place)
        add_transposed(self.motion, lambda rows: schedule.rate(rows, j), q)
        self.anchor += place

    def reverse_kick(self, j: int, base: int, num_passes: int) -> None:
        """No pass shows a state that it changed before."""

    def finish(self) -> None:
        """The sweep leaves nothing undone."""

    def norm(self) -> tuple[float, float]:
        """Euclidean norms of the adjoints of displacement and velocity, joints included, where the sweep stands.

        Fixed vertices have no velocity, and sets that are `reduced` only admissible motions.
        """
        reduced = self.ws.scene.reduced
        p, q = reduced.of(self.p), reduced.of(self.ws.arrays.supports.free(self.q))
        if self.joints:
            p, q = np.append(p, self.joints.by_q), np.append(q, self.joints.by_v)
        return float(np.linalg.norm(p)), float(np.linalg.norm(q))

    def scale(self, factor: float) -> None:
        """Multiply the running adjoint."""
        self.p, self.q = factor * self.p, factor * self.q
        self.pending = [x if x is None else factor * x for x in self.pending]
        if self.joints:
            self.joints.scale(factor)
        if self.z is not None:
            runtime.fill(self.z, runtime.fetch(self.z) * factor)

    def collect(self) -> Derived:
        """Adjoints of what kernels read, in float64, at the start of the run."""
        a, features, out = self.ws.arrays, self.features, self.numbers.collect()
        out.displacement, out.velocity = self.p, self.q
        if features.density and self.element_masses is None:
            out.mass = self.mass_adj
        out.element_masses = self.element_masses
        if features.gravity >= 0:
            out.parameters[features.gravity :][:3] = self.gravity_adj
        if features.drag >= 0:
            out.parameters[features.drag] = self.rate
        by_pairs = None
        if self.ws.pairs:
            by_parameters, by_pairs = self.ws.pairs.collect()
            out.parameters += by_parameters
        if features.shape:
            out.rest = plus(self.frames[0].sum(0) + self.rest_adj + out.rest, by_pairs)
        out.growths = self.growth
        out.forces, out.motion, out.path = self.forces, self.motion, self.path
        out.add(self.by_hosts)
        if self.joints:
            self.joints.collect(out)
        if self.motion is not None:
            out.displacement[a.held] += self.anchor
        return out
