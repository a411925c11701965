"""Studies of filters of known honesty; a run's totals against simulate, run and NumPy; runs that go wrong."""

import dataclasses
import functools
import itertools
import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import scipy.stats
from drives import SHORT, like
from jax.sharding import Mesh, PartitionSpec

from jaxlocmap import Params, init, run, sensors, simulation
from jaxlocmap._internal import batching
from jaxlocmap.consistency import COVERAGE_LEVELS
from jaxlocmap.consistency.scoring import NEES_EDGES, PHASES, Averages, Undiverged
from jaxlocmap.consistency.study import (
    MapTotals,
    RandomBuildings,
    Study,
    Totals,
    median_nees,
    pose_means,
    reference_study,
    summarise,
)
from jaxlocmap.monte_carlo import monte_carlo
from jaxlocmap.simulation import CAPSTONE, LOOP, Noise

# What the plant really does, seen by a first-order filter: the heading noise of a step is a yaw rate's as well.
PLANT = {"v": 0.02, "w": math.hypot(0.01, 0.005 / 0.1), "range": 0.08, "bearing": 0.02}
# A detector with a reach picks the short readings near its edge, and a gate throws out honest readings; without
# either, what is left of the loop is a filter that is right but for its linearisation.
HONEST = like(LOOP, name="honest", detector=dict(max_range=1e3))
HONEST_CONFIG = HONEST.config(motion="euler", gate_probability=None, grid=False)
PLAIN = {"xla_backend_optimization_level": 0}  # compiles in two thirds of the time, to slower programs
ERRORS = 4  # standard errors a statistic may be off: a right program misses one in 16,000
FAULTS = ("none", "control", "bearing", "range", "heading", "scan", "Q", "R", "blind", "off_map", "wild")


def sums(runs):
    return jax.tree.map(lambda x: np.sum(np.asarray(x), axis=0, dtype=np.float64), runs)


def copies(count, *trees):
    """What every run is given, as NumPy arrays that may be changed run by run."""
    return jax.tree.map(lambda x: np.array([x] * count, np.asarray(jnp.array(x)).dtype), trees)


def by_run(scenario, config, params, runs, *, world=None):
    """Every run's own totals."""
    world, prior = simulation.room() if world is None else world, scenario.prior()
    arguments = (jax.random.key(0), runs, params, world, Noise(), prior)
    return monte_carlo(Study(scenario, config), *arguments, chunk=125, keep_runs=True).value


@functools.partial(jax.jit, static_argnames=("scenario", "config"), compiler_options=PLAIN)
def studied(keys, *args, scenario, config):
    """The same of given keys; every argument is batched."""
    return jax.vmap(Study(scenario, config))(keys, *args)


def keys_of(runs):
    """The keys of the first runs of `by_run`."""
    return jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(0), jnp.arange(runs))


def out_of_sight(world):
    return world._replace(landmarks=world.landmarks + 1e6)


def standard_error(values):
    """Of the mean of one value per run."""
    return scipy.stats.sem(np.asarray(values, np.float64))


# --- A filter that is consistent, and the same with a covariance wrong by a known factor ---


@pytest.fixture(scope="module")
def honest():
    """By scale of Q and R: every run's totals and the report of 500 runs, or of 125 where a factor of 4 is to be seen
    to 5 %: the ANEES of so many is known to 1.4 %.
    """
    plant = Params.from_std(**PLANT)
    results = {}
    for scale, count in ((1.0, 500), (4.0, 125), (0.25, 125)):
        params = plant._replace(Q=scale * plant.Q, R=scale * plant.R)
        runs = by_run(HONEST, HONEST_CONFIG, params, count)
        results[scale] = runs, summarise(sums(runs), HONEST_CONFIG)
    return results


def test_the_statistics_of_a_consistent_filter_are_the_expected_ones(honest):
    runs, report = honest[1.0]
    # The linearisation's own part, measured with 4,000 runs: ANEES 3.005 ± 0.008, NIS 2.0001 ± 0.0010.
    assert abs(report["anees"] - 3) < ERRORS * standard_error(runs.average.nees) + 0.02
    assert abs(report["nis_mean"] - 2) < ERRORS * standard_error(runs.run_nis[:, 0]) + 0.002
    for i, level in enumerate(COVERAGE_LEVELS):
        shares = runs.average.covered[:, i]
        assert report[f"coverage_{round(100 * level)}"] == pytest.approx(shares.mean())
        assert abs(shares.mean() - level) < ERRORS * standard_error(shares)
    for i, share in enumerate(report["within_two_sigma"].values()):
        shares = runs.average.within_two_sigma[:, i]
        assert share == pytest.approx(shares.mean())
        assert abs(share - scipy.stats.chi2.cdf(4, 1)) < ERRORS * standard_error(shares)
    # Steps of a run are correlated, so the share of them in their band spreads more than a binomial.
    assert report["nees_steps_in_band"] > 0.85
    assert (report["diverged_runs"], report["flagged_steps"], report["unscored_steps"]) == (0, 0, 0)


def test_the_innovations_of_a_consistent_filter_are_white(honest):
    report = honest[1.0][1]
    for name, lag in report["innovation_lag_one"].items():
        band = report["innovation_lag_one_band_95"][name]
        assert abs(lag) < ERRORS / 1.96 * band
        assert band < 0.004  # so a correlation of 0.01 would be seen


def test_the_bands_of_a_study_are_the_spread_between_its_runs(honest):
    runs, report = honest[1.0]
    for name, averages, expected in (("anees", runs.average.nees, 3), ("nis", runs.run_nis[:, 0], 2)):
        error = standard_error(averages)
        assert report[f"{name}_standard_error"] == pytest.approx(error, rel=1e-4)
        band = scipy.stats.t.interval(0.95, len(averages) - 1, loc=expected, scale=error)
        assert report[f"{name}_band_95"] == pytest.approx(band, rel=1e-4)
    # Far wider than if every step counted as a sample of its own.
    assert report["anees_standard_error"] > 3 * math.sqrt(6 / (len(averages) * HONEST.steps))


def test_a_drawn_prior_is_honest_before_anything_is_observed(honest):
    del honest  # which has compiled this
    world = simulation.room()
    runs = by_run(HONEST, HONEST_CONFIG, Params.from_std(**PLANT), 125, world=out_of_sight(world))
    assert runs.observed.sum() == 0
    # The runs' NEES of the first step are independent χ² with 3 degrees.
    low, high = scipy.stats.chi2.ppf([1e-5, 1 - 1e-5], 3 * 125) / 125
    assert low < runs.nees[:, 0].mean() < high


@pytest.mark.parametrize(("scale", "words"), [(4.0, "too large"), (0.25, "too small")])
def test_a_covariance_wrong_by_a_factor_is_reported_with_that_factor(honest, scale, words):
    # Scaling Q and R alike leaves the gain of a filter that has forgotten its prior as it is and scales P and S.
    runs, report = honest[scale]
    assert abs(report["anees"] * scale - 3) < ERRORS * standard_error(runs.average.nees) * scale + 0.1
    assert abs(report["nis_mean"] * scale - 2) < ERRORS * standard_error(runs.run_nis[:, 0]) * scale + 0.02
    assert report["verdict"].startswith("under-confident" if scale > 1 else "over-confident")
    factor, low, high = map(
        float, re.search(rf"covariance ([\d.]+) \[([\d.]+), ([\d.]+)\] times {words}", report["verdict"]).groups()
    )
    assert factor == pytest.approx(4, rel=0.05)
    assert low < factor < high


# --- The course's drive with and without its mistakes ---


def course(runs, params):
    return keys_of(runs), *jax.tree.map(jnp.array, copies(runs, params, simulation.room(), Noise(), CAPSTONE.prior()))


@pytest.fixture(scope="module")
def capstones():
    """By motion and parameters: every run's totals and the report of 1000 runs."""
    results = {}
    for motion, name in (("capstone", "course"), ("euler", "course"), ("euler", "plant")):
        config = CAPSTONE.config(motion=motion, grid=False)
        params = simulation.course_params() if name == "course" else Params.from_std(**PLANT)
        runs = jax.tree.map(np.asarray, studied(*course(1000, params), scenario=CAPSTONE, config=config))
        results[motion, name] = runs, summarise(sums(runs), config)
    return results


@pytest.mark.parametrize(
    ("motion", "params", "anees"), [("capstone", "course", 2.51), ("euler", "course", 2.31), ("euler", "plant", 2.90)]
)
def test_the_anees_of_the_course_s_drive(capstones, motion, params, anees):
    runs, report = capstones[motion, params]
    assert abs(report["anees"] - anees) < ERRORS * standard_error(runs.average.nees)
    # The true start is the prior's mean, so the first steps, and with them the average, lie below 3 even for the
    # plant's own noise.
    assert report["nees_per_step"][0] < 2
    assert report["exact_start"]
    if params == "plant":  # the filter is right: what is off is the start's and the gate's
        assert report["verdict"].startswith("undecided")
        assert "exact start" in report["verdict"]
    else:
        assert report["verdict"].startswith("not consistent: error² over σ² of x")
        assert "times too" not in report["verdict"]  # no factor follows from such a study


def test_the_accuracy_of_the_course_s_drive(capstones):
    runs, report = capstones["capstone", "course"]
    x, y, yaw = runs.error_square
    squares = (x + y).mean(1)
    assert report["rmse_position_m"] == pytest.approx(math.sqrt(squares.mean()))
    assert abs(squares.mean() - 0.0308**2) < ERRORS * standard_error(squares)
    assert report["rmse_yaw_rad"] == pytest.approx(math.sqrt(yaw.mean()))


def test_the_course_s_gate_is_too_loose_for_its_wide_R_and_right_for_the_plant_s(capstones):
    report = capstones["capstone", "course"][1]
    assert report["gate_accept_rate"] > 0.999
    assert report["gate_verdict"].startswith("too loose")
    assert report["nis_mean"] < 1
    report = capstones["euler", "plant"][1]
    # Observations of one run hardly depend on each other: binomial.
    error = math.sqrt(0.99 * 0.01 / report["observations"])
    assert abs(report["gate_accept_rate"] - 0.99) < ERRORS * error
    assert report["gate_verdict"].startswith("the gate rejected")


def test_map_scores_are_there_only_with_a_grid(capstones, faulty):
    assert "map" not in capstones["capstone", "course"][1]
    assert "map" in faulty_report(faulty)


# --- A run is simulate, run and a score, all in one ---


SHORT_CONFIG = SHORT.config(motion="euler")
# Observations that can be false, a sensor off the robot's centre, another period, and a gate that is a value.
LIED = like(
    LOOP,
    name="lied",
    steps=40,
    detector=dict(period=3, outliers=True),
    robot=dict(dt=0.2, sensor_offset=(0.1, -0.05, 0.03)),
)
LIED_CONFIG = LIED.config(gate_probability=None, grid=False)


OVER_RUNS, DEVICES = PartitionSpec("runs"), Mesh(np.array(jax.devices()[:1]), ("runs",))
# Over runs on every device, without a wrapper: that the numbers are the same is in every comparison with this program.
short = jax.jit(
    jax.shard_map(jax.vmap(Study(SHORT, SHORT_CONFIG)), mesh=DEVICES, in_specs=OVER_RUNS, out_specs=OVER_RUNS),
    compiler_options=PLAIN,
)


def lied(key, params, world, noise, prior, gate):
    params = params._replace(gate_probability=gate)
    return studied(key, params, world, noise, prior, scenario=LIED, config=LIED_CONFIG)


def room():
    """The course's, its walls said over and over: as many as a building has, so that one program takes both."""
    here, walls = simulation.room(), len(simulation.building().segments)
    return here._replace(segments=np.resize(here.segments, (walls, 2, 2)))


def batch(faults):
    """What every run is given: the same but for its fault."""
    params, world, noise, prior = copies(len(faults), simulation.course_params(), room(), Noise(), SHORT.prior())
    no_number = {"control": noise.v, "Q": params.Q, "R": params.R}
    no_number |= {name: getattr(noise, name) for name in ("bearing", "range", "heading", "scan")}
    for i, fault in enumerate(faults):
        if fault in no_number:
            no_number[fault][i] = np.nan
        elif fault == "blind":
            world.landmarks[i] += 1e3
        elif fault == "off_map":
            prior.mean[i] -= 100
        elif fault == "wild":
            noise.v[i] = 4
    keys = jax.random.split(jax.random.key(0), len(faults))
    return keys, *jax.tree.map(jnp.array, (params, world, noise, prior))


@functools.partial(jax.jit, static_argnames=("scenario", "config"), compiler_options=PLAIN)
def played(*args, scenario, config):
    """By run: the truth, what was measured, what `run` reports, its map and the true one."""

    def one(key, params, world, noise, prior):
        start_key, key = jax.random.split(key)
        start = prior.mean if scenario.exact_prior else simulation.draw_state(start_key, prior)
        mapping = config.grid is not None
        truth, inputs = simulation.simulate(key, world, noise, start, scenario=scenario, scan=mapping)
        scene = {"landmarks": world.landmarks, "beam_angles": scenario.beam_angles(), "config": config}
        state, info = run(params, init(prior, config=config), inputs, **scene)
        true_map = simulation.occupancy(world, config.grid) if mapping else None
        return truth.pose, inputs, info, state.log_odds, true_map

    return jax.vmap(one)(*args)


def by_hand(args, scenario, config):
    """Every run's totals, from `simulate`, `run` and a score in NumPy."""
    double = jax.tree.map(
        lambda x: np.asarray(x, np.float64 if x.dtype.kind == "f" else x.dtype),
        played(*args, scenario=scenario, config=config),
    )
    runs = []
    for i in range(len(args[0])):
        truth, inputs, info, log_odds, true_map = jax.tree.map(lambda x, i=i: x[i], double)
        report = {"mean": info.belief.mean, "cov": info.belief.cov, "innovation": info.innovation, "S": info.S}
        of_map = None if log_odds is None else map_score(log_odds, true_map)
        runs.append(
            score(truth, inputs.valid, config.gate_probability, info.ok, of_map, scenario.exact_prior, **report)
        )
    return runs


def score(truth, valid, gate, ok, of_map, exact_start=True, *, mean, cov, innovation, S, **_):
    """The totals of one run, in plain loops."""
    error = truth - mean
    error[:, 2] = reference.wrap(error[:, 2])
    nees = np.array([reference.nees(e, P) for e, P in zip(error, cov, strict=True)])
    scored = np.isfinite(nees) & (nees >= 0)
    nees[~scored] = 0
    square, variance = (np.where(scored[:, None], x, 0) for x in (error**2, np.diagonal(cov, axis1=1, axis2=2)))
    axis = np.divide(square, variance, out=np.zeros_like(square), where=variance > 0)
    lost = np.any((square[:, 0] + square[:, 1] > 1) & (nees > scipy.stats.chi2.ppf(1 - 1e-6, 3)))
    ended = np.all(np.isfinite(error[-1])) and np.all(np.isfinite(np.diagonal(cov[-1])))

    observed, nis, accepted = np.zeros(len(truth)), np.zeros(len(truth)), np.zeros(len(truth))
    products, squares, pairs, unscored, latest = np.zeros(2), np.zeros(2), 0, 0, {}
    threshold = math.inf if gate is None else scipy.stats.chi2.ppf(gate, 2)
    for k, j in np.argwhere(valid):
        if not (np.all(np.isfinite(S[k, j])) and np.all(np.isfinite(innovation[k, j])) and S[k, j].any()):
            unscored += 1
            continue
        white = np.linalg.solve(np.linalg.cholesky(S[k, j]), innovation[k, j])
        observed[k] += 1
        nis[k] += white @ white
        accepted[k] += white @ white < threshold
        if j in latest:
            products += white * latest[j]
            squares += white**2 + latest[j] ** 2
            pairs += 1
        latest[j] = white
    count = max(scored.sum(), 1)
    average = Averages(
        nees=nees.sum() / count,
        within_two_sigma=(scored[:, None] & (square <= 4 * variance)).sum(0) / count,
        covered=np.array([(scored & (nees < scipy.stats.chi2.ppf(level, 3))).sum() for level in COVERAGE_LEVELS])
        / count,
    )
    parts = [slice(-(-i * len(nees) // PHASES), -(-(i + 1) * len(nees) // PHASES)) for i in range(PHASES)]
    whole = scored.all()
    run_nis, kept = nis.sum() / max(observed.sum(), 1), scored.any() and ended and not lost
    undiverged = Undiverged(
        nees=kept * average.nees,
        axis_nees=kept * axis.sum(0) / count,
        phase_nees=kept * whole * np.array([nees[part].mean() for part in parts]),
    )
    lag = 2 * products / squares if pairs else np.zeros(2)
    bins = np.zeros(len(NEES_EDGES) + 1)
    bins[np.searchsorted(NEES_EDGES, average.nees, side="right")] += scored.any()
    return Totals(
        runs=1,
        exact_starts=exact_start,
        scored_runs=scored.any(),
        scored=scored,
        nees=nees,
        error_square=tuple(square.T),
        variance=tuple(variance.T),
        average=average,
        average_square=jax.tree.map(np.square, average),
        undiverged_runs=kept,
        whole_runs=kept * whole,
        undiverged=undiverged,
        undiverged_square=jax.tree.map(np.square, undiverged),
        nees_bins=bins,
        run_nis=np.array([run_nis, run_nis**2]),
        observing_runs=observed.any(),
        observed=observed,
        unscored_observations=unscored,
        nis=nis,
        accepted=accepted,
        lag_one=np.stack([lag, lag**2]),
        lag_runs=pairs > 0,
        lag_pairs=pairs,
        flagged_steps=np.sum(~ok),
        diverged=lost or not ended,
        map=of_map,
    )


def map_score(log_odds, occupied):
    p, seen = reference.probability(log_odds), log_odds != 0
    bins = np.minimum((p[seen] * 10).astype(int), 9)
    cells, probability, share = (np.bincount(bins, weights, 10) for weights in (None, p[seen], occupied[seen]))
    return MapTotals(
        entropy_bits=-np.sum(p * np.log2(p) + (1 - p) * np.log2(1 - p)),
        brier=np.mean((p - occupied)[seen] ** 2) if seen.any() else 0,
        scored=seen.any(),
        cells=cells,
        probability=probability,
        occupied=share,
    )


def of_run(runs, i):
    return jax.tree.map(lambda x: np.asarray(x)[i], runs)


def assert_same(got, expected, rtol, atol, run=""):
    def same(path, value, wanted):
        name = f"run {run}{jax.tree_util.keystr(path)}"
        np.testing.assert_allclose(value, np.asarray(wanted, float), rtol=rtol, atol=atol, err_msg=name)

    jax.tree_util.tree_map_with_path(same, got, expected)


@pytest.fixture(scope="module")
def faulty():
    """The totals of one run per fault."""
    return jax.tree.map(np.asarray, short(*batch(FAULTS)))


def lies(gates=(0.9, 0.9, 1.0, 1.0), outlier_rate=0.3):
    """What every run of the study with outliers is given, and its gate."""
    params, noise = Params.from_std(**PLANT), Noise(outlier_rate=outlier_rate)
    args = copies(len(gates), params, simulation.room(), noise, LIED.prior())
    keys = jax.random.split(jax.random.key(1), len(gates))
    return keys, *jax.tree.map(jnp.array, args), jnp.array(gates)


def test_runs_under_shard_map_that_go_wrong_and_one_that_does_not_are_simulate_run_and_numpy(faulty, tolerance):
    """The course's drive with a map, behind a gate."""
    expected = by_hand(batch(FAULTS), SHORT, SHORT_CONFIG)
    for i, fault in enumerate(FAULTS):
        # float32: a map of a few hundred cells, and a NEES whose covariance has lost digits
        assert_same(of_run(faulty, i), expected[i], tolerance(1e-10, 1e-2), tolerance(1e-12, 1e-4), fault)
    assert sum(run.unscored_observations for run in expected) > 0
    assert sum(run.flagged_steps for run in expected) > SHORT.steps


def test_added_up_step_by_step_a_study_is_the_sum_of_its_runs_each_in_a_random_building_of_its_own(tolerance):
    """Of those that are counted, whatever goes wrong in the others; in the building that a run's key draws."""
    counted = np.arange(len(FAULTS)) % 3 != 1
    add_up = jax.vmap(RandomBuildings(SHORT, SHORT_CONFIG).summed, out_axes=None, axis_name=batching.RUNS)
    keys, params, world, *rest = batch(FAULTS)
    got = jax.jit(add_up, compiler_options=PLAIN)(keys, jnp.array(counted), params, world, *rest)
    world_keys, keys = jax.vmap(jax.random.split, out_axes=1)(keys)
    drawn = jax.jit(jax.vmap(simulation.random_building))(world_keys)._replace(landmarks=world.landmarks)
    runs = jax.tree.map(np.asarray, short(keys, params, drawn, *rest))
    assert_same(got, sums(jax.tree.map(lambda x: x[counted], runs)), tolerance(1e-10, 1e-3), tolerance(1e-12, 1e-3))
    # A run off the map, or whose pose or scans are no numbers, has no map to score.
    assert len(np.unique(runs.map.brier[runs.map.brier > 0])) > len(FAULTS) / 2


def test_runs_of_the_whole_loop_are_simulate_run_and_numpy(honest, tolerance):
    """From a start drawn from the prior, without gate and map; two laps."""
    args = jax.tree.map(jnp.array, copies(3, Params.from_std(**PLANT), simulation.room(), Noise(), HONEST.prior()))
    for i, expected in enumerate(by_hand((keys_of(3), *args), HONEST, HONEST_CONFIG)):
        assert_same(of_run(honest[1.0][0], i), expected, tolerance(1e-10, 2e-2), tolerance(1e-11, 1e-3), i)


def test_runs_of_the_whole_course_are_simulate_run_and_numpy(capstones, tolerance):
    """Behind a gate, without a map."""
    config, runs = CAPSTONE.config(motion="capstone", grid=False), capstones["capstone", "course"][0]
    for i, expected in enumerate(by_hand(course(3, simulation.course_params()), CAPSTONE, config)):
        assert_same(of_run(runs, i), expected, tolerance(1e-10, 2e-2), tolerance(1e-11, 1e-3), i)


def test_a_gate_given_as_a_value_is_that_of_the_configuration(tolerance):
    """With outliers; and a gate of 1 is none."""
    *args, gates = lies()
    runs = jax.tree.map(np.asarray, lied(*args, gates))
    config = dataclasses.replace(LIED_CONFIG, gate_probability=0.9)
    for i, expected in enumerate(by_hand(args, LIED, config)[:2]):
        assert_same(of_run(runs, i), expected, tolerance(1e-10, 2e-2), tolerance(1e-12, 1e-3), i)
    assert np.all(runs.accepted[:2].sum(1) < runs.observed[:2].sum(1))
    assert np.all(runs.accepted[2:] == runs.observed[2:])


def behind(key, params, world, noise, prior, gate):
    """A run behind a gate that is a value."""
    return Study(LIED, LIED_CONFIG)(key, params._replace(gate_probability=gate), world, noise, prior)


def test_a_gate_may_be_an_array_that_is_not_traced():
    key, *args, gate = jax.tree.map(lambda x: x[0], lies())
    jax.eval_shape(lambda key: behind(key, *args, gate), key)


def test_observations_are_false_as_often_as_they_are_said_to_be():
    """False ones lie anywhere in reach, so the gate of a filter that is about right refuses nearly all of them."""
    none, some = (lied(*lies((0.9999,) * 4, outlier_rate)) for outlier_rate in (0.0, 0.3))
    assert none.accepted.sum() == none.observed.sum()
    refused, share = 1 - some.accepted.sum() / some.observed.sum(), 0.3
    assert abs(refused - share) < ERRORS * math.sqrt(share * (1 - share) / some.observed.sum()) + 0.02


def test_the_totals_of_a_run_are_the_reference_s(faulty, tolerance):
    """The same run by the filter and the map of the reference."""
    truth, inputs, *_ = jax.tree.map(
        lambda x: np.asarray(x[0], np.float64 if x.dtype.kind == "f" else x.dtype),
        played(*batch(FAULTS), scenario=SHORT, config=SHORT_CONFIG),
    )
    report = reference.run(
        np.array(SHORT.start),
        reference.COURSE_PRIOR_COV,
        inputs.dt,
        inputs.control,
        inputs.landmark,
        inputs.z,
        inputs.valid,
        reference.COURSE_LANDMARKS,
        reference.COURSE_Q,
        reference.COURSE_R,
        scipy.stats.chi2.ppf(0.99, 2),
        reference.euler,
        0.1,
    )
    log_odds = np.zeros(SHORT.robot.grid.shape)
    how = {**reference.COURSE_SCAN, "resolution": SHORT.robot.grid.resolution}
    for pose, ranges in zip(report["mean"], inputs.ranges, strict=True):
        log_odds = reference.update_scan(log_odds, pose, ranges, np.asarray(SHORT.beam_angles()), **how)
    occupied = np.asarray(jax.jit(simulation.occupancy, static_argnums=1)(simulation.room(), SHORT.robot.grid))
    ok = np.ones(SHORT.steps, bool)
    expected = score(truth, inputs.valid, 0.99, ok, map_score(log_odds, occupied), **report)
    assert expected.observed.sum() == 4 * SHORT.steps / SHORT.detector.period
    assert_same(of_run(faulty, 0), expected, tolerance(1e-9, 1e-2), tolerance(1e-12, 1e-4))


def test_no_value_compiles_a_study_again():
    args = lies()
    first, compiled = lied(*args), studied._cache_size()
    for i in range(len(args)):
        other = list(args)
        other[i] = jax.random.split(jax.random.key(2), 4) if i == 0 else jax.tree.map(lambda x: x * 0.9, args[i])
        assert not np.array_equal(lied(*other).nees, first.nees), f"argument {i}"
    assert studied._cache_size() == compiled


def loss(params, key, world, noise, prior):
    """A number that depends on every parameter, and the totals of the run."""
    totals = Study(SHORT, SHORT_CONFIG)(key, params, world, noise, prior)
    return totals.nees.mean() + totals.run_nis[0] + totals.map.entropy_bits / 100, totals


ALONE = jax.jit(jax.value_and_grad(loss, has_aux=True), compiler_options=PLAIN)


def alone(fault, params=None):
    """Loss and totals, and the slope of the loss, of one run on its own."""
    i = FAULTS.index(fault)
    key, own, *rest = jax.tree.map(lambda x: x[i], batch(FAULTS))
    params = own if params is None else jax.tree.map(lambda x: jnp.array(np.asarray(x)), params)  # no weak types
    return ALONE(params, key, *rest)


def test_a_run_alone_is_the_run_in_company(faulty, tolerance):
    for fault in ("none", "control", "off_map"):
        (_, totals), _ = alone(fault)
        got = of_run(faulty, FAULTS.index(fault))
        assert_same(got, totals, tolerance(1e-10, 1e-2), tolerance(1e-12, 1e-4), fault)


def test_the_slope_of_a_total_is_a_finite_difference(x64):
    del x64
    # Ten crossings by the course's -0.4 end exactly at a clamp, where there are two slopes.
    params = simulation.course_params()._replace(l_free=jnp.array(-0.37))
    _, slope = alone("none", params)
    leaves, structure = jax.tree.flatten(params)
    rng = np.random.default_rng(0)
    for i, leaf in enumerate(leaves):
        direction = rng.normal(size=leaf.shape) * np.abs(leaf) * 1e-5
        ends = [
            alone("none", jax.tree.unflatten(structure, [*leaves[:i], leaf + sign * direction, *leaves[i + 1 :]]))
            for sign in (1, -1)
        ]
        difference = (ends[0][0][0] - ends[1][0][0]) / 2
        assert np.sum(jax.tree.leaves(slope)[i] * direction) == pytest.approx(float(difference), rel=1e-5)


@pytest.mark.parametrize("fault", ["control", "bearing", "range", "scan", "blind", "off_map"])
def test_a_run_that_goes_wrong_has_a_slope_all_the_same(fault):
    (value, _), slope = alone(fault)
    assert math.isfinite(value)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(slope)), slope


@pytest.mark.parametrize("apart", range(6))
def test_shard_map_takes_any_argument_apart(apart):
    """That what differs between devices and what does not are kept apart is checked while tracing: of one run each."""

    def one(*args):
        own = (jax.tree.map(lambda x: x[0], x) if i == apart else x for i, x in enumerate(args))
        return jax.tree.map(lambda x: x[None], behind(*own))

    args = [x if i == apart else jax.tree.map(lambda x: x[0], x) for i, x in enumerate(lies((0.9,)))]
    specs = tuple(OVER_RUNS if i == apart else PartitionSpec() for i in range(6))
    jax.eval_shape(jax.shard_map(one, mesh=DEVICES, in_specs=specs, out_specs=OVER_RUNS), *args)


# --- Runs that go wrong ---


def of_fault(faulty, *faults):
    """The totals of some of the runs, summed."""
    return sums(jax.tree.map(lambda x: x[[FAULTS.index(fault) for fault in faults]], faulty))


def faulty_report(faulty, *faults):
    return summarise(of_fault(faulty, *(faults or FAULTS)), SHORT_CONFIG)


def test_a_run_does_not_feel_the_company_it_is_in(faulty):
    alone = jax.tree.map(np.asarray, short(*batch(("none",) * len(FAULTS))))
    jax.tree.map(np.testing.assert_array_equal, of_fault(alone, "none"), of_fault(faulty, "none"))


def test_a_control_that_is_no_number_flags_its_steps(faulty):
    report = faulty_report(faulty, "control")
    assert report["flagged_steps"] == SHORT.steps
    assert report["unscored_steps"] == 0  # the belief grew by Q, and can still be judged
    assert math.isfinite(report["anees"])


def test_a_reading_that_is_no_number_is_flagged_and_not_an_observation_of_distance_zero(faulty):
    report, healthy = faulty_report(faulty, "bearing"), faulty_report(faulty, "none")
    assert report["observations"] == 0
    assert report["unscored_observations"] == healthy["observations"]
    assert report["flagged_steps"] == SHORT.steps / SHORT.detector.period
    assert math.isnan(report["nis_mean"])
    both = faulty_report(faulty, "bearing", "none")
    assert both["nis_mean"] == healthy["nis_mean"]
    assert both["innovation_lag_one"] == healthy["innovation_lag_one"]


def test_a_belief_that_is_no_number_is_lost_unscored_and_not_an_error_of_zero(faulty):
    report, healthy = faulty_report(faulty, "Q"), faulty_report(faulty, "none")
    assert report["diverged_runs"] == 1
    assert report["unscored_steps"] == report["flagged_steps"] == SHORT.steps
    assert math.isnan(report["anees"])
    assert report["verdict"].startswith("not consistent: no NEES is finite; 1 of 1 runs diverged")
    both = faulty_report(faulty, "Q", "none")
    assert both["anees"] == healthy["anees"]
    assert both["nis_mean"] == healthy["nis_mean"]
    assert both["rmse_position_m"] == healthy["rmse_position_m"]
    assert "; 1 of 2 runs diverged, which a gate can bring about by itself" in both["verdict"]


def test_steps_without_a_score_have_no_mean(faulty):
    report = faulty_report(faulty, "Q")
    assert np.isnan(report["nees_per_step"]).all()
    assert np.isnan(report["rmse_per_step"]).all()
    assert math.isnan(report["nees_steps_in_band"])


def test_an_innovation_covariance_that_is_no_number_spoils_no_average(faulty):
    report, healthy = faulty_report(faulty, "R"), faulty_report(faulty, "none")
    assert report["unscored_observations"] == healthy["observations"]
    assert report["unscored_steps"] == 0  # dead reckoning
    assert faulty_report(faulty, "R", "none")["nis_mean"] == healthy["nis_mean"]


def test_a_run_that_observes_nothing_is_judged_by_its_pose_alone(faulty):
    report = faulty_report(faulty, "blind")
    assert report["observations"] == report["unscored_observations"] == 0
    assert math.isnan(report["nis_mean"])
    assert math.isnan(report["gate_accept_rate"])
    assert report["gate_verdict"] == "nothing observed: the gate was never asked"
    assert all(map(math.isnan, report["innovation_lag_one_band_95"].values()))
    assert report["nis_chi2_band_95"] == report["nis_per_step"] == [None] * SHORT.steps
    assert math.isfinite(report["anees"])


def test_a_run_that_maps_nothing_has_no_brier_score_and_spoils_none(faulty):
    report, healthy = faulty_report(faulty, "off_map"), faulty_report(faulty, "none")
    assert math.isnan(report["map"]["brier"])
    assert math.isnan(report["map"]["calibration_error"])
    assert report["map"]["entropy_bits"] == pytest.approx(400, rel=1e-5)  # one bit a cell
    both = faulty_report(faulty, "off_map", "none")
    assert both["map"]["brier"] == healthy["map"]["brier"]
    assert both["map"]["calibration_error"] == healthy["map"]["calibration_error"]


def test_runs_that_are_a_metre_off_and_exclude_it_at_any_step_are_lost():
    runs = jax.tree.map(np.asarray, short(*batch(("wild",) * len(FAULTS))))
    far = runs.error_square[0] + runs.error_square[1] > 1
    excluded = runs.nees > scipy.stats.chi2(3).ppf(1 - 1e-6)
    lost = np.any(far & excluded, axis=1)
    assert lost.sum() > 0
    assert np.any(lost & ~(far & excluded)[:, -1])  # found again at the end, and yet counted
    np.testing.assert_array_equal(runs.diverged, lost)
    report = summarise(sums(runs), SHORT_CONFIG)
    assert f"; {lost.sum()} of {len(FAULTS)} runs diverged" in report["verdict"]
    kept = runs.average.nees[~lost]
    expected = kept.mean() if len(kept) else math.nan
    assert report["anees_undiverged"] == pytest.approx(expected, nan_ok=True)


def test_a_run_that_is_far_off_and_says_so_is_not_lost():
    """Dead reckoning by a speedometer that is 30 m/s off, and known to be."""
    count = len(FAULTS)
    params, world = Params.from_std(**PLANT | {"v": 30.0}), out_of_sight(room())
    args = jax.tree.map(jnp.array, copies(count, params, world, Noise(v=30.0), SHORT.prior()))
    totals = [sums(short(jax.random.split(jax.random.key(seed), count), *args)) for seed in range(5)]
    report = summarise(sums(jax.tree.map(lambda *x: np.stack(x), *totals)), SHORT_CONFIG)
    assert report["runs"] == 5 * count
    assert report["rmse_position_m"] > 5
    assert report["diverged_runs"] == 0


def test_every_fault_is_counted_and_none_makes_the_study_no_number(faulty):
    report = faulty_report(faulty)
    assert report["runs"] == len(FAULTS)
    assert report["diverged_runs"] == faulty.diverged.sum() >= 2  # Q, heading, and the wild run if it ends far off
    assert report["unscored_steps"] == 2 * SHORT.steps  # Q, heading
    assert report["flagged_steps"] >= 2 * SHORT.steps + SHORT.steps / SHORT.detector.period
    for name in ("anees", "nis_mean", "gate_accept_rate", "rmse_position_m", "rmse_yaw_rad", "coverage_95"):
        assert math.isfinite(report[name]), name
    assert all(map(math.isfinite, report["innovation_lag_one"].values()))
    assert all(math.isfinite(report["map"][name]) for name in ("entropy_bits", "brier", "calibration_error"))
    assert f"of {len(FAULTS)} runs diverged" in report["verdict"]


def test_a_study_of_one_run_has_values_and_no_band(faulty):
    report = faulty_report(faulty, "none")
    assert math.isfinite(report["anees"])
    assert math.isnan(report["anees_standard_error"])
    assert report["anees_band_95"] == (-math.inf, math.inf)
    assert not report["verdict"].startswith("consistent")


# --- The report, from totals made by hand ---


def hand_made():
    """Two runs of two steps: NEES (3, 1) and (5, 3); the second step brings an observation each."""
    return Totals(
        runs=np.array(2.0),
        scored_runs=np.array(2.0),
        scored=np.array([2.0, 2.0]),
        nees=np.array([8.0, 4.0]),
        error_square=(np.array([0.02, 0.06]), np.array([0.03, 0.05]), np.array([0.2, 0.12])),
        variance=(np.array([0.08, 0.5]), np.array([0.02, 0.72]), np.array([0.5, 0.02])),
        exact_starts=np.array(0.0),
        average=Averages(np.array(6.0), np.array([2.0, 1.5, 1.0]), np.array([0.5, 1.0, 1.5, 2.0])),
        average_square=Averages(  # averages 2 and 4; shares 1 and 1, 0.5 and 1, 0.5 and 0.5; ...
            np.array(20.0), np.array([2.0, 1.25, 0.5]), np.array([0.25, 0.5, 1.25, 2.0])
        ),
        undiverged_runs=np.array(1.0),
        whole_runs=np.array(1.0),
        undiverged=Undiverged(np.array(2.0), np.array([0.5, 1.0, 1.5]), np.array([3.0, 0.0, 1.0, 0.0])),
        undiverged_square=Undiverged(np.array(4.0), np.array([0.25, 1.0, 2.25]), np.array([9.0, 0.0, 1.0, 0.0])),
        nees_bins=np.bincount(np.searchsorted(NEES_EDGES, [2.0, 4.0], "right"), minlength=len(NEES_EDGES) + 1),
        run_nis=np.array([5.0, 17.0]),  # averages 1 and 4
        observing_runs=np.array(2.0),
        observed=np.array([0.0, 2.0]),
        unscored_observations=np.array(3.0),
        nis=np.array([0.0, 5.0]),
        accepted=np.array([0.0, 1.0]),
        lag_one=np.array([[0.5, -1.0], [0.17, 0.58]]),  # 0.1 and 0.4, -0.3 and -0.7
        lag_runs=np.array(2.0),
        lag_pairs=np.array(16.0),
        flagged_steps=np.array(1.0),
        diverged=np.array(1.0),
        map=MapTotals(
            entropy_bits=np.array(90.0),
            brier=np.array(0.3),
            scored=np.array(2.0),
            cells=np.array([6.0, 0.0, 2.0]),
            probability=np.array([0.6, 0.0, 1.8]),
            occupied=np.array([1.0, 0.0, 1.0]),
        ),
    )


def test_a_report_of_totals_made_by_hand():
    report = summarise(hand_made(), SHORT_CONFIG)
    expected = {
        "runs": 2,
        "steps": 2,
        "anees": 3.0,
        "anees_standard_error": 1.0,
        "anees_undiverged": 2.0,
        "anees_reference": None,
        "exact_start": False,
        "nis_mean": 2.5,
        "nis_standard_error": 1.5,
        "nees_per_step": [4.0, 2.0],
        "nees_steps_in_band": 1.0,
        "nis_per_step": [None, 2.5],
        "axis_nees": {"x": 0.5, "y": 1.0, "yaw": 1.5},
        "within_two_sigma": {"x": 1.0, "y": 0.75, "yaw": 0.5},
        "coverage_50": 0.25,
        "coverage_90": 0.5,
        "coverage_95": 0.75,
        "coverage_99": 1.0,
        "rmse_position_m": 0.2,  # sqrt((0.02 + 0.06 + 0.03 + 0.05) / 4)
        "observations": 2,
        "observing_steps": 1,
        "unscored_observations": 3,
        "gate_accept_rate": 0.5,
        "gate_nominal_rate": 0.99,
        "innovation_lag_one": {"range": 0.25, "bearing": -0.5},
        "diverged_runs": 1,
        "unscored_steps": 0,
        "flagged_steps": 1,
    }
    for name, value in expected.items():
        assert report[name] == (pytest.approx(value) if isinstance(value, (int, float, dict)) else value), name
    assert report["rmse_yaw_rad"] == pytest.approx(math.sqrt(0.08))
    np.testing.assert_allclose(report["rmse_per_step"], np.sqrt([[0.01, 0.015, 0.1], [0.03, 0.025, 0.06]]))
    np.testing.assert_allclose(report["sigma_per_step"], [[0.2, 0.1, 0.5], [0.5, 0.6, 0.1]])
    # Student's t with one degree of freedom.
    assert report["anees_band_95"] == pytest.approx((3 - 12.706, 3 + 12.706), abs=1e-3)
    assert report["nees_band_95"] == pytest.approx(np.array(scipy.stats.chi2.interval(0.95, 6)) / 2)
    assert report["nis_chi2_band_95"][0] is None
    assert report["nis_chi2_band_95"][1] == pytest.approx(np.array(scipy.stats.chi2.interval(0.95, 4)) / 2)
    # One degree of freedom again; standard errors of two runs are half their distance.
    assert list(report["innovation_lag_one_band_95"].values()) == pytest.approx(
        12.7062 * np.array([0.15, 0.2]), abs=1e-4
    )
    assert report["within_two_sigma_interval_95"]["y"] == pytest.approx(
        (0.75 - 12.706 / 4, 0.75 + 12.706 / 4), abs=1e-3
    )
    assert report["axis_nees_interval_95"]["x"] == (-math.inf, math.inf)  # of the one run that has not diverged
    assert [phase["anees"] for phase in report["nees_phases"]] == [3.0, 0.0, 1.0, 0.0]
    assert 2.0 <= report["anees_median_run"] <= 2.0 * math.exp(0.05)  # the lower one of two
    assert "; 1 of 2 runs diverged" in report["verdict"]
    assert report["map"] == {
        "entropy_bits": 45.0,
        "brier": pytest.approx(0.15),
        "brier_base_rate": pytest.approx(0.25 * 0.75),
        "calibration_error": pytest.approx((0.4 + 0.8) / 8),
        "calibration_cells": [3.0, 0.0, 1.0],
        "calibration_probability": pytest.approx([0.1, 0.0, 0.9]),
        "calibration_frequency": pytest.approx([1 / 6, 0.0, 0.5]),
    }


def test_every_mean_over_runs_is_of_its_own_runs_with_their_spread():
    """Five runs, of which the last diverged and the one before has a step without a score."""
    rng = np.random.default_rng(0)

    def drawn(expected, *shape):
        return expected + 0.01 * rng.normal(size=(5, *shape))

    levels = np.array(COVERAGE_LEVELS)
    average = Averages(drawn(3), drawn(0.9545, 3), drawn(levels, len(levels)))
    kept = Undiverged(drawn(3), drawn(1, 3), drawn(3, PHASES))
    kept = jax.tree.map(lambda x: np.where((np.arange(5) < 4).reshape(-1, *[1] * (x.ndim - 1)), x, 0), kept)
    kept.phase_nees[3] = 0
    nis = drawn(2)

    def added(runs):
        return jax.tree.map(lambda x: np.sum(x, axis=0), runs), jax.tree.map(lambda x: np.sum(x**2, axis=0), runs)

    totals = hand_made()._replace(
        **dict(zip(("average", "average_square"), added(average), strict=True)),
        **dict(zip(("undiverged", "undiverged_square"), added(kept), strict=True)),
        **{name: np.array(float(n)) for name, n in {"runs": 5, "scored_runs": 5, "observing_runs": 3}.items()},
        **{name: np.array(float(n)) for name, n in {"undiverged_runs": 4, "whole_runs": 3}.items()},
        run_nis=np.array([nis[:3].sum(), (nis[:3] ** 2).sum()]),
    )
    means = pose_means(totals, SHORT_CONFIG)
    expected = [
        (means.nees, average.nees, 3),
        (means.undiverged_nees, kept.nees[:4], 3),
        *zip(means.axis_nees, kept.axis_nees[:4].T, [1] * 3, strict=True),
        *zip(means.within_two_sigma, average.within_two_sigma.T, [scipy.stats.chi2.cdf(4, 1)] * 3, strict=True),
        *zip(means.covered, average.covered.T, levels, strict=True),
        *zip(means.phases, kept.phase_nees[:3].T, [3] * PHASES, strict=True),
    ]
    report = summarise(totals, SHORT_CONFIG)
    for mean, values, centre in expected:
        error, reach = standard_error(values), scipy.stats.t.ppf(0.975, len(values) - 1)
        assert mean.value == pytest.approx(values.mean(), rel=1e-12)
        assert mean.standard_error == pytest.approx(error, rel=1e-6)
        assert mean.band_95 == pytest.approx((centre - reach * error, centre + reach * error), rel=1e-6)
        assert mean.interval_95 == pytest.approx((mean.value - reach * error, mean.value + reach * error), rel=1e-6)
    error, reach = standard_error(nis[:3]), scipy.stats.t.ppf(0.975, 2)
    assert report["nis_standard_error"] == pytest.approx(error, rel=1e-6)
    assert report["nis_band_95"] == pytest.approx((2 - reach * error, 2 + reach * error), rel=1e-6)
    assert report["anees_undiverged_interval_95"] == means.undiverged_nees.interval_95


def test_however_far_apart_shares_lie_their_band_is_that_of_independent_ones():
    """Of two runs of which one has every step inside an ellipsoid and one none: no more than p (1 - p) / 2."""
    half = hand_made().average._replace(covered=np.ones(4))
    totals = hand_made()._replace(average=half, average_square=half)
    reach = scipy.stats.t.ppf(0.975, 1)
    for mean, level in zip(pose_means(totals, SHORT_CONFIG).covered, COVERAGE_LEVELS, strict=True):
        most = reach * min(0.5, math.sqrt(level * (1 - level) / 2))
        assert mean.band_95 == pytest.approx((level - most, level + most), rel=1e-12)


@pytest.mark.parametrize(("steps", "edges"), [(8, [0, 2, 4, 6, 8]), (10, [0, 3, 5, 8, 10]), (4, [0, 1, 2, 3, 4])])
def test_the_phases_of_a_report_are_from_step_to_step_in_seconds(steps, edges):
    """Step k ends k + 1 periods after the start; a phase is from the end of its first step to that of its last."""
    totals = hand_made()._replace(nees=np.zeros(steps))
    spans = pose_means(totals, dataclasses.replace(SHORT_CONFIG, dt=0.5)).phase_spans
    np.testing.assert_allclose(spans, [(0.5 * (a + 1), 0.5 * b) for a, b in itertools.pairwise(edges)])
    np.testing.assert_array_equal(
        np.searchsorted(edges, np.arange(steps), "right") - 1, PHASES * np.arange(steps) // steps
    )


@pytest.mark.parametrize(("before", "inside", "share"), [(0, 1, 0.5), (1, 4, 0.375), (3, 3, 0.0), (0, 10, 0.5)])
def test_the_median_lies_in_its_bin_where_half_of_the_runs_are_below(before, inside, share):
    """So many runs in the bins before it, so many in it; on the logarithmic scale of its edges."""
    bins, i = np.zeros(len(NEES_EDGES) + 1), 60
    bins[i], bins[i - 5] = inside, before
    if before == inside:  # then the lower bin holds the median, up to its upper edge
        i, share = i - 5, 1.0
    expected = NEES_EDGES[i - 1] ** (1 - share) * NEES_EDGES[i] ** share
    assert median_nees(bins) == pytest.approx(expected, rel=1e-12)
    assert median_nees(np.eye(len(bins))[0]) == NEES_EDGES[0]


def test_the_bins_of_the_median_are_5_per_cent_apart_from_a_tenth_to_ten_thousand():
    assert NEES_EDGES[0] == pytest.approx(0.1)
    assert 1e4 / 1.06 < NEES_EDGES[-1] < 1e4
    np.testing.assert_allclose(np.diff(np.log(NEES_EDGES)), 0.05, rtol=1e-9)


def test_a_filter_that_is_told_the_truth_differs_in_nothing_else():
    config = dataclasses.replace(SHORT.config(motion="capstone", gate_probability=0.9), sensor_offset=(0.1, 0.2, 0.3))
    noise = Noise(heading=0.01, v=0.03, w=0.02, range=0.1, bearing=0.05)
    study, params = reference_study(SHORT, config, noise)
    assert study == Study(SHORT, dataclasses.replace(config, motion="euler", grid=None))
    jax.tree.map(np.testing.assert_array_equal, params, simulation.own_params(noise, SHORT))


def test_what_such_a_filter_shows_is_in_the_report():
    totals = hand_made()
    sharper = totals._replace(average=totals.average._replace(nees=np.array(5.0)))
    assert summarise(totals, SHORT_CONFIG, sharper)["anees_reference"] == 2.5
    assert summarise(totals, SHORT_CONFIG, sharper)["anees"] == 3.0


def test_runs_without_a_score_are_no_part_of_the_average():
    totals = hand_made()
    lost = totals._replace(runs=np.array(5.0), scored_runs=np.array(2.0), observing_runs=np.array(2.0))
    report = summarise(lost, SHORT_CONFIG)
    assert (report["runs"], report["anees"], report["nis_mean"]) == (5, 3.0, 2.5)
    assert report["gate_verdict"].startswith("the gate rejected 50 % [1.26, 98.7] of 2 observations")
    assert report["unscored_steps"] == 6


def test_the_median_of_the_runs_average_nees_is_numpy_s_to_a_bin():
    values = np.random.default_rng(0).gamma(3, 1, 501)
    bins = np.bincount(np.searchsorted(NEES_EDGES, values, "right"), minlength=len(NEES_EDGES) + 1)
    assert median_nees(bins) == pytest.approx(np.median(values), rel=0.05)
    assert math.isnan(median_nees(0 * bins))
    assert median_nees(np.eye(len(bins))[-1]) == math.inf


@pytest.mark.parametrize(
    ("name", "other", "own"),
    [
        ("dt", 0.2, "0.1"),
        ("sensor", sensors.RANGE_BEARING._replace(positive=()), "range_bearing"),
        ("sensor_offset", (0.1, 0.0, 0.0), "(0.0, 0.0, 0.0)"),
        ("scanner_offset", (0.1, 0.0, 0.0), "(0.0, 0.0, 0.0)"),
        ("min_range", 0.1, "0.05"),
        ("max_range", 7.0, "8.0"),
    ],
)
def test_a_study_of_a_filter_on_another_robot_is_refused(name, other, own):
    study = Study(SHORT, dataclasses.replace(SHORT_CONFIG, **{name: other}))
    args = simulation.course_params(), simulation.room(), Noise(), SHORT.prior()
    with pytest.raises(ValueError, match=re.escape(f"config.{name}: expected that of the scenario, {own}, got")):
        study(jax.random.key(0), *args)


def test_the_priors_dtype_wins_over_that_of_everything_else(x64):
    """As in `pipeline.run`."""
    prior = jax.tree.map(lambda x: x.astype(jnp.float32), SHORT.prior())
    args = (simulation.course_params(), simulation.room(), Noise(), prior)
    shapes = jax.eval_shape(Study(SHORT, SHORT_CONFIG), jax.random.key(0), *args)
    assert {leaf.dtype for leaf in jax.tree.leaves(shapes)} == {np.dtype(np.float32)}
