"""Can the covariance be believed? Statistics of normalised errors, what they say in words, and a report for any filter.

`judge` takes the poses and covariances of anybody's filter. The rest is what it, and the studies of simulated runs, are
made of.
"""

from jaxlocmap.consistency.innovations import Innovations
from jaxlocmap.consistency.judge import judge
from jaxlocmap.consistency.means import (
    Mean,
    binomial_interval,
    correlation_time,
    mean_lag_one,
    mean_over_runs,
    mean_over_time,
    ratio,
    student_t,
)
from jaxlocmap.consistency.report import AXES, PoseMeans, by_component, pose_fields, share_in_band
from jaxlocmap.consistency.statistics import (
    COVERAGE_LEVELS,
    WITHIN_TWO_SIGMA,
    PoseScore,
    chi2_band,
    chi2_quantile,
    nees,
    pose_error,
    score_pose,
    whiten,
)
from jaxlocmap.consistency.verdict import Basis, gate_verdict, readable, verdict

__all__ = [
    "AXES",
    "COVERAGE_LEVELS",
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
