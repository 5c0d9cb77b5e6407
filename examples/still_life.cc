#include "examples/still_life.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>

namespace nrff {
namespace {

constexpr double kPi = std::numbers::pi;

Vec3d Mix(const Vec3d& a, const Vec3d& b, double t) { return a + std::clamp(t, 0.0, 1.0) * (b - a); }

// Brightness multiplied by 1 + `change`, kept a valid albedo.
Vec3d Shaded(const Vec3d& albedo, double change) { return (albedo * std::max(1 + change, 0.1)).cwiseMin(0.95); }

// Flagstones: each of its own colour and grain, some painted with fine checks, with dark joints.
Vec3d Paving(const Vec3d& p, double footprint, uint32_t seed) {
  static const std::array<Vec3d, 7> kStones = {
      Vec3d(0.55, 0.42, 0.28), Vec3d(0.33, 0.36, 0.40), Vec3d(0.50, 0.24, 0.15), Vec3d(0.30, 0.36, 0.20),
      Vec3d(0.68, 0.62, 0.50), Vec3d(0.22, 0.31, 0.42), Vec3d(0.46, 0.40, 0.38)};
  constexpr double kStoneSize = 0.42, kJoint = 0.012;
  // Warped a little, so that joints are not straight lines.
  const Vec2 warp(Fractal(p, 0.3, 2, 0.5, footprint, seed + 10), Fractal(p, 0.3, 2, 0.5, footprint, seed + 20));
  const Vec2 plane = p.head<2>() + 0.03 * warp;
  const Cell cell = FindCell(plane / kStoneSize, seed);
  const double grain = Fractal(p, 0.3, 7, 0.78, footprint, seed + 30);
  // Chips of lighter and darker stone, crisp at two sizes.
  const double chips = SmoothStep(0.30, 0.38, Fractal(p, 0.06, 2, 0.6, footprint, seed + 40)) -
                       SmoothStep(0.30, 0.38, Fractal(p, 0.11, 2, 0.6, footprint, seed + 50));
  Vec3d stone = Shaded(kStones[cell.id % kStones.size()], 0.5 * grain + 0.7 * chips);
  if (cell.id / 7 % 3 == 0) {
    const double angle = UnitFromHash(cell.id * 2654435761u) * kPi;
    const Vec2 turned(std::cos(angle) * plane.x() + std::sin(angle) * plane.y(),
                      std::cos(angle) * plane.y() - std::sin(angle) * plane.x());
    stone = Shaded(stone, 0.55 * RandomChecks(turned, 0.045, footprint, cell.id));
  }
  const double border = cell.border * kStoneSize;
  const double softness = std::max(0.006, 0.5 * footprint);
  return Mix(Vec3d(0.07, 0.06, 0.05), stone, SmoothStep(kJoint - softness, kJoint + softness, border));
}

// Hills in three layers against a clouded evening sky; emitted radiance.
Vec3d Landscape(const Vec3d& p, double footprint, uint32_t seed) {
  const double radius = p.norm();
  const Vec3d direction = p / radius;
  const double height = direction.z(), blur = footprint / radius, softness = std::max(0.002, blur);
  // From the nearest layer, which is the lowest, darkest and greenest, to the farthest.
  static const std::array<Vec3d, 3> kHills = {Vec3d(0.10, 0.15, 0.07), Vec3d(0.17, 0.24, 0.22),
                                              Vec3d(0.27, 0.33, 0.44)};
  const Vec3d along = Vec3d(direction.x(), direction.y(), 0).normalized();
  Vec3d colour = Vec3d::Zero();
  double uncovered = 1;
  for (size_t layer = 0; layer < kHills.size() && uncovered > 0; ++layer) {
    const uint32_t layer_seed = seed + 100 * static_cast<uint32_t>(layer + 1);
    const double crest =
        0.05 + 0.06 * static_cast<double>(layer) + 0.09 * Fractal(along, 0.6, 6, 0.5, blur, layer_seed);
    const double cover = 1 - SmoothStep(crest - softness, crest + softness, height);
    if (cover <= 0) continue;
    // Clumps of trees, crisp at several sizes.
    const double woods = Fractal(direction, 0.09, 6, 0.85, blur, layer_seed + 50);
    const double clumps = SmoothStep(-0.10, 0.05, woods) + SmoothStep(0.4, 0.5, woods) - 0.8;
    colour += uncovered * cover * Shaded(kHills[layer], 0.45 * clumps);
    uncovered *= 1 - cover;
  }
  if (uncovered <= 0) return colour;
  const double clouds = Fractal(direction.cwiseProduct(Vec3d(1, 1, 2.5)), 0.7, 7, 0.6, blur, seed);
  const Vec3d sky = Mix(Vec3d(0.88, 0.62, 0.42), Vec3d(0.13, 0.27, 0.58), std::sqrt(std::max(height, 0.0)) * 1.2);
  return colour + uncovered * Mix(sky, Vec3d(0.95, 0.90, 0.85), SmoothStep(-0.05, 0.6, clouds) * 0.85);
}

// Glaze with flecks of a lighter tone.
Vec3d TealGlaze(const Vec3d& p, double footprint, uint32_t seed) {
  const double clouds = Fractal(p, 0.4, 5, 0.6, footprint, seed);
  const double flecks = Fractal(p, 0.07, 3, 0.7, footprint, seed + 10);
  const Vec3d glaze = Mix(Vec3d(0.005, 0.05, 0.07), Vec3d(0.02, 0.22, 0.24), 0.5 + 0.8 * clouds);
  return Mix(glaze, Vec3d(0.62, 0.58, 0.40), SmoothStep(0.42, 0.60, flecks));
}

Vec3d RedLacquer(const Vec3d& p, double footprint, uint32_t seed) {
  const double clouds = Fractal(p, 0.2, 5, 0.6, footprint, seed);
  const double threads = std::abs(Fractal(p, 0.13, 4, 0.55, footprint, seed + 10));
  const Vec3d lacquer = Shaded(Vec3d(0.42, 0.025, 0.02), 0.7 * clouds);
  return Mix(Vec3d(0.75, 0.48, 0.12), lacquer, SmoothStep(0.015, 0.04, threads));
}

// Layers of clay, bent by noise.
Vec3d Terracotta(const Vec3d& p, double footprint, uint32_t seed) {
  const double bend = Fractal(p, 0.3, 6, 0.6, footprint, seed);
  const double layers = std::sin(26 * (p.z() + 0.35 * p.x()) + 5 * bend);
  const double grain = Fractal(p, 0.06, 4, 0.8, footprint, seed + 10);
  return Shaded(Mix(Vec3d(0.60, 0.23, 0.10), Vec3d(0.84, 0.70, 0.50), 0.5 + 0.7 * layers), 0.35 * grain);
}

// A cube painted on every side with checks of many colours under worn varnish.
Vec3d PaintedChecks(const Vec3d& p, double footprint, uint32_t seed) {
  static const std::array<Vec3d, 6> kPaints = {Vec3d(0.75, 0.56, 0.13), Vec3d(0.10, 0.25, 0.44),
                                               Vec3d(0.62, 0.16, 0.10), Vec3d(0.80, 0.75, 0.64),
                                               Vec3d(0.12, 0.34, 0.22), Vec3d(0.09, 0.08, 0.10)};
  constexpr double kCheckSize = 0.094;
  int axis = 0;
  p.cwiseAbs().maxCoeff(&axis);
  const uint32_t side = seed + 10 * static_cast<uint32_t>(2 * axis + (p[axis] > 0));
  const Vec2 face(p[(axis + 1) % 3], p[(axis + 2) % 3]);
  const uint32_t check = Hash(static_cast<int32_t>(std::floor(face.x() / kCheckSize)),
                              static_cast<int32_t>(std::floor(face.y() / kCheckSize)), 0, side);
  const double wear = Fractal(p, 0.3, 7, 0.75, footprint, seed + 100);
  return Shaded(kPaints[check % kPaints.size()],
                0.4 * wear + 0.2 * RandomChecks(face, kCheckSize / 4, footprint, side));
}

Vec3d Wood(const Vec3d& p, double footprint, uint32_t seed) {
  const double bend = Fractal(p, 0.25, 4, 0.5, footprint, seed);
  const double rings = std::sin(70 * std::hypot(p.x() + 0.3, p.y() + 0.05 * bend) + 4 * bend);
  const double fibres = Fractal(p.cwiseProduct(Vec3d(1, 1, 0.15)), 0.05, 4, 0.8, footprint, seed + 10);
  return Shaded(Mix(Vec3d(0.28, 0.14, 0.06), Vec3d(0.62, 0.40, 0.20), 0.5 + 0.5 * rings), 0.45 * fibres);
}

// Enamel ring: segments of two golds and a blue, with a fine grain.
Vec3d Enamel(const Vec3d& p, double footprint, uint32_t seed) {
  const double turn = std::atan2(p.y(), p.x()) / (2 * kPi) + 0.5;
  const uint32_t segment = Hash(static_cast<int32_t>(turn * 22), 0, 0, seed);
  const double grain = Fractal(p, 0.08, 5, 0.7, footprint, seed + 10);
  const Vec3d colour = segment % 3 == 0   ? Vec3d(0.03, 0.08, 0.30)
                       : segment % 3 == 1 ? Vec3d(0.72, 0.46, 0.10)
                                          : Vec3d(0.52, 0.30, 0.08);
  return Shaded(colour, 0.5 * grain);
}

Vec3d Pebble(const Vec3d& p, double footprint, uint32_t seed) {
  const Vec3d tone = Mix(Vec3d(0.62, 0.56, 0.48), Vec3d(0.26, 0.28, 0.31), UnitFromHash(Hash(1, 2, 3, seed)));
  return Shaded(tone, 0.7 * Fractal(p, 0.12, 5, 0.8, footprint, seed));
}

Object Place(Object::Shape shape, const Vec3d& size, const Vec3d& centre, double turn_degrees, Texture texture,
             uint32_t seed) {
  Object object;
  object.shape = shape;
  object.size = size;
  object.world_from_object.translation() = centre;
  object.world_from_object.linear() = Eigen::AngleAxisd(turn_degrees * kPi / 180, Vec3d::UnitZ()).toRotationMatrix();
  object.material = {.texture = texture, .seed = seed};
  return object;
}

bool Overlaps(const std::vector<Object>& objects, const Vec3d& centre, double radius) {
  return std::any_of(objects.begin(), objects.end(), [&](const Object& other) {
    const double other_radius = other.shape == Object::Shape::kTorus ? other.size.x() + other.size.y()
                                : other.shape == Object::Shape::kBox ? other.size.head<2>().norm()
                                                                     : other.size.x();
    return (other.world_from_object.translation() - centre).head<2>().norm() < radius + other_radius + 0.03;
  });
}

}  // namespace

World MakeStillLife(Finish finish, uint32_t seed) {
  using Shape = Object::Shape;
  World world;
  world.ground = {.texture = Paving, .seed = seed + 1000};
  world.dome = {.texture = Landscape, .seed = seed + 2000};
  world.dome_radius = 12;
  world.to_sun = Vec3d(0.65, -0.40, 0.62).normalized();
  world.sun_angular_radius = 0.05;
  world.sun = Vec3d(1.30, 1.10, 0.84);
  world.sky = Vec3d(0.22, 0.26, 0.34);
  world.bounce = Vec3d(0.14, 0.11, 0.08);

  const auto add = [&](Object object, double reflectance, double shininess) {
    if (finish == Finish::kGlossy) {
      object.material.reflectance = reflectance;
      object.material.shininess = shininess;
    }
    world.objects.push_back(std::move(object));
  };
  add(Place(Shape::kSphere, {0.56, 0, 0}, {0, 0.05, 0.56}, 0, TealGlaze, seed + 1), 0.22, 400);
  add(Place(Shape::kSphere, {0.38, 0, 0}, {-1.0, 0.35, 0.38}, 20, Terracotta, seed + 2), 0, 0);
  add(Place(Shape::kBox, {0.33, 0.33, 0.33}, {0.82, 0.72, 0.33}, 24, PaintedChecks, seed + 3), 0, 0);
  add(Place(Shape::kBox, {0.17, 0.17, 0.17}, {0.78, 0.70, 0.83}, 63, Wood, seed + 4), 0, 0);
  add(Place(Shape::kTorus, {0.34, 0.115, 0}, {0.66, -0.78, 0.115}, 0, Enamel, seed + 5), 0.15, 150);
  add(Place(Shape::kSphere, {0.26, 0, 0}, {-0.62, -0.74, 0.26}, 0, RedLacquer, seed + 6), 0.06, 250);
  add(Place(Shape::kBox, {0.14, 0.26, 0.09}, {-0.35, 1.0, 0.09}, -38, Wood, seed + 7), 0, 0);
  constexpr size_t kObjectsWithPebbles = 19;
  for (int32_t attempt = 0; world.objects.size() < kObjectsWithPebbles; ++attempt) {
    const auto random = [&](int32_t i) { return UnitFromHash(Hash(attempt, i, 7, seed)); };
    const double distance = 0.5 + 1.3 * random(0), angle = 2 * kPi * random(1), radius = 0.05 + 0.06 * random(2);
    const Vec3d centre(distance * std::cos(angle), distance * std::sin(angle), radius);
    if (Overlaps(world.objects, centre, radius)) continue;
    add(Place(Shape::kSphere, {radius, 0, 0}, centre, 0, Pebble, seed + 50 + static_cast<uint32_t>(attempt)), 0, 0);
  }
  return world;
}

std::vector<Camera> MakeOrbit(int n_views, uint32_t seed) {
  constexpr double kFullCircle = 24;  // views
  const int n_low = (n_views + 1) / 2;
  const double arc = 2 * kPi * std::min(1.0, std::pow(n_views / kFullCircle, 1.5));
  std::vector<Camera> cameras;
  for (int i = 0; i < n_views; ++i) {
    // In [-1, 1], the k-th deviation of this view.
    const auto deviation = [&](int32_t k) { return 2 * UnitFromHash(Hash(i, k, 11, seed)) - 1; };
    const bool low = i < n_low;
    const double place = low ? i : i - n_low + 0.5;
    const double angle = arc / n_low * (place + 0.12 * deviation(0)) - 0.5 * kPi;
    const double radius = (low ? 3.2 : 2.8) * (1 + 0.03 * deviation(1));
    const Vec3d centre(radius * std::cos(angle), radius * std::sin(angle), (low ? 1.20 : 2.30) + 0.12 * deviation(2));
    const Vec3d target(0.06 * deviation(3), 0.06 * deviation(4), 0.36 + 0.05 * deviation(5));
    const double roll = 0.03 * deviation(6);

    const Vec3d forward = (target - centre).normalized();
    const Vec3d right = forward.cross(Vec3d::UnitZ()).normalized();
    Eigen::Matrix3d world_from_camera;
    world_from_camera << right, forward.cross(right), forward;
    Camera camera;
    camera.world_from_camera.linear() = world_from_camera * Eigen::AngleAxisd(roll, Vec3d::UnitZ());
    camera.world_from_camera.translation() = centre;
    cameras.push_back(camera);
  }
  return cameras;
}

}  // namespace nrff
