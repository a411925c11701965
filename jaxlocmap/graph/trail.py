"""What a filter that matches scans on submaps leaves behind: a chain of submaps, and where each scan lies in one."""

from __future__ import annotations

from typing import NamedTuple

import jax
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

    def scaled(self, scale: float) -> Trail:
        """The same with standard deviations times a scale."""
        return self._replace(edge_cov=self.edge_cov * scale**2, place_cov=self.place_cov * scale**2)

    @property
    def middle(self) -> np.ndarray:
        """(N,) int: the scan in the middle of each submap's own; the one at which it began, if it has none."""
        own = [np.flatnonzero(self.submap == k) for k in range(self.submaps)]
        return np.array(
            [scans[len(scans) // 2] if len(scans) else at for scans, at in zip(own, self.begun, strict=True)]
        )


def trail_of(report: MatchReport) -> Trail:
    """The trail of a run, from what its matches report, (T,) steps; those without a scan due are left out.

    A submap that nothing was matched on, because the next one was begun anew, is left out too.
    """
    due = np.flatnonzero(report.due)

    def at_due(x: jax.Array) -> np.ndarray:
        return np.asarray(x)[due]

    anew, begins, finished = (at_due(x) for x in (report.anew, report.begun, report.finished))
    place, place_cov, edge, edge_cov = (at_due(x).astype(np.float64) for x in (*report.relative, *report.edge))
    submap = np.full(len(due), -1)
    edges, begun, younger = [], [], 0
    for s in range(len(due)):
        if anew[s]:  # at the pose of this scan, as far as the submap before is concerned
            edges.append((place[s], place_cov[s]))
            begun.append(s)
        submap[s] = len(begun) - 1
        if finished[s]:
            edges.append((edge[s], edge_cov[s]))
            begun.append(younger)
        if begins[s]:
            younger = s
    own = anew | (submap < 0)  # the anchor itself
    return Trail(
        edge=np.array([mean for mean, _ in edges[1:]]).reshape(-1, POSE),
        edge_cov=np.array([cov for _, cov in edges[1:]]).reshape(-1, POSE, POSE),
        submap=submap,
        place=np.where(own[:, None], 0, place),
        place_cov=np.where(own[:, None, None], 0, place_cov),
        drawn=(at_due(report.accepted) | anew) & (submap >= 0),
        begun=np.array(begun, int),
    )
