"""Speed against accuracy, stability, growth of gradients, and advice: what a scene needs and what that costs."""

from diffsim_ti.study.problem import Problem
from diffsim_ti.study.problems import PROBLEMS, problem
from diffsim_ti.study.recommend import Recommendation, recommend
from diffsim_ti.study.work_precision import Chart, Point, chart, pareto_front

__all__ = ["Chart", "PROBLEMS", "Point", "Problem", "Recommendation", "chart", "pareto_front", "problem", "recommend"]
