#include "tests/ball_scene.h"

#include <cmath>
#include <fstream>
#include <numbers>

#include "pipeline/files.h"

namespace nrff {
namespace {

// What a camera at `eye` looking at the origin sees of a shaded ball of radius 0.5: RGBA.
std::vector<uint8_t> BallImage(const View& view) {
  std::vector<uint8_t> pixels;
  const Mat4& m = view.scene_from_camera;
  for (int y = 0; y < kBallViewSize; ++y) {
    for (int x = 0; x < kBallViewSize; ++x) {
      const double camera[3] = {(x + 0.5 - view.cx) / view.fx, (y + 0.5 - view.cy) / view.fy, 1};
      double d[3], o[3] = {m[3], m[7], m[11]}, dd = 0, od = 0, oo = 0;
      for (int k = 0; k < 3; ++k) {
        d[k] = m[4 * k] * camera[0] + m[4 * k + 1] * camera[1] + m[4 * k + 2] * camera[2];
        dd += d[k] * d[k];
        od += o[k] * d[k];
        oo += o[k] * o[k];
      }
      const double root = od * od - dd * (oo - 0.25);
      const bool hit = root > 0;
      const double t = hit ? (-od - std::sqrt(root)) / dd : 0;
      for (int k = 0; k < 3; ++k) {
        const double normal = 2 * (o[k] + t * d[k]);
        pixels.push_back(hit ? uint8_t(std::lround(127.5 + 100 * normal)) : 0);
      }
      pixels.push_back(hit ? 255 : 0);
    }
  }
  return pixels;
}

}  // namespace

// Six views of the ball around the equator to train on, two above to hold out.
Scene WriteBallScene(const std::filesystem::path& dir) {
  Scene scene;
  scene.name = "ball";
  scene.background = Background::kWhite;
  scene.near = 0.5;
  scene.far = 5;
  scene.scene_from_world = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
  std::ofstream pack(dir / kPackFile, std::ios::binary);
  for (int i = 0; i < 8; ++i) {
    const double azimuth = 2 * std::numbers::pi * i / 6, height = i < 6 ? 0.5 * (i % 2) : 1;
    const double norm = std::sqrt(1 + height * height), c = std::cos(azimuth), s = std::sin(azimuth);
    const double z[3] = {-c / norm, -s / norm, -height / norm}, right[3] = {-s, c, 0};
    const double down[3] = {z[1] * right[2] - z[2] * right[1], z[2] * right[0] - z[0] * right[2],
                            z[0] * right[1] - z[1] * right[0]};
    View view;
    view.id = "00000" + std::to_string(i);
    view.name = view.id + ".png";
    view.split = i < 6 ? Split::kTrain : Split::kTest;
    view.width = view.height = kBallViewSize;
    view.channels = 4;
    view.pack_offset = uint64_t(i) * kBallViewSize * kBallViewSize * 4;
    view.fx = view.fy = 1.5 * kBallViewSize;
    view.cx = view.cy = kBallViewSize / 2.;
    view.scene_from_camera = {0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1};
    for (int k = 0; k < 3; ++k) {
      view.scene_from_camera[4 * k] = right[k];
      view.scene_from_camera[4 * k + 1] = down[k];
      view.scene_from_camera[4 * k + 2] = z[k];
      view.scene_from_camera[4 * k + 3] = -2 * z[k];
    }
    scene.views.push_back(view);
    const std::vector<uint8_t> pixels = BallImage(view);
    pack.write(reinterpret_cast<const char*>(pixels.data()), std::streamsize(pixels.size()));
  }
  pack.close();
  SaveScene(scene, dir);
  SaveSparseDepths({}, dir);
  return scene;
}

// Points of the ball's front on rays of the training views.
std::vector<SparseDepth> BallDepths(const Scene& scene) {
  std::vector<SparseDepth> depths;
  for (const int v : scene.ViewsOf(Split::kTrain)) {
    const Mat4& m = scene.views[v].scene_from_camera;
    const double norm = std::sqrt(m[3] * m[3] + m[7] * m[7] + m[11] * m[11]);
    for (const double lean : {-0.6, -0.3, 0., 0.3, 0.6}) {  // radians from the direction of the camera
      SparseDepth depth{uint32_t(v), {}, 0.005F};
      for (int k = 0; k < 3; ++k)
        depth.position[k] = float(0.5 * (std::cos(lean) * m[4 * k + 3] / norm + std::sin(lean) * m[4 * k]));
      depths.push_back(depth);
    }
  }
  return depths;
}

Preset BallPreset(int64_t steps) {
  Preset preset = MakePreset("tiny", false);
  preset.field.levels = 2;
  preset.field.max_resolution = 24;
  preset.field.spatial_width = preset.field.directional_width = 16;
  preset.field.lobes_theta = 3;
  preset.field.lobes_phi = 4;
  preset.train.steps = steps;
  preset.train.rays = 256;
  preset.train.max_rays = 512;
  preset.train.target_shaded = 1024;
  preset.train.occupancy_resolution = 32;
  preset.train.occupancy_cells = 2048;
  preset.train.step_voxels = {16, 32};
  preset.train.step_moments = {0.2};
  preset.train.camera_moments = {};
  return preset;
}

}  // namespace nrff
