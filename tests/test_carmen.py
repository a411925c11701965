"""CARMEN logs that the tests write: where beams point, what a range means, scanners of every line, damaged files."""

import math

import numpy as np
import pytest
from test_logs import data, flaser, refused, write  # noqa: F401

from jaxlocmap import logs
from jaxlocmap.logs.fan import Fan, directions, fits
from jaxlocmap.logs.text import numbers, table, whole


def param(name, value):
    return f"PARAM {name} {value} nohost 0\n"


def robotlaser(ranges, *, head="0 -2.356194 4.712389 0.008727 30.0 0.01 0", remissions=(), stamp=3.5, turn_axis="0.0 "):
    """The scanner at (1, 2, 0.5), the robot elsewhere."""
    counted = f"{len(ranges)} {' '.join(map(str, ranges))} {len(remissions)} {' '.join(map(str, remissions))}"
    return f"ROBOTLASER1 {head} {counted} 1 2 0.5 1.1 2.1 0.6 0.2 0.0 0.5 0.3 {turn_axis}100.5 host {stamp}\n"


def rawlaser(ranges, stamp):
    head = "0 -1.570796 3.141593 0.017453 81.9 0.01 0"
    return f"RAWLASER1 {head} {len(ranges)} {' '.join(map(str, ranges))} 0 99.0 host {stamp}\n"


def odom(x, y, theta, stamp):
    return f"ODOM {x} {y} {theta} 0 0 0 99.0 host {stamp}\n"


@pytest.fixture
def read(tmp_path):
    return lambda text, **said: logs.read_carmen(write(tmp_path / "a.log", text), **said)


# --- where the beams point


@pytest.mark.parametrize(
    ("beams", "lines", "first", "last"),
    [
        (541, [("laser_front_laser_fov", 4.71239), ("laser_front_laser_resolution", 0.5)], -135, 135),
        (541, [("laser_front_laser_fov", 270)], -135, 135),
        (540, [("laser_front_laser_fov", 270)], -135, 134.5),
        (540, [("laser_front_laser_fov", 270), ("laser_front_laser_resolution", 0.5)], -135, 134.5),
        (1081, [("laser_front_laser_resolution", 0.25)], -135, 135),
        (1080, [("laser_front_laser_resolution", 0.25)], -135, 134.75),
        (181, [("laser_front_laser_fov", 3.14159), ("laser_front_laser_resolution", 1.0)], -90, 90),
        (180, [("laser_front_laser_resolution", 1.0)], -90, 89),
        (180, [("laser_front_laser_resolution", 0.0174533)], -90, 89),
        (682, [("laser_front_laser_resolution", 0.3515625)], -119.70703125, 119.70703125),
        (361, [("laser_front_fov", 6.28319)], -180, 180),
        (360, [("robot_frontlaser_fov", 360)], -180, 179),
        (1000, [("robot_frontlaser_fov", 360)], -180, 179.64),
        (91, [("laser_front_laser_start_angle", -45), ("laser_front_laser_resolution", 1.0)], -45, 45),
        (91, [("laser_front_laser_start_angle", -0.5), ("laser_front_laser_resolution", 1.0)], -28.6479, 61.3521),
    ],
)
def test_beams_point_where_param_lines_say(read, beams, lines, first, last):
    log = read("".join(param(*line) for line in lines) + flaser([1.0] * beams))
    assert log.beam_angles_from == "log"
    np.testing.assert_allclose(np.rad2deg(log.beam_angles), np.linspace(first, last, beams), rtol=0, atol=1e-3)


def test_the_user_knows_better_than_the_log(read):
    text = param("laser_front_laser_fov", 90) + param("laser_front_laser_resolution", 1.0) + flaser([1.0] * 541)
    log = read(text, fov=np.deg2rad(270))
    assert log.beam_angles_from == "user"
    np.testing.assert_allclose(np.rad2deg(log.beam_angles), np.linspace(-135, 135, 541), rtol=0, atol=1e-9)
    refused(lambda: read(text), "a.log:3: beam angles: 541 beams 1 degrees apart do not span a field of view of 90")
    refused(lambda: read(param("laser_front_laser_resolution", 1.0) + flaser([1.0] * 541)), "more than a turn")
    assert read(flaser([1.0] * 181)).beam_angles_from == "assumed"


@pytest.mark.parametrize(("beams", "head", "first", "last"), [
    (541, "0 -2.356194 4.712389 0.008727 30.0 0.01 0", -135, 135),
    (540, "0 -2.356194 4.712389 0.008727 30.0 0.01 0", -135, 134.5),
    (11, "0 0.0 0.174533 0 30.0 0.01 0", 0, 10),
    (11, "0 0.0 0 0.0174533 30.0 0.01 0", 0, 10),
    (181, "0 0 0 0 30.0 0.01 0", -90, 90),
])  # fmt: skip
def test_robotlaser_states_its_fan(read, beams, head, first, last):
    log = read(robotlaser([1.0] * beams, head=head))
    np.testing.assert_allclose(np.rad2deg(log.beam_angles), np.linspace(first, last, beams), rtol=0, atol=1e-3)
    assert log.beam_angles_from == ("assumed" if beams == 181 else "log")


def test_directions_are_the_fans_own():
    np.testing.assert_array_equal(directions(Fan(3, fov=2.0)), [-1, 0, 1])
    np.testing.assert_array_equal(directions(Fan(3, fov=2.0, start=0.5)), [0.5, 1.5, 2.5])
    np.testing.assert_array_equal(directions(Fan(4, spacing=0.5)), [-0.75, -0.25, 0.25, 0.75])


@pytest.mark.parametrize(("share", "fit"), [(1.09, True), (1.11, False), (0.91, True), (0.89, False)])
def test_a_spacing_may_be_off_by_a_tenth(share, fit):
    fan = Fan(1001, fov=2.0, spacing=2e-3 / share)
    assert fits(fan) == fit
    if fit:
        np.testing.assert_allclose(directions(fan)[[0, -1]], [-1, 1], rtol=0, atol=2e-3)


# --- what a range means


def test_no_range_is_erased(read):
    far = [29.9, 30.0, 79.9, 120.0, math.inf, -1.0, 0.0, math.nan, -math.inf]
    log = read(flaser(far))
    np.testing.assert_array_equal(log.scan, [[29.9, 30, 79.9, 120, np.inf, np.nan, np.nan, np.nan, np.nan]])
    assert (log.counts["no_return"], log.counts["bad_ranges"]) == (1, 4)
    assert log.scan_max_range == math.inf


@pytest.mark.parametrize("name", ["robot_front_laser_max", "laser_front_laser_max_range", "robot_frontlaser_max"])
def test_a_stated_maximum_means_no_return(read, name):
    ranges = [79.9, 80.0, 81.0]
    log = read(param(name, 80) + flaser(ranges))
    np.testing.assert_array_equal(log.scan, [[79.9, np.inf, np.inf]])
    assert log.scan_max_range == 80
    np.testing.assert_array_equal(read(param(name, 80) + flaser(ranges), max_range=81).scan, [[79.9, 80, np.inf]])


def test_robotlaser_states_its_maximum(read):
    log = read(robotlaser([29.9, 30.0, math.inf], head="0 -1 2 1 30.0 0.01 0"))
    np.testing.assert_array_equal(log.scan, [[29.9, np.inf, np.inf]])
    assert log.scan_max_range == 30


# --- scanners and their poses


@pytest.mark.parametrize("turn_axis", ["0.0 ", ""])
def test_robotlaser_is_mapped_at_the_scanners_pose(read, turn_axis):
    ranges = np.linspace(1, 2, 541)
    log = read(robotlaser(ranges, remissions=[7.0] * 541, turn_axis=turn_axis) + robotlaser(ranges, stamp=4.5))
    np.testing.assert_array_equal(log.truth, [[1, 2, 0.5]] * 2)
    np.testing.assert_array_equal(log.scan, [ranges] * 2)
    np.testing.assert_array_equal(log.scan_time, [3.5, 4.5])


def test_a_laser_offset_moves_and_turns_every_pose(read):
    log = read(flaser([1.0] * 3, pose=(1, 2, np.pi / 2)) + flaser([1.0] * 3, pose=(0, 0, 0)), laser_offset=(2, 1, 0.25))
    np.testing.assert_allclose(log.truth, [[0, 4, np.pi / 2 + 0.25], [2, 1, 0.25]], rtol=0, atol=1e-15)


def test_rawlaser_gets_its_pose_from_odometry(read):
    lines = [odom(0, 0, 3.0, 1.0), rawlaser([1.0] * 3, 0.5), odom(2, 4, -3.0, 2.0), rawlaser([2.0] * 3, 1.5)]
    text = "".join(lines).replace("0.017453", "1.570796")
    log = read(text)
    np.testing.assert_allclose(log.truth, [[1, 2, np.pi]], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(log.scan, [[2, 2, 2]])
    assert log.counts["scans_without_pose"] == 1
    mounted = param("robot_frontlaser_offset", 0.5) + text
    np.testing.assert_allclose(read(mounted).truth, [[0.5, 2, np.pi]], rtol=0, atol=1e-12)
    np.testing.assert_allclose(read(mounted, laser_offset=(1, 0, 0)).truth, [[0, 2, np.pi]], rtol=0, atol=1e-12)
    assert read(text + "ODOM 1 2").counts["cut_lines"] == 1
    refused(lambda: read("ODOM 1 2\n" + text), "a.log:1: expected 8 columns")
    assert read(rawlaser([1.0] * 3, 1.0).replace("0.017453", "1.570796")).truth.shape == (0, 3)


def test_scans_whose_stamps_go_back_are_counted(read):
    log = read("".join(robotlaser([1.0] * 541, stamp=stamp) for stamp in (1.0, 2.0, 3.0, 2.5, 4.0)))
    assert log.counts["backward_stamps"] == 1
    assert log.scan_time.tolist() == [1, 2, 3, 2.5, 4]


def test_rawlaser_beside_scans_with_poses_is_a_copy(read):
    log = read(rawlaser([1.0] * 541, 1.0) + robotlaser([2.0] * 541))
    np.testing.assert_array_equal(log.scan, np.full((1, 541), 2.0))


def test_scans_of_another_fan_are_counted(read):
    text = flaser([9.0] * 4) + flaser([1.0] * 3) + flaser([2.0] * 3) + flaser([9.0] * 2)
    log = read(text)
    np.testing.assert_array_equal(log.scan[:, 0], [1, 2])
    np.testing.assert_array_equal(log.scan_line, [2, 3])
    assert log.counts["other_beam_counts"] == 2


# --- damaged files

LINES = (flaser([1.0, 2.0, 3.0]), robotlaser([1.0, 2.0, 3.0], head="0 -1 2 1 30.0 0.01 0"))


@pytest.mark.parametrize("line", LINES)
def test_a_cut_last_line_is_counted(read, line):
    """Wherever between two fields, or inside one, it was cut."""
    for end in [i for i, c in enumerate(line) if c == " " and i > len(line.split()[0])]:
        for cut in (line[:end], line[: end + 2]):
            if len(cut.split()) == len(line.split()):  # nothing but digits of the last stamp are missing
                continue
            log = read(line + cut)
            assert (len(log.scan), log.counts["cut_lines"]) == (1, 1)
            assert read(line + cut + "\n\n").counts["cut_lines"] == 1
            refused(lambda cut=cut: read(line + cut + "\n" + line), "a.log:2: expected")
    refused(lambda: read(line + line.replace("host", "host host")), "a.log:2: expected")


def test_a_cut_line_alone_is_no_scan(read):
    refused(lambda: read(LINES[0][:-9]), "no FLASER, ROBOTLASER1 or RAWLASER1 line", "a.log:1: expected 13 fields")


@pytest.mark.parametrize("kind", ["utf-8-sig", "utf-16", "utf-16-le with mark", "every line"])
def test_byte_order_marks(tmp_path, kind):
    text = LINES[0] * 3
    path = tmp_path / "a.log"
    if kind == "every line":
        path.write_bytes(b"".join(b"\xef\xbb\xbf" + LINES[0].encode() for _ in range(3)))
    else:
        path.write_bytes(("\ufeff" + text).encode("utf-16-le") if "mark" in kind else text.encode(kind))
    assert logs.read_carmen(path).scan.shape == (3, 3)


@pytest.mark.parametrize("field", ["2_5", "0x1p3", "1e", "\uff12", "2,5", "1d3", "--1", "\u0662"])
def test_only_decimal_numbers_of_ascii_are_numbers(tmp_path, field):
    path = tmp_path / "a.log"
    path.write_text(flaser([1.0, field, 3.0]), encoding="utf-8")
    refused(lambda: logs.read_carmen(path), f"{path}:1: range 2: expected a number, got")
    path.write_text(f"1.0 {field}\n", encoding="utf-8")
    refused(lambda: table(path, ("time", "v")), f"{path}:1: v: expected a finite number, got")
    refused(lambda: numbers([field], ("v",), "here"), "here: v: expected a finite number, got")
    refused(lambda: whole("n", field, "here", least=0), "here: n: expected a whole number >= 0, got")


@pytest.mark.parametrize(("field", "taken"), [("1e12", True), ("-1e12", True), ("1.01e12", False), ("-1.01e12", False)])
def test_numbers_are_taken_up_to_a_million_millions(field, taken):
    if taken:
        assert numbers([field], ["x"], "a:1") == [float(field)]
    else:
        refused(lambda: numbers([field], ["x"], "a:1"), "a:1: x: expected a number of a size up to 1e+12")


def test_whole_numbers():
    assert whole("n", "0180", "here", least=2) == 180
    for field in ("1", "-3", "+3", "3.0", "", "9" * 5000, "\u00b2"):
        refused(lambda field=field: whole("n", field, "here", least=2), "here: n: expected a whole number >= 2, got")


@pytest.mark.parametrize(("name", "value", "said"), [
    ("laser_front_laser_fov", -1, "expected an angle in (0, 2 pi] rad"),
    ("laser_front_laser_fov", 400, "expected an angle in (0, 2 pi] rad"),
    ("laser_front_laser_resolution", 0, "expected an angle in (0, 2 pi] rad"),
    ("laser_front_laser_resolution", "half", "expected a finite number, got 'half'"),
    ("robot_front_laser_max", 0, "expected metres > 0"),
])  # fmt: skip
def test_a_bad_param_line_is_named(read, name, value, said):
    refused(lambda: read(param(name, value) + LINES[0]), f"a.log:1: {name}: {said}")


@pytest.mark.parametrize(("head", "said"), [
    ("0 nan 2 1 30 0 0", "start_angle: expected a finite number"),
    ("0 -1 7 1 30 0 0", "field_of_view: expected an angle in (0, 2 pi] rad, got 7"),
    ("0 -1 2 -1 30 0 0", "angular_resolution: expected an angle"),
    ("0 -1 2 0.1 30 0 0", "beam angles: 3 beams"),
    ("0 -1 2 1 far 0 0", "maximum_range: expected a number, got 'far'"),
])  # fmt: skip
def test_a_bad_robotlaser_head_is_named(read, head, said):
    refused(lambda: read(robotlaser([1.0] * 3, head=head)), f"a.log:1: {said}")


@pytest.mark.parametrize(("said", "expected"), [
    ({"fov": 0.0}, "fov: expected an angle in (0, 2 pi] rad, got 0.0"),
    ({"fov": 270}, "fov: expected an angle in (0, 2 pi] rad, got 270"),
    ({"fov": math.nan}, "fov: expected an angle"),
    ({"max_range": 0.0}, "max_range: expected metres > 0, got 0.0"),
    ({"max_range": math.nan}, "max_range: expected metres > 0"),
    ({"laser_offset": (0, math.inf, 0)}, "laser_offset: expected finite (dx, dy, dtheta)"),
    ({"laser_offset": (0, 0)}, "laser_offset: expected finite (dx, dy, dtheta)"),
])  # fmt: skip
def test_arguments_out_of_range(read, said, expected):
    refused(lambda: read(LINES[0], **said), expected)


def test_read_passes_the_scanner_on_and_to_no_other_format(tmp_path):
    path = write(tmp_path / "a.log", flaser([1.0] * 3))
    np.testing.assert_allclose(logs.read(path, "carmen", fov=2.0).beam_angles, [-1, 0, 1], rtol=0, atol=1e-15)
    refused(lambda: logs.read(path, "woods", fov=2.0), "fov: expected nothing: format woods has no laser scanner")


def test_the_record_checks_what_is_said_of_scans():
    scan = {"scan_time": np.zeros(2), "scan": np.ones((2, 3)), "beam_angles": np.zeros(3)}
    refused(lambda: logs.Log("a", **scan, scan_line=np.zeros(1, np.int32)), "scan_line: expected shape (2)")
    refused(lambda: logs.Log("a", **scan, scan_max_range=0.0), "scan_max_range: expected metres > 0, got 0.0")


# --- the small cases beside the real data


@pytest.fixture
def cases(data):  # noqa: F811
    folder = data.parent / "cases"
    if not folder.is_dir():
        pytest.skip("needs the folder cases beside the real data")
    return folder


@pytest.mark.parametrize(("name", "scans", "cut"), [("bom", 3, 0), ("cut_last_line", 3, 1), ("robotlaser1", 3, 0)])
def test_cases(cases, name, scans, cut):
    log = logs.read_carmen(cases / f"{name}.log")
    assert log.scan.shape == (scans, 180)
    assert log.counts["cut_lines"] == cut
    np.testing.assert_array_equal(log.truth, [[1, 2, 0.5]] * scans)
    np.testing.assert_allclose(np.rad2deg(log.beam_angles), np.arange(-90, 90), rtol=0, atol=1e-4)


def test_case_underscore(cases):
    refused(lambda: logs.read_carmen(cases / "underscore.log"), "underscore.log:1: range 1: expected a number")
