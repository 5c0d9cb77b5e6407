#include "sfm/capture.h"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <numeric>
#include <utility>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/json.h"

namespace nrff {
namespace {

Split SplitNamed(const std::string& name, const std::string& where) {
  if (name == "train") return Split::kTrain;
  if (name == "test") return Split::kTest;
  throw CorruptError(where + ": \"split\" is \"" + name + "\"; expected train or test; run ingest again");
}

constexpr const char* kMasksNames[] = {"ignore", "background"};  // in the order of Masks

Masks MasksNamed(const std::string& name, const std::string& where) {
  for (size_t i = 0; i < std::size(kMasksNames); ++i) {
    if (name == kMasksNames[i]) return Masks(i);
  }
  throw CorruptError(where + ": \"masks\" is \"" + name + "\"; expected ignore or background; run ingest again");
}

template <typename T>
Json OrNull(const std::optional<T>& value) {
  return value ? Json(*value) : Json(nullptr);
}

// value[key], nothing where it is null.
template <typename T>
std::optional<T> GetOptional(const Json& value, const char* key, const std::string& where) {
  if (Get<Json>(value, key, where).is_null()) return {};
  return Get<T>(value, key, where);
}

Json GpsToJson(const GpsPosition& gps) {
  return {{"lat", gps.latitude_deg}, {"lon", gps.longitude_deg}, {"alt", OrNull(gps.altitude_m)}};
}

GpsPosition GpsFromJson(const Json& json, const std::string& where) {
  const GpsPosition gps{Get<double>(json, "lat", where), Get<double>(json, "lon", where),
                        GetOptional<double>(json, "alt", where)};
  if (std::abs(gps.latitude_deg) <= 90 && std::abs(gps.longitude_deg) <= 180) return gps;
  throw CorruptError(where + ": \"gps\" is at " + Json(gps.latitude_deg).dump() + "°, " +
                     Json(gps.longitude_deg).dump() + "°, which is no place on earth; run ingest again");
}

Json ToJson(const CaptureImage& image) {
  const ImageInfo& info = image.info;
  return {{"id", image.id},
          {"path", EscapePath(image.path)},
          {"extracted", image.extracted},
          {"name", image.Name()},
          {"split", image.split == Split::kTest ? "test" : "train"},
          {"width", info.width},
          {"height", info.height},
          {"orientation", info.orientation},
          {"channels", info.channels},
          {"bit_depth", info.bit_depth},
          {"hash", image.hash},
          {"mask", image.mask.empty() ? Json() : Json(EscapePath(image.mask))},
          {"mask_hash", image.mask_hash},
          {"camera", image.camera},
          {"focal_px", OrNull(info.focal_px)},
          {"make", info.make},
          {"model", info.model},
          {"timestamp", OrNull(info.timestamp)},
          {"exposure_seconds", OrNull(info.exposure_seconds)},
          {"f_number", OrNull(info.f_number)},
          {"iso", OrNull(info.iso)},
          {"gps", info.gps ? GpsToJson(*info.gps) : Json()},
          {"blur", image.blur}};
}

CaptureImage ImageFromJson(const Json& json, const std::string& where) {
  CaptureImage image;
  image.id = Get<std::string>(json, "id", where);
  image.path = UnescapePath(Get<std::string>(json, "path", where));
  image.extracted = Get<bool>(json, "extracted", where);
  image.split = SplitNamed(Get<std::string>(json, "split", where), where);
  image.hash = Get<std::string>(json, "hash", where);
  image.mask = UnescapePath(GetOptional<std::string>(json, "mask", where).value_or(""));
  image.mask_hash = Get<std::string>(json, "mask_hash", where);
  image.camera = Get<int>(json, "camera", where);
  image.blur = Get<double>(json, "blur", where);
  ImageInfo& info = image.info;
  info.width = Get<int>(json, "width", where);
  info.height = Get<int>(json, "height", where);
  info.orientation = Get<int>(json, "orientation", where);
  info.channels = Get<int>(json, "channels", where);
  info.bit_depth = Get<int>(json, "bit_depth", where);
  info.focal_px = GetOptional<double>(json, "focal_px", where);
  info.make = Get<std::string>(json, "make", where);
  info.model = Get<std::string>(json, "model", where);
  info.timestamp = GetOptional<std::string>(json, "timestamp", where);
  info.exposure_seconds = GetOptional<double>(json, "exposure_seconds", where);
  info.f_number = GetOptional<double>(json, "f_number", where);
  info.iso = GetOptional<int>(json, "iso", where);
  if (const auto gps = GetOptional<Json>(json, "gps", where)) info.gps = GpsFromJson(*gps, where);
  const std::string photo = where + ": photo " + EscapePath(image.id);
  if (!IsFileName(image.id)) {
    throw CorruptError(photo + " has an id that is no file name, expected one as 000012; run ingest again");
  }
  if (info.width < 1 || info.height < 1 || info.orientation < 1 || info.orientation > 8 ||
      (info.channels != 3 && info.channels != 4) || (info.bit_depth != 8 && info.bit_depth != 16)) {
    throw CorruptError(photo + " is " + std::to_string(info.width) + "×" + std::to_string(info.height) + " px with " +
                       std::to_string(info.channels) + " channels of " + std::to_string(info.bit_depth) +
                       " bits and orientation " + std::to_string(info.orientation) +
                       ", which no photo is; run ingest again");
  }
  return image;
}

}  // namespace

std::vector<size_t> OrderByPath(const std::vector<std::filesystem::path>& paths) {
  std::vector<size_t> order(paths.size());
  std::iota(order.begin(), order.end(), size_t(0));
  std::stable_sort(order.begin(), order.end(),
                   [&](size_t a, size_t b) { return paths[a].native() < paths[b].native(); });
  return order;
}

const char* MasksName(Masks masks) { return kMasksNames[size_t(masks)]; }

std::string CaptureImage::Name() const { return EscapePath(path.filename()); }

void SaveCapture(const Capture& capture, const std::filesystem::path& dir) {
  Json images = Json::array();
  for (const CaptureImage& image : capture.images) images.push_back(ToJson(image));
  Json rejected = Json::array();
  for (const RejectedFile& file : capture.rejected) rejected.push_back({{"name", file.name}, {"reason", file.reason}});
  WriteJson(dir / kCaptureFile, {{"schema_version", kCaptureSchemaVersion},
                                 {"name", capture.name},
                                 {"kind", capture.kind},
                                 {"root", EscapePath(capture.root)},
                                 {"split_rule", capture.split_rule},
                                 {"posed", capture.posed},
                                 {"ordered", capture.ordered},
                                 {"background", BackgroundName(capture.background)},
                                 {"masks", MasksName(capture.masks)},
                                 {"box", OrNull(capture.box)},
                                 {"images", std::move(images)},
                                 {"rejected", std::move(rejected)},
                                 {"duplicates", capture.duplicates}});
}

Capture LoadCapture(const std::filesystem::path& dir) {
  const std::string where = EscapePath(dir / kCaptureFile);
  const Json json = ReadJson(dir / kCaptureFile);
  CheckSchemaVersion(json, kCaptureSchemaVersion, where);
  Capture capture;
  capture.artifact = dir;
  capture.name = Get<std::string>(json, "name", where);
  capture.kind = Get<std::string>(json, "kind", where);
  capture.root = UnescapePath(Get<std::string>(json, "root", where));
  capture.split_rule = Get<std::string>(json, "split_rule", where);
  capture.posed = Get<bool>(json, "posed", where);
  capture.ordered = Get<bool>(json, "ordered", where);
  capture.background = ParseBackground(json, where);
  capture.masks = MasksNamed(Get<std::string>(json, "masks", where), where);
  capture.box = GetOptional<std::array<double, 6>>(json, "box", where);
  for (const Json& image : Get<std::vector<Json>>(json, "images", where)) {
    capture.images.push_back(ImageFromJson(image, where));
  }
  for (const Json& file : Get<std::vector<Json>>(json, "rejected", where)) {
    capture.rejected.push_back({Get<std::string>(file, "name", where), Get<std::string>(file, "reason", where)});
  }
  capture.duplicates = Get<std::vector<std::vector<std::string>>>(json, "duplicates", where);
  return capture;
}

}  // namespace nrff
