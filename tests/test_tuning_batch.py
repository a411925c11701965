"""Sequences, padding, windows, blocks: what is counted is what was there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drives import ONLY_POSES, OWN, SHORT, drives, like

from jaxlocmap import Gaussian, Inputs, simulation, tuning
from jaxlocmap.simulation.world import random_room

OBJECTIVE = tuning.Objective(ONLY_POSES, (("innovation_nll", 1.0), ("pose_nll", 1.0)))


@jax.jit
def every_sum(batch):
    return OBJECTIVE.tallies(OWN, batch)[0]


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
    return jax.tree.map(lambda x: x[:, :steps], cut._replace(prior=None, landmarks=None, beam_angles=None))._replace(
        prior=cut.prior, landmarks=cut.landmarks, beam_angles=cut.beam_angles
    )


# Each of these makes batches of four sequences of twelve steps, so that one program does for all.


def test_padding_changes_nothing(tolerance):
    batch = drives()
    short = first_steps(batch, 7, 3)
    joined = tuning.join(tuning.pick(batch, slice(0, 3)), short)
    assert joined.counted.shape == (4, 12)
    assert joined.counted[3].sum() == 7
    whole = jax.tree.map(lambda x: x[:3], every_sum(batch))
    expected = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), whole, every_sum(short))
    near(every_sum(joined), expected, tolerance)


def first_sequence():
    return tuning.pick(drives(), slice(0, 1))


def is_the_first_sequence(cut, tolerance):
    np.testing.assert_array_equal(np.asarray(cut.counted).sum(), 12)
    whole = jax.tree.map(lambda x: x[0], every_sum(drives()))
    near(jax.tree.map(jnp.sum, every_sum(cut)), whole, tolerance)


def test_windows_that_run_in_from_the_prior_are_the_whole(tolerance):
    anywhere = Gaussian(np.zeros((1, 12, 3)), np.eye(3)[None, None].repeat(12, axis=1))
    cut = tuning.windows(first_sequence(), 3, run_in=12, beliefs=anywhere)
    assert cut.counted.shape == (4, 12)
    is_the_first_sequence(cut, tolerance)


def test_windows_start_where_they_are_told(tolerance):
    """Started at the filter's own beliefs, windows see what the filter saw."""
    beliefs = jax.jit(lambda batch: tuning.beliefs(OWN, batch, config=ONLY_POSES))(drives())
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
        tuning.blocks(drives(), 2)


def test_an_unknown_truth_is_not_judged():
    batch = drives()
    truth = np.array(batch.truth[0])
    truth[3:6] = np.nan
    inputs, prior = jax.tree.map(lambda x: x[0], (batch.inputs, batch.prior))
    one = tuning.sequence(inputs, prior, landmarks=batch.landmarks, truth=truth, beam_angles=batch.beam_angles)
    sums = every_sum(tuning.join(one, tuning.pick(batch, slice(1, 4))))
    assert float(sums["pose_nll"][1][0]) == 9
    assert float(sums["innovation_nll"][1][0]) == np.asarray(batch.inputs.valid)[0].sum()
    assert np.isfinite(float(sums["pose_nll"][0][0]))


# --- Every field, in numbers that tell where they come from


def numbered(runs, steps, slots=2):
    """A batch each of whose numbers is its own."""
    count = iter(range(100))

    def made(*shape):
        return next(count) * 1000.0 + np.arange(np.prod(shape)).reshape(shape)

    inputs = Inputs(
        made(runs, steps),
        made(runs, steps, 2),
        made(runs, steps, slots).astype(np.int32),
        made(runs, steps, slots, 2),
        np.ones((runs, steps, slots), bool),
        made(runs, steps, 3),
    )
    return tuning.Batch(
        prior=Gaussian(made(runs, 3), made(runs, 3, 3)),
        inputs=inputs,
        counted=np.ones((runs, steps), bool),
        landmarks=made(4, 2),
        truth=made(runs, steps, 3),
        known=np.ones((runs, steps), bool),
        beam_angles=made(3),
        poses=made(runs, steps, 3),
    )


def same(got, expected):
    assert jax.tree.structure(got) == jax.tree.structure(expected)
    jax.tree.map(np.testing.assert_array_equal, got, expected)


def cut(batch, run, steps):
    """These steps of one run; what has no steps stays."""
    each = batch._replace(prior=None, landmarks=None, beam_angles=None)
    part = jax.tree.map(lambda x: x[run : run + 1, steps], each)
    prior = jax.tree.map(lambda x: x[run : run + 1], batch.prior)
    return part._replace(prior=prior, landmarks=batch.landmarks, beam_angles=batch.beam_angles)


def test_a_sequence_is_a_batch_of_one():
    whole = numbered(1, 5)
    one = jax.tree.map(lambda x: x[0], whole._replace(landmarks=None, beam_angles=None))
    given = {name: getattr(whole if name in ("landmarks", "beam_angles") else one, name) for name in _SEQUENCE}
    same(tuning.sequence(one.inputs, one.prior, **given), whole)
    # Where the truth is no number it is not known, and zero; where it is said not to be known, too.
    truth = one.truth.copy()
    truth[1, 2], truth[3, 0] = np.nan, np.inf
    for known in (None, np.array([True, False, True, False, True])):
        got = tuning.sequence(one.inputs, one.prior, truth=truth if known is None else one.truth, known=known)
        np.testing.assert_array_equal(got.known, [[True, False, True, False, True]])
        np.testing.assert_array_equal(got.truth[0], one.truth * [[1], [0], [1], [0], [1]])
    assert tuning.sequence(one.inputs, one.prior).truth is None


_SEQUENCE = ("landmarks", "truth", "known", "beam_angles", "poses")


def test_no_observations_are_steps_of_no_time_with_no_slots():
    inputs = tuning.no_observations(4)
    assert [None if x is None else x.shape for x in inputs] == [(4,), (4, 2), (4, 0), (4, 0, 2), (4, 0), None]
    assert [x.dtype for x in inputs[2:5]] == [np.int32, np.float64, np.bool_]
    assert not any(x.any() for x in inputs[:5])


def test_what_is_joined_keeps_its_order_and_is_filled_with_nothing():
    long, short = numbered(2, 5, 3), numbered(1, 3, 2)
    for batches, rows in (((long, short), (slice(0, 2), 2)), ((short, long), (slice(1, 3), 0))):
        joined = tuning.join(*batches)
        same(tuning.pick(joined, rows[0]), long)
        filled = tuning.pick(joined, slice(rows[1], rows[1] + 1))
        inputs = filled.inputs
        slots = inputs._replace(landmark=inputs.landmark[..., :2], z=inputs.z[..., :2, :], valid=inputs.valid[..., :2])
        same(cut(filled._replace(inputs=slots), 0, slice(0, 3)), short)
        for x in (filled.counted, filled.known, inputs.valid, inputs.dt, inputs.control, inputs.z, inputs.landmark):
            assert not x[:, 3:].any()
        for x in (filled.truth, filled.poses, inputs.valid[:, :, 2:], inputs.z[:, :3, 2:], inputs.landmark[:, :3, 2:]):
            assert not x[:, 3:].any()
        assert np.isnan(inputs.ranges[:, 3:]).all()
        assert not inputs.valid[:, :, 2:].any()


@pytest.mark.parametrize("name", ["ranges", "truth", "known", "poses", "landmarks", "beam_angles"])
def test_a_field_that_only_some_have_is_named(name):
    batch = numbered(1, 3)
    without = batch._replace(inputs=batch.inputs._replace(ranges=None)) if name == "ranges" else None
    with pytest.raises(ValueError, match=f"^{name}: expected in all batches or in none, got it in 2 of 3"):
        tuning.join(batch, without or batch._replace(**{name: None}), batch)


@pytest.mark.parametrize("name", ["landmarks", "beam_angles"])
def test_what_is_shared_must_be_the_same(name):
    batch = numbered(1, 3)
    other = np.array(getattr(batch, name))
    other.flat[-1] += 1e-9 + 1
    for value in (other, other[:-1]):
        with pytest.raises(ValueError, match=f"^{name}: expected the same in all batches"):
            tuning.join(batch, batch, batch._replace(**{name: value}))


def test_a_window_is_its_steps_and_those_it_runs_in_from_the_belief_before():
    """Of two sequences, of which the second counts to its sixth step, and not the third."""
    batch = numbered(2, 8)
    batch.counted[1, 6:] = batch.counted[1, 2] = False
    beliefs = Gaussian(*(np.asarray(x) + 0.5 for x in (batch.truth, np.ones((2, 8, 3, 3)) * batch.truth[..., None])))
    got = tuning.windows(batch, 3, run_in=2, beliefs=beliefs)
    # (sequence, from, to, counted of these)
    expected = [(0, 0, 3, 3), (0, 1, 6, 3), (0, 4, 8, 2), (1, 0, 3, 2), (1, 1, 6, 3)]
    assert got.counted.shape == (5, 5)
    for row, (run, first, end, count) in enumerate(expected):
        part = cut(batch, run, slice(first, end))
        counted = part.counted & (np.arange(first, end) >= (first + 2 if first else 0))
        assert counted.sum() == count
        if first:
            part = part._replace(prior=jax.tree.map(lambda x, r=run, f=first: x[r : r + 1, f - 1], beliefs))
        same(cut(got, row, slice(0, end - first)), part._replace(counted=counted))
        assert not got.counted[row, end - first :].any()
    none = tuning.windows(batch, 4, run_in=0, beliefs=beliefs)
    np.testing.assert_array_equal(none.inputs.dt[1], batch.inputs.dt[0, 4:])
    np.testing.assert_array_equal(none.prior.mean[1], beliefs.mean[0, 3])
    for length, run_in in ((0, 0), (1, -1)):
        with pytest.raises(ValueError, match=f"length, run_in: .* got {length} and {run_in}"):
            tuning.windows(batch, length, run_in=run_in, beliefs=beliefs)


def test_blocks_follow_each_other_and_leave_out_what_does_not_count():
    batch = numbered(1, 8)
    batch.counted[0, [0, 5]] = False
    got = tuning.blocks(batch, 3)
    assert [np.flatnonzero(row).tolist() for row in got.counted] == [[1, 2], [3, 4], [6, 7]]
    for row in range(3):
        same(tuning.pick(got, slice(row, row + 1))._replace(counted=None), batch._replace(counted=None))
    for count in (0, 7):
        with pytest.raises(ValueError, match=f"1 to 6 blocks, got 1 and {count}"):
            tuning.blocks(batch, count)


def test_what_is_picked_keeps_what_all_share():
    batch = numbered(3, 4)
    got = tuning.pick(batch, np.array([2, 0]))
    np.testing.assert_array_equal(got.inputs.dt, batch.inputs.dt[[2, 0]])
    np.testing.assert_array_equal(got.prior.cov, batch.prior.cov[[2, 0]])
    assert got.landmarks is batch.landmarks
    assert got.beam_angles is batch.beam_angles
    same(tuning.pick(batch, np.array([False, True, False])), tuning.pick(batch, slice(1, 2)))


def test_simulated_drives_hang_on_all_of_their_key_and_each_on_its_own():
    """The same program as that of `drives`, in the same context."""

    def made(*words):
        key = jax.random.wrap_key_data(jnp.array(words, jnp.uint32))
        with jax.ensure_compile_time_eval():
            return tuning.simulated(key, 4, simulation.room(), simulation.Noise(), scenario=SHORT, scans=True)

    batches = [made(0, 0), made(0, 1), made(1, 0)]
    ends = np.concatenate([np.asarray(batch.truth)[:, -1] for batch in batches])
    assert len(np.unique(ends[:, 0])) == 12
    one = batches[0]
    assert one.counted.all()
    assert one.known.all()
    np.testing.assert_allclose(one.prior.mean, [SHORT.start] * 4, rtol=1e-6)
    np.testing.assert_allclose(one.prior.cov, [np.diag(np.square(SHORT.prior_std))] * 4, rtol=1e-5)
    np.testing.assert_allclose(one.beam_angles, np.linspace(-SHORT.half_view, SHORT.half_view, 9), rtol=1e-5)
    np.testing.assert_array_equal(one.landmarks, simulation.room().landmarks)
    # From an exact start a step of a tenth of a second leads not far.
    assert np.abs(np.asarray(one.truth)[:, 0] - np.array(SHORT.start)).max() < 0.3


def test_a_start_that_is_not_exact_is_drawn_from_the_prior_with_half_of_the_run_s_key():
    """One step of no time to speak of; of the heading there is noise of its own."""
    still = like(SHORT, name="still", steps=1, exact_prior=False, robot=dict(dt=1e-9))
    batch = tuning.simulated(jax.random.key(5), 8, simulation.room(), simulation.Noise(), scenario=still)
    draw = jax.jit(
        jax.vmap(lambda key, prior: simulation.draw_state(jax.random.split(key)[0], prior), in_axes=(0, None))
    )
    starts = draw(jax.random.split(jax.random.key(5), 8), still.prior())
    np.testing.assert_allclose(batch.truth[:, 0, :2], starts[:, :2], rtol=0, atol=1e-5)
    assert batch.beam_angles is None
    assert batch.inputs.ranges is None


def test_simulated_rooms_may_differ_from_run_to_run():
    rooms = jax.vmap(random_room)(jax.random.split(jax.random.key(1), 3))
    batch = jax.eval_shape(
        lambda key, rooms: tuning.simulated(key, 3, rooms, simulation.Noise(), scenario=SHORT, scans=True, worlds=True),
        jax.random.key(0),
        rooms,
    )
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
    batch = drives()
    with pytest.raises(ValueError, match="at least one, got none"):
        tuning.join()
    with pytest.raises(ValueError, match=r"truth: expected in all batches or in none, got it in 1 of 2"):
        tuning.join(batch, batch._replace(truth=None, known=None))
    with pytest.raises(ValueError, match="landmarks: expected the same in all batches"):
        tuning.join(batch, batch._replace(landmarks=batch.landmarks + 1))
    with pytest.raises(ValueError, match="length, run_in"):
        tuning.windows(batch, 0, run_in=0, beliefs=batch.prior)
