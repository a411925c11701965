"""Pose graphs: a chain of odometry, loops between its poses, robust kernels, solvers and covariances."""

from jaxlocmap.graph.covariance import marginals, relative_covariances
from jaxlocmap.graph.factors import Graph, chi2, dead_reckoning, errors, stack
from jaxlocmap.graph.kernels import Kernel
from jaxlocmap.graph.scales import Scales, pose_nll, scaled, tune_scales
from jaxlocmap.graph.solver import Solution, faults, solve
from jaxlocmap.graph.start import chordal

__all__ = [
    "Graph",
    "Kernel",
    "Scales",
    "Solution",
    "chi2",
    "chordal",
    "dead_reckoning",
    "errors",
    "faults",
    "marginals",
    "pose_nll",
    "relative_covariances",
    "scaled",
    "solve",
    "stack",
    "tune_scales",
]
