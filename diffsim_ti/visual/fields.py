"""What a picture's colours mean: the fields of a saved frame, their units, colour maps and limits.

The maps are even in lightness and safe for the colour-blind: viridis for what starts at zero, PuOr about the middle value
for what goes both ways.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Field:
    """A quantity to colour by: `middle` is the neutral value of a two-sided field, None for one that starts at zero."""

    label: str
    colours: str = "viridis"
    middle: float | None = None

    def limits(self, low: float, high: float) -> tuple[float, float]:
        """What the colours span for values from `low` to `high`: never empty, symmetric about `middle` if there is one."""
        if self.middle is None:
            low = min(0.0, low)
            return (low, high) if high > low else (low, low + 1.0)
        reach = max(abs(low - self.middle), abs(high - self.middle)) or 1.0
        return self.middle - reach, self.middle + reach


FIELDS = {
    "displacement": Field("displacement [m]"),
    "speed": Field("speed [m/s]"),
    "von_mises": Field("von Mises stress [Pa]"),
    "energy_density": Field("energy density [J/m^3]"),
    "plastic_strain": Field("equivalent plastic strain [-]"),
    "J": Field("volume ratio J [-]", "PuOr", 1.0),
    "stiffness": Field("Young's modulus [Pa]"),
    "gradient": Field("size of the gradient"),
}


def field_named(name: str) -> Field:
    """The field of that name. Raises ValueError for an unknown one."""
    if name not in FIELDS:
        raise ValueError(f"colour: must be one of {', '.join(FIELDS)}, got {name!r}; choose one of these")
    return FIELDS[name]
