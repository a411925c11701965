"""Imports go one way: a room knows those below it and none above."""

import ast
from pathlib import Path

import jaxlocmap

ROOT = Path(jaxlocmap.__file__).parent
LAYERS = (
    ("_internal", "checks", "files"),
    ("se2", "poses"),
    ("parameters", "types", "motion", "sensors"),
    ("filters", "mapping"),
    ("matching",),
    ("graph",),
    ("step",),
    ("pipeline", "smoothing"),
    ("simulation",),
    ("consistency", "logs"),
    ("replay", "tuning", "plotting"),
)
ON_TOP = {"cli", "__main__"}  # programs, which use all of it as others do
BESIDE = {"monte_carlo": {"_internal", "files"}}  # it knows no robot


def imported(file):
    """The rooms that a file imports."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module == "jaxlocmap":
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and str(node.module).startswith("jaxlocmap."):
            yield node.module.split(".")[1]


def room_of(file):
    return file.relative_to(ROOT).with_suffix("").parts[0]


def test_every_room_has_its_place():
    rooms = {room_of(file) for file in ROOT.rglob("*.py")} - {"__init__"}
    assert rooms == {room for layer in LAYERS for room in layer} | set(BESIDE) | ON_TOP


def test_no_room_imports_one_above_it():
    level = {room: i for i, layer in enumerate(LAYERS) for room in layer}
    upwards = [
        (file.relative_to(ROOT).as_posix(), name)
        for file in ROOT.rglob("*.py")
        if (here := room_of(file)) in level
        for name in imported(file)
        if level.get(name, len(LAYERS)) > level[here] and name != here
    ]
    assert not upwards


def test_what_stands_beside_knows_little():
    for room, allowed in BESIDE.items():
        for file in (ROOT / room).rglob("*.py"):
            assert set(imported(file)) <= allowed | {room}, file
