#include "pipeline/data_sets.h"

#include <algorithm>
#include <cctype>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/photo_name.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr char kPaper[] = "Han & Xiang, CVPR 2023";
constexpr char kTensoRf[] = "Chen et al., ECCV 2022";
constexpr char kNerfBaselines[] = "nerfbaselines";

std::string Lower(std::string text) {
  std::transform(text.begin(), text.end(), text.begin(), [](unsigned char c) { return char(std::tolower(c)); });
  return text;
}

bool IsFileIn(const fs::path& dir, const char* name) {
  std::error_code error;
  return fs::is_regular_file(dir / name, error);
}

bool IsFolderIn(const fs::path& dir, const char* name) {
  std::error_code error;
  return fs::is_directory(dir / name, error);
}

bool IsNsvfScene(const fs::path& dir) { return IsFileIn(dir, "intrinsics.txt") && IsFolderIn(dir, "pose"); }
bool IsSyntheticScene(const fs::path& dir) { return IsFileIn(dir, "transforms_train.json"); }
bool IsLlffScene(const fs::path& dir) { return IsFolderIn(dir, "sparse") && IsFolderIn(dir, "images"); }

// Photos, or poses beside them.
bool IsCapture(const fs::path& dir) {
  if (IsNsvfScene(dir) || IsSyntheticScene(dir) || IsLlffScene(dir) || IsFileIn(dir, "transforms.json")) return true;
  for (const fs::path& folder : {dir, dir / "images", dir / "photos"}) {
    std::error_code error;
    for (const fs::directory_entry& entry : fs::directory_iterator(folder, error)) {
      if (HasPhotoExtension(entry.path()) && entry.is_regular_file(error)) return true;
    }
  }
  return false;
}

constexpr char kNsvfLayout[] = "intrinsics.txt, pose/ and rgb/";

}  // namespace

const std::vector<DataSet>& DataSets() {
  static const std::vector<DataSet> data_sets = {
      {"tanks-and-temples",
       "Tanks & Temples (NSVF)",
       {"Barn", "Caterpillar", "Family", "Ignatius", "Truck"},
       kNsvfLayout,
       IsNsvfScene,
       1920,
       1080,
       "names that begin with 2_, or with 1_ where there are none",
       "white",
       {{"NRFF, 60K steps", 29.05, 0.931, 0.119, "", kPaper},
        {"NRFF, 30K steps", 28.87, {}, {}, "", kPaper},
        {"ngp_pl", 28.78, {}, {}, "", "its README"},
        {"TensoRF", 28.56, {}, {}, "", kTensoRf},
        {"NSVF", 28.48, {}, {}, "", "Liu et al., NeurIPS 2020"},
        {"DVGO", 28.41, {}, {}, "", "Sun et al., CVPR 2022"}}},
      {"nerf-synthetic",
       "NeRF-synthetic (Blender)",
       {"chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship"},
       "transforms_train.json and transforms_test.json",
       IsSyntheticScene,
       800,
       800,
       "transforms_test.json",
       "white",
       {{"NRFF, 60K steps", 35.02, 0.977, 0.031, "3.39 h, V100", kPaper},
        {"NRFF, 30K steps", 34.65, {}, 0.034, "1.7 h, V100", kPaper},
        {"RayGaussX", 34.64, {}, {}, "697 s, RTX 5090", "its README"},
        {"Zip-NeRF", 33.67, {}, {}, "5 h 22 min", kNerfBaselines},
        {"3DGS-MCMC", 33.64, {}, {}, "9 min 8 s", kNerfBaselines},
        {"3DGS", 33.31, {}, {}, "6 min 6 s", kNerfBaselines},
        {"TensoRF", 33.17, {}, {}, "10 min 47 s", kNerfBaselines},
        {"instant-ngp", 32.20, {}, {}, "2 min 23 s", kNerfBaselines}}},
      {"nsvf-synthetic",
       "NSVF-synthetic",
       {"Bike", "Lifestyle", "Palace", "Robot", "Spaceship", "Steamtrain", "Toad", "Wineholder"},
       kNsvfLayout,
       IsNsvfScene,
       800,
       800,
       "names that begin with 2_",
       "white",
       {{"RayGaussX", 38.85, {}, {}, "", "its README"},
        {"NRFF, 60K steps", 38.25, {}, {}, "", kPaper},
        {"TensoRF", 36.52, {}, {}, "", kTensoRf}}},
      {"llff",
       "LLFF (forward-facing)",
       {"fern", "flower", "fortress", "horns", "leaves", "orchids", "room", "trex"},
       "a COLMAP model in sparse/ and images/",
       IsLlffScene,
       1008,
       756,
       "the first of every eight by file name",
       "none",
       {{"TensoRF", 26.73, {}, {}, "", kTensoRf}}},
      {"captures",
       "Captures of one's own",
       {},
       "photos (it or its images/ or photos/), or a posed capture",
       IsCapture,
       0,
       0,
       "",
       "",
       {}},
  };
  return data_sets;
}

std::vector<fs::path> FindScenes(const DataSet& data_set, const fs::path& dir) {
  std::error_code error;
  if (!fs::is_directory(dir, error)) {
    throw InputError(EscapePath(dir) + " is no folder; give the one that holds the scenes of " + data_set.name);
  }
  if (data_set.is_scene(dir)) return {dir};
  std::vector<fs::path> scenes;
  size_t n_others = 0;
  for (const fs::directory_entry& entry : fs::directory_iterator(dir, error)) {
    if (!entry.is_directory(error)) continue;
    if (data_set.is_scene(entry.path())) {
      scenes.push_back(entry.path());
    } else {
      ++n_others;
    }
  }
  if (scenes.empty()) {
    throw InputError(EscapePath(dir) + " holds no scene of " + data_set.name + ": " +
                     (n_others == 0 ? "there is no folder in it that has "
                                    : "none of its " + std::to_string(n_others) + " folders has ") +
                     data_set.layout);
  }
  std::sort(scenes.begin(), scenes.end());
  return scenes;
}

std::string PublishedScene(const DataSet& data_set, const std::string& name) {
  for (const std::string& scene : data_set.scenes) {
    if (Lower(scene) == Lower(name)) return scene;
  }
  return {};
}

}  // namespace nrff
