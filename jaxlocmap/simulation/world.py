"""What stands around a robot: walls and landmarks, what a laser sees of them, and the map they ought to give."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import checks
from jaxlocmap._internal.batching import scan, zero_of
from jaxlocmap._internal.trig import sin_cos
from jaxlocmap.se2 import POSE
from jaxlocmap.types import GridSpec


class World(NamedTuple):
    """What stands around the robot."""

    segments: jax.Array  # (S, 2, 2) m: walls, from point to point
    landmarks: jax.Array  # (L, 2) m


def room() -> World:
    """A room of 12 x 12 m with one box in it and four landmarks."""
    corners = [
        [(0.0, 0.0), (12.0, 0.0), (12.0, 12.0), (0.0, 12.0)],
        [(4.5, 4.0), (7.5, 4.0), (7.5, 6.5), (4.5, 6.5)],
    ]
    walls = [(ring[i], ring[(i + 1) % 4]) for ring in corners for i in range(4)]
    return World(
        segments=jnp.array(walls),
        landmarks=jnp.array([[2.0, 10.0], [10.0, 2.5], [9.5, 10.5], [2.0, 5.5]]),
    )


_CORRIDOR, _PARTITIONS = (8.8, 11.2), (11.0, 23.0)  # m: y of its walls, x of those between rooms
_DOORS = (
    np.array([5.0, 17.0, 29.0]),
    np.array([4.0, 16.0]),
)  # m: x of the doors to the corridor, y of those between rooms
_FURNITURE = np.array(
    [
        (2.0, 1.0, 3.5, 2.0),
        (8.0, 6.0, 9.0, 7.5),
        (14.0, 6.0, 15.0, 7.5),
        (19.0, 1.0, 21.0, 2.0),
        (31.0, 2.0, 32.5, 5.0),
        (26.0, 18.0, 28.0, 19.0),
        (13.0, 13.0, 14.5, 14.0),
        (6.5, 18.0, 9.0, 19.0),
    ]
)  # m: from (x, y) to (x, y)
_CLEAR = np.array(
    [
        (0.3, 0.3, 10.7, 3.4),
        (7.2, 4.6, 10.7, 8.5),
        (11.3, 4.6, 22.7, 8.5),
        (11.3, 0.3, 22.7, 3.4),
        (29.7, 0.3, 33.7, 8.5),
        (23.3, 16.6, 33.7, 19.7),
        (11.3, 11.5, 22.7, 15.4),
        (0.3, 16.6, 10.7, 19.7),
    ]
)  # m: where each piece may stand and the tour of the building passes 0.6 m or farther away
_AJAR, _WIDEST = 0.45, 1.2  # m: from where the tour passes a door to its posts, at least and at most
_UNUSED, _SHIFT = 1, 3.0  # the door to the corridor that the tour does not pass, and m how far it may be elsewhere


def building() -> World:
    """A building of 34 x 20 m: a corridor along its middle, three rooms on either side, doors of 1.2 m, furniture, no
    landmark.
    """
    to_corridor, between_rooms = (doors[:, None] + np.array([-0.6, 0.6]) for doors in _DOORS)
    return _furnished(np.stack([to_corridor] * 2), np.stack([between_rooms] * 2), _FURNITURE)


def random_building(key: jax.Array) -> World:
    """`building` with its doors wider or narrower and moved, and its furniture elsewhere in the same rooms.

    The tour of the building scenario leads through the same doors, 0.45 m or more from their posts and 0.6 m or more
    from the furniture.
    """
    of_posts, of_shifts, of_places = jax.random.split(key, 3)
    dtype = jnp.result_type(float)
    side = _AJAR + (_WIDEST - _AJAR) * jax.random.uniform(of_posts, (2, 5, 2), dtype)
    shift = _SHIFT * jax.random.uniform(of_shifts, (2,), dtype, -1.0, 1.0)
    middle = jnp.asarray(np.concatenate(_DOORS), dtype)[None]
    posts = jnp.stack([middle - side[..., 0], middle + side[..., 1]], axis=-1)
    posts = posts.at[:, _UNUSED].add(shift[:, None])
    size = jnp.asarray(_FURNITURE[:, 2:] - _FURNITURE[:, :2], dtype)
    free = jnp.asarray(_CLEAR[:, 2:] - _CLEAR[:, :2], dtype) - size
    corner = jnp.asarray(_CLEAR[:, :2], dtype) + free * jax.random.uniform(of_places, free.shape, dtype)
    return _furnished(posts[:, :3], posts[:, 3:], jnp.concatenate([corner, corner + size], axis=1))


def _furnished(to_corridor: Any, between_rooms: Any, furniture: Any) -> World:
    """A building of these doors and furniture.

    Args:
        to_corridor: (2, 3, 2) m: x of the posts of the doors in the lower and the upper wall of the corridor.
        between_rooms: (2, 2, 2) m: y of those in either partition, in the lower and the upper row of rooms.
        furniture: (F, 4) m: from (x, y) to (x, y).
    """
    walls = [(0.0, 0.0, 34.0, 0.0), (34.0, 0.0, 34.0, 20.0), (34.0, 20.0, 0.0, 20.0), (0.0, 20.0, 0.0, 0.0)]
    for y, doors in zip(_CORRIDOR, to_corridor, strict=True):
        edges = [0.0, *doors.ravel(), 34.0]
        walls += [(a, y, b, y) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    for x, doors in zip(_PARTITIONS, between_rooms, strict=True):
        for (low, high), door in zip(((0.0, 8.8), (11.2, 20.0)), doors, strict=True):
            walls += [(x, low, x, door[0]), (x, door[1], x, high)]
    for x0, y0, x1, y1 in furniture:
        walls += [(x0, y0, x1, y0), (x1, y0, x1, y1), (x1, y1, x0, y1), (x0, y1, x0, y0)]
    return World(segments=jnp.array(walls).reshape(-1, 2, 2), landmarks=jnp.zeros((0, 2)))


def random_room(key: jax.Array) -> World:
    """`room` with its box elsewhere, half a metre or more from the walls, its sides 1 to 4 m long. The same landmarks.

    A drive may lead through the box, as that of the capstone scenario does in `room`: the plant knows no collisions.
    """
    plain = room()
    low, high, margin = 0.0, 12.0, 0.5
    sizes, places = jax.random.uniform(key, (2, 2), plain.segments.dtype)
    size = 1 + 3 * sizes
    corner = low + margin + places * (high - low - 2 * margin - size)
    x, y = (jnp.stack([corner[i], corner[i] + size[i]]) for i in (0, 1))
    ring = jnp.stack([jnp.stack([x[i], y[j]]) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))])
    box = jnp.stack([ring, jnp.roll(ring, -1, axis=0)], axis=1)
    return plain._replace(segments=jnp.concatenate([plain.segments[:4], box]))


def ray_cast(pose: jax.Array, beam_angles: jax.Array, segments: jax.Array, max_range: float) -> jax.Array:
    """Distance along each beam to the nearest wall, `max_range` where there is none.

    Args:
        pose: (3,) m, m, rad.
        beam_angles: (B,) rad, body frame.
        segments: (S, 2, 2) m.

    Returns:
        (B,) m.

    Raises:
        ValueError: a wrong shape.
    """
    checks.shapes(pose=(pose, (POSE,)), beam_angles=(beam_angles, (None,)), segments=(segments, (None, 2, 2)))
    checks.shape("max_range", max_range, ())
    sin, cos = sin_cos(pose[2])
    table_cos, table_sin = jnp.cos(beam_angles), jnp.sin(beam_angles)
    dx, dy = cos * table_cos - sin * table_sin, sin * table_cos + cos * table_sin

    def nearer(nearest: jax.Array, segment: jax.Array) -> tuple[jax.Array, None]:
        # pose + t d = a + s wall, by Cramer's rule
        wall_x, wall_y = segment[1, 0] - segment[0, 0], segment[1, 1] - segment[0, 1]
        away_x, away_y = pose[0] - segment[0, 0], pose[1] - segment[0, 1]
        det = dx * wall_y - dy * wall_x
        across = 1 / jnp.where(jnp.abs(det) < 1e-9, 1, det)  # a beam along the wall does not hit it
        s = (dx * away_y - dy * away_x) * across
        t = (wall_x * away_y - wall_y * away_x) * across
        hits = (jnp.abs(det) >= 1e-9) & (s >= 0) & (s <= 1) & (t >= 0)
        return jnp.where(hits, jnp.minimum(nearest, t), nearest), None

    # Beams side by side, wall after wall: a minimum over a short last axis would not be vector code.
    return scan(
        nearer, jnp.full(dx.shape, max_range, dx.dtype), segments, unroll=8, zero=zero_of(dx, segments, max_range)
    )[0]


def occupancy(world: World, spec: GridSpec) -> jax.Array:
    """The true map: the cells a wall runs through. A wall along the edge of two cells occupies both.

    Returns:
        (rows, columns) bool.

    Raises:
        ValueError: walls of a wrong shape.
    """
    checks.shape("world.segments", world.segments, (None, 2, 2))
    rows, columns = spec.shape
    dtype = world.segments.dtype
    reach = spec.resolution * 1e-3  # a wall on the edge must not depend on rounding
    low_x = spec.origin[0] + spec.resolution * jnp.arange(columns, dtype=dtype)[None, :] - reach
    low_y = spec.origin[1] + spec.resolution * jnp.arange(rows, dtype=dtype)[:, None] - reach
    size = spec.resolution + 2 * reach

    def with_wall(occupied: jax.Array, segment: jax.Array) -> tuple[jax.Array, None]:
        enter, leave = jnp.zeros((), dtype), jnp.ones((), dtype)
        # Clip the wall against every cell, one axis after the other (Liang & Barsky 1984).
        for axis, low in ((0, low_x), (1, low_y)):
            near, step = low - segment[0, axis], segment[1, axis] - segment[0, axis]
            far = near + size
            share = 1 / jnp.where(step != 0, step, 1)
            across = jnp.broadcast_to(step != 0, near.shape)
            between = (near <= 0) & (far >= 0)
            first, last = jnp.minimum(near * share, far * share), jnp.maximum(near * share, far * share)
            enter = jnp.maximum(enter, jnp.where(across, first, jnp.where(between, 0, jnp.inf)))
            leave = jnp.minimum(leave, jnp.where(across, last, jnp.where(between, 1, -jnp.inf)))
        return occupied | (enter <= leave), None

    return scan(with_wall, jnp.zeros(spec.shape, bool), world.segments)[0]
