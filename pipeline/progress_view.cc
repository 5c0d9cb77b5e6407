#include "pipeline/progress_view.h"

#include <fmt/format.h>
#include <sys/ioctl.h>
#include <unistd.h>

#include <algorithm>
#include <cmath>

#include "pipeline/progress.h"

namespace nrff {
namespace {

constexpr auto kRedraw = std::chrono::milliseconds(100);
constexpr auto kPlainLine = std::chrono::seconds(10);
constexpr int kBarColumns = 24;
constexpr int kFallbackColumns = 80;  // a terminal that does not tell its width

double Seconds(std::chrono::steady_clock::duration duration) { return std::chrono::duration<double>(duration).count(); }

// The first `columns` characters, not cutting one of several bytes.
std::string Truncate(const std::string& text, int columns) {
  int n_characters = 0;
  for (size_t i = 0; i < text.size(); ++i) {
    const bool starts_character = (static_cast<unsigned char>(text[i]) & 0xC0) != 0x80;
    if (starts_character && n_characters++ == columns) return text.substr(0, i);
  }
  return text;
}

}  // namespace

int TerminalColumns(int descriptor) {
  if (isatty(descriptor) == 0) return 0;
  winsize size{};
  if (ioctl(descriptor, TIOCGWINSZ, &size) != 0 || size.ws_col == 0) return kFallbackColumns;
  return size.ws_col;
}

std::string ProgressText(const ProgressUpdate& update) {
  std::string text = update.what;
  if (update.total > 0) text += fmt::format(" {:.0f}/{:.0f} {}", update.done, update.total, update.unit);
  if (update.total <= 0 && update.done > 0) text += fmt::format(" {:.0f} {}", update.done, update.unit);
  if (update.seconds_left) text += ", " + FormatSeconds(*update.seconds_left) + " left";
  if (!update.text.empty()) text += ", " + update.text;
  return text;
}

ProgressView::ProgressView(std::ostream& out, std::function<int()> columns, Clock clock)
    : out_(out), columns_(std::move(columns)), clock_(std::move(clock)) {}

ProgressView::~ProgressView() {
  Erase();
  out_.flush();
}

ProgressView::Bar* ProgressView::Find(const std::string& label) {
  const auto found = std::find_if(bars_.begin(), bars_.end(), [&](const Bar& bar) { return bar.label == label; });
  return found == bars_.end() ? nullptr : &*found;
}

void ProgressView::Print(const std::string& line) {
  Erase();
  out_ << line << '\n';
  Draw();
}

void ProgressView::Begin(const std::string& label) {
  bars_.push_back({label, clock_(), clock_(), {}, false});
  Erase();
  Draw();
}

void ProgressView::Update(const std::string& label, const ProgressUpdate& update) {
  Bar* bar = Find(label);
  if (bar == nullptr) return;
  bar->update = update;
  bar->has_update = true;
  const auto now = clock_();
  if (columns_() > 0) {
    if (now - last_draw_ < kRedraw) return;
    Erase();
    Draw();
  } else if (now - bar->last_line >= kPlainLine) {
    bar->last_line = now;
    out_ << label << ": " << ProgressText(update) << '\n';
    out_.flush();
  }
}

void ProgressView::End(const std::string& label) {
  Erase();
  std::erase_if(bars_, [&](const Bar& bar) { return bar.label == label; });
  Draw();
}

void ProgressView::Tick() {
  if (columns_() == 0 || bars_.empty()) return;
  Erase();
  Draw();
}

void ProgressView::Erase() {
  if (n_drawn_ == 0) return;
  out_ << "\033[" << n_drawn_ << "A\r\033[J";  // up to the first bar, clear to the end of the screen
  n_drawn_ = 0;
}

void ProgressView::Draw() {
  const int columns = columns_();
  last_draw_ = clock_();
  if (columns > 0) {
    for (const Bar& bar : bars_) out_ << Truncate(BarText(bar, columns), columns - 1) << '\n';
    n_drawn_ = static_cast<int>(bars_.size());
  }
  out_.flush();
}

std::string ProgressView::BarText(const Bar& bar, int columns) const {
  size_t label_width = 0;
  for (const Bar& other : bars_) label_width = std::max(label_width, other.label.size());
  std::string text = fmt::format("{:<{}}  ", bar.label, label_width);
  const ProgressUpdate& update = bar.update;
  if (!bar.has_update || update.total <= 0) {
    text += FormatSeconds(Seconds(clock_() - bar.start));
    return bar.has_update ? text + "  " + ProgressText(update) : text;
  }
  const double fraction = std::clamp(update.done / update.total, 0.0, 1.0);
  if (columns >= kFallbackColumns) {
    const int n_full = static_cast<int>(std::floor(fraction * kBarColumns));
    text += fmt::format("[{:-<{}}] ", std::string(n_full, '#'), kBarColumns);
  }
  return text + fmt::format("{:3.0f} %  ", std::floor(fraction * 100)) + ProgressText(update);
}

}  // namespace nrff
