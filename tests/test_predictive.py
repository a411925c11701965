"""One scan ahead: the log-loss against plain loops, its derivatives against differences."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from jaxlocmap import GridSpec
from jaxlocmap.mapping.predictive import BINS, predict_scans, scan_log_loss
from jaxlocmap.types import Scanner

SPEC = GridSpec(origin=(-1.0, -2.0), resolution=0.25, shape=(24, 20), l_min=-3.0, l_max=2.5)
ANGLES = np.linspace(-1.5, 1.5, 7)
LIMITS = {"min_range": 0.05, "max_range": 3.0}
L_OCC, L_FREE = 0.9, -0.6


def scanner():
    return Scanner(jnp.asarray(ANGLES), **LIMITS)


def drive(steps=9):
    rng = np.random.default_rng(3)
    poses = np.column_stack([rng.uniform(-0.5, 3.5, steps), rng.uniform(-1.5, 3.5, steps), rng.uniform(-3, 3, steps)])
    poses[4] = (9.0, 9.0, 0.0)  # off the map
    ranges = rng.uniform(0.3, 3.4, (steps, len(ANGLES)))
    ranges[2, 3], ranges[5, 1] = np.nan, 0.01
    return poses, ranges


def in_plain_loops(l_occ, l_free, counted):
    """Log-loss, number of cells, and the bins. How often beams cross and end in each cell comes from maps of ones."""
    sizes = {"origin": SPEC.origin, "resolution": SPEC.resolution, **LIMITS}
    free_range = {"l_min": -1e9, "l_max": 1e9}
    none = np.zeros(SPEC.shape)
    log_odds, loss, cells, bins = none.copy(), 0.0, 0.0, np.zeros((3, 10))
    for pose, ranges, counts in zip(*drive(), counted, strict=True):
        crossed = reference.update_scan(none, pose, ranges, ANGLES, l_occ=0.0, l_free=1.0, **sizes, **free_range)
        ended = reference.update_scan(none, pose, ranges, ANGLES, l_occ=1.0, l_free=0.0, **sizes, **free_range)
        p = reference.probability(log_odds)
        if counts:
            loss -= float(np.sum(crossed * np.log(1 - p)) + np.sum(ended * np.log(p)))
            cells += float(crossed.sum() + ended.sum())
            row = np.floor(p * 10).astype(int).ravel()
            for b, amount in zip(bins, (crossed + ended, (crossed + ended) * p, ended), strict=True):
                b += np.bincount(row, amount.ravel(), 10)
        bounds = {"l_min": SPEC.l_min, "l_max": SPEC.l_max}
        log_odds = reference.update_scan(log_odds, pose, ranges, ANGLES, l_occ=l_occ, l_free=l_free, **sizes, **bounds)
    return loss, cells, bins


@functools.partial(jax.jit, static_argnames="bins")
def of_drive(l_occ, l_free, counted, poses, ranges, bins):
    return predict_scans(l_occ, l_free, poses, ranges, counted, scanner=scanner(), spec=SPEC, bins=bins)


def predicted(l_occ, l_free, counted, bins=False):
    given = (jnp.asarray(np.asarray(x), jnp.result_type(float)) for x in (l_occ, l_free, *drive()))
    l_occ, l_free, *scans = given
    return of_drive(l_occ, l_free, jnp.asarray(counted), *scans, bins=bins)


loss_of_scan = jax.jit(functools.partial(scan_log_loss, scanner=scanner(), spec=SPEC))


@pytest.mark.parametrize("counted", [np.ones(9, bool), np.arange(9) >= 5])
def test_it_is_what_plain_loops_give(counted, tolerance):
    got = predicted(L_OCC, L_FREE, counted)
    loss, cells, _ = in_plain_loops(L_OCC, L_FREE, counted)
    assert float(got.cells) == cells > 50
    assert not np.any(got[2:])
    assert float(got.log_loss) == pytest.approx(loss, rel=tolerance(1e-12, 1e-5))


def test_a_map_that_knows_nothing_pays_log_two_a_cell(tolerance):
    poses, ranges = drive()
    args = (jnp.zeros(SPEC.shape), *map(jnp.asarray, (poses[0], ranges[0])))
    loss, cells = loss_of_scan(*args)
    assert float(loss) == pytest.approx(float(cells) * np.log(2), rel=tolerance(1e-13, 1e-6))


@pytest.mark.parametrize("counted", [np.ones(9, bool), np.arange(9) % 3 > 0])
def test_bins_are_those_of_plain_loops(counted, tolerance):
    """Over the scans that count, in tenths of probability; what was never seen lies at 0.5, in the sixth."""
    got = predicted(L_OCC, L_FREE, counted, bins=True)
    loss, cells, bins = in_plain_loops(L_OCC, L_FREE, counted)
    assert BINS == 10
    assert float(got.cells) == cells == bins[0].sum()
    assert float(got.log_loss) == pytest.approx(loss, rel=tolerance(1e-12, 1e-5))
    assert np.count_nonzero(bins[0]) > 4
    for found, expected in zip((got.bin_cells, got.bin_probability, got.bin_hits), bins, strict=True):
        np.testing.assert_allclose(found, expected, rtol=tolerance(1e-12, 1e-4), atol=1e-6)


@pytest.mark.parametrize(("beyond", "bound"), [(99.0, 2.5), (-99.0, -3.0)])
def test_what_lies_beyond_the_bounds_counts_as_at_them(beyond, bound):
    poses, ranges = drive()
    args = tuple(map(jnp.asarray, (poses[0], ranges[0])))
    losses = [loss_of_scan(jnp.full(SPEC.shape, x), *args) for x in (beyond, bound)]
    assert losses[0] == losses[1]


def test_derivatives_are_those_of_the_loops(x64):
    counted, h = np.ones(9, bool), 1e-6
    scans = (jnp.array(x) for x in (counted, *drive()))
    slope = jax.jit(jax.grad(lambda *x: of_drive(*x, bins=False).log_loss, (0, 1)))(
        jnp.array(L_OCC), jnp.array(L_FREE), *scans
    )
    up, down = in_plain_loops(L_OCC + h, L_FREE, counted)[0], in_plain_loops(L_OCC - h, L_FREE, counted)[0]
    assert float(slope[0]) == pytest.approx((up - down) / (2 * h), rel=1e-6)
    up, down = in_plain_loops(L_OCC, L_FREE + h, counted)[0], in_plain_loops(L_OCC, L_FREE - h, counted)[0]
    assert float(slope[1]) == pytest.approx((up - down) / (2 * h), rel=1e-6)


def test_shapes_that_do_not_fit_are_named():
    amounts = jnp.array(0.9), jnp.array(-0.6)
    poses, ranges = (jnp.asarray(x) for x in drive())
    with pytest.raises(ValueError, match=r"ranges: expected shape \(9, 7\), got \(8, 7\)"):
        predict_scans(*amounts, poses, ranges[:8], jnp.ones(9, bool), scanner=scanner(), spec=SPEC)
