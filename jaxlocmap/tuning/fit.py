"""Descent: any optax optimiser, in one compiled scan, the best so far kept."""

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

from jaxlocmap.parameters import Params
from jaxlocmap.tuning.batch import Batch, pick
from jaxlocmap.tuning.forward import forward
from jaxlocmap.tuning.losses import Objective
from jaxlocmap.tuning.parameters import NOISE, Coordinates, constrain, correlations_of, natural, unconstrain


class Trace(NamedTuple):
    """What happened at each step, before it was taken. NumPy arrays, leading axis of steps."""

    loss: Any  # (steps,) of the sequences it was taken on
    gradient_norm: Any  # (steps,) by the coordinates
    skipped: Any  # (steps,) bool: something was not finite, so no step was taken
    evaluations: Any  # (steps,) of value and gradient
    params: dict[str, Any]  # (steps,) by name, in the units of `parameters.UNITS`


class Fit(NamedTuple):
    """What a fit found, so far or in the end."""

    params: Params  # the best
    loss: float  # of the best: on the validation set, if there is one
    losses: np.ndarray  # (epochs + 1,) the loss that picks the best, at the start and after every epoch
    trace: Trace
    best_epoch: int  # 0: the start
    stopped_early: bool
    compile_s: float  # of the descent
    run_s: float  # without compilation


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
    objective.check_tuned(tuned)
    params.check()
    blocks = objective.blocks
    whole = unconstrain(params, blocks)
    inside = natural(constrain(whole, blocks), blocks)
    for name, value in natural(params, blocks).items():
        if not np.allclose(value, inside[name], rtol=1e-3, atol=1e-3 if name in correlations_of(blocks) else 0):
            raise ValueError(
                f"{name}: expected a value within the limits of tuning, the nearest being {float(inside[name]):.3g}, "
                f"got {float(value):.3g}"
            )
    fixed = {name: value for name, value in whole.items() if name not in tuned}

    def at(coordinates: Coordinates, batch: Batch) -> Any:
        return objective(constrain(fixed | coordinates, blocks, others=params), batch)

    return forward(at)


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
        optimiser: L-BFGS by default, which wants the whole batch at every step; with minibatches `optax.adam(0.05)`:
            coordinates are logarithms, so that is 5 % a step.
        epochs: at most so many; after each the validation loss is taken and `progress` called.
        steps: of the optimiser in an epoch, one compiled scan.
        minibatch: sequences a step, drawn anew without repetition; all by default.
        key: of the draws.
        validation: what the best is picked by; the batch itself by default.
        patience: stop after so many epochs in which the loss fell by less than `tolerance` of what it fell since the
            start.
        progress: called with the fit so far.

    Returns:
        `Fit`. A step whose loss or gradient is not finite is skipped and counted in its trace.

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
    at = coordinates_objective(objective, params, tuned)
    objective.check(params, batch)
    if optimiser is None:
        optimiser = _lbfgs() if minibatch is None else optax.adam(0.05)
    optimiser = optax.with_extra_args_support(optimiser)
    dtype = jnp.asarray(batch.prior.mean).dtype
    blocks = objective.blocks
    whole = {name: jnp.asarray(value, dtype) for name, value in unconstrain(params, blocks).items()}

    def params_at(theta: Coordinates) -> Params:
        return constrain(whole | theta, blocks, others=params)

    theta = {name: whole[name] for name in tuned}
    judge = validation if validation is not None else batch

    def step(batch: Batch, carry: Any, key: Any) -> Any:
        theta, state = carry
        if minibatch is not None:
            batch = pick(batch, jax.random.choice(key, runs, (minibatch,), replace=False))

        def value(theta: Coordinates) -> jax.Array:
            return at(theta, batch)[0]

        known, fresh = optax.tree.get(state, "value", None), jnp.ones((), bool)
        if minibatch is None and optax.tree.get(state, "grad", None) is not None:  # of a line search, at its end
            fresh = ~jnp.isfinite(known)
            loss, gradient = optax.value_and_grad_from_state(value)(theta, state=state)
        else:
            loss, gradient = jax.value_and_grad(value)(theta)
        norm = optax.tree.norm(gradient)
        updates, after = optimiser.update(gradient, state, theta, value=loss, grad=gradient, value_fn=value)
        moved = optax.apply_updates(theta, updates)
        fine = jnp.isfinite(loss) & jnp.isfinite(norm) & jnp.isfinite(optax.tree.norm(moved))
        kept = jax.tree.map(lambda new, old: jnp.where(fine, new, old), (moved, after), (theta, state))
        evaluations = fresh.astype(jnp.int32) + _line_search_steps(after)
        return kept, Trace(loss, norm, ~fine, evaluations, natural(params_at(theta), blocks))

    @jax.jit
    def epoch(carry: Any, keys: Any, batch: Batch) -> Any:
        return jax.lax.scan(functools.partial(step, batch), carry, keys)

    def judged(theta: Coordinates) -> float:
        return objective.judged(params_at(theta), judge)[0]

    keys = jax.random.split(key, (epochs, steps)) if key is not None else np.zeros((epochs, steps))
    carry = _strong((theta, optimiser.init(theta)))
    began = time.perf_counter()
    best, best_loss, best_epoch = carry[0], judged(carry[0]), 0
    if not math.isfinite(best_loss):
        raise ValueError(f"validation: expected a finite loss at the start, got {best_loss}")
    with jax.numpy_dtype_promotion("standard"):  # optax mixes integers of different widths
        program = epoch.lower(carry, keys[0], batch).compile()
    compiled = time.perf_counter()
    losses, traces, stale = [best_loss], [], 0

    def so_far() -> Fit:
        trace = jax.tree.map(lambda *xs: np.concatenate(xs), *traces)
        seconds = compiled - began, time.perf_counter() - compiled
        return Fit(params_at(best), best_loss, np.array(losses), trace, best_epoch, stale >= patience, *seconds)

    for number in range(epochs):
        carry, trace = program(carry, keys[number], batch)
        traces.append(jax.tree.map(np.asarray, trace))
        losses.append(judged(carry[0]))
        stale = 0 if losses[-1] < best_loss - tolerance * (losses[0] - best_loss) else stale + 1
        if losses[-1] < best_loss:
            best, best_loss, best_epoch = carry[0], losses[-1], number + 1
        if progress is not None:
            progress(so_far())
        if stale >= patience:
            break
    return so_far()


def _lbfgs() -> optax.GradientTransformation:
    # Near the minimum a line search that looks for more digits than there are takes all the steps it may.
    search = optax.scale_by_zoom_linesearch(max_linesearch_steps=6, initial_guess_strategy="one")
    return optax.lbfgs(linesearch=search)


def _strong(tree: Any) -> Any:
    """Arrays of types that do not yield: else the second epoch, which gets what the first returned, compiles anew."""
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(x)), tree)


def _line_search_steps(state: Any) -> Any:
    """How often a line search, if the optimiser has one, evaluated the objective."""
    counted = optax.tree.get_all_with_path(state, "num_linesearch_steps")
    return sum((jnp.asarray(value, jnp.int32) for _, value in counted), jnp.zeros((), jnp.int32))
