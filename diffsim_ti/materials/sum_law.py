"""The sum of two laws."""

from dataclasses import dataclass

from diffsim_ti.materials.calculus.tensor import sum_of
from diffsim_ti.materials.law import Law, as_of
from diffsim_ti.runtime import let, traced


@dataclass(frozen=True)
class SumLaw(Law):
    """A law `base`, and `added`, after which the sum is called and whose coefficients come first; it may have a state.

    What resists a change of volume is that of the base.
    """

    base: Law | None = None
    added: Law | None = None

    @property
    def title(self):
        return f"{self.added.title}({self.base.title})"

    @property
    def coefficient_names(self):
        return (*self.added.coefficient_names, *self.base.coefficient_names)

    state_names, lanes = as_of("added", "state_names"), as_of("base", "lanes")
    has_dilatation = as_of("base", "has_dilatation")
    dilatation, dilatation_gradient = as_of("base", "dilatation"), as_of("base", "dilatation_gradient")
    dilatation_gradient_differential = as_of("base", "dilatation_gradient_differential")

    @property
    def last_without_lam(self):
        factors = self.base.last_without_lam
        return (0,) * len(self.added.coefficient_names) + tuple(factors) if factors else ()

    @traced
    def _parts(self, q):
        """(what the added law takes, what the base takes)"""
        first, last = len(self.added.coefficient_names), len(self.coefficient_names)
        return [*q[:first], *q[last:]], q[first:last]

    @traced
    def _terms(self, q) -> list:
        """(law, what it takes) of those that act: both, or the base alone."""
        own, p = self._parts(q)
        return [(self.added, own), (self.base, p)]

    @traced
    def _joined(self, H, *of_terms):
        """Derivatives by q, from those of the terms."""
        first, (*of_added, of_base) = len(self.added.coefficient_names), of_terms
        (of_added,) = of_added or [[let(H[0, 0] * 0)] * first]
        return [*of_added[:first], *of_base, *of_added[first:]]

    @traced
    def energy_density(self, H, q):
        return sum_of(law.energy_density(H, p) for law, p in self._terms(q))

    @traced
    def energy_by_coefficients(self, H, q):
        return self._joined(H, *(law.energy_by_coefficients(H, p) for law, p in self._terms(q)))

    @traced
    def stress(self, H, q):
        return sum_of(law.stress(H, p) for law, p in self._terms(q))

    @traced
    def stress_differential(self, H, dH, q):
        return sum_of(law.stress_differential(H, dH, p) for law, p in self._terms(q))

    @traced
    def stress_change(self, H, q, dq):
        both = zip(self._terms(q), self._terms(dq))
        return sum_of(law.stress_change(H, p, dp) for (law, p), (_, dp) in both)

    @traced
    def stress_differential_and_products(self, H, dH, q):
        of_terms = [law.stress_differential_and_products(H, dH, p) for law, p in self._terms(q)]
        return sum_of(dP for dP, _ in of_terms), self._joined(H, *(products for _, products in of_terms))

    @property
    def _remembers(self) -> int:
        """Which of both has the state: 0 what is added, 1 the base."""
        return int(not self.added.state_names)

    @traced
    def next_state_at(self, H, q, h):
        k = self._remembers
        return (self.added, self.base)[k].next_state_at(H, self._parts(q)[k], h)

    @traced
    def next_state_jvp(self, H, dH, q, dq, h):
        k = self._remembers
        return (self.added, self.base)[k].next_state_jvp(H, dH, self._parts(q)[k], self._parts(dq)[k], h)

    @traced
    def next_state_vjp(self, H, q, h, z_adj):
        k = self._remembers
        by_H, by_own = (self.added, self.base)[k].next_state_vjp(H, self._parts(q)[k], h, z_adj)
        return by_H, self._joined(
            H, *((by_own,) if k else (by_own, [let(H[0, 0] * 0)] * len(self.base.coefficient_names)))
        )
