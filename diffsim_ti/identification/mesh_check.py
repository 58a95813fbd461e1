"""What a fit owes to its mesh: the same data fitted again with ten-node tetrahedra."""

import warnings

import numpy as np

from diffsim_ti.accuracy.finer import on_ten_nodes, rollout_on_finer
from diffsim_ti.identification.measurements import Measurement
from diffsim_ti.identification.modal_test import ModalTest
from diffsim_ti.identification.problem import Experiment, Problem
from diffsim_ti.identification.result import Information, MeshCheck
from diffsim_ti.identification.search import FAILURES, Search
from diffsim_ti.mesh import TetrahedralMesh

RUNS, USUAL = 12, 5  # on the finer mesh: at most, and usually
# a step that is this share of the standard errors, or of the way from the first estimates, is the last
SETTLED = 0.1, 0.02
LONGEST = 2.0  # change of a free variable in one step
DEAREST, ALWAYS = 3.0, 1e8  # times the work of the fit, or so much (seconds), up to which it is done unasked
SHORTER = 4.0  # times as many explicit steps are stable
# work per tetrahedron and pass, over that of linear ones in explicit steps
TEN_NODES, IMPLICIT, MODES = 5.0, 3000.0, 1000.0


def mesh_check(search: Search, J: np.ndarray, found: Information, asked: bool | None) -> MeshCheck:
    """Fit the data of a search again with ten-node tetrahedra, from its estimates and with its Jacobian J, which Broyden's
    updates carry on: forward runs alone. asked: None where it is to be cheap.

    Dennis, Schnabel, Numerical Methods for Unconstrained Optimization, 1996, ch. 8, doi:10.1137/1.9781611971200.
    """
    if asked is False:
        return MeshCheck(reason="it was not asked for")
    rollouts = search.problem.rollouts
    fit = search.problem.simulations / len(rollouts) * sum(_work(x) for x in rollouts)
    dear = USUAL * sum(_work(x) * TEN_NODES * (SHORTER if _is_explicit(x) else 1.0) for x in rollouts)
    if asked is None and dear > max(DEAREST * fit, ALWAYS):
        often = f"{dear / fit:.2g} times the fit's own time"
        return MeshCheck(reason=f"ten-node tetrahedra would take about {often}; check_mesh=True does it")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what the body is known for already
            fine = _finer(search)
    except ValueError as error:
        return MeshCheck(reason=f"it cannot be had of ten-node tetrahedra ({error})")
    try:
        return _refitted(search, fine, J, found)
    except FAILURES as error:
        return MeshCheck(reason=f"a run with ten-node tetrahedra failed ({type(error).__name__}: {error})")


def _refitted(search: Search, fine: Problem, J: np.ndarray, found: Information) -> MeshCheck:
    first, priors, s = search.point.t, search.priors, found.deviations
    point = fine.run(first)
    while True:
        t, r = point.t, point.residual
        H = J.T @ J + priors.hessian(t)
        step = -np.linalg.solve(H + 1e-3 * np.eye(len(t)), J.T @ r + priors.gradient(t))
        size, way = np.abs(step / s).max(), np.abs((t - first) / s).max()
        if size <= max(SETTLED[0], SETTLED[1] * way):
            break
        if fine.simulations >= RUNS * len(fine.rollouts):
            return MeshCheck(reason=f"estimates on ten-node tetrahedra did not settle in {RUNS} runs")
        step = step * min(1.0, LONGEST / np.abs(step).max())
        point = fine.run(t + step)
        J = J + np.outer(point.residual - r - J @ step, step / (step @ step))
    shifts = t - first
    numbers = dict(estimates=fine.numbers(t), numbers=fine.all_numbers(t), shifts=shifts, in_errors=shifts / s)
    return MeshCheck(**numbers, chi_square=float(r @ r), simulations=fine.simulations)


def _finer(search: Search) -> Problem:
    """The same problem with ten-node tetrahedra. Raises ValueError for what cannot be carried over."""
    problem, rollouts, data = search.problem, [], []
    for k, experiment in enumerate(problem.rollouts):
        if experiment.scene.mesh.order == 2:
            raise ValueError("the mesh has ten-node tetrahedra already; fit the data on a mesh of smaller ones as well")
        if isinstance(experiment, ModalTest):
            fine = ModalTest(on_ten_nodes(experiment.scene), experiment.k)
        else:
            values = {name: x for name, x in problem.inputs(k, search.point.t).items() if name != "time_offset"}
            fine = rollout_on_finer(experiment, TetrahedralMesh.quadratic, values)
        rollouts.append(fine)
        data.append([_carried(m, experiment, fine) for m in problem.data[k]])
    out = Problem(rollouts, data, {free.label: free.unknown for free in problem.unknowns})
    if out.labels != problem.labels:
        raise ValueError("numbers for each vertex are not those of a finer mesh")
    return out


def _carried(m: Measurement, coarse: Experiment, fine: Experiment) -> Measurement:
    """The same measurement on the finer mesh, whose first vertices are those of the coarser one."""
    shapes = [tuple(x.outputs[m.output].shape(x.num_frames)) for x in (coarse, fine)]
    at = m.at
    if shapes[0] != shapes[1]:
        if [shape[1:2] for shape in shapes] != [(x.scene.mesh.num_vertices,) for x in (coarse, fine)]:
            raise ValueError(f"{m.output} has shape {shapes[0]} on the one mesh and {shapes[1]} on the other")
        at = np.arange(coarse.scene.mesh.num_vertices) if at is None else at
    return Measurement(m.output, m.values, m.noise, at, m.times)


def _is_explicit(experiment: Experiment) -> bool:
    return not isinstance(experiment, ModalTest) and experiment.solver.explicit


def _work(experiment: Experiment) -> float:
    size = experiment.scene.mesh.num_tetrahedra
    if isinstance(experiment, ModalTest):
        return MODES * size
    return size * experiment.solver.num_passes(experiment.steps) * (1.0 if _is_explicit(experiment) else IMPLICIT)
