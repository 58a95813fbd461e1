"""The tangent of implicit passes: one linear solve per pass, with the operator of the reverse sweep (adjoint.py)."""

from types import SimpleNamespace

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.common.blas_threads import one_blas_thread
from diffsim_ti.inputs import Derived
from diffsim_ti.mechanics.chambers.volume_constraints import ChamberRecord
from diffsim_ti.mechanics.energy.kernels import potential_kernels
from diffsim_ti.mechanics.joints.sweeps import JointTangent
from diffsim_ti.mechanics.obstacles.contact_record import ContactRecord, Shares
from diffsim_ti.mechanics.stress.law_state import LawFrames
from diffsim_ti.solvers.implicit.recorded_passes import RecordedPasses
from diffsim_ti.state.numbers import Tangent


class ImplicitTangent(RecordedPasses):
    """The tangent of a run: changes of the state for changes of everything that the equation names."""

    def __init__(self, workspace, tangent: Derived):
        super().__init__(workspace)
        a, self.tangent, self.mass_dot = workspace.arrays, tangent, workspace.mass_of(tangent)
        p = workspace.potential
        self.du, self.dv, self.tangent_before = tangent.displacement.copy(), tangent.velocity.copy(), None
        self.features = a.features()
        kernels = potential_kernels(a.law, self.features, workspace.parallel, a.in_lanes)
        self.numbers = Tangent(a, tangent)
        self.lag, self.poses = (runtime.array(a.vector, *x.shape) for x in (p.lag, p.poses))
        self.z, own = a.law_states(1), dict(scene=a, pass_=p, at=p, out=p, tangent=(self, self.numbers))
        if self.z is not None:
            runtime.fill(self.z, 0)
            self._law = SimpleNamespace(z=self.z, w=p.w)
        self.law_frames = LawFrames(workspace) if workspace.law_frames else None
        self.held = a.frozen_numbers()
        self._jvp = kernels.jvp.bind(a.in_vectors, **own)
        self.contacts = ContactRecord(workspace) if workspace.impulses else None
        self.joints = JointTangent(workspace, tangent) if workspace.joints else None
        self._shares = Shares(workspace) if (workspace.impulses or self.joints) and len(a.obstacles) else None
        self.rate_dot = float(tangent.parameters[a.features().drag]) if a.features().drag >= 0 else 0.0
        self.frames, self.chamber_record = ([], []), ChamberRecord(workspace.solver, workspace.constrained_chambers)

    @one_blas_thread
    def advance(self, first: int, last: int, num_passes: int, save_every: int) -> None:
        """Tangent of passes first .. last - 1, recorded from slot 0."""
        for j in range(first, last):
            frame = int(self.ws.solver.schedule.shown(j, save_every))
            if frame >= 0:
                self.save_frame(frame)
            self.open(j, first)
            self._pass(j, save_every)
            if self.z is not None:
                runtime.fill(self.ws.potential.w, self.du[None])
                own = dict(at=self.ws.record, tangent=(self._law, self.numbers))
                self.ws.launch_law_state("jvp", self.features, j, j - first, j - first + 1, **own)

    def _pass(self, j: int, save_every: int) -> None:
        ws, s, tangent, a = self.ws, self.stage, self.tangent, self.ws.arrays
        db0, db1, de0, de1 = (x * self.rate_dot for x in s.by_rate)
        dx, dy = s.a0 * self.du, s.b0 * self.dv + db0 * self.v
        if self.before is not None:
            dx = dx + s.a1 * self.tangent_before[0]
            dy = dy + s.b1 * self.tangent_before[1] + db1 * self.before[1]
        place, speed = ws.prescribed(j, tangent)
        now = self.du[a.held]
        held = ws.with_frozen(np.zeros_like(self.du), now if place is None else now + (place - now) / s.c0)
        if ws.rigid:
            held = ws.rigid.held_jvp(held, self.du, tangent.rest)
        poses = None if tangent.path is None else ws.collisions.jvp(tangent.path, j, s)
        if self.joints:
            self.joints.begin()
            held[ws.joints.at] = self.joints.led()
            poses = 0.0 if poses is None else poses
            poses = poses + self.joints.rows_jvp(0.0 * self.joints.dq, self.joints.dq, self.joints.dx)
        surface_friction, from_friction = ws.potential.surface_friction, 0.0
        if surface_friction:
            from_friction = surface_friction.jvp(ws.potential.held_at, held, dx, self.du, self.numbers, poses)
            ws.potential.place(self.u_star)
        runtime.fill(ws.potential.w, held[None])
        if ws.potential.has_friction:
            runtime.fill(self.lag, np.stack([self.du, dx]))
        if tangent.growths is not None:
            moved = ws.growth_of(tangent.growths, j, s)
            runtime.fill(self.numbers.growths, a.growth_blocks(np.stack([moved, moved])[None]))
        if poses is not None and len(poses):
            runtime.fill(self.poses, poses)
        if ws.strains:
            ws.strains.jvp(s, (self.u, self.du), (self.before, self.tangent_before), self)
        if ws.pairs:
            moved = self.numbers.rest, tangent.parameters, poses
            ws.pairs.product(ws.potential.u, 0, ws.potential.w, a.corner, *moved)
        self._jvp(**ws.potential.sizes())
        share = ws.load_share(j, s)
        dR = runtime.fetch(ws.potential.y)[0].astype(np.float64) + self.mass_dot * self.weight(share)
        dR += from_friction
        dR += share * ws.mass * a.gravity_of(tangent)
        dR += ws.applied_forces(tangent.forces, j, s)
        dR += ws.hosts.jvp(ws.potential.held_at, held, (held - dx) / self.gamma, tangent)
        if ws.rigid:
            dR += ws.rigid.turned(held + tangent.rest)
        dR += self.mass * (dx + s.gamma * dy - held)
        if self.joints:
            shares = self._shares.forces("jvp", **self._moved) if self._shares else None
            push = self.joints.force(shares, held, self.du, dR)
            dR = dR - ws.joints.of_joints(ws.joints.follow(push), dR.shape)
        d_star = self.solve(dR)
        if ws.volumes:
            targets = ws.volumes.targets_jvp(ws.potential.held_at, held, tangent)
            d_star, change = ws.volumes.tangent(ws.potential.held_at, d_star, targets, self.solve)
            self.chamber_record.note(j, save_every, change[: len(ws.constrained_chambers)])
        dq = ws.joints.follow(push - ws.joints.of_body(d_star)) if self.joints else None
        d_star = held + d_star
        if self.joints:
            d_star[ws.joints.at] += np.einsum("iad,a->id", ws.joints.J_a, dq)
            poses = poses + self.joints.rows_jvp(dq, 0.0 * dq, 0.0 * dq)
            if len(poses):
                runtime.fill(self.poses, poses)
        if self.contacts:
            self._note_contacts(j, save_every, d_star, dx, poses)
        if self.joints:
            self.joints.step(dq)
        before = self.du, self.dv
        self.du = s.c0 * d_star + (1 - s.c0) * self.du
        self.dv = s.e0 * (d_star - dx) / s.gamma + s.e1 * dy + de0 * self.v_star + de1 * self.y
        place, speed = (x[a.held] for x in before) if place is None else (place, speed)
        self.du, self.dv = ws.with_frozen(self.du, place), ws.with_frozen(self.dv, speed)
        if s.static:
            self.dv = np.zeros_like(self.dv)
        self.tangent_before = before

    @property
    def _moved(self) -> dict:
        """What the forces of obstacles change with, besides places."""
        return dict(tangent=(SimpleNamespace(lag=self.lag, poses=self.poses), self.numbers))

    def _note_contacts(self, j: int, save_every: int, d_star: np.ndarray, dx: np.ndarray, poses) -> None:
        """Change of the forces of obstacles, and of surfaces on each other, in pass j, u* changing by d_star."""
        made, pairs = [], self.ws.pair_shares
        runtime.fill(self.ws.potential.w, d_star[None])
        if self._shares:
            made.append(lambda: self._shares.forces("jvp", **self._moved))
        if pairs:
            along = d_star, dx, self.du, self.numbers, self.tangent.parameters, poses
            made.append(lambda: pairs.jvp(*along))
        self.contacts.add(j, save_every, self.stage.static, *made)

    @property
    def joint_frames(self) -> list:
        """Changes of the frames' joint positions and velocities."""
        return self.joints.frames

    def contact_forces(self, frame_time: np.ndarray) -> np.ndarray:
        """Changes of the frames' contact forces."""
        return self.contacts.forces

    def save_frame(self, frame: int) -> None:
        """Copy the current tangent to a frame."""
        for saved, now in zip(self.frames, (self.du, self.dv)):
            saved.append(now.copy())
        if self.law_frames:
            self.law_frames.note(frame, self.z)
        if self.joints:
            self.joints.note()

    def collect(self) -> tuple[np.ndarray, np.ndarray]:
        """Changes of the frames' positions and velocities."""
        du, dv = (np.stack(x) for x in self.frames)
        return du + self.tangent.rest, dv
