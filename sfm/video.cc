#include "sfm/video.h"

#include <algorithm>
#include <cstdio>
#include <utility>

#include "pipeline/files.h"
#include "pipeline/log.h"
#include "pipeline/progress.h"
#include "sfm/frame_choice.h"
#include "sfm/video_stream.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr int kMeasuredSide_px = 640;  // of the pictures that frames are measured on
constexpr int kThumbnailSide_px = 160;
constexpr size_t kMostThumbnails = 48;

// A name for files that is nobody else's.
std::string UniqueStem(const fs::path& video, std::vector<std::string>& taken) {
  std::string stem;
  for (const char c : video.stem().string()) {
    const bool plain =
        (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || (c >= '0' && c <= '9') || c == '-' || c == '_';
    stem += plain ? c : '_';
  }
  if (stem.size() > 40) stem.resize(40);
  std::string unique = stem;
  for (int n = 2; std::find(taken.begin(), taken.end(), unique) != taken.end(); ++n) {
    unique = stem + "-" + std::to_string(n);
  }
  taken.push_back(unique);
  return unique;
}

std::vector<FrameMeasure> MeasureFrames(const fs::path& video, const VideoFacts& facts, const std::string& name,
                                        const fs::path& dir, std::string& complaint) {
  Progress progress("looking at " + name, facts.seconds * facts.frames_per_second, "frames");
  std::vector<FrameMeasure> frames;
  GreyPicture before;
  complaint = StreamFrames(video, kMeasuredSide_px, dir, [&](const GreyPicture& picture) {
    const double motion = frames.empty() ? 0 : MeasureMotion(before, picture);
    frames.push_back({MeasureSharpness(picture), motion});
    before = picture;
    progress.Update(double(frames.size()));
  });
  progress.Done();
  return frames;
}

// Evenly over the video, kept or not.
std::vector<int> ThumbnailFrames(const std::vector<FrameVerdict>& verdicts) {
  std::vector<int> chosen;
  const size_t n = std::min(kMostThumbnails, verdicts.size());
  for (size_t k = 0; k < n; ++k) chosen.push_back(int(k * verdicts.size() / n));
  // Every other one is a frame that was kept, where there are so many.
  std::vector<int> kept;
  for (size_t i = 0; i < verdicts.size(); ++i) {
    if (verdicts[i] == FrameVerdict::kKept) kept.push_back(int(i));
  }
  for (size_t k = 0; k < std::min(n / 2, kept.size()); ++k) {
    chosen[2 * k] = kept[k * kept.size() / std::min(n / 2, kept.size())];
  }
  std::sort(chosen.begin(), chosen.end());
  chosen.erase(std::unique(chosen.begin(), chosen.end()), chosen.end());
  return chosen;
}

}  // namespace

ExtractedVideo ExtractFrames(const fs::path& video, const std::string& name, int n_wanted, const fs::path& dir,
                             std::vector<std::string>& taken) {
  const VideoFacts facts = ProbeVideo(video);
  std::string complaint;
  const std::vector<FrameMeasure> frames = MeasureFrames(video, facts, name, dir, complaint);
  const std::vector<FrameVerdict> verdicts = ChooseFrames(frames, n_wanted);
  const std::string stem = UniqueStem(video, taken);
  const auto file_of = [&](const char* folder, int frame) {
    char number[16];
    std::snprintf(number, sizeof number, "_%06d.jpg", frame);
    return fs::path(folder) / stem / (stem + number);
  };

  ExtractedVideo extracted;
  FrameFiles kept, thumbnails;
  Json verdict_names = Json::array(), sharpness = Json::array(), motion = Json::array(), shown = Json::array();
  for (size_t i = 0; i < frames.size(); ++i) {
    verdict_names.push_back(kFrameVerdicts[size_t(verdicts[i])]);
    sharpness.push_back(frames[i].sharpness);
    motion.push_back(frames[i].motion);
    if (verdicts[i] != FrameVerdict::kKept) continue;
    extracted.frames.push_back(file_of(kFramesDir, int(i)));
    kept.frames.push_back(int(i));
    kept.names.push_back(dir / extracted.frames.back());
  }
  thumbnails.longer_side = kThumbnailSide_px;
  thumbnails.frames = ThumbnailFrames(verdicts);
  for (const int frame : thumbnails.frames) {
    const fs::path file = file_of(kThumbnailsDir, frame);
    thumbnails.names.push_back(dir / file);
    shown.push_back({{"frame", frame}, {"file", file.string()}});
  }
  WriteFrames(video, facts, {kept, thumbnails}, dir);
  extracted.record = {{"name", name},
                      {"seconds", facts.seconds},
                      {"frames_per_second", facts.frames_per_second},
                      {"complaint", complaint},
                      {"sharpness", std::move(sharpness)},
                      {"motion", std::move(motion)},
                      {"verdict", std::move(verdict_names)},
                      {"thumbnails", std::move(shown)}};
  if (!complaint.empty()) LogWarning(name + " is damaged (" + complaint + "); what can be decoded of it is used");
  LogInfo(name + ": " + std::to_string(kept.frames.size()) + " of " + std::to_string(frames.size()) +
          " frames are kept as photos");
  return extracted;
}

}  // namespace nrff
