// A small ray tracer: analytic objects on a plane under a dome, one soft sun and a sky, one mirror bounce.
//
// World: z up, ground at z = 0, units of the scene. Radiance is linear RGB; `ToneMap` makes it display-referred.
#pragma once

#include <Eigen/Geometry>
#include <array>
#include <cstdint>
#include <optional>
#include <vector>

#include "examples/procedural.h"

namespace nrff {

// Albedo, linear RGB in [0, 1], at `point` (in the object's own axes) with the pixel's width there.
using Texture = Vec3d (*)(const Vec3d& point, double footprint, uint32_t seed);

struct Material {
  Texture texture = nullptr;
  uint32_t seed = 0;
  // Gloss: Blinn-Phong highlight of the sun and a mirror image of the surroundings, both scaled by Schlick's Fresnel
  // term from this value at normal incidence. 0: diffuse.
  double reflectance = 0;
  double shininess = 0;  // Blinn-Phong exponent
};

struct Object {
  enum class Shape { kSphere, kBox, kTorus };
  Shape shape = Shape::kSphere;
  // Sphere: radius, –, –. Box: half extents; edges are rounded by a tenth of the smallest. Torus: ring radius, tube
  // radius, –; its axis is z.
  Vec3d size = Vec3d::Ones();
  Eigen::Isometry3d world_from_object = Eigen::Isometry3d::Identity();
  Material material;
};

struct World {
  std::vector<Object> objects;
  Material ground;
  Material dome;  // emits its texture; a sphere about the origin
  double dome_radius = 0;
  Vec3d to_sun = Vec3d::UnitZ();
  double sun_angular_radius = 0;                                           // radians; what makes shadows soft
  Vec3d sun = Vec3d::Zero(), sky = Vec3d::Zero(), bounce = Vec3d::Zero();  // irradiance/π: sun, from above, from below
};

struct Ray {
  Vec3d origin, direction;  // unit
};

struct Hit {
  double distance = 0;             // along the ray
  Vec3d point, normal;             // world; the normal faces the ray's origin
  const Object* object = nullptr;  // null: ground or dome
  bool dome = false;
};

// The dome closes the world, so every ray from inside it hits.
Hit Intersect(const World& world, const Ray& ray);

// Radiance that arrives along the ray. `spread` is the growth of the pixel's width per unit of distance.
Vec3d Radiance(const World& world, const Ray& ray, double spread);

// Linear radiance → sRGB in [0, 1], highlights rolled off.
Vec3d ToneMap(const Vec3d& radiance);

// What a camera's lens does to the image of a pinhole, as OpenCV's models have it: perspective with k1, k2, p1, p2, or
// a fisheye, whose radius is f·θ·(1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸) at θ from the axis.
struct Distortion {
  bool fisheye = false;
  std::array<double, 4> k{};
};

// OpenCV axes, pixel centres at +0.5.
struct Camera {
  int width = 0, height = 0;  // px
  double focal_px = 0;        // principal point at the centre
  Distortion distortion;
  Eigen::Isometry3d world_from_camera = Eigen::Isometry3d::Identity();
  Vec3d gain = Vec3d::Ones();  // of radiance before ToneMap: exposure and white balance

  Ray RayThrough(double x, double y) const;  // px; by Newton's method where the lens distorts
};

struct Picture {
  std::vector<uint8_t> rgb;     // height × width × 3, sRGB
  std::vector<float> distance;  // height × width, along the ray through the pixel's centre
  std::vector<float> normal;    // height × width × 3, world axes
};

// `samples` rays a pixel, jittered in the cells of a square grid (a square number: 1, 4, 9, …).
Picture Render(const World& world, const Camera& camera, int samples, uint32_t seed);

}  // namespace nrff
