"""Energies of parts of the body, and the work of loads on it."""

from collections.abc import Sequence
from copy import copy

import numpy as np

from diffsim_ti.differentiation.arrays import value_of, with_slopes
from diffsim_ti.inputs.consistent_mass import consistent
from diffsim_ti.materials.evaluate import evaluate
from diffsim_ti.mesh.named_sets import SetOrIndices
from diffsim_ti.outputs.deformation import displacement_gradients
from diffsim_ti.outputs.forces_at_frames import AppliedLoads
from diffsim_ti.outputs.output import Frames, Output, derived
from diffsim_ti.outputs.stresses import at_points, patch_pressure, with_state
from diffsim_ti.scene import Scene


class ElasticEnergy(Output):
    """Energy of strain [J], sum over tetrahedra, or their points, of V psi(F), in each frame; shape (frames,).

    sets: tetrahedron sets, by name, indices or mask, for the energy of each; shape (frames, len(sets)). name: how a loss
    calls it. The gradient is exact by all inputs.
    With volume="patches" a tetrahedron has pi theta / 2 of its patch's pressure pi in the place of lam theta^2 / 2.
    Of a law with a state, such as `Prony`, it is what is stored in all its springs; of a plastic one `Dissipation` has the
    rest. Raises ValueError for laws with rates.
    Holzapfel, Nonlinear Solid Mechanics, 2000, sec. 6.1.
    """

    reads_law_state = True

    def __init__(self, sets: Sequence[SetOrIndices] | None = None, name: str = "elastic_energy"):
        self.sets, self.name = None if sets is None else list(sets), name

    def settled(self, scene: Scene) -> "ElasticEnergy":
        law, mesh = scene.law, scene.mesh
        if law.in_steps().reads != ("H",):
            raise ValueError(
                f"ElasticEnergy supports laws of the displacement gradient, not {law.title}: take a law without rates"
            )
        self.refuse_growth("ElasticEnergy", scene)
        out = copy(self)
        out.scene, out.all = scene, np.arange(mesh.num_tetrahedra)
        out.patched = scene.volume == "patches"
        out.law = self._law_of(law.base if out.patched else law)
        masks = np.ones((1, mesh.num_tetrahedra))
        if self.sets is not None:
            masks = np.zeros((len(self.sets), mesh.num_tetrahedra))
            for mask, chosen in zip(masks, self.sets):
                mask[mesh.tetrahedron_indices(chosen)] = 1
        out.points = mesh.reference.num_points
        out.masks = np.repeat(masks, out.points, 1)  # of the points of all tetrahedra
        return out

    @staticmethod
    def _law_of(law):
        """The law whose energy it is."""
        return law.stored

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return (num_frames,) if self.sets is None else (num_frames, len(self.sets))

    def value(self, frames: Frames) -> np.ndarray:
        of, z, added = derived(self.scene, frames), self.remembered(frames, self.scene), 0.0
        H = displacement_gradients(frames, of, self.scene.mesh, self.all)
        if self.patched:
            pressure, p, theta, _ = patch_pressure(self.scene, of, H)
            added = 0.5 * pressure * theta
        else:
            p = at_points(of.coefficients, len(self.all), self.points).reshape(-1, of.coefficients.shape[-1])
        F, p = (np.eye(3) + H).reshape(-1, 3, 3), with_state(p, z)
        psi, P, by_p = evaluate(self.law, value_of(F), value_of(p))
        psi = with_slopes(psi, (F, lambda: P), (p, lambda: by_p)).reshape(H.shape[:2]) + added
        return ((psi * of.volumes.ravel()) @ self.masks.T).reshape(self.shape(len(psi)))


class Dissipation(ElasticEnergy):
    """Energy that plastic flow has dissipated since the start [J], the sum of V D(a): the integral of the flow stress over
    the equivalent plastic strain a, isotropic hardening included, in each frame; it never falls. Shape (frames,).

    sets, name: as of `ElasticEnergy`. The gradient is exact by all inputs. Raises ValueError for laws without plastic flow.
    Simo, Hughes, Computational Inelasticity, 1998, sec. 9.2.
    """

    def __init__(self, sets: Sequence[SetOrIndices] | None = None, name: str = "dissipation"):
        super().__init__(sets, name)

    def settled(self, scene: Scene) -> "Dissipation":
        if not scene.law.plastic:
            raise ValueError(f"Dissipation: {scene.law.title} has no plastic flow; take J2Plasticity as the material")
        out = super().settled(scene)
        out.patched = False  # no pressure does work on what keeps its volume
        return out

    @staticmethod
    def _law_of(law):
        return law.dissipated


class KineticEnergy(Output):
    """Energy of motion [J], sum over vertices of m v^2 / 2, in each frame; shape (frames,). Implicit steps of ten-node
    tetrahedra have consistent masses: v . M v / 2, a set having the rows of its vertices.

    sets: vertex sets, by name, indices or mask, for the energy of each; shape (frames, len(sets)). name: how a loss
    calls it.
    The gradient is exact by all inputs. Goldstein, Classical Mechanics, 3rd ed., 2002, sec. 1.2.
    """

    def __init__(self, sets: Sequence[SetOrIndices] | None = None, name: str = "kinetic_energy"):
        self.sets, self.name = None if sets is None else list(sets), name

    def settled(self, scene: Scene) -> "KineticEnergy":
        out, mesh = copy(self), scene.mesh
        out.scene, out.masks = scene, np.ones((1, mesh.num_vertices))
        if self.sets is not None:
            out.masks = np.zeros((len(self.sets), mesh.num_vertices))
            for mask, chosen in zip(out.masks, self.sets):
                mask[mesh.vertex_indices(chosen)] = 1
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return (num_frames,) if self.sets is None else (num_frames, len(self.sets))

    def value(self, frames: Frames) -> np.ndarray:
        v, of = frames.velocities.astype(np.float64), derived(self.scene, frames)
        if of.element_masses is None:
            momentum = of.mass[:, None] * v
        else:
            momentum = np.stack([consistent(self.scene.mesh.elements, of.element_masses, frame) for frame in v])
        return (0.5 * (v * momentum).sum(2) @ self.masks.T).reshape(self.shape(len(v)))


class WorkOfLoads(Output):
    """Work [J] that loads have done on the body since the first frame, shape (frames,): the sum over the frames before of

        W_k - W_(k-1) = 1/6 [F_b(a) + 2 F_b(m) + 2 F_e(m) + F_e(b)] . (b - a),        m = (a + b) / 2

    a, b: positions in the two frames; F_b(x), F_e(x): forces of all tractions, body forces, external forces, pressures,
    chambers, springs, cables, muscles, foundations and relations with a stiffness at x, as the first step between the frames
    begins and as the last one ends; with weight=True also those of gravity. A `FilledChamber` pushes with what
    `ChamberPressure` says of the two frames, before the first step with that of the second: its work is the mean of both
    times the change of volume, 0 where V stays.
    It is Simpson's rule along straight lines from frame to frame under loads that go linearly in time: exact, to round-off,
    for such motions; for loads that are constant and dead (and weight), and for a constant pressure on a closed surface
    (minus p times the change of volume), whatever the motion. Else its error falls as the square of the time between
    frames; with save_every=1 loads for each step are those of their step. Loads that change between frames further apart are
    not seen there. What moves fixed vertices, relations that are held exactly, obstacles, drag and a rotating frame do no
    work of loads.

    weight: whether gravity counts. name: how a loss calls it. The gradient is exact by all inputs.
    Raises ValueError for a scene without such loads.
    Belytschko, Liu, Moran, Nonlinear Finite Elements for Continua and Structures, 2000, sec. 6.2.3 (energy balance).
    """

    unit, cumulative, reads_chamber_pressures = "J", True, True

    def __init__(self, weight: bool = False, name: str = "work"):
        self.weight, self.name = bool(weight), name

    def __repr__(self) -> str:
        return f"WorkOfLoads(weight={self.weight}, name={self.name!r})"

    def settled(self, scene: Scene) -> "WorkOfLoads":
        out = copy(self)
        out.scene, out.loads = scene, AppliedLoads(scene, weight=self.weight)
        if not out.loads.any:
            raise ValueError(
                "WorkOfLoads: the scene has no load: add a Traction, BodyForce, ExternalForce or Pressure, or count gravity "
                "by weight=True"
            )
        return out

    def shape(self, num_frames: int) -> tuple[int, ...]:
        return (num_frames,)

    def value(self, frames: Frames) -> np.ndarray:
        of, work, filled = derived(self.scene, frames), [np.zeros(())], self.scene.holds_volumes
        places = frames.positions.astype(np.float64)
        for k in range(1, len(frames.steps)):
            (a, b), first, last = (places[k - 1], places[k]), int(frames.steps[k - 1]) + 1, int(frames.steps[k])
            middle, mean = 0.5 * (a + b), 0.0
            # (weight, place, step, whether as that step begins, frame of held pressures) of each force
            parts = (1 / 6, a, first, True, max(k - 1, 1)), (1 / 3, middle, first, True, max(k - 1, 1))
            for w, x, step, begins, shown in (*parts, (1 / 3, middle, last, False, k), (1 / 6, b, last, False, k)):
                held = frames.chamber_pressures[shown] if filled else None
                mean = mean + w * self.loads.forces(of, x, step, begins, held)
            work.append(work[-1] + (mean * (b - a)).sum())
        return np.stack(work)
