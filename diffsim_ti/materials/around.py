"""What materials made around another one share: numbers of their own, and coefficients of these that come first."""

import numpy as np

from diffsim_ti.differentiation.arrays import as_array
from diffsim_ti.materials.material import Material, _all_values, _short


class Around(Material):
    """A material with the numbers `own`, names in order, around `material`.

    Its own coefficients are these numbers, vectors spread out, and, with `takes_moduli`, the moduli (mu, lam) of small
    strains of the isotropic part; or what a subclass makes of them.
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
        """Columns, each shape () or (num_tetrahedra,), of these, by functions that record (differentiation/arrays.py)."""
        return numbers

    def _coefficients(self, values):
        own = self.own_coefficients(self._numbers_of(values))
        parts = [*(as_array(x)[..., None] for x in own), self.material.coefficients(self.inner(values))]
        if any(part.ndim == 3 for part in parts):  # numbers at points
            parts = [part[:, None] if part.ndim == 2 else part for part in parts]
        shape = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
        return np.concatenate([np.broadcast_to(part, (*shape, part.shape[-1])) for part in parts], -1)

    def __repr__(self):
        own = {name: self._numbers[name] for name in self.own}
        return f"{self.name}({self.material!r}, {', '.join(f'{name}={_short(x)}' for name, x in own.items())})"
