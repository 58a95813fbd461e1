"""PyTorch interface: contact with a floor as a torch formula, and as the core's term with the same numbers."""

from diffsim_ti.common.public import Public
from diffsim_ti.terms import Ground
from diffsim_ti.terms.obstacles import barrier
from diffsim_ti.torch_bridge.autograd import torch


class DifferentiableBarrierContact(metaclass=Public):
    """Smooth ground contact by a barrier; a plain torch formula, differentiable as often as wanted.

    b(d) = -kappa (d - d_hat)^2 log(d / d_hat) for d < d_hat [J], zero beyond, C2; below d_hat / 1000 its Taylor polynomial.
    friction: Coulomb's coefficient mu; a vertex pressed with N and sliding with velocity t is held back by
    mu N f(|t| / eps) t / |t|, f(y) = 2 y - y^2 for y < 1, 1 beyond, eps = friction_speed [m/s]; 0 compiles none.
    `DifferentiableBarrierContact(barrier_stiffness=1e4, barrier_width=0.01)`, or the seeds' second spelling
    `(ground_height=..., barrier_stiffness=..., barrier_distance=...)`. Attributes kappa, d_hat, ground_height, friction,
    friction_speed; each may be a tensor with gradient.
    """

    def __init__(
        self,
        barrier_stiffness: float | torch.Tensor = 1e4,
        barrier_width: float | torch.Tensor | None = None,
        *,
        ground_height: float = 0.0,
        barrier_distance: float | torch.Tensor | None = None,
        friction: float | torch.Tensor = 0.0,
        friction_speed: float | torch.Tensor = 1e-3,
    ):
        given = [w for w in (barrier_width, barrier_distance) if w is not None]
        if len(given) > 1:
            raise ValueError("barrier_width and barrier_distance are two spellings of one number: give one")
        self.kappa, self.d_hat, self.ground_height = barrier_stiffness, given[0] if given else 0.01, ground_height
        self.friction, self.friction_speed = friction, friction_speed
        self.term()  # checks the numbers

    def term(self) -> Ground:
        """The core's term with the same numbers."""
        numbers = self.ground_height, self.kappa, self.d_hat, self.friction, self.friction_speed
        height, kappa, width, friction, speed = (float(torch.as_tensor(x).detach()) for x in numbers)
        return Ground(height, kappa, width, friction=friction, friction_speed=speed)

    def tensors(self, like: torch.Tensor) -> dict[str, torch.Tensor]:
        """The term's inputs, in the graph."""
        numbers = dict(ground_height=self.ground_height, barrier_stiffness=self.kappa, barrier_width=self.d_hat)
        if self.term().has_friction:
            numbers |= dict(friction=self.friction, friction_speed=self.friction_speed)
        out = {name: torch.as_tensor(x, dtype=like.dtype, device=like.device) for name, x in numbers.items()}
        if not isinstance(self.ground_height, torch.Tensor):  # a place, which may be far from the origin
            out["ground_height"] = torch.tensor(self.ground_height, dtype=torch.float64, device=like.device)
        elif self.ground_height.dtype == torch.float64:
            out["ground_height"] = self.ground_height.to(like.device)
        return out

    def barrier_potential(self, d: torch.Tensor) -> torch.Tensor:
        """Energy [J] at distances d [m], elementwise."""
        s = d / self.d_hat
        safe = s.clamp(barrier.CROSSOVER, 1.0)
        t = torch.minimum(s - barrier.CROSSOVER, torch.zeros_like(s))
        beta = barrier.value_within(safe, torch.log(safe)) + t * (barrier.SLOPE + t * barrier.CURVATURE / 2)
        return self.kappa * self.d_hat**2 * beta

    def ground_contact_force(self, positions: torch.Tensor, velocities: torch.Tensor | None = None) -> torch.Tensor:
        """Forces [N], shape (n, 3): along y, minus the slope of the barrier; with velocities [m/s] also friction."""
        inputs = (positions, velocities, self.ground_height, self.kappa, self.d_hat, self.friction, self.friction_speed)
        wanted = torch.is_grad_enabled() and any(isinstance(x, torch.Tensor) and x.requires_grad for x in inputs)
        with torch.enable_grad():
            d = positions[:, 1] - self.ground_height
            d = d if d.requires_grad else d.detach().requires_grad_()
            (slope,) = torch.autograd.grad(self.barrier_potential(d).sum(), d, create_graph=wanted)
        slope = slope if wanted else slope.detach()
        zero = torch.zeros_like(slope)
        pushed = torch.stack([zero, -slope, zero], 1)
        return pushed if velocities is None or not self.term().has_friction else pushed + self._rub(-slope, velocities)

    def _rub(self, push: torch.Tensor, velocities: torch.Tensor) -> torch.Tensor:
        """Friction [N] for normal forces [N], shape (n,)."""
        t = velocities * velocities.new_tensor([1.0, 0.0, 1.0])
        moves = (t**2).sum(1) > 0
        speed = torch.where(moves[:, None], t, torch.ones_like(t)).norm(dim=1)  # whose slope at 0 is not finite
        slow = torch.where(moves, speed, torch.zeros_like(speed)).clamp(max=self.friction_speed) / self.friction_speed
        share = torch.where(slow < 1, (2 - slow) / self.friction_speed, 1 / speed)
        return -(self.friction * push.clamp(min=0) * share)[:, None] * t

    compute_forces = ground_contact_force
