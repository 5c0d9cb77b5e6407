#include "pipeline/progress.h"

#include <unistd.h>

#include <cmath>
#include <cstdio>
#include <cstdlib>

#include "pipeline/json.h"
#include "pipeline/log.h"

namespace nrff {
namespace {

using Seconds = std::chrono::duration<double>;

// The driver's pipe, or -1 when the stage was started by hand.
int ProgressDescriptor() {
  static const int descriptor = [] {
    const char* text = std::getenv("NRFF_PROGRESS_FD");
    return text != nullptr ? std::atoi(text) : -1;
  }();
  return descriptor;
}

void WriteAll(int descriptor, const std::string& line) {
  // Lines are shorter than PIPE_BUF, so that one write is all or nothing; a reader that is gone is no reason to stop.
  [[maybe_unused]] const ssize_t written = write(descriptor, line.data(), line.size());
}

}  // namespace

Progress::Progress(std::string what, double total, std::string unit)
    : what_(std::move(what)), unit_(std::move(unit)), total_(total), start_(std::chrono::steady_clock::now()) {}

Progress::~Progress() {
  if (!finished_ && last_write_.time_since_epoch().count() != 0 && ProgressDescriptor() < 0 && isatty(STDERR_FILENO)) {
    std::fputc('\n', stderr);
  }
}

void Progress::Update(double done, const std::string& text) {
  const double elapsed = Seconds(std::chrono::steady_clock::now() - start_).count();
  UpdateWithTimeLeft(done, total_ > 0 && done > 0 ? elapsed * (total_ - done) / done : -1, text);
}

void Progress::UpdateWithTimeLeft(double done, double seconds_left, const std::string& text) {
  const bool often = ProgressDescriptor() >= 0 || isatty(STDERR_FILENO);
  const auto now = std::chrono::steady_clock::now();
  if (Seconds(now - last_write_).count() < (often ? 0.1 : 10.0)) return;
  last_write_ = now;
  Write(done, seconds_left, text, false);
}

void Progress::Done(const std::string& text) {
  if (finished_) return;
  finished_ = true;
  Write(total_, 0, text, true);
}

void Progress::Write(double done, double seconds_left, const std::string& text, bool last) {
  if (const int descriptor = ProgressDescriptor(); descriptor >= 0) {
    Json line = {{"what", what_}, {"done", done}, {"total", total_}, {"unit", unit_}, {"text", text}};
    line["seconds_left"] = std::isfinite(seconds_left) && seconds_left >= 0 ? Json(seconds_left) : Json();
    WriteAll(descriptor, line.dump(-1, ' ', false, Json::error_handler_t::replace) + "\n");
    return;
  }
  if (GetVerbosity() == Verbosity::kQuiet) return;
  const bool terminal = isatty(STDERR_FILENO) != 0;
  std::string line = what_;
  if (total_ > 0) {
    char count[96];
    std::snprintf(count, sizeof count, " %.0f/%.0f %s", done, total_, unit_.c_str());
    line += count;
  }
  if (!last && seconds_left >= 0) line += ", " + FormatSeconds(seconds_left) + " left";
  if (!text.empty()) line += ", " + text;
  std::fprintf(stderr, terminal ? "\r\033[K%s%s" : "%s%s", line.c_str(), !terminal || last ? "\n" : "");
  std::fflush(stderr);
}

std::optional<ProgressUpdate> ParseProgress(std::string_view line) {
  const Json json = Json::parse(line, nullptr, /*allow_exceptions=*/false);
  if (!json.is_object()) return {};
  const auto text = [&](const char* key) {
    const auto found = json.find(key);
    return found != json.end() && found->is_string() ? found->get<std::string>() : std::string();
  };
  const auto number = [&](const char* key) -> std::optional<double> {
    const auto found = json.find(key);
    if (found == json.end() || !found->is_number()) return {};
    return found->get<double>();
  };
  ProgressUpdate update;
  update.what = text("what");
  update.unit = text("unit");
  update.text = text("text");
  update.done = number("done").value_or(0);
  update.total = number("total").value_or(0);
  update.seconds_left = number("seconds_left");
  return update;
}

std::string FormatSeconds(double seconds) {
  char text[64];
  const long whole = std::lround(std::fmax(seconds, 0));
  if (seconds < 10) {
    std::snprintf(text, sizeof text, "%.1f s", std::fmax(seconds, 0));
  } else if (whole < 60) {
    std::snprintf(text, sizeof text, "%ld s", whole);
  } else if (whole < 3600) {
    std::snprintf(text, sizeof text, "%ld min %02ld s", whole / 60, whole % 60);
  } else {
    std::snprintf(text, sizeof text, "%ld h %02ld min", whole / 3600, whole % 3600 / 60);
  }
  return text;
}

std::string FormatBytes(double bytes) {
  static constexpr const char* kUnits[] = {"B", "KiB", "MiB", "GiB", "TiB"};
  int unit = 0;
  while (bytes >= 1024 && unit < 4) {
    bytes /= 1024;
    ++unit;
  }
  char text[64];
  std::snprintf(text, sizeof text, unit == 0 ? "%.0f %s" : "%.1f %s", bytes, kUnits[unit]);
  return text;
}

}  // namespace nrff
