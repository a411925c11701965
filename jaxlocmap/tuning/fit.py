"""Descent: L-BFGS or any optax optimiser, around one compiled program of loss and gradient, the best so far kept."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxlocmap.parameters import Block, Params
from jaxlocmap.tuning.batch import Batch, in_dtype_of, pick
from jaxlocmap.tuning.forward import forward
from jaxlocmap.tuning.losses import Objective
from jaxlocmap.tuning.parameters import NOISE, Coordinates, constrain, correlations_of, natural, unconstrain
from jaxlocmap.tuning.slopes import Evaluation, evaluate, params_at

_LBFGS = optax.scale_by_lbfgs()  # the direction alone
_ADAM = optax.adam(0.05)
_SEARCHES = 6  # evaluations along a line: near the minimum a search for more digits than there are takes all it may
_ARMIJO, _WOLFE = 1e-4, 0.9  # of the slope at the start of a line


class Trace(NamedTuple):
    """What happened at each step, before it was taken. NumPy arrays, leading axis of steps."""

    loss: Any  # (steps,) of the sequences it was taken on
    gradient_norm: Any  # (steps,) by the coordinates
    skipped: Any  # (steps,) bool: no step was taken, as something was not finite or nothing along the line was better
    evaluations: Any  # (steps,) of value and gradient, since the step before
    params: dict[str, Any]  # (steps,) by name, in the units of `parameters.UNITS`


class Fit(NamedTuple):
    """What a fit found, so far or in the end."""

    params: Params  # the best
    loss: float  # of the best: on the validation set, if there is one
    losses: np.ndarray  # (epochs + 1,) the loss that picks the best, at the start and after every epoch
    trace: Trace
    best_epoch: int  # 0: the start
    stopped_early: bool
    compile_s: float  # until the loss at the start is known: compilation, if there was any, and one evaluation
    run_s: float  # of the descent


def coordinates_objective(objective: Objective, params: Params, tuned: tuple[str, ...]) -> Callable[..., Any]:
    """The objective as a function of the tuned coordinates: `f(coordinates, batch) -> (total, {loss: ()})`, the
    other parameters held at `params`. Its derivative is taken forward, also under `jax.grad`.

    It is what any other optimiser needs. SciPy's, say:

        f = coordinates_objective(objective, params, NOISE)
        start, unravel = ravel_pytree({name: unconstrain(params)[name] for name in NOISE})
        program = jax.jit(jax.value_and_grad(lambda x: f(unravel(x), batch)[0]))
        slope = lambda x: jax.tree.map(np.asarray, program(x))
        found = scipy.optimize.minimize(slope, start, jac=True, method="L-BFGS-B")
        tuned = constrain(unconstrain(params) | unravel(found.x))

    Raises:
        ValueError: nothing to tune, a name that is none of the filter's parameters, more than the losses tell
            (`Objective.check_tuned`), or parameters beyond the limits of `constrain`.
    """
    _check_coordinates(objective, params, tuned)
    of_coordinates = _of_coordinates(objective)
    return lambda coordinates, batch: of_coordinates(coordinates, (params, batch))


def _check_coordinates(objective: Objective, params: Params, tuned: tuple[str, ...]) -> None:
    objective.check_tuned(tuned)
    params.check()
    blocks = objective.blocks
    inside = natural(constrain(unconstrain(params, blocks), blocks), blocks)
    for name, value in natural(params, blocks).items():
        if not np.allclose(value, inside[name], rtol=1e-3, atol=1e-3 if name in correlations_of(blocks) else 0):
            raise ValueError(
                f"{name}: expected a value within the limits of tuning, the nearest being {float(inside[name]):.3g}, "
                f"got {float(value):.3g}"
            )


@functools.lru_cache(maxsize=16)  # one function for an objective, so that JAX traces it once for the same shapes
def _of_coordinates(objective: Objective) -> Callable[..., Any]:
    """`f(coordinates, (params, batch)) -> (total, {loss: ()})`; what has no coordinate stays."""

    def f(coordinates: Coordinates, data: tuple[Params, Batch]) -> Any:
        params, batch = data
        return objective(params_at(objective.blocks, coordinates, params, batch), batch)

    return forward(f)


@functools.partial(jax.jit, static_argnums=0)
def _named(
    blocks: tuple[Block, ...], coordinates: Coordinates, params: Params, batch: Batch
) -> tuple[Params, dict[str, jax.Array]]:
    """The parameters at some coordinates, and what people call them."""
    at = params_at(blocks, coordinates, params, batch)
    return at, natural(at, blocks)


def fit(
    objective: Objective,
    params: Params,
    batch: Batch,
    *,
    tuned: tuple[str, ...] = NOISE,
    optimiser: optax.GradientTransformation | None = None,
    epochs: int = 20,
    steps: int = 2,
    minibatch: int | None = None,
    key: jax.Array | None = None,
    validation: Batch | None = None,
    patience: int = 2,
    tolerance: float = 1e-4,
    progress: Callable[[Fit], None] | None = None,
) -> Fit:
    """Tune parameters for an objective.

    Args:
        objective: what for.
        params: the start; what is not tuned stays.
        batch: to tune on.
        tuned: which parameters, `parameters.names_of(objective.blocks)` being all.
        optimiser: of optax. By default L-BFGS with a line search, which wants the whole batch at every step; with
            minibatches `optax.adam(0.05)`: coordinates are logarithms, so that is 5 % a step.
        epochs: at most so many; after each the validation loss is taken and `progress` called.
        steps: of the optimiser in an epoch.
        minibatch: sequences a step, drawn anew without repetition; all by default.
        key: of the draws.
        validation: what the best is picked by; the batch itself by default.
        patience: stop after so many epochs in which the loss fell by less than `tolerance` of what it fell since the
            start.
        progress: called with the fit so far.

    Returns:
        `Fit`. A step whose loss or gradient is not finite is skipped and counted in its trace. Value and gradient are
        compiled once for an objective, the names tuned and the shapes of the batch, however often this is called.

    Raises:
        ValueError: nothing to tune or nothing to tune on, more than the losses tell (`Objective.check_tuned`), a start
            that cannot be judged (`Objective.check`), a minibatch without a key or larger than the batch, no epochs or
            steps.
    """
    runs = len(batch.counted)
    for name, number in (("epochs", epochs), ("steps", steps), ("patience", patience)):
        if number < 1:
            raise ValueError(f"{name}: expected at least 1, got {number}")
    if minibatch is not None and (key is None or not 1 <= minibatch <= runs):
        raise ValueError(f"minibatch: expected a key and 1 to {runs} sequences, got key {key} and {minibatch}")
    _check_coordinates(objective, params, tuned)
    began = time.perf_counter()
    blocks, params = objective.blocks, in_dtype_of(batch, params)
    theta = {name: value for name, value in unconstrain(params, blocks).items() if name in tuned}
    evaluations = 0

    def evaluated(theta: Coordinates, some: Batch = batch) -> Evaluation:
        nonlocal evaluations
        evaluations += 1
        return evaluate(objective, theta, params, some)

    def params_of(theta: Coordinates) -> Params:
        return _named(blocks, theta, params, batch)[0]

    known: Evaluation | None = None  # at theta, of the whole batch
    if minibatch is None:
        objective.check_batch(batch)
        known = evaluated(theta)
        objective.check_start(batch, known.sums, known.accepted)
    else:
        objective.check(params, batch)

    def judged() -> float:
        nonlocal known
        if validation is not None or minibatch is not None:
            return objective.judged(params_of(theta), batch if validation is None else validation)[0]
        known = evaluated(theta) if known is None else known
        return float(known.loss)

    best, best_loss, best_epoch = theta, judged(), 0
    if not math.isfinite(best_loss):
        raise ValueError(f"validation: expected a finite loss at the start, got {best_loss}")
    compiled = time.perf_counter()
    rule = optimiser if optimiser is not None else _ADAM if minibatch is not None else _LBFGS
    state, losses, traces, stale = rule.init(theta), [best_loss], [], 0

    def so_far() -> Fit:
        trace = jax.tree.map(lambda *xs: np.stack(xs), *traces)
        seconds = compiled - began, time.perf_counter() - compiled
        return Fit(params_of(best), best_loss, np.array(losses), trace, best_epoch, stale >= patience, *seconds)

    keys = None if key is None else jax.random.split(key, (epochs, steps))
    for epoch in range(epochs):
        for step in range(steps):
            some = batch if keys is None or minibatch is None else _drawn(keys[epoch, step], batch, minibatch)
            here, there = evaluated(theta, some) if known is None else known, theta
            if rule is _LBFGS:
                direction, state = _direction(here.gradient, state, theta)
                theta, known = _line_search(evaluated, theta, direction, here)
                taken = known is not here
            else:
                theta, state, taken = _updated(rule, objective, theta, state, here, params, some)
                known = None
            values = jax.tree.map(np.asarray, _named(blocks, there, params, batch)[1])
            traces.append(Trace(here.loss, _norm(here.gradient), not taken, evaluations, values))
            evaluations = 0
        losses.append(judged())
        stale = 0 if losses[-1] < best_loss - tolerance * (losses[0] - best_loss) else stale + 1
        if losses[-1] < best_loss:
            best, best_loss, best_epoch = theta, losses[-1], epoch + 1
        if progress is not None:
            progress(so_far())
        if stale >= patience:
            break
    return so_far()


@functools.partial(jax.jit, static_argnums=2)
def _drawn(key: jax.Array, batch: Batch, size: int) -> Batch:
    """Sequences of a batch, without repetition."""
    return pick(batch, jax.random.choice(key, len(batch.counted), (size,), replace=False))


@functools.partial(jax.jit, static_argnums=(0, 1))
def _updated(
    rule: optax.GradientTransformation,
    objective: Objective,
    theta: Coordinates,
    state: Any,
    here: Evaluation,
    params: Params,
    batch: Batch,
) -> tuple[Coordinates, Any, jax.Array]:
    """One step of an optimiser, and whether it was taken: not where something is not finite."""

    def value(theta: Coordinates) -> jax.Array:
        return _of_coordinates(objective)(theta, (params, batch))[0]

    extra = {"value": here.loss, "grad": here.gradient, "value_fn": value}  # for those that search along a line
    with jax.numpy_dtype_promotion("standard"):  # optax mixes integers of different widths
        updates, after = optax.with_extra_args_support(rule).update(here.gradient, state, theta, **extra)
    moved = optax.apply_updates(theta, updates)
    fine = jnp.isfinite(here.loss) & jnp.isfinite(optax.tree.norm(here.gradient)) & jnp.isfinite(optax.tree.norm(moved))
    kept = jax.tree.map(lambda new, old: jnp.where(fine, new, old), (moved, after), (theta, state))
    return *kept, fine


@jax.jit
def _direction(gradient: Coordinates, state: Any, theta: Coordinates) -> tuple[Coordinates, Any]:
    """The direction of L-BFGS, and what it remembers."""
    with jax.numpy_dtype_promotion("standard"):
        step, state = _LBFGS.update(gradient, state, theta)
    return jax.tree.map(jnp.negative, step), state


def _line_search(
    evaluated: Callable[[Coordinates], Evaluation], theta: Coordinates, direction: Coordinates, here: Evaluation
) -> tuple[Coordinates, Evaluation]:
    """A point along the direction at which the loss has fallen enough (Armijo) and its slope has flattened (the weak
    Wolfe condition), by bisection; the best on the way where none is met in `_SEARCHES` evaluations, and the start
    where none is better. A loss that is not finite counts as one that rose.

    Source: Lewis & Overton 2013, algorithm 2.6.
    """
    slope = _along(here.gradient, direction)
    low, high, far, best = 0.0, math.inf, 1.0, (theta, here)
    for _ in range(_SEARCHES):
        there = {name: x + jnp.asarray(far, x.dtype) * direction[name] for name, x in theta.items()}
        found = evaluated(there)
        if found.finite and found.loss < best[1].loss:
            best = there, found
        if not found.finite or found.loss > here.loss + _ARMIJO * far * slope:
            high = far
        elif _along(found.gradient, direction) < _WOLFE * slope:
            low = far
        else:
            return there, found
        far = 2 * far if math.isinf(high) else (low + high) / 2
    return best


def _along(gradient: Coordinates, direction: Coordinates) -> float:
    return sum(float(gradient[name]) * float(direction[name]) for name in gradient)


def _norm(gradient: Coordinates) -> float:
    return _along(gradient, gradient) ** 0.5
