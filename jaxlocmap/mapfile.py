"""Occupancy maps as files: the PGM picture and YAML sheet that ROS map_server loads."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxlocmap import checks
from jaxlocmap.types import GridSpec

OCCUPIED, FREE, UNKNOWN = 100, 0, -1  # as in nav_msgs/OccupancyGrid
_GREY = {OCCUPIED: 0, FREE: 254, UNKNOWN: 205}  # as map_saver writes them


class LoadedMap(NamedTuple):
    """A map read from a file."""

    cells: np.ndarray  # (rows, columns) int8: OCCUPIED, FREE or UNKNOWN; row 0 is the lowest y
    spec: GridSpec  # its log-odds bounds are the defaults: the file does not hold any


def trinary(log_odds: np.ndarray, *, occupied_above: float = 0.65, free_below: float = 0.196) -> np.ndarray:
    """Cells as map_server sees them: OCCUPIED above one probability, FREE below another, UNKNOWN between.

    Args:
        log_odds: (rows, columns) nats.

    Returns:
        (rows, columns) int8.

    Raises:
        ValueError: thresholds that are not 0 < free_below < occupied_above < 1.
    """
    if not 0 < free_below < occupied_above < 1:
        raise ValueError(
            f"thresholds: expected 0 < free_below < occupied_above < 1, got {free_below}, {occupied_above}"
        )
    high, low = (math.log(p / (1 - p)) for p in (occupied_above, free_below))
    return np.where(log_odds > high, OCCUPIED, np.where(log_odds < low, FREE, UNKNOWN)).astype(np.int8)


def save_map(
    folder: str | Path,
    log_odds: np.ndarray,
    spec: GridSpec,
    *,
    name: str = "map",
    occupied_above: float = 0.65,
    free_below: float = 0.196,
) -> np.ndarray:
    """Write `name.pgm` and `name.yaml` for ROS map_server.

    Args:
        log_odds: (rows, columns) nats. spec: where the grid lies.
        occupied_above, free_below: probabilities, as in `trinary`; map_server's defaults.

    Returns:
        (rows, columns) int8, the cells as written and as `load_map` reads them again.

    Raises:
        ValueError: log-odds of another shape than the grid, or thresholds that `trinary` refuses.
    """
    checks.shape("log_odds", log_odds, spec.shape)
    cells = trinary(np.asarray(log_odds), occupied_above=occupied_above, free_below=free_below)
    picture = np.full(cells.shape, _GREY[UNKNOWN], np.uint8)
    for kind in (OCCUPIED, FREE):
        picture[cells == kind] = _GREY[kind]
    rows, columns = cells.shape
    folder = Path(folder)
    # A picture's first row is its top, a grid's first row its lowest y.
    (folder / f"{name}.pgm").write_bytes(f"P5\n{columns} {rows}\n255\n".encode() + picture[::-1].tobytes())
    (folder / f"{name}.yaml").write_text(
        f"image: {name}.pgm\nmode: trinary\nresolution: {float(spec.resolution)!r}\n"
        f"origin: [{float(spec.origin[0])!r}, {float(spec.origin[1])!r}, 0.0]\nnegate: 0\n"
        # Of the picture's three greys, whatever the thresholds the cells were sorted by.
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    return cells


def load_map(path: str | Path) -> LoadedMap:
    """Read a map_server YAML and its PGM (binary, 8 bit). Nothing in the file is executed.

    Raises:
        ValueError: not such a YAML or PGM, a missing or impossible field, a mode other than trinary, or a rotated
            map; the message starts with the path.
        FileNotFoundError: no such file.
        ImportError: PyYAML is not installed.
    """
    try:
        import yaml  # needed here alone, so it is no dependency of the library
    except ImportError as error:
        raise ImportError("load_map needs PyYAML: pip install 'jaxlocmap[experiments]'") from error

    try:
        sheet = yaml.safe_load(Path(path).read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: expected a map_server YAML: {error}") from None
    needed = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")
    missing = [field for field in needed if not isinstance(sheet, dict) or field not in sheet]
    if missing:
        raise ValueError(f"{path}: expected the fields {', '.join(needed)}, missing {', '.join(missing)}")
    try:
        x, y, yaw = (float(value) for value in sheet["origin"])
        resolution, negate = float(sheet["resolution"]), bool(int(sheet["negate"]))
        high, low = float(sheet["occupied_thresh"]), float(sheet["free_thresh"])
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: expected numbers, and an origin of three: {error}") from None
    if yaw != 0:
        raise ValueError(f"{path}: expected an origin without rotation, got {yaw} rad")
    if sheet.get("mode", "trinary") != "trinary":
        raise ValueError(f"{path}: expected mode trinary, got {sheet['mode']}")
    grey = _read_pgm(Path(path).parent / str(sheet["image"]))[::-1]
    occupancy = grey / 255 if negate else (255 - grey.astype(int)) / 255
    cells = np.where(occupancy > high, OCCUPIED, np.where(occupancy < low, FREE, UNKNOWN)).astype(np.int8)
    try:
        return LoadedMap(cells, GridSpec(origin=(x, y), resolution=resolution, shape=cells.shape))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _read_pgm(path: Path) -> np.ndarray:
    data = path.read_bytes()
    # Magic number, then width, height and maximum, between them white space and comments, then one white space.
    numbers: list[int] = []
    at = 2
    while data[:2] == b"P5" and len(numbers) < 3 and at < len(data):
        if data[at : at + 1].isspace():
            at += 1
        elif data[at : at + 1] == b"#":
            at = data.find(b"\n", at) % (len(data) + 1)
        else:
            end = at
            while data[end : end + 1].isdigit():
                end += 1
            if end == at:
                break
            numbers.append(int(data[at:end]))
            at = end
    if len(numbers) < 3 or numbers[2] != 255:
        raise ValueError(f"{path}: expected a binary 8-bit PGM (P5, maximum 255), got {data[:20]!r}")
    columns, rows = numbers[:2]
    pixels = data[at + 1 :]
    if len(pixels) != rows * columns or not pixels:
        raise ValueError(f"{path}: expected {rows} x {columns} pixels, got {len(pixels)} bytes")
    return np.frombuffer(pixels, np.uint8).reshape(rows, columns)
