"""Studies of filters of known honesty, a run's totals against the reference, and runs that go wrong."""

import dataclasses
import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import scipy.stats

from jaxlocmap import GridSpec, Params, simulate
from jaxlocmap.consistency import COVERAGE_LEVELS
from jaxlocmap.monte_carlo import monte_carlo
from jaxlocmap.simulate import CAPSTONE, LOOP, Noise
from jaxlocmap.study import MapTotals, Study, Totals, summarise

# What the plant really does, seen by a first-order filter: the heading noise of a step is a yaw rate's as well.
PLANT = {"v": 0.02, "w": math.hypot(0.01, 0.005 / 0.1), "range": 0.08, "bearing": 0.02}
# A detector with a reach picks the short readings near its edge, and a gate throws out honest readings; without
# either, what is left of the loop is a filter that is right but for its linearisation.
HONEST = dataclasses.replace(LOOP, name="honest", sight_range=1e3)
SHORT = dataclasses.replace(
    CAPSTONE,
    name="short",
    start=(6.0, 8.5, 0.5),  # in sight of all four landmarks
    steps=12,
    beams=9,
    sight_period=2,
    grid=GridSpec(origin=(0.0, 0.0), resolution=0.6, shape=(20, 20)),
)
ERRORS = 4  # standard errors a statistic may be off: a right program misses one in 16,000
FAULTS = ("none", "control", "bearing", "Q", "R", "blind", "off_map", "wild")


def sums(runs):
    return jax.tree.map(lambda x: np.sum(x, axis=0, dtype=np.float64), runs)


def by_run(scenario, config, params, runs, *, seed=0):
    """A study's result with every run's own totals."""
    return monte_carlo(
        Study(scenario, config),
        jax.random.key(seed),
        runs,
        params,
        simulate.room(),
        Noise(),
        scenario.prior(),
        chunk=250,
        keep_runs=True,
    )


def standard_error(values):
    """Of the mean of one value per run."""
    return scipy.stats.sem(np.asarray(values, np.float64))


# --- A filter that is consistent, and the same with a covariance wrong by a known factor ---


@pytest.fixture(scope="module")
def honest():
    """By scale of Q and R: every run's totals and the report of 500 runs."""
    config = HONEST.config(motion="euler", gate_probability=None, grid=False)
    plant = Params.from_std(**PLANT)
    results = {}
    for scale in (1.0, 4.0, 0.25):
        params = plant._replace(Q=scale * plant.Q, R=scale * plant.R)
        runs = by_run(HONEST, config, params, 500).value
        results[scale] = runs, summarise(sums(runs), config)
    return results


def test_the_statistics_of_a_consistent_filter_are_the_expected_ones(honest):
    runs, report = honest[1.0]
    # The linearisation's own part, measured with 4,000 runs: ANEES 3.005 ± 0.008, NIS 2.0001 ± 0.0010.
    assert abs(report["anees"] - 3) < ERRORS * standard_error(runs.run_nees[:, 0]) + 0.02
    assert abs(report["nis_mean"] - 2) < ERRORS * standard_error(runs.run_nis[:, 0]) + 0.002
    for i, level in enumerate(COVERAGE_LEVELS):
        shares = runs.covered[:, i] / HONEST.steps
        assert report[f"coverage_{round(100 * level)}"] == pytest.approx(shares.mean())
        assert abs(shares.mean() - level) < ERRORS * standard_error(shares)
    for i, share in enumerate(report["within_two_sigma"].values()):
        shares = runs.within_two_sigma[:, i] / HONEST.steps
        assert share == pytest.approx(shares.mean())
        assert abs(share - scipy.stats.chi2.cdf(4, 1)) < ERRORS * standard_error(shares)
    # Steps of a run are correlated, so the share of them in their band spreads more than a binomial.
    assert report["nees_steps_in_band"] > 0.85
    assert (report["diverged_runs"], report["flagged_steps"], report["unscored_steps"]) == (0, 0, 0)


def test_the_innovations_of_a_consistent_filter_are_white(honest):
    report = honest[1.0][1]
    for lag in report["innovation_lag_one"].values():
        assert abs(lag) < ERRORS / 1.96 * report["innovation_lag_one_band_95"]
    assert report["innovation_lag_one_band_95"] < 0.004  # so a correlation of 0.01 would be seen


def test_the_bands_of_a_study_are_the_spread_between_its_runs(honest):
    runs, report = honest[1.0]
    for name, averages, expected in (("anees", runs.run_nees[:, 0], 3), ("nis", runs.run_nis[:, 0], 2)):
        error = standard_error(averages)
        assert report[f"{name}_standard_error"] == pytest.approx(error, rel=1e-4)
        band = scipy.stats.t.interval(0.95, len(averages) - 1, loc=expected, scale=error)
        assert report[f"{name}_band_95"] == pytest.approx(band, rel=1e-4)
    # Far wider than if every step counted as a sample of its own.
    assert report["anees_standard_error"] > 3 * math.sqrt(6 / (len(averages) * HONEST.steps))


def test_a_drawn_prior_is_honest_before_anything_is_observed():
    blind = dataclasses.replace(HONEST, name="blind", steps=1, sight_range=0.0)
    report = summarise(
        sums(by_run(blind, blind.config(motion="euler", grid=False), Params.from_std(**PLANT), 250).value),
        blind.config(grid=False),
    )
    assert report["observations"] == 0
    # One step: the runs' NEES are independent χ² with 3 degrees.
    low, high = scipy.stats.chi2.ppf([1e-5, 1 - 1e-5], 3 * 250) / 250
    assert low < report["anees"] < high


@pytest.mark.parametrize(("scale", "words"), [(4.0, "too large"), (0.25, "too small")])
def test_a_covariance_wrong_by_a_factor_is_reported_with_that_factor(honest, scale, words):
    # Scaling Q and R alike leaves the gain of a filter that has forgotten its prior as it is and scales P and S.
    runs, report = honest[scale]
    assert abs(report["anees"] * scale - 3) < ERRORS * standard_error(runs.run_nees[:, 0]) * scale + 0.1
    assert abs(report["nis_mean"] * scale - 2) < ERRORS * standard_error(runs.run_nis[:, 0]) * scale + 0.02
    assert report["verdict"].startswith("under-confident" if scale > 1 else "over-confident")
    factor = float(re.search(rf"covariance ([\d.]+) times {words}", report["verdict"])[1])
    assert factor == pytest.approx(4, rel=0.05)


# --- The course's drive with and without its mistakes ---


@pytest.fixture(scope="module")
def capstones():
    """By motion and parameters: every run's totals, the report of 1000 runs, and the seconds of compiling."""
    results = {}
    for motion, name in (("capstone", "course"), ("euler", "course"), ("euler", "plant")):
        config = CAPSTONE.config(motion=motion, grid=False)
        params = simulate.course_params() if name == "course" else Params.from_std(**PLANT)
        result = by_run(CAPSTONE, config, params, 1000)
        results[motion, name] = result.value, summarise(sums(result.value), config), result.compile_s
    return results


@pytest.mark.parametrize(
    ("motion", "params", "anees"), [("capstone", "course", 2.51), ("euler", "course", 2.31), ("euler", "plant", 2.90)]
)
def test_the_anees_of_the_course_s_drive(capstones, motion, params, anees):
    runs, report, _ = capstones[motion, params]
    assert abs(report["anees"] - anees) < ERRORS * standard_error(runs.run_nees[:, 0])
    # The true start is the prior's mean, so the first steps, and with them the average, lie below 3 even for the
    # plant's own noise.
    assert report["nees_per_step"][0] < 2
    assert report["verdict"].startswith("under-confident")


def test_the_accuracy_of_the_course_s_drive(capstones):
    runs, report, _ = capstones["capstone", "course"]
    squares = runs.error_square[..., :2].sum((1, 2)) / CAPSTONE.steps
    assert report["rmse_position_m"] == pytest.approx(math.sqrt(squares.mean()))
    assert abs(squares.mean() - 0.0308**2) < ERRORS * standard_error(squares)
    assert report["rmse_yaw_rad"] == pytest.approx(math.sqrt(np.mean(runs.error_square[..., 2])))


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


def test_other_parameters_need_no_other_program(capstones):
    assert capstones["euler", "course"][2] > 0
    assert capstones["euler", "plant"][2] == 0


def test_map_scores_are_there_only_with_a_grid(capstones, faulty):
    assert "map" not in capstones["capstone", "course"][1]
    assert "map" in faulty_report(faulty)


# --- One run against the reference, and runs that go wrong ---


SHORT_CONFIG = SHORT.config(motion="euler")
STUDY = jax.jit(jax.vmap(Study(SHORT, SHORT_CONFIG)))


def batch(faults):
    """What every run is given: the same but for its fault."""
    one = simulate.course_params(), simulate.room(), Noise(), SHORT.prior()
    params, world, noise, prior = jax.tree.map(
        lambda x: np.array([x] * len(faults), np.asarray(jnp.array(x)).dtype), one
    )
    for i, fault in enumerate(faults):
        if fault == "control":
            noise.v[i] = np.nan
        elif fault == "bearing":
            noise.bearing[i] = np.nan
        elif fault == "Q":
            params.Q[i] = np.nan
        elif fault == "R":
            params.R[i] = np.nan
        elif fault == "blind":
            world.landmarks[i] += 1e3
        elif fault == "off_map":
            prior.mean[i] -= 100
        elif fault == "wild":
            noise.v[i] = 4
    keys = jax.random.split(jax.random.key(0), len(faults))
    return keys, *jax.tree.map(jnp.array, (params, world, noise, prior))


@pytest.fixture(scope="module")
def faulty():
    """The totals of one run per fault."""
    return jax.tree.map(np.asarray, STUDY(*batch(FAULTS)))


def of_fault(faulty, *faults):
    """The totals of some of the runs, summed."""
    return sums(jax.tree.map(lambda x: x[[FAULTS.index(fault) for fault in faults]], faulty))


def faulty_report(faulty, *faults):
    return summarise(of_fault(faulty, *(faults or FAULTS)), SHORT_CONFIG)


def reference_totals(key):
    """The totals of a run without a fault, from the reference's filter and map."""
    assert SHORT.exact_prior
    key = jax.random.split(key)[1]  # the first is for the start
    truth, inputs = jax.jit(simulate.simulate, static_argnames="scenario")(
        key, simulate.room(), Noise(), SHORT.prior().mean, scenario=SHORT
    )
    truth, inputs = jax.tree.map(
        lambda x: np.asarray(x, np.float64 if x.dtype.kind == "f" else x.dtype), (truth, inputs)
    )
    run = reference.run(
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
    error = truth.pose - run["mean"]
    error[:, 2] = reference.wrap(error[:, 2])
    nees = np.array([reference.nees(e, P) for e, P in zip(error, run["cov"], strict=True)])
    variance = np.diagonal(run["cov"], axis1=1, axis2=2)
    white = np.zeros_like(run["innovation"])
    for k, j in np.argwhere(inputs.valid):
        white[k, j] = np.linalg.solve(np.linalg.cholesky(run["S"][k, j]), run["innovation"][k, j])
    products, squares, pairs = np.zeros(2), np.zeros(2), 0
    for j in range(inputs.valid.shape[1]):
        seen = white[inputs.valid[:, j], j]
        products += (seen[1:] * seen[:-1]).sum(0)
        squares += (seen[1:] ** 2).sum(0)
        pairs += len(seen) - 1
    return Totals(
        runs=1,
        scored_runs=1,
        scored=np.ones(SHORT.steps),
        nees=nees,
        error_square=error**2,
        variance=variance,
        axis_nees=(error**2 / variance).sum(0),
        within_two_sigma=(np.abs(error) <= 2 * np.sqrt(variance)).sum(0),
        covered=[(nees < scipy.stats.chi2.ppf(level, 3)).sum() for level in COVERAGE_LEVELS],
        run_nees=[nees.mean(), nees.mean() ** 2],
        run_nis=[run["nis"][inputs.valid].mean(), run["nis"][inputs.valid].mean() ** 2],
        observing_runs=1,
        observed=inputs.valid.sum(1),
        unscored_observations=0,
        nis=run["nis"].sum(1),
        accepted=run["accepted"].sum(1),
        lag_products=products,
        lag_squares=squares,
        lag_pairs=pairs,
        flagged_steps=0,
        diverged=0,
        map=reference_map_totals(run["mean"], inputs.ranges),
    )


def reference_map_totals(poses, scans):
    log_odds = np.zeros(SHORT.grid.shape)
    how = {**reference.COURSE_SCAN, "resolution": SHORT.grid.resolution}
    for pose, ranges in zip(poses, scans, strict=True):
        log_odds = reference.update_scan(log_odds, pose, ranges, np.asarray(SHORT.beam_angles()), **how)
    p = reference.probability(log_odds)
    seen = log_odds != 0
    occupied = np.asarray(jax.jit(simulate.occupancy, static_argnums=1)(simulate.room(), SHORT.grid))
    bins = np.minimum((p[seen] * 10).astype(int), 9)
    counted = [np.bincount(bins, weights, 10) for weights in (np.ones(seen.sum()), p[seen], occupied[seen])]
    return MapTotals(
        entropy_bits=-np.sum(p * np.log2(p) + (1 - p) * np.log2(1 - p)),
        brier=np.mean((p - occupied)[seen] ** 2),
        scored=1,
        cells=counted[0],
        probability=counted[1],
        occupied=counted[2],
    )


def test_the_totals_of_a_run_are_the_reference_s(faulty, tolerance):
    expected = reference_totals(jax.random.split(jax.random.key(0), len(FAULTS))[0])
    got = of_fault(faulty, "none")
    assert got.observed.sum() == 4 * SHORT.steps / SHORT.sight_period
    for name, value in got._replace(map=0)._asdict().items():
        wanted = expected._asdict()[name] if name != "map" else 0
        np.testing.assert_allclose(value, wanted, rtol=tolerance(1e-9, 1e-2), atol=tolerance(1e-12, 1e-4), err_msg=name)
    for name, value in got.map._asdict().items():
        wanted = getattr(expected.map, name)
        np.testing.assert_allclose(value, wanted, rtol=tolerance(1e-9, 1e-4), err_msg=name)


def test_a_run_does_not_feel_the_company_it_is_in(faulty):
    alone = jax.tree.map(np.asarray, STUDY(*batch(("none",) * len(FAULTS))))
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
    assert report["flagged_steps"] == SHORT.steps / SHORT.sight_period
    assert math.isnan(report["nis_mean"])
    both = faulty_report(faulty, "bearing", "none")
    assert both["nis_mean"] == healthy["nis_mean"]
    assert both["innovation_lag_one"] == healthy["innovation_lag_one"]


def test_a_belief_that_is_no_number_is_lost_unscored_and_not_an_error_of_zero(faulty):
    report, healthy = faulty_report(faulty, "Q"), faulty_report(faulty, "none")
    assert report["diverged_runs"] == 1
    assert report["unscored_steps"] == report["flagged_steps"] == SHORT.steps
    assert math.isnan(report["anees"])
    assert report["verdict"] == "not consistent: the NEES is not finite; 1 of 1 runs diverged"
    both = faulty_report(faulty, "Q", "none")
    assert both["anees"] == healthy["anees"]
    assert both["nis_mean"] == healthy["nis_mean"]
    assert both["rmse_position_m"] == healthy["rmse_position_m"]
    assert both["verdict"].endswith("; 1 of 2 runs diverged")


def test_steps_without_a_score_have_no_mean(faulty):
    report = faulty_report(faulty, "Q")
    assert np.isnan(report["nees_per_step"]).all()
    assert np.isnan(report["rmse_per_step"]).all()
    assert report["nees_steps_in_band"] == 0


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
    assert report["innovation_lag_one_band_95"] is None
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
    runs = jax.tree.map(np.asarray, STUDY(*batch(("wild",) * len(FAULTS))))
    far, excluded = runs.error_square[..., :2].sum(-1) > 1, runs.nees > scipy.stats.chi2(3).ppf(1 - 1e-6)
    lost = np.any(far & excluded, axis=1)
    assert lost.sum() > 0
    assert np.any(lost & ~(far & excluded)[:, -1])  # found again at the end, and yet counted
    np.testing.assert_array_equal(runs.diverged, lost)
    report = summarise(sums(runs), SHORT_CONFIG)
    assert report["verdict"].startswith("over-confident")
    assert report["verdict"].endswith(f"; {lost.sum()} of {len(FAULTS)} runs diverged")


def test_a_run_that_is_far_off_and_says_so_is_not_lost():
    """Dead reckoning by a speedometer that is 30 m/s off, and known to be."""
    blind = dataclasses.replace(SHORT, name="blind", sight_range=0.0)
    study = Study(blind, blind.config(motion="euler", grid=False))
    params = Params.from_std(**PLANT | {"v": 30.0})
    world, noise, prior = simulate.room(), Noise(v=30.0), blind.prior()
    report = summarise(monte_carlo(study, jax.random.key(0), 50, params, world, noise, prior).value, study.config)
    assert report["rmse_position_m"] > 5
    assert report["diverged_runs"] == 0


def test_every_fault_is_counted_and_none_makes_the_study_no_number(faulty):
    report = faulty_report(faulty)
    assert report["runs"] == len(FAULTS)
    assert report["diverged_runs"] == faulty.diverged.sum() >= 1  # Q, and the wild run where it ends far off
    assert report["unscored_steps"] == SHORT.steps  # Q
    assert report["flagged_steps"] >= 2 * SHORT.steps + SHORT.steps / SHORT.sight_period
    for name in ("anees", "nis_mean", "gate_accept_rate", "rmse_position_m", "rmse_yaw_rad", "coverage_95"):
        assert math.isfinite(report[name]), name
    assert all(map(math.isfinite, report["innovation_lag_one"].values()))
    assert all(math.isfinite(report["map"][name]) for name in ("entropy_bits", "brier", "calibration_error"))
    assert report["verdict"].endswith("of 8 runs diverged")


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
        error_square=np.array([[0.02, 0.03, 0.2], [0.06, 0.05, 0.12]]),
        variance=np.array([[0.08, 0.02, 0.5], [0.5, 0.72, 0.02]]),
        axis_nees=np.array([2.0, 4.0, 6.0]),
        within_two_sigma=np.array([4.0, 3.0, 2.0]),
        covered=np.array([1.0, 2.0, 3.0, 4.0]),
        run_nees=np.array([6.0, 20.0]),  # averages 2 and 4
        run_nis=np.array([5.0, 17.0]),  # averages 1 and 4
        observing_runs=np.array(2.0),
        observed=np.array([0.0, 2.0]),
        unscored_observations=np.array(3.0),
        nis=np.array([0.0, 5.0]),
        accepted=np.array([0.0, 1.0]),
        lag_products=np.array([1.0, -2.0]),
        lag_squares=np.array([4.0, 4.0]),
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
        "innovation_lag_one_band_95": 0.49,
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
    assert report["verdict"].endswith("; 1 of 2 runs diverged")
    assert report["map"] == {
        "entropy_bits": 45.0,
        "brier": pytest.approx(0.15),
        "calibration_error": pytest.approx((0.4 + 0.8) / 8),
        "calibration_cells": [3.0, 0.0, 1.0],
        "calibration_probability": pytest.approx([0.1, 0.0, 0.9]),
        "calibration_frequency": pytest.approx([1 / 6, 0.0, 0.5]),
    }


def test_runs_without_a_score_are_no_part_of_the_average():
    totals = hand_made()
    lost = totals._replace(runs=np.array(5.0), scored_runs=np.array(2.0), observing_runs=np.array(2.0))
    report = summarise(lost, SHORT_CONFIG)
    assert (report["runs"], report["anees"], report["nis_mean"]) == (5, 3.0, 2.5)
    assert report["unscored_steps"] == 6
