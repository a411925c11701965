"""The capstone run as a course teaches it: one robot, NumPy arrays of three numbers, Python loops over cells and walls.

Not written for speed. It is what a study of a thousand runs costs where nobody thought of one; `benchmark.py` times
it. The equations are the course's, chapter 20, lesson 3; the clamp after every cell and the beams that are left out
where they end outside the map are its own too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np


@dataclass
class Settings:
    """The course's numbers."""

    steps: int = 240
    dt: float = 0.1  # s
    q_v: float = 0.02  # m/s
    q_w: float = 0.03  # rad/s
    r_range: float = 0.15  # m
    r_bearing: float = 0.03  # rad
    gate: float = 9.21
    sight_range: float = 7.5  # m
    max_range: float = 8.0  # m
    beams: int = 61
    resolution: float = 0.2  # m
    cells: int = 120
    l_occ: float = 0.85
    l_free: float = -0.40
    l_min: float = -4.0
    l_max: float = 4.0
    landmarks: list[tuple[float, float]] = field(
        default_factory=lambda: [(2.0, 10.0), (10.0, 2.5), (9.5, 10.5), (2.0, 5.5)]
    )
    walls: list[tuple[float, float, float, float]] = field(
        default_factory=lambda: [
            (0.0, 0.0, 12.0, 0.0),
            (12.0, 0.0, 12.0, 12.0),
            (12.0, 12.0, 0.0, 12.0),
            (0.0, 12.0, 0.0, 0.0),
            (4.5, 4.0, 7.5, 4.0),
            (7.5, 4.0, 7.5, 6.5),
            (7.5, 6.5, 4.5, 6.5),
            (4.5, 6.5, 4.5, 4.0),
        ]
    )


def wrap(angle: float) -> float:
    """The angle in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


class Localizer:
    """An extended Kalman filter of the pose (x, y, theta)."""

    def __init__(self, settings: Settings):
        self.settings = settings
        self.mean = np.array([1.0, 1.0, 0.0])
        self.cov = np.diag([0.05, 0.05, 0.02])

    def predict(self, v: float, w: float) -> None:
        """Drive along the arc; the covariance takes the first-order Jacobians."""
        s, dt = self.settings, self.settings.dt
        x, y, theta = self.mean
        if abs(w) < 1e-6:
            x, y = x + v * math.cos(theta) * dt, y + v * math.sin(theta) * dt
            turned = theta
        else:
            turned = theta + w * dt
            x = x + v / w * (math.sin(turned) - math.sin(theta))
            y = y - v / w * (math.cos(turned) - math.cos(theta))
        F = np.eye(3)
        F[0, 2] = -v * math.sin(theta) * dt
        F[1, 2] = v * math.cos(theta) * dt
        G = np.array([[math.cos(theta) * dt, 0.0], [math.sin(theta) * dt, 0.0], [0.0, dt]])
        Q = np.diag([s.q_v**2, s.q_w**2])
        self.mean = np.array([x, y, wrap(turned)])
        self.cov = F @ self.cov @ F.T + G @ Q @ G.T

    def correct(self, range_: float, bearing: float, landmark: tuple[float, float]) -> None:
        """Correct by one landmark if the gate lets it in, in Joseph form."""
        s = self.settings
        dx, dy = landmark[0] - self.mean[0], landmark[1] - self.mean[1]
        q = dx * dx + dy * dy
        if q < 1e-9:
            return
        r = math.sqrt(q)
        innovation = np.array([range_ - r, wrap(bearing - wrap(math.atan2(dy, dx) - self.mean[2]))])
        H = np.array([[-dx / r, -dy / r, 0.0], [dy / q, -dx / q, -1.0]])
        R = np.diag([s.r_range**2, s.r_bearing**2])
        S_inverse = np.linalg.inv(H @ self.cov @ H.T + R)
        if float(innovation @ S_inverse @ innovation) > s.gate:
            return
        K = self.cov @ H.T @ S_inverse
        self.mean = self.mean + K @ innovation
        self.mean[2] = wrap(self.mean[2])
        rest = np.eye(3) - K @ H
        self.cov = rest @ self.cov @ rest.T + K @ R @ K.T


class Grid:
    """Log-odds of occupancy."""

    def __init__(self, settings: Settings):
        self.settings = settings
        self.log_odds = np.zeros((settings.cells, settings.cells))

    def cell(self, x: float, y: float) -> tuple[int, int]:
        """Column and row of a point."""
        return int(x / self.settings.resolution), int(y / self.settings.resolution)

    def inside(self, column: int, row: int) -> bool:
        """Whether the cell is on the map."""
        return 0 <= column < self.settings.cells and 0 <= row < self.settings.cells

    def change(self, column: int, row: int, amount: float) -> None:
        """Add to one cell and clamp it."""
        s = self.settings
        self.log_odds[row, column] = np.clip(self.log_odds[row, column] + amount, s.l_min, s.l_max)

    def add(self, pose: np.ndarray, ranges: np.ndarray, angles: np.ndarray) -> None:
        """One scan at a pose."""
        s = self.settings
        x, y, theta = pose
        start = self.cell(x, y)
        if not self.inside(*start):
            return
        for range_, angle in zip(ranges, angles, strict=True):
            if range_ <= 0.05:
                continue
            reach = min(range_, s.max_range)
            end = self.cell(x + reach * math.cos(theta + angle), y + reach * math.sin(theta + angle))
            if not self.inside(*end):
                continue
            line = bresenham(*start, *end)
            for column, row in line[:-1]:
                self.change(column, row, s.l_free)
            if range_ < s.max_range:
                self.change(*line[-1], s.l_occ)


def bresenham(column: int, row: int, last_column: int, last_row: int) -> list[tuple[int, int]]:
    """The cells of a line, both ends included."""
    width, height = abs(last_column - column), abs(last_row - row)
    right, up = (1 if column < last_column else -1), (1 if row < last_row else -1)
    error = width - height
    cells = [(column, row)]
    while (column, row) != (last_column, last_row):
        twice = 2 * error
        if twice > -height:
            error -= height
            column += right
        if twice < width:
            error += width
            row += up
        cells.append((column, row))
    return cells


def distance_to_wall(x: float, y: float, dx: float, dy: float, wall: tuple[float, float, float, float]) -> float | None:
    """How far a beam flies to a wall, None where it misses."""
    ax, ay, bx, by = wall
    wx, wy = bx - ax, by - ay
    det = dx * wy - dy * wx
    if abs(det) < 1e-9:
        return None
    along_wall = (dx * (y - ay) - dy * (x - ax)) / det
    distance = (wx * (y - ay) - wy * (x - ax)) / det
    return distance if 0.0 <= along_wall <= 1.0 and distance >= 0.0 else None


def scan(pose: np.ndarray, angles: np.ndarray, settings: Settings, random: np.random.RandomState) -> np.ndarray:
    """What the scanner measures at the true pose."""
    x, y, theta = pose
    ranges = np.zeros(len(angles))
    for i, angle in enumerate(angles):
        dx, dy = math.cos(theta + angle), math.sin(theta + angle)
        nearest = settings.max_range
        for wall in settings.walls:
            distance = distance_to_wall(x, y, dx, dy, wall)
            if distance is not None and distance < nearest:
                nearest = distance
        ranges[i] = max(0.05, nearest + random.normal(0.0, 0.03))
    return ranges


def run(seed: int, settings: Settings | None = None) -> dict[str, float]:
    """One drive with its map, and how far off the robot was."""
    s = settings or Settings()
    random = np.random.RandomState(seed)
    truth = np.array([1.0, 1.0, 0.0])
    localizer, grid = Localizer(s), Grid(s)
    angles = np.linspace(-1.2, 1.2, s.beams)
    square, nees = [], []
    for k in range(s.steps):
        v, w = 0.35 + 0.05 * math.sin(0.05 * k), 0.25 * math.sin(0.03 * k)
        truth[0] += v * math.cos(truth[2]) * s.dt
        truth[1] += v * math.sin(truth[2]) * s.dt
        truth[2] = wrap(truth[2] + w * s.dt + random.normal(0.0, 0.005))
        localizer.predict(v + random.normal(0.0, 0.02), w + random.normal(0.0, 0.01))
        if k % 5 == 0:
            for landmark in s.landmarks:
                dx, dy = landmark[0] - truth[0], landmark[1] - truth[1]
                range_ = math.hypot(dx, dy) + random.normal(0.0, 0.08)
                bearing = wrap(math.atan2(dy, dx) - truth[2] + random.normal(0.0, 0.02))
                if range_ < s.sight_range:
                    localizer.correct(range_, bearing, landmark)
        grid.add(localizer.mean, scan(truth, angles, s, random), angles)
        error = truth - localizer.mean
        error[2] = wrap(error[2])
        square.append(error[0] ** 2 + error[1] ** 2)
        nees.append(float(error @ np.linalg.solve(localizer.cov, error)))
    return {
        "rmse_position_m": float(np.sqrt(np.mean(square))),
        "nees_mean": float(np.mean(nees)),
        "occupancy_mean": float(np.mean(1 / (1 + np.exp(-grid.log_odds)))),
    }


if __name__ == "__main__":
    print(run(seed=4))
