"""The filter alone, against other libraries' extended Kalman filters, on their own ground.

A robot drives a circle in first-order steps under a known control; noise on its yaw rate alone, so that one constant
covariance of the process describes it exactly in every library. At every step it sees four landmarks, range and
bearing: one observation of eight numbers for the others, four of two for us. Every library gets the same numbers and
gives back the mean and covariance of every step of every run.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import functools
import importlib
import importlib.metadata
import multiprocessing
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

import jaxlocmap
from jaxlocmap import Config, Gaussian, Inputs, Params, consistency
from jaxlocmap.se2 import wrap

DT, V, W = 0.1, 0.3, 0.1  # s, m/s, rad/s: a circle of 3 m
LANDMARKS = np.array([[2.0, 10.0], [10.0, 2.5], [9.5, 10.5], [2.0, 5.5]])  # m
PRIOR_MEAN, PRIOR_STD = np.array([9.0, 5.4, np.pi / 2]), np.array([0.2, 0.2, 0.1])
YAW_RATE_STD, RANGE_STD, BEARING_STD = 0.05, 0.08, 0.02  # rad/s, m, rad
NOTHING = 1e-6  # m: what covariances that must be definite get where there is no noise
Q = np.diag([NOTHING**2, NOTHING**2, (YAW_RATE_STD * DT) ** 2])
R = np.diag(np.tile([RANGE_STD**2, BEARING_STD**2], len(LANDMARKS)))


class Drives(NamedTuple):
    """What happened and what was measured, in float64."""

    truth: np.ndarray  # (N, T, 3)
    z: np.ndarray  # (N, T, 8) range and bearing of each landmark in turn, bearings in [-pi, pi)


def drive(runs: int, steps: int, seed: int) -> Drives:
    """Simulate, the true start drawn from the prior."""
    random = np.random.default_rng(seed)
    pose = PRIOR_MEAN + PRIOR_STD * random.standard_normal((runs, 3))
    truth = np.empty((runs, steps, 3))
    for k in range(steps):
        pose = _moved(pose)
        pose[:, 2] += YAW_RATE_STD * DT * random.standard_normal(runs)
        truth[:, k] = pose
    noise = np.tile([RANGE_STD, BEARING_STD], len(LANDMARKS))
    z = _seen(truth) + noise * random.standard_normal((runs, steps, len(noise)))
    z[..., 1::2] = _wrapped(z[..., 1::2])
    return Drives(truth, z)


def _wrapped(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _moved(pose: np.ndarray) -> np.ndarray:
    step = V * DT
    return pose + np.stack(
        [step * np.cos(pose[..., 2]), step * np.sin(pose[..., 2]), np.full(pose.shape[:-1], W * DT)], axis=-1
    )


def _seen(pose: np.ndarray) -> np.ndarray:
    dx, dy = (LANDMARKS[:, i] - pose[..., i, None] for i in (0, 1))
    z = np.stack([np.hypot(dx, dy), np.arctan2(dy, dx) - pose[..., 2, None]], axis=-1)
    return z.reshape(*pose.shape[:-1], -1)


def _move_jacobian(pose: np.ndarray) -> np.ndarray:
    F = np.broadcast_to(np.eye(3), (*pose.shape[:-1], 3, 3)).copy()
    F[..., 0, 2], F[..., 1, 2] = -V * DT * np.sin(pose[..., 2]), V * DT * np.cos(pose[..., 2])
    return F


def _see_jacobian(pose: np.ndarray) -> np.ndarray:
    dx, dy = (LANDMARKS[:, i] - pose[..., i, None] for i in (0, 1))
    r = np.hypot(dx, dy)
    rows = np.stack(
        [np.stack([-dx / r, -dy / r, 0 * r], axis=-1), np.stack([dy / r**2, -dx / r**2, 0 * r - 1], axis=-1)], axis=-2
    )
    return rows.reshape(*pose.shape[:-1], -1, 3)


def _residual(z: np.ndarray, expected: np.ndarray) -> np.ndarray:
    r = z - expected
    r[..., 1::2] = _wrapped(r[..., 1::2])
    return r


def score(drives: Drives, means: np.ndarray, covs: np.ndarray) -> dict[str, float]:
    """How consistent the beliefs (N, T, 3), (N, T, 3, 3) are, in float64, whatever made them.

    The NIS is that of the whole observation given the belief of the step before, at every tenth step.
    """
    runs = len(means)
    means, covs = np.asarray(means, np.float64), np.asarray(covs, np.float64)
    report = consistency.judge(drives.truth[:runs], means, covs)
    usable = np.all(np.isfinite(means), axis=-1) & np.all(np.isfinite(covs), axis=(-1, -2))
    covs = np.where(usable[..., None, None], covs, np.eye(3))
    usable = usable & (np.linalg.eigvalsh(covs)[..., 0] > 0)
    covs = np.where(usable[..., None, None], covs, np.eye(3))

    before = np.where(usable[..., None], means, PRIOR_MEAN)[:, 9:-1:10]
    F = _move_jacobian(before)
    mean = _moved(before)
    H = _see_jacobian(mean)
    S = H @ (F @ covs[:, 9:-1:10] @ np.swapaxes(F, -1, -2) + Q) @ np.swapaxes(H, -1, -2) + R
    nis = _squared_distance(S, _residual(drives.z[:runs, 10::10], _seen(mean)))
    return {
        **{name: report[name] for name in ("anees", "anees_standard_error", "rmse_position_m", "diverged_runs")},
        "nis_mean": float(np.mean(nis[usable[:, 9:-1:10]])),
        "unusable_steps": int((~usable).sum()),
    }


def _squared_distance(cov: np.ndarray, error: np.ndarray) -> np.ndarray:
    return np.sum(error * np.linalg.solve(cov, error[..., None])[..., 0], axis=-1)


# ---- Ours and those on JAX: one run, mapped over runs and devices ---------------------------------------------------


def _over_runs(one_run: Callable[[jax.Array], Any], z: np.ndarray) -> Callable[[], Any]:
    """`vmap` over runs on every device at once, the same for every library on JAX."""
    mesh = Mesh(np.array(jax.local_devices()), ("runs",))
    mapped = jax.shard_map(jax.vmap(one_run), mesh=mesh, in_specs=P("runs"), out_specs=P("runs"), check_vma=False)
    data = jnp.asarray(z)
    program = jax.jit(mapped).lower(data).compile()
    return lambda: jax.block_until_ready(program(data))


def _expected(pose: jax.Array) -> jax.Array:
    dx, dy = (jnp.asarray(LANDMARKS[:, i], pose.dtype) - pose[i] for i in (0, 1))
    return jnp.stack([jnp.hypot(dx, dy), jnp.arctan2(dy, dx) - pose[2]], axis=-1).ravel()


def _expected_near(pose: jax.Array, z: jax.Array) -> jax.Array:
    """`_expected`, each bearing shifted by whole turns to lie next to the measured one: for filters that subtract."""
    off = (z - _expected(pose)).reshape(-1, 2)
    return z - jnp.stack([off[:, 0], wrap(off[:, 1])], axis=-1).ravel()


def _transition(pose: jax.Array) -> jax.Array:
    return pose + jnp.stack([V * DT * jnp.cos(pose[2]), V * DT * jnp.sin(pose[2]), jnp.full_like(pose[2], W * DT)])


def _jaxlocmap(z: np.ndarray) -> Callable[[], Any]:
    dtype, steps, count = z.dtype, z.shape[1], len(LANDMARKS)
    config = Config(dt=DT, motion="euler", gate_probability=None)
    params = Params(
        Q=jnp.diag(jnp.array([(NOTHING / DT) ** 2, YAW_RATE_STD**2], dtype)),
        R=jnp.diag(jnp.array([RANGE_STD**2, BEARING_STD**2], dtype)),
        l_occ=jnp.array(1, dtype),
        l_free=jnp.array(-1, dtype),
    )
    prior = Gaussian(jnp.array(PRIOR_MEAN, dtype), jnp.diag(jnp.array(PRIOR_STD**2, dtype)))
    landmarks = jnp.array(LANDMARKS, dtype)

    def one_run(z: jax.Array) -> Gaussian:
        inputs = Inputs(
            dt=jnp.full(steps, DT, dtype),
            control=jnp.tile(jnp.array([V, W], dtype), (steps, 1)),
            landmark=jnp.tile(jnp.arange(count, dtype=jnp.int32), (steps, 1)),
            z=z.reshape(steps, count, 2),
            valid=jnp.ones((steps, count), bool),
        )
        start = jaxlocmap.init(prior, config=config)
        return jaxlocmap.run(params, start, inputs, landmarks=landmarks, config=config, collect=_belief)[1]

    return _over_runs(one_run, z)


def _belief(state: Any, info: Any, aside: Any) -> Gaussian:
    del state, aside
    return info.belief


def _first_predicted() -> tuple[np.ndarray, np.ndarray]:
    F = _move_jacobian(PRIOR_MEAN)
    return _moved(PRIOR_MEAN), F @ np.diag(PRIOR_STD**2) @ F.T + Q


def _dynamax(z: np.ndarray, near: bool) -> Callable[[], Any]:
    inference = importlib.import_module("dynamax.nonlinear_gaussian_ssm")
    mean, cov = (jnp.array(x, z.dtype) for x in _first_predicted())  # its prior is that of the first observation
    params = inference.ParamsNLGSSM(
        initial_mean=mean,
        initial_covariance=cov,
        dynamics_function=(lambda pose, z: _transition(pose)) if near else _transition,
        dynamics_covariance=jnp.array(Q, z.dtype),
        emission_function=_expected_near if near else _expected,
        emission_covariance=jnp.array(R, z.dtype),
    )

    def one_run(z: jax.Array) -> Any:
        kept = ["filtered_means", "filtered_covariances"]
        out = inference.extended_kalman_filter(params, z, inputs=z if near else None, output_fields=kept)
        return out.filtered_means, out.filtered_covariances

    return _over_runs(one_run, z)


def _cuthbert(z: np.ndarray) -> Callable[[], Any]:
    moments = importlib.import_module("cuthbert.gaussian.moments")
    filtering = importlib.import_module("cuthbert.filtering")
    root_Q, root_R = (jnp.array(np.sqrt(x), z.dtype) for x in (Q, R))
    build = moments.build_filter(
        jnp.array(PRIOR_MEAN, z.dtype),
        jnp.diag(jnp.array(PRIOR_STD, z.dtype)),
        lambda state, z: ((lambda pose: (_transition(pose), root_Q)), state.mean),
        lambda state, z: ((lambda pose: (_expected_near(pose, z), root_R)), state.mean, z),
    )

    def one_run(z: jax.Array) -> Any:
        states = filtering.filter(build, z, build.init_prepare())
        return states.mean[1:], states.chol_cov[1:] @ jnp.swapaxes(states.chol_cov[1:], -1, -2)

    return _over_runs(one_run, z)


def _kalman_py_residual(z: jax.Array, expected: jax.Array) -> jax.Array:
    r = (z - expected).reshape(-1, 2)
    return jnp.stack([r[:, 0], wrap(r[:, 1])], axis=-1).ravel()


def _kalman_py(z: np.ndarray) -> Callable[[], Any]:
    module = importlib.import_module("kalman_py")
    filter_ = module.ExtendedKalmanFilter(
        _kalman_py_transition,
        _expected,
        Q.astype(z.dtype),
        R.astype(z.dtype),
        PRIOR_MEAN.astype(z.dtype),
        np.diag(PRIOR_STD**2).astype(z.dtype),
        residual_z=_kalman_py_residual,
    )

    def one_run(z: jax.Array) -> Any:
        result = filter_.filter(z, DT, backend="jax")
        return result.means, result.covs

    return _over_runs(one_run, z)


def _kalman_py_transition(pose: jax.Array, dt: jax.Array) -> jax.Array:
    del dt
    return _transition(pose)


# ---- On NumPy: a loop over steps ------------------------------------------------------------------------------------


def _filterpy(z: np.ndarray) -> Callable[[], Any]:
    kalman = importlib.import_module("filterpy.kalman")

    class Robot(kalman.ExtendedKalmanFilter):
        def predict_x(self, u: Any = 0) -> None:
            del u
            self.x = _moved(self.x)

    def run() -> tuple[np.ndarray, np.ndarray]:
        means, covs = np.empty((*z.shape[:2], 3)), np.empty((*z.shape[:2], 3, 3))
        for i, measured in enumerate(z):
            robot = Robot(dim_x=3, dim_z=z.shape[-1])
            robot.x, robot.P, robot.Q, robot.R = PRIOR_MEAN.copy(), np.diag(PRIOR_STD**2), Q, R
            for k, seen in enumerate(measured):
                robot.F = _move_jacobian(robot.x)
                robot.predict()
                robot.update(seen, _see_jacobian, _seen, residual=_residual)
                means[i, k], covs[i, k] = robot.x, robot.P
        return means, covs

    return run


# ---- All of them -----------------------------------------------------------------------------------------------------

# z of all runs -> what filters them and gives means (N, T, 3) and covariances (N, T, 3, 3)
_Prepare = Callable[[np.ndarray], Callable[[], Any]]


class Peer(NamedTuple):
    """One library's filter in one form."""

    name: str
    package: str
    form: str  # how it is called, in a few words
    prepare: _Prepare
    precisions: tuple[str, ...] = ("float32", "float64")
    share: int = 1  # of how many runs one is filtered: the slow ones get fewer
    processes: bool = False  # one a core, for what cannot use all cores in one

    def version(self) -> str | None:
        """As installed; None if it is not."""
        try:
            return importlib.metadata.version(self.package)
        except importlib.metadata.PackageNotFoundError:
            return None


OURS = Peer("jaxlocmap", "jaxlocmap", "run under vmap", _jaxlocmap)
PEERS = (
    Peer("dynamax", "dynamax", "under vmap, wrapped: z is an input, too", functools.partial(_dynamax, near=True)),
    Peer("dynamax plain", "dynamax", "under vmap, bearings subtracted", functools.partial(_dynamax, near=False)),
    Peer("cuthbert", "cuthbert", "moments filter under vmap, wrapped by the model", _cuthbert, processes=True),
    Peer("kalman-py", "kalman-py", "JAX backend under vmap, wrapped by residual_z", _kalman_py),
    Peer("filterpy", "filterpy", "a Python loop, wrapped by residual", _filterpy, ("float64",), 50, processes=True),
)


class Ready(NamedTuple):
    """A filter with everything compiled."""

    steps_per_s: Callable[[], float]  # runs it once over all runs
    facts: dict[str, Any]


@contextlib.contextmanager
def ready(peer: Peer, drives: Drives, precision: str) -> Iterator[Ready]:
    """Prepare a filter and see how consistent it is."""
    z = drives.z[: max(len(drives.z) // peer.share, jax.local_device_count())].astype(precision)
    with contextlib.ExitStack() as stack:
        began = time.perf_counter()
        program = _in_processes(peer.prepare, z, stack) if peer.processes else _in_this_process(peer.prepare, z)
        prepare_s = time.perf_counter() - began
        facts = score(drives, *program(True))

        def steps_per_s() -> float:
            began = time.perf_counter()
            program(False)
            return z.shape[0] * z.shape[1] / (time.perf_counter() - began)

        yield Ready(steps_per_s, {"runs": z.shape[0], "steps": z.shape[1], "prepare_s": prepare_s, **facts})


def _in_this_process(prepare: _Prepare, z: np.ndarray) -> Callable[[bool], Any]:
    with jax.enable_x64(z.dtype == np.float64):
        prepared = prepare(z)
    return lambda keep: prepared()


def _in_processes(prepare: _Prepare, z: np.ndarray, stack: contextlib.ExitStack) -> Callable[[bool], Any]:
    """One process a core, each with a share of the runs; what they make comes back where `keep` asks for it."""
    spawn = multiprocessing.get_context("spawn")
    shares = np.array_split(z, jax.local_device_count())
    pools = [stack.enter_context(concurrent.futures.ProcessPoolExecutor(1, spawn)) for _ in shares]
    for each in [pool.submit(_prepare_here, prepare, share) for pool, share in zip(pools, shares, strict=True)]:
        each.result()

    def program(keep: bool) -> Any:
        parts = [each.result() for each in [pool.submit(_run_here, keep) for pool in pools]]
        return tuple(np.concatenate(part) for part in zip(*parts, strict=True)) if keep else None

    return program


_HERE: list[Callable[[], Any]] = []


def _prepare_here(prepare: _Prepare, z: np.ndarray) -> None:
    with jax.enable_x64(z.dtype == np.float64):
        _HERE.append(prepare(z))


def _run_here(keep: bool) -> Any:
    result = _HERE[0]()
    return [np.asarray(each) for each in result] if keep else None
