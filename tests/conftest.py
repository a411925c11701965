"""The strict session: float64 by default, no silent change of rank or dtype; pyproject turns warnings into errors.

JAXLOCMAP_X64=0 makes it the float32 job: tests that need float64 skip, the rest hold to float32 tolerances.
"""

import gc
import os
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from hypothesis import settings

from jaxlocmap import Config, Gaussian, GridSpec, Inputs, Params

X64 = os.environ.get("JAXLOCMAP_X64", "1") != "0"
jax.config.update("jax_enable_x64", X64)
# Compiling takes most of the time: as little optimised as can be, in one piece, without a compiler's context for every
# kernel. JAX reads the flags when it first compiles. Programs in processes of their own get them too (`programs`).
jax.config.update("jax_disable_most_optimizations", True)
QUICKLY = (
    "--xla_cpu_parallel_codegen_split_count=1",
    "--xla_backend_extra_options=xla_cpu_disable_new_fusion_emitters",
)
os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *QUICKLY]).strip()
gc.set_threshold(50_000, 20, 50)  # tracing makes many small objects, which are not garbage
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# The same examples in every run; compiling takes longer than the default deadline.
settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
settings.load_profile("repeatable")


def pytest_configure(config):
    """Files go to the workers in the order of their names. By their number of tests, as xdist has it, those that take
    longest would come last, and one worker would wait for the other.
    """
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False


@pytest.fixture(scope="module", autouse=True)
def no_program_outlives_its_module():
    """Compiled programs take memory, and pieces of it: Linux lets a process have 65,530, and beyond it JAX crashes."""
    yield
    jax.clear_caches()


@pytest.fixture
def x64():
    """Skip the test, visibly, in the float32 job."""
    if not X64:
        pytest.skip("needs float64, this is the float32 job")


@pytest.fixture(scope="session")
def tolerance():
    """Picks the tolerance of the job's precision: `tolerance(double, single)`."""
    return lambda double, single: double if X64 else single


@pytest.fixture
def as_a_program():
    """Not in the strict session: a program makes its own."""
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        yield
    jax.config.update("jax_disable_most_optimizations", True)


class Course(NamedTuple):
    """The course's run, ready for the library: what its robot measured and what its filter believed."""

    params: Params
    prior: Gaussian
    inputs: Inputs
    landmarks: jax.Array
    beam_angles: jax.Array
    grid: GridSpec

    def config(self, *, motion="arc", mapping=False, **kwargs):
        return Config(dt=reference.COURSE_DT, motion=motion, grid=self.grid if mapping else None, **kwargs)

    def first(self, steps, *, slots=2, scans=False):
        """The first steps only, and the last slots: near the start the robot sees the last landmark alone."""
        dt, control, landmark, z, valid, ranges = jax.tree.map(lambda x: x[:steps], self.inputs)
        some = slice(-slots, None)
        cut = Inputs(dt, control, landmark[:, some], z[:, some], valid[:, some], ranges if scans else None)
        return self._replace(inputs=cut)


@pytest.fixture(scope="session")
def course():
    measured = reference.course_run()
    scan = reference.COURSE_SCAN
    return Course(
        params=Params(
            Q=jnp.array(reference.COURSE_Q),
            R=jnp.array(reference.COURSE_R),
            l_occ=jnp.array(scan["l_occ"]),
            l_free=jnp.array(scan["l_free"]),
        ),
        prior=Gaussian(jnp.array(reference.COURSE_PRIOR_MEAN), jnp.array(reference.COURSE_PRIOR_COV)),
        inputs=Inputs(
            dt=jnp.array(measured["dt"]),
            control=jnp.array(measured["control"]),
            landmark=jnp.array(measured["landmark"].astype(np.int32)),
            z=jnp.array(measured["z"]),
            valid=jnp.array(measured["valid"]),
            ranges=jnp.array(measured["scans"]),
        ),
        landmarks=jnp.array(reference.COURSE_LANDMARKS),
        beam_angles=jnp.array(reference.COURSE_ANGLES),
        grid=GridSpec(
            origin=scan["origin"],
            resolution=scan["resolution"],
            shape=reference.COURSE_GRID_SHAPE,
            l_min=scan["l_min"],
            l_max=scan["l_max"],
        ),
    )
