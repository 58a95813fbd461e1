"""What kernels are compiled for, drawn from a number: law, solver, precision, kinds of terms, friction, paths, motion."""

from dataclasses import dataclass, replace

import numpy as np

import diffsim_ti as ds

from .open_materials import open_laws

PER_STRUCTURE = 8  # configurations of numbers on each
CELL = 0.1  # edge of a grid cell [m]

LAWS = (ds.StableNeoHookean, ds.SmithNeoHookean, ds.MooneyRivlin, ds.Corotated, ds.StVenantKirchhoff, ds.LinearElastic)
EXPLICIT = (ds.SemiImplicitSolver, ds.VelocityVerletSolver)
IMPLICIT = (ds.ImplicitEulerSolver, ds.ImplicitMidpointSolver, ds.BDF2Solver)
SOLVERS = (*EXPLICIT, *IMPLICIT, ds.StaticSolver)
WHEEL = (*EXPLICIT * 3, *IMPLICIT * 2, *(ds.StaticSolver,) * 3, ds.SemiImplicitSolver)  # how often each is drawn
OBSTACLES = ("Ground", "HalfSpace", "Sphere", "Bowl", "Box", "Capsule", "Cylinder", "MeshObstacle")

LOADS = tuple(
    f"{kind} {how}" for kind in ("Traction", "Pressure", "BodyForce") for how in ("constant", "per step", "keyed")
)
CHAMBERS = tuple(f"{kind} {how}" for kind in ("gas", "volume") for how in ("constant", "per step", "keyed"))
TIES = (
    *("Spring within", "Spring anchored", "ElasticFoundation one", "ElasticFoundation each"),
    *(f"Cable {what} {how}" for what in ("tension", "length") for how in ("constant", "per step", "keyed")),
)
NARROW = ("Sphere", "Box", "Capsule", "Cylinder")  # of which some are


@dataclass(frozen=True)
class ObstacleKind:
    """An obstacle as kernels know it."""

    name: str
    friction: bool
    path: bool
    per_area: bool  # its stiffness
    narrow: bool = False  # narrower than a triangle, before whose middle it lies


@dataclass(frozen=True)
class Structure:
    """Everything that kernels are compiled for."""

    number: int
    law: type
    solver: type
    precision: str
    volume: str
    parallel: bool | None
    obstacles: tuple[ObstacleKind, ...]
    self_contact: bool
    gravity: bool
    drag: bool
    forces: str  # "none", "constant", "per step"
    fixed: bool
    motion: bool
    uniform: bool  # moduli
    torch: bool  # whether its torch simulator is tried
    contact: str  # of explicit solvers
    contact_damping: float
    loads: tuple[str, ...]  # on surfaces and volumes, each with how it is given
    lines: tuple[str, ...]  # springs, cables, foundations
    rollers: bool  # some of what is fixed is fixed in some directions alone
    chamber: str  # what the cavity of a hollow body holds, and how that is given; "" of others
    order: int  # of the functions between nodes

    @property
    def explicit(self) -> bool:
        return self.solver in EXPLICIT

    @property
    def static(self) -> bool:
        return self.solver is ds.StaticSolver

    def __str__(self) -> str:
        kinds = [
            k.name + " rough" * k.friction + " moving" * k.path + " per area" * k.per_area + " narrow" * k.narrow
            for k in self.obstacles
        ]
        flags = ("self_contact", "gravity", "drag", "fixed", "motion", "uniform", "rollers")
        words = [name for name in flags if getattr(self, name)]
        how = f"{self.contact} {self.contact_damping:g}" if self.explicit else "potential"
        words += ["ten nodes"] * (self.order == 2)
        forces = [self.forces, *self.loads, *self.lines, *[self.chamber] * bool(self.chamber)]
        return (
            f"structure {self.number}: {self.law.__name__}, {self.solver.__name__}, {self.precision}, {self.volume}"
            f"{', parallel' if self.parallel else ''}; obstacles: {', '.join(kinds) or 'none'}, {how}; "
            f"forces {', '.join(forces)}; {', '.join(words)}"
        )


def turn(wheel: tuple, number: int, salt: int):
    """The number-th entry of a wheel that is shuffled anew in every round: all entries come equally often."""
    at, place = divmod(number, len(wheel))
    return wheel[np.random.default_rng([salt, at]).permutation(len(wheel))[place]]


def structure(number: int) -> Structure:
    """The number-th structure; the same for ever."""
    rng = np.random.default_rng([1, number])
    solver = turn(WHEEL, number, 2)
    static = solver is ds.StaticSolver
    self_contact = bool(turn((True, False, False), number, 3))
    count = int(
        rng.choice([0, 1, 2, 3, 4], p=[0.0, 0.35, 0.35, 0.2, 0.1] if not self_contact else [0.2, 0.4, 0.3, 0.1, 0])
    )
    names = [turn(OBSTACLES, 4 * number + k, 4) for k in range(max(count, int(static)))]
    if len(names) > 1 and rng.random() < 0.25:
        names[1] = names[0]  # two of a kind
    obstacles = tuple(
        ObstacleKind(name, rng.random() < 0.65, rng.random() < 0.45, turn((True, True, False), 4 * number + k, 8))
        for k, name in enumerate(names)
    )
    if solver in EXPLICIT and obstacles and obstacles[0].name in NARROW and turn((True, True, False), number, 11):
        obstacles = (replace(obstacles[0], narrow=True), *obstacles[1:])
    fixed = static or rng.random() < 0.5
    precision = "f32" if rng.random() < 0.2 else "f64"
    volume = "patches" if rng.random() < 0.2 else "tetrahedra"
    contact = turn(("stage", "stage", "force"), number, 6)
    of_users = number % 8 == 1  # a law that is not the package's
    laws = open_laws(solver in EXPLICIT, static, volume == "patches") if of_users else LAWS
    return Structure(
        number,
        turn(laws, number // 8 if of_users else number, 5),
        solver,
        precision,
        volume,
        True if solver in EXPLICIT and rng.random() < 0.2 else None,
        obstacles,
        self_contact,
        static or rng.random() < 0.75,
        not static and rng.random() < 0.5,
        str(rng.choice(["none", "constant", "per step"], p=[0.4, 0.3, 0.3])),
        fixed,
        fixed and rng.random() < 0.5,
        rng.random() < 0.4,
        number % 3 == 0 and not of_users,
        contact,
        turn((0.0, 0.005, 0.005, 0.2, 1.0), number, 7),
        tuple(turn(LOADS, 3 * number + k, 12) for k in range(1 + number // 4 % 3)) if number % 4 == 3 else (),
        tuple(turn(TIES, 3 * number + k, 13) for k in range(1 + number // 4 % 3)) if number % 4 == 2 else (),
        fixed and not static and number % 5 in (0, 4),
        turn(CHAMBERS, number // 4, 13) if number % 4 == 1 and not self_contact else "",
        turn((1, 1, 2), number, 14),
    )
