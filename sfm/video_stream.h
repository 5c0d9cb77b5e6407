// A video as FFmpeg decodes it.
#pragma once

#include <filesystem>
#include <functional>
#include <string>
#include <vector>

#include "sfm/video_measures.h"

namespace nrff {

struct VideoFacts {
  double seconds = 0, frames_per_second = 0;  // as the file says; 0 where it does not
  // FFmpeg's name of the matrix that its colours were made with: "auto" where the file says, else what players take:
  // BT.709 from 720 lines on.
  std::string matrix = "auto";
};

// Throws InputError when the file is no video that can be decoded, ExternalToolError when FFmpeg is not installed.
VideoFacts ProbeVideo(const std::filesystem::path& video);

// Calls on_frame for every frame, turned as the file's rotation says, as a grey picture whose longer side is at most
// `longer_side` px, one after the other. Memory for one picture; `dir`: for a named pipe. Returns what FFmpeg
// complained about, empty where it did not. Throws InputError when there is no frame, ExternalToolError as ProbeVideo.
std::string StreamFrames(const std::filesystem::path& video, int longer_side, const std::filesystem::path& dir,
                         const std::function<void(const GreyPicture&)>& on_frame);

// Writes the frames of these numbers (ascending, from 0, as StreamFrames counts them) as JPEG files: names[i] is the
// file of frames[i]. longer_side 0: in full size.
struct FrameFiles {
  std::vector<int> frames;
  std::vector<std::filesystem::path> names;
  int longer_side = 0;  // px
};
// All in one decoding. `dir`: for files while they are written. Throws InputError when the video no longer has these
// frames.
void WriteFrames(const std::filesystem::path& video, const VideoFacts& facts, const std::vector<FrameFiles>& wanted,
                 const std::filesystem::path& dir);

}  // namespace nrff
