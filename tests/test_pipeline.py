"""The loop against the reference's loop, in its limiting cases, under every transformation, and with bad numbers."""

import functools
import math
import re

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from jax.sharding import Mesh, PartitionSpec

from jaxlocmap import Config, Gaussian, GridSpec, Inputs, init, map_scans, motion, run, sensors, step
from jaxlocmap.filters import ekf
from jaxlocmap.mapping import grid, quality
from jaxlocmap.step import correct, is_held, is_valid, predict
from jaxlocmap.types import Scanner

GATE = ekf.gate_threshold(0.99, 2)
STEPS = 12  # of a short run: the course's detector looks at steps 0, 5 and 10
SLOTS = 2

compiled = jax.jit(run, static_argnames=("config", "collect"))


def put(x, where, value):
    """A copy with other entries, in NumPy: JAX would compile a program for each place and shape."""
    x = np.array(x)
    x[where] = value
    return x


def localise(course, config, execute=compiled):
    """Run the filter over `course.inputs` from its prior: last state, every step's Info, as NumPy arrays."""
    return jax.tree.map(np.asarray, traceable(course, config, execute))


def traceable(course, config, execute=compiled):
    state = init(course.prior, config=config)
    mapping = {} if course.inputs.ranges is None else {"beam_angles": course.beam_angles}
    return execute(course.params, state, course.inputs, landmarks=course.landmarks, config=config, **mapping)


def edit(course, **fields):
    """The course with other inputs."""
    return course._replace(inputs=course.inputs._replace(**fields))


@functools.partial(jax.jit, static_argnames="config")
def compiled_batch(params, state, inputs, landmarks, config):
    return jax.vmap(lambda i: run(params, state, i, landmarks=landmarks, config=config))(inputs)


def localise_batch(courses, config):
    """Runs at once that differ in their inputs; the rest is the first one's."""
    first = courses[0]
    inputs = jax.tree.map(lambda *x: np.stack(x), *(c.inputs for c in courses))
    state = init(first.prior, config=config)
    return jax.tree.map(np.asarray, compiled_batch(first.params, state, inputs, first.landmarks, config))


def lane(tree, index):
    return jax.tree.map(lambda x: x[index], tree)


@pytest.fixture(scope="module")
def course(course):
    """In NumPy: to cut it and to change it compiles nothing."""
    return type(course)(*jax.tree.map(np.asarray, course[:-1]), course.grid)


@pytest.fixture(scope="module")
def short(course):
    return course.first(STEPS)


@pytest.fixture(scope="module")
def config(course):
    return course.config()


@pytest.fixture(scope="module")
def short_result(short, config):
    return localise(short, config)


# --- against the independent loop


def assert_info_is(info, expected, tolerance):
    """Every field of Info. What divides by S is magnified by up to 1e3."""
    got = {
        "mean": (info.belief.mean, tolerance(1e-10, 2e-4)),
        "cov": (info.belief.cov, tolerance(1e-12, 2e-6)),
        "innovation": (info.innovation, tolerance(1e-10, 2e-4)),
        "S": (info.S, tolerance(1e-12, 2e-6)),
        "nis": (info.nis, tolerance(1e-9, 1e-2)),
        "log_likelihood": (info.log_likelihood, tolerance(1e-9, 1e-2)),
    }
    for name, (value, atol) in got.items():
        np.testing.assert_allclose(value, expected[name], rtol=0, atol=atol, err_msg=name)
    np.testing.assert_array_equal(info.accepted, expected["accepted"])
    assert bool(np.all(info.ok))


@pytest.mark.parametrize("model", ["euler", "arc", "capstone"])
def test_the_course_run_is_the_reference_to_every_field_and_cell(model, course, tolerance):
    expected = reference.course_run(motion=model, conventions="design", gate=GATE)
    state, info = localise(course, course.config(motion=model, mapping=True))
    assert_info_is(info, expected, tolerance)
    np.testing.assert_allclose(state.log_likelihood, expected["log_likelihood"].sum(), rtol=tolerance(1e-12, 1e-4))
    error = np.abs(np.asarray(state.log_odds) - expected["log_odds"])
    # Float64: another order of summation. Float32: poses are 1e-5 m off, which moves an end across the edge of a
    # cell in one of 1e4 beams, and with it the cells along that beam.
    assert np.mean(error > tolerance(1e-12, 1e-4)) <= tolerance(0.0, 0.01)


def test_the_reference_is_the_courses_program():
    """Its own conventions give the numbers of the course's text."""
    course = reference.course_run()
    np.testing.assert_allclose(course["mean"][-1], [6.46387367, 5.58104105, 0.32367098], rtol=0, atol=5e-9)
    assert course["rmse_position"] == pytest.approx(0.0293, abs=5e-5)
    assert course["rmse_yaw"] == pytest.approx(0.0136, abs=5e-5)
    occupancy = [course[f"occupancy_{name}"] for name in ("min", "max", "mean")]
    assert np.all(np.abs(np.subtract(occupancy, [0.018, 0.982, 0.4352])) < [5e-4, 5e-4, 5e-5])


def test_the_designs_map_of_the_course_run(course):
    state, _ = localise(course, course.config(motion="capstone", mapping=True))
    assert float(jnp.mean(grid.probability(state.log_odds))) == pytest.approx(0.4344, abs=5e-5)


def random_drive(seed, offset=(0.0, 0.0, 0.0)):
    """A course with uneven steps, some of no length, empty and anonymous slots, and numbers of no sense at all."""
    rng = np.random.default_rng(seed)
    dt = rng.uniform(0.02, 0.3, STEPS)
    dt[3] = 0.0
    control = np.column_stack([rng.uniform(-1, 1, STEPS), rng.uniform(-2, 2, STEPS)])
    landmark = np.where(rng.random((STEPS, SLOTS)) < 0.4, -1, rng.integers(4, size=(STEPS, SLOTS))).astype(np.int32)
    valid = rng.random((STEPS, SLOTS)) < 0.7
    z, pose = np.zeros((STEPS, SLOTS, 2)), reference.COURSE_PRIOR_MEAN
    for k in range(STEPS):
        pose, _, _ = reference.arc(pose, control[k], dt[k])
        for m in range(SLOTS):
            seen = landmark[k, m] if landmark[k, m] >= 0 else rng.integers(4)
            z[k, m] = reference.expected_observation(pose, reference.COURSE_LANDMARKS[seen], offset)[0]
    z += rng.normal(size=z.shape) * np.where(rng.random((STEPS, SLOTS, 1)) < 0.3, 3.0, 0.05)
    z[..., 0] = np.abs(z[..., 0])
    return dt, control, landmark, z, valid


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (0.219, -0.1, 0.7)])
def test_uneven_steps_a_mounted_sensor_and_anonymous_outliers_are_the_reference(offset, short, tolerance):
    drive = random_drive(0, offset)
    expected = reference.run(
        reference.COURSE_PRIOR_MEAN,
        reference.COURSE_PRIOR_COV,
        *drive,
        reference.COURSE_LANDMARKS,
        reference.COURSE_Q,
        reference.COURSE_R,
        GATE,
        "arc",
        0.1,
        offset,
    )
    inputs = Inputs(*(np.array(x) for x in drive))
    _, info = localise(short._replace(inputs=inputs), short.config(sensor_offset=offset))
    assert_info_is(info, expected, tolerance)
    rejected = np.asarray(inputs.valid) & ~expected["accepted"]
    assert rejected.any()
    assert (np.asarray(inputs.valid) & (drive[2] < 0) & expected["accepted"]).any()


# --- limiting cases


def test_without_observations_the_run_is_predict_alone(short, config, tolerance):
    _, info = localise(edit(short, valid=np.zeros_like(short.inputs.valid)), config)
    mean, cov = short.prior
    predict = jax.jit(functools.partial(ekf.predict, motion=motion.ARC, nominal_dt=config.dt))
    for k in range(STEPS):
        mean, cov = predict(mean, cov, short.inputs.control[k], short.inputs.dt[k], short.params.Q)
        np.testing.assert_allclose(info.belief.mean[k], mean, rtol=0, atol=tolerance(1e-15, 1e-6))
        np.testing.assert_allclose(info.belief.cov[k], cov, rtol=0, atol=tolerance(1e-15, 1e-7))
    for field in (info.innovation, info.S, info.nis, info.log_likelihood, info.accepted):
        assert not np.any(field)


def test_data_without_noise_leaves_no_error(short, config, tolerance):
    pose, truth, z = reference.COURSE_PRIOR_MEAN, [], np.zeros((STEPS, SLOTS, 2))
    for k in range(STEPS):
        pose, _, _ = reference.arc(pose, np.asarray(short.inputs.control[k], float), 0.1)
        truth.append(pose)
        z[k] = [reference.expected_observation(pose, mark)[0] for mark in reference.COURSE_LANDMARKS[-SLOTS:]]
    _, info = localise(edit(short, z=np.array(z), valid=np.ones((STEPS, SLOTS), bool)), config)
    np.testing.assert_allclose(info.belief.mean, truth, rtol=0, atol=tolerance(1e-14, 1e-5))
    assert np.all(info.accepted)


def test_500_steps_without_a_landmark_grow_the_covariance_and_stay_sound(short, config):
    """In pieces of the short run, whose program they share."""
    blind = edit(
        short,
        dt=np.full(STEPS, 0.1),
        control=np.tile([0.5, 0.05], (STEPS, 1)),
        landmark=np.zeros((STEPS, SLOTS), np.int32),
        z=np.zeros((STEPS, SLOTS, 2)),
        valid=np.zeros((STEPS, SLOTS), bool),
    )
    state, infos = init(short.prior, config=config), []
    for _ in range(-(-500 // STEPS)):
        state, info = compiled(short.params, state, blind.inputs, landmarks=short.landmarks, config=config)
        infos.append(info)
    info = jax.tree.map(lambda *x: np.concatenate(x), *infos)
    assert len(info.ok) >= 500
    cov = np.asarray(info.belief.cov, np.float64)
    assert bool(np.all(info.ok))
    assert np.linalg.eigvalsh(cov).min() > 0
    assert np.all(np.diff(cov[:, 2, 2]) > 0)
    assert np.all(np.diff(np.linalg.det(cov)) > 0)  # a prediction only adds to the volume


def test_an_observation_outside_the_gate_is_reported_and_not_used(short, config):
    k, slot = 0, int(np.flatnonzero(short.inputs.valid[0])[0])
    far = edit(short, z=put(short.inputs.z, (k, slot, 0), short.inputs.z[k, slot, 0] + 5.0))
    empty = edit(short, valid=put(short.inputs.valid, (k, slot), False))
    (_, gated), (_, unseen) = localise(far, config), localise(empty, config)
    assert float(gated.nis[k, slot]) > GATE
    assert not gated.accepted[k, slot]
    assert float(gated.innovation[k, slot, 0]) > 4.0
    assert bool(np.all(gated.ok))
    np.testing.assert_array_equal(gated.belief.mean, unseen.belief.mean)


def test_log_likelihood_of_the_state_is_the_sum_over_observations(short_result, tolerance):
    state, info = short_result
    np.testing.assert_allclose(state.log_likelihood, np.sum(info.log_likelihood), rtol=tolerance(1e-14, 1e-5))


# --- the same numbers however it is run


def test_a_run_split_in_two_is_the_whole(course):
    """That of the course, which has a program already."""
    config = course.config(mapping=True)
    whole, info = localise(course, config)
    half = len(course.inputs.dt) // 2
    assert 2 * half == len(course.inputs.dt)
    state, infos = init(course.prior, config=config), []
    for part in (slice(0, half), slice(half, None)):
        now = lane(course.inputs, part)
        state, part_info = compiled(
            course.params, state, now, landmarks=course.landmarks, beam_angles=course.beam_angles, config=config
        )
        infos.append(part_info)
    chex.assert_trees_all_equal(state, whole)
    chex.assert_trees_all_equal(jax.tree.map(lambda *x: np.concatenate(x), *infos), info)


def test_mapping_afterwards_is_mapping_on_the_way(course, tolerance):
    on_the_way, info = localise(course, course.config(mapping=True))
    alone, without = localise(edit(course, ranges=None), course.config())
    # Two programs, which the compiler may round differently.
    chex.assert_trees_all_close(info.belief, without.belief, rtol=0, atol=tolerance(1e-12, 1e-4))
    assert alone.log_odds is None
    afterwards = jax.jit(map_scans, static_argnames="config")(
        course.params,
        np.zeros(course.grid.shape),
        info.belief.mean,
        course.inputs.ranges,
        beam_angles=course.beam_angles,
        config=course.config(mapping=True),
    )
    np.testing.assert_allclose(afterwards, on_the_way.log_odds, rtol=0, atol=tolerance(1e-12, 1e-4))


def test_a_run_is_a_loop_of_steps(short, config, short_result, tolerance):
    state, compiled_step = init(short.prior, config=config), jax.jit(step, static_argnames="config")
    for k in range(STEPS):
        state, info = compiled_step(
            short.params, state, lane(short.inputs, k), landmarks=short.landmarks, config=config
        )
        # The compiler may leave out roundings in one program and not in the other.
        chex.assert_trees_all_close(
            info, lane(short_result[1], k), rtol=tolerance(1e-11, 1e-3), atol=tolerance(1e-13, 1e-5)
        )


def test_jit_is_no_jit(short, config, short_result, tolerance):
    got = localise(short, config, execute=run)
    chex.assert_trees_all_close(got, short_result, rtol=tolerance(1e-11, 1e-3), atol=tolerance(1e-13, 1e-5))


def variants(short):
    """Different runs: as the course saw, blind, anonymous landmarks at every step, and the same with wrong names."""
    blind = edit(short, valid=np.zeros_like(short.inputs.valid))
    drive = Inputs(*(np.array(x) for x in random_drive(1)))._replace(valid=np.ones((STEPS, SLOTS), bool))
    anonymous = short._replace(inputs=drive._replace(landmark=np.full_like(drive.landmark, -1)))
    return short, blind, anonymous, edit(anonymous, landmark=np.zeros_like(drive.landmark))


def test_vmap_is_a_loop(short, config, tolerance):
    runs = variants(short)
    batches = localise_batch(runs[:3], config), localise_batch(runs[1:], config)
    for batch, within in zip(batches, (runs[:3], runs[1:]), strict=True):
        for index, one in enumerate(within):
            chex.assert_trees_all_close(
                lane(batch, index), localise(one, config), rtol=tolerance(1e-11, 1e-3), atol=tolerance(1e-13, 1e-5)
            )


@pytest.mark.parametrize("gate", [0.99, None])
def test_a_run_does_not_depend_on_its_company(gate, short):
    """Bit for bit, whoever else observes at a step, and whether they know what; also where no gate would help."""
    config = short.config(gate_probability=gate)
    sighted, blind, anonymous, misnamed = variants(short)
    for one in (sighted, blind, anonymous, misnamed):
        alone = lane(localise_batch([one] * 3, config), 0)
        for others in ((blind, blind), (sighted, anonymous), (anonymous, misnamed)):
            chex.assert_trees_all_equal(lane(localise_batch([one, *others], config), 0), alone)


def branches(function, *args):
    """Number of `cond`s that are still branches in the program of a function."""
    return str(jax.make_jaxpr(function)(*args)).count("cond[")


def test_branches_stay_branches_under_every_transformation(course):
    """A batched predicate would turn them into selects that run both sides; there are three, one of them the map's."""
    config = course.config(mapping=True)
    state, first = init(course.prior, config=config), course.first(2, slots=1, scans=True).inputs

    def likelihood(inputs):
        return run(
            course.params, state, inputs, landmarks=course.landmarks, beam_angles=course.beam_angles, config=config
        )[0].log_likelihood

    def slope(inputs):
        return jax.grad(lambda z: likelihood(inputs._replace(z=z)))(inputs.z)

    def batched_slope(inputs):
        return jax.grad(lambda z: jnp.sum(jax.vmap(likelihood)(inputs._replace(z=z))))(inputs.z)

    batch = jax.tree.map(lambda x: np.stack([x] * 2), first)
    batches = jax.tree.map(lambda x: np.stack([x] * 2), batch)
    plain, plain_slope = branches(likelihood, first), branches(slope, first)
    assert plain >= 3
    assert branches(jax.vmap(likelihood), batch) == plain
    assert branches(jax.vmap(jax.vmap(likelihood)), batches) == plain
    assert plain_slope >= 3
    assert branches(jax.vmap(slope), batch) == plain_slope
    assert branches(batched_slope, batch) == plain_slope


def test_other_values_do_not_compile_again(short, config):
    """One trace for other parameters, landmarks, inputs and prior."""

    @jax.jit
    @chex.assert_max_traces(n=1)
    def once(params, prior, inputs, landmarks):
        return run(params, init(prior, config=config), inputs, landmarks=landmarks, config=config)

    chex.clear_trace_counter()
    args = (short.params, short.prior, short.inputs, short.landmarks)
    means = [once(*args)[0].belief.mean]
    for index in range(4):
        other = list(args)
        other[index] = jax.tree.map(lambda x: x * 1.01 if jnp.issubdtype(x.dtype, jnp.floating) else x, args[index])
        means.append(once(*other)[0].belief.mean)
    assert len({tuple(m.tolist()) for m in means}) == 5  # and every one of them mattered


def without_slots(course):
    """A run that observes nothing, which compiles fastest."""
    inputs = course.inputs
    return edit(course, landmark=inputs.landmark[:, :0], z=inputs.z[:, :0], valid=inputs.valid[:, :0])


def test_nobody_needs_jit_to_compile_once(short):
    """`run` and `step` as they are: with other values and the same shapes, the motion model is not traced again."""
    traced = []

    def transition(state, u, dt):
        traced.append(1)
        return motion.EULER.transition(state, u, dt)

    config = Config(motion=motion.from_transition(transition))
    short = without_slots(short)
    state = init(short.prior, config=config)
    one = lane(short.inputs, 0)
    for call in (
        lambda scale: run(scale(short.params), state, short.inputs, landmarks=short.landmarks, config=config),
        lambda scale: step(scale(short.params), state, one, landmarks=short.landmarks, config=config),
    ):
        call(lambda params: params)
        before = len(traced)
        assert before
        call(lambda params: params._replace(Q=2 * params.Q))
        assert len(traced) == before


def test_a_config_made_anew_does_not_compile_again(short):
    before, blind = compiled._cache_size(), without_slots(short)
    localise(blind, Config(dt=0.1, motion="euler"))
    localise(blind, Config(dt=0.1, motion="euler"))
    assert compiled._cache_size() == before + 1


def test_shard_map_over_runs_needs_no_wrapper(short, config):
    state = init(short.prior, config=config)
    over_runs = PartitionSpec("runs")

    def block(params, inputs, landmarks):
        return jax.vmap(lambda i: run(params, state, i, landmarks=landmarks, config=config))(inputs)

    sharded = jax.shard_map(
        block,
        mesh=Mesh(np.array(jax.devices()), ("runs",)),
        in_specs=(PartitionSpec(), over_runs, PartitionSpec()),
        out_specs=over_runs,
    )
    sharded, runs = jax.jit(sharded), variants(short)
    for some in (runs[:3], runs[1:]):  # three at a time, as other tests run them
        inputs = jax.tree.map(lambda *x: np.stack(x), *(c.inputs for c in some))
        got = sharded(short.params, inputs, short.landmarks)
        chex.assert_trees_all_close(got, localise_batch(some, config), rtol=1e-6, atol=1e-6)


def test_a_landmark_on_the_sensor_is_flagged_and_not_used(short, config):
    """Of two observations at step 0 the first is of the spot the robot stands on; the second goes on as usual."""
    prior = Gaussian(np.array([1.0, 2.0, 0.0]), np.eye(3) * 1e-4)
    inputs = edit(
        short,
        control=np.zeros((STEPS, 2)),
        landmark=np.broadcast_to(np.arange(SLOTS, dtype=np.int32), (STEPS, SLOTS)),
        valid=put(np.zeros((STEPS, SLOTS), bool), (0, slice(2)), True),
        z=np.ones((STEPS, SLOTS, 2)),
    ).inputs
    marks = put(put(short.landmarks, 0, np.array([1.0, 2.0])), 1, np.array([2.0, 2.0]))
    _, info = run(short.params, init(prior, config=config), inputs, landmarks=marks, config=config)
    assert info.ok.tolist() == [False] + [True] * (STEPS - 1)
    assert float(info.nis[0, 0]) == 0
    assert float(info.nis[0, 1]) > 0
    assert info.row[0].tolist() == [-1, 1, *[-1] * (SLOTS - 2)]


def test_a_landmark_within_an_arms_length_is_used(short, config):
    """5 cm away it has a bearing, though a poor one."""
    prior = Gaussian(np.array([1.0, 2.0, 0.0]), np.eye(3) * 1e-4)
    inputs = short.inputs._replace(
        control=np.zeros((STEPS, 2)),
        landmark=np.zeros((STEPS, SLOTS), np.int32),
        valid=put(np.zeros((STEPS, SLOTS), bool), (0, 0), True),
        z=np.broadcast_to(np.array([0.06, 0.02]), (STEPS, SLOTS, 2)),
    )
    marks = put(short.landmarks, 0, np.array([1.05, 2.0]))
    _, info = compiled(short.params, init(prior, config=config), inputs, landmarks=marks, config=config)
    assert bool(np.all(info.ok))
    assert info.row[0].tolist() == [0, *[-1] * (SLOTS - 1)]
    assert bool(info.accepted[0, 0])
    np.testing.assert_allclose(info.innovation[0, 0], [0.01, 0.02], rtol=0, atol=1e-6)
    assert float(info.belief.cov[0, 1, 1]) < 1e-5  # it lies ahead: 0.03 rad of bearing are 1.5 mm across


def test_info_says_which_landmark_an_anonymous_observation_was_taken_for(short, config):
    valid = np.asarray(short.inputs.valid)
    anonymous = edit(short, landmark=np.full_like(short.inputs.landmark, -1))
    for course in (short, anonymous):
        _, info = localise(course, config)
        np.testing.assert_array_equal(np.asarray(info.row)[valid], np.asarray(short.inputs.landmark)[valid])
        assert np.all(np.asarray(info.row)[~valid] == -1)


def test_collect_keeps_what_it_is_asked_for_with_what_lies_aside(short, config):
    _, (info, truth) = run(
        short.params,
        init(short.prior, config=config),
        short.inputs,
        landmarks=short.landmarks,
        config=config,
        collect=lambda state, info, aside: (info.ok, aside * 2 + 0 * state.belief.mean[0]),
        aside=np.arange(STEPS).astype(float),
    )
    assert info.shape == (STEPS,)
    np.testing.assert_array_equal(truth, 2 * np.arange(STEPS))


# --- dtypes


def as_float32(tree):
    return jax.tree.map(lambda x: x.astype(jnp.float32) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree)


def assert_float32(tree):
    floats = [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)]
    assert floats
    assert {x.dtype for x in floats} == {jnp.dtype(jnp.float32)}


@pytest.fixture
def single(course):
    """The course's first steps in float32, whatever the session."""
    first = course.first(STEPS, scans=True)
    names = ("params", "prior", "inputs", "landmarks", "beam_angles")
    return first._replace(**{name: as_float32(getattr(first, name)) for name in names})


def test_float32_in_float32_out(single):
    result = localise(single, single.config(mapping=True))
    assert_float32(result)


def test_every_atom_keeps_float32(single):
    spec = single.grid
    offset = (0.1, 0.2, 0.3)

    def every_atom(params, prior, inputs, mark, beam_angles):
        (mean, cov), z, control, dt = prior, inputs.z[0], inputs.control, inputs.dt
        residual, H, _ = sensors.linearise(mean, mark, z, offset=offset)
        empty = jnp.zeros(spec.shape, jnp.float32)
        scanner = Scanner(beam_angles, (0.0, 0.0, 0.0), 0.05, 8.0)
        log_odds = grid.update_log_odds(
            empty, mean, inputs.ranges, params.l_occ, params.l_free, scanner=scanner, spec=spec
        )
        occupied = log_odds > 0
        return {
            "transition": [
                model.transition(mean, control, dt) for model in motion.MODELS.values() if model.inputs == 2
            ],
            "predict": ekf.predict(mean, cov, control, dt, params.Q, motion=motion.ARC, nominal_dt=0.1),
            "update": ekf.update(mean, cov, residual, H, params.R, threshold=GATE),
            "sensor": [residual, H.array(jnp.float32), sensors.observe(mean, mark, offset=offset)],
            "wheels": [motion.from_wheels(dt, z[0], 0.4), motion.to_wheels(control, 0.4)],
            "map": [log_odds, grid.probability(log_odds), quality.entropy_bits(log_odds)],
            "brier": quality.brier(log_odds, occupied, occupied),
            "calibration": quality.calibration(log_odds, occupied, occupied),
            "end": grid.endpoint_covariance(mean, cov, z[0], z[1], params.R),
        }

    now = lane(single.inputs, 0)
    arguments = single.params, single.prior, now, single.landmarks[0], single.beam_angles
    for atom in jax.eval_shape(every_atom, *arguments).values():
        assert_float32(atom)


@pytest.mark.usefixtures("x64")
def test_the_priors_dtype_wins_over_that_of_everything_else(course, single):
    """float32 prior, float64 the rest, and the other way round."""
    config = course.config(mapping=True)
    doubles = course.first(STEPS, scans=True)
    assert_float32(jax.eval_shape(lambda: traceable(doubles._replace(prior=single.prior), config)))
    state, _ = jax.eval_shape(lambda: traceable(single._replace(prior=course.prior), config))
    assert {x.dtype for x in jax.tree.leaves(state)} == {jnp.dtype(jnp.float64)}


# --- precision

UTM = np.array([388_096.0, 3_948_996.0, 0.3])


def test_a_prior_that_becomes_float32_must_fit_into_it():
    """As where x64 is off, whatever the prior came in; and a covariance may come in any."""
    prior = Gaussian(UTM, np.eye(3) * 0.01)
    with jax.enable_x64(False):
        with pytest.raises(ValueError, match=r"^prior\.mean: expected .* float32 .* got 3\.949e\+06 m, .* subtract"):
            init(prior, config=Config())
        init(prior._replace(mean=np.array([16_000.0, -16_000.0, 0.0])), config=Config())
    init(Gaussian(UTM.astype(np.float32) * 0, prior.cov), config=Config())


def test_landmarks_poses_and_grids_must_fit_into_the_dtype_of_the_state(single):
    far = Config(grid=GridSpec(origin=(UTM[0], 0.0), resolution=0.5, shape=(8, 8)))
    with pytest.raises(ValueError, match=r"^config\.grid: expected coordinates that float32 holds"):
        init(single.prior, config=far)
    state = init(single.prior, config=single.config())
    for marks in (np.tile(UTM[:2], (4, 1)), put(single.landmarks, (2, 0), -16_384.0)):
        with pytest.raises(ValueError, match=r"^landmarks: expected coordinates that float32 holds"):
            run(single.params, state, single.inputs, landmarks=marks, config=single.config())
    poses = put(np.zeros((STEPS, 3), np.float32), (3, 1), 2e4)
    with pytest.raises(ValueError, match=r"^poses: expected coordinates that float32 holds"):
        map_scans(
            single.params,
            np.zeros(single.grid.shape, np.float32),
            poses,
            single.inputs.ranges,
            beam_angles=single.beam_angles,
            config=single.config(mapping=True),
        )


@pytest.mark.parametrize(("x", "y", "fine"), [(16_000.0, 1.0, True), (16_390.0, 1.0, False), (1.0, -4e6, False)])
def test_a_pose_that_the_dtype_cannot_hold_is_flagged_where_it_cannot_be_refused(x, y, fine, single):
    config = single.config(mapping=True)
    state = init(single.prior, config=config)
    mean = np.array([x, y, 0.0], np.float32)
    _, info = compiled(
        single.params,
        state._replace(belief=Gaussian(mean, state.belief.cov)),
        single.inputs,
        landmarks=single.landmarks,
        beam_angles=single.beam_angles,
        config=config,
    )
    assert info.ok.tolist() == [fine] * STEPS


def test_an_observed_landmark_that_the_dtype_cannot_hold_is_left_out_and_flagged(single):
    """Where it cannot be refused; one that nobody observes does no harm."""
    config = single.config(mapping=True)
    valid = np.asarray(single.inputs.valid)
    names = np.asarray(single.inputs.landmark)
    seen = {int(name) for name in names[valid]}
    for row in range(4):
        _, info = compiled(
            single.params,
            init(single.prior, config=config),
            single.inputs,
            landmarks=put(single.landmarks, (row, row % 2), -16_384.0),
            beam_angles=single.beam_angles,
            config=config,
        )
        hit = valid & (names == row)
        assert hit.any() == (row in seen)
        np.testing.assert_array_equal(info.ok, ~hit.any(axis=1))
        np.testing.assert_array_equal(info.row, np.where(valid & ~hit, names, -1))
    assert seen
    assert seen != set(range(4))


# --- unknown landmarks


def test_anonymous_observations_of_the_course_run_find_their_landmark(course, config):
    blind = edit(course, ranges=None)
    named = localise(blind, config)
    anonymous = localise(edit(blind, landmark=np.full_like(course.inputs.landmark, -1)), config)
    chex.assert_trees_all_equal(anonymous, named)


@pytest.mark.parametrize("beyond", [4, 1000])
def test_a_landmark_beyond_the_table_is_flagged_and_not_used(beyond, short, config):
    wrong = edit(
        short, landmark=put(short.inputs.landmark, (5, 0), beyond), valid=put(short.inputs.valid, (5, 0), True)
    )
    without = edit(short, valid=put(short.inputs.valid, (5, 0), False))
    (_, info), (_, expected) = localise(wrong, config), localise(without, config)
    np.testing.assert_array_equal(info.ok, np.arange(STEPS) != 5)
    chex.assert_trees_all_equal(info.belief, expected.belief)


# --- bad numbers


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("place", [0, 1])
def test_a_control_that_is_no_number_flags_its_step_and_no_other_run(bad, place, short, config):
    broken = edit(short, control=put(short.inputs.control, (4, place), bad))
    clean = localise_batch([short] * 3, config)
    batch = localise_batch([short, broken, short], config)
    for index in (0, 2):
        chex.assert_trees_all_equal(lane(batch, index), lane(clean, index))
    state, info = lane(batch, 1)
    np.testing.assert_array_equal(info.ok, np.arange(STEPS) != 4)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves((state, info)))
    # It stands still for that step and is no more certain for it.
    np.testing.assert_array_equal(info.belief.mean[4], info.belief.mean[3])
    assert np.linalg.eigvalsh(info.belief.cov[4] - info.belief.cov[3])[-1] > 0


@pytest.mark.parametrize("bad", [-0.1, -1e-9, math.nan, math.inf])
def test_a_step_length_that_is_none_is_flagged(bad, short, config):
    _, info = localise(edit(short, dt=put(short.inputs.dt, 4, bad)), config)
    np.testing.assert_array_equal(info.ok, np.arange(STEPS) != 4)
    assert np.all(np.isfinite(info.belief.cov))
    # What it takes instead is a nominal step at rest, of which the belief grows.
    rest = edit(short, dt=put(short.inputs.dt, 4, config.dt), control=put(short.inputs.control, 4, 0.0))
    chex.assert_trees_all_equal(info.belief, localise(rest, config)[1].belief)
    assert float(info.belief.cov[4, 2, 2]) > float(info.belief.cov[3, 2, 2])


def test_what_is_not_said_of_a_step_is_taken_for_its_own_reason(course):
    """Standing still for the time that passed, or moving not at all for a nominal time; told, either way."""
    belief = Gaussian(np.array([1.0, 2.0, 0.5]), np.eye(3) * 1e-4)
    go, config = np.array([0.7, 0.3]), course.config()
    predicted = jax.jit(functools.partial(predict, config=config))
    by_hand = jax.jit(functools.partial(ekf.predict, motion=motion.ARC, nominal_dt=config.dt))
    for control, dt, taken, usable in (
        (go, 0.0, (go, 0.0), True),
        (go, 0.4, (go, 0.4), True),
        (put(go, 0, np.nan), 0.4, (0 * go, 0.4), False),
        (put(go, 1, np.inf), 0.4, (0 * go, 0.4), False),
        (go, np.nan, (0 * go, config.dt), False),
        (go, -0.4, (0 * go, config.dt), False),
        (go, np.inf, (0 * go, config.dt), False),
    ):
        got, was_usable = predicted(course.params, belief, control, np.array(dt))
        expected = by_hand(*belief, taken[0], np.array(taken[1]), course.params.Q)
        chex.assert_trees_all_close(tuple(got), expected, rtol=1e-6, atol=1e-9)
        assert bool(was_usable) is usable


@pytest.mark.parametrize(
    ("place", "bad"), [(place, bad) for place in range(3) for bad in (math.nan, math.inf, -math.inf)]
)
def test_a_belief_is_sound_if_all_of_it_is(place, bad):
    mean, cov = np.array([1.0, 2.0, 0.5]), np.eye(3)
    assert is_valid(Gaussian(mean, cov))
    assert not is_valid(Gaussian(put(mean, place, bad), cov))
    assert not is_valid(Gaussian(mean, put(cov, (place, place), bad)))
    assert not is_valid(Gaussian(mean, put(cov, (place, place), -1.0)))


def test_a_place_is_held_below_16384_m_in_float32_on_either_side_of_either_axis():
    far, near = 16_384, 16_384 - 2**-10
    places = [[near, 0], [far, 0], [-near, 0], [-far, 0], [0, far], [0, -far], [near, -near]]
    x, y = jnp.array(places, jnp.float32).T
    np.testing.assert_array_equal(is_held(x, y), [True, False, True, False, False, False, True])
    assert not is_held(jnp.array(jnp.nan), jnp.array(0.0))


def test_a_range_is_one_above_zero_and_a_bearing_any_number():
    reach = jnp.array([1e-9, 0.0, -0.0, -1.0, jnp.nan, jnp.inf, 1.0, 1.0, 1.0, 1.0])
    bearing = jnp.array([9.0, 0.0, 0.0, 0.0, 0.0, 0.0, -0.0, jnp.nan, jnp.inf, -jnp.inf])
    expected = [True, False, False, False, False, False, True, False, False, False]
    got = jax.vmap(sensors.RANGE_BEARING.is_measurement)(jnp.stack([reach, bearing], axis=1))
    np.testing.assert_array_equal(got, expected)


@pytest.mark.parametrize("temperature", [0.0, 1.0])
def test_an_observation_whose_covariance_is_none_is_reported_and_not_called_used(temperature, course):
    """R = -9 I makes that of the innovation negative."""
    corrected = jax.jit(functools.partial(correct, config=course.config(gate_temperature=temperature)))
    belief = Gaussian(np.array([1.0, 2.0, 0.0]), np.eye(3) * 1e-4)
    rest = np.array([1.01, 0.01]), np.array([2.0, 2.0]), np.array(3, np.int32), np.array(True)
    for R, fine in ((course.params.R, True), (-9 * np.eye(2), False)):
        after, observation, used = corrected(course.params._replace(R=R), belief, *rest)
        assert (bool(used), bool(observation.accepted), int(observation.row)) == (fine, fine, 3)
        assert bool(np.isfinite(observation.nis)) is fine
        assert bool(np.all(after.cov == belief.cov)) is not fine
    # Just outside the gate, where a hard one decides and a soft one weighs.
    after, observation, used = corrected(course.params, belief, put(rest[0], 0, 1.48), *rest[1:])
    assert (bool(used), bool(observation.accepted), float(observation.nis) > 9.21) == (True, False, True)
    assert bool(np.all(after.mean == belief.mean)) is (temperature == 0)
    _, observation, used = corrected(course.params, belief, *rest[:3], np.array(False))
    assert (bool(used), bool(observation.accepted), int(observation.row)) == (False, False, -1)
    assert not any(np.any(x) for x in observation._replace(row=0))


def test_what_is_collected_of_a_map_is_within_its_bounds(course):
    """The loop leaves cells below the lower one until the end; who looks at a step sees what `step` would give.

    One beam ends 3 m ahead, one is longer than the reach of 4 m, and one is no longer than the least range.
    """
    spec = GridSpec(origin=(0.0, 0.0), resolution=1.0, shape=(3, 6), l_min=-0.5, l_max=0.6)
    steps, none = 4, np.zeros((4, 0))
    inputs = Inputs(
        dt=np.full(steps, 0.1),
        control=np.zeros((steps, 2)),
        landmark=np.array(none, np.int32),
        z=np.zeros((steps, 0, 2)),
        valid=np.array(none, bool),
        ranges=np.broadcast_to(np.array([3.0, 5.0, 1.2]), (steps, 3)),
    )
    config, angles = Config(dt=0.1, grid=spec, min_range=1.2, max_range=4.0), np.array([0.0, 0.0, math.pi / 2])
    state = init(Gaussian(np.array([0.5, 1.5, 0.0]), np.eye(3) * 1e-4), config=config)
    _, maps = run(
        course.params, state, inputs, beam_angles=angles, config=config, collect=lambda state, *_: state.log_odds
    )
    expected = np.zeros((steps, *spec.shape))
    expected[:, 1, :3] = -0.5  # two beams cross them at every step
    expected[:, 1, 3] = [0.45, 0.6, 0.6, 0.6]
    np.testing.assert_allclose(maps, expected, rtol=1e-6)


def test_a_step_of_no_length_changes_nothing(short, config):
    _, info = localise(edit(short, dt=put(short.inputs.dt, 4, 0.0)), config)
    assert bool(np.all(info.ok))
    chex.assert_trees_all_equal(lane(info.belief, 4), lane(info.belief, 3))


@pytest.mark.parametrize(
    ("bad", "place"),
    [(math.nan, 0), (math.inf, 0), (-math.inf, 0), (math.nan, 1), (math.inf, 1), (0.0, 0), (-1e-3, 0), (-5.0, 0)],
)
def test_an_observation_that_is_no_measurement_is_flagged_and_not_used(bad, place, short, config):
    """No number, or a range that is not above zero."""
    slot = int(np.flatnonzero(short.inputs.valid[5])[0])
    broken = edit(short, z=put(short.inputs.z, (5, slot, place), bad))
    without = edit(short, valid=put(short.inputs.valid, (5, slot), False))
    (state, info), (expected_state, expected) = localise(broken, config), localise(without, config)
    np.testing.assert_array_equal(info.ok, np.arange(STEPS) != 5)
    chex.assert_trees_all_equal((state, info._replace(ok=None)), (expected_state, expected._replace(ok=None)))


def test_an_empty_slot_may_hold_anything(short, config, short_result):
    rubbish = edit(
        short,
        z=np.where(short.inputs.valid[..., None], short.inputs.z, np.nan),
        landmark=np.where(short.inputs.valid, short.inputs.landmark, 99),
    )
    chex.assert_trees_all_equal(localise(rubbish, config), short_result)


def test_a_covariance_that_has_broken_down_is_flagged(short, config):
    state = init(short.prior, config=config)
    broken = state._replace(belief=state.belief._replace(cov=-state.belief.cov))
    _, info = compiled(short.params, broken, short.inputs, landmarks=short.landmarks, config=config)
    assert not np.any(info.ok)


def test_a_prior_that_is_no_number_is_refused_or_where_it_cannot_be_flagged(short, config):
    bad = short.prior._replace(mean=np.array([np.nan, 1.0, 0.0]))
    with pytest.raises(ValueError, match=r"prior\.mean: expected finite x, y, theta, got \[nan"):
        init(bad, config=config)
    _, info = compiled(
        short.params,
        init(short.prior, config=config)._replace(belief=bad),
        short.inputs,
        landmarks=short.landmarks,
        config=config,
    )
    assert not np.any(info.ok)


def test_a_negative_step_length_is_refused_where_it_can_be_looked_at(short, config):
    inputs = short.inputs._replace(dt=put(short.inputs.dt, 2, -0.1))
    with pytest.raises(ValueError, match=r"inputs\.dt: expected seconds >= 0, got -0\.1 at step 2"):
        run(short.params, init(short.prior, config=config), inputs, landmarks=short.landmarks, config=config)


def test_a_control_that_is_no_number_takes_its_time_all_the_same(short, config):
    """Two seconds of unknown motion add the noise of two seconds at rest, and none pass at dt = 0."""
    dt = put(put(short.inputs.dt, 1, 2.0), 2, 0.0)
    lost = put(short.inputs.control, slice(1, 3), np.nan)
    rest = put(short.inputs.control, slice(1, 3), 0.0)
    blind = np.zeros_like(short.inputs.valid)
    _, got = localise(edit(short, dt=dt, control=lost, valid=blind), config)
    _, expected = localise(edit(short, dt=dt, control=rest, valid=blind), config)
    chex.assert_trees_all_equal(got.belief, expected.belief)
    assert got.ok.tolist() == [True, False, False] + [True] * (STEPS - 3)


def test_a_state_without_a_map_is_refused_by_a_config_with_a_grid(course, short, config):
    with pytest.raises(ValueError, match=r"state\.log_odds: expected a map"):
        localise(
            short,
            course.config(mapping=True),
            lambda params, state, *rest, **more: run(params, init(short.prior, config=config), *rest, **more),
        )


# --- gradients


SMALL = Config(grid=GridSpec(origin=(0.0, 0.0), resolution=1.0, shape=(12, 12), l_min=-50.0, l_max=50.0))


def total(given, rest):
    """Everything a run reports, added up; a map and a covariance at random weights, so that no part can cancel."""
    params, prior, fields, landmarks = given
    inputs, beam_angles = rest
    scene = {"landmarks": landmarks, "beam_angles": beam_angles, "config": SMALL}
    state, info = run(params, init(prior, config=SMALL), inputs._replace(**fields), **scene)
    rng = np.random.default_rng(0)
    weigh_map, weigh_cov = (jnp.array(rng.normal(size=shape), prior.mean.dtype) for shape in (SMALL.grid.shape, (3, 3)))
    mean, cov = state.belief
    reported = (state.log_likelihood, *info.belief, info.innovation, info.S, info.nis, info.log_likelihood)
    weighed = jnp.sum(weigh_map * state.log_odds) + jnp.sum(weigh_cov * cov) + 10 * jnp.sum(mean)
    return weighed + sum(jnp.sum(x) for x in reported)


slopes = jax.jit(jax.value_and_grad(total))


def of_slopes(course):
    """What a run is given of which there are slopes, and the rest."""
    inputs = course.inputs._replace(ranges=course.inputs.ranges[:, ::15])
    fields = {name: getattr(inputs, name) for name in ("control", "z", "dt")}
    given = course.params, course.prior, fields, course.landmarks
    return given, (inputs, course.beam_angles[::15])


@pytest.fixture(scope="module")
def six(course):
    """Six steps with scans and two observations."""
    first = course.first(6, scans=True)
    return edit(first, valid=put(first.inputs.valid, (0, 0), True))


@pytest.mark.usefixtures("x64")
def test_gradients_through_the_run_are_finite_differences(six):
    """Along one direction in everything it is given, forwards and in reverse."""
    given, rest = of_slopes(six)
    rng = np.random.default_rng(1)
    # Not in what was measured: other controls move the ends of beams across the edges of cells, where the map jumps.
    direction = jax.tree.map(lambda x: rng.normal(size=x.shape), given)
    direction = direction[0], direction[1], jax.tree.map(np.zeros_like, direction[2]), direction[3]

    def moved(by):
        return jax.tree.map(lambda x, d: x + by * d, given, direction)

    # Differences of step 3e-7 on variances of 4e-4: the cubic term is 1e-6 of the slope, rounding 1e-14 / 3e-7.
    length = 3e-7
    (_, gradient), (up, _), (down, _) = (
        jax.tree.map(np.asarray, slopes(moved(by), rest)) for by in (0.0, length, -length)
    )
    difference = (up - down) / (2 * length)
    reverse = sum(np.sum(g * d) for g, d in zip(*map(jax.tree.leaves, (gradient, direction)), strict=True))
    along = jax.jit(lambda given, direction: jax.jvp(lambda given: total(given, rest), (given,), (direction,))[1])
    for slope in (reverse, along(given, direction)):
        assert float(slope) == pytest.approx(float(difference), rel=1e-5, abs=1e-5)


NAN_CASES = {
    "nothing observed": lambda c: edit(c, valid=np.zeros_like(c.inputs.valid)),
    "NaN in empty slots": lambda c: edit(c, z=np.where(c.inputs.valid[..., None], c.inputs.z, np.nan)),
    "NaN in a filled slot": lambda c: edit(c, z=put(c.inputs.z, 5, np.nan), valid=put(c.inputs.valid, 5, True)),
    "NaN in a control": lambda c: edit(c, control=put(c.inputs.control, 2, np.nan)),
    "no step length": lambda c: edit(c, dt=put(c.inputs.dt, 2, 0.0)),
    "straight ahead": lambda c: edit(c, control=put(c.inputs.control, (slice(None), 1), 0.0)),
    "anonymous": lambda c: edit(c, landmark=np.full_like(c.inputs.landmark, -1)),
    "landmark beyond the table": lambda c: edit(c, landmark=put(c.inputs.landmark, 5, 77)),
    "landmark on the sensor": lambda c: edit(c, control=np.zeros_like(c.inputs.control))._replace(
        landmarks=put(c.landmarks, 2, c.prior.mean[:2])
    ),
    "all landmarks on the sensor, anonymous": lambda c: edit(
        c, control=np.zeros_like(c.inputs.control), landmark=np.full_like(c.inputs.landmark, -1)
    )._replace(landmarks=np.tile(c.prior.mean[:2], (4, 1))),
}


@pytest.mark.parametrize("case", NAN_CASES)
def test_gradients_are_numbers_when(case, six):
    _, gradients = slopes(*of_slopes(NAN_CASES[case](six)))
    for gradient in jax.tree.leaves(gradients):
        assert np.all(np.isfinite(gradient))


def test_gradient_of_the_map_by_the_pose_is_zero(course):
    config = course.config(mapping=True)

    @jax.jit
    @jax.value_and_grad
    def score(poses):
        after = map_scans(
            course.params,
            jnp.zeros(course.grid.shape),
            poses,
            course.inputs.ranges[:2],
            beam_angles=course.beam_angles,
            config=config,
        )
        return jnp.sum(after**2)

    value, slope = score(np.tile(course.prior.mean, (2, 1)))
    assert float(value) > 0
    np.testing.assert_array_equal(slope, np.zeros((2, 3)))


# --- inputs that do not fit: every message names the field, what came and what was expected

SCANNING = Config(grid=GridSpec(origin=(0.0, 0.0), resolution=0.5, shape=(8, 8)))


def refused(course, error, message, *, config=SCANNING, params=None, **fields):
    """Assert that a run of 3 steps with other inputs is refused with that message."""
    inputs = jax.tree.map(lambda x: x[:3], course.inputs)
    arguments = {"landmarks": course.landmarks, "beam_angles": course.beam_angles}
    for name in arguments.keys() & fields.keys():
        arguments[name] = fields.pop(name)

    def start_and_run():
        state = init(course.prior, config=config)
        run(params or course.params, state, inputs._replace(**fields), config=config, **arguments)

    with pytest.raises(error, match=message):
        start_and_run()


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("dt", np.zeros(()), r"inputs\.dt: expected shape \(any\), got \(\)"),
        ("dt", np.zeros((3, 1)), r"inputs\.dt: expected shape \(any\), got \(3, 1\)"),
        ("dt", np.zeros(4), r"inputs\.control: expected 4 steps as inputs\.dt has, got \(3, 2\)"),
        ("control", np.zeros((3, 3)), r"inputs\.control: expected shape \(2\), got \(3,\)"),
        ("control", np.zeros((4, 2)), r"inputs\.control: expected 3 steps as inputs\.dt has, got \(4, 2\)"),
        ("control", np.zeros(()), r"inputs\.control: expected 3 steps as inputs\.dt has, got \(\)"),
        ("landmark", np.zeros((3, 5), np.int32), r"inputs\.landmark: expected shape \(4\), got \(5,\)"),
        ("landmark", np.zeros((2, 4), np.int32), r"inputs\.landmark: expected 3 steps as inputs\.dt has, got \(2, 4\)"),
        ("z", np.zeros((3, 4, 3)), r"inputs\.z: expected shape \(4, 2\), got \(4, 3\)"),
        ("z", np.zeros((3, 5, 2)), r"inputs\.z: expected shape \(4, 2\), got \(5, 2\)"),
        ("z", np.zeros((1, 4, 2)), r"inputs\.z: expected 3 steps as inputs\.dt has, got \(1, 4, 2\)"),
        ("valid", np.zeros((3, 4, 1), bool), r"inputs\.valid: expected shape \(any\), got \(4, 1\)"),
        ("valid", np.zeros((5, 4), bool), r"inputs\.valid: expected 3 steps as inputs\.dt has, got \(5, 4\)"),
        ("ranges", np.zeros((3, 7)), r"inputs\.ranges: expected shape \(61\), got \(7,\)"),
        ("ranges", np.zeros((2, 61)), r"inputs\.ranges: expected 3 steps as inputs\.dt has, got \(2, 61\)"),
        ("landmarks", np.zeros((4, 3)), r"landmarks: expected shape \(any, 2\), got \(4, 3\)"),
        ("landmarks", np.zeros((0, 2)), r"landmarks: expected at least one"),
        ("landmarks", None, r"landmarks: expected \(L, 2\) for the 4 observation slots, got None"),
        ("beam_angles", np.zeros((61, 1)), r"beam_angles: expected shape \(any\), got \(61, 1\)"),
        ("beam_angles", None, r"beam_angles: expected \(B,\) for the ranges to map or to match, got None"),
    ],
)
def test_a_shape_that_does_not_fit_is_refused(field, value, message, course):
    refused(course, ValueError, message, **{field: value})


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("dt", np.ones(3, np.int32), r"inputs\.dt: expected dtype floating, got int32"),
        ("control", np.ones((3, 2), np.int32), r"inputs\.control: expected dtype floating, got int32"),
        ("landmark", np.zeros((3, 4), np.float32), r"inputs\.landmark: expected dtype integer, got float32"),
        ("z", np.zeros((3, 4, 2), np.int32), r"inputs\.z: expected dtype floating, got int32"),
        ("valid", np.ones((3, 4), np.int32), r"inputs\.valid: expected dtype bool_?, got int32"),
        ("ranges", np.ones((3, 61), np.int32), r"inputs\.ranges: expected dtype floating, got int32"),
        ("landmarks", np.ones((4, 2), np.int32), r"landmarks: expected dtype floating, got int32"),
        ("beam_angles", np.ones(61, np.int32), r"beam_angles: expected dtype floating, got int32"),
    ],
)
def test_a_dtype_of_another_kind_is_refused(field, value, message, course):
    refused(course, TypeError, message, **{field: value})


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("Q", np.diag([1.0, -1.0]), r"Q: expected a positive definite matrix, got eigenvalues \[-1\.0, 1\.0\]"),
        ("R", np.zeros((2, 2)), r"R: expected a positive definite matrix"),
        ("R", np.array([[1.0, 0.5], [0.2, 1.0]]), r"R: expected a symmetric matrix, got"),
        ("Q", np.full((2, 2), np.nan), r"Q: expected finite entries, got"),
        ("Q", np.eye(3), r"Q: expected shape \(2, 2\), got \(3, 3\)"),
        ("l_occ", np.array(-0.1), r"l_occ: expected a finite value > 0 nats, got -0\.1"),
        ("l_free", np.array(0.0), r"l_free: expected a finite value < 0 nats, got 0\.0"),
        ("l_free", np.array(np.nan), r"l_free: expected a finite value < 0 nats, got nan"),
        ("l_occ", np.ones(2), r"l_occ: expected shape \(\), got \(2,\)"),
    ],
)
def test_parameters_that_cannot_be_are_refused(field, value, message, course):
    refused(course, ValueError, message, params=course.params._replace(**{field: jnp.array(value)}))


def test_an_unknown_motion_model_is_refused(course):
    refused(course, ValueError, r"motion: expected one of .*'arc'.* got 'bicycle'", config=Config(motion="bicycle"))


def test_parameters_that_are_traced_are_not_looked_at(short, config):
    wrong = jax.tree.map(lambda x: x * 0, short.params)
    _, info = localise(short._replace(params=wrong), config)
    assert info.ok.shape == (STEPS,)


@pytest.mark.parametrize(
    ("field", "value", "error", "message"),
    [
        ("mean", np.zeros(2), ValueError, r"prior\.mean: expected shape \(3\), got \(2,\)"),
        ("mean", np.zeros(3, np.int32), TypeError, r"prior\.mean: expected dtype floating, got int32"),
        ("cov", np.eye(2), ValueError, r"prior\.cov: expected shape \(3, 3\), got \(2, 2\)"),
        ("cov", -np.eye(3), ValueError, r"prior\.cov: expected a positive semi-definite matrix, got eigenvalues"),
        ("cov", np.full((3, 3), np.nan), ValueError, r"prior\.cov: expected finite entries, got"),
        ("cov", np.triu(np.ones((3, 3))), ValueError, r"prior\.cov: expected a symmetric matrix, got"),
    ],
)
def test_a_prior_that_cannot_be_is_refused(field, value, error, message, course):
    with pytest.raises(error, match=message):
        init(course.prior._replace(**{field: value}), config=Config())


def test_in_float32_a_heading_is_known_no_less_than_not_at_all(course):
    def start(variance, dtype):
        prior = Gaussian(jnp.zeros(3, dtype), jnp.diag(jnp.array([1e4, 1e4, variance], dtype)))
        return init(prior, config=Config())

    start(np.pi**2 / 3 * 0.999, jnp.float32)
    with pytest.raises(ValueError, match=r"prior\.cov: expected a heading variance up to 3.29 rad².*got 1e\+04"):
        start(1e4, jnp.float32)
    if jax.config.jax_enable_x64:
        start(1e4, jnp.float64)


def test_a_prior_without_uncertainty_is_fine(course):
    state = init(course.prior._replace(cov=np.zeros((3, 3))), config=Config())
    assert state.log_odds is None


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("state.belief.mean", lambda s: s._replace(belief=s.belief._replace(mean=jnp.zeros((5, 3))))),
        ("state.belief.cov", lambda s: s._replace(belief=s.belief._replace(cov=jnp.zeros((5, 3, 3))))),
        ("state.log_likelihood", lambda s: s._replace(log_likelihood=jnp.zeros(5))),
    ],
)
def test_a_state_of_many_runs_is_refused(name, change, course):
    state = change(init(course.prior, config=Config()))
    now = lane(course.inputs, 0)
    with pytest.raises(ValueError, match=rf"^{name}: expected shape .*, got \(5"):
        step(course.params, state, now, landmarks=course.landmarks, config=Config())


@pytest.mark.parametrize("name", ["control", "dt", "z", "landmark", "row", "usable", "mean", "cov"])
def test_what_a_step_is_made_of_refuses_a_batch_by_name(name, course):
    shapes = {"control": (2,), "dt": (), "z": (2,), "landmark": (2,), "row": (), "usable": (), "mean": (3,)}
    shapes["cov"] = (3, 3)
    parts = (
        lambda of: predict(course.params, of("mean", "cov"), of("control"), of("dt"), config=Config()),
        lambda of: correct(
            course.params, of("mean", "cov"), of("z"), of("landmark"), of("row"), of("usable") > 0, config=Config()
        ),
        lambda of: is_valid(of("mean", "cov")),
    )
    uses = ({"control", "dt", "mean", "cov"}, {"z", "landmark", "row", "usable", "mean", "cov"}, {"mean", "cov"})
    for wrong in ((5, *shapes[name]), (1,)):

        def of(*names, wrong=wrong):
            arrays = [jnp.ones(wrong if key == name else shapes[key]) for key in names]
            return Gaussian(*arrays) if len(arrays) == 2 else arrays[0]

        for part, used in zip(parts, uses, strict=True):
            if name in used:
                with pytest.raises(ValueError, match=rf"^{name}: expected shape .*, got {re.escape(str(wrong))}$"):
                    part(of)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"config": Config()}, r"config\.grid: expected .*GridSpec.*, got None"),
        ({"log_odds": np.zeros((8, 9))}, r"log_odds: expected shape \(8, 8\), got \(8, 9\)"),
        ({"poses": np.zeros((3, 2))}, r"poses: expected shape \(any, 3\), got \(3, 2\)"),
        ({"ranges": np.zeros((2, 5))}, r"ranges: expected shape \(3, 5\), got \(2, 5\)"),
        ({"beam_angles": np.zeros(6)}, r"ranges: expected shape \(3, 6\), got \(3, 5\)"),
    ],
)
def test_mapping_refuses_what_does_not_fit(change, message, course):
    arguments = {
        "log_odds": np.zeros((8, 8)),
        "poses": np.zeros((3, 3)),
        "ranges": np.zeros((3, 5)),
        "beam_angles": np.zeros(5),
        "config": SCANNING,
    } | change
    with pytest.raises(ValueError, match=message):
        map_scans(course.params, **arguments)
