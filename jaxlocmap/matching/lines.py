"""The map that scans are matched on: a grid in which every cell keeps sums over the surface points near it.

    A = Σ w n nᵀ,  b = Σ w n nᵀ (p - c),  W = Σ w

p is a point, n its normal, c the centre of the cell and w a weight that falls linearly to zero two cells from p in
either direction. A is what the cell knows of the direction of the walls in it, and A⁻¹ b where they stand, as far as A
has an inverse: along a wall nothing is known and nothing is claimed. A sum over points needs no order, the sign of a
normal does not matter, and a thin wall may be seen from both sides.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import checks
from jaxlocmap._internal.batching import any_in_batch
from jaxlocmap._internal.linalg import stack_scalars
from jaxlocmap._internal.trig import sin_cos
from jaxlocmap.matching.normals import Points
from jaxlocmap.se2 import POSE
from jaxlocmap.types import GridSpec

SUMS = 6  # of a cell: A (xx, xy, yy), b (x, y), W
REACH = 0.3  # m: a point farther off a line than this does not belong to it
_LEAST_WEIGHT = 0.05  # W of a cell that knows anything: half a point at its corner
_LEAST_AGREEMENT = 0.5  # share of the weight whose normals agree with that of a point


class Fit(NamedTuple):
    """How the points of a scan lie on the lines of a map, at one pose."""

    hessian: jax.Array  # (3, 3) 1, 1, m^2 on the diagonal: sum of w J' J, J the derivative of a residual by the pose
    slope: jax.Array  # (3,) m, m, m^2: sum of w J' r
    residual: jax.Array  # (B,) m, distance of each point from its line; 0 where not used
    direction: jax.Array  # (B, 2) derivative of each by the place of its point: along the normal of the map
    used: jax.Array  # (B,) bool: the point has a line
    weight: jax.Array  # (B,) share of each point that counts; 0 where not used


def add_points(
    lines: jax.Array,
    pose: jax.Array,
    points: Points,
    *,
    spec: GridSpec,
    counts: jax.Array | bool = True,
    at: int | jax.Array = 0,
) -> jax.Array:
    """The map with the points of one more scan.

    Args:
        lines: (maps * rows, columns, 6), zeros for one that knows nothing: one map, or several in one array.
        pose: (3,) m, m, rad, of the robot in the map's frame.
        points: of the scan, in the robot's frame; those outside the map are left out.
        spec: of one map; its bounds on log-odds do not matter.
        counts: () bool; False adds nothing.
        at: () which of the maps.

    Raises:
        ValueError: a wrong shape.
    """
    rows, columns = _check(lines, pose, points, spec)
    x, y, normal_x, normal_y, *_ = placed(pose, points)
    (column, u), (row, v) = _in_cells(x, y, spec)
    # The cells two to either side at once, (16, B): cell by cell they would take long to compile.
    i, j = np.indices((4, 4)).reshape(2, -1, 1) - 1
    du, dv = u[None] - jnp.asarray(j, u.dtype), v[None] - jnp.asarray(i, v.dtype)
    row, column = row[None] + jnp.asarray(i, row.dtype), column[None] + jnp.asarray(j, column.dtype)
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    w = jnp.where(points.valid[None] & inside & counts, (1 - jnp.abs(du) / 2) * (1 - jnp.abs(dv) / 2), 0)
    normal_x, normal_y = normal_x[None], normal_y[None]
    off = (normal_x * du + normal_y * dv) * spec.resolution
    n = (normal_x * normal_x, normal_x * normal_y, normal_y * normal_y, normal_x * off, normal_y * off)
    sums = jnp.stack([*(w * term for term in n), w], axis=-1)
    index = (jnp.clip(row, 0, rows - 1) + at * rows) * columns + jnp.clip(column, 0, columns - 1)
    flat = lines.reshape(-1, SUMS)
    flat = flat.at[index].add(sums, mode="promise_in_bounds")
    return flat.reshape(lines.shape)


def fit(
    lines: jax.Array, pose: jax.Array, points: Points, scale: jax.Array, *, spec: GridSpec, at: int | jax.Array = 0
) -> Fit:
    """How far the points of a scan lie off the lines of the map, and how that changes with the pose.

        r = mᵀ (A q - b) / (mᵀ A m),  J = mᵀ A [I, (R p)^⊥] / (mᵀ A m)
        w = (mᵀ A m / W) (1 - (r / REACH)²) / (1 + (r / scale)²)

    q is the point in the map's frame, m its normal there, and the sums are read between the centres of four cells, each
    about its own centre. A m points along the map's own normal, an average over many points. The normal of one point is
    noisy: a derivative along it would tell of the place along a wall, of which nothing is known. A point is left out
    where W is small, where the normals of the map do not agree with its own, or where it lies `REACH` or farther off
    its line.

    Args:
        lines, pose, points, spec, at: as of `add_points`.
        scale: () m, of the Cauchy weight: a point that far off its line counts half.

    The weight fades to nothing at `REACH`, so that a point that leaves its line makes no jump.

    Source: Biber & Strasser 2003 (a grid of local surfaces); Censi 2008 (point to line); the weight Cauchy's.

    Raises:
        ValueError: a wrong shape.
    """
    rows, columns = _check(lines, pose, points, spec)
    checks.shape("scale", scale, ())
    x, y, normal_x, normal_y, arm_x, arm_y, _ = placed(pose, points)
    (column, u), (row, v) = _in_cells(x, y, spec)
    inside = (row >= 0) & (row < rows - 1) & (column >= 0) & (column < columns - 1)
    column, row = jnp.clip(column, 0, columns - 2), jnp.clip(row, 0, rows - 2)
    flat = lines.reshape(-1, SUMS)
    xx = xy = yy = off_x = off_y = weight = jnp.zeros_like(x)
    for i in (0, 1):
        for j in (0, 1):
            cell = flat.at[(row + i + at * rows) * columns + column + j].get(mode="promise_in_bounds")
            w = (u if j else 1 - u) * (v if i else 1 - v)
            dx, dy = (u - j) * spec.resolution, (v - i) * spec.resolution
            a, b, c = cell[:, 0], cell[:, 1], cell[:, 2]
            xx, xy, yy, weight = xx + w * a, xy + w * b, yy + w * c, weight + w * cell[:, 5]
            off_x = off_x + w * (a * dx + b * dy - cell[:, 3])
            off_y = off_y + w * (b * dx + c * dy - cell[:, 4])
    along_x, along_y = normal_x * xx + normal_y * xy, normal_x * xy + normal_y * yy  # A m
    agree = normal_x * along_x + normal_y * along_y
    known = points.valid & inside & (weight > _LEAST_WEIGHT) & (agree > _LEAST_AGREEMENT * weight)
    per_agree = 1 / jnp.where(known, agree, 1)
    residual = (normal_x * off_x + normal_y * off_y) * per_agree
    used = known & (jnp.abs(residual) < REACH)
    residual = jnp.where(used, residual, 0)
    share = jnp.where(used, agree / jnp.where(used, weight, 1) * _robust(residual, scale), 0)
    J_x, J_y = along_x * per_agree, along_y * per_agree
    J = J_x, J_y, J_y * arm_x - J_x * arm_y
    hessian = [[jnp.sum(share * J[min(i, j)] * J[max(i, j)]) for j in range(POSE)] for i in range(POSE)]
    slope = jnp.stack([jnp.sum(share * Ji * residual) for Ji in J])
    return Fit(stack_scalars(hessian), slope, residual, jnp.stack([J_x, J_y], axis=-1), used, share)


@jax.custom_jvp
def cleared(lines: jax.Array, clear: jax.Array, after: jax.Array) -> jax.Array:
    """Maps in one array, some of them cleared. Under `vmap` that takes time only where a run of the batch clears one.

    Args:
        lines: (maps * rows, columns, 6).
        clear: (maps,) bool, which to clear.
        after: () something computed from the maps before, of any value. By its derivative the compiler knows that
            derivatives of the maps are read before they are cleared, and need not be copied.
    """
    some = any_in_batch(jnp.any(clear)).astype(int)
    # Not a branch: one inside a loop makes the compiler copy the maps (jaxlib 0.10 on CPUs, under `shard_map`).
    return jax.lax.fori_loop(0, some, lambda _, lines: _set(lines, clear, jnp.zeros_like(after)), lines)


@cleared.defjvp
def _cleared_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[jax.Array, jax.Array]:
    """Along the maps, with a branch after all: a loop of unknown length has no derivative backwards."""
    (_, clear, after), (lines_dot, _, after_dot) = primals, tangents
    zero = 0 * jnp.where(jnp.isfinite(after), after_dot, 0)
    some = any_in_batch(jnp.any(clear))
    return cleared(*primals), jax.lax.cond(some, lambda x: _set(x, clear, zero), lambda x: x, lines_dot)


def _set(lines: jax.Array, which: jax.Array, value: jax.Array) -> jax.Array:
    """Maps in one array, everything in some of them set to a value."""
    maps = len(which)
    flat = lines.reshape(maps, -1)
    for i in range(maps):
        # That the index is unique, as one alone is, makes the derivative a plain copy.
        flat = flat.at[jnp.where(which[i], i, maps)].set(value, mode="drop", unique_indices=True)
    return flat.reshape(lines.shape)


def overlap(
    lines: jax.Array,
    position: jax.Array,
    turned: Placed,
    scale: jax.Array,
    *,
    spec: GridSpec,
    at: int | jax.Array = 0,
) -> jax.Array:
    """How many points lie on lines of the map, each by its weight, read from the nearest cell alone.

    Args:
        lines, scale, spec, at: as of `fit`.
        position: (2,) m, of the robot.
        turned: the points of the scan as `placed` at the origin, with the robot's heading.

    Returns:
        () between 0 and the number of points.
    """
    rows, columns = spec.shape
    corners = _in_cells(
        position[0] + turned.x + spec.resolution / 2, position[1] + turned.y + spec.resolution / 2, spec
    )
    (column, u), (row, v) = corners
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    index = (jnp.clip(row, 0, rows - 1) + at * rows) * columns + jnp.clip(column, 0, columns - 1)
    xx, xy, yy, b_x, b_y, weight = jnp.moveaxis(lines.reshape(-1, SUMS).at[index].get(mode="promise_in_bounds"), -1, 0)
    dx, dy, n_x, n_y = (u - 0.5) * spec.resolution, (v - 0.5) * spec.resolution, turned.normal_x, turned.normal_y
    agree = n_x * n_x * xx + 2 * n_x * n_y * xy + n_y * n_y * yy
    known = turned.valid & inside & (weight > _LEAST_WEIGHT) & (agree > _LEAST_AGREEMENT * weight)
    off = n_x * (xx * dx + xy * dy - b_x) + n_y * (xy * dx + yy * dy - b_y)
    residual = off / jnp.where(known, agree, 1)
    return jnp.sum(jnp.where(known, agree / jnp.where(known, weight, 1) * _robust(residual, scale), 0))


def _robust(residual: jax.Array, scale: jax.Array) -> jax.Array:
    """The weight of a point by its distance from its line."""
    return jnp.maximum(1 - (residual / REACH) ** 2, 0) / (1 + (residual / scale) ** 2)


class Placed(NamedTuple):
    """Points of a scan in the map's frame, (B,) each."""

    x: jax.Array  # m
    y: jax.Array
    normal_x: jax.Array
    normal_y: jax.Array
    arm_x: jax.Array  # m, from the robot to the point, in the map's frame
    arm_y: jax.Array
    valid: jax.Array  # bool


def placed(pose: jax.Array, points: Points) -> Placed:
    """The points of a scan taken at a pose (3,)."""
    sin, cos = sin_cos(pose[2])

    def turned(vectors: jax.Array) -> tuple[jax.Array, jax.Array]:
        x, y = vectors[:, 0], vectors[:, 1]
        return cos * x - sin * y, sin * x + cos * y

    arm_x, arm_y = turned(points.xy)
    return Placed(pose[0] + arm_x, pose[1] + arm_y, *turned(points.normal), arm_x, arm_y, points.valid)


def _in_cells(x: jax.Array, y: jax.Array, spec: GridSpec) -> list[tuple[jax.Array, jax.Array]]:
    """The column and the row whose centre is next below each point, and how far beyond it the point is, in cells."""
    cells = []
    for value, origin in ((x, spec.origin[0]), (y, spec.origin[1])):
        position = (value - origin) * (1 / spec.resolution) - 0.5
        whole = jnp.floor(position)
        cells.append((whole.astype(jnp.int32), position - whole))
    return cells


def _check(lines: jax.Array, pose: jax.Array, points: Points, spec: GridSpec) -> tuple[int, int]:
    rows, columns = spec.shape
    checks.shapes(lines=(lines, (None, columns, SUMS)), pose=(pose, (POSE,)))
    if len(lines) % rows:
        raise ValueError(f"lines: expected maps of {rows} rows, got {len(lines)} rows")
    checks.shapes(xy=(points.xy, (None, 2)), normal=(points.normal, (len(points.xy), 2)))
    return rows, columns
