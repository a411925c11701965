"""What a filter can be tuned for. Each loss is a pure function of parameters and a batch; an `Objective` is a
weighted sum of them over one run of the filter.

An observation that the gate refuses is judged all the same: it pays in `innovation_nll` what an outlier pays and in
`nis` for its distance, so that refusing is no way to win; and what is paid grows ever more slowly with the distance, so
that one false reading does not outweigh a thousand good ones. What it pays is smooth across the gate. What its decision
does to the steps that follow is not, and no derivative sees it: tune with a gate that weighs
(`Config.gate_temperature`).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special

from jaxlocmap import consistency, sensors
from jaxlocmap._internal.linalg import Matrix, ldl
from jaxlocmap.mapping.predictive import PredictiveScore, predict_scans
from jaxlocmap.parameters import Block, Params
from jaxlocmap.se2 import POSE
from jaxlocmap.sensors import Sensor
from jaxlocmap.tuning.batch import Batch, in_dtype_of
from jaxlocmap.tuning.filtering import Judged, check_batch, filtered
from jaxlocmap.tuning.forward import forward
from jaxlocmap.tuning.parameters import SENSOR_MODEL, blocks_of, check_names
from jaxlocmap.types import Config, Info

OUTLIER_SHARE = 0.01  # of observations, what `innovation_nll` allows for
LEVER = 1.0  # m: a heading error of 1 rad counts in `mse` as a position error of this
_TWO_EQUATIONS = ("nees", "nis")  # which compare a mean and a spread
_FAR = 1e-4  # share of good values beyond which `nees` and `nis` count distances by their logarithm


class _Step(NamedTuple):
    """What losses may look at, of one step of one sequence."""

    info: Info
    truth: jax.Array | None
    sensor: Sensor
    max_range: float


class _Loss(NamedTuple):
    needs: str  # "observations", "truth" or "scans"
    tally: Callable[[_Step], tuple[jax.Array, ...]]  # what a step adds up; the last entry counts
    value: Callable[[tuple[jax.Array, ...], int], jax.Array]  # of the sums over all that is counted; degrees of NIS


def innovation_nll(params: Params, batch: Batch, *, config: Config) -> jax.Array:
    """Negative log-likelihood of the innovations, the mean over observations. Needs no truth.

        -log[ (1 - e) N(r; 0, S) + e / (2 pi max_range) ],   e = 0.01,   of range and bearing

    The second term is the density of a false reading, anywhere within `config.max_range` and at any angle: 1 / (2 pi)
    for each component that is an angle, 1 / max_range for each other. It is what a refused
    observation comes to, and for the good ones it makes no difference. Where errors are correlated in time this loss
    does not see it: the innovations look right while the pose is over-confident. Then tune with truth.

    Args:
        params: the filter's.
        batch: with observations.
        config: the filter's.

    Returns:
        () nats; NaN where nothing is observed. Source: Schweppe 1965 (the likelihood of innovations); Box & Tiao 1968
        (the mixture).
    """
    return _alone("innovation_nll", params, batch, config)


def pose_nll(params: Params, batch: Batch, *, config: Config) -> jax.Array:
    """Negative log density of the true pose under the belief, the mean over steps with truth.

        1/2 [ eᵀ P⁻¹ e + log |P| + 3 log 2 pi ]

    It rewards accuracy and honesty at once: at its minimum over a common scale of all covariances the mean NEES is 3.

    Args, returns: as in `innovation_nll`, of a batch with truth. Source: Abbeel et al. 2005, section 3.
    """
    return _alone("pose_nll", params, batch, config)


def mse(params: Params, batch: Batch, *, config: Config) -> jax.Array:
    """Squared error of the pose, the mean over steps with truth: e_x² + e_y² + (1 m · e_theta)².

    It asks for accuracy alone. The gain of a filter hangs on ratios of its noise, so the scale of the covariance is
    left where it was.

    Args, returns: as in `innovation_nll`, in m², of a batch with truth. Source: Greenberg, Yannay & Mannor 2023.
    """
    return _alone("mse", params, batch, config)


def nees(params: Params, batch: Batch, *, config: Config) -> jax.Array:
    """How far the normalised errors of the pose are from what an honest filter shows, in mean and in spread.

        (m - m_chi)² + (s - s_chi)²

    m and s are mean and standard deviation of sqrt(NEES) over steps with truth, and m_chi, s_chi those of χ with 3
    degrees. A filter that is too modest half of the time and too sure the other half has the right mean and the wrong
    spread. Beyond the 0.9999 quantile distances grow with their logarithm, so that a lost run does not decide.

    Two equations tell two parameters at most; with more there are filters without number that meet them.

    Args, returns: as in `innovation_nll`, dimensionless, of a batch with truth. Source: Gelbrich 1990 (a lower bound
    of the squared Wasserstein distance, met if both distributions have one shape).
    """
    return _alone("nees", params, batch, config)


def nis(params: Params, batch: Batch, *, config: Config) -> jax.Array:
    """As `nees`, of the normalised innovations: χ with the sensor's dimension for degrees, over all observations, let
    in or not. Needs no truth.

    Args, returns: as in `innovation_nll`, dimensionless.
    """
    return _alone("nis", params, batch, config)


def map(params: Params, batch: Batch, *, config: Config) -> jax.Array:
    """Log-loss of each scan under the map before it (`predictive.scan_log_loss`), the mean over cells of beams. Needs
    no truth.

    It hangs on `l_occ` and `l_free`, and on the other parameters through the pose, of which its derivative is zero.

    Args, returns: as in `innovation_nll`, in nats, of a batch with scans; `config` with a grid.
    """
    return _alone("map", params, batch, config)


def _innovation_tally(step: _Step) -> tuple[jax.Array, ...]:
    seen = step.info.row >= 0
    good = step.info.log_likelihood + math.log(1 - OUTLIER_SHARE)
    widths = [2 * math.pi if i in step.sensor.angles else step.max_range for i in range(step.sensor.dim)]
    false = jnp.asarray(math.log(OUTLIER_SHARE / math.prod(widths)), good.dtype)
    return -jnp.sum(jnp.where(seen, jnp.logaddexp(good, false), 0)), jnp.sum(seen).astype(good.dtype)


def _pose_tally(step: _Step) -> tuple[jax.Array, ...]:
    mean, cov = step.info.belief.pose
    error = consistency.pose_error(_truth(step), mean)
    log_det = sum(jnp.log(d) for d in ldl(Matrix.symmetric(cov))[1])
    return 0.5 * (consistency.nees(error, cov) + log_det + POSE * math.log(2 * math.pi)), jnp.ones((), mean.dtype)


def _mse_tally(step: _Step) -> tuple[jax.Array, ...]:
    x, y, yaw = consistency.pose_error(_truth(step), step.info.belief.pose.mean)
    return x * x + y * y + (LEVER * yaw) ** 2, jnp.ones((), x.dtype)


def _nees_tally(step: _Step) -> tuple[jax.Array, ...]:
    mean, cov = step.info.belief.pose
    d = _distance(consistency.nees(consistency.pose_error(_truth(step), mean), cov), POSE)
    return d, d * d, jnp.ones((), d.dtype)


def _nis_tally(step: _Step) -> tuple[jax.Array, ...]:
    seen = step.info.row >= 0
    d = jnp.where(seen, _distance(jnp.where(seen, step.info.nis, 1), step.sensor.dim), 0)
    return jnp.sum(d), jnp.sum(d * d), jnp.sum(seen).astype(d.dtype)


def _truth(step: _Step) -> jax.Array:
    if step.truth is None:
        raise ValueError("batch.truth: expected the true poses (N, T, 3), which this loss needs, got None")
    return step.truth


def _distance(squared: jax.Array, degrees: int) -> jax.Array:
    """The root of a squared Mahalanobis distance, beyond the far quantile growing with its logarithm."""
    d = jnp.sqrt(jnp.maximum(squared, 1e-12))  # at zero a root has no derivative
    far = math.sqrt(consistency.chi2_quantile(1 - _FAR, degrees))
    return jnp.where(d > far, far + jnp.log1p(jnp.maximum(d - far, 0)), d)


def _mean(sums: tuple[jax.Array, ...], degrees: int) -> jax.Array:
    del degrees
    return sums[0] / sums[1]


def _from_chi(sums: tuple[jax.Array, ...], degrees: int) -> jax.Array:
    mean, square = sums[0] / sums[2], sums[1] / sums[2]
    spread = jnp.sqrt(jnp.maximum(square - mean * mean, 1e-12))
    expected = math.sqrt(2) * math.exp(
        float(scipy.special.gammaln((degrees + 1) / 2) - scipy.special.gammaln(degrees / 2))
    )
    return (mean - expected) ** 2 + (spread - math.sqrt(degrees - expected**2)) ** 2


LOSSES: Mapping[str, _Loss] = {
    "innovation_nll": _Loss("observations", _innovation_tally, _mean),
    "pose_nll": _Loss("truth", _pose_tally, _mean),
    "mse": _Loss("truth", _mse_tally, _mean),
    "nees": _Loss("truth", _nees_tally, lambda sums, _: _from_chi(sums, POSE)),
    "nis": _Loss("observations", _nis_tally, _from_chi),
    "map": _Loss("scans", lambda step: (), _mean),
}


@dataclasses.dataclass(frozen=True)
class Objective:
    """A weighted sum of losses: `objective(params, batch) -> (total (), {loss: ()})`. Hashable, static under jit.

    Raises:
        ValueError: no loss, an unknown one, a weight that is not positive, or `map` without a grid.
    """

    config: Config
    weights: tuple[tuple[str, float], ...]

    def __post_init__(self) -> None:
        if not self.weights:
            raise ValueError(f"weights: expected at least one of {sorted(LOSSES)}, got none")
        for name, weight in self.weights:
            if name not in LOSSES:
                raise ValueError(f"loss: expected one of {sorted(LOSSES)}, got {name!r}")
            if not (math.isfinite(weight) and weight > 0):
                raise ValueError(f"weight of {name}: expected a positive number, got {weight}")
        if "map" in self.names and self.config.grid is None:
            raise ValueError("config.grid: expected the GridSpec of the map, which the loss `map` needs, got None")

    @property
    def sensor(self) -> Sensor:
        """The filter's."""
        return sensors.resolve(self.config.sensor)

    @property
    def blocks(self) -> tuple[Block, ...]:
        """The blocks of parameters that the filter has."""
        return blocks_of(self.config)

    @property
    def names(self) -> tuple[str, ...]:
        """The losses, in order."""
        return tuple(name for name, _ in self.weights)

    def __call__(self, params: Params, batch: Batch) -> tuple[jax.Array, dict[str, jax.Array]]:
        """The weighted sum, and each loss."""
        return self.value(jax.tree.map(jnp.sum, self.tallies(params, batch)[0]))

    def tallies(self, params: Params, batch: Batch) -> tuple[dict[str, tuple[jax.Array, ...]], jax.Array | None]:
        """What every sequence adds to every loss, (N,) each; and (N,) how many of its observations the gate lets in,
        None where no filter is run.
        """
        return _tallies(params, batch, self.config, self.names)

    def value(self, sums: dict[str, tuple[jax.Array, ...]]) -> tuple[jax.Array, dict[str, jax.Array]]:
        """What a call returns, of the tallies' sums over sequences."""
        terms = {name: LOSSES[name].value(sums[name], self.sensor.dim) for name in self.names}
        return jnp.asarray(sum(weight * terms[name] for name, weight in self.weights)), terms

    def judged(self, params: Params, batch: Batch) -> tuple[float, dict[str, float]]:
        """What a call returns, as numbers: compiled once for every shape of the batch."""
        total, terms = self.value(jax.tree.map(jnp.sum, _tallied(self, in_dtype_of(batch, params), batch)[0]))
        return float(total), {name: float(term) for name, term in terms.items()}

    def check_tuned(self, tuned: tuple[str, ...]) -> None:
        """Raise if so many parameters cannot be told apart by these losses.

        `nees` and `nis` compare a mean and a spread with those of χ. Two equations carry two parameters of the noise;
        the loss is zero along whole surfaces of three or more.

        Raises:
            ValueError: nothing to tune, a name that is no parameter, or more than two of the noise for these alone.
        """
        check_names(tuned, self.blocks)
        noise = [name for name in tuned if name not in SENSOR_MODEL]
        of_filter = [name for name in self.names if name != "map"]
        if len(noise) > 2 and of_filter and set(of_filter) <= set(_TWO_EQUATIONS):
            raise ValueError(
                f"tuned: the loss `{'`, `'.join(of_filter)}` compares a mean and a spread, two equations, which tell "
                f"no more than two parameters: expected one or two of the noise, or `pose_nll`, `innovation_nll` or "
                f"`mse` beside it, got {', '.join(noise)}"
            )

    def check(self, params: Params, batch: Batch) -> None:
        """Raise if there is nothing to tune on (`check_batch`), or if the start cannot be judged (`check_start`).

        Raises:
            ValueError: as these.
        """
        self.check_batch(batch)
        self.check_start(batch, *_tallied(self, in_dtype_of(batch, params), batch))

    def check_batch(self, batch: Batch) -> None:
        """Raise if there is nothing to tune on.

        Raises:
            ValueError: fields that do not fit; a loss whose observations, truth or scans are not there.
        """
        check_batch(batch)
        observed = _observed(batch)
        for name in self.names:
            needs = LOSSES[name].needs
            if needs == "truth" and batch.truth is None:
                raise ValueError(f"batch.truth: expected the true poses, which the loss `{name}` needs, got None")
            known = True if batch.known is None else np.asarray(batch.known)
            if needs == "truth" and not np.any(known & np.asarray(batch.counted)):
                raise ValueError(f"batch.truth: expected a step with a known pose for the loss `{name}`, got none")
            if needs == "observations" and not observed.any():
                raise ValueError(f"batch.inputs.valid: expected an observation for the loss `{name}`, got none")
            if needs == "scans" and (batch.inputs.ranges is None or batch.beam_angles is None):
                raise ValueError(f"batch.inputs.ranges: expected scans, which the loss `{name}` needs, got None")

    def check_start(self, batch: Batch, sums: dict[str, tuple[jax.Array, ...]], accepted: jax.Array | None) -> None:
        """Raise if the start cannot be judged. sums, accepted: the `tallies` there.

        Raises:
            ValueError: a filter that refuses everything; a loss that is not finite, with the number of sequences at
                fault.
        """
        observed = _observed(batch)
        if accepted is not None and observed.any() and not np.any(np.asarray(accepted)):
            raise ValueError(
                f"config.gate_probability: at the start the gate refuses all {int(observed.sum())} observations, so "
                "nothing corrects the pose: expected a start with wider Q or R, or no gate (None)"
            )
        for name, columns in sums.items():
            bad = ~np.all([np.isfinite(np.asarray(x)) for x in columns], axis=0)
            if bad.any():
                raise ValueError(
                    f"loss `{name}`: expected a finite value at the start, got none for {int(bad.sum())} of {len(bad)} "
                    f"sequences, the first being number {int(np.argmax(bad))}"
                )


@functools.partial(jax.jit, static_argnums=0)
def _tallied(objective: Objective, params: Params, batch: Batch) -> tuple[dict[str, Any], jax.Array | None]:
    return objective.tallies(params, batch)


def _observed(batch: Batch) -> np.ndarray:
    """(N, T, M) bool: what counts of the observations."""
    return np.asarray(batch.inputs.valid) & np.asarray(batch.counted)[..., None]


def _tallies(
    params: Params, batch: Batch, config: Config, names: tuple[str, ...]
) -> tuple[dict[str, tuple[jax.Array, ...]], jax.Array | None]:
    """The tallies, and how many observations of each sequence the gate lets in, if the filter is run at all."""
    sensor = sensors.resolve(config.sensor)
    of_filter = tuple(name for name in names if name != "map")

    def collect(info: Info, aside: Judged) -> Any:
        sums = {}
        for name in of_filter:
            judged = aside.counted
            if LOSSES[name].needs == "truth" and aside.known is not None:
                judged = judged & aside.known
            sums[name] = tuple(
                jnp.where(judged, x, 0) for x in LOSSES[name].tally(_Step(info, aside.truth, sensor, config.max_range))
            )
        means = info.belief.pose.mean if "map" in names and batch.poses is None else ()
        return sums, jnp.sum(info.accepted & aside.counted), means

    poses, accepted = batch.poses, None
    sums: dict[str, Any] = {}
    if of_filter or poses is None:
        per_step, let_in, means = filtered(params, batch, config=config, collect=collect)
        sums = {name: tuple(jnp.sum(x, axis=1) for x in columns) for name, columns in per_step.items()}
        poses, accepted = means if poses is None else poses, jnp.sum(let_in, axis=1)
    if "map" in names:
        # Reverse mode would keep a map of every step; the map has two parameters, so two more maps will do.
        amounts, data = (jnp.asarray(params.l_occ), jnp.asarray(params.l_free)), (batch, jax.lax.stop_gradient(poses))
        total = forward(lambda amounts, data: predictive_score(*amounts, *data, config=config))(amounts, data)
        sums["map"] = total.log_loss, total.cells
    return sums, accepted


def predictive_score(
    l_occ: jax.Array, l_free: jax.Array, batch: Batch, poses: jax.Array, *, config: Config, bins: bool = False
) -> PredictiveScore:
    """`predictive.predict_scans` over every sequence.

    Args:
        l_occ, l_free: () nats, > 0 and < 0.
        batch: with scans.
        poses: (N, T, 3) m, m, rad, where to map them.
        config: static, with a grid.
        bins: fill the bins too.

    Returns:
        `PredictiveScore` with a leading axis N.

    Raises:
        ValueError: no grid, scans or beams; a wrong shape.
    """
    spec = config.grid
    if spec is None or batch.inputs.ranges is None or batch.beam_angles is None:
        raise ValueError("loss `map`: expected config.grid, batch.inputs.ranges and batch.beam_angles, got None")

    scanner = config.scanner(jnp.asarray(batch.beam_angles))

    def one(poses: jax.Array, ranges: jax.Array, counted: jax.Array) -> PredictiveScore:
        return predict_scans(l_occ, l_free, poses, ranges, counted, scanner=scanner, spec=spec, bins=bins)

    return jax.vmap(one)(jnp.asarray(poses), batch.inputs.ranges, batch.counted)


def _alone(name: str, params: Params, batch: Batch, config: Config) -> jax.Array:
    return Objective(config, ((name, 1.0),))(params, batch)[0]
