"""What figures show: the numbers handed to matplotlib, the axis they lie on, and what the words beside them say."""

import math
from pathlib import Path

import matplotlib.colors
import numpy as np
import pytest
import scipy.stats
from matplotlib.collections import LineCollection
from matplotlib.patches import Ellipse

from jaxlocmap import GridSpec, plotting
from jaxlocmap.plotting import maps, studies, style, tuning

RNG = np.random.default_rng(0)
LEVELS = (50, 90, 95, 99)


@pytest.fixture
def draw(monkeypatch):
    """Draws a figure and returns it, with no file written."""
    figures = []
    for module in (maps, studies, tuning):
        monkeypatch.setattr(module, "save", lambda figure, path, dpi: figures.append(figure))

    def drawn(function, *args, **kwargs):
        function(Path("nowhere.png"), *args, **kwargs)
        return figures.pop()

    return drawn


def lines(ax, begin):
    """x and y of the lines whose label begins so, in order."""
    return [line.get_xydata().T for line in ax.lines if line.get_label().startswith(begin)]


def line(ax, begin):
    (only,) = lines(ax, begin)
    return only


def colour(ax, begin):
    (only,) = (line.get_color() for line in ax.lines if line.get_label().startswith(begin))
    return only


def band(ax, begin):
    """From where to where a band across the whole axis reaches, upwards."""
    (patch,) = (patch for patch in ax.patches if patch.get_label().startswith(begin))
    box = patch.get_extents().transformed(ax.transData.inverted())
    return box.y0, box.y1


def bars(ax, label):
    """Middles and heights of bars."""
    (group,) = (group for group in ax.containers if group.get_label() == label)
    patches = getattr(group, "patches", [])
    return [p.get_x() + p.get_width() / 2 for p in patches], [p.get_height() for p in patches]


def words(ax):
    return ax.get_title(), ax.get_xlabel(), ax.get_ylabel()


def is_red(rgba):
    return rgba[0] > 2 * rgba[2]


# --- From above ---


@pytest.mark.parametrize(("probability", "said"), [(0.95, "95 %"), (0.5, "50 %")])
def test_ellipses_hold_the_position_with_their_probability_and_lie_as_the_covariance_does(draw, probability, said):
    cov = np.tile(np.eye(3), (7, 1, 1))
    cov[2, :2, :2], cov[6, :2, :2] = [[3, 1.6], [1.6, 1.2]], [[1, -0.9], [-0.9, 2]]
    cov[0, 0, 0] = np.nan
    estimate = RNG.normal(size=(7, 3))
    figure = draw(
        plotting.trajectory_figure,
        *(estimate, cov, None),
        landmarks=np.zeros((1, 2)),
        ellipses=4,
        probability=probability,
    )
    (ax,) = figure.axes
    patches = [patch for patch in ax.patches if isinstance(patch, Ellipse)]
    assert len(patches) == 3  # of steps 0, 2, 4 and 6; that of step 0 has no covariance
    for patch, k in zip(patches, (2, 4, 6), strict=True):
        around = np.linspace(0, 2 * math.pi, 9)
        border = patch.get_patch_transform().transform(np.column_stack([np.cos(around), np.sin(around)]))
        away = border - estimate[k, :2]
        distance = np.einsum("ij,jk,ik->i", away, np.linalg.inv(cov[k, :2, :2]), away)
        np.testing.assert_allclose(distance, scipy.stats.chi2.ppf(probability, 2), rtol=1e-9)
    assert patches[0].get_label() == f"{said} ellipses of the position"
    assert not patches[1].get_label()  # one line in the legend


def test_a_trajectory_has_x_to_the_right_and_y_upwards_at_one_scale(draw):
    estimate, truth, landmarks = (RNG.normal(size=shape) for shape in ((5, 3), (5, 3), (2, 2)))
    walls, cov = RNG.normal(size=(2, 2, 2)), np.tile(np.eye(3), (5, 1, 1))
    how = {"landmarks": landmarks, "segments": walls, "title": "drive"}
    (ax,) = draw(plotting.trajectory_figure, estimate, cov, truth, **how).axes
    np.testing.assert_array_equal(line(ax, "estimate"), estimate[:, :2].T)
    np.testing.assert_array_equal(line(ax, "truth"), truth[:, :2].T)
    np.testing.assert_array_equal(line(ax, "landmarks"), landmarks.T)
    np.testing.assert_array_equal(line(ax, "walls"), walls[0].T)
    assert sum(np.array_equal(drawn.get_xydata(), walls[1]) for drawn in ax.lines) == 1
    assert words(ax) == ("drive", "x [m]", "y [m]")
    assert ax.get_aspect() == 1
    assert sum(isinstance(patch, Ellipse) for patch in ax.patches) == 25
    (ax,) = draw(plotting.trajectory_figure, estimate, cov, None, landmarks=landmarks).axes
    assert not lines(ax, "truth")
    assert not lines(ax, "walls")


def test_a_map_lies_in_the_world_with_rows_upwards_and_what_is_occupied_dark(draw):
    log_odds = np.zeros((3, 5))
    log_odds[1, 3], log_odds[2, 3] = 2.0, -1.0
    poses, truth = RNG.normal(size=(4, 3)), RNG.normal(size=(4, 3))
    spec = GridSpec(origin=(-1.0, 2.0), resolution=0.5, shape=(3, 5))
    figure = draw(plotting.map_figure, log_odds, spec, poses, truth=truth, segments=np.ones((1, 2, 2)), title="hall")
    ax, bar = figure.axes
    (image,) = ax.images
    shown = np.full((3, 5), 0.5)
    shown[1, 3], shown[2, 3] = 1 / (1 + math.exp(-2)), 1 / (1 + math.exp(1))
    np.testing.assert_allclose(image.get_array(), shown, rtol=1e-12)
    assert (image.origin, image.get_extent(), image.get_clim()) == ("lower", [-1.0, 1.5, 2.0, 3.5], (0, 1))
    assert [image.cmap(image.norm(p))[0] for p in (0.0, 1.0)] == [1, 0]
    # Half a cell around what was seen, no further than the map.
    np.testing.assert_allclose(ax.get_xlim(), (-1 + 0.5 * 2.5, -1 + 0.5 * 4.5), rtol=1e-12)
    np.testing.assert_allclose(ax.get_ylim(), (2 + 0.5 * 0.5, 2 + 0.5 * 3), rtol=1e-12)
    np.testing.assert_array_equal(line(ax, "path the map was made from"), poses[:, :2].T)
    np.testing.assert_array_equal(line(ax, "truth"), truth[:, :2].T)
    np.testing.assert_array_equal(line(ax, "walls"), np.ones((2, 2)))
    assert words(ax) == ("hall", "x [m]", "y [m]")
    assert bar.get_ylabel() == "probability of being occupied [–], 0.5 = never seen"


def test_the_margin_of_a_large_map_is_a_twentieth_of_what_was_seen(draw):
    log_odds = np.zeros((100, 300))
    log_odds[20, 40] = log_odds[60, 240] = 1.0  # 200 cells apart, so 10 cells of margin
    spec = GridSpec(origin=(0.0, 0.0), resolution=0.1, shape=(100, 300))
    ax, _ = draw(plotting.map_figure, log_odds, spec, np.zeros((1, 3))).axes
    np.testing.assert_allclose(ax.get_xlim(), (3.0, 25.1), rtol=1e-12)
    np.testing.assert_allclose(ax.get_ylim(), (1.0, 7.1), rtol=1e-12)


def test_a_map_of_nothing_is_shown_whole(draw):
    spec = GridSpec(origin=(0.0, 1.0), resolution=1.0, shape=(2, 4))
    ax, _ = draw(plotting.map_figure, np.zeros((2, 4)), spec, np.zeros((1, 3))).axes
    assert (ax.images[0].get_extent(), *ax.get_xlim()) == ([0, 4, 1, 3], 0, 4)


# --- Studies ---


def study(steps=6, runs=40, **fields):
    """A report with a number of its own in every place."""
    error, sigma = RNG.uniform(1, 2, size=(2, steps, 3))
    shares = {f"coverage_{level}": level / 100 - 0.03 for level in LEVELS}
    return {
        "steps": steps,
        "runs": runs,
        "time": (10 + 0.5 * np.arange(steps)).tolist(),
        "nees_band_95": (2.2, 3.9),
        "nees_per_step": RNG.uniform(2, 4, steps).tolist(),
        "anees": 3.456,
        "nis_per_step": [None, 2.1, None, 1.9, 2.3, None][:steps],
        "nis_chi2_band_95": [None, (1.5, 2.5), None, (1.4, 2.6), (1.3, 2.7), None][:steps],
        "rmse_per_step": error.tolist(),
        "sigma_per_step": sigma.tolist(),
        "dishonest": [],
        "verdict": "consistent",
        **shares,
        **{f"{name}_interval_95": (share - 0.01, share + 0.02) for name, share in shares.items()},
        **fields,
    }


def check_errors(ax, report, time, over):
    for name, unit, columns in (("position", "m", [0, 1]), ("heading", "rad", [2])):
        for field, label in (
            ("rmse_per_step", f"{name}: error{over} [{unit}]"),
            ("sigma_per_step", f"{name}: the filter's own σ [{unit}]"),
        ):
            x, y = line(ax, label)
            np.testing.assert_allclose(x, time, rtol=1e-12)
            expected = np.sqrt(np.sum(np.array(report[field])[:, columns] ** 2, axis=1))
            np.testing.assert_allclose(y, expected, rtol=1e-12, err_msg=label)
    assert words(ax)[1:] == ("time [s]", "[m] or [rad]")
    assert colour(ax, "position: error") == colour(ax, "position: the") != colour(ax, "heading: error")


def check_coverage(ax, report):
    place, expected = bars(ax, "expected")
    np.testing.assert_allclose(expected, LEVELS, rtol=1e-12)
    beside, measured = bars(ax, "measured, 95 % interval")
    np.testing.assert_allclose(measured, np.array(LEVELS) - 3, rtol=1e-12)
    (reach,) = ax.collections
    ends = [100 * np.array(report[f"coverage_{level}_interval_95"]) for level in LEVELS]
    np.testing.assert_allclose([segment[:, 1] for segment in reach.get_segments()], ends, rtol=1e-9)
    np.testing.assert_allclose([segment[:, 0].mean() for segment in reach.get_segments()], beside, rtol=1e-12)
    texts = [(text.get_position()[0], float(text.get_text())) for text in ax.texts]
    np.testing.assert_allclose(texts, np.column_stack([beside, measured]), rtol=1e-9)
    assert [text.get_text() for text in ax.get_xticklabels()] == [f"{level} %" for level in LEVELS]
    np.testing.assert_allclose(ax.get_xticks(), (np.array(place) + beside) / 2, atol=1e-12)
    assert ax.get_ylabel() == "[%]"


def test_a_study_shows_nees_nis_errors_and_coverage_over_time(draw):
    report = study(scenario="loop", motion="arc")
    figure = draw(plotting.study_figure, report, 0.1)
    nees, nis, errors, coverage = figure.axes
    time = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])  # a step ends dt after it began
    np.testing.assert_allclose(line(nees, "mean of 40 runs"), [time, report["nees_per_step"]], rtol=1e-12)
    np.testing.assert_allclose(band(nees, "95 % band, χ²(3·40)/40"), (2.2, 3.9), rtol=1e-9)
    np.testing.assert_array_equal(line(nees, "ANEES 3.46 over all steps")[1], 3.456)
    assert any(list(drawn.get_ydata()) == [3, 3] for drawn in nees.lines)
    assert nees.get_ylim()[0] == 0
    np.testing.assert_allclose(line(nis, "mean over observations"), [time[[1, 3, 4]], [2.1, 1.9, 2.3]], rtol=1e-12)
    (filled,) = nis.collections
    assert filled.get_label() == "95 % band, χ²(2·n)/n"
    corners = {tuple(np.round(corner, 9)) for corner in filled.get_paths()[0].vertices}
    assert {(0.2, 1.5), (0.2, 2.5), (0.4, 1.4), (0.4, 2.6), (0.5, 1.3), (0.5, 2.7)} <= corners
    assert any(list(drawn.get_ydata()) == [2, 2] for drawn in nis.lines)
    assert (words(nees)[1:], words(nis)[1:]) == (("time [s]", "NEES [–]"), ("time [s]", "NIS [–]"))
    check_errors(errors, report, time, ", RMS over runs")
    check_coverage(coverage, report)
    assert figure.get_suptitle() == "loop, arc motion, 40 runs — consistent"


def test_a_study_without_observations_has_no_band_of_them(draw):
    nis = draw(plotting.study_figure, study(nis_per_step=[None] * 6), 0.1).axes[1]
    assert line(nis, "no observation").size == 0
    assert not nis.collections


@pytest.mark.parametrize(("runs", "over"), [(40, ", RMS over runs"), (1, "")])
def test_a_judged_filter_is_shown_when_and_where_it_lies(draw, runs, over):
    spans = [
        {"side": "over-confident", "from_s": 10.5, "to_s": 11.0, "anees": 9.0},
        {"side": "under-confident", "from_s": 11.5, "to_s": 12.0, "anees": 0.5},
        {"side": "over-confident", "from_s": 12.0, "to_s": 12.5, "anees": 8.0},
    ]
    report = study(runs=runs, dishonest=spans, nees_per_step=[3, 30, 0.3, 3e6, 3e-6, 6])
    where = RNG.normal(size=(6, 2))
    figure = draw(plotting.judge_figure, report, where, "a robot")
    nees, place, errors, coverage, bar = figure.axes
    shown = "NEES" if runs == 1 else "NEES, mean of 40 runs"
    np.testing.assert_allclose(line(nees, shown), [report["time"], report["nees_per_step"]], rtol=1e-12)
    span = "95 % of an honest filter's values, χ²(3)" if runs == 1 else "95 % band, χ²(3·40)/40"
    np.testing.assert_allclose(band(nees, span), (2.2, 3.9), rtol=1e-9)
    np.testing.assert_array_equal(line(nees, "ANEES 3.46")[1], 3.456)
    np.testing.assert_array_equal(line(nees, "over-confident"), [[10.5, 11], [9, 9]])
    np.testing.assert_array_equal(line(nees, "under-confident"), [[11.5, 12], [0.5, 0.5]])
    assert sum(np.array_equal(drawn.get_xydata().T, [[12, 12.5], [8, 8]]) for drawn in nees.lines) == 1
    assert is_red(matplotlib.colors.to_rgba(colour(nees, "over-confident")))
    check_errors(errors, report, report["time"], over)
    check_coverage(coverage, report)
    (dots,) = place.collections
    np.testing.assert_allclose(dots.get_offsets(), where, rtol=1e-12)
    np.testing.assert_allclose(dots.get_array(), [1, 10, 0.1, 1e3, 1e-2, 2], rtol=1e-9)
    np.testing.assert_allclose(dots.get_clim(), (1e-3, 1e3), rtol=1e-9)  # 1 is in the middle
    assert is_red(dots.cmap(dots.norm(100.0)))
    assert not is_red(dots.cmap(dots.norm(0.01)))
    assert bar.get_ylabel() == "NEES over 3 [–]: red is over-confident"
    assert words(place) == ("Where", "x [m]", "y [m]")
    assert place.get_aspect() == 1
    assert figure.get_suptitle() == "a robot — consistent"


def test_precision_is_shown_by_kind_of_numbers_and_form(draw):
    def numbers(scale):
        values = (scale * RNG.uniform(1, 2, size=(2, 4))).tolist()
        return {"nees_per_bin": values[0], "position_difference_per_bin_m": values[1]}

    row = {
        "steps": 1200,
        "runs": 7,
        "time_s": [1, 2, 3, 4],
        "verdict": "fine; fast",
        "float64": {"nees_per_bin": [3, 3.1, 2.9, 3]},
    }
    row |= {"float32": numbers(1), "short_form": numbers(5)}
    figure = draw(plotting.precision_figure, [row])
    left, right = figure.axes
    name, difference = "1,200 steps, 7 runs", "position_difference_per_bin_m"
    np.testing.assert_array_equal(line(left, f"{name}, float64"), [row["time_s"], row["float64"]["nees_per_bin"]])
    single = line(left, "the same in float32")
    np.testing.assert_array_equal(single, [row["time_s"], row["float32"]["nees_per_bin"]])
    np.testing.assert_array_equal(line(right, name), [row["time_s"], row["float32"][difference]])
    np.testing.assert_array_equal(line(right, "with the short form"), [row["time_s"], row["short_form"][difference]])
    np.testing.assert_array_equal(line(left, "3: an honest covariance")[1], 3)
    assert words(left) == ("NEES, mean over runs and a 4th of the drive", "time [s]", "NEES [–]")
    assert words(right)[1:] == ("time [s]", "distance [m]")
    assert (left.get_xscale(), right.get_xscale(), right.get_yscale()) == ("log",) * 3
    assert figure.get_suptitle() == "fine\nfast"


def test_filters_that_match_scans_are_compared_in_a_panel_for_each_world(draw):
    def world(scale):
        rows = [{"filter": name, "nees_per_match": (scale * RNG.uniform(1, 2, 4)).tolist()} for name in ("a", "b")]
        return {"time_s": [1, 2, 3, 4], "nees_band_95": (2.0, 4.5), "filters": rows}

    report = {"runs": 7, "worlds": {"loop": world(1), "hall": world(100)}}
    figure = draw(plotting.matching_figure, report)
    assert len(figure.axes) == 2
    for ax, (name, each) in zip(figure.axes, report["worlds"].items(), strict=True):
        for row in each["filters"]:
            np.testing.assert_array_equal(line(ax, row["filter"]), [each["time_s"], row["nees_per_match"]])
        assert band(ax, "95 % band, χ²(3·7)/7") == pytest.approx((2.0, 4.5))
        np.testing.assert_array_equal(line(ax, "3: an honest covariance")[1], 3)
        assert words(ax) == (name, "time [s]", "NEES after a match, mean of 7 runs [–]")
        assert ax.get_yscale() == "log"
        assert colour(ax, "b") != colour(ax, "a")
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()][-2:] == ["a", "b"]


def sweep(anees, nis, rmse, consistent, misfit):
    cells = zip(*(np.ravel(x).tolist() for x in (anees, nis, rmse, misfit, consistent)), strict=True)
    names = ("anees", "nis_mean", "rmse_position_m", "misfit", "consistent")
    head = {"scenario": "loop", "motion": "arc", "runs": 50, "verdict": "two of six", "gate_verdict": "open"}
    return {"cells": [dict(zip(names, cell, strict=True)) for cell in cells], **head}


TICKS = ["one", "two", "three"], ["low", "high"]


def test_a_sweep_has_its_columns_to_the_right_and_its_rows_upwards(draw):
    anees, rmse = np.array([[1.5, 3.0, 6.0], [2.0, 2.9, 12.0]]), np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    consistent = np.array([[False, True, False], [False, True, False]])
    report = sweep(anees, 2 * np.ones((2, 3)), rmse, consistent, np.ones((2, 3)))
    figure = draw(plotting.sweep_figure, report, ("across", "up"), TICKS)
    left, right = figure.axes[:2]
    for ax, values in ((left, anees), (right, rmse)):
        (image,) = ax.images
        np.testing.assert_array_equal(image.get_array(), values)
        assert image.origin == "lower"
        texts = {text.get_position(): float(text.get_text()) for text in ax.texts}
        assert texts == {(j, i): values[i, j] for i in range(2) for j in range(3)}
        assert [text.get_text() for text in ax.get_xticklabels()] == TICKS[0]
        assert [text.get_text() for text in ax.get_yticklabels()] == TICKS[1]
        assert (ax.get_xlabel(), ax.get_ylabel()) == ("across", "up")
        # The outline goes around the second column, both rows.
        upright = [c for c in ax.collections if c.get_label().startswith("consistent: ANEES inside its 95 % band")]
        sides = sorted(tuple(map(tuple, segment)) for segment in upright[0].get_segments())
        assert sides == [((x, y), (x, y + 1)) for x in (0.5, 1.5) for y in (-0.5, 0.5)]
        flat = [c for c in ax.collections if isinstance(c, LineCollection) and c not in upright]
        ends = sorted(tuple(map(tuple, segment)) for segment in flat[0].get_segments())
        assert ends == [((0.5, y), (1.5, y)) for y in (-0.5, 1.5)]
    image = left.images[0]
    np.testing.assert_allclose(image.get_clim(), (0.75, 12), rtol=1e-9)  # 3 is in the middle, and 12 is there
    assert is_red(image.cmap(image.norm(12.0)))
    assert not is_red(image.cmap(image.norm(0.75)))
    # ANEES crosses 3 between the cells of the first row where they are as far from it, by ratio, and NIS nowhere.
    assert any(label.startswith("ANEES 3, interp") for label in left.get_legend_handles_labels()[1])
    assert not any(label.startswith("NIS 2") for label in left.get_legend_handles_labels()[1])
    assert right.get_title() == "Accurate? Position RMSE [m]"
    assert figure.get_suptitle() == "loop, arc motion, 50 runs a cell\nopen\ntwo of six"


def test_a_sweep_without_a_consistent_cell_outlines_the_best_fit_and_says_so(draw):
    misfit = np.array([[5.0, 4.0, 3.0], [6.0, 7.0, 1.0]])
    nis = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, 4.0]])
    report = sweep(np.full((2, 3), 6.0), nis, np.ones((2, 3)), np.zeros((2, 3), bool), misfit)
    left = draw(plotting.sweep_figure, report, ("across", "up"), TICKS).axes[0]
    handles, labels = left.get_legend_handles_labels()
    (best,) = (h for h, label in zip(handles, labels, strict=True) if label.startswith("none is consistent: the best"))
    sides = sorted(tuple(map(tuple, segment)) for segment in best.get_segments())
    assert sides == [((1.5, 0.5), (1.5, 1.5)), ((2.5, 0.5), (2.5, 1.5))]
    assert any(label.startswith("NIS 2, interp") for label in labels)
    assert not any(label.startswith("ANEES 3, interp") for label in labels)  # 6 everywhere


def test_a_large_sweep_has_no_numbers_in_its_cells(draw):
    ones = np.ones((2, 13))
    report = sweep(ones, ones, ones, ones > 0, ones)
    figure = draw(plotting.sweep_figure, report, ("across", "up"), (list("abcdefghijklm"), list("ab")))
    assert not any(ax.texts for ax in figure.axes[:2])


# --- Tuning ---


def descent(**fields):
    trace = {"loss": [4.0, 3.0, 2.5, 2.4], "gradient_norm": [1.0, 0.5, 0.0, 0.1], "validation": [5.0, 3.5, 3.8]}
    trace["parameters"] = {"range": [0.2, 0.3, 0.35, 0.4], "bearing": [0.1, 0.09, 0.08, 0.05]}
    tuned = {
        "range": {"end": 0.4, "unit": "m", "standard_error": 0.02},
        "bearing": {"end": 0.05, "unit": "rad", "standard_error": math.nan},
    }
    report = {"trace": trace, "parameters": tuned, "validated": True, "steps_per_epoch": 2, "best_epoch": 1}
    return report | {"loss_words": "nats", "source": "loop", "evaluations": 9, "run_s": 1.25} | fields


def test_a_descent_shows_loss_parameters_and_gradient_by_step(draw):
    figure = draw(plotting.descent_figure, descent())
    left, middle, right = figure.axes
    np.testing.assert_array_equal(line(left, "on the sequences tuned on"), [range(4), [4.0, 3.0, 2.5, 2.4]])
    np.testing.assert_array_equal(line(left, "on those left aside"), [[0, 2, 4], [5.0, 3.5, 3.8]])
    np.testing.assert_array_equal(line(left, "best: what is kept"), [[2], [3.5]])
    np.testing.assert_allclose(line(middle, "range: 0.4 m"), [range(4), [1, 1.5, 1.75, 2]], rtol=1e-12)
    np.testing.assert_allclose(line(middle, "bearing: 0.05 rad"), [range(4), [1, 0.9, 0.8, 0.5]], rtol=1e-12)
    (bar,) = middle.collections  # of the one whose standard error is known: ±2 of 0.02 over a start of 0.2
    np.testing.assert_allclose(bar.get_segments(), [[[3.5, 1.8], [3.5, 2.2]]], rtol=1e-12)
    np.testing.assert_array_equal(right.lines[0].get_xydata().T, [range(4), [1, 0.5, 1e-16, 0.1]])
    assert [ax.get_xlabel() for ax in figure.axes] == ["step"] * 3
    assert (middle.get_yscale(), right.get_yscale()) == ("log", "log")
    assert figure.get_suptitle() == "loop: 9 evaluations in 1.2 s"


def test_what_was_not_validated_has_no_line_and_what_crosses_zero_no_logarithm(draw):
    report = descent(validated=False)
    report["trace"]["parameters"]["range"] = [0.0, -0.1, 0.1, 0.4]
    left, middle, _ = draw(plotting.descent_figure, report).axes
    assert not lines(left, "on those left aside")
    np.testing.assert_array_equal(line(middle, "range")[1], [0.0, -0.1, 0.1, 0.4])
    assert middle.get_yscale() == "linear"


def check_before_after(ax, before, after):
    np.testing.assert_allclose(bars(ax, "expected")[1], LEVELS, rtol=1e-12)
    places = []
    for name, report in (("before", before), ("after", after)):
        place, heights = bars(ax, name)
        np.testing.assert_allclose(heights, [100 * report[f"coverage_{level}"] for level in LEVELS], rtol=1e-12)
        places.append(place)
    assert np.all(np.array(places[0]) < places[1])
    assert ax.get_ylabel() == "[%]"


def test_studies_before_and_after_keep_their_colours_apart(draw):
    before, after = study(anees=9.87, coverage_50=0.1, verdict="too sure"), study()
    figure = draw(plotting.study_before_after_figure, before, after, 0.2)
    left, right = figure.axes
    time = 0.2 * np.arange(1, 7)
    np.testing.assert_allclose(line(left, "before: ANEES 9.87"), [time, before["nees_per_step"]], rtol=1e-12)
    np.testing.assert_allclose(line(left, "after: ANEES 3.46"), [time, after["nees_per_step"]], rtol=1e-12)
    np.testing.assert_allclose(band(left, "95 % band, χ²(3·40)/40"), (2.2, 3.9), rtol=1e-9)
    check_before_after(right, before, after)
    shades = {group.get_label(): group.patches[0].get_facecolor() for group in right.containers if group.get_label()}
    assert shades["before"] == matplotlib.colors.to_rgba(colour(left, "before"))
    assert shades["after"] == matplotlib.colors.to_rgba(colour(left, "after"))
    assert shades["before"] != shades["after"]
    assert figure.get_suptitle() == "before: too sure\nafter: consistent"


def test_each_drive_before_and_after_has_a_row(draw):
    drives = {}
    for name, begin in (("drive 4", 100.0), ("drive 5", 0.0)):
        drives[name] = {
            "time": begin + np.arange(4.0),
            "nees_before": np.array([9, 0, np.nan, 4.0]) + begin,
            "nees_after": np.array([3, 0, np.nan, 2.0]),
            "before": study(anees=9.0, rmse_position_m=0.25),
            "after": study(anees=3.1, rmse_position_m=0.125),
        }
    figure = draw(plotting.log_before_after_figure, drives)
    for (left, right), (name, drive) in zip(np.reshape(figure.axes, (2, 2)), drives.items(), strict=True):
        for when, label in (("before", "before: ANEES 9, RMSE 0.250 m"), ("after", "after: ANEES 3.1, RMSE 0.125 m")):
            expected = np.maximum(drive[f"nees_{when}"], 1e-3)  # a logarithmic axis has no zero
            np.testing.assert_array_equal(line(left, label), [range(4), expected])
        limits = scipy.stats.chi2.ppf([0.025, 0.975], 3)
        np.testing.assert_allclose(band(left, "95 % of an honest filter's values"), limits, rtol=1e-6)
        assert words(left) == (f"{name}, held out", "time [s]", "NEES [–]")
        check_before_after(right, drive["before"], drive["after"])


def test_calibration_is_what_happens_over_what_the_map_says(draw):
    def judged(error):
        return {
            "calibration_cells": [10, 0, 30],
            "calibration_probability": [0.1, 0.0, 0.8],
            "calibration_frequency": [0.2 + error, 0.0, 0.7],
            "calibration_error": error,
            "log_loss": 0.3,
        }

    figure = draw(plotting.calibration_figure, judged(0.05), judged(0.01), "a hall")
    left, right = figure.axes
    for name, error in (("before", 0.05), ("after", 0.01)):
        label = f"{name}: error {error:.4f}, log-loss 0.3000 nats"
        np.testing.assert_allclose(line(left, label), [[0.1, 0.8], [0.2 + error, 0.7]], rtol=1e-12)
        np.testing.assert_allclose(line(right, name), [[0.1, 0.8], [0.25, 0.75]], rtol=1e-12)
        assert colour(left, name) == colour(right, name)
    np.testing.assert_array_equal(line(left, "calibrated"), [[0, 1], [0, 1]])
    assert words(left)[1:] == (
        "probability of being occupied the map gave [–]",
        "share of these cells a beam ended in [–]",
    )
    assert (left.get_title(), right.get_yscale()) == ("Calibration one scan ahead: a hall", "log")


def test_a_figure_is_written_at_the_resolution_it_asks_for(tmp_path):
    figure = maps.Figure(figsize=(2, 1))
    style.save(figure, tmp_path / "a.png", dpi=50)
    from PIL import Image

    with Image.open(tmp_path / "a.png") as image:
        assert (image.format, image.size) == ("PNG", (100, 50))
