"""The comparison of pose graphs with GTSAM, where that is installed (extra `benchmark`)."""

import sys
from pathlib import Path

import numpy as np
import pytest
from test_graph import drawn

from jaxlocmap import graph as pose_graph
from jaxlocmap.logs import write_g2o

pytest.importorskip("gtsam")
sys.path.append(str(Path(__file__).parent.parent / "experiments"))
import graph_compare

pytestmark = pytest.mark.usefixtures("as_a_program", "x64")


def test_false_loops_come_last():
    _, graph = drawn(1, poses=30, loops=10)
    spoiled, true = graph_compare.with_false_loops(graph, np.zeros((30, 3)), 0.2, 0)
    np.testing.assert_array_equal(true, [True] * 10 + [False] * 2)
    np.testing.assert_array_equal(spoiled.loop[:10], graph.loop)


@pytest.mark.slow
def test_small(tmp_path):
    for name in ("input_M3500_g2o.g2o", "CSAIL_P_toro.graph"):
        _, graph = drawn(1, poses=30, loops=10)
        write_g2o(tmp_path / name, graph, np.asarray(pose_graph.dead_reckoning(graph)), np.arange(30))
    config = graph_compare.GraphCompareConfig(data=tmp_path, out=tmp_path / "out", quick=True)
    report = graph_compare.main(config)
    assert report["m3500"]["marginals_off"] < 1e-6
    assert report["batch"]["converged"] == 50
    for reached in report["csail"]["chi2_when_timed"].values():
        assert reached == pytest.approx(report["csail"]["chi2"], rel=1e-5)
