"""Advice: the cheapest solver, step, precision and checkpoints that meet a tolerance, from trial runs and the theory."""

import warnings
from concurrent.futures import Executor

import numpy as np

from diffsim_ti.common.public import public
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.scene import Scene
from diffsim_ti.study.recommendation import Recommendation
from diffsim_ti.study.trials import Trials


@public
def recommend(
    scene: Scene,
    duration: float,
    tolerance: float = 1e-2,
    memory: float | None = None,
    gradients: bool = True,
    budget: float = 20.0,
    frames: int = 8,
    elements: bool = True,
    coarser: TetrahedralMesh | None = None,
    executor: Executor | None = None,
) -> Recommendation:
    """The cheapest way to run `scene` for `duration` [s] with a relative error of motion below `tolerance`.

    The error meant is that of steps and precision on the scene's own mesh: the largest distance of any vertex at any of
    `frames` times over the largest displacement from the start. memory [MB]: most that gradients may keep.
    gradients: whether runs will be differentiated, which is then timed as well.
    budget [s]: wall time of the trials, compiling apart; if the reference of the whole duration would take more, trials
    cover a first part and errors grow with time from there.
    elements: whether linear tetrahedra, patches and ten nodes are compared too, by what the mesh itself makes wrong; the
    advice's `element` is the cheapest that keeps to the tolerance. coarser: a linear mesh of the body with the same
    named sets, to try ten nodes on; None: half the cells of a mesh that `create_box` made.
    executor: any `concurrent.futures.Executor`, which takes a solver at a time, each with the budget, and the elements;
    those near the best are timed again here.

    Raises ValueError for a duration or tolerance that is no such thing, FloatingPointError if nothing meets the tolerance.
    """
    if not (duration > 0 and np.isfinite(duration)):
        raise ValueError(f"duration must be > 0 [s], got {duration:g}")
    if not 0 < tolerance < 1:
        raise ValueError(f"tolerance must lie between 0 and 1, got {tolerance:g}")
    if memory is not None and not memory > 0:
        raise ValueError(f"memory must be > 0 [MB], got {memory:g}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of trials with coarse steps, whose errors are measured
        trials = Trials(scene, duration, tolerance, memory, gradients, budget, frames)
        trials.coarser = coarser
        trials.run(elements, executor)
    return trials.advice()
