#include "examples/ray_tracer.h"

#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <numbers>

namespace nrff {
namespace {

constexpr double kNever = 1e30;
constexpr double kSurfaceOffset = 1e-4;  // keeps secondary rays off the surface they leave

double BoundingRadius(const Object& object) {
  switch (object.shape) {
    case Object::Shape::kSphere:
      return object.size.x();
    case Object::Shape::kBox:
      return object.size.norm();
    case Object::Shape::kTorus:
      return object.size.x() + object.size.y();
  }
  return 0;
}

// Radius of the sphere that takes as much of the sky from its neighbours as the object does.
double OcclusionRadius(const Object& object) {
  return object.shape == Object::Shape::kTorus ? 2 * object.size.y() : object.size.minCoeff();
}

double SignedDistance(const Object& object, const Vec3d& p) {
  switch (object.shape) {
    case Object::Shape::kSphere:
      return p.norm() - object.size.x();
    case Object::Shape::kBox: {
      const double round = 0.1 * object.size.minCoeff();
      const Vec3d q = p.cwiseAbs() - (object.size - Vec3d::Constant(round));
      return q.cwiseMax(0).norm() + std::min(q.maxCoeff(), 0.0) - round;
    }
    case Object::Shape::kTorus:
      return Vec2(p.head<2>().norm() - object.size.x(), p.z()).norm() - object.size.y();
  }
  return kNever;
}

// Where the ray enters and leaves a sphere about `centre`; nothing when it misses or the sphere is behind.
std::optional<std::pair<double, double>> IntersectSphere(const Ray& ray, const Vec3d& centre, double radius) {
  const Vec3d to_centre = centre - ray.origin;
  const double along = to_centre.dot(ray.direction);
  const double discriminant = radius * radius - (to_centre - along * ray.direction).squaredNorm();
  if (discriminant < 0) return std::nullopt;
  const double half_chord = std::sqrt(discriminant);
  if (along + half_chord <= 0) return std::nullopt;
  return std::pair{along - half_chord, along + half_chord};
}

// Distance to the object's surface, or kNever. Boxes and tori are sphere-traced [Hart 1996] inside their bounds.
double IntersectObject(const Object& object, const Ray& ray) {
  const auto span = IntersectSphere(ray, object.world_from_object.translation(), BoundingRadius(object));
  if (!span) return kNever;
  if (object.shape == Object::Shape::kSphere) return span->first > 0 ? span->first : kNever;
  const Eigen::Isometry3d object_from_world = object.world_from_object.inverse();
  const Vec3d origin = object_from_world * ray.origin, direction = object_from_world.linear() * ray.direction;
  double t = std::max(span->first, 0.0);
  for (int step = 0; step < 200 && t < span->second; ++step) {
    const double distance = SignedDistance(object, origin + t * direction);
    if (distance < 1e-5) return t;
    t += distance;
  }
  return kNever;
}

Vec3d ObjectNormal(const Object& object, const Vec3d& world_point) {
  const Vec3d p = object.world_from_object.inverse() * world_point;
  constexpr double kStep = 1e-5;
  Vec3d gradient;
  for (int axis = 0; axis < 3; ++axis) {
    const Vec3d step = kStep * Vec3d::Unit(axis);
    gradient[axis] = SignedDistance(object, p + step) - SignedDistance(object, p - step);
  }
  return object.world_from_object.linear() * gradient.normalized();
}

// Share of the sun's disc that is seen from `point`, from how far the ray to its centre passes each object; smooth and
// free of noise. Exact but for the shape of the fall-off for spheres; boxes and tori have only the outer half of their
// penumbra [Quilez 2010].
double SunVisibility(const World& world, const Vec3d& point) {
  double visible = 1;
  for (const Object& object : world.objects) {
    const Vec3d to_centre = object.world_from_object.translation() - point;
    const double along = to_centre.dot(world.to_sun), radius = BoundingRadius(object);
    if (along < -radius) continue;
    const double beside = (to_centre - along * world.to_sun).norm();
    const double penumbra = 2 * world.sun_angular_radius * (along + radius);
    if (beside > radius + penumbra) continue;
    if (object.shape == Object::Shape::kSphere) {
      if (along > 0)
        visible = std::min(visible, SmoothStep(-1, 1, (beside - radius) / (along * world.sun_angular_radius)));
      continue;
    }
    const Eigen::Isometry3d object_from_world = object.world_from_object.inverse();
    const Vec3d origin = object_from_world * point, direction = object_from_world.linear() * world.to_sun;
    double nearest = kNever;  // angular distance to the sun's centre
    for (double t = std::max(along - radius - penumbra, 1e-3); t < along + radius + penumbra;) {
      const double distance = SignedDistance(object, origin + t * direction);
      nearest = std::min(nearest, distance / t);
      if (nearest <= 0) break;
      t += std::max(distance, 2e-3);
    }
    visible = std::min(visible, SmoothStep(0, 2 * world.sun_angular_radius, nearest));
  }
  return visible;
}

// Share of the sky that the other objects leave, each taken as a sphere.
double SkyVisibility(const World& world, const Hit& hit) {
  double visible = 1;
  for (const Object& object : world.objects) {
    if (&object == hit.object) continue;
    const Vec3d to_centre = object.world_from_object.translation() - hit.point;
    const double cosine = hit.normal.dot(to_centre);  // × distance
    if (cosine <= 0) continue;
    const double squared_distance = to_centre.squaredNorm(), radius = OcclusionRadius(object);
    visible *= 1 - std::min(cosine * radius * radius / (squared_distance * std::sqrt(squared_distance)), 0.9);
  }
  return visible;
}

Vec3d Albedo(const World& world, const Hit& hit, double footprint) {
  const Material& material = hit.object ? hit.object->material : hit.dome ? world.dome : world.ground;
  const Vec3d local = hit.object ? hit.object->world_from_object.inverse() * hit.point : hit.point;
  return material.texture(local, footprint, material.seed);
}

Vec3d Shade(const World& world, const Ray& ray, double spread, double distance_before, int n_bounces) {
  const Hit hit = Intersect(world, ray);
  const double cosine = std::max(-hit.normal.dot(ray.direction), 0.05);
  // The geometric mean of the footprint's short and long side: sharper than the long one, still free of aliasing once
  // supersampled.
  const double footprint = spread * (distance_before + hit.distance) / std::sqrt(cosine);
  Vec3d albedo = Albedo(world, hit, footprint);
  if (hit.dome) return albedo;

  const Vec3d surface = hit.point + kSurfaceOffset * hit.normal;
  const double sun_cosine = hit.normal.dot(world.to_sun);
  const double sun = sun_cosine > 0 ? SunVisibility(world, surface) : 0;
  const double up = 0.5 + 0.5 * hit.normal.z();
  const Vec3d ambient = SkyVisibility(world, hit) * (up * world.sky + (1 - up) * world.bounce);
  Vec3d radiance = albedo.cwiseProduct(ambient + std::max(sun_cosine, 0.0) * sun * world.sun);

  const Material& material = hit.object ? hit.object->material : world.ground;
  if (material.reflectance > 0) {
    const Vec3d halfway = (world.to_sun - ray.direction).normalized();
    const double highlight = std::pow(std::max(hit.normal.dot(halfway), 0.0), material.shininess);
    const double fresnel = material.reflectance + (1 - material.reflectance) * std::pow(1 - cosine, 5);
    // Blinn-Phong normalised to conserve energy: (n + 8) / 8π, with the irradiance over π already in `sun`.
    radiance += fresnel * sun * std::max(sun_cosine, 0.0) * highlight * (material.shininess + 8) / 8 * world.sun;
    if (n_bounces > 0) {
      const Ray mirrored{surface, (ray.direction + 2 * cosine * hit.normal).normalized()};
      // A curved mirror widens the pixel's cone by about twice the footprint over the radius of curvature.
      const double curvature = hit.object ? 1 / hit.object->size.x() : 0;
      const double mirrored_spread = spread + 2 * footprint * curvature;
      radiance += fresnel * Shade(world, mirrored, mirrored_spread, footprint / mirrored_spread, n_bounces - 1);
    }
  }
  return radiance;
}

// The direction whose image, in units of the focal length, is `image`.
Vec3d Undistorted(const Distortion& distortion, const Eigen::Vector2d& image) {
  const auto& [k1, k2, k3, k4] = distortion.k;
  constexpr int kMostSteps = 50;
  if (distortion.fisheye) {
    const double radius = image.norm();
    if (radius == 0) return Vec3d::UnitZ();
    double theta = radius;
    for (int step = 0; step < kMostSteps; ++step) {
      const double t2 = theta * theta;
      const double value = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))));
      const double slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)));
      const double change = (value - radius) / slope;
      theta -= change;
      if (std::abs(change) < 1e-14) break;
    }
    const Eigen::Vector2d sideways = std::sin(theta) / radius * image;
    return {sideways.x(), sideways.y(), std::cos(theta)};
  }
  if (distortion.k == std::array<double, 4>{}) return {image.x(), image.y(), 1};
  const double p1 = k3, p2 = k4;
  Eigen::Vector2d uv = image;
  for (int step = 0; step < kMostSteps; ++step) {
    const double u = uv.x(), v = uv.y(), r2 = uv.squaredNorm();
    const double radial = 1 + r2 * (k1 + r2 * k2), slope = 2 * (k1 + 2 * r2 * k2);  // d radial = slope · (u du + v dv)
    const Eigen::Vector2d value(u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u),
                                v * radial + 2 * p2 * u * v + p1 * (r2 + 2 * v * v));
    Eigen::Matrix2d jacobian;
    jacobian << radial + slope * u * u + 2 * p1 * v + 6 * p2 * u, slope * u * v + 2 * p1 * u + 2 * p2 * v,
        slope * u * v + 2 * p1 * u + 2 * p2 * v, radial + slope * v * v + 2 * p2 * u + 6 * p1 * v;
    const Eigen::Vector2d change = jacobian.inverse() * (value - image);
    uv -= change;
    if (change.norm() < 1e-14) break;
  }
  return {uv.x(), uv.y(), 1};
}

}  // namespace

Hit Intersect(const World& world, const Ray& ray) {
  Hit hit;
  hit.distance = kNever;
  for (const Object& object : world.objects) {
    const double distance = IntersectObject(object, ray);
    if (distance < hit.distance) {
      hit.distance = distance;
      hit.object = &object;
    }
  }
  if (ray.direction.z() < 0) {
    const double distance = -ray.origin.z() / ray.direction.z();
    if (distance < hit.distance) {
      hit.distance = distance;
      hit.object = nullptr;
    }
  }
  if (const auto span = IntersectSphere(ray, Vec3d::Zero(), world.dome_radius); span && span->second < hit.distance) {
    hit.distance = span->second;
    hit.object = nullptr;
    hit.dome = true;
  }
  hit.point = ray.origin + hit.distance * ray.direction;
  hit.normal = hit.object ? ObjectNormal(*hit.object, hit.point)
               : hit.dome ? Vec3d(-hit.point.normalized())
                          : Vec3d(Vec3d::UnitZ());
  return hit;
}

Vec3d Radiance(const World& world, const Ray& ray, double spread) { return Shade(world, ray, spread, 0, 1); }

Vec3d ToneMap(const Vec3d& radiance) {
  Vec3d srgb;
  for (int i = 0; i < 3; ++i) {
    // Linear up to 0.7, then an exponential shoulder with the same slope that ends at 1.
    const double x = radiance[i];
    const double y = x < 0.7 ? x : 1 - 0.3 * std::exp((0.7 - x) / 0.3);
    srgb[i] = y <= 0.0031308 ? 12.92 * y : 1.055 * std::pow(y, 1 / 2.4) - 0.055;
  }
  return srgb;
}

Ray Camera::RayThrough(double x, double y) const {
  const Vec3d direction = Undistorted(distortion, {(x - 0.5 * width) / focal_px, (y - 0.5 * height) / focal_px});
  return {world_from_camera.translation(), world_from_camera.linear() * direction.normalized()};
}

Picture Render(const World& world, const Camera& camera, int samples, uint32_t seed) {
  const int grid = std::max(1, static_cast<int>(std::lround(std::sqrt(samples))));
  const size_t n_pixels = static_cast<size_t>(camera.width) * camera.height;
  Picture picture;
  picture.rgb.resize(3 * n_pixels);
  picture.distance.resize(n_pixels);
  picture.normal.resize(3 * n_pixels);
  for (int y = 0; y < camera.height; ++y) {
    for (int x = 0; x < camera.width; ++x) {
      const size_t pixel = static_cast<size_t>(y) * camera.width + x;
      Vec3d sum = Vec3d::Zero();
      for (int i = 0; i < grid * grid; ++i) {
        const uint32_t sample = Hash(x, y, i, seed);
        const int column = i % grid, row = i / grid;
        const double u = (column + UnitFromHash(Hash(0, 0, 0, sample))) / grid;
        const double v = (row + UnitFromHash(Hash(0, 1, 0, sample))) / grid;
        sum += Radiance(world, camera.RayThrough(x + u, y + v), 1 / camera.focal_px);
      }
      const Vec3d srgb = ToneMap(camera.gain.cwiseProduct(sum) / (grid * grid));
      const Hit hit = Intersect(world, camera.RayThrough(x + 0.5, y + 0.5));
      picture.distance[pixel] = static_cast<float>(hit.distance);
      for (int channel = 0; channel < 3; ++channel) {
        picture.rgb[3 * pixel + channel] = static_cast<uint8_t>(std::lround(255 * std::clamp(srgb[channel], 0.0, 1.0)));
        picture.normal[3 * pixel + channel] = static_cast<float>(hit.normal[channel]);
      }
    }
  }
  return picture;
}

}  // namespace nrff
