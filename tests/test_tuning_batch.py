"""Sequences, padding, windows, blocks: what is counted is what was there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drives import ONLY_POSES, OWN, drives

from jaxlocmap import Gaussian, tuning

OBJECTIVE = tuning.Objective(ONLY_POSES, (("innovation", 1.0), ("pose", 1.0)))


@jax.jit
def every_sum(batch):
    return OBJECTIVE.tallies(OWN, batch)


def near(got, expected, tolerance):
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=tolerance(1e-11, 2e-4), atol=tolerance(0, 1e-5)),
        got,
        expected,
    )


def first_steps(batch, steps, slots):
    cut = tuning.pick(batch, slice(0, 1))
    inputs = cut.inputs._replace(
        landmark=cut.inputs.landmark[..., :slots], z=cut.inputs.z[..., :slots, :], valid=cut.inputs.valid[..., :slots]
    )
    cut = cut._replace(inputs=inputs)
    return jax.tree.map(lambda x: x[:, :steps], cut._replace(prior=None, landmarks=None))._replace(
        prior=cut.prior, landmarks=cut.landmarks
    )


# Each of these makes batches of four sequences of twelve steps, so that one program does for all.


def test_padding_changes_nothing(tolerance):
    batch = drives(scans=False)
    short = first_steps(batch, 7, 3)
    joined = tuning.join(tuning.pick(batch, slice(0, 3)), short)
    assert joined.counted.shape == (4, 12)
    assert joined.counted[3].sum() == 7
    whole = jax.tree.map(lambda x: x[:3], every_sum(batch))
    expected = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), whole, every_sum(short))
    near(every_sum(joined), expected, tolerance)


def first_sequence():
    return tuning.pick(drives(scans=False), slice(0, 1))


def is_the_first_sequence(cut, tolerance):
    np.testing.assert_array_equal(np.asarray(cut.counted).sum(), 12)
    whole = jax.tree.map(lambda x: x[0], every_sum(drives(scans=False)))
    near(jax.tree.map(jnp.sum, every_sum(cut)), whole, tolerance)


def test_windows_that_run_in_from_the_prior_are_the_whole(tolerance):
    anywhere = Gaussian(np.zeros((1, 12, 3)), np.eye(3)[None, None].repeat(12, axis=1))
    cut = tuning.windows(first_sequence(), 3, run_in=12, beliefs=anywhere)
    assert cut.counted.shape == (4, 12)
    is_the_first_sequence(cut, tolerance)


def test_windows_start_where_they_are_told(tolerance):
    """Started at the filter's own beliefs, windows see what the filter saw."""
    beliefs = jax.jit(lambda batch: tuning.beliefs(OWN, batch, config=ONLY_POSES))(drives(scans=False))
    cut = tuning.windows(first_sequence(), 3, run_in=2, beliefs=jax.tree.map(lambda x: x[:1], beliefs))
    assert cut.counted.shape == (4, 5)
    np.testing.assert_array_equal(cut.counted.sum(axis=1), 3)
    is_the_first_sequence(cut, tolerance)


def test_blocks_share_out_the_steps_of_one_sequence(tolerance):
    cut = tuning.blocks(first_sequence(), 4)
    assert cut.counted.shape == (4, 12)
    np.testing.assert_array_equal(cut.counted.sum(axis=0), 1)
    is_the_first_sequence(cut, tolerance)
    with pytest.raises(ValueError, match="expected one sequence"):
        tuning.blocks(drives(scans=False), 2)


def test_an_unknown_truth_is_not_judged():
    batch = drives(scans=False)
    truth = np.array(batch.truth[0])
    truth[3:6] = np.nan
    inputs, prior = jax.tree.map(lambda x: x[0], (batch.inputs, batch.prior))
    one = tuning.sequence(inputs, prior, landmarks=batch.landmarks, truth=truth)
    sums = every_sum(tuning.join(one, tuning.pick(batch, slice(1, 4))))
    assert float(sums["pose"][1][0]) == 9
    assert float(sums["innovation"][1][0]) == np.asarray(batch.inputs.valid)[0].sum()
    assert np.isfinite(float(sums["pose"][0][0]))


def test_simulated_rooms_may_differ_from_run_to_run():
    from drives import SHORT

    from jaxlocmap import simulate
    from jaxlocmap.world import random_room

    rooms = jax.vmap(random_room)(jax.random.split(jax.random.key(1), 3))
    batch = tuning.simulated(jax.random.key(0), 3, rooms, simulate.Noise(), scenario=SHORT, scans=True, worlds=True)
    assert batch.inputs.ranges.shape == (3, 12, 9)
    assert batch.landmarks.shape == (4, 2)
    segments = np.asarray(rooms.segments)
    assert not np.allclose(segments[0, 4:], segments[1, 4:])
    np.testing.assert_array_equal(segments[:, :4], segments[:1, :4].repeat(3, axis=0))
    assert segments[:, 4:].min() >= 0.5 - 1e-6
    assert segments[:, 4:].max() <= 11.5 + 1e-6
    # Each box is a closed ring of four walls.
    np.testing.assert_allclose(segments[:, 4:, 1], np.roll(segments[:, 4:, 0], -1, axis=1))


def test_what_does_not_fit_together_is_named():
    batch = drives(scans=False)
    with pytest.raises(ValueError, match="at least one, got none"):
        tuning.join()
    with pytest.raises(ValueError, match=r"truth: expected in all batches or in none, got it in 1 of 2"):
        tuning.join(batch, batch._replace(truth=None, known=None))
    with pytest.raises(ValueError, match="landmarks: expected the same in all batches"):
        tuning.join(batch, batch._replace(landmarks=batch.landmarks + 1))
    with pytest.raises(ValueError, match="length, run_in"):
        tuning.windows(batch, 0, run_in=0, beliefs=batch.prior)
