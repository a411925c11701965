"""Occupancy maps as files: the picture and YAML sheet that ROS map_server loads.

Source: "Value interpretation" in wiki.ros.org/map_server, and its loaders of ROS 1 and 2 where that is silent.
"""

from __future__ import annotations

import math
import re
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxlocmap import checks
from jaxlocmap.types import GridSpec

OCCUPIED, FREE, UNKNOWN = 100, 0, -1  # as in nav_msgs/OccupancyGrid
_GREY = {OCCUPIED: 0, FREE: 254, UNKNOWN: 205}  # as map_saver writes them


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
        folder: to write into, made if missing. name: of the files without suffix; one with folders in it is taken from
            `folder` on.
        log_odds: (rows, columns) nats. spec: where the grid lies.
        occupied_above, free_below: probabilities, as in `trinary`; map_server's defaults.

    Returns:
        (rows, columns) int8, the cells as written and as `load_map` reads them again.

    Raises:
        ValueError: a name that is none, log-odds of another shape than the grid, or thresholds that `trinary` refuses.
        OSError: the files cannot be written.
    """
    if Path(name).name in ("", ".."):
        raise ValueError(f"name: expected the name of a file without suffix, got {name!r}")
    checks.shape("log_odds", log_odds, spec.shape)
    cells = trinary(np.asarray(log_odds), occupied_above=occupied_above, free_below=free_below)
    picture = np.full(cells.shape, _GREY[UNKNOWN], np.uint8)
    for kind in (OCCUPIED, FREE):
        picture[cells == kind] = _GREY[kind]
    rows, columns = cells.shape
    path = Path(folder, name)
    path.parent.mkdir(parents=True, exist_ok=True)
    # A picture's first row is its top, a grid's first row its lowest y.
    path.with_name(f"{path.name}.pgm").write_bytes(f"P5\n{columns} {rows}\n255\n".encode() + picture[::-1].tobytes())
    path.with_name(f"{path.name}.yaml").write_text(
        f"image: {_scalar(path.name + '.pgm')}\nmode: trinary\nresolution: {float(spec.resolution)!r}\n"
        f"origin: [{float(spec.origin[0])!r}, {float(spec.origin[1])!r}, 0.0]\nnegate: 0\n"
        # Of the picture's three greys, whatever the thresholds the cells were sorted by.
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n",
        encoding="utf-8",
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
        ValueError: not such a YAML or picture, a missing or impossible field, or a rotated map; the message starts with
            the path.
        FileNotFoundError: no such file.
        ImportError: PyYAML is not installed.
    """
    try:
        import yaml  # needed here alone, so it is no dependency of the library
    except ImportError as error:
        raise ImportError("load_map needs PyYAML: pip install 'jaxlocmap[experiments]'") from error

    try:
        sheet = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: expected a map_server YAML: {error}") from None
    needed = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")
    missing = [field for field in needed if not isinstance(sheet, dict) or sheet.get(field) is None]
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
    if not 0 <= low <= high <= 1:
        raise ValueError(f"{path}: expected 0 <= free_thresh <= occupied_thresh <= 1, got {low}, {high}")
    mode = str(sheet.get("mode", "trinary")).lower()
    if mode not in ("trinary", "scale", "raw"):
        raise ValueError(f"{path}: expected mode trinary, scale or raw, got {sheet['mode']}")
    picture = _read_picture(Path(path).parent / str(sheet["image"]))[::-1]
    cells = _cells(picture, mode, negate, high, low)
    try:
        return LoadedMap(cells, GridSpec(origin=(x, y), resolution=resolution, shape=cells.shape))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


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


def _read_picture(path: Path) -> np.ndarray:
    """Pixels (rows, columns, channels) from 0 to 255, the first row on top: grey, three colours, or these and alpha."""
    from PIL import Image, UnidentifiedImageError  # takes its time, and is needed here alone

    try:
        with (
            warnings.catch_warnings(action="ignore", category=Image.DecompressionBombWarning),
            Image.open(path) as image,
        ):
            if image.mode.startswith("I"):  # grey of 16 bits
                pixels = np.asarray(image, np.int64)[..., None] / 257
            elif image.has_transparency_data:
                pixels = np.asarray(image.convert("RGBA"), np.float64)
            else:
                pixels = np.asarray(image.convert("L" if image.mode in ("1", "L") else "RGB"), np.float64)
                pixels = pixels.reshape(*pixels.shape[:2], -1)
            if image.mode == "F" or not np.all((pixels >= 0) & (pixels <= 255)):
                raise ValueError(f"expected pixels of 8 or 16 bits, got Pillow's mode {image.mode}")
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such picture") from None
    except UnidentifiedImageError:
        raise ValueError(f"{path}: expected a picture such as PGM or PNG, got something else") from None
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(f"{path}: expected a whole picture that Pillow reads: {error}") from None
    return pixels
