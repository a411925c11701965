"""The program that optimises a pose graph: what it writes and says, and what it refuses."""

import json

import jax
import numpy as np
import pytest
from test_experiments import is_png
from test_graph import drawn
from test_logs import write

from jaxlocmap import graph as pose_graph
from jaxlocmap.cli import graph
from jaxlocmap.logs import read_graph, read_trajectory, write_g2o, write_tum
from jaxlocmap.poses import between, compose

pytestmark = pytest.mark.usefixtures("x64")
POSES, LOOPS = 10, 6
IDS = np.array([0, 1, 2, 4, 5, 6, 8, 9, 10, 11])


@pytest.fixture(scope="module", autouse=True)
def as_programs():
    """`as_a_program`, and for a whole module: what its fixtures compile serves its tests."""
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A graph of ten poses, fixed at the third, and its truth, in a frame of its own."""
    if not jax.config.jax_enable_x64:
        pytest.skip("needs float64, this is the float32 job")
    folder = tmp_path_factory.mktemp("graph")
    truth, measured = drawn(4, poses=POSES, loops=LOOPS)
    write_g2o(folder / "a.g2o", measured, np.asarray(pose_graph.dead_reckoning(measured)), IDS, fixed=2)
    moved = compose(np.broadcast_to([5.0, 6.0, 2.0], truth.shape), truth)
    write_tum(folder / "truth.tum", IDS.astype(float), moved)
    report = graph.main(graph.GraphConfig(file=folder / "a.g2o", judge=folder / "truth.tum", out=folder / "out"))
    return folder, measured, report


@pytest.fixture(scope="module")
def solution(made):
    """Of the library, from another start than the program's, for which it has compiled."""
    measured = made[1]
    return pose_graph.solve(measured, pose_graph.dead_reckoning(measured))


def test_report(made, solution, capsys):
    folder, _, report = made
    assert json.loads((folder / "out" / "report.json").read_text()).keys() == report.keys()
    for name in ("chi2_start", "chi2", "iterations", "seconds", "converged", "poses", "loops"):
        assert name in report
    assert report["chi2"] == pytest.approx(float(solution.chi2), rel=1e-6)
    assert (report["poses"], report["loops"], report["fixed"], report["degrees_of_freedom"]) == (10, 6, 2, 18)
    assert report["converged"]
    assert report["careful"] == []
    assert report["judged"]["scored_steps"] == 9


def test_the_fixed_vertex_stays(made, solution):
    folder, measured, _ = made
    before, after = read_graph(folder / "a.g2o"), read_graph(folder / "out" / "graph.g2o")
    np.testing.assert_allclose(after.poses[2], before.poses[2], atol=1e-12)
    written = read_trajectory(folder / "out" / "poses.csv")
    np.testing.assert_array_equal(written.time, IDS)
    np.testing.assert_allclose(written.cov[2], 0, atol=1e-12)
    expected = between(np.broadcast_to(solution.poses[2], (10, 3)), np.asarray(solution.poses))
    np.testing.assert_allclose(between(np.broadcast_to(after.poses[2], (10, 3)), after.poses), expected, atol=1e-6)
    # In the file's own frame, the fixed pose given.
    relative = pose_graph.relative_covariances(
        measured, solution, np.stack([np.full(10, 2), np.arange(10)], axis=-1).astype(np.int32)
    )
    c, s = np.cos(before.poses[2, 2]), np.sin(before.poses[2, 2])
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    np.testing.assert_allclose(written.cov[5], R @ np.asarray(relative[5]) @ R.T, rtol=1e-6, atol=1e-12)


def test_files(made):
    out = made[0] / "out"
    assert is_png(out / "graph.png")
    assert len(read_trajectory(out / "poses.tum").time) == 10


def test_false_loops_are_listed(tmp_path, capsys):
    _, measured = drawn(2, poses=POSES, loops=LOOPS, false=2)
    poses = np.asarray(pose_graph.dead_reckoning(measured))
    write_g2o(tmp_path / "a.g2o", measured, poses, np.arange(POSES), fixed=2)
    report = graph.main(graph.GraphConfig(file=tmp_path / "a.g2o", kernel="gnc", out=tmp_path / "out"))
    assert report["start"] == "odometry"
    assert report["loops_down_weighted"] >= 2
    assert {(s["from"], s["to"]) for s in report["suspicious"]} >= {tuple(map(int, p)) for p in measured.pair[-2:]}
    lines = (tmp_path / "a.g2o").read_text().splitlines()
    assert all(lines[s["line"] - 1].split()[1:3] == [str(s["from"]), str(s["to"])] for s in report["suspicious"])
    assert "suspicious: line" in capsys.readouterr().out
    trusting = graph.main(graph.GraphConfig(file=tmp_path / "a.g2o", out=tmp_path / "out"))
    assert any("beyond 95 % of right graphs: false loops" in said for said in trusting["careful"])


def test_parts_and_no_loops(tmp_path):
    """A chain with a gap is solved by SciPy, which is asked for where there is none: one program does both."""
    edge = "1 0 0 100 0 0 100 0 400\n"
    parts = write(tmp_path / "parts.g2o", f"EDGE_SE2 0 1 {edge}EDGE_SE2 3 4 {edge}")
    report = graph.main(graph.GraphConfig(file=parts, out=tmp_path / "a"))
    assert not report["converged"]
    assert any("the graph has 2 parts: nothing ties 2 poses, such as 2, to the first" in s for s in report["careful"])
    chain = write(tmp_path / "chain.g2o", "".join(f"EDGE_SE2 {k} {k + 1} {edge}" for k in range(3)))
    report = graph.main(graph.GraphConfig(file=chain, method="scipy", out=tmp_path / "b"))
    assert report["converged"]
    assert report["chi2"] < 1e-20
    assert any(said.startswith("no loops") for said in report["careful"])
    cov = read_trajectory(tmp_path / "b" / "poses.csv").cov[2]
    np.testing.assert_allclose(cov, [[0.02, 0, 0], [0, 0.0225, 0.0025], [0, 0.0025, 0.005]], atol=1e-9)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"start": "file"}, "expected vertices to start from, got edges alone"),
        ({"scale": -1.0, "kernel": "huber"}, "scale: expected a number > 0, got -1.0"),
    ],
)
def test_refused(tmp_path, settings, words):
    file = write(tmp_path / "a.g2o", "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
    with pytest.raises(ValueError, match=words):
        graph.main(graph.GraphConfig(file=file, out=tmp_path / "out", **settings))


def test_truth_without_the_fixed_vertex(tmp_path):
    file = write(tmp_path / "a.g2o", "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
    write_tum(tmp_path / "truth.tum", [1.0], np.zeros((1, 3)))
    with pytest.raises(ValueError, match="judge: expected the true pose of vertex 0, which stays, got none"):
        graph.main(graph.GraphConfig(file=file, judge=tmp_path / "truth.tum", out=tmp_path / "out"))
