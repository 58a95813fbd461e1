"""Every number of a scene that kernels read, described once: its kind of array, how it comes to the device and back.

The same description serves three records: the values (state/arrays.py), their changes (`Tangent`), their adjoints
(`Adjoint`). Interactions describe what they have of their own (mechanics/interaction.py). Numbers of tetrahedra lie in
blocks of eight. Adjoints of numbers that many vertices share are summed per vertex first, in rows (`Features.sums`).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.inputs import Derived
from diffsim_ti.runtime import LANES


@dataclass(frozen=True)
class Part:
    """kind: as in `runtime.array_types`; pack(arrays, derived): what is uploaded, None for what the scene has not;
    unpack(arrays, on host): its adjoint as `Derived` holds it, None for what comes from the sums of vertices."""

    kind: str
    pack: Callable
    unpack: Callable | None = None


def _given(name: str) -> Callable:
    return lambda arrays, derived: getattr(derived, name)


def _whole(arrays, x):
    return x.astype(np.float64)


PARTS = {
    "gradients": Part(
        "blocks",
        lambda a, d: a.to_blocks(d.gradients),
        lambda a, x: a.from_blocks(x, 9 * a.points).reshape(a.values.gradients.shape),
    ),
    "volumes": Part(
        "blocks",
        lambda a, d: a.volume_blocks(d.volumes),
        lambda a, x: a.with_stress(a.from_blocks(x, a.points).reshape(a.values.volumes.shape)),
    ),
    "coefficients": Part(
        "blocks", lambda a, d: a.coefficient_blocks(d.coefficients), lambda a, x: a.coefficients_from_blocks(x)
    ),
    "growths": Part("blocks2", lambda a, d: a.growth_blocks(d.growths), lambda a, x: a.from_growth_blocks(x)),
    "mass": Part("scalars", _given("mass")),
    "parameters": Part("scalars", _given("parameters")),
    "rest": Part("vectors", _given("rest")),
    "surface": Part("scalars", _given("surface")),
    "forces": Part("vectors2", _given("forces"), _whole),
    "motion": Part("vectors2", _given("motion"), _whole),
    "anchor": Part("vectors", lambda a, d: None if d.motion is None else d.displacement[a.held], _whole),
    "path": Part("vectors2", _given("path"), _whole),
}
TOPOLOGY = dict.fromkeys(("tets", "start", "corner_of", "force_slot", "motion_slot"), "ints")
TANGENT = {name: part.kind for name, part in PARTS.items()}
SCENE = TOPOLOGY | TANGENT | dict(inverse_mass="scalars", corner="vectors")  # all that a kernel may read of a scene
del SCENE["mass"]
OF_TETRAHEDRA = {name: PARTS[name].kind for name in ("gradients", "volumes", "coefficients", "growths")}
OF_STEPS = {name: PARTS[name].kind for name in ("forces", "motion", "anchor", "path")}
ADJOINT = OF_TETRAHEDRA | dict(sums="scalars2")
OF_SHAPE = "gradients", "volumes"  # of the adjoint, those by the rest shape


def _absent(has) -> set[str]:
    """Arrays that kernels of a scene with such `Features` do not read: each costs half a microsecond in every launch."""
    obstacles = has.groups or has.reduced
    read = {
        ("force_slot", "forces"): has.forces,
        ("motion_slot", "motion", "anchor"): has.motion or has.partly_fixed,
        ("growths",): has.growing,
        ("surface", "seen", "path"): obstacles,
        ("path_adjoint",): has.moving,
        ("offsets",): has.led,
        ("rest",): obstacles or has.shape or any(x.reads_rest for x in has.interactions),
        ("parameters",): obstacles or has.num_parameters,
        ("stage",): has.num_staged,
        ("work",): has.driven,
        ("own_work",): has.balanced,
    }
    return {name for names, some in read.items() if not some for name in names}


def needed(arrays: dict, has) -> dict:
    """Those of some arrays that kernels of a scene with such `Features` read."""
    absent = _absent(has)
    return {name: kind for name, kind in arrays.items() if name not in absent}


def adjoints(arrays: dict, has) -> dict:
    """The same of adjoints."""
    return {name: kind for name, kind in needed(arrays, has).items() if has.shape or name not in OF_SHAPE}


def with_state(arrays: dict, law) -> dict:
    """The arrays of a state with what a law remembers, z, if it does: the numbers of each tetrahedron, by slots."""
    return arrays | dict(z="blocks2") if law.state_names else arrays


def with_pass(arrays: dict, law) -> dict:
    """The arrays of a state in a pass, with what a law holds there and its rate."""
    arrays = with_state(arrays, law) | (dict(rate="scalars") if law.viscous else {})
    return arrays | dict(held="blocks2") if law.frozen_names else arrays


def with_frozen(arrays: dict, law) -> dict:
    """Changes or adjoints of these."""
    arrays = with_state(arrays, law)
    return arrays | dict(held="blocks2") if law.frozen_names else arrays


def on_device(arrays, name: str, derived: Derived):
    """(data, element type) of a part; a single zero where the scene has no such thing."""
    part = PARTS[name] if name in PARTS else Part(arrays.own[name], _given(name))
    kind = part.kind
    element = {"blocks": arrays.lanes, "blocks2": arrays.lanes, "scalars": arrays.fp}.get(kind, arrays.vector)
    data = part.pack(arrays, derived)
    if data is None:
        data = np.zeros({"vectors2": (1, 1, 3), "blocks2": (1, 1, LANES), "scalars": (1,)}.get(kind, (1, 3)))
    return data, element


class Tangent:
    """Changes of all numbers, on the device."""

    def __init__(self, arrays, tangent: Derived):
        for name in (*PARTS, *arrays.own):
            setattr(self, name, runtime.upload(*on_device(arrays, name, tangent)))


class Adjoint:
    """Adjoints of a scene's numbers on the device: those of tetrahedra, sums per vertex, and parts of `more`.

    density, shape: whether masses and the rest shape are among them.
    """

    def __init__(self, arrays, features, more=()):
        self._arrays, self._features, self._rows = arrays, features, features.sums()
        a, blocks = arrays, arrays.num_blocks
        shape = a.points * blocks if features.shape else 0
        self.coefficients = runtime.array(a.lanes, a.coefficients_each * blocks)
        self.gradients, self.volumes = runtime.array(a.lanes, 9 * shape), runtime.array(a.lanes, shape)
        self.growths = runtime.array(a.lanes, *((a.growths.shape[0], 2 * blocks) if features.growing else (1, 1)))
        self.sums = runtime.array(a.fp, self._rows.total, a.num_vertices)
        for name in more:
            setattr(self, name, runtime.array(a.vector, *getattr(a, name).shape))
        absent = (() if features.shape else OF_SHAPE) + (() if features.growing else ("growths",))
        self._names = tuple(name for name in (*ADJOINT, *more) if name not in absent)
        self._read = [name for name in self._names if name in PARTS and getattr(a.values, name, None) is not None]
        self._but = {*self._read, *absent}  # of what `collect` makes zero

    def fits(self, arrays, features) -> bool:
        """Whether kernels and shapes are still those of the run."""
        same = (getattr(self, name).shape == getattr(arrays, name).shape for name in self._names if name in OF_STEPS)
        same = all(same) and (not features.growing or self.growths.shape[0] == arrays.growths.shape[0])
        return self._features == features and same

    def clear(self) -> None:
        """All zero."""
        runtime.clear(getattr(self, name) for name in self._names)

    def collect(self) -> Derived:
        """All of them in float64 on the host, those of the state being zero; without the shape, None for what it makes."""
        a, features, rows = self._arrays, self._features, self._rows
        out, sums = a.values.zeros(self._but), runtime.look(self.sums).astype(np.float64)
        out.parameters[: features.num_parameters] = sums[rows.of("parameters")].sum(1)
        if features.density:
            out.mass = sums[rows.first("mass")]
        if features.shape:
            out.rest = sums[rows.of("rest")].T
        if features.areas:
            out.surface = sums[rows.first("surface")]
        for name in self._read:
            setattr(out, name, PARTS[name].unpack(a, runtime.look(getattr(self, name))))
        if "anchor" in self._names and out.motion is not None:
            out.displacement[a.held] += runtime.fetch(self.anchor)
        return out
