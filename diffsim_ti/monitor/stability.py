"""How large a step may be: a bound by elements, the tight limit by Lanczos, and a bound during the run."""

from dataclasses import replace

import numpy as np

from diffsim_ti import runtime
from diffsim_ti.inputs import StressPoints
from diffsim_ti.mechanics.energy.kernels import potential_kernels
from diffsim_ti.mechanics.interactions import host_forces
from diffsim_ti.mechanics.workspace import Workspace
from diffsim_ti.mesh.patches import volume_patches
from diffsim_ti.scene import Scene
from diffsim_ti.state.schedule import EqualSteps
from diffsim_ti.state.viscous_stages import ViscousStages
from diffsim_ti.terms import Term
from diffsim_ti.terms.mass_scaling import row_sums
from diffsim_ti.terms.reduced import KINDS

ONE = ViscousStages()


class StepLimit(float):
    """Largest stable explicit step [s], a float; with `tetrahedron`, which sets it, and `method`, how it was found."""

    tetrahedron: int
    method: str

    def __new__(cls, dt: float, tetrahedron: int, method: str):
        out = super().__new__(cls, dt)
        out.tetrahedron, out.method = tetrahedron, method
        return out

    def __getnewargs__(self) -> tuple:
        return self.dt, self.tetrahedron, self.method

    @property
    def dt(self) -> float:
        """The step alone."""
        return float.__add__(self, 0.0)

    def __str__(self) -> str:
        return f"{self.dt:.4g} s ({self.method}, set by tetrahedron {self.tetrahedron})"


def element_limit(scene: Scene, values: dict | None = None, kicks: ViscousStages = ONE) -> StepLimit:
    """A step that is safe at rest, from each tetrahedron by itself, without contact.

        omega^2 <= (4 / rho) [max(lam, 0) sum_a |grad N_a|^2 + 2 mu lambda_max(sum_a grad N_a (x) grad N_a)]
        dt = 2 / omega, or with viscosity (sqrt(c^2 + 4 omega^2) - c) / omega^2,

    c [1/s] being the same bound with eta, lam_v in the place of mu, lam: with x the eigenvector of a step, of unit mass,
    its eigenvalues are those of an oscillator of stiffness x . K x and damping x . C x; for kicks in stages see there.
    mu, lam are the law's small-strain moduli; with volume="patches" lam is the patch's mean. The eigenvalues of the
    assembled system never exceed the largest of its elements (Hughes, The Finite Element Method, 9.1); lumped vertex masses
    are at least those of the element. With mass scaling another bound counts where it is lower (mass_scaling.py). Gases and
    cables count with the largest they have over time (`stiffest`).
    """
    values, material = stiffest(scene, scene.inputs.values if values is None else values), scene.material
    mu, lam = material.lame({name: values[name] for name in material.inputs})
    derived = scene.inputs.derive(values)
    if scene.volume == "patches" and np.ndim(lam) and scene.mesh.order == 1:
        patches = volume_patches(scene.mesh)
        means = np.bincount(patches, lam * derived.volumes) / np.bincount(patches, derived.volumes)
        lam = means[patches]
    dilatation, largest = (x.copy() for x in _squares_of_strains(scene, derived))
    within = scene.reduced.elements(scene.mesh.elements) if scene.reduced else []
    together = [(body, own) for body, own in zip(scene.reduced.bodies, within) if body.kind in KINDS and len(own)]
    for _, own in together:
        dilatation[own] = largest[own] = 0.0
    viscous = material.viscosities({name: values[name] for name in material.inputs})

    def bound_of(mu, lam):
        return (np.maximum(lam, 0) * dilatation + 2 * mu * largest) / values["density"]  # one of each tetrahedron

    def largest_of(omega2, c):
        each = kicks.squared_rate(omega2, c)
        return omega2[worst := int(np.argmax(each))], c[worst] if np.ndim(c) else c, worst

    omega2, c = bound_of(mu, lam), 0.0 if viscous is None else bound_of(*viscous)
    for body, own in together:
        if not body.rigid:
            omega2[own[0]] = _affine_bound(scene.mesh, derived.volumes, own, mu, lam, values["density"])
            if viscous is not None:
                c[own[0]] = _affine_bound(scene.mesh, derived.volumes, own, *viscous, values["density"])
    omega2, c, worst = largest_of(omega2, c)
    more = sum(x.added_omega2(values, derived) for x in scene.interactions)  # what all of them add at the most
    if hosts := host_forces(scene).with_energy:
        at = hosts.stiffest(derived, EqualSteps(1.0, 1))
        more += at.largest_omega2(derived.mass, derived.displacement, scene.fixed)
    if scene.mass_scaling:
        mass = np.where(derived.mass > 0, derived.mass, 1.0)
        rows = row_sums(scene, mu, lam, scene.volume == "patches") / mass
        damped = 0.0 if viscous is None else row_sums(scene, *viscous, False) / mass
        *of_rows, vertex = largest_of(rows, damped)
        if kicks.squared_rate(*of_rows) < kicks.squared_rate(omega2, c):
            omega2, c = of_rows
        worst = int(np.argmax((scene.mesh.tetrahedra == vertex).any(1)))
    total = kicks.squared_rate(omega2 + more, c)
    return StepLimit(float(2 / np.sqrt(total)) if total > 0 else np.inf, worst, "element bound")


def _squares_of_strains(scene: Scene, derived) -> tuple[np.ndarray, np.ndarray]:
    """The same for a rest shape, kept as long as it stays."""
    known, of = getattr(scene, "known_strains", None), (derived.gradients, derived.volumes)
    if known is None or any(x is not y for x, y in zip(known[0], of)):
        known = scene.known_strains = of, _strains_of(scene.mesh, derived)
    return known[1]


def _strains_of(mesh, derived) -> tuple[np.ndarray, np.ndarray]:
    """For each element, the most that the integrals of (div v)^2 and |grad v|^2 may be of that of v^2 by lumped masses."""
    element, (_, N, V) = mesh.reference, StressPoints.of(mesh, derived)
    if element.order == 1:
        return 4 * (N**2).sum((1, 2)), 4 * np.linalg.eigvalsh(np.einsum("eai,eaj->eij", N, N))[:, -1]
    m, Q = len(mesh.elements), element.num_points
    share = V.reshape(m, Q) / V.reshape(m, Q).sum(1, keepdims=True)
    N = N.reshape(m, Q, -1, 3) * np.sqrt(share)[:, :, None, None] / np.sqrt(element.lumped)[:, None]
    rows = np.swapaxes(N, 2, 3).reshape(m, 3 * Q, -1)  # of grad v, whose squares are those of the smaller Gram matrices
    of_dilatation = np.einsum("eqai,epai->eqp", N, N, optimize=True)
    return np.linalg.eigvalsh(of_dilatation)[:, -1], np.linalg.eigvalsh(rows @ np.swapaxes(rows, 1, 2))[:, -1]


def _affine_bound(mesh, volumes: np.ndarray, own: np.ndarray, mu, lam, density) -> float:
    """The largest omega^2 [1/s^2] of elements `own` that move by nine strains together, free of all else: that of

        sum V (lam (tr G)^2 + 2 mu |sym G|^2)    by    sum m |G y|^2

    over all gradients G, the m being the elements' own lumped masses, and y places from their centre.
    """
    volumes = np.asarray(volumes).reshape(len(mesh.elements), -1).sum(1)[own]
    mu, lam, density = (np.broadcast_to(x, len(mesh.elements))[own] for x in (mu, np.maximum(lam, 0), density))
    mass = ((density * volumes)[:, None] * mesh.reference.lumped).ravel()
    y = mesh.vertices[mesh.elements[own].ravel()]
    y = y - mass @ y / mass.sum()
    values, vectors = np.linalg.eigh(np.einsum("n,ni,nj->ij", mass, y, y))
    G = np.einsum("ai,jk->akij", np.eye(3), vectors / np.sqrt(values)).reshape(9, 3, 3)  # orthonormal by mass
    symmetric = 0.5 * (G + np.swapaxes(G, 1, 2))
    trace = np.trace(G, axis1=1, axis2=2)
    K = (volumes @ lam) * np.outer(trace, trace) + 2 * (volumes @ mu) * np.einsum("aij,bij->ab", symmetric, symmetric)
    return float(np.linalg.eigvalsh(K)[-1])


class Stiffness:
    """Products of M^-1/2 (-df/du - s df/dv) M^-1/2 on the free vertices, at the current state of a workspace.

    s = 2 / h is the `rate` [1/s] of a step h, which is stable where no eigenvalue is beyond s^2 (`element_limit`); without
    viscosity it means nothing.
    """

    def __init__(self, workspace: Workspace):
        self.ws = workspace
        a = workspace.arrays
        self.w, self.y = runtime.array(a.vector, 1, a.num_vertices), runtime.array(a.vector, 1, a.num_vertices)
        self.poses, self.lag = a.offsets, runtime.array(a.vector, 2, 1)
        self.pressed = self.lag  # no friction
        features = a.features()
        without_stages = replace(features, groups=features.pressing)  # a stage limits no step
        law = workspace.scene.law  # as explicit passes take it
        self.viscous, self.rate = law.viscous, runtime.array(a.fp, 1)
        kernels = potential_kernels(law, without_stages, workspace.parallel, a.in_lanes)
        at = (workspace.state, self)
        self._multiply = kernels.stiffness.bind(a.in_vectors, scene=a, pass_=self, at=at, out=self)
        self.vector, self._random = None, np.random.default_rng(1)
        self.hosts = host_forces(workspace.scene).with_energy
        self._told = None  # the numbers that they have
        self.bodies = workspace.arrays.bodies

    def possible(self, x: np.ndarray, root: np.ndarray) -> np.ndarray:
        """What of vectors, times the roots of the masses, sets that move by few numbers can do."""
        if self.bodies is None:
            return x
        values = self.ws.arrays.values
        free, u = np.where(root > 0, root, 1.0), runtime.fetch_row(self.ws.state.u, 0)
        return self.bodies.projected(x * free, u, values.mass) / free

    @property
    def root(self) -> np.ndarray:
        """Roots of the inverse masses as they are now, shape (num_vertices, 1)."""
        return np.sqrt(runtime.fetch(self.ws.arrays.inverse_mass).astype(np.float64))[:, None]

    def product(self, x: np.ndarray) -> np.ndarray:
        """The product with x, shape (num_vertices, 3), float64."""
        root = self.root
        w = root * self.possible(x, root)
        scale = np.abs(w).max() or 1.0  # f32 keeps its digits whatever the masses
        runtime.fill(self.w, (w / scale)[None])
        a = self.ws.arrays
        a.clear_corners_of_loads()
        self._multiply(num_items=a.num_items, num_tetrahedra=a.num_places, num_vertices=a.num_vertices, per_gamma=0.0)
        y = runtime.fetch(self.y)[0].astype(np.float64) * scale
        y = -root * (y + self.ws.chambers.product(w) if self.ws.chambers else y)
        if self.hosts:
            now = runtime.fetch_row(self.ws.state.u, 0)
            given = a.values, *a.rows.values()
            if self._told is None or any(x is not y for x, y in zip(given, self._told)):
                self.hosts.stiffest(a.now, self.ws.solver.schedule)
                self._told = given
            y += root * self.hosts.product(now, w)
        return self.possible(y, root)

    def _stiffest(self, x: np.ndarray) -> float:
        """The size of the product with x of the same body without sets that move by few numbers."""
        bodies, self.bodies = self.bodies, None
        size = np.linalg.norm(self.product(x))
        self.bodies = bodies
        return float(size)

    def largest(self, tolerance: float = 1e-3) -> tuple[float, float]:
        """(largest eigenvalue omega^2 [1/s^2], residual bound) by Lanczos; keeps the vector for `lower_bound`. With
        viscosity (2 / h)^2 of the longest stable step h, at whose rate it is the largest eigenvalue.

        Some eigenvalue lies within the residual of the Ritz value (Parlett, The Symmetric Eigenvalue Problem, 4.5).
        """
        value, residual = self._largest(tolerance)
        for _ in range(20 if self.viscous and value > 0 else 0):
            s2 = self._of_step()
            value, residual = self._largest(tolerance)
            if value <= (1 + tolerance) * s2:
                break
        return value, residual

    def set_rate(self, rate: float) -> None:
        """Set s [1/s]."""
        runtime.fill(self.rate, rate)

    def _of_step(self) -> float:
        """(2 / h)^2 of the longest stable step of the vector's own motion, at whose rate products are from now on."""
        x, s = self.vector / np.linalg.norm(self.vector), float(runtime.fetch(self.rate)[0]) or 1.0
        parts = []
        for rate in (0.0, s):
            self.set_rate(rate)
            parts.append(float((x * self.product(x)).sum()))
        s2 = float(ONE.squared_rate(parts[0], (parts[1] - parts[0]) / s))
        self.set_rate(np.sqrt(s2))
        return s2

    def _largest(self, tolerance: float) -> tuple[float, float]:
        from scipy.sparse.linalg import LinearOperator, eigsh

        n = self.root.size
        start = np.random.default_rng(0).standard_normal((n, 3)) * (self.root > 0)
        if not start.any():
            return 0.0, 0.0
        with np.errstate(over="ignore", invalid="ignore"):
            size = np.linalg.norm(self.product(start))
        if self.bodies is not None:
            rounding = 1e-6 if self.ws.arrays.precision == "f32" else 1e-12
            if not size > rounding * self._stiffest(start):  # nothing deforms
                return 0.0, 0.0
        if not 0 < size < np.inf:
            raise FloatingPointError(
                f"the stiffness of this state is {'zero' if size == 0 else 'not finite'} in this precision: check Young's "
                'modulus and the scale of the mesh, or take precision="f64"'
            )
        operator = LinearOperator((3 * n, 3 * n), lambda x: self.product(x.reshape(-1, 3)).ravel(), dtype=np.float64)
        value, vector = eigsh(operator, 1, which="LA", v0=start.ravel(), tol=tolerance, ncv=min(3 * n - 1, 24))
        self.vector = vector[:, 0].reshape(-1, 3)
        residual = np.linalg.norm(self.product(self.vector) - value[0] * self.vector)
        return float(value[0]), float(residual)

    def lower_bound(self, products: int = 4) -> float:
        """A lower bound of omega^2 at the present state: a few Lanczos steps from the vector of the last call.

        Something random is mixed in: a vector that has settled on one mode would not see another mode overtake it.
        """
        if self.vector is None:
            self.largest(1e-2)
        if self.vector is None:  # nothing is free to move
            return 0.0
        x = self._random.standard_normal(self.vector.shape) * (self.root > 0)
        x = self.vector / np.linalg.norm(self.vector) + 0.3 * x / np.linalg.norm(x)
        basis, ritz = [], np.zeros((products, products))
        for k in range(products):
            size = np.linalg.norm(x)
            for q in basis:
                x = x - (q * x).sum() * q
            if np.linalg.norm(x) <= 1e-4 * size:  # few vertices are free: all of their motions are in the basis
                break
            basis.append(x / np.linalg.norm(x))
            x = self.product(basis[-1])
            if not np.isfinite(np.linalg.norm(x)):
                return np.inf
            ritz[k, : k + 1] = [(q * x).sum() for q in basis]
        count = len(basis)
        values, vectors = np.linalg.eigh(ritz[:count, :count])  # reads the lower half
        self.vector = sum(c * q for c, q in zip(vectors[:, -1], basis))
        return self._of_step() if self.viscous else float(values[-1])

    def worst_tetrahedron(self) -> int:
        """The tetrahedron where that vector moves most relative to its size."""
        a = self.ws.arrays
        points = StressPoints.of(a.mesh, a.values)
        strain = points.displacement_gradients(self.root * self.vector)
        return int(np.argmax((strain**2).sum((1, 2)) * points.volumes)) // a.points


class Damping(Stiffness):
    """Products of M^-1/2 (-df/dv) M^-1/2 [1/s]."""

    def __init__(self, workspace: Workspace):
        super().__init__(workspace)
        self.viscous = False  # this is a stiffness like others
        self._rate = 2 / workspace.substep

    def product(self, x: np.ndarray) -> np.ndarray:
        self.set_rate(0.0)
        elastic = super().product(x)
        self.set_rate(self._rate)
        return (super().product(x) - elastic) / self._rate


class StagedStiffness:
    """A stiffness and a damping by themselves, for kicks in stages (state/viscous_stages.py); calls as of `Stiffness`."""

    def __init__(self, workspace: Workspace):
        self.kicks = workspace.solver.kicks
        self.elastic, self.damping = Stiffness(workspace), Damping(workspace)
        self.elastic.viscous, self._worst = False, self.elastic

    def _squared_rate(self, omega2: float, c: float) -> float:
        parts = [float(self.kicks.squared_rate(*x)) for x in ((omega2, 0.0), (0.0, c))]
        self._worst = self.damping if parts[1] > parts[0] else self.elastic
        return max(parts)

    def largest(self, tolerance: float = 1e-3) -> tuple[float, float]:
        """((2 / h)^2 of the longest stable substep h, what it may be off)."""
        (omega2, of_omega2), (c, of_c) = (part.largest(tolerance) for part in (self.elastic, self.damping))
        value = self._squared_rate(omega2, c)
        return value, self._squared_rate(omega2 + of_omega2, c + of_c) - value

    def lower_bound(self) -> float:
        """A lower bound of it at the present state."""
        return self._squared_rate(self.elastic.lower_bound(), self.damping.lower_bound())

    def worst_tetrahedron(self) -> int:
        return self._worst.worst_tetrahedron()


def stiffness_of(workspace: Workspace) -> Stiffness | StagedStiffness:
    """What tells how long a substep of the workspace's solver may be."""
    return Stiffness(workspace) if workspace.solver.kicks == ONE else StagedStiffness(workspace)


def lanczos_limit(workspace: Workspace, tolerance: float = 1e-3) -> StepLimit:
    """The tight stable step 2 / omega_max at the workspace's present state, contact included.

    A residual bound is added to omega^2, so the step errs on the safe side.
    """
    stiffness = stiffness_of(workspace)
    value, residual = stiffness.largest(tolerance)
    if value <= 0:
        return StepLimit(np.inf, 0, "Lanczos")
    return StepLimit(float(2 / np.sqrt(value + residual)), stiffness.worst_tetrahedron(), "Lanczos")


def over_time(scene: Scene) -> list[Term]:
    """Terms whose stiffness may change over time."""
    return [term for term in scene.terms if term.stiffest is not None]


def stiffest(scene: Scene, values: dict) -> dict[str, np.ndarray]:
    """Values in which gases have their largest pressure, cables their largest tension and least length, of all steps that
    are given, of all keyframes, or of the times at which `values` sample a function; of one that they do not, at time 0."""
    out = dict(values)
    for term in over_time(scene):
        name = scene.input_names(term)[term.plain]
        rows = [np.ravel(values[name])] if name in values else []
        if term.keyed:
            rows.append(np.ravel(term.rows([0.0] if callable(term.given) else term.given[0])))
        extreme = term.stiffest(np.concatenate(rows))
        out[name] = np.array([extreme]) if term.keyed else np.array(extreme)
    return out


def sampled_by_runs(scene: Scene) -> bool:
    """Whether some of them is a function of time, which a run alone samples."""
    return any(term.keyed and callable(term.given) for term in over_time(scene))
