"""Occupancy maps as files: the picture and YAML sheet that ROS map_server loads.

Source: "Value interpretation" in wiki.ros.org/map_server, and its loaders of ROS 1 and 2 where that is silent.
"""

from __future__ import annotations

import io
import math
import re
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxlocmap import checks, files
from jaxlocmap.types import GridSpec

OCCUPIED, FREE, UNKNOWN = 100, 0, -1  # as in nav_msgs/OccupancyGrid
_GREY = {OCCUPIED: 0, FREE: 254, UNKNOWN: 205}  # as map_saver writes them
_PIXEL, _ROW = {"1": 1, "L": 1, "I;16": 2, "I;16B": 2}, 16  # bytes that Pillow takes, 4 for a pixel of another kind


class LoadedMap(NamedTuple):
    """A map read from a file."""

    cells: np.ndarray  # (rows, columns) int8: UNKNOWN, or FREE to OCCUPIED; row 0 is the lowest y
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
        folder: to write into, made if missing.
        name: of the files, without folder and suffix.
        log_odds: (rows, columns) nats.
        spec: where the grid lies.
        occupied_above, free_below: probabilities, as in `trinary`; map_server's defaults.

    Returns:
        (rows, columns) int8, the cells as written and as `load_map` reads them again.

    Raises:
        ValueError: a name that is none, log-odds of another shape than the grid, or thresholds that `trinary` refuses.
        OSError: the files cannot be written.
    """
    if name in ("", ".", "..") or Path(name).name != name or "\0" in name:
        raise ValueError(f"name: expected the name of a file, without folder and suffix, got {name!r}")
    checks.shape("log_odds", log_odds, spec.shape)
    cells = trinary(np.asarray(log_odds), occupied_above=occupied_above, free_below=free_below)
    picture = np.full(cells.shape, _GREY[UNKNOWN], np.uint8)
    for kind in (OCCUPIED, FREE):
        picture[cells == kind] = _GREY[kind]
    rows, columns = cells.shape
    path = Path(folder)
    path.mkdir(parents=True, exist_ok=True)
    # A picture's first row is its top, a grid's first row its lowest y.
    files.write(path / f"{name}.pgm", f"P5\n{columns} {rows}\n255\n".encode() + picture[::-1].tobytes())
    files.write(
        path / f"{name}.yaml",
        f"image: {_scalar(name + '.pgm')}\nmode: trinary\nresolution: {float(spec.resolution)!r}\n"
        f"origin: [{float(spec.origin[0])!r}, {float(spec.origin[1])!r}, 0.0]\nnegate: 0\n"
        # Of the picture's three greys, whatever the thresholds the cells were sorted by.
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n",
    )
    return cells


def _scalar(text: str) -> str:
    """A string as YAML has it: as it is where nothing in it has a meaning there, else in double quotes."""
    if re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]*", text):
        return text
    escaped = (c if c.isprintable() and c not in '"\\' else f"\\U{ord(c):08x}" for c in text)
    return f'"{"".join(escaped)}"'


def load_map(path: str | Path) -> LoadedMap:
    """Read a map_server YAML and its picture: PGM, PNG or whatever else Pillow reads. Nothing in the file is executed.

    With x the mean of a pixel's colours, 0 to 255 whatever the depth of the picture, the occupancy is
    p = (255 - x) / 255, with `negate` x / 255. By the sheet's `mode` a cell is

    - trinary, also where none is given: OCCUPIED if p > occupied_thresh, FREE if p < free_thresh, else UNKNOWN; an
      alpha channel is averaged in as if it were a colour;
    - scale: UNKNOWN where the pixel is at all transparent, else as before but for the values between the thresholds,
      which are 99 (p - free_thresh) / (occupied_thresh - free_thresh), rounded down;
    - raw: x, rounded, or UNKNOWN if that is above 100.

    Raises:
        ValueError: not such a YAML or picture, a missing or impossible field, a rotated map, aliases in the YAML, or
            more than `files.most_bytes`; the message starts with the path.
        FileNotFoundError: no such file.
        ImportError: PyYAML is not installed.
    """
    try:
        import yaml  # needed here alone, so it is no dependency of the library
    except ImportError as error:
        raise ImportError("load_map needs PyYAML: pip install 'jaxlocmap[cli]'") from error

    class Loader(yaml.SafeLoader):
        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):  # a few hundred bytes of them can stand for gigabytes
                raise yaml.YAMLError("expected no aliases, got one")
            return super().compose_node(parent, index)

    with files.reading(path, "a map_server YAML"):
        text = files.read(path, most=files.SETTINGS)
        try:
            sheet = yaml.load(text, Loader)
        except (yaml.YAMLError, ValueError) as error:
            raise ValueError(f"{path}: expected a map_server YAML: {error}") from None
        sheet = _Sheet.of(sheet)
    picture = Path(path).parent / sheet.image
    with files.reading(picture, "a picture"):
        cells = _read_picture(picture, sheet)[::-1]
    with files.reading(path, "a grid"):
        return LoadedMap(cells, GridSpec(origin=sheet.origin, resolution=sheet.resolution, shape=cells.shape))


class _Sheet(NamedTuple):
    """The fields of the YAML."""

    image: str
    mode: str
    resolution: float
    origin: tuple[float, float]
    negate: bool
    high: float
    low: float

    @classmethod
    def of(cls, fields: Any) -> _Sheet:
        needed = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")
        missing = [field for field in needed if not isinstance(fields, dict) or fields.get(field) is None]
        if missing:
            raise ValueError(f"expected the fields {', '.join(needed)}, missing {', '.join(missing)}")
        image, mode, origin, negate = (fields.get(name, "trinary") for name in ("image", "mode", "origin", "negate"))
        if not isinstance(image, str) or not image or "\0" in image or len(image) > 1000:
            raise ValueError(f"image: expected the name of a file, got {_shown(image)}")
        if not isinstance(mode, str) or mode.lower() not in ("trinary", "scale", "raw"):
            raise ValueError(f"mode: expected trinary, scale or raw, got {_shown(mode)}")
        if not isinstance(origin, list) or len(origin) != 3:
            raise ValueError(f"origin: expected three numbers, got {_shown(origin)}")
        x, y, yaw = (_number("origin", value) for value in origin)
        if yaw != 0:
            raise ValueError(f"expected an origin without rotation, got {yaw} rad")
        if negate not in (0, 1):
            raise ValueError(f"negate: expected 0 or 1, got {_shown(negate)}")
        resolution, high, low = (_number(name, fields[name]) for name in ("resolution", *needed[4:]))
        if not 0 <= low <= high <= 1:
            raise ValueError(f"expected 0 <= free_thresh <= occupied_thresh <= 1, got {low}, {high}")
        return cls(image, mode.lower(), resolution, (x, y), bool(negate), high, low)


def _number(name: str, value: Any) -> float:
    """A finite number, or text that is one: YAML 1.1 takes 1e-2 for text."""
    try:
        number = math.nan if isinstance(value, bool) or "_" in str(value)[:40] else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{name}: expected a finite number, got {_shown(value)}")
    return number


def _shown(value: Any) -> str:
    """A value for a message, whatever its size."""
    return f"{value!r:.40}" if isinstance(value, (str, int, float)) else f"a {type(value).__name__}"


def _cells(picture: np.ndarray, mode: str, negate: bool, high: float, low: float) -> np.ndarray:
    """Cells (rows, columns) int8 of a picture (rows, columns, channels), 0 to 255; a fourth channel is alpha."""
    shade = np.mean(picture if mode == "trinary" else picture[..., :3], axis=-1)
    if mode == "raw":
        shade = np.rint(shade)
        return np.where(shade <= OCCUPIED, shade, UNKNOWN).astype(np.int8)
    occupancy = shade / 255 if negate else (255 - shade) / 255
    between = np.full_like(shade, UNKNOWN)
    if mode == "scale":
        between = np.floor(99 * ((occupancy - low) / max(high - low, np.finfo(float).tiny)))
    cells = np.where(occupancy > high, OCCUPIED, np.where(occupancy < low, FREE, between))
    if mode == "scale":
        cells[np.any(picture[..., 3:] < 255, axis=-1)] = UNKNOWN
    return cells.astype(np.int8)


def _read_picture(path: Path, sheet: _Sheet) -> np.ndarray:
    """Cells (rows, columns) int8 of a picture, the first row on top."""
    from PIL import Image, UnidentifiedImageError  # takes its time, and is needed here alone

    content = io.BytesIO(files.read(path))
    try:
        with (
            warnings.catch_warnings(action="ignore"),  # of large pictures, and of tags that nobody needs
            Image.open(content) as image,
        ):
            columns, rows = image.size
            if image.format == "EPS":  # a program, which Pillow would run
                raise UnidentifiedImageError
            each = 4 if image.has_transparency_data else _PIXEL.get(image.mode, 4)
            if rows * (columns * each + _ROW) > files.most_bytes():
                raise files.too_large(path, "pixels")
            whole, scale = image, 1
            if image.mode.startswith("I"):  # grey of 16 bits
                scale = 257
            elif image.has_transparency_data:
                whole = image.convert("RGBA")
            else:
                whole = image.convert("L" if image.mode in ("1", "L") else "RGB")
            pixels = np.asarray(whole).reshape(rows, columns, -1)
            if image.mode == "F" or pixels.min(initial=0) < 0 or pixels.max(initial=0) > 255 * scale:
                raise ValueError(f"{path}: expected pixels of 8 or 16 bits, got Pillow's mode {image.mode}")
    except UnidentifiedImageError:
        raise ValueError(f"{path}: expected a picture such as PGM or PNG, got something else") from None
    except Image.DecompressionBombError as error:
        raise ValueError(f"{path}: expected a whole picture that Pillow reads: {error}") from None
    except (OSError, SyntaxError):  # their words may quote the file
        raise ValueError(f"{path}: expected a whole picture that Pillow reads, got a damaged one") from None
    except ValueError as error:
        if str(error).startswith(str(path)):
            raise
        raise ValueError(f"{path}: expected a whole picture that Pillow reads, got a damaged one") from None
    at_once = max(2**20 // max(columns, 1), 1)  # rows
    blocks = (pixels[row : row + at_once] / scale for row in range(0, rows, at_once))
    return np.concatenate([_cells(block, sheet.mode, sheet.negate, sheet.high, sheet.low) for block in blocks])
