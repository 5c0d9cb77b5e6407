// The data sets that papers of this field report on: how their scenes are recognised, how they are evaluated, and what
// was published. One of them, `captures`, is none: any captures, of which nothing was published.
#pragma once

#include <filesystem>
#include <optional>
#include <string>
#include <vector>

namespace nrff {

struct PublishedResult {
  std::string method;
  double psnr = 0;  // dB, mean over the data set's scenes
  std::optional<double> ssim, lpips;
  std::string training;  // time and device, as published
  std::string source;
};

struct DataSet {
  std::string name;                 // on the command line
  std::string title;                // in tables
  std::vector<std::string> scenes;  // that the published means are over; folders are called so, whatever their case
  std::string layout;               // what a scene's folder holds
  bool (*is_scene)(const std::filesystem::path&) = nullptr;
  int width = 0, height = 0;  // px, of the published figures; 0: none
  std::string split;          // which images are held out
  std::string background;     // white, none
  std::vector<PublishedResult> published;
};

const std::vector<DataSet>& DataSets();

// The folders in `dir` that hold a scene, by name; `dir` itself where it is one. Throws InputError where there is none.
std::vector<std::filesystem::path> FindScenes(const DataSet& data_set, const std::filesystem::path& dir);

// The published scene of that name; empty where it is none of them.
std::string PublishedScene(const DataSet& data_set, const std::string& name);

}  // namespace nrff
