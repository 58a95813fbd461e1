"""Robots among a scene's interactions: their numbers over time, and which solvers take them."""

import numpy as np

from diffsim_ti.inputs.joints import JointRows
from diffsim_ti.mechanics.interaction import Interaction
from diffsim_ti.terms.robots.robot import Robot
from diffsim_ti.terms.self_contact import SelfContact
from diffsim_ti.terms.whole_body import RotatingFrame

SOFT = 1e-4  # of the range of a joint, on which its limits grow stiff


class Robots(Interaction):
    """Their joints are unknowns of implicit steps and equilibria (joints/joints.py), and of explicit steps
    (joints/explicit.py)."""

    name, kinds, works, on_host, in_kernels = "robots", (Robot,), "robots", False, False
    derived = dict(joints="vectors2")

    def __init__(self, scene, terms):
        super().__init__(scene, terms)
        self.count = sum(term.model.size for term in terms)
        self.prescribed = np.concatenate([term.prescribed for term in terms])
        self.damping = np.concatenate([term.damping for term in terms])
        self.typical = np.concatenate([term.typical for term in terms])
        self.lower, self.upper = (np.concatenate(x) for x in zip(*(term.limits for term in terms)))
        span = self.upper - self.lower
        self.soft = np.where(np.isfinite(span), SOFT * span, 1.0)  # on which the stiffness of limits grows [rad or m]

    def slices(self) -> list[slice]:
        """Places of each robot's joints among all."""
        ends = np.cumsum([0, *(term.model.size for term in self.terms)]).tolist()
        return [slice(a, b) for a, b in zip(ends, ends[1:])]

    def links(self, own):
        names = [f"{own[term]} {part}" for term in self.terms for part in ("targets", "torques")]
        return [JointRows(names, "joints")]

    def check_solver(self, solver) -> None:
        if not solver.moves_robots:
            raise ValueError(
                f"{type(solver).__name__}: robots move in steps that end where forces are taken: take BDF2Solver or "
                "ImplicitEulerSolver"
            )
        if solver.explicit and solver.contact == "force" and any(term.companions for term in self.terms):
            raise ValueError('links of robots act in a stage of explicit steps: leave out contact="force"')
        if solver.explicit and len(solver.kicks.kicks) > 1:
            raise ValueError("robots take one kick in each substep: leave out viscous_stages, and take more substeps")
        if self.scene.term(RotatingFrame):
            raise ValueError("a RotatingFrame does not act on robots: leave it out")
        if self.scene.reduced:
            raise ValueError("robots do not support reduced sets and ties beside them: leave out reduced= and Tie")
        held = [vertices for term in self.terms for _, vertices in term.holds]
        if held and solver.explicit and not solver.last_frame_is_state:
            raise ValueError(
                f"attached= of a robot is not for {type(solver).__name__}, whose steps end in half a kick: take "
                "SemiImplicitSolver"
            )
        if held and (
            self.scene.holds_volumes or any(t.primitives or isinstance(t, SelfContact) for t in self.scene.terms)
        ):
            raise ValueError(
                "attached= of a robot does not go with SelfContact, obstacles that act by pairs and FilledChamber: leave "
                "these out, or pass by_pairs=False to the obstacles"
            )
        if len(np.unique(np.concatenate([*held, self.scene.held]))) < sum(map(len, held)) + len(self.scene.held):
            raise ValueError(
                "attached=: some vertices are held by two links, or are fixed as well: name sets that share no vertices"
            )
        if self.scene.origin.any():
            raise ValueError(
                'robots do not support bodies far from the origin in float32: pass precision="f64", or move all nearer to it'
            )

    def numbers(self, parameters: np.ndarray) -> np.ndarray:
        """Start positions and velocities, drives' stiffness and damping, masses, shape (5, joints of all)."""
        rows = [parameters[self.scene.inputs.parameters.of(term)].reshape(5, -1) for term in self.terms]
        return np.concatenate(rows, 1)

    def add_numbers(self, parameters_adj: np.ndarray, adjoint: np.ndarray) -> None:
        """Adjoint of `numbers`."""
        for term, own in zip(self.terms, self.slices()):
            parameters_adj[self.scene.inputs.parameters.of(term)] += adjoint[:, own].ravel()
