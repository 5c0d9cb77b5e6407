// Makes the example capture: photos of a ray-traced scene as a camera would write them, with the truth beside them.
//
//   DIR/photos/IMG_0001.jpg …       JPEG with EXIF
//   DIR/truth/transforms.json       exact poses (OpenGL axes) and intrinsics of the photos
//   DIR/truth/truth.json            units, objects, files per view
//   DIR/truth/depth, DIR/truth/normal   16-bit PNG per view
//   DIR/photos/masks            with --passers-by: black where a photo shows something else than the scene; DIR/masks
//                               with --posed
//
// With --posed DIR is itself a posed capture: DIR/transforms.json and DIR/images/*.png in place of DIR/photos.
#include <OpenImageIO/imageio.h>
#include <fmt/format.h>

#include <atomic>
#include <exception>
#include <memory>
#include <mutex>
#include <numbers>
#include <thread>

#include "examples/still_life.h"
#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/json.h"
#include "pipeline/progress.h"
#include "pipeline/stage.h"

namespace fs = std::filesystem;

namespace nrff {
namespace {

constexpr int kFocal35mm = 35;  // 35 mm equivalent, by the diagonal (CIPA DCG-001)
constexpr int kSecondFocal35mm = 28;
constexpr double kZoom35mm[] = {28, 50};
constexpr double kFullFrameDiagonalMm = 43.2666;
constexpr double kCropFactor = 5.5;        // of a small sensor
constexpr double kDepthUnit = 1.0 / 2048;  // scene units per step of the 16-bit depth

// Real ones' distortion, about: a kit zoom's moustache, an action camera's barrel, a fisheye of 160° across.
enum class LensKind { kPinhole, kBrown, kWide, kFisheye };
constexpr double kWide35mm = 17, kFisheye35mm = 15.6;
Distortion DistortionOf(LensKind lens) {
  switch (lens) {
    case LensKind::kPinhole:
      return {};
    case LensKind::kBrown:
      return {false, {-0.16, 0.22, 0.001, -0.0015}};
    case LensKind::kWide:
      return {false, {-0.25, 0.06, 0.0005, -0.0005}};
    case LensKind::kFisheye:
      return {true, {-0.02, 0.004, -0.001, 0}};
  }
  return {};
}

struct Options {
  fs::path out;
  int n_views = 24, width = 640, height = 480, samples = 4;
  uint32_t seed = 1;
  bool posed = false;
  Finish finish = Finish::kGlossy;
  double exposure_drift_ev = 0;
  bool passers_by = false;
  LensKind lens = LensKind::kPinhole;
  bool second_camera = false, turned = false, focal_jitter = false, no_focal = false;
  int zoom = 0;
  int n_threads = static_cast<int>(std::max(1u, std::thread::hardware_concurrency()));
};

std::string ViewName(int i) { return fmt::format("IMG_{:04d}", i + 1); }
std::string PhotoPath(const Options& options, int i) {
  return options.posed ? "images/" + ViewName(i) + ".png" : "photos/" + ViewName(i) + ".jpg";
}

// As COLMAP names them.
std::string MaskPath(const Options& options, int i) {
  const fs::path photo = PhotoPath(options, i);
  return (options.posed ? photo.parent_path().parent_path() : photo.parent_path()) / "masks" /
         (photo.filename().string() + ".png");
}

void WriteImage(const fs::path& path, const OIIO::ImageSpec& spec, const void* pixels) {
  const std::unique_ptr<OIIO::ImageOutput> file = OIIO::ImageOutput::create(path.string());
  if (!file || !file->open(path.string(), spec) || !file->write_image(spec.format, pixels) || !file->close()) {
    throw ResourceError(fmt::format("{} cannot be written ({}); check the disk's space and permissions",
                                    EscapePath(path), file ? file->geterror() : OIIO::geterror()));
  }
}

// Exposure rises and falls twice along the capture, white balance once, a third as far and the other way round for
// blue. Gains of red, green and blue; EV of the exposure.
double ExposureEv(const Options& options, int i) {
  return options.exposure_drift_ev / 2 * std::sin(4 * std::numbers::pi * i / options.n_views);
}
Vec3d Gain(const Options& options, int i) {
  const double balance = options.exposure_drift_ev / 6 * std::sin(2 * std::numbers::pi * i / options.n_views);
  const double ev = ExposureEv(options, i);
  return {std::exp2(ev + balance), std::exp2(ev), std::exp2(ev - balance)};
}

bool IsOfSecondCamera(const Options& options, int i) { return options.second_camera && i % 2 == 1; }

// How the camera was held for the photo, as EXIF has it.
int Orientation(const Options& options, int i) {
  constexpr int kTurned[] = {1, 6, 8};
  return options.turned ? kTurned[i % 3] : 1;
}

// 35 mm equivalent of the photo's focal length.
double Focal35mm(const Options& options, int i) {
  if (IsOfSecondCamera(options, i)) return kSecondFocal35mm;
  if (options.lens == LensKind::kWide) return kWide35mm;
  if (options.lens == LensKind::kFisheye) return kFisheye35mm;
  if (options.zoom == 0) return kFocal35mm;
  const double step = options.zoom == 1 ? 0 : double(i % options.zoom) / (options.zoom - 1);
  return kZoom35mm[0] * std::pow(kZoom35mm[1] / kZoom35mm[0], step);
}

// The photo's camera, where MakeOrbit has it. A turned photo's picture is upright.
void SetUp(const Options& options, int i, Camera& camera) {
  camera.width = options.width;
  camera.height = options.height;
  if (IsOfSecondCamera(options, i)) camera.width = options.height * 5 / 4;  // of another shape
  camera.focal_px = Focal35mm(options, i) / kFullFrameDiagonalMm * std::hypot(camera.width, camera.height);
  if (Orientation(options, i) != 1) std::swap(camera.width, camera.height);
  camera.distortion = DistortionOf(options.lens);
  camera.gain = Gain(options, i);
}

// As the sensor has it: what displaying turns by a quarter to the right (EXIF orientation 6) or to the left (8).
template <typename T>
std::vector<T> Stored(const std::vector<T>& shown, const OIIO::ImageSpec& stored, int orientation) {
  if (orientation == 1) return shown;
  const size_t width = size_t(stored.width), height = size_t(stored.height), channels = size_t(stored.nchannels);
  std::vector<T> pixels(shown.size());
  for (size_t y = 0; y < height; ++y) {
    for (size_t x = 0; x < width; ++x) {
      const size_t from = orientation == 6 ? x * height + (height - 1 - y) : (width - 1 - x) * height + y;
      std::copy_n(&shown[from * channels], channels, &pixels[(y * width + x) * channels]);
    }
  }
  return pixels;
}

OIIO::ImageSpec PhotoSpec(const Options& options, const Camera& camera, int i) {
  OIIO::ImageSpec spec(camera.width, camera.height, 3, OIIO::TypeDesc::UINT8);
  spec.attribute("oiio:ColorSpace", "sRGB");
  if (options.posed) return spec;
  const std::string time = fmt::format("2024:06:21 19:{:02d}:{:02d}", 30 + i * 4 / 60, i * 4 % 60);
  spec.attribute("Compression", "jpeg:92");
  if (Orientation(options, i) != 1) std::swap(spec.width, spec.height);
  spec.full_width = spec.width;
  spec.full_height = spec.height;
  spec.attribute("Orientation", Orientation(options, i));
  spec.attribute("Make", "NRFF");
  spec.attribute("Model", IsOfSecondCamera(options, i) ? "Second Camera" : "Example Camera");
  spec.attribute("DateTime", time);
  spec.attribute("Exif:DateTimeOriginal", time);
  if (!options.no_focal) {
    const double focal = Focal35mm(options, i) + (options.focal_jitter ? i * 7 % 3 - 1 : 0);
    spec.attribute("Exif:FocalLength", static_cast<float>(focal / kCropFactor));
    spec.attribute("Exif:FocalLengthIn35mmFilm", static_cast<int>(std::lround(focal)));
  }
  spec.attribute("ExposureTime", static_cast<float>(std::exp2(ExposureEv(options, i)) / 250));
  spec.attribute("FNumber", 5.6f);
  spec.attribute("Exif:ISOSpeedRatings", 100);
  return spec;
}

// A striped ellipse over a seventh of the picture, at another place and in other colours in each; its mask is black
// there.
void AddPasserBy(const Options& options, const Camera& camera, int i, Picture& picture, std::vector<uint8_t>& mask) {
  const auto random = [&](int k) { return UnitFromHash(Hash(i, k, 17, options.seed)); };
  const double cx = (0.2 + 0.6 * random(0)) * camera.width, cy = (0.3 + 0.4 * random(1)) * camera.height;
  const double rx = 0.15 * camera.width, ry = 0.3 * camera.height, angle = std::numbers::pi * random(2);
  const double stripe = 0.03 * camera.height * (1 + random(3));
  mask.assign(static_cast<size_t>(camera.width) * camera.height, 255);
  for (int y = 0; y < camera.height; ++y) {
    for (int x = 0; x < camera.width; ++x) {
      const double dx = x + 0.5 - cx, dy = y + 0.5 - cy;
      if (dx * dx / (rx * rx) + dy * dy / (ry * ry) > 1) continue;
      const size_t pixel = static_cast<size_t>(y) * camera.width + x;
      mask[pixel] = 0;
      const bool odd = std::fmod(dx * std::cos(angle) + dy * std::sin(angle) + 1e3 * stripe, 2 * stripe) < stripe;
      for (int c = 0; c < 3; ++c) {
        picture.rgb[3 * pixel + static_cast<size_t>(c)] = static_cast<uint8_t>(255 * random(4 + c + (odd ? 3 : 0)));
      }
    }
  }
}

void WriteView(const Options& options, const World& world, const Camera& camera, int i, const fs::path& dir) {
  Picture picture = Render(world, camera, options.samples, options.seed + 7919 * static_cast<uint32_t>(i + 1));
  const OIIO::ImageSpec photo = PhotoSpec(options, camera, i);
  const int orientation = options.posed ? 1 : Orientation(options, i);
  if (options.passers_by) {
    std::vector<uint8_t> mask;
    AddPasserBy(options, camera, i, picture, mask);
    const OIIO::ImageSpec spec(photo.width, photo.height, 1, OIIO::TypeDesc::UINT8);
    WriteImage(dir / MaskPath(options, i), spec, Stored(mask, spec, orientation).data());
  }
  WriteImage(dir / PhotoPath(options, i), photo, Stored(picture.rgb, photo, orientation).data());

  std::vector<uint16_t> depth(picture.distance.size()), normal(picture.normal.size());
  for (size_t p = 0; p < depth.size(); ++p) {
    depth[p] = static_cast<uint16_t>(std::lround(picture.distance[p] / kDepthUnit));
  }
  for (size_t p = 0; p < normal.size(); ++p) {
    normal[p] = static_cast<uint16_t>(std::lround((picture.normal[p] + 1) / 2 * 65535));
  }
  OIIO::ImageSpec spec(camera.width, camera.height, 1, OIIO::TypeDesc::UINT16);
  spec.attribute("png:compressionLevel", 3);
  WriteImage(dir / "truth/depth" / (ViewName(i) + ".png"), spec, depth.data());
  spec.nchannels = 3;
  spec.default_channel_names();
  WriteImage(dir / "truth/normal" / (ViewName(i) + ".png"), spec, normal.data());
}

Json Intrinsics(const Camera& camera) {
  Json json = {{"camera_model", "PINHOLE"}, {"fl_x", camera.focal_px},   {"fl_y", camera.focal_px},
               {"cx", 0.5 * camera.width},  {"cy", 0.5 * camera.height}, {"w", camera.width},
               {"h", camera.height}};
  if (!camera.distortion.fisheye) json["camera_angle_x"] = 2 * std::atan(0.5 * camera.width / camera.focal_px);
  if (!camera.distortion.fisheye && camera.distortion.k == std::array<double, 4>{}) return json;
  json["camera_model"] = camera.distortion.fisheye ? "OPENCV_FISHEYE" : "OPENCV";
  const std::array<const char*, 4> names = camera.distortion.fisheye
                                               ? std::array<const char*, 4>{"k1", "k2", "k3", "k4"}
                                               : std::array<const char*, 4>{"k1", "k2", "p1", "p2"};
  for (size_t i = 0; i < names.size(); ++i) json[names[i]] = camera.distortion.k[i];
  return json;
}

// instant-ngp's layout; what a frame has of its own stands with it; `prefix` leads from the file to the capture's
// directory.
Json Transforms(const Options& options, const std::vector<Camera>& cameras, const std::string& prefix) {
  const Json shared = Intrinsics(cameras.front());
  Json frames = Json::array();
  for (size_t i = 0; i < cameras.size(); ++i) {
    Eigen::Matrix4d matrix = cameras[i].world_from_camera.matrix();
    matrix.middleCols<2>(1) *= -1;  // OpenCV axes (y down, z forward) → OpenGL axes (y up, z backward)
    Json rows = Json::array();
    for (int row = 0; row < 4; ++row) {
      rows.push_back({matrix(row, 0), matrix(row, 1), matrix(row, 2), matrix(row, 3)});
    }
    Json frame = {{"file_path", prefix + PhotoPath(options, static_cast<int>(i))}, {"transform_matrix", rows}};
    const Json intrinsics = Intrinsics(cameras[i]);
    if (intrinsics != shared) frame.update(intrinsics);
    frames.push_back(std::move(frame));
  }
  Json transforms = shared;
  transforms["frames"] = frames;
  return transforms;
}

Json Truth(const Options& options, const World& world) {
  static constexpr const char* kShapes[] = {"sphere", "box", "torus"};
  Json objects = Json::array(), views = Json::array();
  for (const Object& object : world.objects) {
    const Vec3d centre = object.world_from_object.translation();
    objects.push_back({{"shape", kShapes[static_cast<int>(object.shape)]},
                       {"size", {object.size.x(), object.size.y(), object.size.z()}},
                       {"centre", {centre.x(), centre.y(), centre.z()}},
                       {"reflectance", object.material.reflectance}});
  }
  for (int i = 0; i < options.n_views; ++i) {
    const Vec3d gain = Gain(options, i);
    views.push_back({{"photo", "../" + PhotoPath(options, i)},
                     {"gain", {gain.x(), gain.y(), gain.z()}},
                     {"depth", "depth/" + ViewName(i) + ".png"},
                     {"normal", "normal/" + ViewName(i) + ".png"}});
  }
  return {{"schema_version", 1},
          {"scene", options.finish == Finish::kGlossy ? "glossy" : "diffuse"},
          {"seed", options.seed},
          {"depth_unit", kDepthUnit},
          {"depth", "distance along the ray through the pixel's centre = value x depth_unit"},
          {"normal", "(n + 1) / 2 x 65535, world axes, z up"},
          {"gain", "of linear radiance: exposure and white balance"},
          {"objects", objects},
          {"views", views}};
}

// A directory that holds something else than an earlier capture of this program is left alone.
void RequireReplaceable(const fs::path& out) {
  if (!fs::exists(out) || (fs::is_directory(out) && fs::is_empty(out))) return;
  if (fs::exists(out / "truth/truth.json")) return;
  throw InputError(fmt::format("--out {} holds files that are not an example capture; name a new or empty directory",
                               EscapePath(out)));
}

void MakeCapture(const Options& options) {
  RequireReplaceable(options.out);
  const World world = MakeStillLife(options.finish, options.seed);
  std::vector<Camera> cameras = MakeOrbit(options.n_views, options.seed);
  for (int i = 0; i < options.n_views; ++i) SetUp(options, i, cameras[static_cast<size_t>(i)]);
  fs::path partial = options.out;
  partial += ".partial";
  fs::remove_all(partial);
  for (const char* folder : {"truth/depth", "truth/normal"}) fs::create_directories(partial / folder);
  fs::create_directories((partial / PhotoPath(options, 0)).parent_path());
  if (options.passers_by) fs::create_directories((partial / MaskPath(options, 0)).parent_path());

  Progress progress("ray tracing", options.n_views, "views");
  std::atomic<int> next_view = 0, n_done = 0;
  std::mutex mutex;  // of the two below
  std::exception_ptr failure;
  const auto work = [&] {
    for (int i = next_view++; i < options.n_views; i = next_view++) {
      try {
        WriteView(options, world, cameras[static_cast<size_t>(i)], i, partial);
      } catch (...) {
        const std::lock_guard lock(mutex);
        failure = std::current_exception();
        return;
      }
      const std::lock_guard lock(mutex);
      progress.Update(++n_done);
    }
  };
  std::vector<std::thread> threads;
  threads.reserve(size_t(options.n_threads));
  for (int i = 0; i < options.n_threads; ++i) threads.emplace_back(work);
  for (std::thread& thread : threads) thread.join();
  if (failure) std::rethrow_exception(failure);
  progress.Done();

  WriteJson(partial / "truth/truth.json", Truth(options, world));
  WriteJson(partial / "truth/transforms.json", Transforms(options, cameras, "../"));
  if (options.posed) WriteJson(partial / "transforms.json", Transforms(options, cameras, ""));
  ReplaceDirectory(partial, options.out);
}

}  // namespace
}  // namespace nrff

int main(int argc, char** argv) {
  nrff::Options options;
  CLI::App app{"Makes the example capture: photos of a ray-traced scene, with the truth beside them."};
  app.add_option("--out", options.out, "Directory to make (an earlier capture in it is replaced)")->required();
  app.add_option("--views", options.n_views, "Number of photos")->check(CLI::Range(1, 1000))->capture_default_str();
  app.add_option("--width", options.width, "Photo's width, px")->check(CLI::Range(8, 8192))->capture_default_str();
  app.add_option("--height", options.height, "Photo's height, px")->check(CLI::Range(8, 8192))->capture_default_str();
  app.add_option("--samples", options.samples, "Rays a pixel (a square number)")
      ->check(CLI::IsMember({1, 4, 9, 16, 25}))
      ->capture_default_str();
  app.add_option("--seed", options.seed, "Of everything random")->capture_default_str();
  app.add_flag("--posed", options.posed, "Write transforms.json and images/ in place of photos/");
  app.add_option("--exposure-drift", options.exposure_drift_ev,
                 "Range of exposures in EV (in EXIF, too, but with --posed); white balance drifts by a third")
      ->check(CLI::Range(0., 6.))
      ->capture_default_str();
  app.add_flag("--passers-by", options.passers_by, "Something else covers part of each photo, and masks say where");
  app.add_option("--lens", options.lens,
                 "Of all photos: pinhole (default), brown (moustache and tangential),\nwide (17 mm, barrel) or fisheye "
                 "(160°)")
      ->transform(CLI::Transformer(std::map<std::string, nrff::LensKind>{{"pinhole", nrff::LensKind::kPinhole},
                                                                         {"brown", nrff::LensKind::kBrown},
                                                                         {"wide", nrff::LensKind::kWide},
                                                                         {"fisheye", nrff::LensKind::kFisheye}}));
  app.add_flag("--second-camera", options.second_camera, "Every other photo is of another size and 28 mm");
  app.add_flag("--turned", options.turned, "Photos held upright, to the left and to the right, said by EXIF");
  app.add_option("--zoom", options.zoom, "Focal lengths from 28 to 50 mm, this many")->check(CLI::Range(1, 1000));
  app.add_flag("--focal-jitter", options.focal_jitter, "EXIF's focal lengths are off by up to 1 mm");
  app.add_flag("--no-focal", options.no_focal, "EXIF says nothing of focal lengths");
  app.add_option("--scene", options.finish, "diffuse: colours do not depend on the view; glossy (default)")
      ->transform(CLI::Transformer(
          std::map<std::string, nrff::Finish>{{"diffuse", nrff::Finish::kDiffuse}, {"glossy", nrff::Finish::kGlossy}}));
  app.add_option("--threads", options.n_threads, "Processor threads")->check(CLI::Range(1, 256))->capture_default_str();
  nrff::AddVerbosity(app);
  app.footer("Example: make_capture --out example && nrff run example/photos");
  return nrff::StageMain(app, argc, argv, [&] { nrff::MakeCapture(options); });
}
