"""Verdicts in words: what they blame, where a factor is given, and what they rest on."""

import math

import numpy as np
import pytest
import scipy.stats

from jaxlocmap import consistency
from jaxlocmap.consistency import Basis, Mean, PoseMeans


def mean(value, error, expected=3.0, runs=300):
    reach = scipy.stats.t.ppf(0.975, runs - 1) * error
    return Mean(value, error, runs, (expected - reach, expected + reach))


def means(anees=3.0, axes=(1.0, 1.0, 1.0), *, error=0.02, kept=None, phases=None, runs=300):
    """Statistics of a study whose NEES has a standard error of `error`, each axis a third of it."""
    ratios = tuple(mean(a, error / 3, 1.0, runs) for a in axes)
    parts = tuple(mean(p, 2 * error, 3.0, runs) for p in phases or (anees,) * 4)
    return PoseMeans(
        nees=mean(anees, error, 3.0, runs),
        undiverged_nees=mean(anees if kept is None else kept, error, 3.0, runs),
        axis_nees=ratios,
        within_two_sigma=ratios,
        covered=ratios + ratios[:1],
        phases=parts,
        phase_spans=((0.1, 6.0), (6.1, 12.0), (12.1, 18.0), (18.1, 24.0)),
    )


def said(of, *, runs=300, **basis):
    return consistency.verdict(of, Basis(runs=runs, steps=1000, **basis))


def scaled(factor, **rest):
    """A filter whose covariance is too small by a factor."""
    return means(3 * factor, (factor,) * 3, **rest)


def test_inside_its_band_a_filter_is_consistent():
    assert said(means(3.02)) == "consistent: ANEES 3.02 lies in its 95 % band [2.961, 3.039]"
    assert said(means(2.961)).startswith("consistent: ")


def test_a_misfit_that_is_significant_and_small_is_named_as_such():
    text = said(means(3.025, error=0.005))
    assert text == "consistent within 1 %: ANEES 3.025, its 95 % band [2.99, 3.01]"
    assert "times" in said(scaled(1.02, error=0.005))


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (4.0, r"over-confident: covariance 4 [3.99, 4.01] times too small (ANEES 12, 3 expected, "),
        (0.5, r"under-confident: covariance 2 [1.95, 2.05] times too large (ANEES 1.5, 3 expected, "),
        (1.04, r"over-confident: covariance 1.040 [1.027, 1.053] times too small"),
    ],
)
def test_axes_that_agree_share_a_factor_with_its_interval(factor, words):
    assert said(scaled(factor)).startswith(words)


def test_no_verdict_says_1_times():
    for factor in np.linspace(0.9, 1.1, 41):
        assert " 1 times" not in said(scaled(factor, error=1e-4))


def test_axes_that_disagree_are_named_each_with_its_own():
    text = said(means(2.49, (0.51, 0.49, 1.22)))
    assert text.startswith("not consistent: the variance of x 1.96 [1.91, 2.01] times too large, the variance of y ")
    assert "the variance of yaw 1.22 [1.21, 1.23] times too small" in text
    assert "covariance" not in text


def test_axes_that_make_up_for_each_other_are_found_out():
    text = said(means(3.0, (0.6, 1.0, 1.5)))
    assert text.startswith("not consistent: ANEES 3 lies in its 95 % band")
    assert "the variance of x 1.67" in text
    assert "the variance of y " not in text


def test_correlations_alone_can_be_wrong():
    assert "the axes alone agree, their correlations do not" in said(means(4.0)) or "covariance" in said(means(4.0))


@pytest.mark.parametrize(
    ("of", "basis", "cause"),
    [
        (scaled(0.94), {"exact_start": True}, "an exact start"),
        (scaled(1.04), {"gate": True}, "a gate"),
        (scaled(0.96), {"gate": True, "exact_start": True}, "an exact start"),
    ],
)
def test_what_start_and_gate_do_by_themselves_is_not_blamed_on_the_filter(of, basis, cause):
    text = said(of, **basis)
    assert text.startswith("undecided: ANEES")
    assert cause in text
    assert "times too" not in text


@pytest.mark.parametrize(
    ("of", "basis", "side"),
    [
        (scaled(1.1), {"exact_start": True}, "over-confident"),  # an exact start only lowers
        (scaled(0.9), {"gate": True}, "under-confident"),  # a gate only raises
        (scaled(3.0), {"gate": True}, "over-confident"),  # by far more than it can
        (scaled(0.3), {"exact_start": True}, "under-confident"),
    ],
)
def test_what_they_cannot_do_is_the_filter_s_without_a_factor(of, basis, side):
    text = said(of, **basis)
    assert text.startswith(side)
    assert "no factor of the covariance" in text
    assert "times too" not in text


def test_a_reference_takes_the_place_of_what_is_expected():
    reference = means(2.8, (0.93, 0.93, 0.94))
    basis = {"exact_start": True, "reference": reference}
    assert said(means(2.82, (0.93, 0.94, 0.94)), **basis).startswith(
        "consistent: ANEES 2.82 lies in its 95 % band [2.744"
    )
    text = said(means(5.6, (1.86, 1.86, 1.88)), **basis)  # from an exact start both suffer alike: a factor follows
    assert text.startswith("over-confident: covariance 2 [1.97, 2.03] times too small")
    text = said(means(5.6, (1.86, 1.86, 1.88)), **basis, gate=True)
    assert "no factor of the covariance behind a gate" in text
    assert "2 times what is expected" in text


def test_the_error_of_the_reference_counts():
    far = means(2.9)
    assert said(means(3.0), reference=far, exact_start=True).startswith("over-confident")
    unsure = means(2.9, error=0.1)
    assert said(means(3.0), reference=unsure, exact_start=True).startswith("consistent")


@pytest.mark.parametrize("of", [means(), scaled(2.0), scaled(0.2)])
def test_diverged_runs_are_in_every_verdict_and_the_others_are_judged(of):
    text = said(of, diverged=4)
    assert text.endswith("; 4 of 300 runs diverged")
    assert "of the others" in text
    assert not text.startswith("consistent")
    assert "diverged" not in said(of)
    assert "which a gate can bring about by itself" in said(of, diverged=4, gate=True)


@pytest.mark.parametrize(("diverged", "as_many"), [(1, True), (3, True), (20, False)])
def test_as_many_diverged_runs_as_of_an_honest_filter_are_not_held_against_one(diverged, as_many):
    """Of 2,000 runs of the filter told the robot's own noise, 7 diverged: at most 0.72 % of all, with 97.5 %."""
    basis = {"gate": True, "reference": means(3.1, (1.03, 1.03, 1.04)), "reference_diverged": (7, 2000)}
    text = said(means(3.1, (1.03, 1.04, 1.04)), diverged=diverged, **basis)
    assert text.startswith("consistent" if as_many else "not consistent")
    assert text.endswith(f"{diverged} of 300 runs diverged, 7 of 2000 of the filter told the robot's own noise")
    low, high = (scipy.stats.binomtest(*n).proportion_ci(0.95, method="exact") for n in ((diverged, 300), (7, 2000)))
    assert (low.low <= high.high) == as_many


def test_nothing_is_said_of_the_others_where_every_run_diverged():
    text = said(
        means(500.0)._replace(undiverged_nees=Mean(math.nan, math.nan, 0.0, (-math.inf, math.inf))), diverged=300
    )
    assert text == "not consistent: ANEES 500; 300 of 300 runs diverged"


@pytest.mark.parametrize(
    ("axes", "basis", "undecided"),
    [
        ((0.79, 0.96, 0.83), {"exact_start": True}, True),  # an honest filter, capstone
        ((0.6, 0.96, 0.83), {"exact_start": True}, False),
        ((0.79, 0.96, 1.1), {"exact_start": True}, False),  # it raises none
        ((0.9, 1.1, 1.1), {"gate": True}, False),  # a gate lowers none
        ((0.8, 1.0, 1.1), {"exact_start": True, "gate": True}, True),
        ((1.0, 1.0, 1.6), {"exact_start": True, "gate": True}, False),
    ],
)
def test_an_exact_start_only_lowers_an_axis_and_a_gate_only_raises_one(axes, basis, undecided):
    for text in (said(means(sum(axes), axes), **basis), said(means(2.94, axes), **basis)):
        assert text.startswith("undecided" if undecided else ("not consistent", "under-", "over-"))


def test_a_lost_run_s_nees_does_not_stand_for_the_others():
    assert said(means(1e6, kept=3.01), diverged=1).startswith("not consistent: ANEES 3.01 of the others lies in its")


def test_the_phase_that_stands_out_is_named():
    assert said(means(6.0, (2.0,) * 3, phases=(3.0, 3.1, 3.0, 15.0))).endswith("; most so from 18.1 to 24 s: NEES 15")
    assert "most so" not in said(scaled(2.0))


def test_one_run_is_undecided_until_its_samples_tell():
    few, some, many = (
        means()._replace(nees=m, undiverged_nees=m)
        for m in (
            Mean(4.0, 0.5, 20.0, (2.0, 4.0)),  # just at its band
            Mean(4.2, 0.5, 20.0, (2.0, 4.0)),  # beyond it, but the correlation time is uncertain
            Mean(3.05, 0.1, 500.0, (2.8, 3.2)),
        )
    )
    for of in (few, some):
        text = said(of, runs=1)
        assert text.startswith("undecided: ANEES 4")
        assert "20 independent samples" in text
    assert said(many, runs=1).startswith("consistent: ")
    far = means()._replace(undiverged_nees=Mean(40.0, 5.0, 20.0, (2.0, 4.0)))
    assert said(far, runs=1).startswith("over-confident")


@pytest.mark.parametrize("steps", [0, 1, 3, 19])
def test_too_little_truth_gives_no_verdict_and_says_how_much_there_is(steps):
    text = consistency.verdict(means(0.0), Basis(runs=1, steps=steps))
    assert text == f"no verdict: {steps} scored steps, at least 20 of one run expected"


def test_no_finite_nees_is_not_consistent():
    text = consistency.verdict(means(math.nan), Basis(runs=2, steps=0, diverged=2))
    assert text == "not consistent: no NEES is finite; 2 of 2 runs diverged"


# --- Words at their borders ---


def of_one_axis(relative, error, anees=3.0):
    """Only x is off."""
    return means(anees, (relative, 1.0, 1.0))._replace(
        axis_nees=(mean(relative, error, 1.0), mean(1.0, error, 1.0), mean(1.0, error, 1.0))
    )


def of_one_run(anees, half, samples):
    one = Mean(anees, 0.1, samples, (3 - half, 3 + half))
    return means()._replace(nees=one, undiverged_nees=one)


WIDER = [scipy.stats.t.ppf(0.999, n - 1) / scipy.stats.t.ppf(0.975, n - 1) for n in (60.0, 99.0)]


@pytest.mark.parametrize(
    ("of", "basis", "begins"),
    [
        # A misfit of 1 % is none to mind, one beyond is.
        (scaled(1.0099, error=1e-3), {}, "consistent within 1 %"),
        (scaled(1.0101, error=1e-3), {}, "over-confident"),
        (scaled(0.9901, error=1e-3), {}, "consistent within 1 %"),
        (scaled(0.9899, error=1e-3), {}, "under-confident"),
        (scaled(1.005, error=1e-3), {"diverged": 1}, "over-confident"),
        # An exact start or a gate may move the ANEES by a quarter, and an axis by a half.
        (means(3 / 1.249, (0.8,) * 3), {"exact_start": True}, "undecided"),
        (means(3 / 1.251, (0.8,) * 3), {"exact_start": True}, "under-confident"),
        (means(3 * 1.249, (1.25,) * 3), {"gate": True}, "undecided"),
        (means(3 * 1.251, (1.25,) * 3), {"gate": True}, "over-confident"),
        (of_one_axis(1.499, 1e-3), {"gate": True}, "consistent"),
        (of_one_axis(1.501, 1e-3), {"gate": True}, "not consistent"),
        (of_one_axis(1 / 1.499, 1e-3), {"exact_start": True}, "consistent"),
        (of_one_axis(1 / 1.501, 1e-3), {"exact_start": True}, "not consistent"),
        # An axis is off by more than 5 % and beyond what one of a thousand reaches.
        (of_one_axis(1.049, 1e-3), {}, "consistent"),
        (of_one_axis(1.051, 1e-3), {}, "not consistent"),
        (of_one_axis(1 / 1.049, 1e-3), {}, "consistent"),
        (of_one_axis(1 / 1.051, 1e-3), {}, "not consistent"),
        (of_one_axis(1 + 0.99 * scipy.stats.t.ppf(0.9995, 299) * 0.1, 0.1), {}, "consistent"),
        (of_one_axis(1 + 1.01 * scipy.stats.t.ppf(0.9995, 299) * 0.1, 0.1), {}, "not consistent"),
        # A band of a quarter of what is expected tells too little.
        (of_one_run(3.0, 0.749, 500.0), {"runs": 1}, "consistent"),
        (of_one_run(3.0, 0.751, 500.0), {"runs": 1}, "undecided"),
        # From fewer than 100 independent samples of one run a band is what one in 500 lies beyond.
        (of_one_run(3.0, 0.3, 100.0), {"runs": 1}, "consistent"),
        (of_one_run(3.0, 0.3, 99.0), {"runs": 1}, "undecided"),
        (of_one_run(3 + 0.99 * 0.3 * WIDER[0], 0.3, 60.0), {"runs": 1}, "undecided"),
        (of_one_run(3 + 1.01 * 0.3 * WIDER[0], 0.3, 60.0), {"runs": 1}, "over-confident"),
        (of_one_run(3 - 0.99 * 0.3 * WIDER[1], 0.3, 99.0), {"runs": 1}, "undecided"),
        (of_one_run(3 - 1.01 * 0.3 * WIDER[1], 0.3, 99.0), {"runs": 1}, "under-confident"),
        (of_one_run(3.31, 0.3, 100.0), {"runs": 1}, "over-confident"),
    ],
)
def test_words_change_where_they_are_said_to(of, basis, begins):
    assert said(of, **basis).startswith(f"{begins}: ")


def test_twenty_steps_of_one_run_and_any_of_several_get_a_verdict():
    assert not consistency.verdict(means(), Basis(runs=1, steps=20)).startswith("no verdict")
    assert not consistency.verdict(means(), Basis(runs=2, steps=2)).startswith("no verdict")


@pytest.mark.parametrize(("apart", "share"), [(1.049, True), (1.051, False)])
def test_axes_within_5_percent_share_a_factor(apart, share):
    assert ("covariance " in said(means(6.0, (2.0, 2.0, 2.0 * apart), error=1e-4))) == share


@pytest.mark.parametrize(("times", "share"), [(0.98, True), (1.02, False)])
def test_axes_share_a_factor_within_the_errors_of_their_ratio(times, share):
    reach = scipy.stats.t.ppf(0.995, 299) * math.hypot(0.1, 0.1)
    axes = (mean(2.0, 0.2, 1.0), mean(2.0, 0.2, 1.0), mean(2.0 * math.exp(times * reach), 0.2, 1.0))
    errors = [axis._replace(standard_error=0.1 * axis.value) for axis in axes]
    assert ("covariance " in said(means(6.0)._replace(axis_nees=tuple(errors)))) == share


def test_correlations_alone_are_blamed_where_the_axes_are_unsure():
    """ANEES 4, two axes apart by more than chance and neither beyond what one of a thousand reaches."""
    axes = (mean(1.2, 0.07, 1.0), mean(0.85, 0.05, 1.0), mean(1.0, 0.01, 1.0))
    text = said(means(4.0)._replace(axis_nees=axes))
    assert text.startswith("over-confident: the axes alone agree, their correlations do not (ANEES 4, 3 expected, ")


@pytest.mark.parametrize(("last", "named"), [(3.74, False), (3.76, True)])
def test_a_phase_stands_out_by_a_quarter(last, named):
    of = means(9.0, (3.0,) * 3, phases=(3.0, 3.0, 3.0, last), error=1e-3)
    assert ("most so from 18.1 to 24 s" in said(of)) == named


def test_a_phase_stands_out_beyond_its_errors():
    reach = scipy.stats.t.ppf(0.995, 299) * math.hypot(0.6, 0.6)  # `means` gives phases twice the error
    for times, named in ((0.98, False), (1.02, True)):
        of = means(30.0, (10.0,) * 3, phases=(3.0, 3.0, 3.0, 3.0 + times * reach), error=0.3)
        assert ("most so" in said(of)) == named


@pytest.mark.parametrize(
    ("value", "text"),
    [(999.4, "999"), (1000.0, "1,000"), (12345.6, "12,346"), (999_999.4, "999,999"), (-2500.0, "-2,500")],
)
def test_numbers_are_readable(value, text):
    assert consistency.readable(value) == text
    assert consistency.readable(value / 1000, 4) == f"{value / 1000:.4g}"


# --- The gate ---


@pytest.mark.parametrize(
    ("rejected", "observations", "streak", "words"),
    [
        (0, 19, 0, "the gate rejected"),  # of fewer than 20 nothing is said
        (19, 19, 19, "the gate rejected"),
        (20, 20, 20, "locked out: "),
        (10, 100, 10, "locked out: "),  # ten one after the other, a tenth of all
        (9, 90, 9, "too tight: "),
        (11, 111, 11, "too tight: "),  # eleven, less than a tenth
        (503, 1000, 0, "too tight: "),
        (560, 1000, 0, "locked out: "),
    ],
)
def test_a_gate_is_judged_from_20_observations_and_locked_by_a_streak_of_10(rejected, observations, streak, words):
    assert consistency.gate_verdict(1 - rejected / observations, 0.99, observations, streak).startswith(words)


@pytest.mark.parametrize(
    ("rate", "nominal", "begins"),
    [
        (0.7, None, "no gate: every observation is used"),
        (math.nan, 0.99, "nothing observed: the gate was never asked"),
        (0.3, 0.99, "locked out: the gate rejected 70 % of the observations, 1 % expected"),
        (0.96, 0.99, "too tight: the gate rejected 4 % of the observations, 1 % expected"),
        (0.998, 0.99, "too loose: the gate rejected 0.2 % of the observations, 1 % expected"),
        (0.988, 0.99, "the gate rejected 1.2 % of the observations, 1 % expected"),
        (0.4, 0.4, "the gate rejected 60 % of the observations, 60 % expected"),
        (0.1, 0.4, "locked out: the gate rejected 90 % of the observations, 60 % expected"),
        # Off is half as many refusals again, or a third fewer.
        (0.8501, 0.9, "the gate"),
        (0.8499, 0.9, "too tight: "),
        (0.9332, 0.9, "the gate"),
        (0.9334, 0.9, "too loose: "),
        (0.4501, 0.9, "too tight: "),
        (0.4499, 0.9, "locked out: "),
    ],
)
def test_the_gate_s_verdict(rate, nominal, begins):
    assert consistency.gate_verdict(rate, nominal).startswith(begins)


@pytest.mark.parametrize(
    ("rejected", "observations", "word"),
    [
        (0, 100, None),  # a good filter shows none in 37 studies of 100
        (0, 1000, "too loose"),
        (2, 40, None),
        (8, 100, "too tight"),
        (60, 100, "too tight"),  # half of them may be let in
        (80, 100, "locked out"),
        (1, 1, None),
        (29_000, 1_000_000, "too tight"),
        (11_000, 1_000_000, None),  # significant, and no one need mind
    ],
)
def test_few_observations_do_not_condemn_a_gate_and_many_do(rejected, observations, word):
    text = consistency.gate_verdict(1 - rejected / observations, 0.99, observations)
    assert text.startswith(f"{word}: " if word else "the gate rejected")
    low, high = scipy.stats.binomtest(rejected, observations).proportion_ci(0.95, method="exact")
    assert f"[{100 * low:.3g}, {100 * high:.3g}] of {observations:,} observations" in text


@pytest.mark.parametrize(
    ("rejected", "streak", "word"),
    [(500, 500, "locked out"), (150, 150, "locked out"), (500, 20, "locked out"), (300, 30, "too tight")],
)
def test_the_longest_streak_tells_a_filter_that_is_locked_out(rejected, streak, word):
    text = consistency.gate_verdict(1 - rejected / 1000, 0.99, 1000, streak)
    if (rejected, streak) == (500, 20):
        assert text.startswith("too tight")  # half of them let in, between the others
    else:
        assert text.startswith(f"{word}: ")
    assert (f"{streak:,} one after the other" in text) == (streak >= 100)


def test_a_good_gate_is_condemned_in_at_most_5_studies_of_100():
    for observations in (10, 50, 200, 1000, 10_000):
        counts = np.arange(observations + 1)
        chance = scipy.stats.binom.pmf(counts, observations, 0.01)
        likely = counts[chance > 1e-12]
        condemned = [
            not consistency.gate_verdict(1 - count / observations, 0.99, observations).startswith("the gate")
            for count in likely
        ]
        assert chance[likely][np.array(condemned)].sum() <= 0.05
