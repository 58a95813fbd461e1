"""Identify Young's modulus (and Poisson's ratio) of a body from its motion, through PyTorch.

Three scenes, from hard to easy: (a) the seeds' falling cube, in log E, with a scaled loss over all frames, Adam; (b) a cube
held at one face that sags, L-BFGS; (c) the same for E and nu together. As the seeds write (a), with Adam on E in pascals and
the last frame only, it cannot work: the gradient is 4e-11, Adam adds 1e-8 to what it divides by, and the loss of the last
frame alone rises before it falls on the way from 2e5 to 8e4.

    python examples/identify/identify_torch.py

Pictures of all three go to output/, written while they run.
"""

from pathlib import Path

import torch

import diffsim_ti as ds
from diffsim_ti import verify
from diffsim_ti.optimization import Optimization
from diffsim_ti.optimization_picture import OptimizationPicture

TRUE_E, TRUE_NU = 8e4, 0.4


class LogModuli(torch.nn.Module):
    """E = exp(log_E) and nu = 0.49 sigmoid(raw_nu) stay in range whatever an optimiser does."""

    def __init__(self, E: float, nu: float, learn_nu: bool = False):
        super().__init__()
        self.log_E = torch.nn.Parameter(torch.tensor(E, dtype=torch.float64).log())
        self.raw_nu = torch.nn.Parameter(
            torch.logit(torch.tensor(nu / 0.49, dtype=torch.float64)), requires_grad=learn_nu
        )

    @property
    def E(self):
        return self.log_E.exp()

    @property
    def nu(self):
        return 0.49 * torch.sigmoid(self.raw_nu)

    def forward(self) -> dict:
        """What a rollout takes."""
        return dict(youngs_modulus=self.E, poissons_ratio=self.nu)


def falling_or_held(held: bool) -> ds.Rollout:
    """A fifth of a second of a cube that falls on a floor, or that hangs from one of its faces."""
    mesh = ds.TetrahedralMesh.create_cube(resolution=4, size=0.5)
    terms = [ds.Gravity(-9.8), ds.Drag(2.0)]
    if not held:
        terms.append(ds.Ground(height=-0.01, stiffness=1e4, width=0.01))
    law, fixed = ds.StableNeoHookean(TRUE_E, TRUE_NU), "xmin" if held else None
    scene = ds.Scene(mesh, law, terms=terms, fixed=fixed, precision="f64")
    return ds.Rollout(ds.SemiImplicitSolver(scene, dt=0.01, substeps=12), 20, save_every=1)


def identify(name, held, learn_nu, make_optimizer, iterations, folder, start=(2e5, TRUE_NU)) -> dict:
    """Recover the material from the motion of a cube that carries the true one."""
    rollout = falling_or_held(held)
    mesh = rollout.scene.mesh
    with torch.no_grad():
        target = ds.rollout_frames(rollout, **LogModuli(TRUE_E, TRUE_NU)()).displacements
    material = LogModuli(*start, learn_nu=learn_nu)
    size = (target - target.mean(1, keepdim=True)).square().mean()
    end = mesh.vertices + target[-1].numpy()
    picture = OptimizationPicture(
        mesh,
        end,
        folder and Path(folder) / f"identify_{name}.png",
        5.0 if folder else None,
        truth={"E [Pa]": TRUE_E} | ({"nu": TRUE_NU} if learn_nu else {}),
    )
    seen = {}

    def loss():
        u = ds.rollout_frames(rollout, **material()).displacements
        seen.update(E=material.E.item(), nu=material.nu.item(), u=u[-1].detach().numpy())
        return (u - target).square().mean() / size

    def note(value):
        picture.add(value, {"E [Pa]": seen["E"]} | ({"nu": seen["nu"]} if learn_nu else {}), mesh.vertices + seen["u"])

    optimization = Optimization(
        material,
        make_optimizer([p for p in material.parameters() if p.requires_grad]),
        mesh,
        folder and Path(folder) / f"identify_{name}.state",
    )
    optimization.run(loss, iterations, note)
    optimization.restore_best()
    result = dict(
        E=material.E.item(),
        E_error=abs(material.E.item() / TRUE_E - 1),
        loss=optimization.best_loss,
        iterations=iterations,
        seconds=optimization.seconds,
    )
    if learn_nu:
        result |= dict(nu=material.nu.item(), nu_error=abs(material.nu.item() / TRUE_NU - 1))
    print(f"{name}: " + ", ".join(f"{key} {value:.5g}" for key, value in result.items()))
    told = verify.identifiability(rollout, ["youngs_modulus", "density"])
    print(f"{name}: with E and density both free, directions not seen: {told.num_singular} of 2\n{told}")
    result["unseen"] = told.num_singular
    if folder:
        picture.save()
    return result


def lbfgs(parameters):
    tolerances = dict(tolerance_grad=1e-14, tolerance_change=1e-16)
    return torch.optim.LBFGS(parameters, max_iter=4, line_search_fn="strong_wolfe", **tolerances)


def main(folder="output", adam_iterations: int = 60) -> dict:
    if folder:
        Path(folder).mkdir(exist_ok=True)
    return {
        "falling": identify("falling", False, False, lambda p: torch.optim.Adam(p, lr=0.08), adam_iterations, folder),
        "sagging": identify("sagging", True, False, lbfgs, 4, folder),
        "both": identify("both", True, True, lbfgs, 8, folder, start=(2e5, 0.25)),
    }


if __name__ == "__main__":
    main()
