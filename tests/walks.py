"""A program as those in experiments/, of a study that compiles at once: random walks.

DIE_AT and DIE_BY in the environment send it a signal when so many runs are done.
"""

import contextlib
import dataclasses
import os
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import tyro

from jaxlocmap.cli import compute, console
from jaxlocmap.cli.command import command_line
from jaxlocmap.cli.compute import ComputeConfig


@dataclasses.dataclass(frozen=True)
class WalkConfig:
    """Settings of the study."""

    runs: int = 300
    """How many walks."""
    seed: int = 0
    """Of all randomness."""
    out: Path = Path("out/walks")
    """Folder for report.json."""
    compute: Annotated[ComputeConfig, tyro.conf.arg(name="")] = dataclasses.field(default_factory=ComputeConfig)


def walk(key, scale):
    return {"walk": scale * jnp.cumsum(jax.random.normal(key, (50,))), "walks": 1}


def main(config: WalkConfig):
    compute.start(config.compute)
    parts = compute.study_checkpoint(config.out, config.compute, {"seed": config.seed})
    key = jax.random.key(config.seed)
    result = compute.study(walk, key, config.runs, 2.0, config=config.compute, checkpoint=parts)
    values = {name: value.tolist() for name, value in result.value.items()}
    if jax.process_index() == 0:
        console.write_report(console.output_folder(config.out), {**result._asdict(), "value": values})
    compute.finish(parts)
    print("total", result.value["walk"].sum().hex())


if at := int(os.environ.get("DIE_AT", "0")):
    bar = compute.progress_bar

    @contextlib.contextmanager
    def deadly_bar(*args):
        with bar(*args) as move:
            yield lambda done: os.kill(os.getpid(), int(os.environ["DIE_BY"])) if done >= at else move(done)

    compute.progress_bar = deadly_bar

if __name__ == "__main__":
    command_line(main)
