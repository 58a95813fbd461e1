"""How many variables the kernels of a first step and of its gradient have, by law, alone and around each other: the time in
which Taichi compiles a kernel grows with the square of their number. As a command, the seconds of processor time:

    python tests/kernel_sizes.py [laws]    # all of LAWS, or those named, with TI_OFFLINE_CACHE=0 in the environment
"""

import sys
import time
from contextlib import contextmanager, suppress

import numpy as np
from scipy.sparse import diags, eye
from scipy.sparse.linalg import spsolve

import diffsim_ti as ds
from diffsim_ti.runtime.launch import Launch
from diffsim_ti.solvers.implicit.device_cg import DeviceCG
from diffsim_ti.solvers.implicit.newton_kernels import DONE, PHASE
from diffsim_ti.solvers.implicit.rounds import Rounds

FIBRE = dict(k1=1e4, k2=1.0)


def ogden(terms: int):
    return ds.Ogden([5e4, -7e4, 3e4][:terms], [2.0, -2.0, 4.0][:terms], 2e5)


def around(material) -> dict:
    """The material alone, and with each of those that go around it."""
    return {
        "": material,
        "voigt": ds.KelvinVoigt(material, time=1e-2),
        "viscous": ds.KelvinVoigt(material, shear_viscosity=70.0, bulk_viscosity=80.0),
        "prony": ds.Prony(material, [0.5, 0.2], [0.1, 1.0]),
        "grown": ds.Grown(material, 0.05),
        "fibres": ds.FibreReinforced(material, **FIBRE, fibre=[1, 0, 0]),
    }


def nested(material):
    """All of them at once."""
    fibres = ds.FibreReinforced(ds.Grown(material, 0.05), **FIBRE, fibre=[1, 0, 0])
    fibres = ds.FibreReinforced(fibres, **FIBRE, fibre=[0, 1, 0])
    return ds.KelvinVoigt(ds.Prony(fibres, [0.5, 0.2], [0.1, 1.0]), time=1e-2)


ALONE = {
    "linear": ds.LinearElastic(1e5, 0.3),
    "corotated": ds.Corotated(1e5, 0.3),
    "kirchhoff": ds.StVenantKirchhoff(1e5, 0.3),
    "neo": ds.StableNeoHookean(1e5, 0.3),
    "smith": ds.SmithNeoHookean(1e5, 0.3),
    "mooney": ds.MooneyRivlin(1e5, 0.3),
    "yeoh": ds.Yeoh(1e5, -1e3, 100.0, 1e6),
    "gent": ds.Gent(4e4, 30.0, 2e5),
    "ogden1": ogden(1),
    "ogden3": ogden(3),
}
LAWS = {f"{outer} {name}".strip(): law for name, one in ALONE.items() for outer, law in around(one).items()}
LAWS |= {f"nested {name}": nested(law) for name, law in ALONE.items()}
SOLVERS = {
    "explicit": lambda scene: ds.VelocityVerletSolver(scene, dt=1e-4),
    "implicit": lambda scene: ds.BDF2Solver(scene, dt=1e-2),
}


@contextmanager
def traced_alone(found: dict):
    """Kernels are traced and not compiled, and do nothing; `found` takes their variables by name."""

    def launch(self, numbers):
        if self._setters is None:
            self._setters, before = (), found.get(self._kernel.func.__name__, 0)
            with suppress(_Traced):
                self._prepare(numbers)
            found[self._kernel.func.__name__] = max(before, self.variables)

    def solve(self, mass, more, convex, b, tolerance, max_iterations, eps):
        """With masses alone, for products are zero."""
        kept[2](self, mass, more, convex, b, tolerance, 1, eps)
        A = diags(np.repeat(mass[:, 0], 3)) + (0 * eye(b.size) if more is None else more)
        free, x = np.flatnonzero(np.repeat(self.free.to_numpy(), 3)), np.zeros(b.size)
        x[free] = spsolve(A.tocsc()[free][:, free], b.ravel()[free])
        return x.reshape(b.shape), 0.0, 1, None

    def run(self):
        """Once, and where it began is the solution."""
        numbers = self._always | self.potential.sizes() | dict(rounding=0.0, most=1.0)
        for part in (self._trial, self._residual, self._update, *(self._steps or ())):
            if part:
                part(1, **numbers)
        self.potential.launch("energy", lanes=False)
        self.potential.launch("forces")
        self.state[:, PHASE] = DONE

    kept = Launch._launch, Launch._compile, DeviceCG.__call__, Rounds.advance
    Launch._launch, Launch._compile, DeviceCG.__call__, Rounds.advance = launch, _stop, solve, run
    try:
        yield
    finally:
        Launch._launch, Launch._compile, DeviceCG.__call__, Rounds.advance = kept


class _Traced(Exception):
    pass


def _stop(*_):
    raise _Traced


def first_step_and_gradient(material, solver: str, order: int, precision: str) -> None:
    mesh = ds.TetrahedralMesh.create_box(2, 0.5)
    mesh = mesh.quadratic() if order == 2 else mesh
    scene = ds.Scene(mesh, material, terms=[ds.Gravity()], fixed="xmin", precision=precision)
    rollout = ds.Rollout(SOLVERS[solver](scene), 1)
    frames = rollout.forward()
    rollout.vjp(frames, positions=np.ones_like(frames.positions))


def sizes(material, solver: str, order: int, precision: str = "f64") -> dict:
    """Variables of its kernels by name."""
    found = {}
    with traced_alone(found), suppress(FloatingPointError):  # of a solve that has nothing to solve
        first_step_and_gradient(material, solver, order, precision)
    return found


def main() -> None:
    ds.init()
    for name in sys.argv[1:] or LAWS:
        for solver in SOLVERS:
            for order in (1, 2):
                for precision in ("f32", "f64"):
                    before = time.process_time()
                    first_step_and_gradient(LAWS[name], solver, order, precision)
                    seconds = time.process_time() - before
                    print(f"{name:24s} {solver} order {order} {precision}: {seconds:6.1f} s", flush=True)


if __name__ == "__main__":
    main()
