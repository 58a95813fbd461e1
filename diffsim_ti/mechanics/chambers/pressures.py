"""Pressures that follow the surface together with those of chambers, which depend on the volume inside."""

import numpy as np

from diffsim_ti.mechanics.chambers.laws import law_of
from diffsim_ti.mechanics.pressure.follower_pressure import FollowerPressure, Tangent
from diffsim_ti.mechanics.pressure.interaction import Pressures
from diffsim_ti.terms import Chamber


class ChamberPressure(FollowerPressure):
    """Of a scene's pressures, and after them of its chambers; its numbers are those of a row of `Derived.follower`.

    The force of a chamber is p(V) g, g = dV/dx of what is free; its tangent is that of the pressure p and p'(V) g (x) dV/dx.
    """

    def __init__(self, scene, symmetric: bool = True):
        pressures, chambers = scene.interaction(Pressures), scene.terms_of(Chamber)
        faces = pressures.faces if pressures else scene.mesh.surface_faces[:0]
        load_of = pressures.load_of if pressures else np.zeros(0, np.int64)
        own = [chamber.enclosure.faces for chamber in chambers]
        self.num_pressures = len(pressures.terms) if pressures else 0
        loads = self.num_pressures + np.repeat(np.arange(len(own)), [len(rows) for rows in own])
        super().__init__(
            np.concatenate([faces, *own]), np.concatenate([load_of, loads]), scene.mesh.num_vertices, symmetric
        )
        self.enclosures = [chamber.enclosure for chamber in chambers]
        self.laws = [law_of(chamber) for chamber in chambers]
        ends = self.num_pressures + np.cumsum([0, *(law.count for law in self.laws)])
        self.rows = [slice(a, b) for a, b in zip(ends, ends[1:])]  # of the numbers, by chamber
        self.held = [k for k, law in enumerate(self.laws) if law.holds]

    def at(self, numbers: np.ndarray, share: float = 1.0) -> "ChamberPressure":
        """With a share of what the numbers say."""
        numbers = np.asarray(numbers, np.float64)
        self.share, self.given, self.count = share, share * numbers[: self.num_pressures], len(numbers)
        for law, rows in zip(self.laws, self.rows):
            law.at(numbers[rows], share)
        return self

    def volumes(self, x: np.ndarray) -> np.ndarray:
        """V of each chamber [m^3]."""
        return np.array([enclosure.volume(x) for enclosure in self.enclosures])

    def of_chambers(self, x: np.ndarray) -> np.ndarray:
        """p of each chamber [Pa]."""
        return np.array([law.pressure(V) for law, V in zip(self.laws, self.volumes(x))])

    def _place(self, x: np.ndarray) -> None:
        self.pressure = np.concatenate([self.given, self.of_chambers(x)])

    def forces(self, x: np.ndarray) -> np.ndarray:
        self._place(x)
        return super().forces(x)

    def sizes(self, x: np.ndarray) -> np.ndarray:
        self._place(x)
        return super().sizes(x)

    def unit_forces(self, x: np.ndarray, k: int) -> np.ndarray:
        """Forces of 1 Pa in chamber k [N / Pa]."""
        self.pressure = np.zeros(self.num_pressures + len(self.laws))
        self.pressure[self.num_pressures + k] = 1
        return super().forces(x)

    def jvp(self, x: np.ndarray, dx: np.ndarray, numbers_dot: np.ndarray | None = None) -> np.ndarray:
        """Change of the forces for changes of x and of the numbers."""
        self._place(x)
        dp = np.zeros(len(self.pressure))
        if numbers_dot is not None:
            dp[: self.num_pressures] = self.share * numbers_dot[: self.num_pressures]
        for k, (law, enclosure, rows) in enumerate(zip(self.laws, self.enclosures, self.rows)):
            V, at = enclosure.volume(x), self.num_pressures + k
            dp[at] = law.slope(V) * float((enclosure.gradient(x) * dx).sum())
            if numbers_dot is not None:
                dp[at] += law.by_numbers(V) @ numbers_dot[rows]
        share, self.share = self.share, 1.0  # which is in dp
        try:
            return super().jvp(x, dx, dp)
        finally:
            self.share = share

    def tangent(self, x: np.ndarray) -> Tangent:
        slopes = [law.slope(V) for law, V in zip(self.laws, self.volumes(x))]
        pairs = [
            (slope * self.unit_forces(x, k), enclosure.gradient(x))
            for k, (slope, enclosure) in enumerate(zip(slopes, self.enclosures))
            if slope
        ]
        self._place(x)
        return Tangent(super().tangent(x).K, pairs)

    def _felt(self, x: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Adjoints of the pressures of all triangles' loads and chambers, for that of the forces."""
        self._place(x)
        share, self.share = self.share, 1.0
        try:
            return super().pressures_vjp(x, w)
        finally:
            self.share = share

    def vjp(self, x: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Adjoint of x for the adjoint w of the forces."""
        felt = self._felt(x, w)[self.num_pressures :]
        out = super().vjp(x, w)
        for law, enclosure, by_pressure in zip(self.laws, self.enclosures, felt):
            out = out + law.slope(enclosure.volume(x)) * by_pressure * enclosure.gradient(x)
        return out

    def pressures_vjp(self, x: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Adjoint of the numbers for the adjoint w of the forces."""
        felt, out = self._felt(x, w), np.zeros(self.count)
        out[: self.num_pressures] = self.share * felt[: self.num_pressures]
        for k, (law, enclosure, rows) in enumerate(zip(self.laws, self.enclosures, self.rows)):
            out[rows] = law.by_numbers(enclosure.volume(x)) * felt[self.num_pressures + k]
        return out

    def work(self, x: np.ndarray, step: np.ndarray) -> float:
        """Work done along a straight step [J]; minus infinity where a chamber would vanish."""
        self.pressure = np.concatenate([self.given, np.zeros(len(self.laws))])
        parts = [FollowerPressure.forces(self, x + t * step) for t in (0.0, 0.5, 1.0)] if len(self.given) else []
        done = float(((parts[0] + 4 * parts[1] + parts[2]) * step).sum()) / 6 if parts else 0.0
        for law, enclosure in zip(self.laws, self.enclosures):
            done += law.work(enclosure.volume(x), enclosure.change(x, step))
        return done


def following(scene, symmetric: bool = True) -> FollowerPressure | None:
    """What presses on a scene's surface as it is now, or None."""
    if scene.terms_of(Chamber):
        return ChamberPressure(scene, symmetric)
    pressures = scene.interaction(Pressures)
    return pressures and FollowerPressure(pressures.faces, pressures.load_of, scene.mesh.num_vertices, symmetric)
