"""Slow reference: the same equations in plain NumPy loops, float64, written without looking at the library.

Source: the course text, chapter 20, lesson 3 (equations of its sections 3, 4 and 6; constants, random numbers
and order of events of its Python program). Conventions are those of the design page: pose (x, y, theta) in m,
m, rad with theta in [-pi, pi); control (v, omega); pose error is truth minus estimate with the heading
wrapped; grid[row = y, col = x].
"""

import math

import numpy as np

# Below this squared distance (m^2) a landmark sits on the sensor and its bearing is undefined (course value).
MIN_SQUARED_DISTANCE = 1e-9

# The course's Python program.
COURSE_DT = 0.1
COURSE_PRIOR_MEAN = np.array([1.0, 1.0, 0.0])
COURSE_PRIOR_COV = np.diag([0.05, 0.05, 0.02])
COURSE_Q = np.diag([0.02**2, 0.03**2])
COURSE_R = np.diag([0.15**2, 0.03**2])
COURSE_GATE = 9.21
COURSE_LANDMARKS = np.array([[2.0, 10.0], [10.0, 2.5], [9.5, 10.5], [2.0, 5.5]])
COURSE_VISIBILITY = 7.5
COURSE_ANGLES = np.linspace(-1.2, 1.2, 61)
COURSE_GRID_SHAPE = (120, 120)
COURSE_SCAN = {
    "origin": (0.0, 0.0),
    "resolution": 0.2,
    "l_occ": 0.85,
    "l_free": -0.40,
    "l_min": -4.0,
    "l_max": 4.0,
    "min_range": 0.05,
    "max_range": 8.0,
}
# Corner loops (m): the room, then the box inside it.
COURSE_WALLS = (
    ((0.0, 0.0), (12.0, 0.0), (12.0, 12.0), (0.0, 12.0)),
    ((4.5, 4.0), (7.5, 4.0), (7.5, 6.5), (4.5, 6.5)),
)


def wrap(a):
    """Angle a modulo 2 pi, in [-pi, pi): (a + pi) mod 2 pi - pi. Scalars and arrays.

    The last line is for a just below -pi, where the modulus rounds up to 2 pi itself.
    """
    wrapped = (a + np.pi) % (2.0 * np.pi) - np.pi
    return wrapped - 2.0 * np.pi * (wrapped >= np.pi)


# --- Motion models: (pose (3,), control (2,), dt) -> pose (3,), F = df/dpose (3,3), G = df/dcontrol (3,2) ---


def _first_order_jacobians(theta, v, dt):
    """F and G of the first-order model of section 3, the derivatives of `euler`."""
    c, s = math.cos(theta), math.sin(theta)
    F = np.array([[1.0, 0.0, -v * s * dt], [0.0, 1.0, v * c * dt], [0.0, 0.0, 1.0]])
    G = np.array([[c * dt, 0.0], [s * dt, 0.0], [0.0, dt]])
    return F, G


def euler(pose, control, dt):
    """First-order model of section 3: x + v cos(theta) dt, y + v sin(theta) dt, theta + omega dt."""
    x, y, theta = pose
    v, omega = control
    moved = np.array([x + v * math.cos(theta) * dt, y + v * math.sin(theta) * dt, wrap(theta + omega * dt)])
    return moved, *_first_order_jacobians(theta, v, dt)


def capstone(pose, control, dt):
    """Model of the course's Python program: mean on the circular arc, Jacobians of the first-order model.

    With theta' = theta + omega dt: x + (v / omega) (sin(theta') - sin(theta)), y - (v / omega) (cos(theta') -
    cos(theta)), theta'; for |omega| < 1e-6 a straight line that leaves theta as it was.
    """
    x, y, theta = pose
    v, omega = control
    if abs(omega) < 1e-6:
        turned = theta
        x += v * math.cos(theta) * dt
        y += v * math.sin(theta) * dt
    else:
        turned = theta + omega * dt
        x += (v / omega) * (math.sin(turned) - math.sin(theta))
        y -= (v / omega) * (math.cos(turned) - math.cos(theta))
    return np.array([x, y, wrap(turned)]), *_first_order_jacobians(theta, v, dt)


def _sinc(h):
    """sin(h) / h, by its Taylor series near 0."""
    if abs(h) < 0.5:
        return sum((-1) ** n * h ** (2 * n) / math.factorial(2 * n + 1) for n in range(10))
    return math.sin(h) / h


def _sinc_slope(h):
    """d/dh (sin(h) / h) = (h cos(h) - sin(h)) / h^2, by its Taylor series near 0, where that cancels."""
    if abs(h) < 0.5:
        return sum((-1) ** n * 2 * n * h ** (2 * n - 1) / math.factorial(2 * n + 1) for n in range(1, 11))
    return (h * math.cos(h) - math.sin(h)) / h**2


def arc(pose, control, dt):
    """Exact arc of constant (v, omega), and its exact Jacobians, smooth through omega = 0.

    The arc's chord has length L = v dt sinc(h) and direction theta + h, with h = omega dt / 2:
    x + L cos(theta + h), y + L sin(theta + h), theta + omega dt. Equal to the (v / omega) (sin - sin) form.
    """
    x, y, theta = pose
    v, omega = control
    h = 0.5 * omega * dt
    c, s = math.cos(theta + h), math.sin(theta + h)
    chord = v * dt * _sinc(h)
    chord_by_omega = v * dt * _sinc_slope(h) * 0.5 * dt
    moved = np.array([x + chord * c, y + chord * s, wrap(theta + omega * dt)])
    F = np.array([[1.0, 0.0, -chord * s], [0.0, 1.0, chord * c], [0.0, 0.0, 1.0]])
    G = np.array(
        [
            [dt * _sinc(h) * c, chord_by_omega * c - chord * s * 0.5 * dt],
            [dt * _sinc(h) * s, chord_by_omega * s + chord * c * 0.5 * dt],
            [0.0, dt],
        ]
    )
    return moved, F, G


MOTION = {"euler": euler, "arc": arc, "capstone": capstone}


# --- Filter ---


def predict(mean, cov, control, dt, Q, model, nominal_dt):
    """P = F P F^T + G (Q nominal_dt / dt) G^T (section 3; Q is the covariance over one nominal period).

    `model` is a motion model or its name. G is proportional to dt, so the noise term goes to 0 with dt: at
    dt = 0 it is left out and nothing is divided.
    """
    model = MOTION[model] if isinstance(model, str) else model
    moved, F, G = model(mean, control, dt)
    moved_cov = F @ cov @ F.T
    if dt != 0.0:
        moved_cov = moved_cov + G @ (np.asarray(Q) * (nominal_dt / dt)) @ G.T
    return moved, moved_cov


def expected_observation(pose, landmark, sensor_offset=(0.0, 0.0, 0.0)):
    """h(pose) = (range, bearing) of a landmark (section 3) and H = dh/dpose; None, None if on the sensor.

    The sensor is at p = (x, y) + Rot(theta) (dx, dy) and looks along theta + dtheta, so theta moves p as
    well.
    """
    x, y, theta = pose
    dx, dy, dtheta = sensor_offset
    c, s = math.cos(theta), math.sin(theta)
    to_x = landmark[0] - (x + c * dx - s * dy)
    to_y = landmark[1] - (y + s * dx + c * dy)
    squared = to_x**2 + to_y**2
    if squared < MIN_SQUARED_DISTANCE:
        return None, None
    distance = math.sqrt(squared)
    px, py = -s * dx - c * dy, c * dx - s * dy  # dp/dtheta
    h = np.array([distance, wrap(math.atan2(to_y, to_x) - (theta + dtheta))])
    H = np.array(
        [
            [-to_x / distance, -to_y / distance, -(to_x * px + to_y * py) / distance],
            [to_y / squared, -to_x / squared, (to_y * px - to_x * py) / squared - 1.0],
        ]
    )
    return h, H


def correct(mean, cov, z, landmark, R, gate, sensor_offset=(0.0, 0.0, 0.0)):
    """One range-bearing correction (section 3), gated, covariance in Joseph form (section 6, result 1).

    r = z - h, S = H P H^T + R, K = P H^T S^-1, d2 = r^T S^-1 r, log N(r; 0, S) = -(d2 + log det(2 pi S)) / 2,
    P = (I - K H) P (I - K H)^T + K R K^T. `gate` is the largest d2 accepted, or None for no gate. Returns
    mean, cov, innovation, S, d2, accepted, log_likelihood; if not accepted, mean and cov are the given ones
    and the rest is reported all the same. A landmark on the sensor: not accepted, and zeros.
    """
    h, H = expected_observation(mean, landmark, sensor_offset)
    if h is None:
        return mean, cov, np.zeros(2), np.zeros((2, 2)), 0.0, False, 0.0
    innovation = np.array([z[0] - h[0], wrap(z[1] - h[1])])
    S = H @ cov @ H.T + R
    S_inv = np.linalg.inv(S)
    d2 = float(innovation @ S_inv @ innovation)
    log_likelihood = -0.5 * (d2 + math.log(np.linalg.det(2.0 * math.pi * S)))
    accepted = gate is None or d2 <= gate
    if accepted:
        K = cov @ H.T @ S_inv
        mean = mean + K @ innovation
        mean[2] = wrap(mean[2])
        left = np.eye(3) - K @ H
        cov = left @ cov @ left.T + K @ R @ K.T
    return mean, cov, innovation, S, d2, accepted, log_likelihood


def nearest_landmark(mean, cov, z, landmarks, R, sensor_offset=(0.0, 0.0, 0.0)):
    """Index j of the landmark of smallest d2 = r_j^T S_j^-1 r_j; the first on a tie, -1 if there is none."""
    best, best_d2 = -1, math.inf
    for j, landmark in enumerate(landmarks):
        h, H = expected_observation(mean, landmark, sensor_offset)
        if h is None:
            continue
        innovation = np.array([z[0] - h[0], wrap(z[1] - h[1])])
        d2 = innovation @ np.linalg.inv(H @ cov @ H.T + R) @ innovation
        if d2 < best_d2:
            best, best_d2 = j, d2
    return best


def run(
    prior_mean,
    prior_cov,
    dt,
    control,
    landmark,
    z,
    valid,
    landmarks,
    Q,
    R,
    gate,
    model,
    nominal_dt,
    sensor_offset=(0.0, 0.0, 0.0),
):
    """Localization recursion of sections 3 and 6: each step predicts, then corrects slot by slot in order.

    dt (T,), control (T,2), landmark (T,M) with -1 = unknown, z (T,M,2), valid (T,M), landmarks (L,2). Returns
    mean (T,3), cov (T,3,3) after the corrections of the step and, per slot, innovation (T,M,2), S (T,M,2,2),
    nis (T,M), accepted (T,M), log_likelihood (T,M), associated (T,M): the landmark used. All but `accepted`
    are filled in whether or not the observation passes the gate; slots not valid hold zeros (associated: -1).
    """
    steps, slots = np.shape(valid)
    out = {
        "mean": np.zeros((steps, 3)),
        "cov": np.zeros((steps, 3, 3)),
        "innovation": np.zeros((steps, slots, 2)),
        "S": np.zeros((steps, slots, 2, 2)),
        "nis": np.zeros((steps, slots)),
        "accepted": np.zeros((steps, slots), bool),
        "log_likelihood": np.zeros((steps, slots)),
        "associated": np.full((steps, slots), -1),
    }
    mean, cov = np.array(prior_mean, float), np.array(prior_cov, float)
    for k in range(steps):
        mean, cov = predict(mean, cov, control[k], dt[k], Q, model, nominal_dt)
        for m in range(slots):
            if not valid[k][m]:
                continue
            j = landmark[k][m]
            if j < 0:
                j = nearest_landmark(mean, cov, z[k][m], landmarks, R, sensor_offset)
                if j < 0:
                    continue
            mean, cov, innovation, S, d2, accepted, log_likelihood = correct(
                mean, cov, z[k][m], landmarks[j], R, gate, sensor_offset
            )
            out["innovation"][k, m] = innovation
            out["S"][k, m] = S
            out["nis"][k, m] = d2
            out["accepted"][k, m] = accepted
            out["log_likelihood"][k, m] = log_likelihood
            out["associated"][k, m] = j
        out["mean"][k] = mean
        out["cov"][k] = cov
    return out


def nees(error, cov):
    """Section 6, result 3: e^T P^-1 e of one pose error (3,) and its covariance (3,3)."""
    return float(error @ np.linalg.inv(cov) @ error)


# --- Occupancy grid ---


def bresenham(x0, y0, x1, y1):
    """Cells (x, y) of the line from (x0, y0) to (x1, y1), both ends included, in that order.

    One cell per step along the longer axis; the shorter axis is at the cell nearest the exact line, on a tie
    (exactly between two) at the one nearer the start: with n steps along the longer axis and m along the
    shorter, step i is at ceil(i m / n - 1/2). The course's loop, which accumulates an error, gives the same
    cells. Because of the ties, the line back need not be the same cells.
    """
    across, up = abs(x1 - x0), abs(y1 - y0)
    right = 1 if x1 > x0 else -1
    upward = 1 if y1 > y0 else -1
    longer, shorter = max(across, up), min(across, up)
    cells = []
    for i in range(longer + 1):
        j = (2 * i * shorter + longer - 1) // (2 * longer) if longer else 0
        cells.append((x0 + right * i, y0 + upward * j) if across >= up else (x0 + right * j, y0 + upward * i))
    return cells


def update_scan(
    log_odds,
    pose,
    ranges,
    angles,
    *,
    origin,
    resolution,
    l_occ,
    l_free,
    l_min,
    l_max,
    min_range,
    max_range,
    conventions="design",
):
    """Log-odds after one scan (section 4): each beam adds l_free to the cells it crosses, l_occ to its last.

    A range that is not finite or <= min_range is no measurement; one >= max_range clears up to max_range, its
    terminal cell excluded, and marks none. A robot outside the map changes nothing. Beyond that:

    - "design": cell = floor; a beam that leaves the map clears up to the edge and marks none; the increments
      of all beams are summed, then the sum is added and the grid clamped once.
    - "course": cell = truncation towards zero; a beam that ends outside the map is skipped; the cell is
      clamped after every single increment.

    Returns a new grid.
    """
    if conventions not in ("design", "course"):
        raise ValueError(f"conventions: got {conventions!r}, expected 'design' or 'course'")
    design = conventions == "design"
    to_int = math.floor if design else int
    height, width = log_odds.shape

    def cell(px, py):
        return to_int((px - origin[0]) / resolution), to_int((py - origin[1]) / resolution)

    def inside(cx, cy):
        return 0 <= cx < width and 0 <= cy < height

    grid = np.array(log_odds, float)
    increment = np.zeros_like(grid)

    def add(cx, cy, amount):
        if design:
            increment[cy, cx] += amount
        else:
            grid[cy, cx] = min(max(grid[cy, cx] + amount, l_min), l_max)

    x, y, theta = pose
    start = cell(x, y)
    if not inside(*start):
        return grid
    for measured, angle in zip(ranges, angles, strict=True):
        if not math.isfinite(measured) or measured <= min_range:
            continue
        reach = min(measured, max_range)
        end = cell(x + reach * math.cos(theta + angle), y + reach * math.sin(theta + angle))
        if not design and not inside(*end):
            continue
        for crossed in bresenham(*start, *end)[:-1]:
            if not inside(*crossed):
                break
            add(*crossed, l_free)
        if measured < max_range and inside(*end):
            add(*end, l_occ)
    return np.clip(grid + increment, l_min, l_max) if design else grid


def probability(log_odds):
    """Occupancy probability 1 / (1 + exp(-L)) (section 4)."""
    return 1.0 / (1.0 + np.exp(-log_odds))


# --- The course's Python program ---


def course_control(k):
    """Commanded (v, omega) of step k: v = 0.35 + 0.05 sin(0.05 k), omega = 0.25 sin(0.03 k)."""
    return np.array([0.35 + 0.05 * math.sin(0.05 * k), 0.25 * math.sin(0.03 * k)])


def course_draws(seed=4, steps=240):
    """Scaled noise of the course's program, drawn in its order from np.random.RandomState(seed).

    Each step: heading of the plant (0.005 rad), measured v (0.02 m/s), measured omega (0.01 rad/s); on every
    5th step from the first, per landmark, range (0.08 m) and bearing (0.02 rad), whether seen or not; then
    the 61 beams (0.03 m). Returns heading (T,), control (T,2), detector (T,4,2) with NaN on steps without
    detections, scan (T,61).
    """
    rng = np.random.RandomState(seed)
    beams, count = len(COURSE_ANGLES), len(COURSE_LANDMARKS)
    heading = np.zeros(steps)
    control = np.zeros((steps, 2))
    detector = np.full((steps, count, 2), np.nan)
    scan = np.zeros((steps, beams))
    for k in range(steps):
        heading[k] = rng.normal(0.0, 0.005)
        control[k] = rng.normal(0.0, 0.02), rng.normal(0.0, 0.01)
        if k % 5 == 0:
            for j in range(count):
                detector[k, j] = rng.normal(0.0, 0.08), rng.normal(0.0, 0.02)
        for b in range(beams):
            scan[k, b] = rng.normal(0.0, 0.03)
    return {"heading": heading, "control": control, "detector": detector, "scan": scan}


def course_ranges(pose, noise):
    """Scan of the course's room: the nearest wall within 8 m along each beam, plus noise, at least 0.05 m.

    Ray p + t d meets wall a + s e at t = ((a - p) x e) / (d x e), s = ((a - p) x d) / (d x e), where t >= 0
    and 0 <= s <= 1. With no wall in reach the reading is 8 m plus noise, which can look like a wall just
    short of 8 m.
    """
    x, y, theta = pose
    dx = np.array([math.cos(theta + angle) for angle in COURSE_ANGLES])
    dy = np.array([math.sin(theta + angle) for angle in COURSE_ANGLES])
    nearest = np.full(len(COURSE_ANGLES), COURSE_SCAN["max_range"])
    for corners in COURSE_WALLS:
        for i, (ax, ay) in enumerate(corners):
            bx, by = corners[(i + 1) % len(corners)]
            ex, ey = bx - ax, by - ay
            cross = dx * ey - dy * ex
            met = np.abs(cross) >= 1e-9
            divisor = np.where(met, cross, 1.0)
            t = ((ax - x) * ey - (ay - y) * ex) / divisor
            s = ((ax - x) * dy - (ay - y) * dx) / divisor
            met &= (t >= 0.0) & (s >= 0.0) & (s <= 1.0)
            nearest = np.where(met & (t < nearest), t, nearest)
    return np.maximum(COURSE_SCAN["min_range"], nearest + noise)


def course_run(seed=4, motion="capstone", conventions="course", gate=COURSE_GATE):
    """The course's whole program, 240 steps, by default with its own motion, grid rules and gate (d2).

    The plant is the first-order model with noise on the heading only; the filter gets the commands plus
    noise. A landmark is reported when its measured range is below 7.5 m. The map is updated at the estimated
    pose.

    Returns what `run` returns (mean (T,3), cov (T,3,3), ...) and its inputs dt (T,), control (T,2) as
    measured, landmark (T,4), z (T,4,2) with zeros where not valid, valid (T,4), landmarks (4,2); truth (T,3);
    scans (T,61) and angles (61,); log_odds (120,120) after the last step; nees (T,), rmse_position (m),
    rmse_yaw (rad), occupancy_min, occupancy_max, occupancy_mean.
    """
    draws = course_draws(seed)
    steps, count = len(draws["heading"]), len(COURSE_LANDMARKS)
    truth = np.zeros((steps, 3))
    control = np.zeros((steps, 2))
    landmark = np.tile(np.arange(count), (steps, 1))
    z = np.zeros((steps, count, 2))
    valid = np.zeros((steps, count), bool)
    scans = np.zeros((steps, len(COURSE_ANGLES)))
    pose = COURSE_PRIOR_MEAN
    for k in range(steps):
        command = course_control(k)
        x, y, theta = pose
        pose = np.array(
            [
                x + command[0] * math.cos(theta) * COURSE_DT,
                y + command[0] * math.sin(theta) * COURSE_DT,
                wrap(theta + command[1] * COURSE_DT + draws["heading"][k]),
            ]
        )
        truth[k] = pose
        control[k] = command + draws["control"][k]
        if k % 5 == 0:
            for j, (lx, ly) in enumerate(COURSE_LANDMARKS):
                to_x, to_y = lx - pose[0], ly - pose[1]
                measured = math.hypot(to_x, to_y) + draws["detector"][k, j, 0]
                if measured < COURSE_VISIBILITY:
                    bearing = wrap(math.atan2(to_y, to_x) - pose[2] + draws["detector"][k, j, 1])
                    z[k, j] = measured, bearing
                    valid[k, j] = True
        scans[k] = course_ranges(pose, draws["scan"][k])

    dt = np.full(steps, COURSE_DT)
    filtered = run(
        COURSE_PRIOR_MEAN,
        COURSE_PRIOR_COV,
        dt,
        control,
        landmark,
        z,
        valid,
        COURSE_LANDMARKS,
        COURSE_Q,
        COURSE_R,
        gate,
        motion,
        COURSE_DT,
    )

    log_odds = np.zeros(COURSE_GRID_SHAPE)
    for estimate, ranges in zip(filtered["mean"], scans, strict=True):
        log_odds = update_scan(log_odds, estimate, ranges, COURSE_ANGLES, **COURSE_SCAN, conventions=conventions)

    error = truth - filtered["mean"]
    error[:, 2] = wrap(error[:, 2])
    occupancy = probability(log_odds)
    return {
        **filtered,
        "dt": dt,
        "control": control,
        "landmark": landmark,
        "z": z,
        "valid": valid,
        "landmarks": COURSE_LANDMARKS.copy(),
        "truth": truth,
        "scans": scans,
        "angles": COURSE_ANGLES.copy(),
        "log_odds": log_odds,
        "nees": np.array([nees(e, P) for e, P in zip(error, filtered["cov"], strict=True)]),
        "rmse_position": math.sqrt(np.mean(error[:, 0] ** 2 + error[:, 1] ** 2)),
        "rmse_yaw": math.sqrt(np.mean(error[:, 2] ** 2)),
        "occupancy_min": float(occupancy.min()),
        "occupancy_max": float(occupancy.max()),
        "occupancy_mean": float(occupancy.mean()),
    }


# --- Pose graphs (g2o, Kümmerle et al. 2011): edges (a, b, z (3,), Omega (3, 3)); poses (N, 3), the first fixed ---


def graph_error(a, b, z):
    """(Z⁻¹ A⁻¹ B) as (x, y, theta): multiply homogeneous matrices, read the result."""

    def matrix(p):
        c, s = math.cos(p[2]), math.sin(p[2])
        return np.array([[c, -s, p[0]], [s, c, p[1]], [0.0, 0.0, 1.0]])

    E = np.linalg.inv(matrix(z)) @ np.linalg.inv(matrix(a)) @ matrix(b)
    return np.array([E[0, 2], E[1, 2], math.atan2(E[1, 0], E[0, 0])])


def graph_linear(poses, edges, weights=None, step=1e-6):
    """chi-square, half its slope and J^T Omega J by (x, y, theta) of all poses but the first; J by differences."""
    n = len(poses)
    chi2, g, H = 0.0, np.zeros(3 * n), np.zeros((3 * n, 3 * n))
    for k, (a, b, z, Omega) in enumerate(edges):
        w = 1.0 if weights is None else weights[k]
        e = graph_error(poses[a], poses[b], z)
        J = np.zeros((3, 3 * n))
        for which in (a, b):
            for i in range(3):
                up, down = poses.copy(), poses.copy()
                up[which, i] += step
                down[which, i] -= step
                difference = graph_error(up[a], up[b], z) - graph_error(down[a], down[b], z)
                difference[2] = wrap(difference[2])
                J[:, 3 * which + i] = difference / (2 * step)
        chi2 += w * e @ Omega @ e
        g += w * J.T @ Omega @ e
        H += w * J.T @ Omega @ J
    return chi2, g[3:], H[3:, 3:]


def graph_optimum(poses, edges, steps=30):
    """Gauss-Newton; the optimum, chi-square there and the covariance of (x, y, theta) of all poses, that of the first
    zero.
    """
    poses = poses.copy()
    for _ in range(steps):
        _, g, H = graph_linear(poses, edges)
        poses[1:] -= np.linalg.solve(H, g).reshape(-1, 3)
    poses[:, 2] = wrap(poses[:, 2])
    chi2, _, H = graph_linear(poses, edges)
    cov = np.zeros((3 * len(poses), 3 * len(poses)))
    cov[3:, 3:] = np.linalg.inv(H)
    return poses, chi2, cov
