"""Whatever is in a file, its reader returns what it promises, or raises an error that names the file.

JAXLOCMAP_FUZZ says how many damaged files all readers together get, 2,000 by default:

    JAXLOCMAP_FUZZ=50000 pytest -s tests/test_fuzz.py
"""

import codecs
import dataclasses
import gzip
import io
import json
import math
import os
import re
import resource
import shutil
import struct
import time
import warnings
import zlib

import jax
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from PIL import EpsImagePlugin, Image
from test_checkpoint import ARRAYS, STUDY
from test_logs import MRCLAM, woods

from jaxlocmap import Params, logs
from jaxlocmap.logs.matlab import read_matrices
from jaxlocmap.mapping.ros import load_map
from jaxlocmap.monte_carlo.checkpoint import Checkpoint, _own_digest
from jaxlocmap.monte_carlo.lock import Lock

INPUTS = int(os.environ.get("JAXLOCMAP_FUZZ", "2000"))
LONGEST, MOST, WORDS = 5, 2**20, 2000  # s of the processor for a file, KiB for all, characters of a message
STAMPS = np.array([0.0, 1.0, 2.0])


@pytest.fixture(scope="module", autouse=True)
def memory():
    """The peak of the whole file's tests."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    print(f"\npeak memory grew by {grown / 2**10:.0f} MiB")
    assert grown < MOST


# --- What the readers promise ---


def sound_log(log):
    for field in dataclasses.fields(log):
        value = getattr(log, field.name)
        if isinstance(value, np.ndarray) and field.name != "scan":
            assert np.all(np.abs(value) <= 1e12), field.name
    assert log.odometry.shape == (len(log.odometry_time), 2)
    assert log.observation.shape == (len(log.observation_time), 2)
    assert log.truth.shape == (len(log.truth_time), 3)
    assert log.scan.shape == (len(log.scan_time), len(log.beam_angles))
    assert np.all(np.isnan(log.scan) | (log.scan > 0))
    assert np.all(log.observation[:, 0] > 0)
    assert np.all((log.observation_landmark >= 0) & (log.observation_landmark < len(log.landmarks)))
    assert np.all(np.diff(log.beam_angles) >= 0)
    assert log.scan_max_range > 0
    assert min(log.counts.values(), default=0) >= 0


def read_woods(folder):
    log = logs.read_woods(folder / "log.mat")
    sound_log(log)
    assert np.all(np.diff(log.odometry_time) > 0)
    assert np.all(np.diff(log.truth_time) > 0)
    assert min(log.stated_variance.values()) > 0


def read_poses(folder):
    stamps, pose, cov, counts = logs.read_trajectory(folder / "poses")
    assert np.all(np.isfinite(stamps))
    assert np.all(stamps[1:] > stamps[:-1])
    assert pose.shape == (len(stamps), 3)
    assert cov is None or cov.shape == (len(stamps), 3, 3)
    assert min(counts.values()) >= 0


def read_innovations(folder):
    found = logs.read_innovations(folder / "nu.csv", STAMPS)
    steps, slots, size = found["innovation"].shape
    assert steps == len(STAMPS)
    assert found["S"].shape == (steps, slots, size, size)
    np.testing.assert_array_equal(found["S"], found["S"].swapaxes(-1, -2))
    assert found["observed"].any(0).all()
    for name in found.keys() - {"innovation", "S"}:
        assert found[name].shape == (steps, slots)


def read_map(folder):
    cells, spec = load_map(folder / "map.yaml")
    assert cells.shape == spec.shape
    assert cells.dtype == np.int8
    assert -1 <= cells.min() <= cells.max() <= 100
    assert math.isfinite(spec.resolution) > 0
    assert np.all(np.isfinite(spec.origin))


def read_params(folder):
    params = Params.load(folder / "params.json")
    params.check()
    assert all(np.all(np.isfinite(value)) for value in jax.tree.leaves(params))


def go_on(folder):
    """With the study in the folder: with its parts that are whole, touching nothing."""
    was = contents(folder / "parts")
    whole = {part for part in range(8) if was[f"part-{part:03d}"] == SOUND["study"][f"parts/part-{part:03d}"]}
    parts = Checkpoint(folder, resume=True)
    try:
        assert parts.open(STUDY, range(8)) == whole
        for part in whole:
            assert all(map(np.array_equal, parts.load(part), ARRAYS))
        for part in set(range(8)) - whole:
            with pytest.raises(ValueError, match="got a damaged file"):
                parts.load(part)
    finally:
        parts.release()
        assert contents(folder / "parts") == was


def contents(folder):
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


READERS = {
    "woods": read_woods,
    "mrclam": lambda folder: sound_log(logs.read_mrclam(folder, 1)),
    "carmen": lambda folder: sound_log(logs.read_carmen(folder / "a.log")),
    "raw carmen": lambda folder: sound_log(logs.read_carmen(folder / "a.log")),
    "tum": read_poses,
    "csv": read_poses,
    "ros": read_poses,
    "innovations": read_innovations,
    "pgm": read_map,
    "png": read_map,
    "tiff": read_map,
    "gif": read_map,
    "jpeg": read_map,
    "params": read_params,
    "study": go_on,
}


# --- Sound files ---


def rows(*lines, separator=" "):
    return "".join(separator.join(map(str, line)) + "\n" for line in lines).encode()


def sheet(picture):
    return (
        f"image: {picture}\nresolution: 0.5\norigin: [1, 2, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    ).encode()


def picture(pixels, format="png", mode=None, **options):
    content = io.BytesIO()
    Image.fromarray(np.asarray(pixels, np.uint8)).convert(mode).save(content, format, **options)
    return content.getvalue()


@pytest.fixture(scope="module", autouse=True)
def sound(tmp_path_factory):
    """Of each reader the files of a folder, by their names."""
    folder = tmp_path_factory.mktemp("sound")
    parts = Checkpoint(folder / "study", discard=True)
    parts.open(STUDY, range(8))
    for part in range(8):
        parts.save(part, ARRAYS)
    parts.release()
    Params.from_std(v=0.1, w=0.1, range=0.1, bearing=0.1).save(folder / "params.json")
    woods(folder / "log.mat", r=np.array([[1, 0], [0, 2], [0, 0], [3, 4]], np.float32))
    upper, ros = ("xx", "xy", "xt", "yy", "yt", "tt"), [f"cov_{i}" for i in range(36)]
    SOUND.update(
        {
            "woods": {"log.mat": (folder / "log.mat").read_bytes()},
            "mrclam": {name: text.encode() for name, text in MRCLAM.items()},
            "carmen": {
                "a.log": b"PARAM laser_front_laser_fov 180\nPARAM robot_front_laser_max 50\n"
                b"FLASER 3 1 2 3 1 2 0.5 7 8 9 99 host 3.5\nFLASER 3 1 99 3 1 2 0.5 7 8 9 99 host 3.7\n"
                b"ROBOTLASER1 0 -1.57 3.14159 1.570795 80 0.01 0 3 1 2 99 1 5 1 2 0.5 7 8 9 0.1 0.2 0 0 0 4 host 4\n"
            },
            "raw carmen": {
                "a.log": b"PARAM robot_frontlaser_offset 0.1\nODOM 1 2 3 0.1 0 0 2 host 2\n"
                b"RAWLASER1 0 -1.57 3.14159 1.570795 80 0.01 0 3 1 2 99 0 2.5 host 2.5\n"
                b"ODOM 1.1 2 3.1 0.1 0 0 3 host 3\n"
            },
            "tum": {"poses": b"# t x y z q\n" + rows(*([t, 1, 2, 0, 0, 0, 0.6, 0.8] for t in (0, 1, 2)))},
            "csv": {
                "poses": rows(
                    ("t", "x", "y", "theta", *upper), *([t, 1, 2, 0, 1, 0, 0, 1, 0, 1] for t in (0, 1)), separator=","
                )
            },
            "ros": {
                "poses": rows(
                    ("t", "x", "y", "z", "qx", "qy", "qz", "qw", *ros),
                    *([t, 1, 2, 0, 0, 0, 0.6, 0.8, *np.eye(6).ravel()] for t in (0, 1)),
                    separator=",",
                )
            },
            "innovations": {
                "nu.csv": rows(
                    ("t", "nu0", "nu1", "S00", "S01", "S11", "landmark", "accepted"),
                    *([t, 0.1, -0.1, 1, 0.1, 2, 3, 1] for t in (0, 0, 1.5)),
                    separator=",",
                )
            },
            "pgm": {"map.yaml": sheet("map.pgm"), "map.pgm": b"P5\n3 2\n255\n" + bytes([0, 254, 205, 100, 205, 205])},
            "png": {
                "map.yaml": sheet("map.png") + b"mode: scale\n",
                "map.png": picture([[0, 254], [205, 100]], mode="P", transparency=3),
            },
            **{
                kind: {"map.yaml": sheet("map"), "map": picture([[0, 254], [205, 100]], kind)}
                for kind in ("tiff", "gif", "jpeg")
            },
            "params": {"params.json": (folder / "params.json").read_bytes()},
            "study": contents(folder / "study"),
        }
    )
    assert SOUND.keys() == READERS.keys()


SOUND = {}


# --- Damage ---

NASTY = [
    *(
        b"nan",
        b"inf",
        b"-inf",
        b"1e308",
        b"-1e308",
        b"1e154",
        b"1e-320",
        b"0",
        b"-0.0",
        b"-1",
        b"0.5",
        b"1e13",
        b"1e11",
    ),
    *(
        b"9" * 5000,
        b"0x10",
        b"1_0",
        "١٢".encode(),
        b"\xff\xfe",
        b"",
        b"\0",
        b"\r",
        b",",
        b'"',
        b"#",
        b"%",
        b"4294967295",
    ),
    *(b"[" * 3000, b'{"a":' * 3000, b"&a [*a, *a]", b"!!python/name:os.system", b"!!binary x", b"<<: 1", b"2001-13-45"),
    *(
        b"1:59" * 50,
        b"true",
        b"null",
        b'"\\ud800"',
        b"P1",
        b"P7",
        b"FLASER",
        b"ODOM",
        b"covariance 3",
        b"nu2",
        b"part-009",
    ),
]
NUMBERS = [0, 1, 2, 7, 14, 15, 64, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 0x7F800001, 0xFFC00001, 2**27]
TOKEN = re.compile(rb"[^\s,:\[\]{}]+")


def replaced(data, begin, end, new):
    return data[:begin] + new + data[end:]


def token(data, where, change):
    found = list(TOKEN.finditer(data))
    if not found:
        return data
    at = found[int(where * len(found))]
    return replaced(data, *at.span(), change(at[0]))


def line(data, where, change):
    lines = data.splitlines(keepends=True) or [b""]
    at = int(where * len(lines))
    return b"".join([*lines[:at], change(lines[at]), *lines[at + 1 :]])


def swapped(data, where, which, pattern):
    pieces = re.split(pattern, data)
    i, j = int(where * len(pieces)), int(which * len(pieces))
    pieces[i], pieces[j] = pieces[j], pieces[i]
    return b"".join(pieces)


def any_of(some, which):
    return list(some)[int(which * len(some))]


def many(piece, times):
    return piece * min(int(times), 2**20 // max(len(piece), 1))


def flip(data, where, which):
    at = int(where * len(data))
    return replaced(data, at, at + 1, bytes([data[at] ^ 1 << int(8 * which)])) if data else data


def number(data, where, which):
    """Four bytes become a number, as they lie in binary files."""
    at = int(where * len(data)) // 4 * 4
    return replaced(data, at, at + 4, struct.pack("<I" if at % 8 else ">I", any_of(NUMBERS, which)))


def double(data, where, which):
    at = int(where * len(data)) // 8 * 8
    value = any_of((math.nan, math.inf, 1e308, -1e308, 1e-320, -1.0, 0.0), which)
    return replaced(data, at, at + 8, struct.pack("<d", value))


DAMAGE = {
    "flip": flip,
    "number": number,
    "double": double,
    "cut": lambda data, where, which: data[: int(where * len(data))],
    "hole": lambda data, where, which: replaced(data, int(where * len(data)), int(where * len(data) + 20 * which), b""),
    "insert": lambda data, where, which: replaced(
        data, int(where * len(data)), int(where * len(data)), any_of(NASTY, which)
    ),
    "field": lambda data, where, which: token(data, where, lambda old: any_of(NASTY, which)),
    "another": lambda data, where, which: token(data, where, lambda old: any_of(TOKEN.findall(data), which)),
    "no field": lambda data, where, which: token(data, where, lambda old: b""),
    "fields": lambda data, where, which: token(
        data, where, lambda old: many(old + any_of((b",", b" "), which), 20_000)
    ),
    "digits": lambda data, where, which: token(data, where, lambda old: many(old, 1 + which * 5000)),
    "swap": lambda data, where, which: swapped(data, where, which, rb"([\s,]+)"),
    "swap lines": lambda data, where, which: swapped(data, where, which, rb"(?<=\n)"),
    "no line": lambda data, where, which: line(data, where, lambda old: b""),
    "lines": lambda data, where, which: line(data, where, lambda old: many(old, 2 + which * 500)),
    "other": lambda data, where, which: any_of(any_of(SOUND.values(), where).values(), which),
    "tail": lambda data, where, which: data + any_of(any_of(SOUND.values(), where).values(), which),
    "zip": lambda data, where, which: gzip.compress(data, 1),
    "encode": lambda data, where, which: data.decode("latin-1").encode(
        any_of(("utf-16", "utf-16-be", "utf-8-sig", "utf-32"), which)
    ),
    "zeros": lambda data, where, which: data + bytes(int(2**20 * which)),
}


def sealed(name, data):
    """The same damage behind the check that its format has, as a program that writes nonsense leaves it."""
    if name.endswith(".mat"):
        packed = zlib.compress(data[128:], 1)
        return data[:128] + struct.pack("<II", 15, len(packed)) + packed
    if name.endswith(".png"):
        at, chunks = 8, [data[:8]]
        while at + 12 <= len(data):
            size = min(int.from_bytes(data[at : at + 4]), len(data) - at - 12)
            body = data[at + 4 : at + 8 + size]
            chunks.append(data[at : at + 4] + body + zlib.crc32(body).to_bytes(4))
            at += 12 + size
        return b"".join(chunks)
    if name.endswith("manifest.json"):
        try:
            found = json.loads(data)
            found["digest"] = _own_digest({key: found[key] for key in found.keys() - {"made by", "digest"}})
            return json.dumps(found).encode()
        except (ValueError, AttributeError, RecursionError):
            return data
    return data


shares = st.floats(0, 1, exclude_max=True)
damages = st.lists(st.tuples(st.sampled_from(list(DAMAGE)), shares, shares), min_size=1, max_size=4)


def held(reader, folder, path):
    """Read the folder, and see that only a sound result or an error that names the path comes of it; its words."""
    began, said = time.process_time(), ""
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            READERS[reader](folder)
        except (ValueError, OSError) as error:
            said = str(error)
            assert str(path) in said
            assert len(said) < WORDS
    assert not [str(warning.message) for warning in warned]
    assert time.process_time() - began < LONGEST
    return said


def laid(folder, files):
    """A folder of these files alone."""
    shutil.rmtree(folder, ignore_errors=True)
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


@pytest.mark.parametrize("reader", READERS)
def test_a_sound_file_is_read(reader, tmp_path):
    READERS[reader](laid(tmp_path / "sound", SOUND[reader]))


@pytest.mark.parametrize("reader", READERS)
def test_a_damaged_file_is_read_or_refused_by_name(reader, tmp_path_factory):
    folder = tmp_path_factory.mktemp("fuzz") / "damaged"

    @settings(max_examples=-(-INPUTS // len(READERS)))
    @example(0.9, [("zeros", 0.5, 0.8), ("fields", 0.7, 0.2), ("fields", 0.01, 0.7)], False)  # a picture's tags
    @example(0.9, [("digits", 0.7, 0.58)] * 2, False)  # a landmark of number inf
    @example(0.0, [("fields", 0.25, 0.0)], False)  # a header of 20,000 columns
    @example(0.0, [("digits", 0.09, 0.45)], False)  # a picture with a name of 15,000 letters
    @given(which=shares, damage=damages, seal=st.booleans())
    def check(which, damage, seal):
        files = dict(SOUND[reader])
        name = any_of(files, which)
        for kind, where, what in damage:
            files[name] = DAMAGE[kind](files[name], where, what)
        if seal:
            files[name] = sealed(name, files[name])
        laid(folder, files)
        held(reader, folder, folder if len(files) > 1 else folder / name)

    check()


# --- Faults that were once passed on ---


def element(kind, content):
    return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)


def variable(shape, kind, content):
    """A MATLAB file of one variable `t`."""
    parts = element(6, bytes([6, *bytes(7)])) + element(5, shape) + element(1, b"t") + element(kind, content)
    return sealed(".mat", bytes(124) + b"\0\1IM" + element(14, parts))


def header(columns, rows, kind, chunks=b""):
    """A PNG that ends after its header, in 8 bits."""
    size = struct.pack(">IIBBBBB", columns, rows, 8, kind, 0, 0, 0)
    png = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + b"IHDR" + size + bytes(4) + chunks
    return sealed(".png", png + struct.pack(">I", 1) + b"IDAT" + bytes(5))


PALETTE = struct.pack(">I", 768) + b"PLTE" + bytes(772)


@pytest.mark.parametrize(
    ("reader", "name", "bomb", "message"),
    [
        ("carmen", "a.log", lambda: gzip.compress(bytes(2**27 + 1), 1), "expected unpacked content of at most"),
        ("carmen", "a.log", lambda: gzip.compress(b"\n" * 2**26, 1), "no FLASER, ROBOTLASER1 or RAWLASER1 line"),
        ("tum", "poses", lambda: gzip.compress(b"\xff\xfe" + b"\0\xd8" * 2**26, 1)[:-9], "truncated or damaged gzip"),
        ("tum", "poses", lambda: codecs.BOM_UTF16_LE + b"\0\xd8" * 2**24, "utf-16"),
        ("csv", "poses", lambda: b"cov" * 340_000 + b",\n", "missing: 't'"),
        ("csv", "poses", lambda: b"a," * 500_000 + b"\n1", "missing: 't'"),
        (
            "innovations",
            "nu.csv",
            lambda: b",".join(b"nu%d" % i for i in range(100_000)) + b"\n1",
            "at most 10 components",
        ),
        (
            "woods",
            "log.mat",
            lambda: variable(struct.pack("<ii", 2**25, 1), 1, bytes(2**25)),
            "expected numbers of at most",
        ),
        ("woods", "log.mat", lambda: variable(bytes(2**24), 1, b""), r"t: damaged: dimensions \[(0, ){31}0\], 4 parts"),
        ("woods", "log.mat", lambda: variable(b"\xff\xff\xff\x7f" * 2, 9, bytes(8)), "t: cannot reshape"),
        ("png", "map.png", lambda: header(2**31 - 1, 2**31 - 1, 0), "Image size"),
        ("png", "map.png", lambda: header(11_000, 11_000, 3, PALETTE), "expected pixels of at most"),
        ("png", "map.png", lambda: header(1, 10**7, 0), "expected pixels of at most"),
        ("png", "map.yaml", lambda: sheet("map.png").replace(b"0.5", b"1" + b":59" * 300_000), "at most 65,536 bytes"),
        ("png", "map.yaml", lambda: b"a: &a [1]\nb: [*a, *a]", "expected no aliases"),
        ("png", "map.yaml", lambda: b"[" * 60_000, "RecursionError"),
        ("params", "params.json", lambda: b"[" + b"1," * 40_000, "at most 65,536 bytes"),
    ],
)
def test_what_is_far_larger_than_it_looks_is_refused_at_once(reader, name, bomb, message, tmp_path):
    folder = laid(tmp_path / "bomb", SOUND[reader] | {name: bomb()})
    assert re.search(message, held(reader, folder, folder / name))


@pytest.mark.parametrize(
    ("reader", "name", "old", "new", "message"),
    [
        ("csv", "poses", b"\n1,1", b"\n-1e308,1", "poses:3: t: expected a stamp of a size up to 1e+12, got -1e+308"),
        ("innovations", "nu.csv", b"2,3,1", b"2,0.5,1", "nu.csv:2: landmark: expected a whole number >= -1, got 0.5"),
        ("innovations", "nu.csv", b"2,3,1", b"2,nan,1", "nu.csv:2: landmark: expected a whole number >= -1, got nan"),
        ("innovations", "nu.csv", b"2,3,1", b"2,inf,1", "nu.csv:2: landmark: expected a whole number >= -1, got inf"),
        ("innovations", "nu.csv", b"2,3,1", b"2,3,nan", "nu.csv:2: accepted: expected 0 or 1, got nan"),
        ("pgm", "map.yaml", b"map.pgm", b"m" * 1001, "map.yaml: image: expected the name of a file, got 'mmm"),
        (
            "params",
            "params.json",
            b'"l_occ": ',
            b'"l_occ": "' + b"x" * 60_000 + b'", "x": ',
            "l_occ: expected numbers, got 'xxx",
        ),
        ("study", "parts/manifest.json", b'"runs": 30', b'"runs": 0', "whose manifest.json is damaged"),
        ("study", "parts/manifest.json", b'"runs": 30', b'"runs": "x"', "whose manifest.json is damaged"),
        ("study", "parts/manifest.json", b'"runs": 30', b'"walks": 30', "whose manifest.json is damaged"),
        ("study", "parts/manifest.json", b"", b" " * 2**20, "got others: manifest.json; none was touched"),
    ],
)
def test_a_fault_is_refused_by_name(reader, name, old, new, message, tmp_path):
    data = SOUND[reader][name].replace(old, new, 1)
    folder = laid(tmp_path / "fault", SOUND[reader] | {name: data if len(data) > 2**20 else sealed(name, data)})
    assert message in held(reader, folder, folder)


def test_stamps_of_a_matlab_file_too_far_apart_are_refused(tmp_path):
    path = woods(tmp_path / "log.mat", t=np.array([[-1e308], [0], [1], [1e308]]))
    assert "t: expected finite values of a size up to 1e+12" in held("woods", tmp_path, path)


def test_a_nan_of_another_pattern_is_one_without_a_warning(tmp_path):
    (tmp_path / "log.mat").write_bytes(variable(struct.pack("<ii", 1, 1), 7, struct.pack("<I", 0x7F800001)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isnan(read_matrices(tmp_path / "log.mat", ["t"])["t"])


def test_a_quaternion_beyond_numbers_is_no_heading(tmp_path):
    (tmp_path / "poses").write_text("0 1 2 0 0 0 1e200 1\n1 1 2 0 0 0 inf 0\n2 1 2 0 0 0 nan 1\n3 1 2 0 0 0 1 1\n")
    assert held("tum", tmp_path, tmp_path) == ""
    heading = logs.read_trajectory(tmp_path / "poses").pose[:, 2]
    np.testing.assert_allclose(heading, [np.nan, np.nan, np.nan, np.pi / 2], rtol=1e-15)


def test_observations_crowded_into_one_step_are_refused_before_they_fill_the_memory(tmp_path, monkeypatch):
    (tmp_path / "nu.csv").write_text("t,nu0,S00\n" + "9,0,1\n" * 40)
    monkeypatch.setenv("JAXLOCMAP_MAX_BYTES", str(3 * 40 * 2 * 8))
    assert held("innovations", tmp_path, tmp_path) == ""
    monkeypatch.setenv("JAXLOCMAP_MAX_BYTES", str(3 * 40 * 2 * 8 - 1))
    assert "innovations, every step having as many as the fullest" in held("innovations", tmp_path, tmp_path)


def test_a_picture_that_is_a_program_is_not_run(tmp_path, monkeypatch):
    monkeypatch.setattr(EpsImagePlugin, "Ghostscript", lambda *_, **__: pytest.fail("run"))
    drawing = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 2 2\n%%EndComments\n%%EOF\n"
    folder = laid(tmp_path / "map", SOUND["pgm"] | {"map.pgm": drawing})
    assert "expected a picture such as PGM or PNG" in held("pgm", folder, folder / "map.pgm")


@pytest.mark.parametrize("name", ["manifest.json", "part-003", ".lock-0"])
@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
@pytest.mark.parametrize("flags", [{"resume": True}, {"discard": True}])
def test_a_pipe_or_folder_in_a_study_s_place_is_not_waited_for_nor_removed(name, make, flags, tmp_path):
    laid(tmp_path, SOUND["study"])
    place = tmp_path / "parts" / name
    place.unlink(missing_ok=True)
    make(place)
    parts = Checkpoint(tmp_path, **flags)
    try:
        with pytest.raises((ValueError, OSError), match=re.escape(str(tmp_path))):
            parts.open(STUDY, range(8))
    finally:
        parts.release()
    assert place.exists()
    assert not place.is_file()


def test_a_lock_whose_owner_is_no_number_is_one_all_the_same(tmp_path):
    lock = Lock(tmp_path / ".lock-0")
    for said in ('{"process": 1e999, "host": 1}', "[" * 1000, "\xff", "[]", "{}"):
        (tmp_path / ".lock-0").write_text(said, encoding="latin-1")
        with pytest.raises(BlockingIOError, match="in use by another process"):
            Lock(tmp_path / ".lock-0")
    lock.release()
