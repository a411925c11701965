// The capstone consistency study as a plain loop: what one writes by hand to have it fast, and what benchmark.py
// compares the library with. One run: drive the robot, filter what it measured, score the filter against the truth
// and, with --map, cast 61 beams a step, put them into an occupancy grid at the estimated pose and score the grid.
// Float32, threads over runs, small matrices unrolled by hand; sums are float within a chunk of runs, then double.
//
//   g++ -O3 -march=native -std=c++17 -pthread -o study study.cpp
//   ./study [--runs N] [--threads N] [--map] [--seed N]   one study: a line of JSON with seconds and statistics
//   ./study --profile [--runs N]                          where a run's time goes, one thread
//   ./study --check < inputs > beliefs_and_map            one given run: see `check` for the format

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <memory>
#include <string>
#include <thread>
#include <vector>

namespace {

// ---- The scenario -------------------------------------------------------------------------------------------------

constexpr int kSteps = 240;
constexpr float kDt = 0.1f;  // s
constexpr int kLandmarks = 4;
constexpr int kSightPeriod = 5;      // steps
constexpr float kSightRange = 7.5f;  // m
constexpr int kBeams = 61;
constexpr int kPadded = 64;  // beams in whole vectors: the last three are computed and not used
constexpr float kHalfView = 1.2f, kMinRange = 0.05f, kMaxRange = 8.0f;  // rad, m, m
constexpr int kWalls = 8;

// Standard deviations of the robot and its sensors, and those the filter believes in.
constexpr float kHeadingNoise = 0.005f, kSpeedNoise = 0.02f, kTurnNoise = 0.01f;
constexpr float kRangeNoise = 0.08f, kBearingNoise = 0.02f, kScanNoise = 0.03f;
constexpr float kQv = 0.02f * 0.02f, kQw = 0.03f * 0.03f, kRr = 0.15f * 0.15f, kRb = 0.03f * 0.03f;
constexpr float kGate = 9.21034037f;  // chi-square, 2 degrees, 0.99
constexpr float kCovered[4] = {2.36597388f, 6.25138863f, 7.81472790f, 11.34486673f};  // 3 degrees: 0.5 0.9 0.95 0.99
constexpr float kLostNees = 30.66484917f;  // 3 degrees, 1 - 1e-6
constexpr float kLostSquare = 1.0f;        // m^2

constexpr int kRows = 120, kColumns = 120;
constexpr float kResolution = 0.2f;  // m; the grid's origin is (0, 0)
constexpr float kLOcc = 0.85f, kLFree = -0.4f, kLMin = -4.0f, kLMax = 4.0f;
constexpr int kBins = 10;

constexpr float kPi = 3.14159265358979f;

struct Point {
    float x, y;
};

struct World {
    Point wall[kWalls][2] = {
        {{0, 0}, {12, 0}},    {{12, 0}, {12, 12}},    {{12, 12}, {0, 12}},      {{0, 12}, {0, 0}},
        {{4.5, 4}, {7.5, 4}}, {{7.5, 4}, {7.5, 6.5}}, {{7.5, 6.5}, {4.5, 6.5}}, {{4.5, 6.5}, {4.5, 4}},
    };
    Point landmark[kLandmarks] = {{2, 10}, {10, 2.5}, {9.5, 10.5}, {2, 5.5}};
    float speed[kSteps], turn[kSteps];  // commands
    alignas(64) float beam_cos[kPadded], beam_sin[kPadded];
    bool occupied[kRows * kColumns];  // cells a wall runs through

    World() {
        for (int k = 0; k < kSteps; ++k) {
            speed[k] = 0.35f + 0.05f * std::sin(0.05f * k);
            turn[k] = 0.25f * std::sin(0.03f * k);
        }
        for (int b = 0; b < kPadded; ++b) {
            const float angle = -kHalfView + 2 * kHalfView * std::min(b, kBeams - 1) / (kBeams - 1);
            beam_cos[b] = std::cos(angle);
            beam_sin[b] = std::sin(angle);
        }
        for (int row = 0; row < kRows; ++row)
            for (int column = 0; column < kColumns; ++column) occupied[row * kColumns + column] = crossed(row, column);
    }

    // Liang & Barsky 1984: does any wall pass through the cell? A wall on an edge occupies the cells on both sides.
    bool crossed(int row, int column) const {
        const float reach = 1e-3f * kResolution, low[2] = {kResolution * column, kResolution * row};
        for (const auto& w : wall) {
            const float from[2] = {w[0].x, w[0].y}, along[2] = {w[1].x - w[0].x, w[1].y - w[0].y};
            float enter = 0, leave = 1;
            for (int i = 0; i < 2; ++i) {
                const float near = low[i] - reach - from[i], far = low[i] + kResolution + reach - from[i];
                if (along[i] != 0) {
                    enter = std::max(enter, std::min(near / along[i], far / along[i]));
                    leave = std::min(leave, std::max(near / along[i], far / along[i]));
                } else if (near > 0 || far < 0) {
                    leave = -1;
                }
            }
            if (enter <= leave) return true;
        }
        return false;
    }
};

float wrap(float angle) { return angle - 2 * kPi * std::floor((angle + kPi) * (0.5f / kPi)); }

// ---- Random numbers -----------------------------------------------------------------------------------------------

// xoshiro256++ (Blackman & Vigna 2021) and the ziggurat of 256 layers (Marsaglia & Tsang 2000; layer and value from
// different bits, Doornik 2005): 2.0 ns a number, where std::mt19937 with std::normal_distribution<float> took 8.3 ns,
// the same distribution on xoshiro128++ 6.1 ns and a polar method by hand 5.2 ns.
class Normal {
   public:
    Normal(uint64_t seed, uint64_t run) {
        uint64_t s = seed * 0x9e3779b97f4a7c15u + run * 0xd1342543de82ef95u;
        for (uint64_t& word : state_) {  // splitmix64
            uint64_t z = (s += 0x9e3779b97f4a7c15u);
            z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
            z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
            word = z ^ (z >> 31);
        }
    }

    float operator()() {
        const uint64_t bits = next();
        const unsigned layer = bits & 255;
        const int32_t value = static_cast<int32_t>(bits >> 32);
        const float x = value * table_.width[layer];
        if (__builtin_expect(static_cast<uint32_t>(std::abs(static_cast<int64_t>(value))) < table_.inside[layer], 1))
            return x;
        return at_the_edge(x, layer);
    }

   private:
    struct Table {
        uint32_t inside[256];
        float width[256], height[256];

        Table() {
            const double r = 3.6541528853610088, area = 0.00492867323399, scale = 2147483648.0;
            double x = r, above = r;
            const double f = std::exp(-0.5 * r * r);
            inside[0] = static_cast<uint32_t>(r * f / area * scale);
            inside[1] = 0;
            width[0] = static_cast<float>(area / f / scale);
            width[255] = static_cast<float>(r / scale);
            height[0] = 1;
            height[255] = static_cast<float>(f);
            for (int i = 254; i >= 1; --i) {
                x = std::sqrt(-2 * std::log(area / x + std::exp(-0.5 * x * x)));
                inside[i + 1] = static_cast<uint32_t>(x / above * scale);
                above = x;
                height[i] = static_cast<float>(std::exp(-0.5 * x * x));
                width[i] = static_cast<float>(x / scale);
            }
        }
    };

    uint64_t next() {
        const uint64_t result = rotate(state_[0] + state_[3], 23) + state_[0], t = state_[1] << 17;
        state_[2] ^= state_[0];
        state_[3] ^= state_[1];
        state_[1] ^= state_[2];
        state_[0] ^= state_[3];
        state_[2] ^= t;
        state_[3] = rotate(state_[3], 45);
        return result;
    }

    static uint64_t rotate(uint64_t x, int k) { return (x << k) | (x >> (64 - k)); }

    float uniform() { return (static_cast<float>(next() >> 40) + 0.5f) * 0x1p-24f; }  // in (0, 1)

    __attribute__((noinline)) float at_the_edge(float x, unsigned layer) {
        constexpr float r = 3.6541528853610088f;
        for (;;) {
            if (layer == 0) {  // the tail
                float tail, y;
                do {
                    tail = -std::log(uniform()) / r;
                    y = -std::log(uniform());
                } while (y + y < tail * tail);
                return x < 0 ? -r - tail : r + tail;
            }
            const float low = table_.height[layer], high = table_.height[layer - 1];
            if (low + uniform() * (high - low) < std::exp(-0.5f * x * x)) return x;
            const uint64_t bits = next();
            layer = bits & 255;
            const int32_t value = static_cast<int32_t>(bits >> 32);
            x = value * table_.width[layer];
            if (static_cast<uint32_t>(std::abs(static_cast<int64_t>(value))) < table_.inside[layer]) return x;
        }
    }

    static const Table table_;
    uint64_t state_[4];
};

const Normal::Table Normal::table_;

// ---- The filter ---------------------------------------------------------------------------------------------------

struct Sighting {
    float range, bearing;
    bool valid;
};

struct Belief {
    float x, y, theta;
    float xx, xy, xt, yy, yt, tt;  // upper triangle of the covariance
};

constexpr Belief kPrior = {1, 1, 0, 0.05f, 0, 0, 0.05f, 0, 0.02f};

// What a correction reports of one observation.
struct Report {
    float nis, det, white_range, white_bearing;  // det: of the innovation's covariance
    bool used, accepted;

    float log_likelihood() const { return used ? -0.5f * (nis + std::log(det)) - std::log(2 * kPi) : 0; }
};

// The exact arc, its chord v dt sinc(w dt / 2) in the direction theta + w dt / 2, and its exact Jacobians.
inline void predict(Belief& b, float v, float w) {
    const float half = 0.5f * w * kDt, q = half * half;
    float s, slope;
    if (std::fabs(half) < 0.25f) {
        s = 1 - q / 6 * (1 - q / 20 * (1 - q / 42 * (1 - q / 72 * (1 - q / 110))));
        slope = -half / 3 * (1 - q / 10 * (1 - q / 28 * (1 - q / 54 * (1 - q / 88))));
    } else {
        s = std::sin(half) / half;
        slope = (std::cos(half) - s) / half;
    }
    const float sin = std::sin(b.theta + half), cos = std::cos(b.theta + half);
    const float chord = v * kDt * s, right = chord * cos, up = chord * sin;
    b.x += right;
    b.y += up;
    b.theta = wrap(b.theta + w * kDt);

    // F P F' with F = I but for its last column (-up, right, 1)
    const float xt = b.xt - up * b.tt, yt = b.yt + right * b.tt;
    b.xx += -up * (b.xt + xt);
    b.xy += right * b.xt - up * yt;
    b.yy += right * (b.yt + yt);
    b.xt = xt;
    b.yt = yt;
    // G Q G' with Q diagonal
    const float lever = 0.5f * v * kDt * kDt;
    const float gx = s * kDt * cos, gy = s * kDt * sin;
    const float hx = lever * (slope * cos - s * sin), hy = lever * (slope * sin + s * cos);
    const float qhx = kQw * hx, qhy = kQw * hy, qgx = kQv * gx;
    b.xx += qgx * gx + qhx * hx;
    b.xy += qgx * gy + qhx * hy;
    b.xt += qhx * kDt;
    b.yy += kQv * gy * gy + qhy * hy;
    b.yt += qhy * kDt;
    b.tt += kQw * kDt * kDt;
}

// Correct by one landmark in Joseph form if it passes the gate.
inline Report correct(Belief& b, const Sighting& z, Point landmark) {
    Report report{};
    const float dx = landmark.x - b.x, dy = landmark.y - b.y, q = dx * dx + dy * dy;
    if (!(q > 1e-9f) || !std::isfinite(z.range) || !std::isfinite(z.bearing)) return report;
    const float r = std::sqrt(q), per_r = 1 / r, per_q = 1 / q;
    const float r0 = z.range - r, r1 = wrap(z.bearing - std::atan2(dy, dx) + b.theta);
    // H = [a c 0; d e -1]
    const float a = -dx * per_r, c = -dy * per_r, d = dy * per_q, e = -dx * per_q;
    // P H', 3 x 2
    const float u0 = b.xx * a + b.xy * c, u1 = b.xy * a + b.yy * c, u2 = b.xt * a + b.yt * c;
    const float w0 = b.xx * d + b.xy * e - b.xt, w1 = b.xy * d + b.yy * e - b.yt, w2 = b.xt * d + b.yt * e - b.tt;
    // S = L D L'
    const float s00 = a * u0 + c * u1 + kRr, s01 = a * w0 + c * w1, s11 = d * w0 + e * w1 - w2 + kRb;
    const float per_d0 = 1 / s00, l = s01 * per_d0, d1 = s11 - l * s01, per_d1 = 1 / d1;
    const float y1 = r1 - l * r0;
    report.nis = r0 * r0 * per_d0 + y1 * y1 * per_d1;
    report.det = s00 * d1;
    report.used = true;
    report.white_range = r0 * std::sqrt(per_d0);
    report.white_bearing = y1 * std::sqrt(per_d1);
    report.accepted = report.nis < kGate && s00 > 0 && d1 > 0;
    if (!report.accepted) return report;

    // K = P H' S^-1, from L D L'
    const float k01 = (w0 - l * u0) * per_d1, k11 = (w1 - l * u1) * per_d1, k21 = (w2 - l * u2) * per_d1;
    const float k00 = u0 * per_d0 - l * k01, k10 = u1 * per_d0 - l * k11, k20 = u2 * per_d0 - l * k21;
    // A = I - K H
    const float a00 = 1 - k00 * a - k01 * d, a01 = -k00 * c - k01 * e, a02 = k01;
    const float a10 = -k10 * a - k11 * d, a11 = 1 - k10 * c - k11 * e, a12 = k11;
    const float a20 = -k20 * a - k21 * d, a21 = -k20 * c - k21 * e, a22 = 1 + k21;
    // A P
    const float b00 = a00 * b.xx + a01 * b.xy + a02 * b.xt, b01 = a00 * b.xy + a01 * b.yy + a02 * b.yt;
    const float b02 = a00 * b.xt + a01 * b.yt + a02 * b.tt;
    const float b10 = a10 * b.xx + a11 * b.xy + a12 * b.xt, b11 = a10 * b.xy + a11 * b.yy + a12 * b.yt;
    const float b12 = a10 * b.xt + a11 * b.yt + a12 * b.tt;
    const float b20 = a20 * b.xx + a21 * b.xy + a22 * b.xt, b21 = a20 * b.xy + a21 * b.yy + a22 * b.yt;
    const float b22 = a20 * b.xt + a21 * b.yt + a22 * b.tt;
    // A P A' + K R K'
    const float m0 = kRr * k00, m1 = kRr * k10, n0 = kRb * k01, n1 = kRb * k11;
    b.xx = b00 * a00 + b01 * a01 + b02 * a02 + m0 * k00 + n0 * k01;
    b.xy = b00 * a10 + b01 * a11 + b02 * a12 + m0 * k10 + n0 * k11;
    b.xt = b00 * a20 + b01 * a21 + b02 * a22 + m0 * k20 + n0 * k21;
    b.yy = b10 * a10 + b11 * a11 + b12 * a12 + m1 * k10 + n1 * k11;
    b.yt = b10 * a20 + b11 * a21 + b12 * a22 + m1 * k20 + n1 * k21;
    b.tt = b20 * a20 + b21 * a21 + b22 * a22 + kRr * k20 * k20 + kRb * k21 * k21;
    b.x += k00 * r0 + k01 * r1;
    b.y += k10 * r0 + k11 * r1;
    b.theta = wrap(b.theta + k20 * r0 + k21 * r1);
    return report;
}

// Finite and positive semi-definite up to rounding: the principal minors, each against its diagonal's product.
inline bool usable(const Belief& b) {
    constexpr float slack = 1 - 64 * 1.1920929e-7f;
    const float xy = b.xy * b.xy, xt = b.xt * b.xt, yt = b.yt * b.yt;
    const float gap = b.xx * yt + b.yy * xt + b.tt * xy - 2 * b.xy * b.xt * b.yt;
    return std::isfinite(b.xx + b.yy + b.tt + b.x + b.y + b.theta) && b.xx >= 0 && b.yy >= 0 && b.tt >= 0 &&
           slack * xy <= b.xx * b.yy && slack * xt <= b.xx * b.tt && slack * yt <= b.yy * b.tt &&
           slack * gap <= b.xx * b.yy * b.tt;
}

// ---- The scanner and the map --------------------------------------------------------------------------------------

// Beam directions at a heading: the table of beams, turned.
inline void directions(const World& world, float theta, float* __restrict dx, float* __restrict dy) {
    const float sin = std::sin(theta), cos = std::cos(theta);
    for (int b = 0; b < kPadded; ++b) {
        dx[b] = cos * world.beam_cos[b] - sin * world.beam_sin[b];
        dy[b] = sin * world.beam_cos[b] + cos * world.beam_sin[b];
    }
}

// Distance to the nearest wall along every beam.
inline void ray_cast(const World& world, float x, float y, float theta, float* __restrict range) {
    alignas(64) float dx[kPadded], dy[kPadded];
    directions(world, theta, dx, dy);
    for (int b = 0; b < kPadded; ++b) range[b] = kMaxRange;
    for (const auto& wall : world.wall) {
        const float wx = wall[1].x - wall[0].x, wy = wall[1].y - wall[0].y;
        const float ax = x - wall[0].x, ay = y - wall[0].y, across = wx * ay - wy * ax;
        for (int b = 0; b < kPadded; ++b) {  // branch-free, so that it becomes vector code
            const float det = dx[b] * wy - dy[b] * wx, per_det = 1 / det;
            const float s = (dx[b] * ay - dy[b] * ax) * per_det, t = across * per_det;
            const bool hits = (std::fabs(det) >= 1e-9f) & (s >= 0) & (s <= 1) & (t >= 0) & (t < range[b]);
            range[b] = hits ? t : range[b];
        }
    }
}

class Map {
   public:
    void clear() { std::memset(log_odds_, 0, sizeof log_odds_); }

    float at(int row, int column) const { return log_odds_[(row + kMargin) * kStride + column + kMargin]; }

    // Add one scan at a pose and clamp once. All beams are prepared as vectors; the cells they cross are listed one
    // beam after the other, then added to in one long loop: a loop a beam, whose length is hard to predict, takes
    // longer. Clamping the rectangle around the beams is vector code and cheaper than clamping the cells of the list.
    void add(const World& world, float x, float y, float theta, const float* __restrict range) {
        const float column_at = std::floor(x / kResolution), row_at = std::floor(y / kResolution);
        const bool on_map = column_at >= 0 && column_at < kColumns && row_at >= 0 && row_at < kRows;
        if (!on_map || !std::isfinite(theta)) return;
        const int column0 = static_cast<int>(column_at), row0 = static_cast<int>(row_at);
        const int start = (row0 + kMargin) * kStride + column0 + kMargin;

        alignas(64) float dx[kPadded], dy[kPadded], slope[kPadded], offset[kPadded], at_end[kPadded];
        alignas(64) int columns[kPadded], rows[kPadded], length[kPadded], major[kPadded], minor[kPadded];
        directions(world, theta, dx, dy);
        for (int b = 0; b < kPadded; ++b) {
            const bool measured = (range[b] > kMinRange) & (range[b] <= std::numeric_limits<float>::max());
            const float reach = measured ? std::min(range[b], kMaxRange) : 0;
            columns[b] = static_cast<int>(std::floor((x + reach * dx[b]) / kResolution)) - column0;
            rows[b] = static_cast<int>(std::floor((y + reach * dy[b]) / kResolution)) - row0;
            at_end[b] = measured & (range[b] < kMaxRange) ? kLOcc : 0;
            // Bresenham 1965: cell j of a beam lies at j along the major axis and ceil(j m / n - 1/2) along the minor.
            const int width = std::abs(columns[b]), height = std::abs(rows[b]);
            const int right = columns[b] < 0 ? -1 : 1, up = rows[b] < 0 ? -kStride : kStride;
            major[b] = width >= height ? right : up;
            minor[b] = width >= height ? up : right;
            length[b] = std::max(width, height);
            const float per_n = 1 / static_cast<float>(std::max(length[b], 1));
            slope[b] = std::min(width, height) * per_n;
            offset[b] = 0.5f - 0.25f * per_n;
        }

        int count = 0, left = 0, right = 0, bottom = 0, top = 0;
        for (int b = 0; b < kBeams; ++b) {
            int* __restrict crossed = crossed_ + count;
            for (int j = 0; j < kLongest; ++j)  // what lies beyond its length is overwritten by the next beam
                crossed[j] = start + j * major[b] + static_cast<int>(j * slope[b] + offset[b]) * minor[b];
            count += length[b];
            log_odds_[start + rows[b] * kStride + columns[b]] += at_end[b];
            left = std::min(left, columns[b]);
            right = std::max(right, columns[b]);
            bottom = std::min(bottom, rows[b]);
            top = std::max(top, rows[b]);
        }
        for (int i = 0; i < count; ++i) log_odds_[crossed_[i]] += kLFree;
        const int first = start + bottom * kStride + left, rest = (start + left) % 8, cells = rest + right - left + 1;
        for (int row = 0; row <= top - bottom; ++row) {
            float* from = log_odds_ + first - rest + row * kStride;
            for (int i = 0; i < cells; i += 8)  // whole vectors; a cell beside the rectangle is clamped already
                for (int lane = i; lane < i + 8; ++lane) from[lane] = std::min(std::max(from[lane], kLMin), kLMax);
        }
    }

   private:
    // A beam is shorter than the margin, so one that leaves the map needs no check of bounds.
    static constexpr int kLongest = 48, kMargin = 48, kStride = kColumns + 2 * kMargin;
    static_assert(kMaxRange / kResolution + 2 < kMargin);

    alignas(64) float log_odds_[(kRows + 2 * kMargin) * kStride];
    alignas(64) int crossed_[kBeams * kLongest];
};

// ---- Sums over runs -----------------------------------------------------------------------------------------------

struct MeanAndSquare {
    float sum = 0, square = 0;
    void add(float value) {
        sum += value;
        square += value * value;
    }
};

// All floats, so that a chunk of runs is added to the doubles of its thread entry by entry.
struct Sums {
    struct Step {
        float scored, nees, error2[3], variance[3], observed, nis, accepted;
    } step[kSteps];
    float axis_nees[3], within[3], covered[4];
    float lag_products[2], lag_squares[2], lag_pairs;
    float unscored, flagged, diverged, observing;
    MeanAndSquare run_nees, run_nis, run_position2, run_yaw2, known_bits, brier;
    float cells[kBins], probability[kBins], occupied[kBins];
};

constexpr int kEntries = sizeof(Sums) / sizeof(float);
constexpr int kChunk = 128;  // runs

// ---- One run ------------------------------------------------------------------------------------------------------

// What the robot measures in one step.
struct Measured {
    float v, w;
    bool looks;
    Sighting sighting[kLandmarks];
    alignas(64) float range[kPadded];
};

struct Robot {
    float x = kPrior.x, y = kPrior.y, theta = kPrior.theta;

    // Drives in first-order steps.
    void step(const World& world, int k, bool scans, Normal& normal, Measured& measured) {
        const float speed = world.speed[k], turn = world.turn[k];
        x += speed * kDt * std::cos(theta);
        y += speed * kDt * std::sin(theta);
        theta = wrap(theta + turn * kDt + kHeadingNoise * normal());
        measured.v = speed + kSpeedNoise * normal();
        measured.w = turn + kTurnNoise * normal();
        measured.looks = k % kSightPeriod == 0;
        if (measured.looks)
            for (int j = 0; j < kLandmarks; ++j) {
                const float dx = world.landmark[j].x - x, dy = world.landmark[j].y - y;
                const float distance = std::sqrt(dx * dx + dy * dy);
                const float range = distance + kRangeNoise * normal();
                const float bearing = wrap(std::atan2(dy, dx) - theta + kBearingNoise * normal());
                measured.sighting[j] = {range, bearing, distance < kSightRange};
            }
        if (!scans) return;
        ray_cast(world, x, y, theta, measured.range);
        for (int b = 0; b < kBeams; ++b)
            measured.range[b] = std::max(measured.range[b] + kScanNoise * normal(), kMinRange);
    }
};

// Predict, correct by every landmark in sight, see whether all is well. `observed(j, report)` is told of each one.
template <class Observed>
inline bool filter(const World& world, const Measured& measured, Belief& belief, Observed observed) {
    predict(belief, measured.v, measured.w);
    bool ok = true;
    if (measured.looks)
        for (int j = 0; j < kLandmarks; ++j)
            if (measured.sighting[j].valid) {
                const Report report = correct(belief, measured.sighting[j], world.landmark[j]);
                ok &= report.used;
                observed(j, report);
            }
    return ok && usable(belief);
}

// The statistics of one run while it lasts.
class Score {
   public:
    explicit Score(Sums& sums) : sums_(sums) {}

    void observation(int k, int j, const Report& report) {
        const float range = report.white_range, bearing = report.white_bearing;
        if (!report.used || !std::isfinite(range + bearing)) {
            sums_.unscored += 1;
            return;
        }
        Sums::Step& step = sums_.step[k];
        step.observed += 1;
        step.nis += report.nis;
        step.accepted += report.accepted;
        nis_ += report.nis;
        ++observations_;
        if (seen_[j]) {
            sums_.lag_products[0] += range * white_[j][0];
            sums_.lag_products[1] += bearing * white_[j][1];
            sums_.lag_squares[0] += range * range;
            sums_.lag_squares[1] += bearing * bearing;
            sums_.lag_pairs += 1;
        }
        seen_[j] = true;
        white_[j][0] = range;
        white_[j][1] = bearing;
    }

    void step(int k, const Robot& truth, const Belief& b) {
        const float ex = truth.x - b.x, ey = truth.y - b.y, et = wrap(truth.theta - b.theta);
        const float per_d0 = 1 / b.xx, l1 = b.xy * per_d0, l2 = b.xt * per_d0;  // P = L D L'
        const float d1 = b.yy - l1 * b.xy, m = b.yt - l1 * b.xt, l3 = m / d1, d2 = b.tt - l2 * b.xt - l3 * m;
        const float f1 = ey - l1 * ex, f2 = et - l2 * ex - l3 * f1;
        const float nees = ex * ex * per_d0 + f1 * f1 / d1 + f2 * f2 / d2;
        finite_ = std::isfinite(ex + ey + et + b.xx + b.yy + b.tt);
        if (!(nees >= 0) || !std::isfinite(nees)) return;
        const float error2[3] = {ex * ex, ey * ey, et * et}, variance[3] = {b.xx, b.yy, b.tt};
        Sums::Step& step = sums_.step[k];
        step.scored += 1;
        step.nees += nees;
        for (int i = 0; i < 3; ++i) {
            step.error2[i] += error2[i];
            step.variance[i] += variance[i];
            sums_.axis_nees[i] += error2[i] / variance[i];
            sums_.within[i] += error2[i] <= 4 * variance[i];
        }
        for (int i = 0; i < 4; ++i) sums_.covered[i] += nees < kCovered[i];
        const float position2 = error2[0] + error2[1];
        nees_ += nees;
        position2_ += position2;
        yaw2_ += error2[2];
        ++steps_;
        lost_ |= position2 > kLostSquare && nees > kLostNees;
    }

    void finish() {
        const float steps = std::max(steps_, 1);
        sums_.run_nees.add(nees_ / steps);
        sums_.run_position2.add(position2_ / steps);
        sums_.run_yaw2.add(yaw2_ / steps);
        sums_.run_nis.add(nis_ / std::max(observations_, 1));
        sums_.observing += observations_ > 0;
        sums_.diverged += lost_ || !finite_;
    }

    void map(const Map& map, const World& world) {
        float nats = 0, square = 0;
        int seen = 0;
        for (int row = 0; row < kRows; ++row)
            for (int column = 0; column < kColumns; ++column) {
                const float log_odds = map.at(row, column);
                if (log_odds == 0) continue;  // one bit, and not scored
                const float size = std::fabs(log_odds), rare = std::exp(-size), larger = 1 / (1 + rare);
                nats += std::log(1 + rare) + size * (rare * larger);
                const float p = log_odds > 0 ? larger : rare * larger, truth = world.occupied[row * kColumns + column];
                square += (p - truth) * (p - truth);
                const int bin = std::min(static_cast<int>(p * kBins), kBins - 1);
                sums_.cells[bin] += 1;
                sums_.probability[bin] += p;
                sums_.occupied[bin] += truth;
                ++seen;
            }
        sums_.known_bits.add(seen - nats / std::log(2.0f));
        sums_.brier.add(square / std::max(seen, 1));
    }

   private:
    Sums& sums_;
    float nees_ = 0, nis_ = 0, position2_ = 0, yaw2_ = 0, white_[kLandmarks][2] = {};
    int steps_ = 0, observations_ = 0;
    bool lost_ = false, finite_ = true, seen_[kLandmarks] = {};
};

// --profile leaves out parts; a study runs all of them, or all but scan and map.
enum Parts { kFilter = 1, kScore = 2, kScan = 4, kMap = 8, kPlain = kFilter | kScore, kWhole = kPlain | kScan | kMap };

template <int parts>
void one_run(const World& world, uint64_t seed, uint64_t run, Map& map, Sums& sums) {
    Normal normal(seed, run);
    Robot robot;
    Belief belief = kPrior;
    Measured measured;
    Score score(sums);
    if (parts & kMap) map.clear();
    for (int k = 0; k < kSteps; ++k) {
        robot.step(world, k, parts & kScan, normal, measured);
        if (parts & kFilter)
            sums.flagged += !filter(world, measured, belief, [&](int j, const Report& report) {
                if (parts & kScore) score.observation(k, j, report);
            });
        if (parts & kScore) score.step(k, robot, belief);
        if (parts & kMap) map.add(world, belief.x, belief.y, belief.theta, measured.range);
        if (!(parts & kScore)) {  // what is left out must not take the rest of the work with it
            sums.step[k].nees += measured.v + measured.w + belief.x + belief.xx;
            for (const Sighting& z : measured.sighting) sums.step[k].nis += measured.looks && z.valid ? z.bearing : 0;
        }
    }
    if (parts & kScore) score.finish();
    if ((parts & kWhole) == kWhole) score.map(map, world);
}

// ---- Studies ------------------------------------------------------------------------------------------------------

using Clock = std::chrono::steady_clock;

double seconds_since(Clock::time_point begin) { return std::chrono::duration<double>(Clock::now() - begin).count(); }

struct Study {
    std::vector<double> total = std::vector<double>(kEntries);
    double seconds = 0;
};

template <int parts>
Study study(const World& world, uint64_t seed, int runs, int threads) {
    std::vector<std::vector<double>> totals(threads, std::vector<double>(kEntries));
    std::atomic<int> next{0};
    const auto work = [&](int thread) {
        const auto map = std::make_unique<Map>();
        const auto sums = std::make_unique<Sums>();
        for (int first; (first = next.fetch_add(kChunk)) < runs;) {
            std::memset(static_cast<void*>(sums.get()), 0, sizeof(Sums));
            for (int run = first; run < std::min(first + kChunk, runs); ++run)
                one_run<parts>(world, seed, run, *map, *sums);
            const float* entries = reinterpret_cast<const float*>(sums.get());
            for (int i = 0; i < kEntries; ++i) totals[thread][i] += entries[i];
        }
    };
    Study result;
    const auto begin = Clock::now();
    std::vector<std::thread> others;
    for (int thread = 1; thread < threads; ++thread) others.emplace_back(work, thread);
    work(0);
    for (auto& other : others) other.join();
    for (const auto& one : totals)
        for (int i = 0; i < kEntries; ++i) result.total[i] += one[i];
    result.seconds = seconds_since(begin);
    return result;
}

double& entry(std::vector<double>& total, const float& field, const Sums& layout) {
    return total[&field - reinterpret_cast<const float*>(&layout)];
}

void print_study(Study& result, int runs, int threads, bool mapping) {
    static const Sums layout{};
    const auto at = [&](const float& field) { return entry(result.total, field, layout); };
    double scored = 0, observed = 0, accepted = 0, position2 = 0, yaw2 = 0;
    for (const Sums::Step& step : layout.step) {
        scored += at(step.scored);
        observed += at(step.observed);
        accepted += at(step.accepted);
        position2 += at(step.error2[0]) + at(step.error2[1]);
        yaw2 += at(step.error2[2]);
    }
    const auto mean = [&](const char* name, const MeanAndSquare& of, double count, double less_than = 0) {
        const double value = at(of.sum) / count, spread = std::max(at(of.square) / count - value * value, 0.0);
        std::printf(", \"%s\": %.9g, \"%s_standard_error\": %.4g", name, less_than ? less_than - value : value, name,
                    std::sqrt(spread / std::max(count - 1, 1.0)));
    };
    std::printf("{\"runs\": %d, \"threads\": %d, \"seconds\": %.6f, \"runs_per_s\": %.6g", runs, threads,
                result.seconds, runs / result.seconds);
    mean("anees", layout.run_nees, runs);
    mean("nis_mean", layout.run_nis, at(layout.observing));
    mean("mean_square_position", layout.run_position2, runs);
    mean("mean_square_yaw", layout.run_yaw2, runs);
    std::printf(", \"rmse_position_m\": %.9g, \"rmse_yaw_rad\": %.9g", std::sqrt(position2 / scored),
                std::sqrt(yaw2 / scored));
    std::printf(", \"observations\": %.0f, \"gate_accept_rate\": %.9g, \"coverage_95\": %.9g", observed,
                accepted / observed, at(layout.covered[2]) / scored);
    std::printf(", \"innovation_lag_range\": %.9g, \"innovation_lag_bearing\": %.9g",
                at(layout.lag_products[0]) / at(layout.lag_squares[0]),
                at(layout.lag_products[1]) / at(layout.lag_squares[1]));
    std::printf(", \"diverged_runs\": %.0f, \"flagged_steps\": %.0f", at(layout.diverged), at(layout.flagged));
    if (mapping) {
        mean("entropy_bits", layout.known_bits, runs, kRows * kColumns);
        mean("brier", layout.brier, runs);
        double apart = 0, cells = 0;
        for (int i = 0; i < kBins; ++i) {
            apart += std::fabs(at(layout.probability[i]) - at(layout.occupied[i]));
            cells += at(layout.cells[i]);
        }
        std::printf(", \"calibration_error\": %.9g, \"cells_seen\": %.6g", apart / cells, cells / runs);
    }
    std::printf("}\n");
}

// Microseconds of what `work` does `runs` times: the best of five.
template <class Work>
double microseconds(int runs, Work work) {
    double best = std::numeric_limits<double>::infinity();
    for (int repeat = 0; repeat < 5; ++repeat) {
        const auto begin = Clock::now();
        for (int run = 0; run < runs; ++run) work(run);
        best = std::min(best, 1e6 * seconds_since(begin) / runs);
    }
    return best;
}

void profile(const World& world, int runs) {
    const auto map = std::make_unique<Map>();
    const auto sums = std::make_unique<Sums>();
    volatile float sink = 0;
    const auto normals = [&](int count) {
        return microseconds(runs, [&](int run) {
            Normal normal(0, run);
            float sum = 0;
            for (int i = 0; i < count; ++i) sum += normal();
            sink = sink + sum;
        });
    };
    const auto timed = [&](auto one) {
        std::memset(static_cast<void*>(sums.get()), 0, sizeof(Sums));
        return microseconds(runs, [&](int run) { one(world, 0, run, *map, *sums); });
    };
    constexpr int looks = (kSteps + kSightPeriod - 1) / kSightPeriod;
    const double drive_normals = normals(kSteps * 3 + looks * kLandmarks * 2), scan_normals = normals(kSteps * kBeams);
    const double drive = timed(one_run<0>), filtered = timed(one_run<kFilter>), scored = timed(one_run<kPlain>);
    const double scanned = timed(one_run<kPlain | kScan>), whole = timed(one_run<kWhole>);
    const double mapped = timed(one_run<kFilter | kScan | kMap>) - timed(one_run<kFilter | kScan>);

    // The filter alone, on what robots measured before.
    std::vector<Measured> measured(256 * kSteps);
    for (size_t run = 0; run < measured.size() / kSteps; ++run) {
        Normal normal(0, run);
        Robot robot;
        for (int k = 0; k < kSteps; ++k) robot.step(world, k, false, normal, measured[run * kSteps + k]);
    }
    const double alone = microseconds(runs, [&](int run) {
        const Measured* inputs = &measured[run % 256 * kSteps];
        Belief belief = kPrior;
        float sum = 0;
        for (int k = 0; k < kSteps; ++k)
            sum += filter(world, inputs[k], belief, [&](int, const Report& report) { sum += report.log_likelihood(); });
        sink = sink + sum + belief.x;
    });
    std::printf("{\"unit\": \"us a run, one thread\", \"drive_normals\": %.2f, \"drive\": %.2f, \"filter\": %.2f, "
                "\"score\": %.2f, \"without_map\": %.2f, \"scan_normals\": %.2f, \"ray_cast\": %.2f, "
                "\"map_update\": %.2f, \"map_score\": %.2f, \"with_map\": %.2f, \"filter_alone\": %.2f}\n",
                drive_normals, drive - drive_normals, filtered - drive, scored - filtered, scored, scan_normals,
                scanned - scored - scan_normals, mapped, whole - scanned - mapped, whole, alone);
}

// Filter and map one given run. In, as floats: control (T, 2), z (T, L, 2), valid (T, L), ranges (T, B). Out, as
// floats: mean, upper triangle of the covariance and log-likelihood of every step (T, 10), then the map.
int check(const World& world) {
    std::vector<float> given(kSteps * (2 + 3 * kLandmarks + kBeams));
    if (std::fread(given.data(), sizeof(float), given.size(), stdin) != given.size()) {
        std::fprintf(stderr, "--check: expected %zu floats\n", given.size());
        return 1;
    }
    const float *control = given.data(), *z = control + 2 * kSteps, *valid = z + 2 * kSteps * kLandmarks;
    const float* range = valid + kSteps * kLandmarks;
    const auto map = std::make_unique<Map>();
    map->clear();
    Belief belief = kPrior;
    for (int k = 0; k < kSteps; ++k) {
        Measured measured{control[2 * k], control[2 * k + 1], true, {}, {}};
        for (int j = 0, at = k * kLandmarks; j < kLandmarks; ++j, ++at)
            measured.sighting[j] = {z[2 * at], z[2 * at + 1], valid[at] != 0};
        std::copy_n(range + kBeams * k, kBeams, measured.range);
        float log_likelihood = 0;
        filter(world, measured, belief, [&](int, const Report& report) { log_likelihood += report.log_likelihood(); });
        map->add(world, belief.x, belief.y, belief.theta, measured.range);
        std::fwrite(&belief, sizeof(float), 9, stdout);
        std::fwrite(&log_likelihood, sizeof(float), 1, stdout);
    }
    for (int row = 0; row < kRows; ++row)
        for (int column = 0; column < kColumns; ++column) {
            const float log_odds = map->at(row, column);
            std::fwrite(&log_odds, sizeof(float), 1, stdout);
        }
    return 0;
}

}  // namespace

int main(int argc, char** argv) {
    int runs = 2000, threads = std::max(1u, std::thread::hardware_concurrency());
    uint64_t seed = 0;
    bool mapping = false;
    std::string mode;
    for (int i = 1; i < argc; ++i) {
        const std::string name = argv[i];
        if (name == "--map") {
            mapping = true;
        } else if (name == "--profile" || name == "--check") {
            mode = name;
        } else if (i + 1 < argc && (name == "--runs" || name == "--threads" || name == "--seed")) {
            const long long value = std::atoll(argv[++i]);
            if (name == "--seed") {
                seed = value;
            } else if (value < 1) {
                std::fprintf(stderr, "%s: expected at least 1, got %s\n", name.c_str(), argv[i]);
                return 1;
            } else {
                (name == "--runs" ? runs : threads) = static_cast<int>(value);
            }
        } else {
            std::fprintf(stderr, "unknown argument %s\n", name.c_str());
            return 1;
        }
    }
    const auto world = std::make_unique<World>();
    if (mode == "--profile") return profile(*world, runs), 0;
    if (mode == "--check") return check(*world);
    const auto once = [&](int count) {
        return mapping ? study<kWhole>(*world, seed, count, threads) : study<kPlain>(*world, seed, count, threads);
    };
    once(std::min(runs, 256 * threads));  // warm up
    Study result = once(runs);
    print_study(result, runs, threads, mapping);
    return 0;
}
