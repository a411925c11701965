"""What the README and the packages' docstrings show runs as it stands."""

import ast
import re
from pathlib import Path

import pytest

import jaxlocmap

README = (Path(__file__).parent.parent / "README.md").read_text()
ROOT = Path(jaxlocmap.__file__).parent


def examples():
    """Every block of Python by where it stands."""
    pages = {"README.md": README}
    for file in sorted(ROOT.rglob("*.py")):
        pages[str(file.relative_to(ROOT))] = ast.get_docstring(ast.parse(file.read_text())) or ""
    return [
        (page, block) for page, text in pages.items() for block in re.findall(r"```python\n(.*?)```", text, flags=re.S)
    ]


def test_there_are_examples():
    pages = [page for page, _ in examples()]
    assert pages.count("README.md") == 3
    packages = ("consistency", "graph", "matching", "tuning")
    assert set(pages) == {
        "README.md",
        "motion.py",
        "pipeline.py",
        "sensors.py",
        *(f"{x}/__init__.py" for x in packages),
    }


@pytest.mark.parametrize(("page", "block"), examples(), ids=[page for page, _ in examples()])
def test_the_example_runs(page, block):
    exec(compile(block, page, "exec"), {})


def test_the_readme_is_read_in_five_minutes():
    assert len(README.splitlines()) <= 200
