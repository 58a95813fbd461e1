"""Contact of the surface with itself, and of several bodies with each other."""

from collections.abc import Mapping

import numpy as np

from diffsim_ti.common.checked import numbers
from diffsim_ti.common.rows import indices
from diffsim_ti.common.warn import warn
from diffsim_ti.inputs import NOT_NEGATIVE, Input
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.mesh.collision_surface import cuts_of
from diffsim_ti.mesh.face_points import bow
from diffsim_ti.terms.term import Term, chosen_width, positive


class SelfContact(Term):
    """Pairs of surface primitives, vertex and triangle or edge and edge, push each other apart nearer than `width`.

    Energy of a pair at distance d: m b(d) with b(d) = -stiffness (d - width)^2 log(d / width) for d < width, exactly zero
    beyond (barrier.py); m fades out edges that become parallel (proximity.py), with lengths as in the mesh.
    Pairs that share a vertex do not count. stiffness [N/m]; width [m], None: 1 % of the smallest body (`mesh.body_size`),
    which `scene.describe()` says.
    Where ten-node faces are curved by a tenth of the width or more, primitives are those of a finer surface on the curved
    faces (mesh/collision_surface.py), whose new vertices are in the sets that all of their nodes are in.

    friction [-]: Coulomb's coefficient of pairs that press with N = m |db/dd|; 0 compiles none. A dict has that of pairs of
    sets of vertices or tetrahedra, {("palm", "ball"): 0.6}, and other pairs have no friction; a pair whose corners are
    in several sets belongs to those of its vertex, or of each edge's first one, and of the triangle's first one.
    friction_speed [m/s]: the speed of sliding below which friction is smoothed, and with which what is held may creep:
    mu N f(s / friction_speed), f(y) = 2 y - y^2 for y < 1, 1 beyond. In explicit steps it is a part of the stage that adds
    no energy, whatever the step (surfaces/contact_parts.py), with N as the stage finds it; in implicit ones a force, with
    N and the normal from where the step begins.
    Its forces F act at the two ends of the gap d: a couple d x F, which changes angular momentum by less than the
    width times the impulse of friction. Edges that pass each other are bumps, which take energy: a slab on a slope
    went as with 0.0005 more friction at a width of 4 mm, and as with 0.0001 at 1 mm, whatever friction_speed and step.
    A narrower and stiffer barrier is smoother.

    Pairs of one body whose distance D at rest is below twice the width, neighbours along its surface or sides of a slit,
    have a width and a stiffness of their own, so that a body at rest does not press on itself:

        own width = share width,   own stiffness = stiffness / share,   share = min(1, D / (2 width))

    They begin to press at half of D, with the forces that others have at the same share of their widths. D follows the rest
    shape, and gradients by rest shape and width know it; where two edges are exactly parallel at rest D has a kink, and they
    take the slope of one side. Different bodies (pieces of the mesh, see `TetrahedralMesh.joined`) may start nearer than the
    width and then press from the start.

    Inputs with gradient: "self_contact_stiffness", "self_contact_width", with friction "self_contact_friction_speed" and
    "self_contact_friction", of a dict shape (pairs,); or "<name>.stiffness" and so on.
    One per scene. In explicit steps it is a stage that no step is too large for (`contact_damping` of their solvers): what
    the stiffness cannot hold is lost as in an inelastic impact. A substep with near pairs then takes several times as long
    as one without, of small bodies the most. Reduced sets go with it there; they keep linear momentum, and without
    friction angular momentum, to round-off, a basis where it has these motions. What an impulse may do to a whole set bounds
    its friction, so that sets creep more than free bodies do.
    stage: has no effect, and goes with the next version.
    Implicit solvers keep surfaces apart during the whole motion of every step; ImplicitMidpointSolver raises Tunnelling
    where the end of a step lies beyond a contact.

    Raises ValueError for stiffness, width or friction_speed <= 0, friction < 0, names that are no sets, sets of a dict that
    share a vertex, and, when a run starts, for a width beyond four mean edges of the surface, for primitives that touch at
    rest, and for surfaces that touch or pass through each other, which `StaticSolver` presses apart. An explicit
    substep whose parts cannot be short enough to keep surfaces apart raises Tunnelling.
    Li et al. 2020, Incremental Potential Contact, doi:10.1145/3386569.3392425.
    """

    index = indices(stiffness=1, width=1, friction_speed=1, friction=1)  # of its numbers; as many coefficients as pairs

    def __init__(
        self,
        stiffness: float = 1e4,
        width: float | None = None,
        name: str | None = None,
        friction: float | Mapping[tuple[str, str], float] = 0.0,
        friction_speed: float = 1e-3,
        stage: bool | None = None,
    ):
        if stage is not None:
            warn(
                "SelfContact: pairs are always a stage of explicit steps; leave `stage` out, which goes with the next "
                "version",
                DeprecationWarning,
            )
        self.friction_pairs = tuple(friction) if isinstance(friction, Mapping) else None
        numbers("friction_speed", 0.0 if hasattr(friction_speed, "detach") else friction_speed)
        speed = positive("friction_speed", friction_speed, "m/s", "self_contact_friction_speed")
        value, shape = numbers("friction", friction) if friction is None else friction, ()
        if self.friction_pairs is not None:
            self._check_pairs(self.friction_pairs)
            value, shape = numbers("friction", list(friction.values())), (len(friction),)
        mu = Input("friction", value, (shape,), "-", NOT_NEGATIVE, plain="self_contact_friction")
        for described in (speed, mu):  # also of what is smooth
            described.check_value("SelfContact")
        self.has_friction = bool(np.any(mu.value > 0))
        self.left_to_scene = ("self_contact_width",) * (width is None)
        super().__init__(
            positive("stiffness", stiffness, "N/m", "self_contact_stiffness"),
            positive("width", 1.0 if width is None else width, "m", "self_contact_width"),
            *((speed, mu) if self.has_friction else ()),
            name=name,
        )

    @staticmethod
    def _check_pairs(pairs: tuple) -> None:
        for pair in pairs:
            if not (isinstance(pair, tuple) and len(pair) == 2 and all(isinstance(name, str) for name in pair)):
                rule = "friction needs pairs of names of sets, such as ('a', 'b')"
                raise ValueError(f"SelfContact: {rule}, got {pair!r}")
            if pair[0] != pair[1] and pair[::-1] in pairs:
                both = f"{pair!r} and {pair[::-1]!r}"
                raise ValueError(f"SelfContact: friction has {both}, which are one pair: name it once")

    def _on(self, mesh: TetrahedralMesh) -> "SelfContact":
        """With the width that a mesh asks for."""
        left = "self_contact_width" in self.left_to_scene
        return self.with_input("self_contact_width", value=chosen_width(mesh)) if left else self

    def settled(self, scene, density, initial_positions, initial_velocities) -> "SelfContact":
        return self._on(scene.mesh)

    def check(self, mesh: TetrahedralMesh) -> None:
        own = self._on(mesh)
        width = float(own.values["self_contact_width"])
        off = bow(mesh) / 4 ** cuts_of(mesh, width)  # so far faces may reach through
        if off > width:
            warn(
                f"{type(self).__name__}: faces of this mesh are curved, and lie up to {off:.3g} m from the triangles that "
                f"stand for each, more than the width {width:.3g} m: refine the mesh where it is curved, or take a wider "
                "one"
            )
        if self.has_friction:
            self.labels(mesh)

    def labels(self, mesh: TetrahedralMesh) -> tuple[np.ndarray, np.ndarray]:
        """(a label of each surface vertex, which coefficient two labels have, or -1: shape (labels, labels))."""
        label = np.zeros(mesh.num_vertices, int)
        if self.friction_pairs is None:
            return label[mesh.surface_vertices], np.zeros((1, 1), int)
        names = sorted({name for pair in self.friction_pairs for name in pair})
        for k, name in enumerate(names, start=1):
            if name not in mesh.vertex_sets and name not in mesh.tetrahedron_sets:
                raise ValueError(
                    f"SelfContact: friction names {name!r}, which is no set of vertices or tetrahedra of the mesh; it has "
                    f"{sorted({*mesh.vertex_sets, *mesh.tetrahedron_sets})}"
                )
            members = mesh.vertex_sets.get(name)
            if members is None:
                members = np.unique(mesh.elements[mesh.tetrahedron_sets[name]])
            if np.any(label[members] > 0):
                other, i = names[int(label[members].max()) - 1], int(members[label[members].argmax()])
                raise ValueError(
                    f"SelfContact: vertex {i} is in {other!r} and in {name!r}, and friction needs to know which it is; "
                    "name sets that have no vertex in common"
                )
            label[members] = k
        rows = np.full((len(names) + 1, len(names) + 1), -1)
        for k, pair in enumerate(self.friction_pairs):
            a, b = (names.index(name) + 1 for name in pair)
            rows[a, b] = rows[b, a] = k
        return label[mesh.surface_vertices], rows
