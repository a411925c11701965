"""Records: what they refuse, and with which words; parameters on disk; checks of values and of what is traced."""

import dataclasses
import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlocmap import Config, GridSpec, Params, checks

STD = {"v": 0.02, "w": 0.03, "range": 0.15, "bearing": 0.03}


@pytest.fixture
def params():
    return Params.from_std(**STD, l_occ=0.7, l_free=-0.3)


# --- parameters


def test_from_std_squares_deviations(params):
    np.testing.assert_allclose(params.Q, np.diag([0.02**2, 0.03**2]), rtol=1e-6)
    np.testing.assert_allclose(params.R, np.diag([0.15**2, 0.03**2]), rtol=1e-6)
    np.testing.assert_allclose([params.l_occ, params.l_free], [0.7, -0.3], rtol=1e-6)
    assert {x.dtype for x in jax.tree.leaves(params)} == {jnp.result_type(float)}


@pytest.mark.parametrize("value", [0.0, -0.1, math.nan, math.inf])
@pytest.mark.parametrize("name", list(STD))
def test_from_std_refuses_what_is_no_deviation(name, value):
    with pytest.raises(ValueError, match=rf"^{name}: expected a positive, finite standard deviation, got {value}"):
        Params.from_std(**(STD | {name: value}))


@pytest.mark.parametrize(
    ("field", "value", "wanted"),
    [("l_occ", 0.0, "> 0"), ("l_occ", -1.0, "> 0"), ("l_free", 0.4, "< 0"), ("l_free", math.nan, "< 0")],
)
def test_from_std_refuses_log_odds_of_the_wrong_sign(field, value, wanted):
    with pytest.raises(ValueError, match=rf"^{field}: expected a finite value {wanted} nats, got {value}"):
        Params.from_std(**STD, **{field: value})


def test_parameters_come_back_from_disk_bit_for_bit(params, tmp_path):
    path = tmp_path / "params.json"
    params.save(path)
    loaded = Params.load(path)
    assert jax.tree.structure(loaded) == jax.tree.structure(params)
    for got, expected in zip(jax.tree.leaves(loaded), jax.tree.leaves(params), strict=True):
        np.testing.assert_array_equal(got, expected)
        assert got.dtype == expected.dtype


def test_the_file_is_json_anyone_can_read(params, tmp_path):
    path = tmp_path / "params.json"
    params.save(str(path))
    fields = json.loads(path.read_text())
    assert list(fields) == ["Q", "R", "l_occ", "l_free"]
    np.testing.assert_allclose(fields["Q"], [[0.0004, 0.0], [0.0, 0.0009]], rtol=1e-6)
    assert fields["l_free"] == pytest.approx(-0.3, rel=1e-6)


GOOD = {"Q": [[1.0, 0.0], [0.0, 1.0]], "R": [[1.0, 0.0], [0.0, 1.0]], "l_occ": 0.8, "l_free": -0.4}


def without(name):
    return {key: value for key, value in GOOD.items() if key != name}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (json.dumps(without("R")), r"expected the fields .*'R'.*got \['Q', 'l_free', 'l_occ'\]"),
        (json.dumps(GOOD | {"gps": [[1, 2], [2, 1]]}), r"gps: expected a positive definite matrix, got eigenvalues"),
        (json.dumps(GOOD | {"gps": [1.0, 1.0]}), r"gps: expected shape \(\), got \(2,\)"),
        (json.dumps(GOOD | {"drift": math.nan}), r"drift: expected a finite number, got nan"),
        (json.dumps(GOOD | {"drift": "none"}), r"drift: expected numbers, got 'none'"),
        (json.dumps(GOOD | {"gate_probability": 1.5}), r"gate_probability: expected a probability in .* got 1\.5"),
        (
            json.dumps(GOOD | {"Q": [[1, 2], [2, 1]]}),
            r"Q: expected a positive definite matrix, got eigenvalues \[-1\.0",
        ),
        (json.dumps(GOOD | {"R": [[1, 0], [0.5, 1]]}), r"R: expected a symmetric matrix, got \[\[1\.0, 0\.0\]"),
        (json.dumps(GOOD | {"R": [[math.nan, 0], [0, 1]]}), r"R: expected finite entries, got \[\[nan"),
        (json.dumps(GOOD | {"Q": [1.0, 1.0]}), r"Q: expected shape \(2, 2\), got \(2,\)"),
        (json.dumps(GOOD | {"Q": [[1.0], [0.0, 1.0]]}), r"inhomogeneous shape"),
        (json.dumps(GOOD | {"l_free": 0.4}), r"l_free: expected a finite value < 0 nats, got 0\.4"),
        (json.dumps(GOOD | {"l_occ": -0.4}), r"l_occ: expected a finite value > 0 nats, got -0\.4"),
        (json.dumps(GOOD | {"l_occ": math.inf}), r"l_occ: expected a finite value > 0 nats, got inf"),
        (json.dumps(GOOD | {"l_occ": [0.8, 0.8]}), r"l_occ: expected shape \(\), got \(2,\)"),
        (json.dumps(GOOD | {"l_occ": "a lot"}), r"l_occ: expected numbers, got 'a lot'"),
        (json.dumps(GOOD | {"l_occ": "0.8"}), r"l_occ: expected numbers, got '0\.8'"),
        (json.dumps(GOOD | {"l_occ": None}), r"l_occ: expected numbers, got None"),
        (json.dumps(GOOD | {"l_occ": True}), r"l_occ: expected numbers, got True"),
        (json.dumps([1, 2]), r"expected the fields .*got list"),
        ("Q = 1\n", r"expected a JSON object with \('Q', 'R', 'l_occ', 'l_free'\)"),
        ("", r"expected a JSON object"),
        (b"\xff\xfe\x00\x93NUMPY", r"expected a JSON object"),
    ],
)
def test_a_file_that_holds_no_parameters_is_refused_by_path_and_field(content, message, tmp_path):
    path = tmp_path / "params.json"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ValueError, match=message) as raised:
        Params.load(path)
    assert str(raised.value).startswith(f"{path}: ")


def test_a_field_of_another_name_is_a_block(tmp_path):
    path = tmp_path / "params.json"
    path.write_text(json.dumps(GOOD | {"gps": [[4.0, 0.5], [0.5, 1.0]], "drift": -2.5}))
    params = Params.load(path)
    assert params.blocks.keys() == {"gps", "drift"}
    np.testing.assert_array_equal(params.blocks["gps"], [[4.0, 0.5], [0.5, 1.0]])
    assert float(params.blocks["drift"]) == -2.5


def test_a_file_that_is_not_there_says_so(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"missing\.json"):
        Params.load(tmp_path / "missing.json")
    with pytest.raises(ValueError, match=f"{tmp_path.name}: expected a file, got a folder"):
        Params.load(tmp_path)


def test_check_passes_what_is_traced_and_still_sees_shapes(params):
    jax.jit(lambda p: p.check())(jax.tree.map(lambda x: -x, params))
    with pytest.raises(ValueError, match=r"Q: expected shape \(2, 2\), got \(3, 3\)"):
        jax.jit(lambda p: p.check())(params._replace(Q=jnp.eye(3)))


# --- settings

GRID = {"origin": (0.0, 0.0), "resolution": 0.1, "shape": (3, 4)}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shape": (0, 4)}, r"shape: expected \(rows, columns\), whole numbers of at least 1, got \(0, 4\)"),
        ({"shape": (3, -1)}, r"shape: expected .* got \(3, -1\)"),
        ({"shape": (3,)}, r"shape: expected .* got \(3,\)"),
        ({"shape": (3, 4, 5)}, r"shape: expected .* got \(3, 4, 5\)"),
        ({"resolution": 0.0}, r"resolution: expected metres per cell > 0, got 0\.0"),
        ({"resolution": -0.1}, r"resolution: expected .* got -0\.1"),
        ({"resolution": math.nan}, r"resolution: expected .* got nan"),
        ({"resolution": math.inf}, r"resolution: expected .* got inf"),
        ({"origin": (0.0, math.nan)}, r"origin: expected two finite coordinates in metres, got \(0\.0, nan\)"),
        ({"origin": (0.0,)}, r"origin: expected two finite coordinates in metres, got \(0\.0,\)"),
        ({"l_min": 0.0}, r"l_min, l_max: expected l_min < 0 < l_max, got 0\.0, 4\.0"),
        ({"l_max": -1.0}, r"l_min, l_max: expected .* got -4\.0, -1\.0"),
        ({"l_max": math.nan}, r"l_min, l_max: expected .* got -4\.0, nan"),
    ],
)
def test_a_grid_that_cannot_be_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        GridSpec(**(GRID | change))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dt": 0.0}, r"dt: expected seconds > 0, got 0\.0"),
        ({"dt": -0.1}, r"dt: expected seconds > 0, got -0\.1"),
        ({"dt": math.nan}, r"dt: expected seconds > 0, got nan"),
        ({"dt": math.inf}, r"dt: expected seconds > 0, got inf"),
        *(
            ({"gate_probability": p}, rf"gate_probability: expected a probability inside \(0, 1\).*got {p}")
            for p in (0.0, 1.0, -1.0, 2.0, math.nan)
        ),
        *(
            ({"gate_temperature": s}, rf"gate_temperature: expected a finite width >= 0, got {s}")
            for s in (-1.0, math.inf, math.nan)
        ),
        ({"sensor_offset": (0.1, 0.2)}, r"sensor_offset: expected finite \(dx, dy, dtheta\), got \(0\.1, 0\.2\)"),
        ({"sensor_offset": (0.1, 0.2, math.inf)}, r"sensor_offset: expected .* got \(0\.1, 0\.2, inf\)"),
        ({"scanner_offset": (0.1, 0.2)}, r"scanner_offset: expected finite \(dx, dy, dtheta\), got \(0\.1, 0\.2\)"),
        ({"scanner_offset": (0.1, math.nan, 0.2)}, r"scanner_offset: expected .* got \(0\.1, nan, 0\.2\)"),
        ({"min_range": -0.1}, r"min_range, max_range: expected 0 <= min_range < max_range, got -0\.1, 8\.0"),
        ({"min_range": 8.0}, r"min_range, max_range: expected .* got 8\.0, 8\.0"),
        ({"max_range": math.inf}, r"min_range, max_range: expected .* got 0\.05, inf"),
        ({"max_range": math.nan}, r"min_range, max_range: expected .* got 0\.05, nan"),
    ],
)
def test_settings_that_cannot_be_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Config(**change)


def test_a_gate_that_is_traced_is_no_setting_but_a_parameter_and_not_looked_at(params):
    with pytest.raises(TypeError, match=r"^gate_probability: expected a number, got "):
        jax.eval_shape(lambda p: dataclasses.replace(Config(), gate_probability=p).gate_probability, 0.9)

    def checked(p):
        gated = params._replace(gate_probability=p)
        gated.check()
        return gated.gate_probability

    assert jax.jit(checked)(1.5) == 1.5
    with pytest.raises(ValueError, match=r"^gate_probability: expected .* in \(0, 1\], 1 for no gate, got 1\.5"):
        checked(1.5)
    assert checked(1.0) == 1.0


def test_settings_are_values_equal_hashable_and_frozen():
    one, other = (Config(grid=GridSpec(**GRID)) for _ in range(2))
    assert one == other
    assert hash(one) == hash(other)
    with pytest.raises(AttributeError, match="dt"):
        one.dt = 1.0


# --- checks


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_a_covariance_may_be_off_by_rounding_of_its_own_dtype(scale):
    singular = np.array([[1.0, 3.0], [3.0, 9.0]]) * scale
    for dtype in (np.float32, np.float64):
        checks.covariance("P", singular.astype(dtype), 2)
    with pytest.raises(ValueError, match=r"P: expected a positive semi-definite matrix, got eigenvalues"):
        checks.covariance("P", singular - 1e-4 * scale * np.eye(2), 2)


def test_a_definite_covariance_has_no_eigenvalue_of_zero():
    with pytest.raises(ValueError, match=r"R: expected a positive definite matrix, got eigenvalues \[0\.0, 1\.0\]"):
        checks.covariance("R", np.diag([0.0, 1.0]), 2, definite=True)


def test_an_expected_shape_says_where_any_length_will_do():
    with pytest.raises(ValueError, match=r"^z: expected shape \(any, 2\), got \(3,\)$"):
        checks.shape("z", np.zeros(3), (None, 2))


def test_dtype_checks_see_through_jit():
    with pytest.raises(TypeError, match=r"landmark: expected dtype integer, got float32"):
        jax.jit(lambda x: checks.dtype("landmark", x, np.integer))(np.zeros(2, np.float32))


@pytest.mark.parametrize(
    ("record", "change", "message"),
    [
        (GridSpec, {"resolution": "0.1"}, r"resolution: expected a number, got '0\.1'"),
        (GridSpec, {"shape": 5}, "shape: expected a tuple of numbers, got 5"),
        (GridSpec, {"origin": ("0", 1.0)}, "origin: expected a number, got '0'"),
        (Config, {"dt": None}, "dt: expected a number, got None"),
        (Config, {"dt": True}, "dt: expected a number, got True"),
        (Config, {"gate_temperature": "2"}, "gate_temperature: expected a number, got '2'"),
        (Config, {"min_range": None}, "min_range: expected a number, got None"),
        (Config, {"max_range": [8.0]}, r"max_range: expected a number, got \[8\.0\]"),
        (GridSpec, {"l_min": None}, "l_min: expected a number, got None"),
        (GridSpec, {"l_max": "4"}, "l_max: expected a number, got '4'"),
        (Config, {"gate_probability": "0.99"}, r"gate_probability: expected a number, got '0\.99'"),
        (Config, {"sensor_offset": 0.2}, r"sensor_offset: expected a tuple of numbers, got 0\.2"),
        (Config, {"scanner_offset": 0.2}, r"scanner_offset: expected a tuple of numbers, got 0\.2"),
    ],
)
def test_a_setting_that_is_no_number_is_named(record, change, message):
    whole = {"origin": (0.0, 0.0), "resolution": 1.0, "shape": (2, 3)} if record is GridSpec else {}
    with pytest.raises(TypeError, match=message):
        record(**whole | change)


def test_settings_given_as_lists_can_be_hashed():
    grid = GridSpec(origin=[0.0, 1.0], resolution=1.0, shape=[2, 3])
    assert hash(Config(grid=grid, sensor_offset=[0.0, 0.0, 0.1])) == hash(
        Config(grid=GridSpec((0.0, 1.0), 1.0, (2, 3)), sensor_offset=(0.0, 0.0, 0.1))
    )


def test_params_made_of_lists_are_refused_by_name():
    with pytest.raises(TypeError, match="Q: expected an array, got list"):
        Params([[1.0, 0.0], [0.0, 1.0]], jnp.eye(2), jnp.array(1.0), jnp.array(-1.0)).check()


# --- precision


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.float16])
def test_the_farthest_coordinate_is_where_numbers_begin_to_lie_a_millimetre_apart(kind):
    far = checks.farthest(kind)
    assert np.spacing(np.nextafter(kind(far), kind(0))) <= 1e-3 < np.spacing(kind(far))


@pytest.mark.parametrize("value", [16_384.0, -388_096.0, [[0.0, 3.0], [2.0, 3_948_996.0]]])
def test_a_coordinate_that_a_type_cannot_hold_is_refused_with_what_to_do(value):
    with pytest.raises(
        ValueError, match=r"^here: expected .* float32 .* lie .* apart: subtract an origin, or use float64"
    ):
        checks.resolved("here", value, jnp.float32)
    checks.resolved("here", value, jnp.float64)


def test_the_spacing_is_said():
    with pytest.raises(ValueError, match=r"got 388097 m, where its numbers lie 0\.031 m apart"):
        checks.resolved("here", np.array([1.0, -388_097.0]), np.float32)
    assert float(np.spacing(np.float32(388_097))) == 0.03125


@pytest.mark.parametrize("value", [0.0, 16_383.9, [], [math.nan, math.inf, 1.0]])
def test_what_a_type_can_hold_passes_and_what_is_no_number_is_no_matter_of_precision(value):
    checks.resolved("here", np.array(value), jnp.float32)


def test_what_is_traced_is_not_looked_at():
    jax.eval_shape(lambda x: checks.resolved("here", x, jnp.float32), jnp.array(1e6))


# --- numbers that a user is told


def test_settings_that_are_not_given_are_those_written_beside_them():
    assert Config() == Config(
        dt=0.1,
        motion="arc",
        gate_probability=0.99,
        gate_temperature=0.0,
        sensor_offset=(0.0, 0.0, 0.0),
        grid=None,
        min_range=0.05,
        max_range=8.0,
        scanner_offset=(0.0, 0.0, 0.0),
        sensor="range_bearing",
    )
    assert GridSpec(**GRID) == GridSpec(**GRID, l_min=-4.0, l_max=4.0)
    params = Params.from_std(**STD)
    np.testing.assert_allclose([params.l_occ, params.l_free], [0.85, -0.40], rtol=1e-7)


@pytest.mark.parametrize("definite", [False, True])
def test_a_covariance_is_symmetric_to_five_digits(definite):
    for off, fine in ((5e-6, True), (5e-5, False)):
        P = np.array([[1.0, 0.5], [0.5 * (1 + off), 1.0]])
        if fine:
            checks.covariance("P", P, 2, definite=definite)
        else:
            with pytest.raises(ValueError, match=r"^P: expected a symmetric matrix, got"):
                checks.covariance("P", P, 2, definite=definite)
