"""Files are written whole or not at all, read within limits, and every fault names its file."""

import gzip
import json
import os
import resource
import stat
import struct
import zlib

import numpy as np
import pytest
from disks import full_disk

from jaxlocmap import Params, files, logs
from jaxlocmap.logs import matlab

PARAMS = Params.from_std(v=0.1, w=0.1, range=0.1, bearing=0.1)


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("report.json", lambda path: files.write(path, "x" * 100)),
        ("params.json", PARAMS.save),
        ("a.tum", lambda path: logs.write_tum(path, [0.0, 1.0], np.zeros((2, 3)))),
    ],
)
def test_a_full_disk_leaves_what_was_there(tmp_path, name, write):
    path = tmp_path / name
    path.write_text("before")
    with full_disk(room=10), pytest.raises(OSError, match=f"File too large: '{path}'"):
        write(path)
    assert [file.name for file in tmp_path.iterdir()] == [name]
    assert path.read_text() == "before"
    write(path)
    assert path.stat().st_size > 40


def test_what_a_link_points_to_stays(tmp_path):
    outside, path = tmp_path / "outside", tmp_path / "report.json"
    outside.write_text("mine")
    path.symlink_to(outside)
    PARAMS.save(path)
    assert outside.read_text() == "mine"
    assert not path.is_symlink()
    np.testing.assert_array_equal(Params.load(path).Q, PARAMS.Q)


def test_a_file_is_written_under_a_name_that_is_new_each_time_with_the_rights_of_any_other(tmp_path):
    names = []
    for _ in range(2):
        with files.writing(tmp_path / "a.png") as temporary:
            temporary.write_bytes(b"x")
            names.append(temporary.name)
            assert temporary.suffix == ".png"
            assert files.left_behind(tmp_path, "a.png") == [temporary]
            assert files.left_behind(tmp_path, "b.png") == files.left_behind(tmp_path, "a") == []
    assert names[0] != names[1]
    (tmp_path / "b").touch()
    modes = {stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("a.png", "b")}
    assert len(modes) == 1


def test_what_is_raised_while_writing_leaves_nothing(tmp_path):
    def half(path):
        with files.writing(path) as temporary:
            temporary.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        half(tmp_path / "a")
    assert not list(tmp_path.iterdir())


# --- Limits ---


def test_more_than_the_limit_is_refused_and_the_limit_can_be_raised(tmp_path, monkeypatch):
    path = tmp_path / "a.tum"
    path.write_text("1 2 3 0 0 0 0 1\n" * 100)
    monkeypatch.setenv("JAXLOCMAP_MAX_BYTES", "1000")
    told = "a.tum: expected a file of at most 1,000 bytes, got more; JAXLOCMAP_MAX_BYTES raises the limit"
    with pytest.raises(ValueError, match=told):
        logs.read_trajectory(path)
    monkeypatch.setenv("JAXLOCMAP_MAX_BYTES", "1600")
    assert len(logs.read_trajectory(path).time) == 1
    for wrong in ("0", "-1", "many", "1e9", ""):
        monkeypatch.setenv("JAXLOCMAP_MAX_BYTES", wrong)
        with pytest.raises(ValueError, match="JAXLOCMAP_MAX_BYTES: expected a number of bytes > 0"):
            logs.read_trajectory(path)


def test_a_file_of_just_the_limit_is_read_which_is_128_mib_unless_said(tmp_path, monkeypatch):
    monkeypatch.delenv("JAXLOCMAP_MAX_BYTES", raising=False)
    assert files.most_bytes() == 128 * 2**20
    path, text = tmp_path / "a", b"x" * 100
    path.write_bytes(text)
    for limit, fine in ((100, True), (99, False)):
        monkeypatch.setenv("JAXLOCMAP_MAX_BYTES", str(limit))
        for read in (lambda: files.read(path), lambda: files.unzipped(path, gzip.compress(text))):
            if fine:
                assert read() == text
            else:
                with pytest.raises(ValueError, match=f"a: expected .* of at most {limit} bytes, got more"):
                    read()


def packed(element):
    """A MATLAB file of one compressed element."""
    content = zlib.compress(element)
    return bytes(124) + b"\0\1IM" + (15).to_bytes(4, "little") + len(content).to_bytes(4, "little") + content


@pytest.mark.parametrize("bomb", ["gzip", "matlab"])
def test_a_small_file_that_unpacks_to_gigabytes_is_refused_within_the_limit(tmp_path, monkeypatch, bomb):
    monkeypatch.setenv("JAXLOCMAP_MAX_BYTES", str(2**22))
    path = tmp_path / "bomb"
    path.write_bytes(gzip.compress(bytes(2**26)) if bomb == "gzip" else packed(bytes(2**26)))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # KiB
    with pytest.raises(ValueError, match="bomb: expected unpacked content of at most 4,194,304 bytes"):
        matlab.read_matrices(path, ("t",))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2**15


def test_a_line_without_end_is_refused(tmp_path):
    path = tmp_path / "a.log"
    path.write_text("FLASER 2 1 1 0 0 0 0 0 0 0 h 0\nFLASER " + "1 " * 2**20)
    with pytest.raises(ValueError, match=r"a\.log:2: expected lines of at most 1,048,576 bytes, got 2,097,159"):
        logs.read_carmen(path)


# --- Kinds of files, and faults of their content ---


@pytest.mark.parametrize("read", [logs.read_trajectory, logs.read_carmen, logs.read_woods, Params.load])
def test_what_is_no_file_is_refused_before_it_is_read(tmp_path, read):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, "/dev/zero"):
        with pytest.raises(ValueError, match=f"^{path}: expected a file, got a folder or a device$"):
            read(path)
    (tmp_path / "link").symlink_to(tmp_path / "gone")
    with pytest.raises(FileNotFoundError, match="link: a link to nothing"):
        read(tmp_path / "link")


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000,
        "1" * 5000,
        '{"Q": ' + "9" * 5000 + "}",
        "\udcff",
        '{"Q": 1e999, "R": 1, "l_occ": 1, "l_free": 1}',
        "",
    ],
)
def test_whatever_is_wrong_with_parameters_names_their_file(tmp_path, text):
    path = tmp_path / "params.json"
    path.write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(ValueError, match=r"params\.json: "):
        Params.load(path)


def test_whatever_a_reader_raises_leaves_with_the_path_of_its_file():
    for error in (
        *(KeyError("x"), RecursionError(), MemoryError(), TypeError("y"), ZeroDivisionError()),
        *(EOFError(), struct.error(), NotImplementedError(), AssertionError()),
    ):
        with (
            pytest.raises(
                ValueError, match=f"^here: expected a log, got one that cannot be read: {type(error).__name__}$"
            ),
            files.reading("here", "a log"),
        ):
            raise error
    with pytest.raises(ValueError, match=r"^here: wrong$"), files.reading("here", "a log"):
        raise ValueError("wrong")
    with pytest.raises(ValueError, match=r"^here: w{1000} \.\.\.$"), files.reading("here", "a log"):
        raise ValueError("here: " + "w" * 2000)
    with pytest.raises(ValueError, match=r"^here/below: wrong$"), files.reading("here", "a log"):
        raise ValueError("here/below: wrong")
    with pytest.raises(FileNotFoundError, match=r"^gone$"), files.reading("here", "a log"):
        raise FileNotFoundError("gone")


def test_a_truth_that_is_a_link_to_nothing_is_not_no_truth(tmp_path):
    (tmp_path / "Barcodes.dat").write_text("6 63\n")
    (tmp_path / "Landmark_Groundtruth.dat").write_text("6 1 0 0 0\n")
    (tmp_path / "Robot1_Odometry.dat").write_text("0 0.1 0\n1 0.1 0\n")
    (tmp_path / "Robot1_Measurement.dat").write_text("0.5 63 1 0\n")
    assert not len(logs.read_mrclam(tmp_path, 1).truth)
    (tmp_path / "Robot1_Groundtruth.dat").symlink_to(tmp_path / "gone")
    with pytest.raises(FileNotFoundError, match=r"Robot1_Groundtruth\.dat: a link to nothing"):
        logs.read_mrclam(tmp_path, 1)
    (tmp_path / "Robot1_Odometry.dat").write_text("0 0.1 0\n1e300 0.1 0\n")
    with pytest.raises(
        ValueError, match=r"Odometry\.dat:2: time: expected a number of a size up to 1e\+12, got '1e300'"
    ):
        logs.read_mrclam(tmp_path, 1)


def test_a_report_is_json_whole(tmp_path):
    files.write(tmp_path / "a.json", json.dumps({"ä": 1}, ensure_ascii=False))
    assert json.loads((tmp_path / "a.json").read_text(encoding="utf-8")) == {"ä": 1}
