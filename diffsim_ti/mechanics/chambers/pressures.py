"""Pressures of chambers, which depend on the volume inside."""

import numpy as np

from diffsim_ti.mechanics.chambers.laws import law_of
from diffsim_ti.mechanics.pressure.follower_pressure import FollowerPressure, Tangent, pressures_at
from diffsim_ti.terms import Chamber, Pressure


def rows_of(scene, chambers) -> list[slice]:
    """Rows of the numbers of some of a scene's chambers in `Derived.follower`, in which those of pressures come first."""
    every = scene.terms_of(Pressure, Chamber)
    ends = np.cumsum([0, *(len(term.rows_in_time("")) for term in every)]).tolist()
    return [slice(*ends[k : k + 2]) for k in map(every.index, chambers)]


class ChamberPressure(FollowerPressure):
    """Of some of a scene's chambers.

    The force of a chamber is p(V) g, g = dV/dx of what is free; its tangent is that of the pressure p and p'(V) g (x) dV/dx.
    """

    def __init__(self, scene, chambers):
        faces = [chamber.enclosure.faces for chamber in chambers]
        load_of = np.repeat(np.arange(len(faces)), [len(rows) for rows in faces])
        super().__init__(np.concatenate(faces), load_of, scene.mesh.num_vertices)
        self.enclosures = [chamber.enclosure for chamber in chambers]
        self.laws = [law_of(chamber) for chamber in chambers]
        self.places = [scene.terms_of(Chamber).index(chamber) for chamber in chambers]
        self.rows = rows_of(scene, chambers)

    def restrict(self, free, rest):
        """Chambers are closed."""

    def at(self, numbers: np.ndarray, share: float = 1.0) -> "ChamberPressure":
        """With a share of what the numbers of all pressures and chambers say."""
        for law, rows in zip(self.laws, self.rows):
            law.at(np.asarray(numbers[rows], np.float64), share)
        return self

    def take(self, values, instant):
        self.values, self.instant, self.rest = values, instant, values.rest
        return self.at(pressures_at(values.follower, instant), instant.load)

    def volumes(self, x: np.ndarray) -> np.ndarray:
        """V of each chamber [m^3]."""
        return np.array([enclosure.volume(x) for enclosure in self.enclosures])

    def _place(self, u: np.ndarray) -> None:
        self.pressure = np.array([law.pressure(V) for law, V in zip(self.laws, self.volumes(self.rest + u))])

    def forces(self, u):
        self._place(u)
        return super().forces(u)

    def sizes(self, u):
        self._place(u)
        return super().sizes(u)

    def jvp(self, u, du, dv=None, moved=None):
        self._place(u)
        return super().jvp(u, du, dv, moved)

    def vjp(self, u, w, adj=None):
        self._place(u)
        return super().vjp(u, w, adj)

    def unit_forces(self, u: np.ndarray, k: int) -> np.ndarray:
        """Forces of 1 Pa in chamber k [N / Pa]."""
        self.pressure = np.zeros(len(self.laws))
        self.pressure[k] = 1
        return super().forces(u)

    def _pressures_jvp(self, x, dx, moved):
        dp, instant = np.zeros(len(self.laws)), self.instant
        if moved is not None:
            changes = instant.schedule.pressure(moved.follower, instant.j, instant.share)
        for k, (law, enclosure, rows) in enumerate(zip(self.laws, self.enclosures, self.rows)):
            V = enclosure.volume(x)
            dp[k] = law.slope(V) * float((enclosure.gradient(x) * dx).sum())
            if moved is not None:
                dp[k] += law.by_numbers(V) @ changes[rows]
        return dp

    def tangent(self, u, transposed=False):
        x = self.rest + u
        slopes = [law.slope(V) for law, V in zip(self.laws, self.volumes(x))]
        pairs = [
            (slope * self.unit_forces(u, k), enclosure.gradient(x))
            for k, (slope, enclosure) in enumerate(zip(slopes, self.enclosures))
            if slope
        ]
        self._place(u)
        out = Tangent(self._tangent(x).K, pairs)
        return out.T if transposed else out

    def _pressures_vjp(self, x, p_adj, adj):
        by_x = 0.0
        for law, enclosure, rows, felt in zip(self.laws, self.enclosures, self.rows, p_adj):
            V = enclosure.volume(x)
            by_x = by_x + law.slope(V) * felt * enclosure.gradient(x)
            if adj is not None:
                self.add_numbers(adj, rows, law.by_numbers(V) * felt)
        return by_x

    def work(self, u, step):
        """Minus infinity where a chamber would vanish."""
        x = self.rest + u
        parts = zip(self.laws, self.enclosures)
        return sum(law.work(enclosure.volume(x), enclosure.change(x, step)) for law, enclosure in parts)
