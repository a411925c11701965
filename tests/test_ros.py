"""Maps as files: what is written comes back cell for cell, and a damaged file is named."""

import math

import numpy as np
import pytest
from PIL import Image

from jaxlocmap import GridSpec
from jaxlocmap.mapping.ros import FREE, OCCUPIED, UNKNOWN, load_map, save_map, trinary

SHEET = "image: map.pgm\nresolution: 0.5\norigin: [1, 2, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
GREYS = bytes([0, 254, 205, 100, 205, 205])  # 3 columns, 2 rows, the upper row first


def written(folder, sheet=SHEET, picture=b"P5\n3 2\n255\n" + GREYS):
    (folder / "map.yaml").write_text(sheet)
    (folder / "map.pgm").write_bytes(picture)
    return folder / "map.yaml"


def nats(probability):
    return math.log(probability / (1 - probability))


# --- What is written ---


@pytest.mark.parametrize(
    ("origin", "resolution", "shape"),
    [
        ((0.0, 0.0), 0.2, (4, 7)),
        ((-12.345678901234567, 1e-5), 0.05, (9, 2)),
        ((1e4, -3.5), 1 / 3, (1, 1)),
        (np.array([-0.1, 0.7]), np.float64(0.1), (5, 3)),
    ],
)
def test_a_map_comes_back_cell_for_cell(tmp_path, origin, resolution, shape):
    log_odds = np.random.default_rng(0).normal(0, 2, shape)
    cells = save_map(tmp_path, log_odds, GridSpec(origin, resolution, shape), name="kitchen")
    loaded = load_map(tmp_path / "kitchen.yaml")
    np.testing.assert_array_equal(loaded.cells, cells)
    np.testing.assert_array_equal(cells, trinary(log_odds))
    assert loaded.spec == GridSpec(tuple(map(float, origin)), float(resolution), shape)
    assert cells.dtype == loaded.cells.dtype == np.int8


@pytest.mark.parametrize(("occupied_above", "free_below"), [(0.9, 0.3), (0.15, 0.1), (0.5, 0.003)])
def test_a_map_sorted_by_other_thresholds_comes_back_as_it_was_sorted(tmp_path, occupied_above, free_below):
    # The picture has one grey for unknown: a sheet with these thresholds would call it free, or occupied.
    log_odds = np.linspace(-7, 7, 60).reshape(6, 10)
    spec = GridSpec((0.0, 0.0), 0.1, (6, 10))
    cells = save_map(tmp_path, log_odds, spec, occupied_above=occupied_above, free_below=free_below)
    assert {OCCUPIED, FREE, UNKNOWN} == set(np.unique(cells))
    np.testing.assert_array_equal(load_map(tmp_path / "map.yaml").cells, cells)


def test_the_cell_at_the_top_left_is_the_first_pixel(tmp_path):
    log_odds = np.zeros((3, 4))
    log_odds[2, 0] = 4  # the highest y, the lowest x
    log_odds[0, 3] = -4  # the lowest y, the highest x
    save_map(tmp_path, log_odds, GridSpec((0.0, 0.0), 1.0, (3, 4)))
    picture = (tmp_path / "map.pgm").read_bytes()
    assert picture == b"P5\n4 3\n255\n" + bytes([0, *[205] * 10, 254])


def test_the_sheet_is_what_map_server_reads(tmp_path):
    save_map(tmp_path, np.zeros((2, 2)), GridSpec((-1.5, 2.0), 0.05, (2, 2)))
    assert (tmp_path / "map.yaml").read_text() == (
        "image: map.pgm\nmode: trinary\nresolution: 0.05\norigin: [-1.5, 2.0, 0.0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )


def test_cells_are_sorted_by_probability_the_thresholds_themselves_being_unknown():
    at = np.array([[0.64, 0.66, 0.5], [0.197, 0.195, 0.0001]])
    np.testing.assert_array_equal(
        trinary(np.vectorize(nats)(at)), [[UNKNOWN, OCCUPIED, UNKNOWN], [UNKNOWN, FREE, FREE]]
    )
    edges = np.array([[nats(0.65), nats(0.196), math.nan, math.inf, -math.inf]])
    np.testing.assert_array_equal(trinary(edges), [[UNKNOWN, UNKNOWN, UNKNOWN, OCCUPIED, FREE]])
    np.testing.assert_array_equal(trinary(np.zeros((1, 1)), occupied_above=0.4, free_below=0.3), [[OCCUPIED]])


@pytest.mark.parametrize(("occupied_above", "free_below"), [(0.2, 0.3), (0.5, 0.5), (1.0, 0.2), (0.6, 0.0)])
def test_thresholds_out_of_order_are_refused(tmp_path, occupied_above, free_below):
    with pytest.raises(ValueError, match="thresholds: expected 0 < free_below < occupied_above < 1"):
        trinary(np.zeros((1, 1)), occupied_above=occupied_above, free_below=free_below)


def test_log_odds_of_another_shape_than_the_grid_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"log_odds: expected shape \(3, 4\), got \(4, 3\)"):
        save_map(tmp_path, np.zeros((4, 3)), GridSpec((0.0, 0.0), 1.0, (3, 4)))
    assert not list(tmp_path.iterdir())


NAMES = [
    "a#b",
    "a #b",
    "a: b",
    "- a",
    "'quoted'",
    'say "hi"',
    "back\\slash",
    "küche",
    "🤖",
    "! &a *b",
    "{a}",
    " ",
    "a\nb",
    "v1.2",
]


@pytest.mark.parametrize("name", NAMES)
def test_any_name_of_a_file_comes_back(tmp_path, name):
    cells = save_map(tmp_path, np.array([[-4.0, 0.0, 4.0]]), GridSpec((0.0, 0.0), 1.0, (1, 3)), name=name)
    assert {path.name for path in tmp_path.iterdir()} == {f"{name}.pgm", f"{name}.yaml"}
    np.testing.assert_array_equal(load_map(tmp_path / f"{name}.yaml").cells, cells)


@pytest.mark.parametrize("name", ["", ".", "..", "/", "floor/kitchen", "../beside", "a\0b"])
def test_a_name_that_leads_elsewhere_is_refused(tmp_path, name):
    with pytest.raises(ValueError, match="name: expected the name of a file, without folder and suffix"):
        save_map(tmp_path / "maps", np.zeros((1, 1)), GridSpec((0.0, 0.0), 1.0, (1, 1)), name=name)
    assert not list(tmp_path.rglob("*"))


def test_a_map_replaces_links_and_not_what_they_point_to(tmp_path):
    outside = tmp_path / "outside"
    outside.write_text("mine")
    (tmp_path / "maps").mkdir()
    for name in ("map.pgm", "map.yaml"):
        (tmp_path / "maps" / name).symlink_to(outside)
    cells = save_map(tmp_path / "maps", np.array([[-4.0, 4.0]]), GridSpec((0.0, 0.0), 1.0, (1, 2)))
    np.testing.assert_array_equal(load_map(tmp_path / "maps" / "map.yaml").cells, cells)
    assert outside.read_text() == "mine"


# --- What others wrote ---


def test_a_sheet_and_picture_worked_by_hand(tmp_path):
    loaded = load_map(written(tmp_path))
    # (255 - 100) / 255 = 0.61 is unknown; the lower row of the picture is row 0.
    np.testing.assert_array_equal(loaded.cells, [[UNKNOWN, UNKNOWN, UNKNOWN], [OCCUPIED, FREE, UNKNOWN]])
    assert loaded.spec == GridSpec((1.0, 2.0), 0.5, (2, 3))


def test_a_negated_picture_has_light_walls(tmp_path):
    loaded = load_map(written(tmp_path, SHEET.replace("negate: 0", "negate: 1")))
    # 0/255 is free, 254/255 and 205/255 = 0.8 occupied, 100/255 = 0.39 unknown.
    np.testing.assert_array_equal(loaded.cells, [[UNKNOWN, OCCUPIED, OCCUPIED], [FREE, OCCUPIED, OCCUPIED]])


def painted(folder, pixels, mode, sheet=SHEET, **options):
    """A PNG of the pixels, read by the sheet with a mode, top row first."""
    Image.fromarray(np.asarray(pixels, options.pop("dtype", np.uint8))).save(folder / "map.png", **options)
    (folder / "map.yaml").write_text(sheet.replace("map.pgm", "map.png") + f"mode: {mode}\n")
    return load_map(folder / "map.yaml").cells[::-1]


# p = 0.196 + 0.454 r: at 205, 0.196078 (r = 0.0002); at 150, 0.411765 (0.4752); at 90, 0.647059 (0.9935).
SCALED = [[254, 205, 150], [90, 89, 0]]


def test_scale_grades_what_lies_between_the_thresholds(tmp_path):
    np.testing.assert_array_equal(painted(tmp_path, SCALED, "scale"), [[0, 0, 47], [98, 100, 100]])
    negated = painted(tmp_path, 255 - np.array(SCALED), "scale", SHEET.replace("negate: 0", "negate: true"))
    np.testing.assert_array_equal(negated, [[0, 0, 47], [98, 100, 100]])


def test_at_one_threshold_nothing_lies_between(tmp_path):
    sheet = SHEET.replace("0.65", "0.2").replace("0.196", "0.2")
    np.testing.assert_array_equal(painted(tmp_path, [[203, 204, 205]], "scale", sheet), [[100, 0, 0]])
    np.testing.assert_array_equal(painted(tmp_path, [[203, 204, 205]], "trinary", sheet), [[100, UNKNOWN, 0]])


def test_raw_is_the_picture_s_own_number(tmp_path):
    cells = painted(tmp_path, [[0, 1, 99], [100, 101, 255]], "raw")
    np.testing.assert_array_equal(cells, [[0, 1, 99], [100, UNKNOWN, UNKNOWN]])
    assert cells.dtype == np.int8


def test_colours_are_averaged(tmp_path):
    pixels = [[[255, 255, 0], [0, 0, 255], [149, 150, 151]]]  # p = 0.333, 0.667, 0.412
    np.testing.assert_array_equal(painted(tmp_path, pixels, "Trinary"), [[UNKNOWN, OCCUPIED, UNKNOWN]])
    np.testing.assert_array_equal(painted(tmp_path, pixels, "scale"), [[29, OCCUPIED, 47]])


@pytest.mark.parametrize("channels", [2, 4])
def test_alpha_is_unknown_in_scale_and_a_colour_in_trinary(tmp_path, channels):
    pixels = np.zeros((1, 4, channels), int)
    pixels[0, :, :-1] = np.array([0, 0, 150, 255])[:, None]
    pixels[0, :, -1] = [255, 254, 255, 0]
    np.testing.assert_array_equal(painted(tmp_path, pixels, "scale"), [[OCCUPIED, UNKNOWN, 47, UNKNOWN]])
    # The means over four channels are 63.75, 63.5, 176.25 and 191.25: p = 0.75, 0.751, 0.309 and 0.25.
    np.testing.assert_array_equal(painted(tmp_path, pixels, "trinary"), [[OCCUPIED, OCCUPIED, UNKNOWN, UNKNOWN]])


def test_pictures_of_other_depths(tmp_path):
    np.testing.assert_array_equal(painted(tmp_path, [[True, False]], "trinary", dtype=bool), [[FREE, OCCUPIED]])
    deep = np.array(SCALED) * 257
    np.testing.assert_array_equal(painted(tmp_path, deep, "scale", dtype=np.uint16), [[0, 0, 47], [98, 100, 100]])
    np.testing.assert_array_equal(painted(tmp_path, deep, "raw", dtype=np.uint16)[1], [90, 89, 0])
    palette = Image.fromarray(np.array([[[255, 255, 255], [0, 0, 0], [150, 150, 150]]], np.uint8)).quantize(3)
    palette.save(tmp_path / "map.png")
    np.testing.assert_array_equal(load_map(tmp_path / "map.yaml").cells, [[UNKNOWN, 0, UNKNOWN]])  # the sheet is raw
    two_bytes = b"P5\n3 1\n65535\n" + bytes([0, 0, 255, 255, 150, 150])
    np.testing.assert_array_equal(load_map(written(tmp_path, picture=two_bytes)).cells, [[OCCUPIED, FREE, UNKNOWN]])


@pytest.mark.parametrize(
    "picture", [b"P2\n3 2\n255\n0 254 205\n100 205 205\n", b"P2 3 2 # made by hand\n10 0 10 8 4 8 8"]
)
def test_a_pgm_of_letters(tmp_path, picture):
    np.testing.assert_array_equal(load_map(written(tmp_path, picture=picture)).cells[1], [OCCUPIED, FREE, UNKNOWN])


@pytest.mark.parametrize("suffix", ["png", "bmp", "tif"])
def test_pictures_of_other_formats(tmp_path, suffix):
    Image.fromarray(np.frombuffer(GREYS, np.uint8).reshape(2, 3)).save(tmp_path / f"map.{suffix}")
    (tmp_path / "map.yaml").write_text(SHEET.replace("pgm", suffix))
    np.testing.assert_array_equal(load_map(tmp_path / "map.yaml").cells, load_map(written(tmp_path)).cells)


def test_the_sheet_s_thresholds_decide(tmp_path):
    loaded = load_map(written(tmp_path, SHEET.replace("0.65", "0.6").replace("0.196", "0.2")))
    np.testing.assert_array_equal(loaded.cells, [[OCCUPIED, FREE, FREE], [OCCUPIED, FREE, FREE]])


@pytest.mark.parametrize(
    "header",
    [b"P5 3 2 255 ", b"P5\n# made by a camera\n3 2\n255\n", b"P5\n3 # columns\n2\n# 9 9\n255\n", b"P5\r\n3\t2\n255\n"],
)
def test_white_space_and_comments_in_the_picture_s_header_are_skipped(tmp_path, header):
    np.testing.assert_array_equal(
        load_map(written(tmp_path, picture=header + GREYS)).cells, load_map(written(tmp_path)).cells
    )


def test_pixels_that_look_like_white_space_are_pixels(tmp_path):
    loaded = load_map(written(tmp_path, picture=b"P5\n3 2\n255\n" + b"\n \t\r\n#"))
    np.testing.assert_array_equal(loaded.cells, np.full((2, 3), OCCUPIED))


def test_a_picture_of_a_million_pixels_a_row_is_read_row_by_row(tmp_path):
    """And one of many narrow rows in blocks, the last of which is smaller."""
    rng = np.random.default_rng(0)
    for rows, columns in ((3, 600_000), (5001, 501)):
        grey = rng.integers(0, 256, (rows, columns), dtype=np.uint8)
        picture = f"P5\n{columns} {rows}\n255\n".encode() + grey.tobytes()
        cells = load_map(written(tmp_path, picture=picture)).cells
        p = (255 - grey[::-1]) / 255
        np.testing.assert_array_equal(cells, np.where(p > 0.65, OCCUPIED, np.where(p < 0.196, FREE, UNKNOWN)))


@pytest.mark.parametrize("mode", ["trinary", "scale"])
@pytest.mark.parametrize("negate", [False, True])
def test_a_pixel_on_the_very_threshold_is_between(tmp_path, mode, negate):
    """Of p = 0.8 and 0.2; between the thresholds scale goes from 0 to 99."""
    sheet = SHEET.replace("0.65", "0.8").replace("0.196", "0.2").replace("negate: 0", f"negate: {int(negate)}")
    pixels = np.array([[50, 51, 52, 203, 204, 205]])
    cells = painted(tmp_path, 255 - pixels if negate else pixels, mode, sheet)
    between = [99, 98, 0, 0] if mode == "scale" else [UNKNOWN] * 4
    np.testing.assert_array_equal(cells, [[OCCUPIED, *between, FREE]])


# --- Damage ---


@pytest.mark.parametrize("field", ["image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh"])
def test_a_missing_field_is_named(tmp_path, field):
    lines = [line for line in SHEET.splitlines() if not line.startswith(field)]
    with pytest.raises(ValueError, match=rf"map\.yaml: expected the fields .*missing {field}$"):
        load_map(written(tmp_path, "\n".join(lines)))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[1, 2, 0]", "[1, 2, 0.1]", "origin without rotation, got 0.1 rad"),
        ("[1, 2, 0]", "[1, 2, .nan]", "origin: expected a finite number, got nan"),
        ("[1, 2, 0]", "[1, 2]", "origin: expected three numbers, got a list"),
        ("[1, 2, 0]", "3", "origin: expected three numbers, got 3"),
        ("[1, 2, 0]", "[.inf, 2, 0]", "origin: expected a finite number, got inf"),
        ("0.5", "wide", "resolution: expected a finite number, got 'wide'"),
        ("0.5", "true", "resolution: expected a finite number, got True"),
        ("0.5", "1" * 5000, "expected a map_server YAML"),
        ("0.5", "1e999", "resolution: expected a finite number"),
        ("0.5", "{a: b}", "resolution: expected a finite number, got a dict"),
        ("0.5", "-0.5", "resolution: expected metres per cell > 0"),
        ("0.5", ".nan", "resolution: expected a finite number, got nan"),
        ("negate: 0", "negate: maybe", "negate: expected 0 or 1, got 'maybe'"),
        ("negate: 0", "negate: 2", "negate: expected 0 or 1, got 2"),
        ("negate: 0", "negate: !!bool ja", "expected a map_server YAML"),
        ("0.65", "[1]", "occupied_thresh: expected a finite number, got a list"),
        ("0.196", "-1", "expected 0 <= free_thresh <= occupied_thresh <= 1, got -1.0, 0.65"),
        ("image: map.pgm", "image: map.pgm\nmode: binary", "mode: expected trinary, scale or raw, got 'binary'"),
        ("image: map.pgm", "image: map.pgm\nmode:", "mode: expected trinary, scale or raw, got a NoneType"),
        ("image: map.pgm", "image:", "missing image"),
        ("0.196", "0.7", "expected 0 <= free_thresh <= occupied_thresh <= 1, got 0.7, 0.65"),
        ("0.65", ".nan", "occupied_thresh: expected a finite number, got nan"),
        ("image: map.pgm", "image: [", "expected a map_server YAML"),
        ("image: map.pgm", "image: [map.pgm]", "image: expected the name of a file, got a list"),
        ("image: map.pgm", "image: &x [*x]", "expected no aliases"),
        ("image: map.pgm", "image: " + "[" * 10_000, "expected a map_server YAML, got one that cannot be read"),
        (SHEET, "", "expected the fields"),
        (SHEET, "- 1\n- 2\n", "expected the fields"),
        (SHEET, "just words", "expected the fields"),
    ],
)
def test_a_damaged_sheet_is_refused_by_name(tmp_path, old, new, message):
    with pytest.raises(ValueError, match=rf"map\.yaml: .*{message}"):
        load_map(written(tmp_path, SHEET.replace(old, new)))


def test_a_sheet_that_is_no_text_is_refused(tmp_path):
    path = written(tmp_path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match=r"map\.yaml: expected a map_server YAML"):
        load_map(path)


def test_nothing_in_a_sheet_is_executed(tmp_path):
    trap = tmp_path / "trap"
    command = f"!!python/object/apply:os.mkdir ['{trap}']"
    with pytest.raises(ValueError, match=r"map\.yaml: expected a map_server YAML"):
        load_map(written(tmp_path, SHEET.replace("negate: 0", f"negate: {command}")))
    assert not trap.exists()


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (b"P2\n3 2\n255\n" + GREYS, "whole picture"),
        (b"P2\n3 2\n255\n0 254 205", "whole picture"),
        (b"P6\n3 2\n255\n" + GREYS, "whole picture"),
        (b"P5\n3 2\n65535\n" + GREYS, "whole picture"),
        (b"P5\n3 2\n", "expected a .*picture"),
        (b"P5\n3 two\n255\n" + GREYS, "expected a .*picture"),
        (b"P5\n# no end", "expected a .*picture"),
        (b"P5\n-3 2\n255\n" + GREYS, "expected a .*picture"),
        (b"", "expected a .*picture"),
        (b"P5\n3 2\n255\n" + GREYS[:-1], "whole picture"),
        (b"P5\n0 0\n255\n", "expected a .*picture"),
        (b"P5\n20000 20000\n255\n", "whole picture .* decompression bomb"),
        (b"Pf\n3 2\n-1.0\n" + bytes(24), "pixels of 8 or 16 bits, got Pillow's mode F"),
    ],
)
def test_a_damaged_picture_is_refused_by_name(tmp_path, picture, message):
    with pytest.raises(ValueError, match=rf"map\.pgm: .*{message}"):
        load_map(written(tmp_path, picture=picture))


def test_a_missing_file_is_missing(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_map(tmp_path / "no.yaml")
    path = written(tmp_path)
    (tmp_path / "map.pgm").unlink()
    with pytest.raises(FileNotFoundError):
        load_map(path)
