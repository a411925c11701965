"""The program that matches a laser log scan by scan: on a small log with known walls, and what it refuses."""

import functools
import json
import math
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_experiments import is_png
from test_logs import write

from jaxlocmap import Gaussian, Params, simulation
from jaxlocmap.cli import slam, slam_loops
from jaxlocmap.logs import Trajectory, read, read_graph, read_trajectory, write_tum
from jaxlocmap.mapping.ros import load_map
from jaxlocmap.matching.storage import load_lines
from jaxlocmap.matching.submaps import with_defaults
from jaxlocmap.poses import between as moved
from jaxlocmap.replay import loops as replay_loops
from jaxlocmap.replay import maps, scans

SCANS = 60
ANGLES = np.deg2rad(np.linspace(-90, 90, 91))


@functools.cache
def drive():
    """True poses of a drive around the box of the room, a scan every 30 cm, and the ranges."""
    turn = np.linspace(0, 2 * math.pi * 1.15, SCANS)
    poses = np.stack([6 + 3.2 * np.cos(turn), 5.25 + 3.2 * np.sin(turn), turn + math.pi / 2], axis=-1)
    cast = jax.vmap(lambda pose: simulation.ray_cast(pose, jnp.asarray(ANGLES), simulation.room().segments, 30.0))
    rng = np.random.default_rng(0)
    return poses, np.asarray(cast(jnp.asarray(poses))) + 0.01 * rng.normal(size=(SCANS, len(ANGLES)))


def log_file(folder, name="a.log", scans=slice(None), line="FLASER", jump=0.0):
    """A log of the drive whose wheels err by some centimetres and hundredths of a radian a step."""
    poses, ranges = drive()
    rng = np.random.default_rng(1)
    steps = moved(poses[:-1], poses[1:]) + np.array([0.03, 0.03, 0.02]) * rng.normal(size=(SCANS - 1, 3))
    steps[SCANS // 2, 0] += jump
    x, y, theta = 100.0, 50.0, 1.0
    driven = [(x, y, theta)]
    for dx, dy, turn in steps:
        c, s = math.cos(theta), math.sin(theta)
        x, y, theta = x + c * dx - s * dy, y + s * dx + c * dy, theta + turn
        driven.append((x, y, theta))
    text = ""
    for k in np.arange(SCANS)[scans]:
        odometry = " ".join(f"{v:.9f}" for v in driven[k])
        text += f"{line} {len(ANGLES)} {' '.join(f'{r:.4f}' for r in ranges[k])} 7 8 9 {odometry} 9.0 host {10 + k}\n"
    return write(folder / name, text)


def since_start(poses):
    return moved(np.broadcast_to(poses[0], poses.shape), poses)


@pytest.fixture(scope="module", autouse=True)
def as_programs():
    """`as_a_program`, and for a whole module: what its fixtures compile serves its tests. Two pieces of the log, the
    second of which is filled up by four scans.
    """
    with (
        jax.numpy_rank_promotion("allow"),
        jax.numpy_dtype_promotion("standard"),
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setattr(scans, "PIECE", 32)
        patch.setattr(maps, "PIECE", 32)
        yield


def program(out, log, **settings):
    settings = {"half_width": 10.0, "resolution": 0.1, "closure": False, "out": out} | settings
    return slam.main(slam.SlamConfig(log=log, format="carmen", **settings))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("slam")
    log = log_file(folder)
    write_tum(folder / "truth.tum", 10.0 + np.arange(SCANS), drive()[0])
    relation = moved(drive()[0][:1], drive()[0][-1:])[0]
    relations = f"10 {9 + SCANS} {relation[0]} {relation[1]} 0 0 0 {relation[2]}\n10 11.5 0 0 0 0 0 0\n"
    relations = write(folder / "a.relations", relations)
    pictures = {"relations": relations, "reference": folder / "truth.tum"}
    return folder, log, program(folder / "out", log, **pictures)


def test_the_trajectory_is_better_than_the_wheels_and_within_its_sigma(made):
    folder, _, report = made
    got = read_trajectory(folder / "out" / "estimate.tum")
    np.testing.assert_array_equal(got.time, 10.0 + np.arange(SCANS))
    error = got.pose - since_start(drive()[0])
    assert np.abs(error[:, :2]).max() < 0.08
    assert np.abs((error[:, 2] + np.pi) % (2 * np.pi) - np.pi).max() < 0.02
    assert np.hypot(*error[-1, :2]) < 3 * report["sigma_position_end_m"] < 0.6
    assert (report["matched"], report["tried"], report["scans"]) == (SCANS - 1, SCANS - 1, SCANS)
    assert report["refused"] == {"points": 0, "share": 0, "nis": 0, "convergence": 0}
    assert report["path_m"] == pytest.approx(3.2 * 2 * math.pi * 1.15, rel=0.02)
    assert (report["refused_most_in_a_row"], report["refused_most_from_s"]) == (0, None)
    assert not report["careful"]


def test_the_pose_on_the_map_is_where_the_scan_was_drawn():
    """Of a robot at (2, 1), on a map whose anchor is at (1, 1), turned left, and which errs by (0.1, 0.2, 0.05)."""
    mean = jnp.array([[2, 1, math.pi, 1, 1, math.pi / 2, 0.1, 0.2, 0.05, *np.zeros(6)]])
    info = SimpleNamespace(belief=Gaussian(mean, jnp.diag(jnp.arange(15.0))[None]))
    poses, cov = scans.on_the_map(info)
    np.testing.assert_allclose(poses, [[1.8, 1.1, 0.05 - math.pi]], atol=1e-6)  # (0, -1) there is (1, 0) here
    np.testing.assert_array_equal(cov, [np.diag([0, 1, 2])])


def test_it_is_scored_by_what_is_known_from_elsewhere(made):
    _, _, report = made
    assert (report["relations"]["scored"], report["relations"]["given"]) == (1, 2)
    assert report["relations"]["translation_m"] < 0.08
    assert report["revisits"]["scored"] == report["revisits"]["given"] > 10
    assert report["revisits"]["translation_m"] < 0.05
    assert report["revisits"]["rotation_deg"] < 1


def test_the_map_has_the_walls_of_the_room(made):
    """In the frame of the start: cells that are occupied lie within two cells of a wall."""
    folder, _, report = made
    cells, spec = load_map(folder / "out" / "map.yaml")
    where = (np.argwhere(cells == 100)[:, ::-1] + 0.5) * spec.resolution + spec.origin
    start = drive()[0][0]
    c, s = math.cos(start[2]), math.sin(start[2])
    x, y = start[0] + c * where[:, 0] - s * where[:, 1], start[1] + s * where[:, 0] + c * where[:, 1]
    a, b = np.moveaxis(np.asarray(simulation.room().segments), 1, 0)
    along = b - a
    t = ((x[:, None] - a[:, 0]) * along[:, 0] + (y[:, None] - a[:, 1]) * along[:, 1]) / np.sum(along**2, axis=1)
    t = np.clip(t, 0, 1)
    off = np.hypot(x[:, None] - a[:, 0] - t * along[:, 0], y[:, None] - a[:, 1] - t * along[:, 1]).min(axis=1)
    assert len(off) > 300
    assert np.mean(off < 0.2) > 0.97
    assert is_png(folder / "out" / "map.png")
    assert report["entropy_bits"] > 0
    assert json.loads((folder / "out" / "report.json").read_text())["shape"] == list(cells.shape)


def test_it_localises_on_the_map_it_made_and_leaves_it(made, tmp_path):
    """From a start some centimetres off."""
    folder, log, _ = made
    known = folder / "out" / "lines.npz"
    before = known.read_bytes()
    report = program(tmp_path / "out", log, map=known, start=(0.05, -0.1, 0.03))
    got = read_trajectory(tmp_path / "out" / "estimate.tum")
    error = got.pose - since_start(drive()[0])
    assert np.abs(error[1:, :2]).max() < 0.08
    assert report["matched"] == SCANS
    assert report["sigma_position_most_m"] < 0.05
    assert known.read_bytes() == before
    assert load_lines(known).lines.shape == (200, 200, 6)
    assert not (tmp_path / "out" / "lines.npz").exists()
    # From elsewhere in the room, on the same program: it says so.
    lost = program(tmp_path / "lost", log, map=known, start=(3.0, 4.0, 1.0))
    assert lost["matched"] < SCANS / 2
    assert any("is it the map of this place" in sentence for sentence in lost["careful"])


def test_wheels_that_jump_are_found_out(tmp_path):
    """By two metres, beyond the window: the scans after it are refused, and it is said from when on."""
    report = program(tmp_path / "out", log_file(tmp_path, jump=2.0))
    assert report["refused_most_in_a_row"] >= 3
    assert report["refused_most_from_s"] == 10 + SCANS // 2 + 1
    assert any(f"in a row were not matched, from {11 + SCANS // 2}.000 s" in said for said in report["careful"])


def test_scans_are_sorted_and_one_is_kept_of_a_stamp(tmp_path):
    log_file(tmp_path)
    rows = (tmp_path / "a.log").read_text().splitlines(keepends=True)
    log = read(write(tmp_path / "b.log", "".join([rows[2], rows[0], rows[0], rows[1]])), "carmen")
    ordered, repeated = scans.in_order(log)
    assert repeated == 1
    np.testing.assert_array_equal(ordered.scan_time, [10, 11, 12])
    np.testing.assert_array_equal(ordered.scan_line, [2, 4, 1])
    np.testing.assert_array_equal(ordered.truth_time, ordered.scan_time)
    assert ordered.scan_odometry[0] == pytest.approx([100, 50, 1])


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"start": (0.0, math.nan, 0.0)}, "start: expected three finite"),
        ({"max_range": 0.0}, "max_range: expected metres"),
        ({"resolution": -1.0}, "resolution: expected metres"),
        ({"fov": 400.0}, "fov: expected degrees"),
        ({"odometry": (0.1, 0.0, 0.1)}, "odometry.*: expected a positive"),
        ({"window": (0.1, -0.1)}, "window: expected two finite"),
        ({"half_width": 0.0}, "half_width: expected finite metres"),
    ],
)
def test_an_option_out_of_range_is_refused(tmp_path, settings, said):
    with pytest.raises(ValueError, match=said):
        program(tmp_path / "out", log_file(tmp_path), **settings)


def test_a_log_without_odometry_and_clocks_that_differ_are_refused(tmp_path):
    raw = write(tmp_path / "raw.log", "RAWLASER1 0 -1.57 3.14 1.57 30 0 0 3 1 2 3 0 5.0 host 5.0\n")
    with pytest.raises(ValueError, match="expected laser scans with odometry"):
        program(tmp_path / "out", raw)
    relations = write(tmp_path / "a.relations", "1 2 0 0 0 0 0 0\n")
    with pytest.raises(ValueError, match=r"relations: expected pairs of stamps of the log, 10\.000 to 69\.000 s"):
        program(tmp_path / "out", log_file(tmp_path), relations=relations)


def test_parameters_of_a_file_take_the_place_of_the_odometry(tmp_path, monkeypatch):
    seen = {}

    class Enough(Exception):
        pass

    def stop(params, log, settings, start, known, progress):
        seen.update(params=params, scans=len(log.scan), settings=settings)
        raise Enough

    monkeypatch.setattr(scans, "match_log", stop)
    other = with_defaults(Params.from_std(odometry=(0.5, 0.6, 0.7)), std=0.05)
    other.save(tmp_path / "a.json")
    with pytest.raises(Enough):
        program(tmp_path / "out", log_file(tmp_path), params=tmp_path / "a.json", laser_offset=(0.1, 0.0, 0.2))
    assert np.diagonal(seen["params"].blocks["odometry"]) == pytest.approx([0.25, 0.36, 0.49])
    assert float(seen["params"].blocks["match_std"]) == pytest.approx(0.05)
    assert seen["settings"].scanner_offset == (0.1, 0.0, 0.2)
    assert seen["settings"].max_range == 20.0


@pytest.fixture(scope="module")
def made_closed(tmp_path_factory):
    """The folder, the report, and the loops as the program closed them."""
    folder, kept = tmp_path_factory.mktemp("closed"), []
    log = log_file(folder)
    write_tum(folder / "truth.tum", 10.0 + np.arange(SCANS), drive()[0])
    closed = replay_loops.closed
    settings = {"closure": True, "submap_length": 2.5, "online": True, "reference": folder / "truth.tum"}
    settings["max_range"] = 12.0  # as far as the room is wide; a submap is as wide as that and its length
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(replay_loops, "closed", lambda *args, **how: kept.append(closed(*args, **how)) or kept[-1])
        report = program(folder / "out", log, **settings)
    return folder, report, kept[0]


def test_closed_loops(made_closed):
    folder, report, _ = made_closed
    poses = since_start(drive()[0])
    estimate = read_trajectory(folder / "out" / "estimate.tum")
    error = np.hypot(*(estimate.pose - poses)[:, :2].T)
    assert error.max() < 0.15
    said = report["closure"]
    assert said["submaps"] >= 5
    assert 1 <= said["kept"] <= said["accepted"] <= said["tried"]
    assert said["converged"]
    # Its covariances are those of the poses since the start.
    with_covariance = read_trajectory(folder / "out" / "poses.csv")
    np.testing.assert_allclose(with_covariance.pose, estimate.pose, atol=1e-9)
    sigma = np.sqrt(with_covariance.cov[:, 0, 0] + with_covariance.cov[:, 1, 1])
    assert sigma[0] == 0
    assert report["sigma_position_end_m"] == pytest.approx(sigma[-1], rel=1e-5)
    assert np.all(error[1:] < 5 * sigma[1:] + 0.02)


def test_what_closed_loops_write(made_closed):
    folder, report, _ = made_closed
    out = folder / "out"
    graph = read_graph(out / "graph.g2o")
    assert len(graph.ids) == report["closure"]["submaps"]
    assert len(graph.loop_line) == report["closure"]["accepted"]
    assert is_png(out / "graph.png")
    assert is_png(out / "map.png")
    online = read_trajectory(out / "online.tum")
    assert len(online.time) == SCANS
    # A map of lines to localise on, of the size that was asked for.
    lines = load_lines(out / "lines.npz")
    assert lines.half_width == 10.0
    assert np.count_nonzero(lines.lines[..., 5]) > 500


def test_words_on_loops():
    said = {"accepted": 10, "kept": 10, "converged": True}
    assert slam_loops.loop_doubts({}) == []
    assert slam_loops.loop_doubts({"closure": said}) == []
    assert "no loop was closed" in slam_loops.loop_doubts({"closure": said | {"accepted": 0, "kept": 0}})[0]
    assert "3 of 10 loops do not fit" in slam_loops.loop_doubts({"closure": said | {"kept": 7}})[0]
    assert "did not converge" in slam_loops.loop_doubts({"closure": said | {"converged": False}})[0]


def test_false_loops_are_counted(made_closed):
    """Against the true poses none is false; against poses of which every other half is a metre aside, some are."""
    _, report, loops = made_closed
    assert report["closure"]["false_kept"] == 0
    aside = drive()[0] + np.where(np.arange(SCANS) > SCANS / 2, 1.0, 0.0)[:, None] * [1, 0, 0]
    assert replay_loops.false_loops(loops, aside) >= 1
    assert replay_loops.false_loops(loops, np.full((SCANS, 3), np.nan)) == 0


def test_poses_at_the_stamps_of_scans():
    reference = Trajectory(np.array([1.0, 2.0, 3.0]), np.arange(9.0).reshape(3, 3), None, {})
    found = scans.at_stamps(reference, np.array([0.5, 1.0, 2.00005, 2.6, 3.0, 9.0]))
    np.testing.assert_array_equal(np.isnan(found[:, 0]), [True, False, False, True, False, True])
    np.testing.assert_array_equal(found[[1, 2, 4]], reference.pose)
