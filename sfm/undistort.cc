#include "sfm/undistort.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <string>

#include "pipeline/error.h"

namespace nrff {
namespace {

using Eigen::Vector2d;

const double kLargestTangent = std::sqrt(3.0);  // tan 60°: a pinhole image wider than 120° is mostly stretched corners
constexpr int kEdgeSamples = 257;

// Rectangle in camera coordinates.
struct Field {
  Vector2d low, high;
};

double Scale(const ColmapCamera& camera, int max_image_size) {
  return std::min(1.0, double(max_image_size) / std::max(camera.width, camera.height));
}

// Points along the border of a rectangle, corners included.
template <typename Function>
void ForBorder(const Vector2d& low, const Vector2d& high, const Function& function) {
  for (int i = 0; i < kEdgeSamples; ++i) {
    const double t = double(i) / (kEdgeSamples - 1);
    const double x = low.x() + t * (high.x() - low.x()), y = low.y() + t * (high.y() - low.y());
    function(Vector2d(x, low.y()));
    function(Vector2d(x, high.y()));
    function(Vector2d(low.x(), y));
    function(Vector2d(high.x(), y));
  }
}

// Whether every ray of the field hits the photo. Its border does, and within ValidRadius the lens is continuous and
// one-to-one, so its inside does too.
bool HasSource(const Lens& lens, const Field& field) {
  const ColmapCamera& camera = lens.camera();
  bool inside = true;
  ForBorder(field.low, field.high, [&](const Vector2d& uv) {
    const auto px = lens.ImageFromCamera(uv);
    constexpr double kSlack_px = 1e-6;
    inside = inside && px && px->x() >= -kSlack_px && px->y() >= -kSlack_px && px->x() <= camera.width + kSlack_px &&
             px->y() <= camera.height + kSlack_px;
  });
  return inside;
}

// The rectangle between the innermost points of the photo's undistorted edges.
Field InnerField(const Lens& lens) {
  const ColmapCamera& camera = lens.camera();
  Field field{Vector2d::Constant(-kLargestTangent), Vector2d::Constant(kLargestTangent)};
  ForBorder(Vector2d::Zero(), Vector2d(camera.width, camera.height), [&](const Vector2d& px) {
    const auto uv = lens.CameraFromImage(px);
    if (!uv) return;
    if (px.x() == 0) field.low.x() = std::max(field.low.x(), std::min(uv->x(), 0.0));
    if (px.y() == 0) field.low.y() = std::max(field.low.y(), std::min(uv->y(), 0.0));
    if (px.x() == camera.width) field.high.x() = std::min(field.high.x(), std::max(uv->x(), 0.0));
    if (px.y() == camera.height) field.high.y() = std::min(field.high.y(), std::max(uv->y(), 0.0));
  });
  return field;
}

PinholeTarget TargetOf(const Lens& lens, const Field& field, double scale) {
  const Vector2d extent = field.high - field.low;
  PinholeTarget target;
  target.width = std::max(1, int(std::lround(extent.x() * lens.focal_px().x() * scale)));
  target.height = std::max(1, int(std::lround(extent.y() * lens.focal_px().y() * scale)));
  target.fx = target.width / extent.x();
  target.fy = target.height / extent.y();
  target.cx = -field.low.x() * target.fx;
  target.cy = -field.low.y() * target.fy;
  return target;
}

// Pixel of the photo for a position in the target.
class PhotoFromTarget {
 public:
  PhotoFromTarget(const Lens& lens, const PinholeTarget& target) : lens_(lens), target_(target) {}

  Vector2d operator()(const Vector2d& px) const {
    if (!target_.undistort) {  // exact for a photo that keeps its size
      const ColmapCamera& camera = lens_.camera();
      return {px.x() * camera.width / target_.width, px.y() * camera.height / target_.height};
    }
    const Vector2d uv((px.x() - target_.cx) / target_.fx, (px.y() - target_.cy) / target_.fy);
    return lens_.ImageFromCamera(uv).value();  // there for every pixel, by the choice of the target
  }

 private:
  const Lens& lens_;
  const PinholeTarget& target_;
};

// Sums of bilinear samples, colours weighted by alpha.
class Sampler {
 public:
  explicit Sampler(const Image& photo) : photo_(photo) {}

  void Add(const Vector2d& px) {
    const double x = std::clamp(px.x() - 0.5, 0.0, double(photo_.width - 1));
    const double y = std::clamp(px.y() - 0.5, 0.0, double(photo_.height - 1));
    const int x0 = std::min(int(x), std::max(photo_.width - 2, 0)),
              y0 = std::min(int(y), std::max(photo_.height - 2, 0));
    const float ax = float(x - x0), ay = float(y - y0);
    AddPixel(x0, y0, (1 - ax) * (1 - ay));
    if (ax > 0) AddPixel(x0 + 1, y0, ax * (1 - ay));
    if (ay > 0) AddPixel(x0, y0 + 1, (1 - ax) * ay);
    if (ax > 0 && ay > 0) AddPixel(x0 + 1, y0 + 1, ax * ay);
  }

  // Writes the mean and starts again.
  void Take(uint8_t* pixel) {
    const auto rounded = [](float value) { return uint8_t(std::clamp(value + 0.5f, 0.f, 255.f)); };
    const float opacity = photo_.channels == 4 ? sums_[3] / 255 : weight_;
    for (int c = 0; c < 3; ++c) pixel[c] = opacity > 0 ? rounded(sums_[c] / opacity) : 0;
    if (photo_.channels == 4) pixel[3] = rounded(sums_[3] / weight_);
    sums_ = {};
    weight_ = 0;
  }

 private:
  void AddPixel(int x, int y, float weight) {
    const uint8_t* pixel = photo_.pixels.data() + (size_t(y) * photo_.width + x) * photo_.channels;
    const float alpha = photo_.channels == 4 ? pixel[3] / 255.f : 1.f;
    for (int c = 0; c < 3; ++c) sums_[c] += weight * alpha * pixel[c];
    if (photo_.channels == 4) sums_[3] += weight * pixel[3];
    weight_ += weight;
  }

  const Image& photo_;
  std::array<float, 4> sums_{};
  float weight_ = 0;
};

}  // namespace

ColmapCamera PinholeTarget::Camera(uint32_t id) const {
  return {id, CameraModel::kPinhole, width, height, {fx, fy, cx, cy}};
}

double LargestDisplacement(const Lens& lens, int max_image_size) {
  const ColmapCamera& camera = lens.camera();
  constexpr int kGrid = 33;
  double largest_px = 0;
  for (int j = 0; j < kGrid; ++j) {
    for (int i = 0; i < kGrid; ++i) {
      const Vector2d px(camera.width * double(i) / (kGrid - 1), camera.height * double(j) / (kGrid - 1));
      const auto uv = lens.CameraFromImage(px);
      if (!uv) return std::numeric_limits<double>::infinity();
      const Vector2d pinhole = uv->cwiseProduct(lens.focal_px()) + lens.principal_point_px();
      largest_px = std::max(largest_px, (pinhole - px).norm());
    }
  }
  return largest_px * Scale(camera, max_image_size);
}

PinholeTarget ScaledTarget(const Lens& lens, int max_image_size) {
  const ColmapCamera& camera = lens.camera();
  const Vector2d size(camera.width, camera.height);
  const Field field{-lens.principal_point_px().cwiseQuotient(lens.focal_px()),
                    (size - lens.principal_point_px()).cwiseQuotient(lens.focal_px())};
  return TargetOf(lens, field, Scale(camera, max_image_size));
}

PinholeTarget UndistortedTarget(const Lens& lens, int max_image_size) {
  const Field inner = InnerField(lens);
  const auto shrunk = [&](double factor) { return Field{inner.low * factor, inner.high * factor}; };
  double factor = 1;
  if (!HasSource(lens, inner)) {
    double low = 0, high = 1;
    for (int step = 0; step < 30; ++step) (HasSource(lens, shrunk((low + high) / 2)) ? low : high) = (low + high) / 2;
    factor = low;
  }
  const Field field = shrunk(factor);
  const Vector2d extent_px = (field.high - field.low).cwiseProduct(lens.focal_px());
  const ColmapCamera& camera = lens.camera();
  if (!(extent_px.x() > 0.1 * camera.width) || !(extent_px.y() > 0.1 * camera.height)) {
    throw InputError("camera " + std::to_string(camera.id) + " (" + CameraModelName(camera.model) +
                     ") has distortion parameters that leave less than a tenth of the photo usable; its poses were"
                     " probably estimated badly: estimate them again or leave its photos out");
  }
  const double scale = std::min(1.0, max_image_size / extent_px.maxCoeff());
  PinholeTarget target = TargetOf(lens, field, scale);
  target.undistort = true;
  return target;
}

Image Resample(const Image& photo, const Lens& lens, const PinholeTarget& target) {
  const ColmapCamera& camera = lens.camera();
  if (photo.width != camera.width || photo.height != camera.height) {
    throw InputError("the photo is " + std::to_string(photo.width) + "×" + std::to_string(photo.height) +
                     " px, its camera " + std::to_string(camera.width) + "×" + std::to_string(camera.height) +
                     "; run ingest again");
  }
  const PhotoFromTarget photo_from_target(lens, target);
  const double ratio = std::max(lens.focal_px().x() / target.fx, lens.focal_px().y() / target.fy);
  const int n = std::max(1, int(std::ceil(ratio - 0.01)));
  Image image{target.width, target.height, photo.channels, {}};
  image.pixels.resize(size_t(target.width) * target.height * photo.channels);
  Sampler sampler(photo);
  uint8_t* pixel = image.pixels.data();
  for (int y = 0; y < target.height; ++y) {
    for (int x = 0; x < target.width; ++x, pixel += photo.channels) {
      for (int b = 0; b < n; ++b) {
        for (int a = 0; a < n; ++a) sampler.Add(photo_from_target({x + (a + 0.5) / n, y + (b + 0.5) / n}));
      }
      sampler.Take(pixel);
    }
  }
  return image;
}

std::optional<Vector2d> TargetFromPhoto(const Vector2d& px, const Lens& lens, const PinholeTarget& target) {
  Vector2d position;
  if (target.undistort) {
    const auto uv = lens.CameraFromImage(px);
    if (!uv) return {};
    position = {uv->x() * target.fx + target.cx, uv->y() * target.fy + target.cy};
  } else {
    position = {px.x() * target.width / lens.camera().width, px.y() * target.height / lens.camera().height};
  }
  if (!(position.x() >= 0 && position.y() >= 0 && position.x() <= target.width && position.y() <= target.height))
    return {};
  return position;
}

}  // namespace nrff
