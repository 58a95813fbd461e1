"""Speed against accuracy, stability, growth of gradients, and advice: what a scene needs and what that costs."""

from diffsim_ti.study.growth import Growth, growth
from diffsim_ti.study.problem import Problem
from diffsim_ti.study.problems import PROBLEMS, problem
from diffsim_ti.study.stability_axes import power_limit
from diffsim_ti.study.stability_map import StabilityMap, boundary, stability_map
from diffsim_ti.study.sweep import Settings, Sweep, sweep
from diffsim_ti.study.trials import Recommendation, recommend
from diffsim_ti.study.work_precision import Chart, Point, chart, pareto_front

__all__ = ["Chart", "Growth", "PROBLEMS", "Point", "Problem", "Recommendation", "Settings", "StabilityMap", "Sweep"]
__all__ += ["boundary", "chart", "growth", "pareto_front", "power_limit", "problem", "recommend", "stability_map"]
__all__ += ["sweep"]
