// The scene: what training, rendering and evaluation know about a capture. Written by the pose stage.
//
//   scene.json   this struct (schema in ARCHITECTURE.md)
//   images.u8    the pixels: per view height × width × channels uint8, row-major, sRGB, straight alpha, at pack_offset
//   depths.bin   SparseDepth records, little endian, 20 bytes each; empty where a capture has no triangulated points
//
// Conventions: OpenCV camera axes (x right, y down, z forward); pixel centres at +0.5; pinhole, no distortion left.
#pragma once

#include <array>
#include <cstdint>
#include <filesystem>
#include <string>
#include <vector>

#include "pipeline/json.h"

namespace nrff {

using Vec3 = std::array<double, 3>;
using Mat4 = std::array<double, 16>;  // row-major

enum class Split { kTrain, kTest };

// Longer side of the packed photos, px: unless said otherwise, and the least that can be asked for.
inline constexpr int kMaxImageSize = 800, kLeastMaxImageSize = 16;

struct View {
  std::string id;    // "000012": unique, a safe file name
  std::string name;  // the photo's name, escaped (EscapePath), for people
  Split split = Split::kTrain;
  int width = 0, height = 0;  // px
  int channels = 3;           // 3 RGB, 4 RGBA
  bool masked = false;        // alpha says which pixels count: those of 255; else it shows the background
  uint64_t pack_offset = 0;   // bytes into images.u8
  double fx = 0, fy = 0, cx = 0,
         cy = 0;             // px; principal point in the corner-origin convention (centre of 2×2 px: 1, 1)
  Mat4 scene_from_camera{};  // rigid
  // How many times as bright this view shows red, green and blue of the same things as the mean of the training views
  // does, in display-referred values, as sfm/view_exposure.h measures it; 1 where nothing says otherwise.
  Vec3 colour_gain{1, 1, 1};

  uint64_t PixelBytes() const { return uint64_t(width) * height * channels; }
};

// What is behind everything: RGBA pixels are composited onto it, and photos before a plain backdrop show it. kNone: the
// field explains every pixel.
enum class Background { kNone, kWhite, kBlack };

const char* BackgroundName(Background background);  // "none", "white", "black"
// json["background"]; throws CorruptError naming `where` when there is none or it is another name.
Background ParseBackground(const Json& json, const std::string& where);

struct Scene {
  std::string name;
  Background background = Background::kNone;
  // Bounded: the field fills [aabb_min, aabb_max] and nothing is outside. Unbounded: that box is the foreground, what
  // is outside is contracted (render/scene_map.h).
  bool unbounded = false;
  Vec3 aabb_min{-1, -1, -1}, aabb_max{1, 1, 1};  // scene units
  double near = 0.05, far = 6;                   // along the ray, scene units
  Mat4 scene_from_world{};                       // similarity: scale·rotation, translation
  std::vector<View> views;                       // by id

  std::vector<int> ViewsOf(Split split) const;  // indices
};

// The standard deviation of the training views' exposures, in EV (doublings of the light), from their colour gains.
double ExposureSpread(const Scene& scene);
// Display-referred values go with about this root of the light.
inline constexpr double kDisplayGamma = 2.2;

// A triangulated point as one training view sees it: the surface on that ray is there, give or take `sigma`.
struct SparseDepth {
  uint32_t view = 0;       // index into Scene::views
  float position[3] = {};  // scene units
  float sigma = 0;         // standard deviation of its distance from the camera, scene units, > 0
};
static_assert(sizeof(SparseDepth) == 20);

inline constexpr int kSceneSchemaVersion = 3;

void SaveScene(const Scene& scene, const std::filesystem::path& dir);
// Checks everything a reader relies on: finite, rotations orthonormal and right-handed, offsets inside the pack.
Scene LoadScene(const std::filesystem::path& dir);

void SaveSparseDepths(const std::vector<SparseDepth>& depths, const std::filesystem::path& dir);
// Throws CorruptError naming the file when it is missing, a record is cut off, has a position that is not finite or a
// deviation that is not positive, or is not of a training view of `scene`.
std::vector<SparseDepth> LoadSparseDepths(const Scene& scene, const std::filesystem::path& dir);

// Read-only memory map of images.u8.
class ImagePack {
 public:
  explicit ImagePack(const std::filesystem::path& dir);
  ~ImagePack();
  ImagePack(const ImagePack&) = delete;
  ImagePack& operator=(const ImagePack&) = delete;
  const uint8_t* Pixels(const View& view) const { return data_ + view.pack_offset; }
  const uint8_t* data() const { return data_; }
  uint64_t size_bytes() const { return size_; }

 private:
  const uint8_t* data_ = nullptr;
  uint64_t size_ = 0;
};

inline constexpr char kSceneFile[] = "scene.json";
inline constexpr char kPackFile[] = "images.u8";
inline constexpr char kDepthFile[] = "depths.bin";

Mat4 Multiply(const Mat4& a, const Mat4& b);
// Inverse of a similarity (scale·rotation, translation).
Mat4 InverseSimilarity(const Mat4& m);

}  // namespace nrff
