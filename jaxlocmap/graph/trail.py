"""What a filter that matches scans on submaps leaves behind: a chain of submaps, and where each scan lies in one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxlocmap.matching.submaps import MatchReport
from jaxlocmap.se2 import POSE


class Trail(NamedTuple):
    """N submaps in the order of time, and S scans. NumPy, float64."""

    edge: np.ndarray  # (N - 1, 3) m, m, rad: each anchor but the first, in the frame of the one before
    edge_cov: np.ndarray  # (N - 1, 3, 3)
    submap: np.ndarray  # (S,) int: the one in whose frame a scan's place is; -1 before the first
    place: np.ndarray  # (S, 3) m, m, rad of the robot at the scan, in the frame of that submap's anchor
    place_cov: np.ndarray  # (S, 3, 3)
    drawn: np.ndarray  # (S,) bool: the scan is in the map of the submap
    begun: np.ndarray  # (N,) int: the scan at which each submap begins

    @property
    def submaps(self) -> int:
        """How many there are."""
        return len(self.begun)


def trail_of(report: MatchReport) -> Trail:
    """The trail of a run, from what its matches report, (T,) steps; those without a scan due are left out.

    A submap that was never matched on, because the next ones were begun anew, is none.
    """
    report = MatchReport(*(np.asarray(x) if not isinstance(x, tuple) else x for x in report))
    due = np.flatnonzero(report.due)
    number, anew, finished = (np.asarray(x)[due] for x in (report.submap, report.anew, report.finished))
    place, place_cov = (np.asarray(x, np.float64)[due] for x in report.relative)
    edge_mean, edge_cov = (np.asarray(x, np.float64)[due] for x in report.edge)
    drawn = (np.asarray(report.accepted) | np.asarray(report.anew))[due]
    begins = np.asarray(report.begun)[due]
    submap = np.full(len(due), -1)
    edges: list[np.ndarray] = []
    covs: list[np.ndarray] = []
    begun: list[int] = []
    current, younger = -1, 0
    places, place_covs = np.zeros((len(due), POSE)), np.zeros((len(due), POSE, POSE))
    for s in range(len(due)):
        if anew[s]:
            if current >= 0:
                edges.append(place[s])
                covs.append(place_cov[s])
            current += 1
            begun.append(s)
            submap[s] = current
            continue
        if current < 0:
            continue
        submap[s], places[s], place_covs[s] = current, place[s], place_cov[s]
        if finished[s]:
            edges.append(edge_mean[s])
            covs.append(edge_cov[s])
            current += 1
            begun.append(younger)
        if begins[s]:
            younger = s
    del number
    return Trail(
        np.array(edges).reshape(-1, POSE),
        np.array(covs).reshape(-1, POSE, POSE),
        submap,
        places,
        place_covs,
        drawn & (submap >= 0),
        np.array(begun, int),
    )
