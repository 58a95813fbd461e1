"""What a scene contains, known when kernels compile: an absent feature leaves no code."""

from dataclasses import dataclass, replace

from diffsim_ti.common.rows import Rows
from diffsim_ti.inputs.poses import COLUMNS
from diffsim_ti.terms import VertexForce


@dataclass(frozen=True)
class ObstacleGroup:
    """Obstacles of one kind, which kernels go through in a loop: the k-th of them has its numbers at first + k size."""

    force: VertexForce  # the device counterpart of all of them
    first: int  # where the numbers of the first start in the parameter array
    number: int  # place of the first among all obstacles
    path: int = -1  # column of the first's path among those that move, -1 if they stand still
    turning: int = -1  # place of the first among those that turn
    count: int = 1

    @property
    def size(self) -> int:
        return self.force.size

    @property
    def led(self) -> bool:
        """Whether robots move them."""
        return self.force.turns and self.path < 0

    def holds(self, force: VertexForce, first: int, path: int) -> bool:
        """Whether one more obstacle, next in the parameters and the paths, belongs to the group."""
        next_path = -1 if self.path < 0 else self.path + self.count * (COLUMNS if force.turns else 1)
        return force == self.force and first == self.first + self.count * self.size and path == next_path


def grouped(obstacles) -> tuple[ObstacleGroup, ...]:
    """Groups of obstacles given as (counterpart, first parameter, column of the path or -1), neighbours of one kind
    together."""
    groups, turning = [], 0
    for number, (force, first, path) in enumerate(obstacles):
        last = groups[-1] if groups else None
        if last and last.holds(force, first, path):
            groups[-1] = replace(last, count=last.count + 1)
        else:
            groups.append(ObstacleGroup(force, first, number, path, turning if force.turns else -1))
        turning += force.turns
    return tuple(groups)


@dataclass(frozen=True)
class Features:
    """What kernels are compiled for, besides the law."""

    order: int = 1  # of the functions between an element's nodes
    groups: tuple[ObstacleGroup, ...] = ()
    stages: bool = False  # whether obstacles with a distance act as a stage of the passes, not as a force
    gravity: int = -1  # where it starts in the parameter array, -1: none
    drag: int = -1
    forces: bool = False
    forces_per_step: bool = False
    forces_keyed: bool = False  # whether they change within steps
    interactions: tuple = ()  # what else acts on a body (mechanics/interaction.py)
    growing: bool = False  # whether tetrahedra grow over time
    growth_per_step: bool = False
    growth_uniform: bool = True
    motion: bool = False
    partly_fixed: bool = False  # whether vertices are fixed in some directions only
    reduced: bool = False  # whether explicit passes take sets of vertices by few numbers
    rigid: bool = False
    moving: int = 0  # columns of the paths that obstacles follow
    num_parameters: int = 0  # numbers of all terms
    uniform: bool = True  # one set of coefficients for all tetrahedra
    by_points: bool = False  # whether each point of the stresses has its own
    recorded: bool = False  # whether a loss names what a contact stage does
    balanced: bool = False  # whether the work of the body's own forces is counted
    density: bool = False  # the last two: adjoints that cost extra, only if asked for
    shape: bool = False

    @property
    def staged(self) -> tuple[ObstacleGroup, ...]:
        """Groups that act as a stage of explicit passes."""
        return tuple(group for group in self.groups if self.stages and group.force.watched)

    @property
    def num_staged(self) -> int:
        return sum(group.count for group in self.staged)

    @property
    def first_staged(self) -> int:
        """Number of the first obstacle that acts as a stage; the others of them follow it."""
        return self.staged[0].number if self.staged else 0

    @property
    def led(self) -> bool:
        """Whether robots move some."""
        return any(group.led for group in self.groups)

    @property
    def driven(self) -> bool:
        """Whether something may do work on the body that its energy does not tell. Drag alone only takes some, and
        counting that would cost small scenes a fifth."""
        return self.forces or self.motion or self.moving > 0 or self.loaded_corners

    @property
    def items(self) -> tuple:
        """Interactions whose items write to corners."""
        return tuple(x for x in self.interactions if x.at_corners and not x.apart)

    @property
    def at_vertices(self) -> tuple:
        """Interactions that act vertex by vertex."""
        return tuple(x for x in self.interactions if not x.at_corners)

    @property
    def in_kernels(self) -> tuple:
        """Both."""
        return self.items + self.at_vertices

    @property
    def loaded_corners(self) -> bool:
        """Whether vertices gather loads: of pressures, or of cables."""
        return any(x.is_load for x in self.interactions)

    @property
    def pulled(self) -> bool:
        """Whether some loads may be counted as energy of the body's own as well."""
        return any(x.is_load and x.pulls for x in self.interactions)

    @property
    def asks_for_steps(self) -> bool:
        """Whether kernels ask in which step a pass lies."""
        return self.forces_keyed or self.growing or any(x.asks_for_steps for x in self.interactions)

    @property
    def pressing(self) -> tuple[ObstacleGroup, ...]:
        """Groups that act by a force of their own."""
        return tuple(group for group in self.groups if group not in self.staged)

    @property
    def staged_rough(self) -> tuple[ObstacleGroup, ...]:
        return tuple(group for group in self.staged if group.force.friction)

    @property
    def rough(self) -> tuple[ObstacleGroup, ...]:
        """Groups with friction."""
        return tuple(group for group in self.pressing if group.force.friction)

    @property
    def rough_backwards(self) -> tuple[ObstacleGroup, ...]:
        return self.rough[::-1]

    @property
    def areas(self) -> bool:
        """Whether adjoints of the surface's areas are wanted: the rest shape decides about them."""
        return self.shape and any(group.force.per_area for group in self.groups)

    def of_elements(self) -> "Features":
        """What tetrahedra see of it: scenes that differ in the rest share kernels of these alone."""
        kept = "order growing growth_per_step growth_uniform uniform by_points shape".split()
        return Features(**{name: getattr(self, name) for name in kept})

    def of_state(self) -> "Features":
        """The same of energies, forces and their derivatives in a given state, which obstacles have as well."""
        if not self.groups:
            return self.of_elements()
        numbers = self.num_parameters if self.density or self.shape else 0  # say where other sums begin
        return replace(self.of_elements(), groups=self.groups, density=self.density, num_parameters=numbers)

    def sums(self) -> Rows:
        """Rows of the per-vertex adjoint sums: those of the parameters stand as the parameters do."""
        sizes = {"mass": int(self.density), "rest": 3 * self.shape, "surface": int(self.areas)}
        return Rows({"parameters": self.num_parameters} | sizes)
