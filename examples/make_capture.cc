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
constexpr double kFullFrameDiagonalMm = 43.2666;
constexpr double kCropFactor = 5.5;        // of a small sensor
constexpr double kDepthUnit = 1.0 / 2048;  // scene units per step of the 16-bit depth

struct Options {
  fs::path out;
  int n_views = 24, width = 640, height = 480, samples = 4;
  uint32_t seed = 1;
  bool posed = false;
  Finish finish = Finish::kGlossy;
  double exposure_drift_ev = 0;
  bool passers_by = false;
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

OIIO::ImageSpec PhotoSpec(const Options& options, int i) {
  OIIO::ImageSpec spec(options.width, options.height, 3, OIIO::TypeDesc::UINT8);
  spec.attribute("oiio:ColorSpace", "sRGB");
  if (options.posed) return spec;
  const std::string time = fmt::format("2024:06:21 19:{:02d}:{:02d}", 30 + i * 4 / 60, i * 4 % 60);
  spec.attribute("Compression", "jpeg:92");
  spec.attribute("Orientation", 1);
  spec.attribute("Make", "NRFF");
  spec.attribute("Model", "Example Camera");
  spec.attribute("DateTime", time);
  spec.attribute("Exif:DateTimeOriginal", time);
  spec.attribute("Exif:FocalLength", static_cast<float>(kFocal35mm / kCropFactor));
  spec.attribute("Exif:FocalLengthIn35mmFilm", kFocal35mm);
  spec.attribute("ExposureTime", static_cast<float>(std::exp2(ExposureEv(options, i)) / 250));
  spec.attribute("FNumber", 5.6f);
  spec.attribute("Exif:ISOSpeedRatings", 100);
  return spec;
}

// A striped ellipse over a seventh of the picture, at another place and in other colours in each; its mask is black
// there.
void AddPasserBy(const Options& options, int i, Picture& picture, std::vector<uint8_t>& mask) {
  const auto random = [&](int k) { return UnitFromHash(Hash(i, k, 17, options.seed)); };
  const double cx = (0.2 + 0.6 * random(0)) * options.width, cy = (0.3 + 0.4 * random(1)) * options.height;
  const double rx = 0.15 * options.width, ry = 0.3 * options.height, angle = std::numbers::pi * random(2);
  const double stripe = 0.03 * options.height * (1 + random(3));
  mask.assign(static_cast<size_t>(options.width) * options.height, 255);
  for (int y = 0; y < options.height; ++y) {
    for (int x = 0; x < options.width; ++x) {
      const double dx = x + 0.5 - cx, dy = y + 0.5 - cy;
      if (dx * dx / (rx * rx) + dy * dy / (ry * ry) > 1) continue;
      const size_t pixel = static_cast<size_t>(y) * options.width + x;
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
  if (options.passers_by) {
    std::vector<uint8_t> mask;
    AddPasserBy(options, i, picture, mask);
    WriteImage(dir / MaskPath(options, i), OIIO::ImageSpec(options.width, options.height, 1, OIIO::TypeDesc::UINT8),
               mask.data());
  }
  WriteImage(dir / PhotoPath(options, i), PhotoSpec(options, i), picture.rgb.data());

  std::vector<uint16_t> depth(picture.distance.size()), normal(picture.normal.size());
  for (size_t p = 0; p < depth.size(); ++p) {
    depth[p] = static_cast<uint16_t>(std::lround(picture.distance[p] / kDepthUnit));
  }
  for (size_t p = 0; p < normal.size(); ++p) {
    normal[p] = static_cast<uint16_t>(std::lround((picture.normal[p] + 1) / 2 * 65535));
  }
  OIIO::ImageSpec spec(options.width, options.height, 1, OIIO::TypeDesc::UINT16);
  spec.attribute("png:compressionLevel", 3);
  WriteImage(dir / "truth/depth" / (ViewName(i) + ".png"), spec, depth.data());
  spec.nchannels = 3;
  spec.default_channel_names();
  WriteImage(dir / "truth/normal" / (ViewName(i) + ".png"), spec, normal.data());
}

// instant-ngp's layout; `prefix` leads from the file to the capture's directory.
Json Transforms(const Options& options, const std::vector<Camera>& cameras, const std::string& prefix) {
  Json frames = Json::array();
  for (size_t i = 0; i < cameras.size(); ++i) {
    Eigen::Matrix4d matrix = cameras[i].world_from_camera.matrix();
    matrix.middleCols<2>(1) *= -1;  // OpenCV axes (y down, z forward) → OpenGL axes (y up, z backward)
    Json rows = Json::array();
    for (int row = 0; row < 4; ++row) {
      rows.push_back({matrix(row, 0), matrix(row, 1), matrix(row, 2), matrix(row, 3)});
    }
    frames.push_back({{"file_path", prefix + PhotoPath(options, static_cast<int>(i))}, {"transform_matrix", rows}});
  }
  const double focal = cameras.front().focal_px;
  return {{"camera_model", "PINHOLE"},
          {"camera_angle_x", 2 * std::atan(0.5 * options.width / focal)},
          {"fl_x", focal},
          {"fl_y", focal},
          {"cx", 0.5 * options.width},
          {"cy", 0.5 * options.height},
          {"w", options.width},
          {"h", options.height},
          {"frames", frames}};
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
  const double diagonal_px = std::hypot(options.width, options.height);
  std::vector<Camera> cameras = MakeOrbit(options.n_views, options.width, options.height,
                                          kFocal35mm / kFullFrameDiagonalMm * diagonal_px, options.seed);
  for (int i = 0; i < options.n_views; ++i) cameras[static_cast<size_t>(i)].gain = Gain(options, i);
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
  app.add_option("--scene", options.finish, "diffuse: colours do not depend on the view; glossy (default)")
      ->transform(CLI::Transformer(
          std::map<std::string, nrff::Finish>{{"diffuse", nrff::Finish::kDiffuse}, {"glossy", nrff::Finish::kGlossy}}));
  app.add_option("--threads", options.n_threads, "Processor threads")->check(CLI::Range(1, 256))->capture_default_str();
  nrff::AddVerbosity(app);
  app.footer("Example: make_capture --out example && nrff run example/photos");
  return nrff::StageMain(app, argc, argv, [&] { nrff::MakeCapture(options); });
}
