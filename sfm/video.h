// Photos out of a video: its frames are looked at, chosen (frame_choice.h) and written.
#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "pipeline/json.h"

namespace nrff {

inline constexpr char kFramesDir[] = "frames";  // below the ingest artifact: the chosen frames, a folder for each video
inline constexpr char kThumbnailsDir[] = "thumbnails";  // frames, kept and not, for people to see
inline constexpr char kVideosFile[] = "videos.json";
inline constexpr int kVideosSchemaVersion = 1;

struct ExtractedVideo {
  std::vector<std::filesystem::path> frames;  // relative to the artifact, in the video's order
  // For videos.json: {"name", "seconds", "frames_per_second", "complaint", "sharpness": [per frame], "motion": [per
  // frame], "verdict": [per frame, of kFrameVerdicts], "thumbnails": [{"frame", "file"}]}
  Json record;
};

// `name`: escaped, for people and progress; `n_wanted`: ChooseFrames. Writes frames/STEM/STEM_000012.jpg (frame 12) and
// thumbnails below `dir`; `taken`: stems that other videos have, to which this one's is added. Throws InputError naming
// the file when it holds no video that can be decoded, ExternalToolError when FFmpeg is not installed.
ExtractedVideo ExtractFrames(const std::filesystem::path& video, const std::string& name, int n_wanted,
                             const std::filesystem::path& dir, std::vector<std::string>& taken);

}  // namespace nrff
