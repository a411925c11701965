"""Anybody's filter judged: arrays and files against a plain NumPy filter, and files with faults."""

import functools
import json
import math
from typing import NamedTuple

import numpy as np
import pytest
import reference
import scipy.stats
from programs import Recorder

from jaxlocmap.cli import judge as program
from jaxlocmap.consistency import COVERAGE_LEVELS, Innovations, judge
from jaxlocmap.logs import pair, read_innovations, read_trajectory, write_tum

RUNS, STEPS, DT = 50, 240, 0.1
R = np.diag([0.1**2, 0.03**2])
LANDMARKS = np.array([[6.0, 8.0], [-6.0, 5.0], [1.0, -7.0]])


class Drives(NamedTuple):
    """What a plain NumPy filter made of simulated drives."""

    truth: np.ndarray  # (N, T, 3)
    mean: np.ndarray
    cov: np.ndarray
    nu: np.ndarray  # (N, T, M, 2), NaN where nothing was observed
    S: np.ndarray


@functools.cache
def drives(runs=RUNS, steps=STEPS, seed=0, scale=1.0):
    """An EKF of the reference's formulas, every landmark seen at every third step; its covariance times a factor."""
    rng = np.random.default_rng(seed)
    Q, P0 = np.diag([0.1**2, 0.2**2]), np.diag([0.01, 0.01, 0.002])
    out = Drives(*(np.full((runs, steps, *shape), np.nan) for shape in ((3,), (3,), (3, 3), (3, 2), (3, 2, 2))))
    for n in range(runs):
        x, P = np.zeros(3), P0.copy()
        true = rng.multivariate_normal(x, P0)
        for k in range(steps):
            u = np.array([1.0, 0.3])
            true = reference.euler(true, u + rng.multivariate_normal(np.zeros(2), Q), DT)[0]
            x, P = reference.predict(x, P, u, DT, Q, reference.euler, DT)
            for j in range(3 if k % 3 == 0 else 0):
                z = reference.expected_observation(true, LANDMARKS[j])[0] + rng.multivariate_normal(np.zeros(2), R)
                x, P, out.nu[n, k, j], out.S[n, k, j], *_ = reference.correct(x, P, z, LANDMARKS[j], R, None)
            out.truth[n, k], out.mean[n, k], out.cov[n, k] = true, x, scale * P
    return out


def numpy_nees(made):
    error = made.truth - made.mean
    error[..., 2] = reference.wrap(error[..., 2])
    return np.array(
        [[reference.nees(*pair) for pair in zip(*run, strict=True)] for run in zip(error, made.cov, strict=True)]
    )


def numpy_nis(made):
    flat = zip(made.nu.reshape(-1, 2), made.S.reshape(-1, 2, 2), strict=True)
    values = [nu @ np.linalg.solve(S, nu) for nu, S in flat]
    return np.reshape(values, made.nu.shape[:-1])


def innovations(made):
    return Innovations(made.nu, made.S)


# --- Arrays ---


def test_the_report_of_many_runs_is_numpy_s():
    made = drives()
    report = judge(made.truth, made.mean, made.cov, time=DT * np.arange(STEPS), innovations=innovations(made))
    nees, nis = numpy_nees(made), numpy_nis(made)
    averages = nees.mean(1)
    assert report["anees"] == pytest.approx(averages.mean(), rel=1e-9)
    np.testing.assert_allclose(report["nees_per_step"], nees.mean(0), rtol=1e-9)
    band = scipy.stats.t.interval(0.95, RUNS - 1, loc=3, scale=scipy.stats.sem(averages))
    assert report["anees_band_95"] == pytest.approx(band, rel=1e-9)
    for level in COVERAGE_LEVELS:
        inside = nees < scipy.stats.chi2.ppf(level, 3)
        name = f"coverage_{round(100 * level)}"
        assert report[name] == pytest.approx(inside.mean(), rel=1e-9)
        shares = inside.mean(1)
        interval = scipy.stats.t.interval(0.95, RUNS - 1, loc=shares.mean(), scale=scipy.stats.sem(shares))
        assert report[f"{name}_interval_95"] == pytest.approx(interval, rel=1e-9)
    error = made.truth - made.mean
    error[..., 2] = reference.wrap(error[..., 2])
    ratio = error**2 / np.diagonal(made.cov, axis1=-2, axis2=-1)
    assert list(report["axis_nees"].values()) == pytest.approx(ratio.mean((0, 1)).tolist(), rel=1e-9)
    assert list(report["within_two_sigma"].values()) == pytest.approx((ratio <= 4).mean((0, 1)).tolist(), rel=1e-9)
    assert report["rmse_position_m"] == pytest.approx(np.sqrt((error[..., :2] ** 2).sum(-1).mean()), rel=1e-9)
    assert report["rmse_yaw_rad"] == pytest.approx(np.sqrt((error[..., 2] ** 2).mean()), rel=1e-9)
    np.testing.assert_allclose(report["rmse_per_step"], np.sqrt((error**2).mean(0)), rtol=1e-9)
    variance = np.diagonal(made.cov, axis1=-2, axis2=-1)
    np.testing.assert_allclose(report["sigma_per_step"], np.sqrt(variance.mean(0)), rtol=1e-9)
    assert report["nees_median"] == pytest.approx(np.median(nees), rel=1e-9)
    assert report["anees_median_run"] == pytest.approx(np.median(averages), rel=1e-9)
    assert report["anees_standard_error"] == pytest.approx(scipy.stats.sem(averages), rel=1e-9)
    assert report["independent_samples"] == RUNS
    step_band = np.array(scipy.stats.chi2.interval(0.95, 3 * RUNS)) / RUNS
    assert report["nees_band_95"] == pytest.approx(step_band, rel=1e-9)
    in_band = (nees.mean(0) >= step_band[0]) & (nees.mean(0) <= step_band[1])
    assert report["nees_steps_in_band"] == in_band.mean()
    for k, phase in enumerate(report["nees_phases"]):
        part = nees[:, 24 * k : 24 * (k + 1)].mean(1)
        assert phase["anees"] == pytest.approx(part.mean(), rel=1e-9)
        band = scipy.stats.t.interval(0.95, RUNS - 1, loc=3, scale=scipy.stats.sem(part))
        assert phase["band_95"] == pytest.approx(band, rel=1e-9)
        assert (phase["from_s"], phase["to_s"]) == pytest.approx((2.4 * k, 2.4 * k + 2.3))
    assert len(report["nees_phases"]) == 10
    for axis, shares in zip(report["within_two_sigma_interval_95"].values(), (ratio <= 4).mean(1).T, strict=True):
        interval = scipy.stats.t.interval(0.95, RUNS - 1, loc=shares.mean(), scale=scipy.stats.sem(shares))
        assert axis == pytest.approx(interval, rel=1e-9)
    run_nis = np.nanmean(nis.reshape(RUNS, -1), axis=1)
    assert report["nis_standard_error"] == pytest.approx(scipy.stats.sem(run_nis), rel=1e-9)
    band = scipy.stats.t.interval(0.95, RUNS - 1, loc=2, scale=scipy.stats.sem(run_nis))
    assert report["nis_band_95"] == pytest.approx(band, rel=1e-9)
    of_step = np.array(scipy.stats.chi2.interval(0.95, 2 * 3 * RUNS)) / (3 * RUNS)
    assert report["nis_chi2_band_95"][0] == pytest.approx(of_step, rel=1e-9)
    assert report["nis_chi2_band_95"][1] is None
    assert (report["nis_degrees"], report["unscored_observations"]) == (2, 0)
    assert report["nis_mean"] == pytest.approx(np.nanmean(nis.reshape(RUNS, -1), axis=1).mean(), rel=1e-9)
    assert report["nis_per_step"][0] == pytest.approx(np.nanmean(nis[:, 0]), rel=1e-9)
    assert report["nis_per_step"][1] is None
    assert report["observations"] == np.isfinite(nis).sum()
    assert report["counts"] == {"missing": 0, "not_finite": 0, "not_symmetric": 0, "not_positive_definite": 0}
    assert report["verdict"].startswith("consistent")
    assert not report["dishonest"]


def test_lag_one_pairs_each_observation_with_the_last_of_its_landmark_and_its_band_is_the_runs_spread():
    made = drives()
    report = judge(made.truth, made.mean, made.cov, innovations=innovations(made))
    white = np.full(made.nu.shape, np.nan)
    seen = np.isfinite(made.nu[..., 0])
    white[seen] = [
        np.linalg.solve(np.linalg.cholesky(S), nu) for nu, S in zip(made.nu[seen], made.S[seen], strict=True)
    ]
    series = white[:, ::3]
    before, after = series[:, :-1], series[:, 1:]
    each = 2 * (before * after).sum((1, 2)) / (before**2 + after**2).sum((1, 2))
    expected = each.mean(0)
    assert list(report["innovation_lag_one"].values()) == pytest.approx(expected.tolist(), rel=1e-9)
    band = scipy.stats.t.ppf(0.975, RUNS - 1) * each.std(0, ddof=1) / math.sqrt(RUNS)
    assert list(report["innovation_lag_one_band_95"].values()) == pytest.approx(band.tolist(), rel=1e-6)
    assert np.all(np.abs(expected) < 2 * band)
    # The same with the slots in another order and their landmarks named.
    order = np.random.default_rng(0).permuted(np.tile(np.arange(3), (RUNS, STEPS, 1)), axis=-1)
    mixed = Innovations(
        np.take_along_axis(made.nu, order[..., None], 2),
        np.take_along_axis(made.S, order[..., None, None], 2),
        landmark=order,
    )
    again = judge(made.truth, made.mean, made.cov, innovations=mixed)
    assert again["innovation_lag_one"] == pytest.approx(report["innovation_lag_one"], rel=1e-9)


@pytest.mark.parametrize("rho", [0.0, 0.05, 0.6, -0.3])
def test_lag_one_of_one_run_is_the_autocorrelation_and_its_band_holds_white_noise_alone(rho):
    rng = np.random.default_rng(5)
    steps, slots = 6000, 4
    # Every landmark is seen at times of its own: the process runs over its observations.
    seen = rng.random((steps, slots)) < 0.5
    white = np.full((steps, slots, 2), np.nan)
    for j in range(slots):
        noise = rng.normal(size=(seen[:, j].sum(), 2))
        for k in range(1, len(noise)):
            noise[k] = rho * noise[k - 1] + math.sqrt(1 - rho**2) * noise[k]
        white[seen[:, j], j] = noise
    S = np.array([[0.04, 0.003], [0.003, 0.01]])
    given = Innovations(white @ np.linalg.cholesky(S).T, np.broadcast_to(S, (steps, slots, 2, 2)))
    poses = np.zeros((steps, 3))
    report = judge(poses, poses, np.broadcast_to(np.eye(3), (steps, 3, 3)), innovations=given)
    pairs = seen.sum() - slots
    found = np.array(list(report["innovation_lag_one"].values()))
    assert list(report["innovation_lag_one_band_95"].values()) == pytest.approx([1.96 / math.sqrt(pairs)] * 2)
    # The estimate's standard error is sqrt((1 - rho²) / pairs).
    assert np.all(np.abs(found - rho) < 4 * math.sqrt((1 - rho**2) / pairs))
    assert np.all(np.abs(found) < 1.96 / math.sqrt(pairs)) == (rho == 0)


def test_a_run_with_wild_innovations_weighs_no_more_than_any_other():
    made = drives()
    nu = made.nu.copy()
    nu[0] = 1e6 * np.abs(nu[0])  # lag one of nearly 1
    report = judge(made.truth, made.mean, made.cov, innovations=Innovations(nu, made.S))
    healthy = judge(made.truth, made.mean, made.cov, innovations=innovations(made))
    for name, value in report["innovation_lag_one"].items():
        assert 0 < value - healthy["innovation_lag_one"][name] < 2 / RUNS


@pytest.mark.parametrize(("scale", "side"), [(0.25, "over-confident"), (4.0, "under-confident")])
def test_a_covariance_wrong_by_a_factor_is_found_with_it(scale, side):
    made = drives()
    report = judge(made.truth, made.mean, scale * made.cov)
    assert report["verdict"].startswith(f"{side}: covariance ")
    low, high = report["anees_interval_95"]
    assert low < 3 / scale < high
    assert all(span["side"] == side for span in report["dishonest"])
    assert len(report["dishonest"]) == 10


def test_when_and_where_it_is_dishonest():
    made = drives()
    cov = made.cov.copy()
    cov[:, 120:144] /= 4  # too sure in the sixth tenth
    report = judge(made.truth, made.mean, cov, time=DT * np.arange(STEPS))
    (span,) = report["dishonest"]
    assert (span["from_s"], span["to_s"]) == pytest.approx((12.0, 14.3))
    assert span["side"] == "over-confident"
    assert span["x_m"] == [made.truth[:, 120:144, 0].min(), made.truth[:, 120:144, 0].max()]
    assert span["y_m"] == [made.truth[:, 120:144, 1].min(), made.truth[:, 120:144, 1].max()]
    assert "most so from 12 to 14.3 s" in report["verdict"]


def test_one_run_has_no_axis_of_runs_and_says_how_many_samples_it_is_worth():
    made = drives(1, 3000, seed=3)
    report = judge(made.truth[0], made.mean[0], made.cov[0], innovations=Innovations(made.nu[0], made.S[0]))
    nees = numpy_nees(made)[0]
    assert report["anees"] == pytest.approx(nees.mean(), rel=1e-9)
    assert 10 < report["independent_samples"] < 3000
    assert report["verdict"].split(":")[0] in ("consistent", "undecided")
    assert "independent samples" in report["verdict"]
    wrong = judge(made.truth[0], made.mean[0], 0.1 * made.cov[0])
    assert wrong["verdict"].startswith("over-confident")


def test_steps_that_are_missing_or_spoilt_are_counted_and_left_out():
    made = drives()
    truth, mean, cov, valid = made.truth.copy(), made.mean.copy(), made.cov.copy(), np.ones((RUNS, STEPS), bool)
    valid[0, :7] = False
    truth[1, 3], mean[2, 4, 0], cov[3, 5, 1, 1] = np.nan, np.inf, np.nan
    cov[4, 6] = -cov[4, 6]
    cov[5, 7, 0, 1] += 0.1
    report = judge(truth, mean, cov, valid=valid)
    assert report["counts"] == {"missing": 7, "not_finite": 3, "not_symmetric": 1, "not_positive_definite": 1}
    assert report["scored_steps"] == RUNS * STEPS - 12
    nees = numpy_nees(made)
    left = np.ones_like(valid)
    left[0, :7] = left[1, 3] = left[2, 4] = left[3, 5] = left[4, 6] = left[5, 7] = False
    expected = np.where(left, nees, 0).sum(1) / left.sum(1)
    assert report["anees"] == pytest.approx(expected.mean(), rel=1e-9)
    assert report["nees_per_step"][3] == pytest.approx(nees[np.arange(RUNS) > 1, 3].sum() / (RUNS - 2), rel=1e-9)


def test_the_pose_may_be_any_entries_of_a_longer_state():
    made = drives()
    place = [3, 0, 4]
    mean, cov = np.full((RUNS, STEPS, 5), 7.0), np.tile(1e3 * np.eye(5), (RUNS, STEPS, 1, 1))
    mean[..., place] = made.mean
    cov[..., np.array(place)[:, None], place] = made.cov
    plain = judge(made.truth, made.mean, made.cov)
    assert judge(made.truth, mean, cov, pose=(3, 0, 4)) == plain
    truth = np.full((RUNS, STEPS, 5), -1.0)
    truth[..., place] = made.truth
    assert judge(truth, mean, cov, pose=(3, 0, 4))["anees"] == plain["anees"]


def test_the_heading_is_compared_round_the_circle():
    made = drives()
    turned = made.truth + np.array([0.0, 0.0, 2 * math.pi])
    assert judge(turned, made.mean, made.cov)["anees"] == pytest.approx(judge(*made[:3])["anees"], rel=1e-9)


@pytest.mark.parametrize("steps", [1, 5])
def test_too_few_steps_of_one_run_get_no_verdict(steps):
    made = drives()
    report = judge(made.truth[0, :steps], made.mean[0, :steps], made.cov[0, :steps])
    assert report["verdict"] == f"no verdict: {steps} scored steps, at least 20 of one run expected"


def test_runs_that_lost_the_robot_are_counted_and_the_others_judged():
    made = drives()
    truth = made.truth.copy()
    truth[7, 100:] += [5.0, 0.0, 0.0]
    report = judge(truth, made.mean, made.cov)
    assert report["diverged_runs"] == 1
    assert report["verdict"].startswith("not consistent: ANEES")
    assert report["verdict"].endswith("; 1 of 50 runs diverged")
    assert report["anees_median_run"] < 3.5 < report["anees"]
    # Axes and phases are the others'.
    others = judge(*(np.delete(x, 7, axis=0) for x in (truth, made.mean, made.cov)))
    assert report["axis_nees"] == pytest.approx(others["axis_nees"], rel=1e-9)
    for one, other in zip(report["nees_phases"], others["nees_phases"], strict=True):
        assert one["anees"] == pytest.approx(other["anees"], rel=1e-9)
    assert f"ANEES {others['anees']:.4g} of the others" in report["verdict"]


def test_a_run_is_lost_that_ends_without_a_belief_or_was_lost_on_the_way():
    """At its last step whose truth is known; one run alone, or all together, are judged as they are."""
    made = drives()
    truth, cov, valid = made.truth.copy(), made.cov.copy(), np.ones((RUNS, STEPS), bool)
    truth[2, 50] += [5.0, 0.0, 0.0]  # found again
    cov[3, -1] = np.nan
    cov[4, 199], valid[4, 200:] = -np.eye(3), False
    cov[5, 100] = np.nan  # in the midst of it
    valid[6] = False  # of this run nothing is known
    cov[7, 200], valid[7, 200:] = np.nan, False
    report = judge(truth, made.mean, cov, valid=valid)
    assert report["diverged_runs"] == 3
    assert "; 3 of 49 runs diverged" in report["verdict"]
    alone = judge(truth[2], made.mean[2], cov[2])
    assert "diverged" not in alone["verdict"]
    assert alone["nees_phases"][2]["anees"] > 10


def test_entries_may_differ_from_their_mirror_images_by_a_millionth_of_what_they_could_be():
    made = drives(2, 12)
    for entries, share, count in (((0, 1), 0.99e-6, 0), ((0, 1), 1.01e-6, 1), ((2, 0), 1.01e-6, 1)):
        cov = made.cov.copy()
        i, j = entries
        cov[1, 3, i, j] = cov[1, 3, j, i] + share * math.sqrt(cov[1, 3, i, i] * cov[1, 3, j, j])
        assert judge(made.truth, made.mean, cov)["counts"]["not_symmetric"] == count


def test_two_sigma_is_counted_to_its_edge_and_the_ellipsoids_without_theirs():
    """Errors along one axis, of 2 and a little more deviations, 4 of them, and steps enough for no more."""
    mean, cov = np.zeros((1, 4, 3)), np.tile(np.eye(3), (1, 4, 1, 1))
    truth = np.zeros((1, 4, 3))
    truth[0, :, 0], truth[0, :, 1], truth[0, :2, 2] = [2.0, -2.0, 2.000001, 0.0], [0, 0, 3, -3], 0.5
    report = judge(truth, mean, cov)
    assert report["within_two_sigma"] == {"x": 0.75, "y": 0.5, "yaw": 1.0}


def test_a_phase_of_one_run_has_the_run_s_correlation_time():
    made = drives(1, 3000, seed=3)
    report = judge(*made[:3])
    nees = numpy_nees(made)[0]
    samples = report["independent_samples"] / 10
    reach = scipy.stats.t.ppf(0.975, samples - 1) * math.sqrt(6 / samples)
    for k, phase in enumerate(report["nees_phases"]):
        assert phase["anees"] == pytest.approx(nees[300 * k : 300 * (k + 1)].mean(), rel=1e-9)
        assert phase["band_95"] == pytest.approx((3 - reach, 3 + reach), rel=1e-9)


@pytest.mark.parametrize(("times", "found"), [(0.98, 0), (1.02, 1)])
def test_a_phase_is_dishonest_beyond_a_band_widened_for_ten_of_them(times, found):
    """Runs whose NEES has mean 3 but for one phase, and whose averages have a spread known beforehand."""
    runs, steps = 40, 20
    spread = np.where(np.arange(runs) % 2, 0.5, -0.5)
    nees = np.full((runs, steps), 3.0) + spread[:, None]
    reach = scipy.stats.t.ppf(1 - 0.05 / 10 / 2, runs - 1) * 0.5 / math.sqrt(runs - 1)
    nees[:, 6:8] += times * reach
    truth = np.zeros((runs, steps, 3))
    truth[..., 0] = np.sqrt(nees)
    report = judge(truth, np.zeros_like(truth), np.tile(np.eye(3), (runs, steps, 1, 1)), time=0.5 * np.arange(steps))
    assert len(report["dishonest"]) == found
    if found:
        assert (report["dishonest"][0]["from_s"], report["dishonest"][0]["to_s"]) == (3.0, 3.5)
        assert report["dishonest"][0]["anees"] == pytest.approx(3 + times * reach, rel=1e-9)


@pytest.mark.parametrize(
    "spoilt",
    [{"S": -np.eye(2)}, {"S": np.array([[1.0, 2.0], [2.0, 1.0]])}, {"S": np.zeros((2, 2))}, {"nu": np.nan},
     {"S": np.full((2, 2), np.inf)}, {"S": np.diag([0.0, 1.0])}],
)  # fmt: skip
def test_what_has_no_covariance_is_observed_and_not_scored(spoilt):
    made = drives(2, 12)
    nu, S = made.nu.copy(), made.S.copy()
    nu[1, 3, 0], S[1, 3, 0] = spoilt.get("nu", nu[1, 3, 0]), spoilt.get("S", S[1, 3, 0])
    observed = np.isfinite(made.nu[..., 0])
    report = judge(*made[:3], innovations=Innovations(nu, S, observed))
    assert (report["observations"], report["unscored_observations"]) == (24, 1)
    left = numpy_nis(made)
    left[1, 3, 0] = np.nan
    assert report["nis_mean"] == pytest.approx(np.nanmean(left.reshape(2, -1), axis=1).mean(), rel=1e-9)
    assert report["nis_per_step"][3] == pytest.approx(np.nansum(left[:, 3]) / 5, rel=1e-9)


def test_what_is_not_observed_counts_nowhere():
    made = drives(2, 12)
    observed, accepted = np.isfinite(made.nu[..., 0]), np.ones((2, 12, 3), bool)
    observed[0, :6], accepted[0, :6], accepted[1, 0] = False, False, False
    report = judge(*made[:3], innovations=Innovations(made.nu, made.S, observed, accepted), gate_probability=0.99)
    assert (report["observations"], report["longest_rejection"]) == (18, 3)
    assert report["gate_accept_rate"] == pytest.approx(15 / 18)
    assert report["gate_nominal_rate"] == 0.99
    nis = numpy_nis(made)
    assert report["nis_per_step"][0] == pytest.approx(nis[1, 0].mean(), rel=1e-9)
    assert report["nis_mean"] == pytest.approx((nis[0, 6:][::3].mean() + np.nanmean(nis[1])) / 2, rel=1e-9)
    for name in ("observed", "accepted"):
        given = Innovations(made.nu, made.S)
        with pytest.raises(ValueError, match=f"{name}: expected shape"):
            judge(*made[:3], innovations=given._replace(**{name: accepted[:, :5]}))
        with pytest.raises((ValueError, TypeError), match=f"^{name}"):
            judge(*made[:3], innovations=given._replace(**{name: accepted.astype(int)}))
    with pytest.raises(ValueError, match="landmark: expected shape"):
        judge(*made[:3], innovations=Innovations(made.nu, made.S, landmark=np.zeros((2, 5), int)))


@pytest.mark.parametrize(
    ("refused", "longest"), [("1110111", 3), ("0111110", 5), ("1111", 4), ("0000", 0), ("1001101", 2)]
)
def test_the_longest_streak_is_counted_from_end_to_end(refused, longest):
    steps = len(refused)
    accepted = np.array([c == "0" for c in refused])
    pose = np.zeros((steps, 3)), np.zeros((steps, 3)), np.tile(np.eye(3), (steps, 1, 1))
    given = Innovations(np.ones((steps, 1)), np.ones((steps, 1, 1)), accepted=accepted)
    assert judge(*pose, innovations=given)["longest_rejection"] == longest


def test_the_gate_is_judged_by_its_share_and_its_longest_streak():
    made = drives()
    accepted = np.ones((RUNS, STEPS, 3), bool)
    accepted[3, 120:] = False  # half of a log refused at its end
    given = innovations(made)._replace(accepted=accepted)
    whole = judge(made.truth, made.mean, made.cov, innovations=given, gate_probability=0.99)
    assert whole["longest_rejection"] == 120
    assert whole["gate_accept_rate"] == pytest.approx(1 - 0.5 / RUNS)
    one = Innovations(*(None if x is None else x[3] for x in given))
    report = judge(made.truth[3], made.mean[3], made.cov[3], innovations=one, gate_probability=0.99)
    assert report["gate_verdict"].startswith("locked out: the gate rejected 50 %")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mean": np.zeros(3)}, r"mean: expected shape \(runs, steps, n\)"),
        (
            {"mean": np.zeros((1, 0, 3)), "truth": np.zeros((1, 0, 3)), "cov": np.zeros((1, 0, 3, 3))},
            "at least one step",
        ),
        ({"cov": np.zeros((2, 4, 3))}, "cov: expected shape"),
        ({"truth": np.zeros((2, 5, 3))}, "truth: expected shape"),
        ({"pose": (0, 0, 1)}, "pose: expected three different entries of a state of 3"),
        ({"pose": (0, 1, 3)}, "pose: expected three different entries"),
        ({"valid": np.zeros((2, 3), bool)}, "valid: expected shape"),
        ({"time": [0.0, 1.0, 1.0, 2.0]}, "time: expected increasing stamps, got 1 that do not"),
        ({"innovations": Innovations(np.zeros((2, 4, 2)), np.zeros((2, 4, 2)))}, "S: expected shape"),
        ({"innovations": Innovations(np.zeros((2, 3, 2)), np.zeros((2, 3, 2, 2)))}, "innovation: expected shape"),
    ],
)
def test_arrays_that_do_not_belong_together_are_refused(change, message):
    given = {"truth": np.zeros((2, 4, 3)), "mean": np.zeros((2, 4, 3)), "cov": np.tile(np.eye(3), (2, 4, 1, 1))}
    given |= change
    with pytest.raises(ValueError, match=message):
        judge(given.pop("truth"), given.pop("mean"), given.pop("cov"), **given)


def test_a_step_that_is_missing_in_every_run_may_share_its_stamp_with_the_next():
    arrays = np.full((2, 4, 3), 0.1), np.zeros((2, 4, 3)), np.tile(np.eye(3), (2, 4, 1, 1))
    valid = np.array([[True, False, True, True]] * 2)
    report = judge(*arrays, time=[0.0, 1.0, 1.0, 2.0], valid=valid)
    assert (report["scored_steps"], report["counts"]["missing"]) == (6, 2)
    assert report["anees"] == pytest.approx(0.03, rel=1e-12)
    for time, seen in (([0, 1, 1, 2], ~valid), ([0, 1, 0.5, 2], valid), ([0, 1, math.nan, 2], valid)):
        with pytest.raises(ValueError, match="time: expected increasing stamps, got"):
            judge(*arrays, time=time, valid=seen)


def test_innovations_of_zero_are_not_correlated():
    pose = np.zeros((4, 3)), np.zeros((4, 3)), np.tile(np.eye(3), (4, 1, 1))
    report = judge(*pose, innovations=Innovations(np.zeros((4, 2)), np.tile(np.eye(2), (4, 1, 1))))
    assert report["innovation_lag_one"] == {"range": 0, "bearing": 0}


# --- Files ---

COLUMNS = ("t", "x", "y", "theta", "xx", "xy", "xt", "yy", "yt", "tt")


def csv(path, names, rows):
    path.write_text("\n".join([",".join(names), *(",".join(map(repr, map(float, row))) for row in rows)]) + "\n")
    return path


def upper(cov):
    return [cov[0, 0], cov[0, 1], cov[0, 2], cov[1, 1], cov[1, 2], cov[2, 2]]


def estimate_rows(made, n, steps=STEPS):
    return [(DT * k, *made.mean[n, k], *upper(made.cov[n, k])) for k in range(steps)]


def files(folder, made, runs):
    """Truth, estimate and innovations of each run, as a user would write them."""
    names = ("t", "landmark", "nu0", "nu1", "S00", "S01", "S11", "accepted")
    truths, estimates, nus = [], [], []
    for n in range(runs):
        write_tum(folder / f"truth{n}.tum", DT * np.arange(STEPS), made.truth[n])
        truths.append(folder / f"truth{n}.tum")
        estimates.append(csv(folder / f"estimate{n}.csv", COLUMNS, estimate_rows(made, n)))
        rows = [
            (DT * k, j, *made.nu[n, k, j], *made.S[n, k, j][np.triu_indices(2)], 1)
            for k in range(0, STEPS, 3)
            for j in range(3)
        ]
        nus.append(csv(folder / f"nu{n}.csv", names, rows))
    return truths, estimates, nus


def judged(folder, truths, estimates, **options):
    config = program.JudgeConfig(tuple(truths), tuple(estimates), out=folder / "out", **options)
    return program.main(config)


def test_files_of_fifty_runs_give_numpy_s_numbers(tmp_path):
    made = drives()
    truths, estimates, nus = files(tmp_path, made, RUNS)
    report = judged(tmp_path, truths, estimates, innovations=tuple(nus))
    nees, nis = numpy_nees(made), numpy_nis(made)
    assert report["anees"] == pytest.approx(nees.mean(), rel=1e-9)
    np.testing.assert_allclose(report["nees_per_step"], nees.mean(0), rtol=1e-9)
    for level in COVERAGE_LEVELS:
        share = np.mean(nees < scipy.stats.chi2.ppf(level, 3))
        assert report[f"coverage_{round(100 * level)}"] == pytest.approx(share, rel=1e-9)
    assert report["nis_mean"] == pytest.approx(np.nanmean(nis), rel=1e-9)
    assert report["gate_accept_rate"] == 1
    written = json.loads((tmp_path / "out" / "report.json").read_text())
    assert written["anees"] == report["anees"]
    assert written["verdict"] == report["verdict"]
    assert (tmp_path / "out" / "nees.png").stat().st_size > 10_000


def test_every_way_to_write_a_covariance_reads_the_same(tmp_path):
    made = drives()
    rng = np.random.default_rng(0)
    plain = csv(tmp_path / "plain.csv", COLUMNS, estimate_rows(made, 0, 5))
    six, tum = rng.normal(size=(5, 6, 6)), {6: [], 9: [], 36: []}
    plane = np.ix_([0, 1, 5], [0, 1, 5])
    ros = []
    for k in range(5):
        six[k][plane] = made.cov[0, k]
        x, y, theta = made.mean[0, k]
        turn = (0, 0, math.sin(theta / 2), math.cos(theta / 2))
        ros.append((DT * k, x, y, 0.3, *turn, *six[k].ravel()))
        for size, entries in ((6, upper(made.cov[0, k])), (9, made.cov[0, k].ravel()), (36, six[k].ravel())):
            tum[size].append((DT * k, x, y, 0.3, *turn, *entries))
    quaternion = ("qx", "qy", "qz", "qw")
    named = csv(tmp_path / "ros.csv", ("time", "x", "y", "z", *quaternion, *(f"cov_{i}" for i in range(36))), ros)
    other = csv(
        tmp_path / "b.csv", ("t", "x", "y", "z", *quaternion, *(f"pose.covariance[{i}]" for i in range(36))), ros
    )
    paths = [plain, named, other]
    for size, rows in tum.items():
        paths.append(tmp_path / f"{size}.tum")
        paths[-1].write_text("# a comment\n" + "\n".join(" ".join(map(repr, map(float, row))) for row in rows))
    for path in paths:
        got = read_trajectory(path)
        np.testing.assert_allclose(got.time, DT * np.arange(5), rtol=0, atol=0, err_msg=path.name)
        np.testing.assert_allclose(got.pose, made.mean[0, :5], rtol=0, atol=1e-12, err_msg=path.name)
        np.testing.assert_allclose(got.cov, made.cov[0, :5], rtol=0, atol=1e-15, err_msg=path.name)


def test_truth_is_interpolated_along_the_shorter_way_and_gaps_are_left_out(tmp_path):
    truth = csv(tmp_path / "truth.csv", COLUMNS[:4], [(0, 0, 0, 3.1), (1, 2, 4, -3.1), (4, 8, 4, 0)])
    rows = [(t, 0, 0, 0, 1, 0, 0, 1, 0, 1) for t in (0.5, 1.0, 2.0, 4.0, 5.0)]
    estimate = csv(tmp_path / "estimate.csv", COLUMNS, rows)
    both = pair([read_trajectory(truth)], [read_trajectory(estimate)], ["estimate"], max_gap=1.0)
    np.testing.assert_array_equal(both.valid[0], [True, True, False, True, False])
    np.testing.assert_allclose(both.truth[0, 0], [1, 2, -math.pi], rtol=0, atol=1e-12)
    assert both.counts == {"backward_stamps": 0, "duplicate_stamps": 0, "without_truth": 2}


def test_runs_of_different_length_stand_beside_each_other(tmp_path):
    made = drives()
    truths, estimates, nus = files(tmp_path, made, 3)
    csv(estimates[1], COLUMNS, estimate_rows(made, 1, 100))
    csv(nus[1], ("t", "landmark", "nu0", "nu1", "S00", "S01", "S11", "accepted"), [(0, 0, 0.1, 0, 1, 0, 1, 0)])
    report = judged(tmp_path, truths, estimates, innovations=tuple(nus), gate=0.99)
    nees = numpy_nees(made)
    assert report["scored_steps"] == 2 * STEPS + 100
    assert report["anees"] == pytest.approx(np.mean([nees[0].mean(), nees[1, :100].mean(), nees[2].mean()]), rel=1e-9)
    assert report["observations"] == 2 * STEPS + 1
    assert report["gate_accept_rate"] == pytest.approx(2 * STEPS / (2 * STEPS + 1))


def test_stamps_that_are_shuffled_or_doubled_are_mended_and_counted(tmp_path):
    made = drives()
    rows = estimate_rows(made, 0)
    truths, estimates, _ = files(tmp_path, made, 1)
    expected = judged(tmp_path, truths, estimates)
    shuffled = [rows[i] for i in np.random.default_rng(0).permutation(STEPS)]
    csv(estimates[0], COLUMNS, [(rows[5][0], *rows[9][1:]), *shuffled])
    report = judged(tmp_path, truths, estimates)
    assert report["anees"] == expected["anees"]
    assert report["counts"]["backward_stamps"] > 50
    assert report["counts"]["duplicate_stamps"] == 1


def test_rows_that_are_no_numbers_or_no_covariances_are_counted_and_left_out(tmp_path):
    made = drives()
    truths, estimates, _ = files(tmp_path, made, 1)
    rows = [list(row) for row in estimate_rows(made, 0)]
    rows[3][1], rows[4][4], rows[5][7] = math.nan, math.inf, -1.0
    csv(estimates[0], COLUMNS, rows)
    report = judged(tmp_path, truths, estimates)
    assert report["counts"]["not_finite"] == 2
    assert report["counts"]["not_positive_definite"] == 1
    assert report["scored_steps"] == STEPS - 3


GOOD = "t,x,y,theta,xx,xy,xt,yy,yt,tt\n0,0,0,0,1,0,0,1,0,1\n1,0,0,0,1,0,0,1,0,1\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (GOOD.replace("theta,", "").replace(",0,0,0,1", ",0,0,1"), r"1: expected the columns .*; missing: 'theta'"),
        (GOOD.replace("xy,", "xx,"), "1: expected the columns .*; missing: 'xy'"),
        ("t,x,y,y,theta\n0,0,0,0,0\n", "1: expected the columns .*; doubled: 'y'"),
        (GOOD.replace(",tt", ",tt,speed").replace("1\n", "1,5\n"), "1: expected the columns .*; unknown: 'speed'"),
        (GOOD.replace("1,0,0,0,1,0,0,1,0,1\n", "1,0,0\n"), "3: expected 10 columns .*, got 3"),
        (GOOD.replace("\n1,0", "\n1,east"), "3: x: expected a number, got 'east'"),
        (GOOD.replace("\n1,", "\nnan,"), "3: t: expected a finite stamp, got nan"),
        ("t,x,y,theta\n0,0,0,0\n", "expected covariances to judge, got poses alone"),
        ("t,x,y,theta\n", "expected rows below the names, got none"),
        ("# nothing\n", "expected poses, got only blank lines and comments"),
        ("", "the file is empty"),
        ("0 0 0 0 0 0 0 1 5\n", "1: expected timestamp x y z qx qy qz qw and none, 6, 9 or 36 entries"),
        ("0 0 0 0 0 0 0 0\n", "expected a rotation, got a quaternion of length 0"),
        (
            GOOD.replace("\n0,", "\n5000,").replace("\n1,", "\n5001,"),
            "truth and estimate: no overlap in time: truth from 0.000",
        ),
        (GOOD.replace("1,0,0,1,0,1\n", "\n", 1), "2: expected 10 columns"),
    ],
)
def test_files_with_faults_are_refused_by_line_and_column(tmp_path, text, message):
    path, truth = tmp_path / "estimate.csv", csv(tmp_path / "truth.csv", COLUMNS[:4], [(0, 0, 0, 0), (9, 0, 0, 0)])
    path.write_text(text)
    with pytest.raises(ValueError, match=f"{path}.*{message}"):
        judged(tmp_path, [truth], [path])
    assert not (tmp_path / "out" / "report.json").exists()


def test_one_step_gets_no_verdict(tmp_path):
    truth = csv(tmp_path / "truth.csv", COLUMNS[:4], [(0, 0, 0, 0)])
    path = tmp_path / "estimate.csv"
    path.write_text("".join(GOOD.splitlines(True)[:2]))
    report = judged(tmp_path, [truth], [path])
    assert report["verdict"].startswith("no verdict: 1 scored steps")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_gap": -1.0}, "max_gap: expected seconds >= 0, got -1"),
        ({"max_gap": math.nan}, "max_gap: expected seconds >= 0, got nan"),
        ({"gate": 2.0}, r"gate: expected a probability inside \(0, 1\)"),
        ({"innovations": ("a", "b")}, "innovations: expected one file for each of the 1 estimates, got 2"),
    ],
)
def test_options_out_of_range_are_refused_by_name(tmp_path, options, message):
    truth = csv(tmp_path / "truth.csv", COLUMNS[:4], [(0, 0, 0, 0)])
    (tmp_path / "estimate.csv").write_text(GOOD)
    with pytest.raises(ValueError, match=message):
        judged(tmp_path, [truth], [tmp_path / "estimate.csv"], **options)


def test_as_many_estimates_as_truths_are_wanted(tmp_path):
    truth = csv(tmp_path / "truth.csv", COLUMNS[:4], [(0, 0, 0, 0)])
    (tmp_path / "estimate.csv").write_text(GOOD)
    with pytest.raises(ValueError, match="truth, estimate: expected as many of each, got 2 and 1"):
        judged(tmp_path, [truth, truth], [tmp_path / "estimate.csv"])


def test_an_innovation_before_the_first_stamp_is_refused_by_its_line(tmp_path):
    path = csv(tmp_path / "nu.csv", ("t", "nu0", "S00"), [(0.0, 0.0, 1.0), (-1.0, 0.0, 1.0)])
    with pytest.raises(ValueError, match=f"{path}:3: t: expected no stamp before the estimate's first, 0.0"):
        read_innovations(path, np.array([0.0, 1.0]))
    path = csv(tmp_path / "nu.csv", ("t", "nu0", "nu1", "S00", "S11"), [(0.0,) * 5])
    with pytest.raises(ValueError, match=f"{path}:1: expected the columns t, nu0, nu1, S00, S01, S11; missing: 'S01'"):
        read_innovations(path, np.array([0.0, 1.0]))


# --- The program ---


@pytest.fixture
def handed(monkeypatch):
    """What the program hands on to be judged, and to be drawn."""
    told, drawn = Recorder({"counts": {"missing": 4}}), Recorder()
    monkeypatch.setattr(program, "judge", told)
    monkeypatch.setattr(program.plotting, "judge_figure", drawn)
    monkeypatch.setattr(program, "_print", Recorder())
    return told, drawn


def test_a_quick_look_is_at_the_first_steps_of_each_run(tmp_path, monkeypatch, handed):
    monkeypatch.setattr(program, "_QUICK", 100)
    made = drives()
    truths, estimates, nus = files(tmp_path, made, 2)
    judged(tmp_path, truths, estimates, innovations=tuple(nus), quick=True)
    ((arrays, how),) = handed[0].calls
    for got, expected in zip(arrays, made, strict=False):
        np.testing.assert_allclose(got, expected[:2, :100], rtol=0, atol=1e-9)
    np.testing.assert_allclose(how["time"], DT * np.arange(100), rtol=0, atol=1e-9)
    assert how["valid"].shape == (2, 100)
    np.testing.assert_allclose(how["innovations"].innovation, made.nu[:2, :100], rtol=0, atol=1e-9)


def test_a_gap_of_the_truth_is_as_long_as_the_option_says(tmp_path, handed):
    truth = csv(tmp_path / "truth.csv", COLUMNS[:4], [(t, 0, 0, 0) for t in (0, 1, 4, 5)])
    rows = [(t, 0, 0, 0, 1, 0, 0, 1, 0, 1) for t in np.arange(11) / 2]
    estimate = csv(tmp_path / "estimate.csv", COLUMNS, rows)
    for gap, valid in ((0.5, 4), (1.0, 6), (3.0, 11)):
        judged(tmp_path, [truth], [estimate], max_gap=gap)
        assert handed[0].calls[-1][1]["valid"].sum() == valid


def test_what_is_judged_is_named_and_counted(tmp_path, handed):
    """By the first file and how many more; what was left out by the reader and by the judge."""
    told, drawn = handed
    made = drives()
    truths, estimates, nus = files(tmp_path, made, 3)
    report = judged(tmp_path, truths, estimates, innovations=tuple(nus), gate=0.9)
    assert report["estimates"] == [str(path) for path in estimates]
    assert report["counts"] == {"backward_stamps": 0, "duplicate_stamps": 0, "without_truth": 0, "missing": 4}
    ((arrays, how),) = told.calls
    for got, expected in zip(arrays, made, strict=False):
        np.testing.assert_allclose(got, expected[:3], rtol=0, atol=1e-9)
    assert how["gate_probability"] == 0.9
    (((path, same, where, title), _),) = drawn.calls
    assert (path, same, title) == (tmp_path / "out" / "nees.png", report, "estimate0.csv and 2 more")
    np.testing.assert_allclose(where, made.truth[0, :, :2], rtol=0, atol=1e-9)
    judged(tmp_path, truths[:1], estimates[:1])
    assert drawn.calls[1][0][3] == "estimate0.csv"
    assert (told.calls[1][1]["innovations"], told.calls[1][1]["gate_probability"]) == (None, None)


def test_what_is_shown_of_a_judgement(monkeypatch, capsys):
    shown = []
    monkeypatch.setattr(program, "show", lambda *args: shown.append(args))
    monkeypatch.setattr(program, "print_verdicts", lambda report: None)
    monkeypatch.setattr(program, "pose_rows", lambda report: [("p", "", "")])
    monkeypatch.setattr(program, "innovation_rows", lambda report: [("i", "", "")])
    span = {"side": "over-confident", "from_s": 1.25, "to_s": 2.5, "x_m": (0.5, 1.5), "y_m": (-2, 3), "anees": 9.5}
    report = {"runs": 2, "steps": 9, "scored_steps": 17, "independent_samples": 12.0, "nees_median": 2.5}
    report |= {"counts": {"missing": 1, "not_finite": 0}, "dishonest": [span]}
    program._print(report, "title")
    program._print(report | {"nis_mean": 2.0}, "title")
    head = [("runs, steps, steps scored", "2, 9, 17", ""), ("independent samples", "12", "")]
    head += [("median NEES", "2.5", "2.37"), ("p", "", "")]
    left = [("dropped or mended in the log: missing", "1", "")]
    assert shown == [("title", head + left), ("title", [*head, ("i", "", ""), *left])]
    said = "over-confident from 1.25 to 2.5 s (x 0.5 to 1.5 m, y -2 to 3 m): NEES 9.5"
    assert said in " ".join(capsys.readouterr().out.split())


def test_innovations_lie_in_slots_of_the_last_stamp_not_after_them(tmp_path):
    names = ("time", "nu1", "nu0", "S11", "S01", "S00", "accepted", "landmark")
    rows = [(2.0, 1, 2, 3, 4, 5, 0, 7), (0.0, 11, 12, 13, 14, 15, 1, 3), (1.99, 21, 22, 23, 24, 25, 1, 5),
            (9.0, 31, 32, 33, 34, 35, 1, 6)]  # fmt: skip
    got = read_innovations(csv(tmp_path / "nu.csv", names, rows), np.array([0.0, 1.0, 2.0]))
    at = [(2, 0), (0, 0), (1, 0), (2, 1)]
    assert got["innovation"].shape == (3, 2, 2)
    assert got["observed"].sum() == 4
    for (step, slot), row in zip(at, rows, strict=True):
        np.testing.assert_array_equal(got["innovation"][step, slot], [row[2], row[1]])
        np.testing.assert_array_equal(got["S"][step, slot], [[row[5], row[4]], [row[4], row[3]]])
        assert (got["observed"][step, slot], got["accepted"][step, slot]) == (True, row[6] == 1)
        assert got["landmark"][step, slot] == row[7]
    empty = ~got["observed"]
    assert np.isnan(got["innovation"][empty]).all()
    assert np.isnan(got["S"][empty]).all()
    assert not got["accepted"][empty].any()
    assert (got["landmark"][empty] == -1).all()


def test_a_heading_is_that_of_its_quaternion_whatever_its_length_and_tilt(tmp_path):
    """Yaw, then pitch, then roll; and the same three times as long."""
    yaw, pitch, roll = 2.0, 0.4, -0.3
    cy, sy, cp, sp, cr, sr = (f(a / 2) for a in (yaw, pitch, roll) for f in (math.cos, math.sin))
    w, x = cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy
    y, z = cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy
    path = tmp_path / "a.tum"
    path.write_text(f"0 1 2 3 {x} {y} {z} {w}\n1 1 2 3 {3 * x} {3 * y} {3 * z} {3 * w}\n2 1 2 3 {-x} {-y} {-z} {-w}\n")
    np.testing.assert_allclose(read_trajectory(path).pose, [[1, 2, yaw]] * 3, rtol=1e-12)


def test_runs_beside_each_other_count_from_their_first_stamp(tmp_path):
    """The time is that of the longest; the counts are those of all files."""
    truth = csv(tmp_path / "truth.csv", COLUMNS[:4], [(100, 0, 0, 0), (103, 3, 0, 0), (101, 1, 0, 0), (101, 1, 0, 0)])
    rows = [(t, 0, 0, 0, 1, 0, 0, 1, 0, 1) for t in (100.5, 101.0, 102.0, 103.0)]
    short = csv(tmp_path / "short.csv", COLUMNS, rows[1:3])
    long = csv(tmp_path / "long.csv", COLUMNS, rows)
    read = [read_trajectory(path) for path in (truth, short, long)]
    both = pair([read[0]] * 2, read[1:], ["short", "long"], max_gap=0.0)
    np.testing.assert_array_equal(both.time, [0, 0.5, 1.5, 2.5])
    np.testing.assert_array_equal(both.valid, [[True, False, False, False], [False, True, False, True]])
    np.testing.assert_array_equal(both.stamps[0], [101, 102])
    assert np.isnan(both.cov[0, 2:]).all()
    assert both.counts == {"backward_stamps": 2, "duplicate_stamps": 2, "without_truth": 3}
    assert pair([read[0]], read[1:2], ["short"], max_gap=2.0).valid.all()


# --- The figure ---


def test_the_figure_shows_what_the_report_says(tmp_path, monkeypatch):
    from matplotlib.figure import Figure

    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    made = drives()
    truths, estimates, _ = files(tmp_path, made, 2)
    report = judged(tmp_path, truths, estimates)
    over_time, where, errors, bars = drawn[0].axes[:4]
    np.testing.assert_array_equal(over_time.lines[0].get_ydata(), report["nees_per_step"])
    np.testing.assert_array_equal(over_time.lines[0].get_xdata(), report["time"])
    band = over_time.patches[0].get_extents().transformed(over_time.transData.inverted())
    assert (band.y0, band.y1) == pytest.approx(report["nees_band_95"])
    dots = where.collections[0]
    np.testing.assert_allclose(dots.get_offsets(), made.truth[0, :, :2], rtol=0, atol=1e-12)
    np.testing.assert_allclose(dots.get_array(), np.clip(np.array(report["nees_per_step"]) / 3, 1e-2, 1e3), rtol=1e-12)
    error = np.array(report["rmse_per_step"])
    np.testing.assert_array_equal(errors.lines[0].get_ydata(), np.hypot(error[:, 0], error[:, 1]))
    np.testing.assert_array_equal(errors.lines[2].get_ydata(), error[:, 2])
    measured = [bar.get_height() for bar in bars.patches[4:8]]
    assert measured == pytest.approx([100 * report[f"coverage_{p}"] for p in (50, 90, 95, 99)])
