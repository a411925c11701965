"""The mapping program on small logs with known walls: which cells it frees and marks, and what it refuses."""

import json
import math
import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import reference
from programs import Recorder
from test_experiments import is_png
from test_logs import flaser, refused, write

from jaxlocmap import Params
from jaxlocmap.cli import map_log, tune_sources
from jaxlocmap.logs import read
from jaxlocmap.mapping.ros import OCCUPIED, load_map
from jaxlocmap.replay import maps
from jaxlocmap.simulation import course_params

pytestmark = pytest.mark.usefixtures("as_a_program")


@pytest.fixture(autouse=True)
def no_pictures(monkeypatch):
    """They take longer than the map."""
    monkeypatch.setattr(map_log.plotting, "map_figure", lambda *_, **__: None)


def make(folder, path, **settings):
    """The report, the cells and the grid of a map."""
    report = map_log.main(map_log.MapConfig(log=path, format="carmen", out=folder / "out", **settings))
    written = json.loads((folder / "out" / "report.json").read_text())
    assert written["beam_angles_from"] == report["beam_angles_from"]
    return report, *load_map(folder / "out" / "map.yaml")


def logged(folder, *scans):
    """A log of FLASER lines, each (ranges, pose)."""
    return write(folder / "a.log", "".join(flaser(ranges, pose) for ranges, pose in scans))


def centres(cells, spec, kind):
    """Positions (K, 2) of the cells of a kind."""
    return (np.argwhere(cells == kind)[:, ::-1] + 0.5) * spec.resolution + spec.origin


WALLS = 5.025, 3.025  # m, in the middle of cells of 0.05 m: rounding puts no hit into the next one


def room(angles, half_x=WALLS[0], half_y=WALLS[1], at=(0.0, 0.0)):
    """Ranges (B,) to the walls x = +-half_x, y = +-half_y from a place inside."""
    reach = np.full(len(angles), np.inf)
    for half, component, start in ((half_x, np.cos(angles), at[0]), (half_y, np.sin(angles), at[1])):
        reach = np.minimum(reach, (np.copysign(half, component) - start) / np.where(component == 0, 1e-12, component))
    return reach


def off_walls(points, half_x=WALLS[0], half_y=WALLS[1]):
    """Distance (K,) of points to the walls of the room."""
    return np.minimum(abs(abs(points[:, 0]) - half_x), abs(abs(points[:, 1]) - half_y))


@pytest.mark.parametrize("far", [20.0, 81.83, math.inf])
def test_a_range_beyond_the_limit_clears_and_marks_nothing(tmp_path, capsys, far):
    path = logged(tmp_path, ([far] * 180 + [2.0], (0, 0, 0)))
    report, cells, spec = make(tmp_path, path, resolution=0.5)
    np.testing.assert_array_equal(np.argwhere(cells == OCCUPIED), np.argwhere(cells == OCCUPIED)[:1])
    assert np.hypot(*(centres(cells, spec, OCCUPIED)[0] - [0, 2])) < 0.5
    # A half disc of 20 m has 2513 such cells; its rim of some 130, where beams end, stays unknown.
    assert 2513 - 150 < report["seen"] < 2513
    reach = np.array(spec.origin), np.array(spec.origin) + 0.5 * np.array(spec.shape[::-1])
    assert np.all(reach[0] <= [0, -20])
    assert np.all(reach[1] >= [20, 20])
    assert report["counts"]["no_return"] == (180 if far == math.inf else 0)
    assert "only 1 of 181 ranges lie below the limit of 20 m: is the unit metres?" in capsys.readouterr().out


def test_what_is_no_measurement_clears_nothing(tmp_path):
    ranges = [math.nan, -1.0, 0.0] * 60 + [2.0]
    report, *_ = make(tmp_path, logged(tmp_path, (ranges, (0, 0, 0))), resolution=0.5)
    assert report["counts"]["bad_ranges"] == 180
    assert report["seen"] == 5  # the four cells along y up to 2 m and the one hit


def test_a_scanner_clears_no_further_than_it_says_it_sees(tmp_path):
    path = logged(tmp_path, ([8.0] * 180 + [2.0], (0, 0, 0)))
    path.write_text("PARAM robot_front_laser_max 8.0 nohost 0\n" + path.read_text())
    report, *_ = make(tmp_path, path, resolution=0.5)
    assert report["max_range"] == 8
    assert report["counts"]["no_return"] == 180
    area = math.pi * 8**2 / 2 / 0.5**2
    assert area - 60 < report["seen"] < area


def test_a_scanner_of_80_m_is_mapped_as_far_as_it_sees(tmp_path):
    """A yard of 150 m x 130 m; from its middle, walls are 65 to 99 m off."""
    angles = np.deg2rad(np.arange(-180, 180))
    path = logged(tmp_path, *((np.minimum(room(angles, 75.25, 65.25), 81.83), (0, 0, 0)) for _ in range(3)))
    settings = {"resolution": 0.5, "fov": 360.0}
    report, cells, spec = make(tmp_path, path, max_range=80.0, **settings)
    assert (report["beam_angles_from"], report["beams_span_deg"]) == ("user", pytest.approx(359))
    hits = centres(cells, spec, OCCUPIED)
    assert np.sum(room(angles, 75.25, 65.25) < 80) > 200
    assert len(hits) > 190
    assert np.all(off_walls(hits, 75.25, 65.25) < 0.01)
    for side in ([75.25, 0], [-75.25, 0], [0, 65.25], [0, -65.25]):
        assert np.any(np.hypot(*(hits - side).T) < 2)
    refused(lambda: make(tmp_path, path, max_range=60.0, **settings), "no range lies below the limit of 60 m")


@pytest.mark.parametrize(("beams", "fov", "stated"), [
    (541, 270.0, "PARAM laser_front_laser_fov 4.71239 nohost 0\nPARAM laser_front_laser_resolution 0.5 nohost 0\n"),
    (541, 270.0, None),
    (181, 180.0, "PARAM laser_front_laser_resolution 1.0 nohost 0\n"),
])  # fmt: skip
def test_walls_lie_where_they_are(tmp_path, capsys, beams, fov, stated):
    angles = np.deg2rad(np.linspace(-fov / 2, fov / 2, beams))
    path = logged(tmp_path, (room(angles).round(3), (0, 0, 0)))
    path.write_text((stated or "") + path.read_text())
    report, cells, spec = make(tmp_path, path, **({} if stated else {"fov": fov}))
    hits = centres(cells, spec, OCCUPIED)
    assert np.all(off_walls(hits) < 0.01)
    assert np.any(hits[:, 0] < -2.9) == (fov > 180)
    assert report["beam_angles_from"] == ("log" if stated else "user")
    assert "assumed" not in capsys.readouterr().out


def test_what_is_assumed_of_the_beams_is_said(tmp_path, capsys, monkeypatch):
    monkeypatch.undo()
    report, *_ = make(tmp_path, logged(tmp_path, ([2.0] * 180, (0, 0, 0))))
    assert report["beam_angles_from"] == "assumed"
    assert "the log does not say where its beams point: assumed -90 to 89 degrees" in capsys.readouterr().out
    assert is_png(tmp_path / "out" / "map.png")


def test_a_scanner_off_the_robots_centre(tmp_path):
    """Mounted 0.3 m ahead, 0.1 m left and turned left; the poses are the robot's."""
    turn = 0.7
    scans = []
    for theta in (0.0, 1.5, 3.0, -1.5):
        at = np.array([math.cos(theta) * 0.3 - math.sin(theta) * 0.1, math.sin(theta) * 0.3 + math.cos(theta) * 0.1])
        scans.append((room(np.deg2rad(np.linspace(-90, 90, 181)) + theta + turn, at=at), (0, 0, theta)))
    path = logged(tmp_path, *scans)
    _, cells, spec = make(tmp_path, path, laser_offset=(0.3, 0.1, turn))
    assert np.all(off_walls(centres(cells, spec, OCCUPIED)) < 0.01)
    _, cells, spec = make(tmp_path, path)
    assert np.mean(off_walls(centres(cells, spec, OCCUPIED)) < 0.01) < 0.5


def test_large_coordinates_cost_no_precision(tmp_path):
    rng = np.random.default_rng(0)
    angles = np.deg2rad(np.linspace(-90, 90, 181))
    poses = [np.array([*rng.uniform(-2, 2, 2), theta]).round(6) for theta in rng.uniform(-3, 3, 20)]
    scans = [(room(angles + pose[2], at=pose[:2]).round(3), pose) for pose in poses]
    offset = np.array([388096.0, 3948996.0, 0.0])
    _, here, spec = make(tmp_path, logged(tmp_path, *scans))
    _, there, moved = make(tmp_path, logged(tmp_path, *((r, pose + offset) for r, pose in scans)))
    np.testing.assert_array_equal(there, here)
    np.testing.assert_allclose(np.subtract(moved.origin, spec.origin), offset[:2], rtol=0, atol=1e-6)
    assert np.all(off_walls(centres(here, spec, OCCUPIED)) < 0.01)


def test_a_log_in_centimetres_is_refused(tmp_path):
    path = logged(tmp_path, ([250.0] * 180, (0, 0, 0)))
    refused(
        lambda: make(tmp_path, path), "a.log: no range lies below the limit of 20 m, the smallest is 250", "metres?"
    )
    path.write_text("PARAM robot_front_laser_max 81.9 nohost 0\n" + path.read_text())
    refused(lambda: make(tmp_path, path), "no range lies below the limit of 20 m")


@pytest.mark.parametrize("glitch", [(1e300, 0), (0, 1.7e308)])
def test_a_pose_that_nothing_measures_is_named_with_its_line(tmp_path, glitch):
    path = logged(tmp_path, ([2.0] * 180, (0, 0, 0)), ([2.0] * 180, (*glitch, 0)))
    refused(
        lambda: make(tmp_path, path), f"a.log:2: {'x' if glitch[0] else 'y'}: expected a number of a size up to 1e+12"
    )


@pytest.mark.parametrize("glitch", [(1e6, 0), (0, -1e12)])
def test_a_glitched_pose_is_named_with_its_line(tmp_path, glitch):
    poses = [(0.1 * k, 0, 0) for k in range(9)]
    poses[4] = (*glitch, 0)
    path = logged(tmp_path, *(([2.0] * 180, pose) for pose in poses))
    refused(lambda: make(tmp_path, path), "resolution: expected", "a.log:5: the pose (")


@pytest.mark.parametrize(("name", "value"), [
    *(("resolution", value) for value in (0.0, -1.0, math.nan, math.inf)),
    *(("max_range", value) for value in (0.0, 0.05, -1.0, math.nan, math.inf)),
    *(("fov", value) for value in (0.0, -90.0, 361.0, math.nan)),
    *(("laser_offset", (0.0, 0.0, value)) for value in (math.nan, math.inf)),
])  # fmt: skip
def test_an_option_out_of_its_range_is_named(tmp_path, name, value):
    refused(lambda: make(tmp_path, tmp_path / "nowhere.log", **{name: value}), f"{name}: expected")
    assert not (tmp_path / "out").exists()


def test_a_log_without_poses_is_refused(tmp_path):
    line = "RAWLASER1 0 -1.570796 3.141593 0.017453 81.9 0.01 0 180 " + "2.0 " * 180 + "0 99.0 host 1.0\n"
    refused(lambda: make(tmp_path, write(tmp_path / "a.log", line)), "expected laser scans, each with a pose, got 1, 0")


def test_tuning_maps_in_the_same_frame_and_with_the_same_ranges(tmp_path):
    """At UTM coordinates its poses are small, and what did not return is as far as the limit."""
    ranges = [math.inf] * 90 + [math.nan] + [2.0] * 90
    scans = [(ranges, (388096.0 + 0.1 * k, 3948996.0, 0)) for k in range(6)]
    wanted = tune_sources.Wanted(("map",), None, None, 0.99, 0, False)
    source = tune_sources.from_scans(logged(tmp_path, *scans), 0.5, 20.0, wanted)
    assert source.config.grid.origin == (0.0, 0.0)
    assert np.all(np.asarray(source.train.poses)[..., :2] < 50)
    first = np.asarray(source.train.inputs.ranges).reshape(-1, 181)[0]
    np.testing.assert_array_equal(first[[0, 90, 91]], [20, np.nan, 2])


# --- what the program makes of its options and of the map


@pytest.fixture
def mapped(monkeypatch):
    """Made without mapping: of which log with which parameters and settings, and what is drawn of it."""
    seen, drawn = Recorder(), Recorder()

    def stub(params, log, config, progress):
        seen(params, log, config)
        log_odds = np.zeros(config.grid.shape, np.float32)
        log_odds[1, 2], log_odds[0, :3] = 3.0, -2.0
        return log_odds, 2.0, 0.5

    monkeypatch.setattr(maps, "make_map", stub)
    monkeypatch.setattr(map_log.plotting, "map_figure", drawn)
    return seen, drawn


def test_the_report_is_that_of_the_map(tmp_path, mapped):
    ranges = [1.0, 2.0, 5.0, math.inf, math.nan]
    path = logged(tmp_path, *((ranges, (0.5 * k, 0, 0)) for k in range(6)))
    report, cells, spec = make(tmp_path, path, resolution=0.25, max_range=5.0, fov=80.0)
    rows, columns = cells.shape
    assert spec.resolution == mapped[0].calls[0][0][2].grid.resolution == 0.25
    assert columns > rows + 4  # the robot drives along x
    p = 1 / (1 + math.exp(3.0)), 1 / (1 + math.exp(2.0))
    bits = sum(n * -(q * math.log2(q) + (1 - q) * math.log2(1 - q)) for n, q in zip((1, 3), p, strict=True))
    assert report["entropy_bits"] == pytest.approx(cells.size - 4 + bits, rel=1e-5)
    assert {name: report[name] for name in report if name not in ("beams_span_deg", "entropy_bits", "counts")} == {
        "log": "a.log",
        "scans": 6,
        "beams": 5,
        "beam_angles_from": "user",
        "max_range": 5.0,
        "ranges_below_max": 12,
        "cells": rows * columns,
        "shape": [rows, columns],
        "origin": list(spec.origin),
        "resolution": 0.25,
        "seen": 4,
        "occupied": 1,
        "free": 3,
        "mapping_s": 2.0,
        "compile_s": 0.5,
        "scans_per_s": 3.0,
    }
    assert report["beams_span_deg"] == pytest.approx(80)
    assert cells[1, 2] == OCCUPIED
    ((_, log_odds, grid, path), how) = mapped[1].calls[0]
    assert (log_odds.shape, grid, how["title"]) == (cells.shape, spec, "a.log: 6 scans, cells of 0.25 m")
    np.testing.assert_allclose(path, [[0.5 * k, 0, 0] for k in range(6)], rtol=0, atol=1e-9)


def test_options_reach_the_map(tmp_path, mapped, monkeypatch):
    path = logged(tmp_path, *(([1.0, 2.0, 3.0], (k, 0, 0)) for k in range(6)))
    monkeypatch.setattr(maps, "PIECE", 4)
    Params.from_std(v=1, w=1, range=1, bearing=1, l_occ=0.5, l_free=-0.25).save(tmp_path / "a.json")
    make(tmp_path, path)
    make(tmp_path, path, quick=True, params=tmp_path / "a.json", max_range=2.5)
    (params, log, config), (other, short, near) = (args for args, _ in mapped[0].calls)
    assert (float(params.l_occ), float(params.l_free)) == pytest.approx((0.85, -0.4))
    assert (float(other.l_occ), float(other.l_free)) == pytest.approx((0.5, -0.25))
    assert (len(log.scan), len(short.scan), len(short.truth)) == (6, 4, 4)
    assert (config.max_range, near.max_range, config.min_range) == (20, 2.5, 0.05)
    assert (log.scan.max(), short.scan.max()) == (3, 2.5)


def test_a_map_is_made_in_pieces_as_in_one(tmp_path, monkeypatch):
    """Of five scans in pieces of two, against NumPy: the map goes on; what fills up the last piece marks nothing."""
    rng = np.random.default_rng(0)
    angles = np.deg2rad(np.linspace(-60, 60, 7))
    poses = [(*rng.uniform(-1, 1, 2).round(3), 0.7 * k) for k in range(5)]
    path = logged(tmp_path, *((room(angles + pose[2], at=pose[:2]).round(3), pose) for pose in poses))
    monkeypatch.setattr(maps, "PIECE", 2)
    log, spec, config = maps.mappable(read(path, "carmen", fov=math.radians(120)), 0.25, 4.0)
    clock = iter([10.0, 12.0, 15.0])
    monkeypatch.setattr(maps, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    log_odds, *took = maps.make_map(course_params(), log, config)
    assert took == [3, 2]  # seconds of mapping, of compiling
    expected = np.zeros(spec.shape)
    scan = {"origin": spec.origin, "resolution": 0.25, "l_occ": 0.85, "l_free": -0.4}
    scan |= {"l_min": config.grid.l_min, "l_max": config.grid.l_max, "min_range": 0.05, "max_range": 4.0}
    for pose, ranges in zip(poses, log.scan, strict=True):
        expected = reference.update_scan(expected, np.array(pose), ranges, angles, **scan)
    assert np.sum(np.abs(log_odds - expected) > 1e-4) <= 2  # where float32 takes a beam through the corner of a cell
    assert np.sum(expected != 0) > 100


@pytest.mark.parametrize(("below", "said"), [(4, True), (5, False)])
def test_few_ranges_below_the_limit_are_doubtful(tmp_path, below, said):
    """Fewer than one in twenty of those that measure anything."""
    ranges = [1.0] * below + [30.0] * (100 - below) + [math.nan] * 50
    log = read(logged(tmp_path, (ranges, (0, 0, 0))), "carmen", fov=3.0)
    words = " ".join(maps.scan_doubts(log, 20.0))
    assert (f"only {below} of 100 ranges lie below" in words) == said


def test_the_grid_holds_everything_with_a_metre_around_it(tmp_path):
    """On whole cells, rows along y."""
    path = logged(tmp_path, ([2.0, 3.0, 4.0], (10.1, 20.1, math.pi / 2)))
    spec = maps.extent(read(path, "carmen", fov=math.pi), 0.5)
    # A beam of 2 m to the right, of 3 m ahead, of 4 m to the left: x from 6.1 to 12.1, y from 20.1 to 23.1.
    assert (spec.origin, spec.shape) == ((5.0, 19.0), (11, 17))


# --- the small cases beside the real data


@pytest.fixture
def cases():
    root = os.environ.get("JAXLOCMAP_DATA")
    folder = Path(root or "nowhere").parent / "cases"
    if not (root and folder.is_dir()):
        pytest.skip("needs the folder cases beside the real data")
    return folder


@pytest.mark.parametrize("name", ["25m", "35m", "81.83m", "inf"])
def test_case_returns(tmp_path, cases, name):
    report, *_ = make(tmp_path, cases / f"returns_{name}.log", resolution=0.5)
    assert (report["occupied"], 2363 < report["seen"] < 2513) == (1, True)


@pytest.mark.parametrize("name", ["fov_541_270deg", "fov_181_180deg"])
def test_case_fov(tmp_path, cases, name):
    report, cells, spec = make(tmp_path, cases / f"{name}.log")
    hits = centres(cells, spec, OCCUPIED)
    assert np.all(off_walls(hits, 5, 3) < 0.1)
    assert np.any(hits[:, 0] < -2.9) == ("541" in name)
    assert report["beam_angles_from"] == "log"


def test_case_utm(tmp_path, cases):
    _, here, spec = make(tmp_path, cases / "local.log.gz", resolution=0.1)
    _, there, moved = make(tmp_path, cases / "utm.log.gz", resolution=0.1)
    np.testing.assert_array_equal(there, here)
    np.testing.assert_allclose(np.subtract(moved.origin, spec.origin), [388096, 3948996], rtol=0, atol=1e-6)


def test_case_centimetres(tmp_path, cases):
    refused(lambda: make(tmp_path, cases / "centimetres.log"), "no range lies below the limit", "is the unit metres?")
