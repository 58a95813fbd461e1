"""What materials made around another one share: numbers of their own, and coefficients of these that come first."""

import numpy as np

from diffsim_ti.materials.material import TINY, Material, _all_values, _short


class Around(Material):
    """A material with the numbers `own`, names in order, around `material`.

    Its own coefficients are these numbers, vectors spread out, and, with `takes_moduli`, the moduli (mu, lam) of small
    strains of the isotropic part; or what a subclass makes of them, with derivatives.
    """

    takes_moduli = True

    def _surround(self, material: Material, numbers: dict) -> None:
        """Take the numbers. Raises ValueError where something is no material, or a name is taken."""
        if not isinstance(material, Material):
            raise ValueError(f"{self.name}: material must be a material such as StableNeoHookean, got {material!r}")
        law = material.law("f64")
        if law.state_names and self.remembers or law.reads != ("H",):
            raise ValueError(
                f"{self.name}: {material.name} has a state or a viscosity of its own; take one without, and put the "
                "viscosity around all else"
            )
        self.material, self.own, self.J_floor, self._extra = material, tuple(numbers), None, ""
        self.density, self.valid_to = material.density, material.valid_to
        self._numbers = numbers | material._numbers
        given = {name: np.ravel(x) if self._is_at_points(name, x) else x for name, x in self._numbers.items()}
        self.check({name: _all_values(name, number, self.shape_of(name)) for name, number in given.items()})

    remembers = True  # whether its law has a state

    def shape_of(self, name):
        return self.shapes.get(name, ()) if name in self.own else self.material.shape_of(name)

    def unit_of(self, name):
        return self.units[name] if name in self.own else self.material.unit_of(name)

    def inner(self, values: dict) -> dict:
        """Of some values, those of the material within."""
        return {name: values[name] for name in self.material.inputs if name in values}

    def check(self, values):
        super().check({name: values[name] for name in self.own})
        self.material.check(self.inner(values))

    @property
    def isotropic(self):
        return self.material.isotropic

    def _moduli_values(self, values: dict) -> dict:
        return {name: values[name] for name in self.isotropic.inputs if name in values}

    def _numbers_of(self, values: dict) -> list:
        """Own values, vectors spread out, and (mu, lam)."""
        moduli = self.isotropic.lame(self._moduli_values(values)) if self.takes_moduli else ()
        return [*self._columns(values, self.own), *moduli]

    def own_coefficients(self, numbers: list) -> list:
        """Columns, each shape () or (num_tetrahedra,), of these, which may be complex."""
        return numbers

    def own_vjp(self, numbers: list, by_columns: list) -> list:
        """Adjoints of the numbers, those of each tetrahedron."""
        return by_columns

    @staticmethod
    def _joined(columns: list, of_material: np.ndarray) -> np.ndarray:
        parts = [*(np.asarray(x, np.float64)[..., None] for x in columns), of_material]
        if any(part.ndim == 3 for part in parts):  # numbers at points
            parts = [part[:, None] if part.ndim == 2 else part for part in parts]
        shape = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
        return np.concatenate([np.broadcast_to(part, (*shape, part.shape[-1])) for part in parts], -1)

    def coefficients(self, values):
        self.check(values)
        own = self.own_coefficients(self._numbers_of(values))
        return self._joined(own, self.material.coefficients(self.inner(values)))

    def coefficients_jvp(self, values, tangents):
        own = {name: np.broadcast_to(tangents.get(name, 0.0), np.shape(values[name])) for name in self.own}
        by_moduli = ()
        if self.takes_moduli:
            by_moduli = self.isotropic.lame_jvp(self._moduli_values(values), self._moduli_values(tangents))
        changes = [*self._columns(own, self.own), *by_moduli]
        moved = self.own_coefficients([x + 1j * TINY * dx for x, dx in zip(self._numbers_of(values), changes)])
        return self._joined(
            [x.imag / TINY for x in moved], self.material.coefficients_jvp(self.inner(values), self.inner(tangents))
        )

    def coefficients_vjp(self, values, coefficients_adj):
        adj, count = np.asarray(coefficients_adj, np.float64), len(self.law("f64").coefficient_names)
        first = count - len(self.material.law("f64").coefficient_names)
        own = self.own_vjp(self._numbers_of(values), [adj[..., k] for k in range(first)])
        out = self._columns_vjp(values, self.own, own)
        within = adj[..., first:]
        out |= self.material.coefficients_vjp(self.inner(values), within.sum(1) if adj.ndim == 3 else within)
        if self.takes_moduli:
            for name, part in self.isotropic.lame_vjp(self._moduli_values(values), *own[-2:]).items():
                out[name] = out[name] + part
        return out

    def __repr__(self):
        own = {name: self._numbers[name] for name in self.own}
        return f"{self.name}({self.material!r}, {', '.join(f'{name}={_short(x)}' for name, x in own.items())})"
