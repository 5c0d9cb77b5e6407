#include <cmath>
#include <numbers>

#include "model/kernels/directional_encoding.h"
#include "model/kernels/fast_math.h"
#include "model/kernels/simd.h"

namespace nrff {

HarmonicRecurrence MakeHarmonicRecurrence(int m) {
  HarmonicRecurrence recurrence;
  recurrence.start = std::sqrt(0.25 / std::numbers::pi);
  for (int k = 1; k <= m; ++k) recurrence.start *= std::sqrt((2. * k + 1) / (2. * k));
  const double mm = double(m) * m;
  for (int l = m; l <= kIdeDegrees.back(); ++l) {
    const double ll = double(l) * l, before = double(l - 1) * (l - 1);
    recurrence.slope[l] = std::sqrt(double(l - m) * (l + m + 1));
    if (l == m) continue;
    recurrence.up[l] = std::sqrt((4 * ll - 1) / (ll - mm));
    if (l > m + 1) recurrence.back[l] = std::sqrt((2. * l + 1) * (before - mm) / ((2. * l - 3) * (ll - mm)));
  }
  return recurrence;
}

namespace {

constexpr int kHighest = kIdeDegrees.back(), kDegrees = kIdeDegrees.size();
constexpr int kLanes = 16;

constexpr int FirstFeature(int degree) {  // of a degree's features
  int first = 0;
  for (int d = 0; d < degree; ++d) first += 2 * (kIdeDegrees[d] + 1);
  return first;
}
static_assert(FirstFeature(kDegrees) == kIdeFeatures);

// The recurrences of all orders, in float.
struct Orders {
  float start[kHighest + 1], up[kHighest + 1][kHighest + 1], back[kHighest + 1][kHighest + 1],
      slope[kHighest + 1][kHighest + 1];

  Orders() {
    for (int m = 0; m <= kHighest; ++m) {
      const HarmonicRecurrence recurrence = MakeHarmonicRecurrence(m);
      start[m] = float(recurrence.start);
      for (int l = 0; l <= kHighest; ++l) {
        up[m][l] = float(recurrence.up[l]);
        back[m][l] = float(recurrence.back[l]);
        slope[m][l] = float(recurrence.slope[l]);
      }
    }
  }
};

const Orders& AllOrders() {
  static const Orders orders;
  return orders;
}

// (x + iy)^m for m = 0 … kHighest, and each degree's attenuation with the roughness's derivative.
struct Lanes {
  float real[kHighest + 1][kLanes], imaginary[kHighest + 1][kLanes];
  float attenuation[kDegrees][kLanes], d_roughness[kLanes];

  NRFF_INLINE Lanes(const float* o, const float* raw, int64_t stride) {
    for (int s = 0; s < kLanes; ++s) {
      real[0][s] = 1;
      imaginary[0][s] = 0;
    }
    for (int m = 1; m <= kHighest; ++m) {
      for (int s = 0; s < kLanes; ++s) {
        const float x = o[s], y = o[stride + s];
        real[m][s] = real[m - 1][s] * x - imaginary[m - 1][s] * y;
        imaginary[m][s] = real[m - 1][s] * y + imaginary[m - 1][s] * x;
      }
    }
    for (int s = 0; s < kLanes; ++s) {
      float roughness;
      FastSoftplus(raw[s] - 1, roughness, d_roughness[s]);
      for (int d = 0; d < kDegrees; ++d) {
        attenuation[d][s] = FastExp(-0.5F * float(kIdeDegrees[d] * (kIdeDegrees[d] + 1)) * roughness);
      }
    }
  }
};

// q_l^m of the encoding's degrees l ≥ m.
NRFF_INLINE void Harmonics(const Orders& orders, int m, const float* z, float (&at_degrees)[kDegrees][kLanes]) {
  float before[kLanes], last[kLanes];
  int degree = 0;
  for (int s = 0; s < kLanes; ++s) {
    before[s] = 0;
    last[s] = orders.start[m];
  }
  while (kIdeDegrees[degree] < m) ++degree;
  for (int l = m; l <= kHighest; ++l) {
    if (l > m) {
      for (int s = 0; s < kLanes; ++s) {
        const float next = z[s] * orders.up[m][l] * last[s] - orders.back[m][l] * before[s];
        before[s] = last[s];
        last[s] = next;
      }
    }
    if (l != kIdeDegrees[degree]) continue;
    for (int s = 0; s < kLanes; ++s) at_degrees[degree][s] = last[s];
    ++degree;
  }
}

NRFF_MULTIVERSION void Forward(const Orders& orders, const float* o, const float* raw, int64_t n, int64_t stride,
                               float* encoding) {
  for (int64_t begin = 0; begin < n; begin += kLanes) {
    const Lanes lanes(o + begin, raw + begin, stride);
    float q[kDegrees][kLanes] = {};
    for (int m = 0; m <= kHighest; ++m) {
      Harmonics(orders, m, o + 2 * stride + begin, q);
      for (int d = 0; d < kDegrees; ++d) {
        if (kIdeDegrees[d] < m) continue;
        float* row = encoding + (FirstFeature(d) + 2 * m) * stride + begin;
        for (int s = 0; s < kLanes; ++s) {
          const float scale = lanes.attenuation[d][s] * q[d][s];
          row[s] = scale * lanes.real[m][s];
          row[stride + s] = scale * lanes.imaginary[m][s];
        }
      }
    }
  }
}

// From the highest order down, as an order's slopes are the next one's values.
NRFF_MULTIVERSION void Backward(const Orders& orders, const float* o, const float* raw, const float* d_encoding,
                                int64_t n, int64_t stride, float* d_o, float* d_raw) {
  for (int64_t begin = 0; begin < n; begin += kLanes) {
    const Lanes lanes(o + begin, raw + begin, stride);
    float q[kDegrees][kLanes] = {}, q_next[kDegrees][kLanes] = {};
    float d_x[kLanes] = {}, d_y[kLanes] = {}, d_z[kLanes] = {}, d_roughness[kLanes] = {};
    for (int m = kHighest; m >= 0; --m) {
      Harmonics(orders, m, o + 2 * stride + begin, q);
      for (int d = 0; d < kDegrees; ++d) {
        const int l = kIdeDegrees[d];
        if (l < m) continue;
        const float* row = d_encoding + (FirstFeature(d) + 2 * m) * stride + begin;
        const float slope = orders.slope[m][l], decay = -0.5F * float(l * (l + 1));
        const int lower = m > 0 ? m - 1 : 0;
        for (int s = 0; s < kLanes; ++s) {
          const float d_real = row[s], d_imaginary = row[stride + s], a = lanes.attenuation[d][s];
          const float along = d_real * lanes.real[m][s] + d_imaginary * lanes.imaginary[m][s];
          d_z[s] += a * slope * q_next[d][s] * along;
          d_roughness[s] += decay * a * q[d][s] * along;
          const float scale = a * q[d][s] * float(m);
          d_x[s] += scale * (d_real * lanes.real[lower][s] + d_imaginary * lanes.imaginary[lower][s]);
          d_y[s] += scale * (d_imaginary * lanes.real[lower][s] - d_real * lanes.imaginary[lower][s]);
        }
      }
      for (int d = 0; d < kDegrees; ++d) {
        for (int s = 0; s < kLanes; ++s) q_next[d][s] = kIdeDegrees[d] < m ? 0.F : q[d][s];
      }
    }
    for (int s = 0; s < kLanes; ++s) {
      d_o[begin + s] = d_x[s];
      d_o[stride + begin + s] = d_y[s];
      d_o[2 * stride + begin + s] = d_z[s];
      d_raw[begin + s] = d_roughness[s] * lanes.d_roughness[s];
    }
  }
}

}  // namespace

void IdeForwardRows(const float* o, const float* raw, int64_t n, int64_t stride, float* encoding) {
  Forward(AllOrders(), o, raw, n, stride, encoding);
}

void IdeBackwardRows(const float* o, const float* raw, const float* d_encoding, int64_t n, int64_t stride, float* d_o,
                     float* d_raw) {
  Backward(AllOrders(), o, raw, d_encoding, n, stride, d_o, d_raw);
}

// By doubling angles, which costs two products; within 2e-6 for kPeFrequencies of 4 (tests).
void PeForwardRows(const float* direction, int64_t n, int64_t stride, float* encoding) {
  for (int axis = 0; axis < 3; ++axis) {
    for (int64_t s = 0; s < n; ++s) {
      const float x = direction[axis * stride + s];
      float sine = std::sin(x), cosine = std::cos(x);
      encoding[axis * stride + s] = x;
      for (int k = 0; k < kPeFrequencies; ++k) {
        encoding[(3 + 6 * k + axis) * stride + s] = sine;
        encoding[(6 + 6 * k + axis) * stride + s] = cosine;
        if (k + 1 == kPeFrequencies) break;
        const float doubled = 2 * sine * cosine;
        cosine = 1 - 2 * sine * sine;
        sine = doubled;
      }
    }
  }
}

}  // namespace nrff
