"""A program as those in experiments/, of a study that compiles at once: random walks.

DIE_AT and DIE_BY in the environment send it a signal when so many runs are done.
"""

import contextlib
import dataclasses
import os
from pathlib import Path
from typing import Annotated

import common
import jax
import jax.numpy as jnp
import tyro


@dataclasses.dataclass(frozen=True)
class WalkConfig:
    """Settings of the study."""

    runs: int = 300
    """How many walks."""
    seed: int = 0
    """Of all randomness."""
    out: Path = Path("out/walks")
    """Folder for report.json."""
    compute: Annotated[common.ComputeConfig, tyro.conf.arg(name="")] = dataclasses.field(
        default_factory=common.ComputeConfig
    )


def walk(key, scale):
    return {"walk": scale * jnp.cumsum(jax.random.normal(key, (50,))), "walks": 1}


def main(config):
    common.start(config.compute)
    parts = common.study_checkpoint(config.out, config.compute, {"seed": config.seed})
    key = jax.random.key(config.seed)
    result = common.study(walk, key, config.runs, 2.0, config=config.compute, checkpoint=parts)
    values = {name: value.tolist() for name, value in result.value.items()}
    if jax.process_index() == 0:
        common.write_report(common.output_folder(config.out), {**result._asdict(), "value": values})
    common.finish(parts)
    print("total", result.value["walk"].sum().hex())


if at := int(os.environ.get("DIE_AT", "0")):
    bar_of_common = common.progress_bar

    @contextlib.contextmanager
    def deadly_bar(*args):
        with bar_of_common(*args) as move:
            yield lambda done: os.kill(os.getpid(), int(os.environ["DIE_BY"])) if done >= at else move(done)

    common.progress_bar = deadly_bar

if __name__ == "__main__":
    common.command_line(main, WalkConfig)
