"""Volume constraints: the part of Newton's method and of its derivatives that finds multipliers.

A step holds V(u) = target by a multiplier p for each chamber. The bordered system

    K d - g dp = R,    g . d = r = target - V

is solved by K' = K + gamma g (x) g, which is positive definite where the body is stable under the constraint, also where K
is not: with y = K'^-1 R, z = K'^-1 g and mu = (r - g . y) / (g . z), d = y + mu z and dp = mu - gamma r. As the Newton
direction of the augmented Lagrangian at multiplier p + mu it goes downhill there, for a line search.
Nocedal, Wright, Numerical Optimization, 2nd ed., 2006, 17.3 and 18.4, doi:10.1007/978-0-387-40065-5.
"""

import numpy as np

from diffsim_ti.mechanics.chambers.pressures import ChamberPressure


class HeldPressure(ChamberPressure):
    """What chambers push with that hold their volume."""

    def volumes_at(self, u: np.ndarray) -> np.ndarray:
        """V of each [m^3]."""
        return self.volumes(self.rest + u)

    def gradients(self, u: np.ndarray) -> list[np.ndarray]:
        """dV/du of each."""
        return [enclosure.gradient(self.rest + u) for enclosure in self.enclosures]

    def missing(self, u: np.ndarray) -> np.ndarray:
        """Targets less volumes."""
        held = zip(self.enclosures, self.numbers, self.laws)
        return np.stack([law.goal(numbers) - enclosure.recorded(self.rest + u) for enclosure, numbers, law in held])


class Multipliers:
    """Of the chambers of a HeldPressure, and of relations between places that have no stiffness (constraints.py), whose g
    and value are in the place of V and its target.

    free: what vertices may do, sets that do not deform all; eps: rounding of displacements.
    """

    share = 0.1  # measured: a hundredth loses thick spheres, all of it halves the steps

    def __init__(self, forces: list, free, rest: np.ndarray, tolerance: float, eps: float):
        self.forces, self.free, self.rest, self.tolerance, self.eps = forces, free, rest, tolerance, eps
        self.laws = [law for force in forces for law in force.laws]
        self.have_energy = any(force.has_energy for force in forces)
        self.places = [k for force in forces if isinstance(force, HeldPressure) for k in force.places]

    def stiffen(self, stiffness: np.ndarray) -> None:
        """Set gamma so that gamma |g|^2 is a tenth of the stiffness of a vertex [N/m], shape (num_vertices, 1)."""
        self._stiffer = 0
        for law, g in zip(self.laws, self.gradients(np.zeros_like(self.rest))):
            g = g * self.free
            law.gamma = self.share * float((g * stiffness * g).sum() / max((g * g).sum() ** 2, 1e-300))

    def can_stiffen(self) -> bool:
        """Raise gamma tenfold, if that was not done too often since `stiffen`."""
        self._stiffer += 1
        for law in self.laws:
            law.gamma *= 10
        return self._stiffer <= 3

    def gradients(self, u: np.ndarray) -> list[np.ndarray]:
        """dV/du of each."""
        return [g for force in self.forces for g in force.gradients(u)]

    def place(self, u: np.ndarray, multipliers: np.ndarray | None = None) -> None:
        """Count from the volumes at u, at the pressures there or at `multipliers`."""
        V = [x for force in self.forces for x in force.volumes_at(u)]
        for k, (law, now) in enumerate(zip(self.laws, V)):
            law.multiplier = law.pressure(now) if multipliers is None else float(multipliers[k])
            law.volume = float(now)

    def arrive(self, u: np.ndarray, share: float, rise: np.ndarray) -> None:
        """Count from u, which a share of a direction has led to: the pressures before `bordered` and that share of dp."""
        self.place(u, self._before + share * rise)

    @property
    def multipliers(self) -> np.ndarray:
        """Pressures at the volumes that are counted from [Pa]."""
        return np.array([law.multiplier for law in self.laws])

    @property
    def missing(self) -> np.ndarray:
        """Targets less volumes where `place` was."""
        return np.array([law.target - law.volume for law in self.laws])

    def met(self, u: np.ndarray, times: float = 1.0) -> bool:
        """Whether volumes are as asked for, to so many times tolerance and rounding."""
        for law, left, g in zip(self.laws, self.missing, self.gradients(u)):
            noise = 4 * self.eps * float((np.abs(g) * np.abs(u)).sum()) + 1e-14 * abs(law.target)
            if abs(left) > times * (self.tolerance * abs(law.target) + noise):
                return False
        return True

    def predicted(self, u: np.ndarray, R: np.ndarray, stiffness: np.ndarray) -> np.ndarray:
        """R with pressures changed so that it is least, by the stiffness of each vertex [N/m], shape (num_vertices, 1).

        `bordered` counts from there: what pressures balance anyway is not left to a rough solve, whose error would be larger
        than the direction.
        """
        G = [g * self.free for g in self.gradients(u)]
        soft = np.divide(1.0, stiffness, out=np.zeros_like(stiffness), where=stiffness > 0)
        S = np.array([[float((g * soft * h).sum()) for h in G] for g in G])
        self._ahead = np.linalg.lstsq(S, -np.array([float((g * soft * R).sum()) for g in G]), rcond=None)[0]
        return R + sum(m * g for m, g in zip(self._ahead, G))

    def _border(self, u: np.ndarray, solve) -> tuple[list, list, np.ndarray]:
        """(g of each, z = K'^-1 g, g . z of all pairs)"""
        G = [g * self.free for g in self.gradients(u)]
        Z = [solve(g) for g in G]
        return G, Z, np.array([[float((g * z).sum()) for z in Z] for g in G])

    def bordered(self, u: np.ndarray, y: np.ndarray, solve) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(d, what comes to R, dp) from y = K'^-1 R, R as `predicted`; solve(g): K'^-1 g. The multipliers go to p + mu, for
        the line search."""
        G, Z, S = self._border(u, solve)
        r, self._before = self.missing, self.multipliers
        mu = np.linalg.lstsq(S, r - np.array([float((g * y).sum()) for g in G]), rcond=None)[0]
        d, mu = y + sum(m * z for m, z in zip(mu, Z)), mu + self._ahead
        for law, more in zip(self.laws, mu):
            law.multiplier += more
        change = sum(m * g for m, g in zip(mu, G))
        return d, change, mu - np.array([law.gamma for law in self.laws]) * r

    # ---- derivatives -------------------------------------------------------------------------------------------------

    def tangent(self, u: np.ndarray, y: np.ndarray, targets: np.ndarray, solve) -> tuple[np.ndarray, np.ndarray]:
        """(du, dp) from y = K'^-1 dR, the target in dR having the slope gamma; targets: their change less what V changes by
        all that does not follow from dR."""
        G, Z, S = self._border(u, solve)
        dp = np.linalg.solve(S, targets - np.array([float((g * y).sum()) for g in G]))
        return y + sum(m * z for m, z in zip(dp, Z)), dp

    def targets_jvp(self, u: np.ndarray, du: np.ndarray, moved) -> np.ndarray:
        """Change of targets for that of the numbers, less that of volumes by du and by the rest shape."""
        return np.concatenate([force.jvp(u, du, None, moved, "missing") for force in self.forces if force.laws])

    def add_targets(self, nu: np.ndarray, u: np.ndarray, adj) -> np.ndarray:
        """Add to the adjoints of numbers and of the rest shape what comes by targets; returns that of u by volumes."""
        ends = np.cumsum([0, *(len(force.laws) for force in self.forces)])
        each = (part for part in zip(self.forces, ends, ends[1:]) if part[0].laws)
        return sum(force.vjp(u, nu[a:b], adj, "missing")[0] for force, a, b in each)

    def adjoint(self, u: np.ndarray, y: np.ndarray, by_pressure: np.ndarray, solve) -> tuple[np.ndarray, np.ndarray]:
        """(w, nu) from y = K'^-T p: the adjoint of R, and what comes to that of targets, and less to that of volumes."""
        G, Z, S = self._border(u, solve)
        by_pressure = np.pad(by_pressure, (0, len(G) - len(by_pressure)))  # relations show none
        nu = np.linalg.solve(S, by_pressure + np.array([float((g * y).sum()) for g in G]))
        return y - sum(m * z for m, z in zip(nu, Z)), nu
