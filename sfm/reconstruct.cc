#include "sfm/reconstruct.h"

#include <algorithm>
#include <charconv>
#include <chrono>
#include <cmath>
#include <fstream>
#include <map>
#include <optional>
#include <set>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/progress.h"
#include "sfm/first_look.h"
#include "sfm/gps.h"
#include "sfm/image_pairs.h"
#include "sfm/lens_model.h"
#include "sfm/sensor_frame.h"
#include "sfm/source.h"
#include "sfm/working_photos.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;
using Clock = std::chrono::steady_clock;

// COLMAP allows 4 px, meant for photos of 3200 px: on smaller copies that lets wrong matches bend the cameras.
constexpr char kInlier_px[] = "2";

// Median number of a photo's features below which fainter ones are taken, too, down to this contrast (COLMAP's usual is
// 0.0067): photos of a smooth cup (800×600 px) have 776 instead of 335, and 60 of 77 instead of 17 register, at half
// the cost of searching them doubled in size, by which 61 do (tests/bench/results/first_look.md); textured ones have
// 1400.
constexpr int kFewFeatures = 500;
constexpr double kFaint = 0.004;

double SecondsSince(Clock::time_point start) { return std::chrono::duration<double>(Clock::now() - start).count(); }

// The number that follows `marker` in a line COLMAP printed.
std::optional<int> NumberAfter(std::string_view line, std::string_view marker) {
  const size_t at = line.find(marker);
  if (at == std::string_view::npos) return {};
  int number = 0;
  const char* begin = line.data() + at + marker.size();
  const auto [end, error] = std::from_chars(begin, line.data() + line.size(), number);
  if (error != std::errc()) return {};
  return number;
}

std::optional<int> FirstOf(std::string_view line, std::initializer_list<std::string_view> markers) {
  for (const std::string_view marker : markers) {
    if (const auto number = NumberAfter(line, marker)) return number;
  }
  return {};
}

std::string Number(double value) { return Json(value).dump(); }

class Reconstruction {
 public:
  Reconstruction(const Capture& capture, const SfmSettings& settings, Colmap& colmap, fs::path dir,
                 const ArtifactWriter& artifact, const EarlierMapping* earlier)
      : capture_(capture),
        settings_(settings),
        colmap_(colmap),
        dir_(std::move(dir)),
        artifact_(artifact),
        earlier_(earlier) {}

  Attempt Run() {
    Attempt attempt;
    fs::create_directories(dir_);
    WriteWorkingPhotos(capture_, settings_.max_image_size, settings_.n_threads, photos_);
    artifact_.SaveSeconds();
    if (earlier_ != nullptr) TakeOverDatabase();
    ExtractEnoughFeatures(attempt);
    artifact_.SaveSeconds();
    const ImagePairs pairs = ChoosePairs();
    MatchPairs(pairs, attempt);
    artifact_.SaveSeconds();
    if (earlier_ != nullptr) {
      attempt.grown = Grow(attempt);
      artifact_.SaveSeconds();
    }
    if (!attempt.grown || attempt.grown->images.size() < capture_.images.size() || !earlier_->holds(*attempt.grown)) {
      attempt.models = Map("models", attempt);
      artifact_.SaveSeconds();
      JoinPieces(pairs, attempt);
    }
    attempt.settings = settings_;
    attempt.database_file = database_;
    return attempt;
  }

  Attempt RunWithLenses(const Attempt& before, const std::string& name) {
    std::map<uint32_t, ColmapCamera> cameras;
    for (const auto& [group, lens] : settings_.lenses) {
      if (const auto id = CameraOf(before.database, group)) cameras[*id] = AtWorkingSize(lens);
    }
    ChangeCopy(before, name, [&](const fs::path& database) { SetLenses(database, cameras); });
    Attempt attempt;
    MatchPairs(MatchedPairs(before.database), attempt);
    artifact_.SaveSeconds();
    return MapAgain(name, std::move(attempt));
  }

  Attempt RunWithOwnCameras(const Attempt& before, const std::string& name,
                            const std::map<uint32_t, ColmapCamera>& by_image) {
    ChangeCopy(before, name, [&](const fs::path& database) { SetOwnCameras(database, by_image); });
    Attempt attempt;
    attempt.database = ReadColmapDatabase(database_);
    return MapAgain(name, std::move(attempt));
  }

 private:
  void ChangeCopy(const Attempt& before, const std::string& name,
                  const std::function<void(const fs::path& database)>& change) {
    database_ = dir_ / (name + ".db");
    if (!fs::exists(database_)) {
      const fs::path partial = dir_ / (name + ".partial.db");
      fs::copy_file(before.database_file, partial, fs::copy_options::overwrite_existing);
      change(partial);
      fs::rename(partial, database_);
    }
  }

  Attempt MapAgain(const std::string& name, Attempt attempt) {
    attempt.models = Map(name, attempt);
    artifact_.SaveSeconds();
    attempt.settings = settings_;
    attempt.database_file = database_;
    return attempt;
  }

  Colmap::Options Common() const {
    return {{"random_seed", std::to_string(settings_.seed)}, {"database_path", database_.native()}};
  }
  std::string Threads() const { return std::to_string(settings_.n_threads); }

  void TakeOverDatabase() {
    if (fs::exists(database_)) return;
    fs::path copy = database_;
    copy += ".partial";
    fs::copy_file(earlier_->database, copy, fs::copy_options::overwrite_existing);
    fs::rename(copy, database_);
  }

  // Photos of a camera group that still have no features.
  std::map<int, std::vector<const CaptureImage*>> PendingGroups(const ColmapDatabase& database) const {
    std::set<std::string> extracted;
    for (const auto& [id, image] : database.images) {
      if (image.n_keypoints >= 0) extracted.insert(image.name);
    }
    std::map<int, std::vector<const CaptureImage*>> groups;
    for (const CaptureImage& photo : capture_.images) {
      if (!extracted.count(WorkingPhotoName(photo))) groups[photo.camera].push_back(&photo);
    }
    return groups;
  }

  // Photos of smooth things: fainter features are taken, too.
  void ExtractEnoughFeatures(Attempt& attempt) {
    ExtractFeatures(attempt);
    if (earlier_ != nullptr || settings_.peak_threshold > 0 || MedianFeatures() >= kFewFeatures) return;
    settings_.peak_threshold = kFaint;
    database_ = dir_ / "faint.db";
    ExtractFeatures(attempt);
  }

  int MedianFeatures() const {
    std::vector<int> n_features;
    for (const auto& [id, image] : ReadColmapDatabase(database_).images) n_features.push_back(image.n_keypoints);
    if (n_features.empty()) return 0;
    const auto middle = n_features.begin() + std::ptrdiff_t(n_features.size() / 2);
    std::nth_element(n_features.begin(), middle, n_features.end());
    return *middle;
  }

  // One camera for each group. The focal length that the photos give is where COLMAP starts from.
  void ExtractFeatures(Attempt& attempt) {
    const auto start = Clock::now();
    const ColmapDatabase database = ReadColmapDatabase(database_);
    const auto groups = PendingGroups(database);
    Progress progress("features", double(capture_.images.size()), "photos");
    size_t n_done = capture_.images.size();
    for (const auto& [camera, photos] : groups) n_done -= photos.size();
    for (const auto& [camera, photos] : groups) {
      std::string list;
      for (const CaptureImage* photo : photos) list += WorkingPhotoName(*photo) + "\n";
      const fs::path list_file = dir_ / "photos.txt";
      WriteFileAtomically(list_file, list);
      Colmap::Options options = Common();
      options.insert(options.end(), {{"image_path", photos_.native()},
                                     {"image_list_path", list_file.native()},
                                     {"ImageReader.single_camera", "1"},
                                     {"ImageReader.camera_model", CameraModelName(ModelOf(camera))},
                                     {"SiftExtraction.use_gpu", "0"},
                                     {"SiftExtraction.num_threads", Threads()},
                                     {"SiftExtraction.max_num_features", std::to_string(settings_.max_features)},
                                     {"SiftExtraction.first_octave", std::to_string(settings_.first_octave)}});
      if (std::any_of(photos.begin(), photos.end(), [](const auto* photo) { return photo->info.channels == 4; }))
        options.emplace_back("ImageReader.mask_path", MasksOfWorkingPhotos(photos_).native());
      if (settings_.peak_threshold > 0)
        options.emplace_back("SiftExtraction.peak_threshold", Number(settings_.peak_threshold));
      if (const auto id = CameraOf(database, camera)) {
        options.emplace_back("ImageReader.existing_camera_id", std::to_string(*id));
      } else if (const std::string params = CameraParams(*photos.front()); !params.empty()) {
        options.emplace_back("ImageReader.camera_params", params);
      }
      colmap_.RunOrThrow("feature_extractor", options, 600 + 60 * double(photos.size()), [&](std::string_view line) {
        if (const auto n = FirstOf(line, {"Processed file [", "Processed image ["}))
          progress.Update(double(n_done) + *n);
      });
      n_done += photos.size();
    }
    progress.Done();
    attempt.seconds_features += SecondsSince(start);
  }

  static std::optional<uint32_t> CameraOf(const ColmapDatabase& database, int group) {
    const std::string folder = std::to_string(group) + "/";
    for (const auto& [id, image] : database.images) {
      if (image.name.starts_with(folder)) return image.camera_id;
    }
    return {};
  }

  ColmapCamera AtWorkingSize(const ColmapCamera& lens) const {
    const auto [width, height] = WorkingSize(lens.width, lens.height, settings_.max_image_size);
    return ScaledCamera(lens, width, height);
  }

  CameraModel ModelOf(int group) const {
    const auto known = settings_.lenses.find(group);
    return known == settings_.lenses.end() ? settings_.camera_model : known->second.model;
  }

  // Of the photo's camera at the working size; empty where nothing is known.
  std::string CameraParams(const CaptureImage& photo) const {
    const ImageInfo& info = photo.info;
    const auto [sensor_width, sensor_height] = SensorSize(info);
    const auto [width, height] = WorkingSize(sensor_width, sensor_height, settings_.max_image_size);
    std::vector<double> params;
    if (const auto known = settings_.lenses.find(photo.camera); known != settings_.lenses.end()) {
      params = ScaledCamera(known->second, width, height).params;
    } else if (info.focal_px) {
      const CameraModel model = settings_.camera_model;
      const double focal = *info.focal_px * std::max(width, height) / std::max(info.width, info.height);
      params.assign(lens_model::HasOneFocalLength(model) ? 1 : 2, focal);
      params.insert(params.end(), {width / 2.0, height / 2.0});
      params.resize(size_t(CameraModelParamCount(model)), 0.0);
    }
    std::string text;
    for (const double param : params) text.append(text.empty() ? "" : ",").append(Number(param));
    return text;
  }

  // In batches, so that progress shows and an interruption costs little.
  void MatchPairs(const ImagePairs& pairs, Attempt& attempt) {
    const auto start = Clock::now();
    const ColmapDatabase before = ReadColmapDatabase(database_);
    const std::vector<uint32_t> ids = ImageIds(before);
    attempt.n_pairs = pairs.size();
    std::vector<std::string> pending;
    for (const auto& [a, b] : pairs) {
      if (before.verified_matches.count(std::minmax({ids[size_t(a)], ids[size_t(b)]}))) continue;
      pending.emplace_back(WorkingPhotoName(capture_.images[size_t(a)]))
          .append(" ")
          .append(WorkingPhotoName(capture_.images[size_t(b)]))
          .append("\n");
    }
    const size_t batch = std::clamp<size_t>(pairs.size() / 20, 20, 400);
    Progress progress("matching", double(pairs.size()), "pairs");
    for (size_t done = 0; done < pending.size();) {
      const size_t n = std::min(batch, pending.size() - done);
      std::string list;
      for (size_t i = done; i < done + n; ++i) list += pending[i];
      const fs::path list_file = dir_ / "pairs.txt";
      WriteFileAtomically(list_file, list);
      Colmap::Options options = Common();
      options.insert(options.end(), {{"match_list_path", list_file.native()},
                                     {"match_type", "pairs"},
                                     {"SiftMatching.use_gpu", "0"},
                                     {"SiftMatching.max_error", kInlier_px},
                                     {"SiftMatching.num_threads", Threads()}});
      colmap_.RunOrThrow("matches_importer", options, 600 + 60 * double(n));
      done += n;
      progress.Update(double(pairs.size() - pending.size() + done));
    }
    progress.Done();
    attempt.database = ReadColmapDatabase(database_);
    attempt.seconds_matching += SecondsSince(start);
  }

  // COLMAP's, of the capture's photos.
  std::vector<uint32_t> ImageIds(const ColmapDatabase& database) const {
    if (database.images.size() != capture_.images.size()) {
      throw ExternalToolError("colmap feature_extractor took " + std::to_string(database.images.size()) + " of " +
                              std::to_string(capture_.images.size()) + " photos; its log is " +
                              EscapePath(artifact_.dir() / "colmap.log"));
    }
    std::map<std::string, uint32_t> by_name;
    for (const auto& [id, image] : database.images) by_name[image.name] = id;
    std::vector<uint32_t> ids;
    ids.reserve(capture_.images.size());
    for (const CaptureImage& photo : capture_.images) ids.push_back(by_name.at(WorkingPhotoName(photo)));
    return ids;
  }

  ImagePairs MatchedPairs(const ColmapDatabase& database) const {
    const std::vector<uint32_t> ids = ImageIds(database);
    std::map<uint32_t, int> index_of;
    for (size_t i = 0; i < ids.size(); ++i) index_of[ids[i]] = int(i);
    ImagePairs pairs;
    for (const auto& [pair, n] : database.verified_matches)
      pairs.emplace_back(std::minmax(index_of.at(pair.first), index_of.at(pair.second)));
    std::sort(pairs.begin(), pairs.end());
    return pairs;
  }

  ImagePairs ChoosePairs() {
    ImagePairs pairs = ChooseAmongAll();
    if (earlier_ == nullptr) return pairs;
    std::erase_if(pairs, [&](const ImagePair& pair) { return IsEarlier(pair.first) && IsEarlier(pair.second); });
    return pairs;
  }

  bool IsEarlier(int i) const { return earlier_->photos.contains(WorkingPhotoName(capture_.images[size_t(i)])); }

  ImagePairs ChooseAmongAll() {
    const std::vector<uint32_t> ids = ImageIds(ReadColmapDatabase(database_));
    const int n_images = int(ids.size());
    if (settings_.exhaustive) return AllPairs(n_images);
    similarity_ = PhotoSimilarities(ids.size(), [&](size_t i) { return ReadFeatureDescriptors(database_, ids[i]); });
    ImagePairs pairs = MostSimilarPairs(similarity_, settings_.n_neighbours);
    if (capture_.ordered) pairs = Union(pairs, NextPairs());
    if (settings_.n_nearest > 0) {
      const Eigen::MatrixXf nearness = Nearness(LocalPositions(GpsPositions(capture_)));
      pairs = Union(pairs, MostSimilarPairs(nearness, settings_.n_nearest));
    }
    return pairs;
  }

  // In the order of taking, which is not that of the ids where photos were added.
  ImagePairs NextPairs() const {
    std::vector<fs::path> paths;
    for (const CaptureImage& photo : capture_.images) paths.push_back(photo.path);
    const std::vector<size_t> order = OrderByPath(paths);
    ImagePairs pairs;
    for (const auto& [a, b] : SequentialPairs(int(order.size()), settings_.n_next)) {
      const auto [first, second] = std::minmax(order[size_t(a)], order[size_t(b)]);
      pairs.emplace_back(int(first), int(second));
    }
    std::sort(pairs.begin(), pairs.end());
    return pairs;
  }

  void JoinPieces(const ImagePairs& matched, Attempt& attempt) {
    const ColmapModel* largest = LargestModel(attempt.models);
    if (settings_.exhaustive || !largest) return;
    std::set<std::string> placed;
    for (const auto& [id, image] : largest->images) placed.insert(image.name);
    std::vector<bool> in_largest;
    for (const CaptureImage& photo : capture_.images) in_largest.push_back(placed.contains(WorkingPhotoName(photo)));
    const ImagePairs bridges = Difference(BridgingPairs(similarity_, in_largest, settings_.n_neighbours), matched);
    if (bridges.empty()) return;
    MatchPairs(Union(matched, bridges), attempt);
    artifact_.SaveSeconds();
    const std::vector<uint32_t> ids = ImageIds(attempt.database);
    const bool any_holds = std::any_of(bridges.begin(), bridges.end(), [&](const ImagePair& pair) {
      const auto matches =
          attempt.database.verified_matches.find(std::minmax({ids[size_t(pair.first)], ids[size_t(pair.second)]}));
      return matches != attempt.database.verified_matches.end() &&
             matches->second > 0;  // none of photos without features
    });
    if (!any_holds) return;
    std::vector<ColmapModel> joined = Map("joined", attempt);
    if (const ColmapModel* now = LargestModel(joined); now && now->images.size() > largest->images.size())
      attempt.models = std::move(joined);
    artifact_.SaveSeconds();
  }

  // Nothing where COLMAP does not bring the model back.
  std::optional<ColmapModel> Grow(Attempt& attempt) {
    const auto start = Clock::now();
    const fs::path folder = dir_ / "grown", finished = dir_ / "grown.finished";
    if (!fs::exists(finished)) {
      fs::remove_all(folder);
      fs::create_directories(folder);
      RunMapper(folder, earlier_->model);
      WriteFileAtomically(finished, "");
    }
    attempt.seconds_mapping += SecondsSince(start);
    // Of a model that it was given, COLMAP writes what it became into the folder itself.
    if (!fs::exists(folder / "images.bin")) return {};
    return ReadColmapModel(folder);
  }

  std::vector<ColmapModel> Map(const std::string& name, Attempt& attempt) {
    const auto start = Clock::now();
    const fs::path folder = dir_ / name, finished = dir_ / (name + ".finished");
    if (!fs::exists(finished)) {
      fs::remove_all(folder);
      fs::create_directories(folder);
      RunMapper(folder);
      WriteFileAtomically(finished, "");
    }
    std::vector<ColmapModel> models;
    for (const auto& entry : fs::directory_iterator(folder)) {
      if (entry.is_directory() && fs::exists(entry.path() / "images.bin"))
        models.push_back(ReadColmapModel(entry.path()));
    }
    attempt.seconds_mapping += SecondsSince(start);
    return models;
  }

  // `grown`: the model to start from; empty: none.
  void RunMapper(const fs::path& models, const fs::path& grown = {}) {
    Colmap::Options options = Common();
    if (!grown.empty()) options.emplace_back("input_path", grown.native());
    options.insert(options.end(), {{"image_path", photos_.native()},
                                   {"output_path", models.native()},
                                   {"Mapper.num_threads", Threads()},
                                   {"Mapper.init_max_error", kInlier_px},
                                   {"Mapper.filter_max_reproj_error", kInlier_px},
                                   {"Mapper.tri_complete_max_reproj_error", kInlier_px},
                                   {"Mapper.tri_merge_max_reproj_error", kInlier_px},
                                   {"Mapper.min_model_size", "3"}});
    if (settings_.tolerant_mapping) {
      options.insert(options.end(), {{"Mapper.init_min_tri_angle", "8"},
                                     {"Mapper.init_min_num_inliers", "50"},
                                     {"Mapper.abs_pose_min_num_inliers", "20"}});
    }
    // COLMAP takes coefficients beyond 1 for a failure, and photos with these out.
    double largest = 1;
    for (const auto& [group, lens] : settings_.lenses) {
      for (size_t i = size_t(lens_model::FirstDistortion(lens.model)); i < lens.params.size(); ++i)
        largest = std::max(largest, 2 * std::abs(lens.params[i]));
    }
    if (largest > 1) options.emplace_back("Mapper.max_extra_param", Number(largest));
    Progress progress("mapping", double(capture_.images.size()), "photos");
    bool no_model = false;
    const double limit_seconds = 1800 + 120 * double(capture_.images.size());
    const ProcessResult result = colmap_.Run("mapper", options, limit_seconds, [&](std::string_view line) {
      no_model |= line.find("failed to create") != std::string_view::npos;
      // "Registering image #12 (5)", "… (num_reg_frames=5)": the fifth
      if (line.find("Registering image #") != std::string_view::npos) {
        if (const auto n = FirstOf(line.substr(std::min(line.find('('), line.size())), {"(", "="})) progress.Update(*n);
      }
    });
    if (!result.Succeeded() && !(result.end == ProcessResult::End::kExited && no_model)) colmap_.Fail("mapper", result);
    progress.Done();
  }

  const Capture& capture_;
  SfmSettings settings_;
  Colmap& colmap_;
  const fs::path dir_;
  const ArtifactWriter& artifact_;
  const EarlierMapping* earlier_;  // may be null
  fs::path database_ = dir_ / "database.db";
  const fs::path photos_ = dir_ / "photos";
  Eigen::MatrixXf similarity_;  // of the photos; with chosen pairs alone
};

}  // namespace

Attempt Reconstruct(const Capture& capture, const SfmSettings& settings, Colmap& colmap, const fs::path& dir,
                    const ArtifactWriter& artifact, const EarlierMapping* earlier) {
  return Reconstruction(capture, settings, colmap, dir, artifact, earlier).Run();
}

Attempt ReconstructWithLenses(const Capture& capture, const Attempt& before, const std::string& name, Colmap& colmap,
                              const fs::path& dir, const ArtifactWriter& artifact) {
  return Reconstruction(capture, before.settings, colmap, dir, artifact, nullptr).RunWithLenses(before, name);
}

Attempt ReconstructWithOwnCameras(const Capture& capture, const Attempt& before,
                                  const std::map<uint32_t, ColmapCamera>& by_image, const std::string& name,
                                  Colmap& colmap, const ArtifactWriter& artifact) {
  return Reconstruction(capture, before.settings, colmap, before.database_file.parent_path(), artifact, nullptr)
      .RunWithOwnCameras(before, name, by_image);
}

}  // namespace nrff
