"""The sum of two laws."""

from dataclasses import dataclass

from diffsim_ti.materials.law import Law
from diffsim_ti.runtime import let, traced


@dataclass(frozen=True)
class SumLaw(Law):
    """A law `base`, and one that a subclass adds to it: `added`, whose coefficients come first; it may have a state."""

    base: Law | None = None

    @property
    def added(self) -> Law:
        """What is added."""
        raise NotImplementedError

    @property
    def coefficient_names(self):
        return (*self.added.coefficient_names, *self.base.coefficient_names)

    @property
    def state_names(self):
        return self.added.state_names

    @property
    def lanes(self):
        return self.base.lanes

    @traced
    def _parts(self, q):
        """(what the added law takes, what the base takes)"""
        first, last = len(self.added.coefficient_names), len(self.coefficient_names)
        return [*q[:first], *q[last:]], q[first:last]

    @traced
    def _joined(self, of_added, of_base):
        first = len(self.added.coefficient_names)
        return [*of_added[:first], *of_base, *of_added[first:]]

    @traced
    def energy_density(self, H, q):
        own, p = self._parts(q)
        return self.added.energy_density(H, own) + self.base.energy_density(H, p)

    @traced
    def energy_by_coefficients(self, H, q):
        own, p = self._parts(q)
        return self._joined(self.added.energy_by_coefficients(H, own), self.base.energy_by_coefficients(H, p))

    @traced
    def stress(self, H, q):
        own, p = self._parts(q)
        return self.added.stress(H, own) + self.base.stress(H, p)

    @traced
    def stress_differential(self, H, dH, q):
        own, p = self._parts(q)
        return self.added.stress_differential(H, dH, own) + self.base.stress_differential(H, dH, p)

    @traced
    def stress_change(self, H, q, dq):
        (own, p), (d_own, dp) = self._parts(q), self._parts(dq)
        return self.added.stress_change(H, own, d_own) + self.base.stress_change(H, p, dp)

    @traced
    def stress_differential_and_products(self, H, dH, q):
        own, p = self._parts(q)
        of_added, by_added = self.added.stress_differential_and_products(H, dH, own)
        of_base, by_base = self.base.stress_differential_and_products(H, dH, p)
        return of_added + of_base, self._joined(by_added, by_base)

    @traced
    def next_state_at(self, H, q, h):
        return self.added.next_state_at(H, self._parts(q)[0], h)

    @traced
    def next_state_jvp(self, H, dH, q, dq, h):
        return self.added.next_state_jvp(H, dH, self._parts(q)[0], self._parts(dq)[0], h)

    @traced
    def next_state_vjp(self, H, q, h, z_adj):
        by_H, by_added = self.added.next_state_vjp(H, self._parts(q)[0], h, z_adj)
        zero = let(H[0, 0] * 0)
        return by_H, self._joined(by_added, [zero] * len(self.base.coefficient_names))
