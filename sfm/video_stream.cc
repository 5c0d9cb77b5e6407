#include "sfm/video_stream.h"

#include <fcntl.h>
#include <poll.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <charconv>
#include <chrono>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <future>
#include <string>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/json.h"
#include "pipeline/process.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr double kStallLimit_seconds = 120;
constexpr int kMostSide_px = 4096;  // of the pictures that are streamed

// So that no name is taken for an option or a protocol.
std::string Input(const fs::path& video) { return "file:" + fs::absolute(video).string(); }

ProcessResult RunTool(std::vector<std::string> command, std::function<void(std::string_view)> on_line = {},
                      const std::atomic<bool>* cancel = nullptr) {
  ProcessOptions options;
  options.command = std::move(command);
  options.on_line = std::move(on_line);
  options.stall_limit_seconds = kStallLimit_seconds;
  options.cancel = cancel;
  try {
    return RunProcess(options);
  } catch (const Error& error) {
    throw ExternalToolError(std::string(error.what()) +
                            "; videos need FFmpeg: install it with `apt-get install ffmpeg`, or save frames as photos");
  }
}

std::string LastLine(const ProcessResult& result) {
  return result.last_lines.empty() ? DescribeEnd(result) : EscapePath(result.last_lines.back());
}

double Number(const Json& json, const char* key) {
  const auto found = json.find(key);
  if (found == json.end() || !found->is_string()) return 0;
  // "30000/1001" or "12.5"
  const std::string text = *found;
  double value = 0, below = 1;
  const char* end = text.data() + text.size();
  const auto [at, error] = std::from_chars(text.data(), end, value);
  if (error != std::errc()) return 0;
  if (at != end && *at == '/') std::from_chars(at + 1, end, below);
  return below > 0 && value >= 0 && value < 1e9 ? value / below : 0;
}

// The reading end of a named pipe, from before its writer starts to after it has ended.
class Pipe {
 public:
  explicit Pipe(fs::path path) : path_(std::move(path)) {
    if (mkfifo(path_.c_str(), 0600) != 0) throw Failure();
    fd_ = open(path_.c_str(), O_RDONLY | O_NONBLOCK | O_CLOEXEC);
    if (fd_ < 0) throw Failure();
  }
  ~Pipe() {
    if (fd_ >= 0) close(fd_);
    std::error_code ignored;
    fs::remove(path_, ignored);
  }
  Pipe(const Pipe&) = delete;
  Pipe& operator=(const Pipe&) = delete;

  // Bytes read; 0 when none came within a moment, or nobody writes.
  size_t Read(char* to, size_t n) const {
    pollfd ready{fd_, POLLIN, 0};
    poll(&ready, 1, 20);
    const ssize_t got = read(fd_, to, n);
    if (got < 0 && errno != EAGAIN && errno != EINTR) throw Failure();
    if (got == 0) usleep(2000);  // a pipe without a writer is always ready
    return got > 0 ? size_t(got) : 0;
  }

 private:
  Error Failure() const {
    return ResourceError("cannot use the pipe " + EscapePath(path_) + ": " + std::strerror(errno));
  }
  fs::path path_;
  int fd_ = -1;
};

// Pictures out of a stream in yuv4mpeg of one plane: a line of parameters, then for each picture a line and its pixels.
class PictureReader {
 public:
  explicit PictureReader(const std::function<void(const GreyPicture&)>& on_frame) : on_frame_(on_frame) {}

  void Take(const char* bytes, size_t n) {
    buffer_.append(bytes, n);
    size_t at = 0;
    while (true) {
      if (picture_.width > 0 && in_picture_) {
        if (buffer_.size() - at < picture_.pixels.size()) break;
        std::memcpy(picture_.pixels.data(), buffer_.data() + at, picture_.pixels.size());
        at += picture_.pixels.size();
        in_picture_ = false;
        on_frame_(picture_);
        continue;
      }
      const size_t end = buffer_.find('\n', at);
      if (end == std::string::npos) break;
      if (picture_.width == 0) {
        ReadHeader(buffer_.substr(at, end - at));
      } else {
        in_picture_ = true;
      }
      at = end + 1;
    }
    buffer_.erase(0, at);
  }

 private:
  void ReadHeader(const std::string& line) {
    int width = 0, height = 0;
    for (size_t at = line.find(' '); at != std::string::npos; at = line.find(' ', at + 1)) {
      const char* number = line.data() + at + 2;
      if (at + 2 > line.size()) break;
      if (line[at + 1] == 'W') std::from_chars(number, line.data() + line.size(), width);
      if (line[at + 1] == 'H') std::from_chars(number, line.data() + line.size(), height);
    }
    if (width < 1 || height < 1 || width > kMostSide_px || height > kMostSide_px) {
      throw ExternalToolError("ffmpeg sent pictures of a size that cannot be: " + EscapePath(line));
    }
    picture_ = {width, height, std::vector<uint8_t>(size_t(width) * size_t(height))};
  }

  const std::function<void(const GreyPicture&)>& on_frame_;
  std::string buffer_;
  GreyPicture picture_;
  bool in_picture_ = false;
};

std::string Scale(int longer_side) {
  const std::string side = std::to_string(longer_side);
  return "scale=w='if(gte(iw,ih),min(iw," + side + "),-2)':h='if(gte(iw,ih),-2,min(ih," + side + "))':flags=area";
}

// In the user's words where FFmpeg's say little.
template <typename Probe>
std::string WhyNoVideo(const fs::path& video, const Probe& probe) {
  if (fs::is_regular_file(video) && fs::file_size(video) == 0) return "the file is empty";
  std::string reason = "it has no stream of pictures";
  bool cut = false;
  probe("error", [&](std::string_view line) {
    cut |= line.find("moov atom not found") != std::string_view::npos;  // the index, written last
    if (line.empty() || std::string_view("{}[] ").find(line.front()) != std::string_view::npos) return;
    const size_t colon = line.rfind(": ");
    reason = EscapePath(std::string(line.substr(colon == std::string_view::npos ? 0 : colon + 2)));
  });
  char start[8] = {};
  std::ifstream(video, std::ios::binary).read(start, sizeof start);
  const bool is_movie = std::string_view(start + 4, 4) == "ftyp";  // MP4, MOV
  return cut && is_movie ? "its index is missing: the recording or a copy was cut short" : reason;
}

}  // namespace

VideoFacts ProbeVideo(const fs::path& video) {
  const auto probe = [&](const char* verbosity, const std::function<void(std::string_view)>& on_line) {
    return RunTool(
        {"ffprobe", "-v", verbosity, "-select_streams", "V:0", "-show_entries",
         "stream=avg_frame_rate,codec_type,width,height,color_space:format=duration", "-of", "json", Input(video)},
        on_line);
  };
  std::string output;
  const ProcessResult result =
      probe("quiet", [&](std::string_view line) { output.append(line).append("\n"); });  // complaints are no JSON
  const Json json = Json::parse(output, nullptr, /*allow_exceptions=*/false);
  const bool has_video = json.is_object() && json.contains("streams") && json["streams"].is_array() &&
                         !json["streams"].empty() && json["streams"][0].is_object();
  if (!result.Succeeded() || !has_video) {
    throw InputError(EscapePath(video) + ": holds no video that can be decoded (" + WhyNoVideo(video, probe) +
                     "); copy it again, or save frames of it as photos");
  }
  VideoFacts facts;
  const Json& stream = json["streams"][0];
  facts.frames_per_second = Number(stream, "avg_frame_rate");
  const auto size = [&](const char* key) {
    return stream.contains(key) && stream[key].is_number() ? int(stream[key]) : 0;
  };
  const bool tagged = stream.contains("color_space") && stream["color_space"] != "unknown";
  if (!tagged && std::min(size("width"), size("height")) >= 720) facts.matrix = "bt709";
  if (json.contains("format") && json["format"].is_object()) facts.seconds = Number(json["format"], "duration");
  return facts;
}

std::string StreamFrames(const fs::path& video, int longer_side, const fs::path& dir,
                         const std::function<void(const GreyPicture&)>& on_frame) {
  const fs::path path = dir / "video.pipe";
  const Pipe pipe(path);
  std::atomic<bool> cancel = false;
  std::future<ProcessResult> ffmpeg = std::async(std::launch::async, [&] {
    return RunTool(
        {"ffmpeg", "-nostdin", "-v", "error", "-y", "-i", Input(video), "-map", "0:V:0", "-vf",
         Scale(longer_side) + ",format=gray", "-vsync", "passthrough", "-f", "yuv4mpegpipe", "file:" + path.string()},
        {}, &cancel);
  });
  // Destroyed before `ffmpeg`, which waits for the program: nobody reads any more when an exception leaves here.
  const struct Cancel {
    std::atomic<bool>& flag;
    ~Cancel() { flag = true; }
  } cancel_at_end{cancel};
  int n_frames = 0;
  const std::function<void(const GreyPicture&)> count = [&](const GreyPicture& picture) {
    ++n_frames;
    on_frame(picture);
  };
  PictureReader reader(count);
  std::vector<char> bytes(1 << 18);
  while (true) {
    const bool ended = ffmpeg.wait_for(std::chrono::seconds(0)) == std::future_status::ready;
    const size_t n = pipe.Read(bytes.data(), bytes.size());
    if (n > 0) reader.Take(bytes.data(), n);
    if (n == 0 && ended) break;
  }
  const ProcessResult result = ffmpeg.get();
  if (result.end != ProcessResult::End::kExited) {
    throw ExternalToolError("ffmpeg " + DescribeEnd(result) + " while it decoded " + EscapePath(video) +
                            "; run it again, with more memory if it was killed");
  }
  if (n_frames == 0) {
    throw InputError(EscapePath(video) + ": no frame of it can be decoded (" + LastLine(result) +
                     "); copy it again, or save frames of it as photos");
  }
  return result.last_lines.empty() && result.Succeeded() ? std::string() : LastLine(result);
}

void WriteFrames(const fs::path& video, const VideoFacts& facts, const std::vector<FrameFiles>& wanted,
                 const fs::path& dir) {
  std::vector<std::string> command = {"ffmpeg", "-nostdin", "-v", "error", "-y", "-i", Input(video)};
  std::vector<fs::path> folders;
  for (const FrameFiles& files : wanted) {
    if (files.frames.empty()) continue;
    std::string filter;
    for (const int frame : files.frames) {
      filter += (filter.empty() ? "select=" : "+") + std::string("eq(n\\,") + std::to_string(frame) + ")";
    }
    // As JPEG files are read: BT.601, all values; with square pixels.
    filter += ',';
    filter += files.longer_side > 0 ? Scale(files.longer_side) : "scale=w='iw*sar':h=ih";
    filter += ":in_color_matrix=" + facts.matrix + ":out_color_matrix=bt601:out_range=full,setsar=1,format=yuvj444p";
    folders.push_back(dir / ("frames." + std::to_string(folders.size())));
    fs::create_directories(folders.back());
    std::string folder = folders.back().string();
    for (size_t at = 0; (at = folder.find('%', at)) != std::string::npos; at += 2) folder.insert(at, 1, '%');
    // A quality of 2 is the best that FFmpeg's JPEG has but for 1, which takes half as much again.
    command.insert(command.end(), {"-map", "0:V:0", "-vf", filter, "-vsync", "passthrough", "-q:v", "2", "-f", "image2",
                                   "file:" + folder + "/%06d.jpg"});
  }
  if (folders.empty()) return;
  const struct Remove {
    const std::vector<fs::path>& folders;
    ~Remove() {
      std::error_code ignored;
      for (const fs::path& folder : folders) fs::remove_all(folder, ignored);
    }
  } remove_at_end{folders};
  const ProcessResult result = RunTool(command);
  size_t folder = 0;
  for (const FrameFiles& files : wanted) {
    if (files.frames.empty()) continue;
    for (size_t i = 0; i < files.frames.size(); ++i) {
      char name[32];
      std::snprintf(name, sizeof name, "%06zu.jpg", i + 1);
      if (!fs::exists(folders[folder] / name)) {
        if (!result.Succeeded()) {
          throw ResourceError("ffmpeg could not write the frames of " + EscapePath(video) + " to " + EscapePath(dir) +
                              " (" + LastLine(result) + "); check the disk's space and permissions");
        }
        throw InputError(EscapePath(video) + ": frame " + std::to_string(files.frames[i]) +
                         " can no longer be decoded (" + LastLine(result) + "); copy the video again");
      }
      fs::create_directories(files.names[i].parent_path());
      fs::rename(folders[folder] / name, files.names[i]);
    }
    ++folder;
  }
}

}  // namespace nrff
