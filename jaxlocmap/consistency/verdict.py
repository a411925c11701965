"""What the statistics say in words: verdicts on a covariance and on a gate, which say what they rest on."""

from __future__ import annotations

import math
from typing import NamedTuple

from jaxlocmap.consistency.means import Mean, binomial_interval, ratio, student_t
from jaxlocmap.consistency.report import AXES, PoseMeans
from jaxlocmap.se2 import POSE

_TOLERANCE = 0.01  # a misfit that is there, and that no one need mind
_LITTLE = 1.25  # up to such a factor an exact start or a gate may be what moves the ANEES,
_LITTLE_AXIS = 1.5  # and up to such a one, that of a single axis
_ALIKE = 1.05  # axes whose variances are off by factors this close share one
_SURE = 0.999  # what an axis is found wrong with, there being three of them
_WIDE = 0.25  # of what is expected: a band this wide tells little
_FEW_SAMPLES = 100  # independent ones of a single run: below, its correlation time is itself uncertain
_FEW_STEPS = 20  # of a single run, or observations of a gate: no verdict
_GATE_TOLERANCE = 1.5  # times the refusals expected
_STREAK = 10  # refusals one after the other, of as many as a tenth of all: the filter is locked out


class Basis(NamedTuple):
    """What a verdict has to know beside the means."""

    runs: int
    steps: int  # scored ones of all runs
    diverged: int = 0  # runs
    exact_start: bool = False  # the true start is the prior's mean, of which the filter's prior knows nothing
    gate: bool = False
    reference: PoseMeans | None = None  # of a filter told the robot's own noise: same start, same gate
    reference_diverged: tuple[int, int] = (0, 0)  # its diverged runs, and all its runs


def readable(value: float, digits: int = 3) -> str:
    """A number for people: so many digits, and never a power of ten where there is room for the number."""
    return f"{value:,.0f}" if 10**digits <= abs(value) < 1e9 else f"{value:.{digits}g}"


def verdict(means: PoseMeans, basis: Basis) -> str:
    """What the normalised errors of a pose say about its covariance: which way it is off, by how much, when, and
    what the statement rests on.

    A factor of the covariance is given where the study allows one: without a gate, from a start that is drawn from
    the prior or beside a reference, and where x, y and yaw are off by the same one within their errors. Elsewhere the
    axes are named. What an exact start or a gate does by itself is not blamed on the filter.
    """
    lost, honest_losses = _losses(basis)
    if not basis.steps and basis.diverged:
        return _joined("not consistent: no NEES is finite", lost)
    if basis.diverged and basis.diverged == basis.runs:
        return _joined(f"not consistent: ANEES {readable(means.nees.value, 4)}", lost)
    if not basis.steps or (basis.runs == 1 and basis.steps < _FEW_STEPS):
        return f"no verdict: {basis.steps} scored steps, at least {_FEW_STEPS} of one run expected"
    judged = means.undiverged_nees
    reference = None if basis.reference is None else basis.reference.undiverged_nees
    relative = _relative(judged, reference, POSE)
    expected = POSE if reference is None else reference.value
    low, high = (expected * limit for limit in relative.band_95)
    others = " of the others" if basis.diverged else ""
    stated = f"ANEES {readable(judged.value, 4)}{others}"
    band = f"its 95 % band [{low:.4g}, {high:.4g}]"
    if reference is not None:
        band += f" around {readable(expected, 4)}, that of the same filter told the robot's own noise"
    if basis.runs == 1:
        band += f", {readable(relative.samples, 2)} independent samples"

    half = (relative.band_95[1] - relative.band_95[0]) / 2
    short = basis.runs == 1 and relative.samples < _FEW_SAMPLES
    if short:
        half *= student_t(relative.samples, 0.998) / student_t(relative.samples)
    off = abs(relative.value - 1)
    axes = _wrong_axes(means, basis)
    if not off > half:
        if half > _WIDE or short:
            return _joined(f"undecided: {stated}, {band}: too few to tell", lost)
        if axes and not _disturbed(basis, axes):
            return _joined(f"not consistent: {stated} lies in {band}, but {_in_words(axes, basis)}", lost)
        opening = "consistent" if honest_losses else "not consistent"
        return _joined(f"{opening}: {stated} lies in {band}", lost)
    if off <= _TOLERANCE and honest_losses:
        return _joined(f"consistent within {100 * _TOLERANCE:g} %: {stated}, {band}", lost)
    cause = _cause(basis, relative.value)
    if cause and 1 / _LITTLE < relative.value < _LITTLE and _disturbed(basis, axes):
        return _joined(f"undecided: {stated} lies outside {band}, which {cause} can bring about by itself", lost)

    side = "over-confident" if relative.value > 1 else "under-confident"
    if len({axis.value > 1 for axis in axes.values()}) > 1:
        side = "not consistent"
    if _share_a_factor(means, basis):
        size = f"covariance {_factor(relative)}" if _has_factor(basis) else f"ANEES {readable(relative.value)} times"
        size += "" if _has_factor(basis) else f" what is expected, no factor of the covariance {_behind(basis)}"
    else:
        size = _in_words(axes, basis) if axes else "the axes alone agree, their correlations do not"
    judged_by = f"({stated}, {readable(expected)} expected, {band})"
    return _joined(f"{side}: {size} {judged_by}{_when(means, basis)}", lost)


def _losses(basis: Basis) -> tuple[str, bool]:
    """Diverged runs in words, and whether an honest filter loses as many."""
    if not basis.diverged:
        return "", True
    words = f"{basis.diverged} of {basis.runs} runs diverged"
    count, runs = basis.reference_diverged
    if runs:
        (least, _), (_, most) = binomial_interval(basis.diverged, basis.runs), binomial_interval(count, runs)
        words += f", {count} of {runs} of the filter told the robot's own noise"
        return words, least <= most
    if basis.gate:
        words += ", which a gate can bring about by itself: it refuses what would correct them"
    return words, False


def _has_factor(basis: Basis) -> bool:
    """Whether the ratio of squared error to variance is what the covariance is wrong by.

    A gate answers a wrong covariance by letting in more or less, so that the errors change too; an exact start makes
    the first errors small, by as much as in the reference.
    """
    return not basis.gate and (not basis.exact_start or basis.reference is not None)


def _behind(basis: Basis) -> str:
    return "behind a gate" if basis.gate else "from an exact start"


def _joined(sentence: str, lost: str) -> str:
    return f"{sentence}; {lost}" if lost else sentence


def _relative(mean: Mean, reference: Mean | None, expected: float) -> Mean:
    """A mean over what is expected of it, so that 1 is right."""
    if reference is not None:
        return ratio(mean, reference)
    low, high = mean.band_95
    return Mean(mean.value / expected, mean.standard_error / expected, mean.samples, (low / expected, high / expected))


def _axes(means: PoseMeans, basis: Basis) -> list[Mean]:
    reference = basis.reference.axis_nees if basis.reference is not None else (None,) * POSE
    return [_relative(*pair, 1) for pair in zip(means.axis_nees, reference, strict=True)]


def _wrong_axes(means: PoseMeans, basis: Basis) -> dict[str, Mean]:
    """The axes whose variance is off, beyond its errors and by more than a few per cent."""

    def wrong(axis: Mean) -> bool:
        reach = student_t(axis.samples, _SURE) * axis.standard_error
        return abs(axis.value - 1) > reach and not 1 / _ALIKE < axis.value < _ALIKE

    return {name: axis for name, axis in zip(AXES, _axes(means, basis), strict=True) if wrong(axis)}


def _disturbed(basis: Basis, axes: dict[str, Mean]) -> bool:
    """Whether an exact start, which only lowers, or a gate, which only raises, may be what moves these axes."""
    low = 1 / _LITTLE_AXIS if basis.exact_start else 1.0
    high = _LITTLE_AXIS if basis.gate else 1.0
    return basis.reference is None and all(low < axis.value < high for axis in axes.values())


def _share_a_factor(means: PoseMeans, basis: Basis) -> bool:
    axes = _axes(means, basis)
    for i, one in enumerate(axes):
        for other in axes[:i]:
            if not (one.value > 0 and other.value > 0):
                return False
            error = math.hypot(one.standard_error / one.value, other.standard_error / other.value)
            reach = student_t(min(one.samples, other.samples), 0.99) * error
            if abs(math.log(one.value / other.value)) > max(reach, math.log(_ALIKE)):
                return False
    return True


def _cause(basis: Basis, relative: float) -> str:
    """What may move the ANEES this way without any fault of the filter's, where no reference says how far."""
    if basis.reference is not None:
        return ""
    causes = []
    if basis.exact_start and relative < 1:
        causes.append("an exact start, of which the prior does not know,")
    if basis.gate and (relative > 1 or basis.exact_start):
        causes.append("a gate, which refuses honest observations too,")
    return " or ".join(causes)


def _factor(relative: Mean) -> str:
    """Size and side of a misfit, with its interval."""
    low, high = relative.interval_95
    if relative.value < 1:
        value, low, high = (1 / x if x > 0 else math.inf for x in (relative.value, high, low))
        return f"{_digits(value)} [{_digits(low)}, {_digits(high)}] times too large"
    return f"{_digits(relative.value)} [{_digits(low)}, {_digits(high)}] times too small"


def _digits(factor: float) -> str:
    """Enough of them that a factor beside 1 does not read 1."""
    return f"{factor:.3f}" if 0.9 < factor < 1.1 else readable(factor)


def _in_words(axes: dict[str, Mean], basis: Basis) -> str:
    """The axes that are off, alike ones together."""
    if not _has_factor(basis):
        sizes = ", ".join(f"{name} {readable(axis.value)}" for name, axis in axes.items())
        return f"error² over σ² of {sizes} times what is expected"
    return ", ".join(f"the variance of {name} {_factor(axis)}" for name, axis in axes.items())


def _when(means: PoseMeans, basis: Basis) -> str:
    """Which part of the drive is worst, if one stands out."""
    reference = basis.reference.phases if basis.reference is not None else (None,) * len(means.phases)
    phases = [_relative(*pair, POSE) for pair in zip(means.phases, reference, strict=True)]
    known = [i for i, phase in enumerate(phases) if math.isfinite(phase.value) and phase.value > 0]
    if len(known) < 2:
        return ""
    far = max(known, key=lambda i: abs(math.log(phases[i].value)))
    near = min(known, key=lambda i: abs(math.log(phases[i].value)))
    error = math.hypot(phases[far].standard_error, phases[near].standard_error)
    reach = student_t(min(phases[i].samples for i in (far, near)), 0.99) * error
    if not abs(phases[far].value - phases[near].value) > max(reach, _WIDE * phases[near].value):
        return ""
    begin, end = means.phase_spans[far]
    return f"; most so from {begin:.4g} to {end:.4g} s: NEES {readable(means.phases[far].value)}"


def gate_verdict(
    accept_rate: float, nominal: float | None, observations: int | None = None, longest_streak: int | None = None
) -> str:
    """What the share of observations the gate lets in says.

    Args:
        accept_rate: share let in.
        nominal: the gate's probability; None: there is no gate.
        observations: their number, for an interval of the share (binomial); without it nothing is called significant
            that is not large.
        longest_streak: of observations of one run that the gate refused one after the other.

    Returns:
        A sentence: locked out where a streak takes up a tenth of the observations, or where less than half as many
        pass as should; too tight or too loose where the interval excludes 1.5 times, or 1 / 1.5 of, the refusals
        expected.
    """
    if nominal is None:
        return "no gate: every observation is used"
    if not math.isfinite(accept_rate):
        return "nothing observed: the gate was never asked"
    rejected, expected = 1 - accept_rate, 1 - nominal
    low = high = rejected
    text = f"the gate rejected {100 * rejected:.3g} % of the observations, {100 * expected:.3g} % expected"
    if observations:
        low, high = binomial_interval(round(rejected * observations), observations)
        interval = f" [{100 * low:.3g}, {100 * high:.3g}] of {observations:,}"
        text = f"the gate rejected {100 * rejected:.3g} %{interval} observations, {100 * expected:.3g} % expected"
        if observations < _FEW_STEPS:
            return text
    streak = longest_streak or 0
    stuck = streak >= _STREAK and streak >= 0.1 * (observations or math.inf)
    if stuck or 1 - low < 0.5 * nominal:
        streak_words = f", {streak:,} one after the other" if stuck else ""
        return f"locked out: {text}{streak_words}; the filter is sure of a wrong pose and refuses what would correct it"
    if low > _GATE_TOLERANCE * expected:
        return f"too tight: {text}; innovations are larger than the filter believes"
    if high < expected / _GATE_TOLERANCE:
        return f"too loose: {text}; innovations are smaller than the filter believes"
    return text
