#include "sfm/colmap_source.h"

#include <algorithm>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/photo_name.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

bool HoldsModel(const fs::path& dir) {
  return (IsFile(dir / "cameras.bin") && IsFile(dir / "images.bin")) ||
         (IsFile(dir / "cameras.txt") && IsFile(dir / "images.txt"));
}

// Model folders, relative to `root`, of the first place that has any.
std::vector<fs::path> FindModels(const fs::path& root) {
  for (const fs::path place : {"sparse", "colmap/sparse", "."}) {
    std::vector<fs::path> models;
    std::error_code error;
    for (const fs::directory_entry& entry : fs::directory_iterator(root / place, error)) {
      if (place != "." && HoldsModel(entry.path())) models.push_back(place / entry.path().filename());
    }
    if (HoldsModel(root / place)) models.push_back(place);
    std::sort(models.begin(), models.end());
    if (!models.empty()) return models;
  }
  return {};
}

// The folder, relative to `root`, in which the model's photos are; nothing where none of them is found.
std::optional<fs::path> FindPhotoFolder(const fs::path& root, const ColmapModel& model) {
  for (const fs::path folder : {"images", "input", ".", "images_2", "images_4", "images_8"}) {
    for (const auto& [id, image] : model.images) {
      if (IsFile(root / folder / image.name)) return folder;
    }
  }
  return {};
}

}  // namespace

std::optional<Source> ReadColmapSource(const fs::path& root) {
  const std::vector<fs::path> dirs = FindModels(root);
  if (dirs.empty()) return {};
  ColmapModel model;
  fs::path model_dir;
  for (const fs::path& dir : dirs) {
    ColmapModel candidate = ReadColmapModel(root / dir);
    if (model_dir.empty() || candidate.images.size() > model.images.size()) {
      model = std::move(candidate);
      model_dir = dir;
    }
  }
  const std::string name = EscapePath(root / model_dir);
  if (model.images.empty())
    throw InputError(name + ": the COLMAP model holds no images; give the model of a successful reconstruction");
  const auto folder = FindPhotoFolder(root, model);
  if (!folder) {
    throw InputError(name + ": the COLMAP model names " + std::to_string(model.images.size()) +
                     " photos (the first: " + EscapePath(model.images.begin()->second.name) +
                     "), none of which is in " + EscapePath(root) + "/images or beside it; put the photos there");
  }

  Source source;
  source.kind = "colmap";
  source.root = root;
  source.poses_ignore_orientation = true;
  source.evidence =
      "COLMAP model " + EscapePath(model_dir) + " with " + std::to_string(model.images.size()) + " images";
  if (dirs.size() > 1) source.evidence += ", the largest of " + std::to_string(dirs.size());
  std::set<fs::path> posed;
  for (auto& [id, image] : model.images) {
    const fs::path path = (*folder / image.name).lexically_normal();
    image.name = path.native();
    if (!IsFile(root / path)) {
      source.rejected.push_back({EscapePath(path), "is in the COLMAP model but does not exist"});
    } else {
      posed.insert(path);
      source.images.push_back({path, {}});
    }
  }
  for (const fs::path& file : ListFiles(root / *folder)) {
    const fs::path path = file.lexically_proximate(root).lexically_normal();
    if (HasPhotoExtension(path) && !posed.contains(path)) {
      source.rejected.push_back({EscapePath(path), "is not registered in the COLMAP model"});
    }
  }
  source.model = std::move(model);
  return source;
}

}  // namespace nrff
