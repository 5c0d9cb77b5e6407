// What a run shows while it runs: lines that stay, and below them one bar per running stage with the time left. On
// anything but a terminal the bars become plain lines, one per stage every ten seconds.
#pragma once

#include <chrono>
#include <functional>
#include <ostream>
#include <string>
#include <vector>

#include "pipeline/executor.h"

namespace nrff {

class ProgressView {
 public:
  using Clock = std::function<std::chrono::steady_clock::time_point()>;

  // `columns`: the terminal's width now; 0: not a terminal.
  ProgressView(std::ostream& out, std::function<int()> columns, Clock clock = std::chrono::steady_clock::now);
  ~ProgressView();  // takes the bars away
  ProgressView(const ProgressView&) = delete;
  ProgressView& operator=(const ProgressView&) = delete;

  void Print(const std::string& line);
  void Begin(const std::string& label);
  void Update(const std::string& label, const ProgressUpdate& update);
  void End(const std::string& label);
  // To be called a few times a second: keeps the times going.
  void Tick();

 private:
  struct Bar {
    std::string label;
    std::chrono::steady_clock::time_point start, last_line;
    ProgressUpdate update;
    bool has_update = false;
  };
  Bar* Find(const std::string& label);
  void Erase();
  void Draw();
  std::string BarText(const Bar& bar, int columns) const;

  std::ostream& out_;
  std::function<int()> columns_;
  Clock clock_;
  std::vector<Bar> bars_;  // in the order they began
  int n_drawn_ = 0;        // lines of bars on the screen
  std::chrono::steady_clock::time_point last_draw_;
};

// Width in columns of the terminal that `descriptor` is; 0 when it is none.
int TerminalColumns(int descriptor);

// "training 120/3000 steps, 41 s left, loss 0.0123"
std::string ProgressText(const ProgressUpdate& update);

}  // namespace nrff
