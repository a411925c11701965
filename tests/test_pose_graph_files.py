"""Files of pose graphs: what real ones hold, what is refused with its line, and what comes back."""

import gzip

import numpy as np
import pytest
from test_experiments import data
from test_logs import write

from jaxlocmap import graph as pose_graph
from jaxlocmap.graph.methods import MOST_LOOPS
from jaxlocmap.logs import chained, read_graph, read_trajectory, write_csv, write_g2o

G2O = """# a square
EDGE_SE2 1 2 1 0 1.5 500 1 2 600 3 700
VERTEX_SE2 1 0 0 0
VERTEX_SE2 2 1 0 1.5
VERTEX_SE2 7 1 1 3
VERTEX_SE2 7 1 1 3
EDGE_SE2 2 7 1 0 1.5 500 1 2 600 3 700
EDGE_SE2 7 1 1.4 0 0.5 50 0 0 60 0 0
FIX 2
VERTEX_XY 9 1 1
VERTEX_XY 10 1 2
"""
FULL = np.array([[500, 1, 2], [1, 600, 3], [2, 3, 700.0]])


def test_g2o(tmp_path, tolerance):
    file = read_graph(write(tmp_path / "a.g2o", G2O))
    np.testing.assert_array_equal(file.ids, [1, 2, 7])
    np.testing.assert_array_equal(file.poses, [[0, 0, 0], [1, 0, 1.5], [1, 1, 3]])
    np.testing.assert_allclose(file.graph.odometry, [[1, 0, 1.5]] * 2)
    np.testing.assert_allclose(file.graph.odometry_information, [FULL] * 2)
    np.testing.assert_array_equal(file.graph.pair, [[2, 0]])
    np.testing.assert_allclose(file.graph.loop_information, [np.diag([50, 60, 0])])
    assert (file.fixed, file.has_fix) == (1, True)
    np.testing.assert_array_equal(file.odometry_line, [2, 7])
    np.testing.assert_array_equal(file.loop_line, [8])
    assert file.counts == {
        "repeated_vertices": 1,
        "repeated_edges": 0,
        "missing_odometry": 0,
        "singular_information": 1,
        "lines_VERTEX_XY": 2,
    }


def test_toro_and_isam_have_one_tag(tmp_path, tolerance):
    toro = read_graph(write(tmp_path / "a.g2o", "EDGE2 0 1 1 0 1.5 500 1 600 700 2 3\n"))
    np.testing.assert_allclose(toro.graph.odometry_information, [FULL])
    assert toro.poses is None
    assert (toro.fixed, toro.has_fix) == (0, False)
    R = np.linalg.cholesky(FULL).T
    entries = " ".join(repr(float(R[i, j])) for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    for tag in ("EDGE2", "ODOMETRY"):
        isam = read_graph(write(tmp_path / "b.txt", f"{tag} 0 1 1 0 1.5 {entries}\n"), isam=True)
        np.testing.assert_allclose(isam.graph.odometry_information, [FULL], rtol=tolerance(1e-12, 1e-5))


def test_units_do_not_make_information_singular(tmp_path):
    file = read_graph(write(tmp_path / "a.g2o", "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 2693538350855.096191\n"))
    assert file.counts["singular_information"] == 0


def test_no_vertices_no_chain(tmp_path):
    text = "EDGE_SE2 5 3 -1 0 0 1 0 0 1 0 1\nEDGE_SE2 3 4 1 0 0 1 0 0 1 0 1\nEDGE_SE2 3 4 1 0 0 1 0 0 1 0 1\n"
    file = read_graph(write(tmp_path / "a.g2o", text))
    np.testing.assert_array_equal(file.ids, [3, 4, 5])
    np.testing.assert_array_equal(file.odometry_line, [2, 0])
    np.testing.assert_array_equal(file.loop_line, [1, 3])
    assert file.counts["missing_odometry"] == 1
    assert file.counts["repeated_edges"] == 1
    np.testing.assert_array_equal(chained(file), [[0, 0, 0], [1, 0, 0], [1, 0, 0]])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the file is empty"),
        ("VERTEX_SE2 0 0 0 0\n", r"a.g2o: expected edges \(EDGE_SE2 or EDGE2\), got none"),
        ("EDGE_SE3:QUAT 0 1\n", "expected edges .*, got none: EDGE_SE3:QUAT"),
        ("EDGE_SE2 0 1 1 0 0 1 0 0 1 0\n", r"a.g2o:1: expected EDGE_SE2 a b dx dy dtheta I11 I12 .*, got 10 fields"),
        ("VERTEX_SE2 0 0 0\n", "a.g2o:1: expected VERTEX_SE2 id x y theta, got 3 fields"),
        ("EDGE_SE2 0 1 1 0 x 1 0 0 1 0 1\n", "a.g2o:1: dtheta: expected a finite number, got 'x'"),
        ("EDGE_SE2 0 1 1 nan 0 1 0 0 1 0 1\n", "a.g2o:1: dy: expected a finite number, got 'nan'"),
        ("EDGE_SE2 0 1 1 0 0 1 0 0 inf 0 1\n", "a.g2o:1: expected finite information"),
        ("EDGE_SE2 0 -1 1 0 0 1 0 0 1 0 1\n", "a.g2o:1: id: expected a whole number >= 0, got '-1'"),
        (
            "EDGE_SE2 2 2 1 0 0 1 0 0 1 0 1\n",
            "a.g2o:1: expected an edge between two vertices, got one from 2 to itself",
        ),
        (
            "\nEDGE_SE2 0 1 1 0 0 1 5 0 1 0 1\n",
            r"a.g2o:2: expected positive semi-definite information, .* order of EDGE_SE2",
        ),
        ("EDGE_SE2 0 1 1 0 0 0 1 0 1 0 1\n", "a.g2o:1: expected positive semi-definite"),
        (
            "VERTEX2 0 0 0 0\nEDGE2 0 1 1 0 0 1 0 1 1 0 0\n",
            "a.g2o:2: expected edges between vertices of the file, got vertex 1",
        ),
        ("VERTEX2 0 0 0 0\nVERTEX2 0 0 0 1\n", r"a.g2o:2: expected one pose of vertex 0, got .* in line 1"),
        ("FIX 0 1\nEDGE2 0 1 1 0 0 1 0 1 1 0 0\n", "a.g2o:1: expected one fixed vertex, got 0 and 1"),
        ("EDGE2 0 1 1 0 0 1 0 1 1 0 0\nFIX 4\n", "a.g2o:2: expected a vertex of the file to be fixed, got vertex 4"),
        ("EDGE2 0 1 1 0 0 1 0 1 1 0 0\nFIX\n", "a.g2o:2: expected FIX and the id of a vertex"),
        ("ODOMETRY 0 1 1 0 0 1 0 0 1 0 1\n", "a.g2o:1: expected g2o or TORO, got ODOMETRY"),
    ],
)
def test_refused(tmp_path, text, words):
    with pytest.raises(ValueError, match=words):
        read_graph(write(tmp_path / "a.g2o", text))


@pytest.mark.parametrize("name", ["b.g2o", "b.g2o.gz"])
def test_written_comes_back(tmp_path, x64, name):
    file = read_graph(write(tmp_path / "a.g2o", G2O))
    write_g2o(tmp_path / name, file.graph, file.poses, file.ids, fixed=file.fixed)
    again = read_graph(tmp_path / name)
    for a, b in zip([*file.graph, file.ids, file.poses], [*again.graph, again.ids, again.poses], strict=True):
        np.testing.assert_array_equal(a, b)
    assert (again.fixed, again.has_fix) == (1, True)
    if name.endswith(".gz"):
        assert gzip.decompress((tmp_path / name).read_bytes()).startswith(b"VERTEX_SE2 1 ")


def test_edges_without_information_are_not_written(tmp_path, x64):
    file = read_graph(write(tmp_path / "a.g2o", G2O))
    graph = file.graph._replace(loop_information=0 * file.graph.loop_information)
    write_g2o(tmp_path / "b.g2o", graph, file.poses, file.ids)
    assert len(read_graph(tmp_path / "b.g2o").loop_line) == 0


@pytest.mark.parametrize(
    ("poses", "ids", "words"),
    [
        (np.zeros((2, 3)), [1, 2, 7], "poses: expected shape"),
        (np.full((3, 3), np.nan), [1, 2, 7], "poses: expected finite values, got 9 others"),
        (np.zeros((3, 3)), [1, 7, 2], "ids: expected increasing numbers"),
    ],
)
def test_not_written(tmp_path, poses, ids, words):
    file = read_graph(write(tmp_path / "a.g2o", G2O))
    with pytest.raises(ValueError, match=words):
        write_g2o(tmp_path / "b.g2o", file.graph, poses, np.array(ids))
    assert not (tmp_path / "b.g2o").exists()


def test_poses_with_covariances_come_back(tmp_path):
    rng = np.random.default_rng(0)
    time, pose = np.array([1.5, 2.25, 9.0]), rng.normal(size=(3, 3))
    cov = np.array([A @ A.T for A in rng.normal(size=(3, 3, 3))])
    write_csv(tmp_path / "a.csv", time, pose, cov)
    again = read_trajectory(tmp_path / "a.csv")
    np.testing.assert_array_equal(again.time, time)
    np.testing.assert_array_equal(again.pose, pose)
    np.testing.assert_allclose(again.cov, cov, rtol=1e-15)
    with pytest.raises(ValueError, match="expected at least one pose, got none"):
        write_csv(tmp_path / "b.csv", time[:0], pose[:0], cov[:0])


REFERENCES = {  # posterior optima of public graphs, g2o's residual, the first pose fixed
    "input_INTEL_g2o.g2o": 215.830,
    "CSAIL_P_toro.graph": 38.9563,
    "input_M3500_g2o.g2o": 137.913,
    "M3500b.g2o": 2054.72,
    "sesync_intel.g2o": 45.0047,
}


def filled_up(graph, *, poses, loops):
    odometry, odometry_information, pair, loop, loop_information = map(np.asarray, graph)
    more, links = poses - graph.poses, loops - graph.loops
    return pose_graph.Graph(
        np.concatenate([odometry, np.zeros((more, 3))]),
        np.concatenate([odometry_information, np.tile(np.eye(3), (more, 1, 1))]),
        np.concatenate([pair, np.tile(np.array([0, 1], pair.dtype), (links, 1))]),
        np.concatenate([loop, np.zeros((links, 3))]),
        np.concatenate([loop_information, np.zeros((links, 3, 3))]),
    )


@pytest.mark.slow
@pytest.mark.parametrize(("name", "chi2"), REFERENCES.items())
def test_public_graphs(x64, name, chi2):
    graph = read_graph(data("posegraph", name)).graph
    if graph.loops > MOST_LOOPS:  # up to the largest, as `stack` does it: one program for all that are solved like it
        graph = filled_up(graph, poses=3500, loops=1954)
    solution = pose_graph.solve(graph)
    assert solution.converged
    assert float(solution.chi2) == pytest.approx(chi2, rel=3e-6)
