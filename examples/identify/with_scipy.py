"""SciPy's minimisers on a rollout: stiffness of four slabs of a beam from how it hangs, by L-BFGS-B and by Newton-CG.

SciPy asks for functions of a vector. `Rollout.forward` and `vjp` give the loss and its gradient; Newton-CG gets products
with the Hessian from `verify.gauss_newton_product`, by a tangent and a reverse sweep; the curvature of frames is left out.
Bounds and logarithms are by hand here. `ds.identify` does all of this in one call, and says how far to trust a number.

    python examples/identify/with_scipy.py
"""

import numpy as np
from scipy.optimize import minimize

import diffsim_ti as ds
from diffsim_ti.verify import gauss_newton_product

SLABS, NOISE = 4, 2e-5  # [m]
TRUE_E = 1e5 * np.array([2.0, 1.0, 3.0, 1.5])  # [Pa], from the wall outwards
GUESS = 1.5e5  # [Pa]


class Loss:
    """Half the mean square of the misfit over the noise, of the logarithms of moduli; it counts what SciPy asks for."""

    def __init__(self, rollout: ds.Rollout, slab: np.ndarray, seen: np.ndarray):
        self.rollout, self.slab, self.seen = rollout, slab, seen
        self.weight = 1 / (NOISE**2 * seen.size)  # Newton-CG solves the more roughly the larger the gradient is
        self.runs = self.sweeps = 0
        self._at = None

    def frames(self, p: np.ndarray) -> ds.Frames:
        """The run for p; SciPy asks for value, gradient and products at one place after another."""
        if self._at is None or not np.array_equal(self._at, p):
            self.runs += 1
            self._at, self._frames = p.copy(), self.rollout.forward(youngs_modulus=np.exp(p)[self.slab])
        return self._frames

    def value_and_gradient(self, p: np.ndarray) -> tuple[float, np.ndarray]:
        frames = self.frames(p)
        misfit = self.weight * (frames.positions - self.seen)
        by_E = self.rollout.vjp(frames, positions=misfit)["youngs_modulus"]
        self.sweeps += 1
        value = 0.5 * float((misfit * (frames.positions - self.seen)).sum())
        return value, np.exp(p) * np.bincount(self.slab, by_E, SLABS)

    def product(self, p: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """The Gauss-Newton Hessian times a direction."""
        frames, E = self.frames(p), np.exp(p)
        change = {"youngs_modulus": (E * direction)[self.slab]}
        by_E = gauss_newton_product(self.rollout, frames, change, weight=self.weight)["youngs_modulus"]
        self.sweeps += 2
        return E * np.bincount(self.slab, by_E, SLABS)


def main() -> dict:
    """Returns for each method the moduli found [Pa], forward runs and sweeps."""
    mesh = ds.TetrahedralMesh.create_box((9, 2, 2), size=(1.2, 0.2, 0.2), pattern="five")
    slab = np.minimum((mesh.centroids[:, 0] / 1.2 * SLABS).astype(int), SLABS - 1)
    material = ds.StableNeoHookean(np.full(mesh.num_tetrahedra, GUESS), 0.3)
    scene = ds.Scene(mesh, material, density=300.0, terms=[ds.Gravity()], fixed="xmin", precision="f64")
    rollout = ds.Rollout(ds.StaticSolver(scene), 1, gradients=["youngs_modulus"])
    seen = rollout.forward(youngs_modulus=TRUE_E[slab]).positions
    seen = seen + NOISE * np.random.default_rng(0).standard_normal(seen.shape)
    start, found = np.full(SLABS, np.log(GUESS)), {}
    for method in ("L-BFGS-B", "Newton-CG"):
        loss = Loss(rollout, slab, seen)
        more = (
            dict(bounds=[(np.log(2e4), np.log(2e6))] * SLABS)
            if method == "L-BFGS-B"
            else dict(hessp=loss.product, options=dict(xtol=1e-8))
        )
        result = minimize(loss.value_and_gradient, start, jac=True, method=method, **more)
        E = np.exp(result.x)
        worst = float(np.abs(E / TRUE_E - 1).max())
        found[method] = dict(E=E, worst=worst, iterations=int(result.nit), runs=loss.runs, sweeps=loss.sweeps)
        print(
            f"{method}: E = {', '.join(f'{x:.3g}' for x in E)} Pa, at most {100 * worst:.2g} % off, "
            f"{result.nit} iterations, {loss.runs} runs, {loss.sweeps} sweeps"
        )
    return found


if __name__ == "__main__":
    ds.init(precision="f64")
    main()
