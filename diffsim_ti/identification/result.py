"""What an identification found and how well: estimates, intervals, what the data do not see, a test of the residuals;
and a picture of it: data and fit, residuals over the noise, numbers with their intervals."""

import textwrap
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from diffsim_ti.common.brief import brief_fields
from diffsim_ti.common.public import Public
from diffsim_ti.identification.measurements import Measurement
from diffsim_ti.identification.problem import Problem
from diffsim_ti.rollout import Frames


@dataclass(repr=False)
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

    __repr__ = brief_fields

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


@dataclass(repr=False)
class MeshCheck:
    """How far estimates move on a finer mesh of the same body, or `reason`: why that is not known.

    estimates: of the same data on the finer mesh; shifts: changes of the free variables, and `in_errors`, over their
    standard errors, in the order of `labels`; chi_square: of the residuals there; simulations: forward runs that it took.
    """

    finer: str = "ten-node tetrahedra of the same mesh"
    estimates: dict | None = None
    numbers: np.ndarray | None = None
    shifts: np.ndarray | None = None
    in_errors: np.ndarray | None = None
    chi_square: float = float("nan")
    simulations: int = 0
    reason: str = ""

    __repr__ = brief_fields

    @property
    def matters(self) -> bool:
        """Whether some estimate moves by more than its standard error."""
        return self.in_errors is not None and bool(np.abs(self.in_errors).max() > 1)

    def moved(self, labels: list[str], numbers: np.ndarray) -> str:
        """The estimate that moves most of its standard error."""
        k = int(np.argmax(np.abs(self.in_errors)))
        return f"{labels[k]} moves to {self.numbers[k]:.4g}, by {abs(self.in_errors[k]):.2g} standard errors"


@dataclass(repr=False)
class Identification(metaclass=Public):
    """What `identify` returns.

    estimates: {unknown: number or array}; covariance: of the numbers, in the order of `labels`, to first order;
    standard_errors: as estimates, what the noise alone makes uncertain; intervals: {unknown: (low, high)}, of 95 %, low and
    high as estimates, through the free variables, widened by what `mesh` found: from the lower end of the lower estimate to
    the upper end of the upper one, with a third of their distance beyond the finer mesh's. They mean nothing where the fit
    does not explain the data: see `headline`.
    chi_square, degrees, p_value: of the residuals, whose sum of squares is chi^2 distributed if model and noise are right;
    iterations: a dict each; simulations: forward, tangent and reverse runs; stopped: why, converged: whether because of the
    tolerance; information: what the data tell; state: for `resume`; starts: where each search began and ended, a dict each,
    of which this is the best; inputs: of each experiment, for rollout.forward(**inputs[k]). Covariance and what follows from
    it are None where it was not asked for.
    Roache 1994, doi:10.1115/1.2910291, on errors from two meshes.
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
    state: dict
    starts: list[dict]
    mesh: MeshCheck
    information: Information | None = None
    covariance: np.ndarray | None = None
    standard_errors: dict | None = None
    intervals: dict | None = None

    @property
    def p_value(self) -> float:
        """Chance of residuals at least so large from the noise alone; 1 where no data are left to test by."""
        from scipy.special import chdtrc

        return float(chdtrc(self.degrees, self.chi_square)) if self.degrees >= 0.5 else 1.0

    @property
    def residuals_fit(self) -> bool:
        """Whether residuals are no more than noise of the given size, at a level of 1 %."""
        return self.p_value >= 0.01

    @property
    def noise_overstated(self) -> bool:
        """Whether residuals are less than noise of the given size makes them, at a level of 1 %."""
        from scipy.special import chdtr

        return self.degrees >= 0.5 and bool(chdtr(self.degrees, self.chi_square) < 0.01)

    @property
    def residual_over_noise(self) -> float:
        """Root mean square of the residuals, in deviations of the noise: about 1 where model and noise are right."""
        return float(np.sqrt(self.chi_square / max(self.degrees, 1.0)))

    @property
    def unseen(self) -> list[dict[str, float]]:
        """Directions of free variables that the data do not determine."""
        return [] if self.information is None else self.information.unseen

    @property
    def headline(self) -> str:
        """What is to be known before the numbers; empty where the search converged and the fit explains the data as noise
        of the given size does, on a mesh that does not matter."""
        said, ratio = [], f"{self.residual_over_noise:.3g}"
        if not self.residuals_fit:
            said.append(
                f"THE FIT DOES NOT EXPLAIN THE DATA: residuals are {ratio} times the noise (p = {self.p_value:.2g}). "
                f"The numbers may be far off, and their intervals mean nothing. {self._remedy()}"
            )
        elif self.noise_overstated:
            said.append(
                f"Residuals are {ratio} of the stated noise, less than it explains: it was overstated, or the data are "
                "synthetic and have no noise. Intervals are those of the stated noise."
            )
        if not self.converged:
            said.append(f"NOT CONVERGED: {self.stopped}.")
        others = self.as_good
        if others:
            said.append(
                f"NOT UNIQUE: another start explains the data as well, with {others[0]}. The intervals hold one of several "
                "solutions: measure more."
            )
        if self.mesh.matters and self.residuals_fit:
            said.append(
                f"THE MESH MATTERS: on {self.mesh.finer} {self.mesh.moved(self.labels, self.numbers)}. Intervals are "
                "widened to hold both: take the finer mesh."
            )
            if self.mesh.chi_square > 4 * max(self.chi_square, self.degrees):
                said.append(
                    f"It fits worse there (chi^2 {self.mesh.chi_square:.4g}): data that this very mesh computed do not "
                    "contain its error, so pass check_mesh=False."
                )
        return " ".join(said)

    def _remedy(self) -> str:
        mesh, count = self.mesh, len(self.starts)
        if mesh.chi_square < 0.5 * self.chi_square:
            return (
                f"On {mesh.finer} chi^2 falls to {mesh.chi_square:.4g}, where {mesh.moved(self.labels, self.numbers)}: take "
                "a finer mesh."
            )
        if count > 1:
            return f"It is the best of {count} starts: check the model, the mesh and the noise."
        return "It may be a local minimum: try other starts (starts=5); or check the model, the mesh and the noise."

    @property
    def as_good(self) -> list[str]:
        """Numbers that other starts found, further off than the intervals, whose fit is as good at a level of 5 %."""
        best, out = min((row["cost"] for row in self.starts), default=0.0), []
        for row in self.starts:
            if self.intervals is None or row["cost"] > best + 3.84:
                continue
            low, high = ends(self.intervals)
            wide = high - low
            if np.any((row["numbers"] < low - wide) | (row["numbers"] > high + wide)):
                out.append(", ".join(f"{label} {x:.5g}" for label, x in list(zip(self.labels, row["numbers"]))[:4]))
        return out if self.residuals_fit else []

    def __str__(self) -> str:
        lines = [self.headline] if self.headline else []
        if self.intervals is not None:
            errors = np.concatenate([np.atleast_1d(x) for x in self.standard_errors.values()])
            low, high = ends(self.intervals)
        for i, (label, x) in enumerate(zip(self.labels, self.numbers)):
            more = "" if self.intervals is None else f" +- {errors[i]:.2g}, 95 % in [{low[i]:.6g}, {high[i]:.6g}]"
            lines.append(f"{label} = {x:.6g}{more if self.residuals_fit else ' (without an interval)'}")
        for direction in self.unseen:
            lines.append("NOT SEEN: " + ", ".join(f"{x:+.2f} {name}" for name, x in direction.items()))
        verdict = "NOT explained by the noise" if not self.residuals_fit else "as the noise explains"
        verdict = "less than the noise explains" if self.noise_overstated else verdict
        test = f" (p = {self.p_value:.2g}), {verdict}" if self.degrees >= 0.5 else ": none left to test the fit by"
        count = f", best of {len(self.starts)} starts" if len(self.starts) > 1 else ""
        lines.append(
            f"chi^2 {self.chi_square:.4g} of {self.degrees:.4g} degrees{test}; "
            f"{len(self.iterations)} iterations, {self.simulations} simulations{count}; {self.stopped}"
        )
        if self.mesh.reason:
            lines.append(f"The mesh's error is not in the intervals: {self.mesh.reason}.")
        elif not self.mesh.matters:
            lines.append(f"On {self.mesh.finer} {self.mesh.moved(self.labels, self.numbers)}.")
        return "\n".join(lines)

    __repr__ = __str__


def ends(intervals: dict) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper ends of all numbers, in their order."""
    return tuple(np.concatenate([np.atleast_1d(pair[k]) for pair in intervals.values()]) for k in (0, 1))


def described(problem: Problem, t: np.ndarray, found: Information, shifts: np.ndarray | float = 0.0) -> dict:
    """Covariance, standard errors and intervals of the numbers, from the information on the free variables and what these
    change by on a finer mesh, from which as much as a third of that may be left."""
    slopes = np.concatenate([free.slopes(t[part]) for free, part in zip(problem.unknowns, problem.parts)])
    errors, intervals, reach = {}, {}, 4 / 3 * shifts + np.zeros(problem.size)
    below, above = (sign * np.maximum(sign * reach, 0) for sign in (-1, 1))
    with np.errstate(over="ignore"):
        for free, part in zip(problem.unknowns, problem.parts):
            s = found.deviations[part]
            far = t[part] + below[part] - 1.959964 * s, t[part] + above[part] + 1.959964 * s
            low, high = np.sort([free.numbers(x) for x in far], axis=0)
            error, single = np.abs(slopes[part]) * s, free.size == 1
            errors[free.label] = float(error[0]) if single else error
            intervals[free.label] = (float(low[0]), float(high[0])) if single else (low, high)
    covariance = slopes[:, None] * found.covariance * slopes
    return dict(information=found, covariance=covariance, standard_errors=errors, intervals=intervals)


def save_picture(
    path: str | Path,
    found: Identification,
    measurement: Measurement,
    frames: Frames,
    at: np.ndarray | None = None,
    at_label: str = "time [s]",
    offset: float | None = None,
) -> None:
    """Write the picture of one experiment's measurement; frames: of the run with the numbers found; at: what the values'
    rows are drawn over, default their times; offset: of these [s], default the estimate of that name, "time_offset"."""
    from matplotlib.figure import Figure

    offset = found.estimates.get("time_offset", 0.0) if offset is None else offset
    r = measurement.residual(frames, float(offset))
    seen = measurement.seen
    times = frames.times if measurement.times is None else measurement.times
    times = times if at is None else at
    t = np.broadcast_to(times.reshape(-1, *[1] * (seen.ndim - 1)), seen.shape)[seen]
    fit = measurement.values[seen] + r * measurement.deviation
    figure = Figure(figsize=(12, 3.6), layout="constrained")
    axes = figure.subplots(1, 3)
    axes[0].plot(t, measurement.values[seen], "o", mfc="none", ms=4, label="data")
    axes[0].plot(t, fit, ".", ms=4, label="fit")
    axes[0].set(xlabel=at_label, ylabel=measurement.output)
    axes[0].legend()
    axes[1].plot(t, r, ".", ms=4)
    axes[1].axhspan(-1.96, 1.96, alpha=0.15)
    axes[1].set(xlabel=at_label, ylabel="residual / noise", title=f"chi² {found.chi_square:.4g} of {found.degrees:.4g}")
    shown = found.intervals and found.residuals_fit
    for i, label in enumerate(found.labels if found.intervals else []):
        low, high = (end[i] / found.numbers[i] for end in ends(found.intervals))
        axes[2].plot(*([low, high], [i, i], "|-") if shown else ([1], [i], "o"))
        axes[2].annotate(
            f"{label} {found.numbers[i]:.5g}", (1, i), xytext=(0, 6), textcoords="offset points", ha="center"
        )
    none = "no intervals: the fit does not explain the data"
    label = "95 % interval over the estimate" if found.residuals_fit else none
    axes[2].set(xlabel=label, yticks=[], ylim=(-0.5, len(found.labels) - 0.3))
    if found.headline:
        figure.suptitle("\n".join(textwrap.wrap(found.headline, 150)), color="tab:red", fontsize=9)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
