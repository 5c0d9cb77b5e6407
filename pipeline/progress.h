// Progress of long work, with the time left.
//
// A stage started by the driver writes one JSON line per update to the file descriptor named by NRFF_PROGRESS_FD:
//   {"what":"training","done":120,"total":3000,"unit":"steps","seconds_left":41.2,"text":"loss 0.0123"}
// A stage started by hand draws a bar on a terminal and writes a plain line every ten seconds elsewhere (stderr).
#pragma once

#include <chrono>
#include <optional>
#include <string>
#include <string_view>

namespace nrff {

class Progress {
 public:
  // `total` ≤ 0: unknown.
  Progress(std::string what, double total, std::string unit);
  ~Progress();
  Progress(const Progress&) = delete;
  Progress& operator=(const Progress&) = delete;

  // Cheap enough to be called every step: writes at most ten times a second.
  void Update(double done, const std::string& text = {});
  // As Update, where the work itself knows the time left better than a straight line does.
  void UpdateWithTimeLeft(double done, double seconds_left, const std::string& text = {});
  void Done(const std::string& text = {});

 private:
  void Write(double done, double seconds_left, const std::string& text, bool last);
  std::string what_;
  std::string unit_;
  double total_;
  std::chrono::steady_clock::time_point start_, last_write_;
  bool finished_ = false;
};

// One line of NRFF_PROGRESS_FD.
struct ProgressUpdate {
  std::string what, unit, text;
  double done = 0;
  double total = 0;                    // ≤ 0: unknown
  std::optional<double> seconds_left;  // nothing: unknown
};

// Nothing for a line that is not of the protocol: progress is no reason to stop a job.
std::optional<ProgressUpdate> ParseProgress(std::string_view line);

// "1 h 02 min", "3 min 05 s", "12 s"
std::string FormatSeconds(double seconds);
// "1.2 GiB"
std::string FormatBytes(double bytes);

}  // namespace nrff
