"""What an identification found and how well: estimates, intervals, what the data do not see, a test of the residuals."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from diffsim_ti.identification.problem import Problem


@dataclass
class Information:
    """What the data tell of the free variables t: Fisher matrix J^T J, and with the prior their covariance.

    eigenvalues of J^T J, smallest first; directions[k]: shape (variables,), of unit length. Along it t is known to
    1 / sqrt(eigenvalues[k]) from the data (Cramer-Rao). Those whose eigenvalue is below 1, a factor of e or more for
    logarithms, are `unseen`. Bates, Watts, Nonlinear Regression Analysis, 1988, ch. 2, doi:10.1002/9780470316757.
    """

    labels: list[str]
    eigenvalues: np.ndarray
    directions: np.ndarray
    covariance: np.ndarray  # of t
    seen_share: float  # trace of what the data settle, of the variables

    @classmethod
    def of(cls, labels, J: np.ndarray, prior: np.ndarray) -> "Information":
        """From the Jacobian of residuals and the prior's Hessian."""
        _, sizes, directions = np.linalg.svd(J, full_matrices=True) if len(J) < J.shape[1] else np.linalg.svd(J, False)
        eigenvalues = np.zeros(J.shape[1])
        eigenvalues[: len(sizes)] = sizes**2
        if not prior.any():  # by singular values, which keep all digits
            least = 1e-26 * max(eigenvalues.max(initial=0.0), 1e-270)
            covariance = (directions.T / np.maximum(eigenvalues, least)) @ directions
        else:
            values, vectors = np.linalg.eigh(J.T @ J + prior)
            covariance = (vectors / np.maximum(values, 1e-26 * values[-1])) @ vectors.T
        share = float(np.trace(J @ covariance @ J.T)) if len(J) < J.shape[1] else float(np.sum((J.T @ J) * covariance))
        return cls(labels, eigenvalues[::-1], directions[::-1], covariance, share)

    @property
    def deviations(self) -> np.ndarray:
        """Standard deviation of each t."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def unseen(self) -> list[dict[str, float]]:
        """Directions {number: its part} that the data leave open."""
        return [
            {name: float(x) for name, x in zip(self.labels, d) if abs(x) > 0.05}
            for value, d in zip(self.eigenvalues, self.directions)
            if value < 1
        ]


@dataclass
class Identification:
    """What `identify` returns.

    estimates: {unknown: number or array}; covariance: of the numbers, in the order of `labels`, to first order;
    standard_errors, intervals (95 %, through the free variables): as estimates; unseen: see Information;
    chi_square, degrees, p_value: of the residuals, whose sum of squares is chi^2 distributed if model and noise are right;
    iterations: a dict each; simulations: forward, tangent and reverse runs; stopped: why, converged: whether because
    of the tolerance; information: what the data tell; state: for `resume`.
    inputs: of each experiment, for rollout.forward(**inputs[k]). Covariance and what follows from it are None where
    it was not asked for (many unknowns).
    """

    estimates: dict
    labels: list[str]
    numbers: np.ndarray
    residuals: np.ndarray
    chi_square: float
    degrees: float
    simulations: int
    stopped: str
    converged: bool
    iterations: list[dict]
    inputs: list[dict]
    state: dict = field(repr=False)
    information: Information | None = None
    covariance: np.ndarray | None = None
    standard_errors: dict | None = None
    intervals: dict | None = None

    @property
    def p_value(self) -> float:
        """Chance of residuals at least so far from what the noise explains, on either side."""
        from scipy.special import chdtr, chdtrc

        return float(2 * min(chdtrc(self.degrees, self.chi_square), chdtr(self.degrees, self.chi_square)))

    @property
    def residuals_fit(self) -> bool:
        """Whether residuals are no more than noise of the given size, at a level of 1 %."""
        return self.p_value >= 0.01

    @property
    def unseen(self) -> list[dict[str, float]]:
        """Directions of free variables that the data do not tell."""
        return [] if self.information is None else self.information.unseen

    def __str__(self) -> str:
        lines = []
        errors = (
            None
            if self.intervals is None
            else np.concatenate([np.atleast_1d(x) for x in self.standard_errors.values()])
        )
        ends = None if self.intervals is None else np.concatenate([np.atleast_2d(x) for x in self.intervals.values()])
        for i, (label, x) in enumerate(zip(self.labels, self.numbers)):
            more = "" if errors is None else f" +- {errors[i]:.2g}, 95 % in [{ends[i, 0]:.6g}, {ends[i, 1]:.6g}]"
            lines.append(f"{label} = {x:.6g}{more}")
        for direction in self.unseen:
            lines.append("NOT SEEN: " + ", ".join(f"{x:+.2f} {name}" for name, x in direction.items()))
        verdict = (
            "as the noise explains" if self.residuals_fit else "NOT explained by the noise: look at model and noise"
        )
        lines.append(
            f"chi^2 {self.chi_square:.4g} of {self.degrees:.4g} degrees (p = {self.p_value:.2g}), {verdict}; "
            f"{len(self.iterations)} iterations, {self.simulations} simulations; {self.stopped}"
        )
        return "\n".join(lines)


def described(problem: "Problem", t: np.ndarray, found: Information) -> dict:
    """Covariance, standard errors and intervals of the numbers, from the information on the free variables."""
    slopes = np.concatenate([free.slopes(t[part]) for free, part in zip(problem.unknowns, problem.parts)])
    errors, intervals = {}, {}
    with np.errstate(over="ignore"):
        for free, part in zip(problem.unknowns, problem.parts):
            s = found.deviations[part]
            ends = np.stack([free.numbers(t[part] - 1.959964 * s), free.numbers(t[part] + 1.959964 * s)], -1)
            error = np.abs(slopes[part]) * s
            errors[free.label] = float(error[0]) if free.size == 1 else error
            intervals[free.label] = tuple(ends[0].tolist()) if free.size == 1 else ends
    covariance = slopes[:, None] * found.covariance * slopes
    return dict(information=found, covariance=covariance, standard_errors=errors, intervals=intervals)
