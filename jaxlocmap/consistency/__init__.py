"""Can the covariance be believed? Statistics of normalised errors, what they say in words, and a report for any filter.

`judge` takes the poses and covariances of anybody's filter. The rest is what it, and the studies of simulated runs, are
made of.
"""

from jaxlocmap.consistency.innovations import Innovations
from jaxlocmap.consistency.judge import judge
from jaxlocmap.consistency.report import (
    AXES,
    Basis,
    PoseMeans,
    by_component,
    gate_verdict,
    pose_fields,
    readable,
    share_in_band,
    verdict,
)
from jaxlocmap.consistency.statistics import (
    COVERAGE_LEVELS,
    POSE_DIMENSION,
    WITHIN_TWO_SIGMA,
    Mean,
    PoseScore,
    binomial_interval,
    chi2_band,
    chi2_quantile,
    correlation_time,
    mean_lag_one,
    mean_over_runs,
    mean_over_time,
    nees,
    pose_error,
    ratio,
    score_pose,
    student_t,
    whiten,
)

__all__ = [
    "AXES",
    "COVERAGE_LEVELS",
    "POSE_DIMENSION",
    "WITHIN_TWO_SIGMA",
    "Basis",
    "Innovations",
    "Mean",
    "PoseMeans",
    "PoseScore",
    "binomial_interval",
    "by_component",
    "chi2_band",
    "chi2_quantile",
    "correlation_time",
    "gate_verdict",
    "judge",
    "mean_lag_one",
    "mean_over_runs",
    "mean_over_time",
    "nees",
    "pose_error",
    "pose_fields",
    "ratio",
    "readable",
    "score_pose",
    "share_in_band",
    "student_t",
    "verdict",
    "whiten",
]
