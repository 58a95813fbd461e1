"""Materials by their tensile tests, and libraries of them."""

import json
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path

import numpy as np

from diffsim_ti.common.checked import number
from diffsim_ti.common.names import nearest
from diffsim_ti.common.public import Public
from diffsim_ti.materials.around import Around
from diffsim_ti.materials.gent import Gent
from diffsim_ti.materials.mooney_rivlin import MooneyRivlin
from diffsim_ti.materials.ogden import Ogden
from diffsim_ti.materials.stable_neo_hookean import StableNeoHookean
from diffsim_ti.materials.yeoh import Yeoh

BULK = 1e9  # [Pa], of silicone rubber, from its density and its speed of sound of 1000 m/s
DENSITY = 1070.0  # [kg/m^3], of silicone rubber, within a twentieth
NOT_SEEN = (
    "of one specimen at one speed, along one path of loading: nothing is known of the batch, of other rates, of cycles (the "
    "first softens those after it), of compression, of the change of volume, of temperature and age"
)


class Measured(Around):
    """A law of rubber with the numbers of a tensile test, which a Scene takes as any material.

    `library["Ecoflex 00-30"]` gives one, of an entry that `diffsim-ti fit` wrote. `material` is the law, whose numbers are
    inputs with gradients.

    valid_to: the largest stretch at which the law is known, and stable, in tension and compression along one or two axes
    and in plane strain; a run that goes beyond warns. measured_to: the largest stretch of the test.
    intervals: {number: (low, high)} of 95 % from blocks of the curve, those of this specimen and not of the batch; None
    where the test does not see the number. shear_modulus [Pa]: of small strains.
    errors: {"fitted", "held_out": {"low", "all": root mean square up to stretch 3 and of all; "low_largest",
    "all_largest"}}, as shares of the largest stress there; held-out ones are of blocks of the curve that were not fitted.
    density [kg/m^3]: what a Scene takes that is given none; `density_known` says whether it was measured.
    source: who measured what, and under which licence. said: what was left out of the data, in words.

    The bulk modulus is none of the test's: 1 GPa, as silicone has it. `up_to` gives the law with a smaller one.
    Tests of the library: Marechal et al., doi:10.1089/soro.2019.0115.
    """

    takes_moduli = remembers = False

    def __init__(self, title: str, entry: Mapping, bulk_modulus: float = BULK):
        kind = {x.__name__: x for x in (StableNeoHookean, MooneyRivlin, Yeoh, Gent, Ogden)}[entry["law"]]
        self.title, self.entry, numbers = title, entry, dict(entry["numbers"])
        if kind is StableNeoHookean:
            numbers["lam"] = bulk_modulus - 2 / 3 * numbers["mu"]
        else:
            numbers |= {"c30": 0.0, **numbers} if kind is Yeoh else {}
            numbers["bulk_modulus"] = bulk_modulus
        self._surround(kind(**numbers), {})
        self.density, self.density_known = entry.get("density") or DENSITY, bool(entry.get("density"))
        self.valid_to, self.measured_to = entry["valid_to"], entry["measured_to"]
        self.intervals = {name: x and tuple(map(np.asarray, x)) for name, x in entry["intervals"].items()}
        self.shear_modulus, self.errors = entry["shear_modulus"], entry["errors"]
        self.source, self.said = entry.get("source", ""), entry.get("said", [])

    def law(self, precision):
        return self.material.law(precision)

    def lame(self, values):
        return self.material.lame(values)

    def nominal_stress(self, stretch, kind: str = "uniaxial") -> np.ndarray:
        """Force over the area at rest [Pa] at stretches, of the incompressible law, where the sides are free: in "uniaxial",
        "equibiaxial" or "planar" tension."""
        from diffsim_ti.materials.rubber_fit import nominal_stress

        p = np.concatenate([np.ravel(x) for x in self.entry["numbers"].values()])
        return nominal_stress(self.entry["law"], p, np.asarray(stretch, np.float64), kind)

    def up_to(self, stretch: float, volume_change: float = 0.01) -> "Measured":
        """The same law, valid to this stretch, with the bulk modulus that lets the volume change by so much there, at
        most: explicit steps may then be longer. Poisson's ratio of small strains stays 0.49 or more."""
        top = number("stretch", stretch, 1.0)
        if top > self.valid_to:
            raise ValueError(f"{self.title} is valid to stretch {self.valid_to:.3g}, got {top:g}")
        x = np.linspace(1, top, 50)
        pressures = [
            n / 3 * (x * self.nominal_stress(x, kind)).max() for n, kind in ((1, "uniaxial"), (2, "equibiaxial"))
        ]
        bulk = min(max(max(pressures) / number("volume_change", volume_change), 50 * self.shear_modulus), BULK)
        return Measured(self.title, {**self.entry, "valid_to": top}, bulk)

    def describe(self) -> str:
        """Law, numbers with intervals, errors, range and source, and what is not known, in a few lines."""
        lines = [f"{self.title}: {type(self.material).__name__}, valid to stretch {self.valid_to:.3g}"]
        lines[0] += f" of {self.measured_to:.3g} measured" if self.valid_to < self.measured_to else ""
        for name, ends in self.intervals.items():
            unit = "" if name in ("exponents", "limit") else " Pa"
            value = _short(self.shear_modulus if name == "shear_modulus" else self.entry["numbers"][name])
            seen = f"{_short(ends[0])} to {_short(ends[1])}" if ends else "not seen by the test"
            lines.append(f"  {name} = {value}{unit} ({seen})")
        for name, e in self.errors.items():
            low = f"{e['low']:.1%} up to stretch 3, " if "low" in e else ""
            lines.append(
                f"  error {name.replace('_', '-')}: {low}{e['all']:.1%} of all, at most {e['all_largest']:.1%}"
            )
        lines += [] if self.entry["kept"] else ["  NO LAW KEEPS 3 % up to stretch 3 and 6 % of all: see the errors"]
        lines.append(
            f"  density {self.density:g} kg/m^3{'' if self.density_known else ', typical of silicone, not measured'}"
        )
        lines += [f"  {text}" for text in self.said]
        return "\n".join([*lines, f"  intervals are of 95 %, {NOT_SEEN}", f"  source: {self.source or 'not said'}"])

    def __repr__(self):
        return f"Measured({self.title!r}, {self.material!r})"


def _short(x) -> str:
    return f"{x:.4g}" if np.ndim(x) == 0 else f"({', '.join(f'{y:.4g}' for y in x)})"


class Library(Mapping, metaclass=Public):
    """Materials by name, from a file that `diffsim-ti fit` wrote, which is read when a first one is asked for.

    Capitals, blanks and hyphens of names do not count. `list(library)` has all names, `describe()` a table.
    Raises KeyError, with the nearest name, for one that is not there.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)

    @cached_property
    def _entries(self) -> dict[str, dict]:
        return json.loads(self.path.read_text(encoding="utf-8"))["materials"]

    def __getitem__(self, name: str) -> Measured:
        for known, entry in self._entries.items():
            if _plain(name) == _plain(known):
                return Measured(known, entry)
        near = nearest(str(name), self._entries)
        meant = f"did you mean {near!r}? " if near else ""
        raise KeyError(f"no material is called {name!r}; {meant}There are {', '.join(self._entries)}")

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def describe(self) -> str:
        """A table of all: law, shear modulus, range and held-out errors."""
        lines = [
            "| material | law | shear modulus [kPa], 95 % | valid to stretch | held-out error to 3 | of all |",
            "| --- | --- | --- | --- | ---: | ---: |",
        ]
        for name, x in self._entries.items():
            ends, e = x["intervals"]["shear_modulus"], x["errors"]["held_out"]
            seen = f"{ends[0] / 1e3:.3g} to {ends[1] / 1e3:.3g}" if ends else "not seen"
            terms = f" {len(x['numbers']['moduli'])}" if x["law"] == "Ogden" else ""
            of = f" of {x['measured_to']:.3g}" if x["valid_to"] < x["measured_to"] else ""
            lines.append(
                f"| {name} | {x['law']}{terms} | {x['shear_modulus'] / 1e3:.3g} ({seen}) | {x['valid_to']:.3g}{of} | "
                f"{e.get('low', e['all']):.1%} | {e['all']:.1%} |"
            )
        return "\n".join(lines)

    def __repr__(self) -> str:
        return f"Library({self.path.name}: {', '.join(self)})"


def _plain(name: object) -> str:
    return "".join(x for x in str(name).lower() if x.isalnum())


library = Library(Path(__file__).with_name("rubbers.json"))
