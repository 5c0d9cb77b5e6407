#include "pipeline/process.h"

#include <fcntl.h>
#include <poll.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <chrono>
#include <csignal>
#include <cstring>
#include <deque>
#include <fstream>
#include <optional>
#include <utility>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/progress.h"

extern char** environ;

namespace nrff {
namespace {

using Clock = std::chrono::steady_clock;
constexpr size_t kLastLines = 12;
constexpr size_t kLongestLine_bytes = 1 << 16;
constexpr double kGrace_seconds = 5;  // between the request to end and the kill
constexpr auto kTick = std::chrono::milliseconds(100);

double SecondsSince(Clock::time_point start) { return std::chrono::duration<double>(Clock::now() - start).count(); }

class Descriptor {
 public:
  explicit Descriptor(int fd = -1) : fd_(fd) {}
  ~Descriptor() { Close(); }
  Descriptor(Descriptor&& other) noexcept : fd_(std::exchange(other.fd_, -1)) {}
  Descriptor& operator=(Descriptor&& other) noexcept {
    std::swap(fd_, other.fd_);
    return *this;
  }
  int get() const { return fd_; }
  bool is_open() const { return fd_ >= 0; }
  void Close() {
    if (fd_ >= 0) close(fd_);
    fd_ = -1;
  }

 private:
  int fd_;
};

struct Pipe {
  Descriptor read, write;
};

Pipe MakePipe() {
  std::array<int, 2> ends{};
  if (pipe2(ends.data(), O_CLOEXEC) != 0) throw ResourceError(std::string("cannot make a pipe: ") + strerror(errno));
  return {Descriptor(ends[0]), Descriptor(ends[1])};
}

// Cuts a stream of bytes into lines. A line that never ends is passed on in pieces.
class LineSplitter {
 public:
  template <typename Callback>
  void Add(std::string_view bytes, const Callback& callback) {
    for (const char c : bytes) {
      if (c == '\n' || c == '\r' || pending_.size() >= kLongestLine_bytes) Flush(callback);
      if (c != '\n' && c != '\r') pending_ += c;
    }
  }
  template <typename Callback>
  void Flush(const Callback& callback) {
    if (!pending_.empty()) callback(std::string_view(pending_));
    pending_.clear();
  }

 private:
  std::string pending_;
};

class Log {
 public:
  explicit Log(const std::filesystem::path& path) : path_(path) {
    if (path.empty()) return;
    fd_ = Descriptor(open(path.c_str(), O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0666));
    if (!fd_.is_open()) Fail();
  }
  void Write(std::string_view bytes) {
    while (fd_.is_open() && !bytes.empty()) {
      const ssize_t n = write(fd_.get(), bytes.data(), bytes.size());
      if (n < 0 && errno == EINTR) continue;
      if (n < 0) Fail();
      bytes.remove_prefix(size_t(n));
    }
  }

 private:
  [[noreturn]] void Fail() const {
    throw ResourceError("cannot write the log " + EscapePath(path_) + ": " + strerror(errno));
  }
  std::filesystem::path path_;
  Descriptor fd_;
};

// Processor time of every process of the group, in clock ticks (fields 5, 14, 15 of /proc/PID/stat, proc(5)).
uint64_t GroupProcessorTicks(pid_t group) {
  uint64_t ticks = 0;
  std::error_code error;
  for (const auto& entry : std::filesystem::directory_iterator("/proc", error)) {
    if (!isdigit(static_cast<unsigned char>(entry.path().filename().c_str()[0]))) continue;
    std::ifstream file(entry.path() / "stat");
    std::string stat;
    if (!std::getline(file, stat)) continue;
    const size_t name_end = stat.rfind(')');  // the name before it may hold anything
    if (name_end == std::string::npos) continue;
    char state = 0;
    int parent = 0, process_group = 0;
    unsigned long user = 0, system = 0;
    const int n = sscanf(stat.c_str() + name_end + 1, " %c %d %d %*d %*d %*d %*u %*u %*u %*u %*u %lu %lu", &state,
                         &parent, &process_group, &user, &system);
    if (n == 5 && process_group == group) ticks += user + system;
  }
  return ticks;
}

// Everything the child needs between fork and exec, made before: only async-signal-safe calls are left.
struct Launch {
  std::vector<std::string> environment_storage;
  std::vector<char*> arguments, environment;

  Launch(const ProcessOptions& options, int progress_fd) {
    for (const std::string& argument : options.command) arguments.push_back(const_cast<char*>(argument.c_str()));
    arguments.push_back(nullptr);
    const auto overridden = [&](std::string_view variable) {
      const std::string name(variable.substr(0, variable.find('=')));
      return name == "NRFF_PROGRESS_FD" || options.environment.count(name) > 0;
    };
    for (char** variable = environ; *variable; ++variable) {
      if (!overridden(*variable)) environment.push_back(*variable);
    }
    for (const auto& [name, value] : options.environment) {
      environment_storage.emplace_back(name).append("=").append(value);
    }
    if (progress_fd >= 0) environment_storage.push_back("NRFF_PROGRESS_FD=" + std::to_string(progress_fd));
    for (std::string& variable : environment_storage) environment.push_back(variable.data());
    environment.push_back(nullptr);
  }
};

[[noreturn]] void BecomeChild(Launch& launch, int output, int progress, int failure, pid_t parent) {
  setpgid(0, 0);
  prctl(PR_SET_PDEATHSIG, SIGKILL);
  if (getppid() != parent) _exit(127);  // the parent died before the line above
  sigset_t none;
  sigemptyset(&none);
  sigprocmask(SIG_SETMASK, &none, nullptr);
  signal(SIGPIPE, SIG_DFL);
  signal(SIGINT, SIG_DFL);
  signal(SIGTERM, SIG_DFL);
  const int input = open("/dev/null", O_RDONLY);
  dup2(input, STDIN_FILENO);
  dup2(output, STDOUT_FILENO);
  dup2(output, STDERR_FILENO);
  if (progress >= 0) fcntl(progress, F_SETFD, 0);
  execvpe(launch.arguments[0], launch.arguments.data(), launch.environment.data());
  const int error = errno;
  const ssize_t ignored = write(failure, &error, sizeof error);
  static_cast<void>(ignored);
  _exit(127);
}

class Child {
 public:
  explicit Child(const ProcessOptions& options) : options_(options), log_(options.log) {
    if (options.command.empty()) throw UsageError("an empty command line cannot be run");
    Pipe output = MakePipe(), failure = MakePipe(), progress;
    if (options.on_progress) progress = MakePipe();
    LogCommand();
    Launch launch(options, progress.write.get());
    const pid_t parent = getpid();
    pid_ = leader_ = fork();
    if (pid_ < 0) throw ResourceError("cannot start " + options.command[0] + ": " + strerror(errno));
    if (pid_ == 0) BecomeChild(launch, output.write.get(), progress.write.get(), failure.write.get(), parent);
    setpgid(pid_, pid_);  // also here: the group must exist before it may be killed
    output_ = std::move(output.read);
    progress_ = std::move(progress.read);
    output.write.Close();
    progress.write.Close();
    failure.write.Close();
    int error = 0;
    ssize_t n = 0;
    while ((n = read(failure.read.get(), &error, sizeof error)) < 0 && errno == EINTR) {
    }
    if (n == sizeof error) {
      waitpid(pid_, nullptr, 0);
      pid_ = -1;
      throw ExternalToolError("cannot start " + options.command[0] + ": " + strerror(error));
    }
  }
  ~Child() {
    if (pid_ > 0) {  // a callback threw
      kill(-pid_, SIGKILL);
      waitpid(pid_, nullptr, 0);
    }
  }
  Child(const Child&) = delete;
  Child& operator=(const Child&) = delete;

  ProcessResult Run() {
    std::optional<int> status;
    while (!status) {
      ReadOutput();
      status = Reap();
      if (!status) Watch();
    }
    kill(-leader_, SIGKILL);  // what it started and left behind
    Drain();
    lines_.Flush([this](std::string_view line) { TakeLine(line); });
    result_.seconds = SecondsSince(start_);
    if (stopped_) {
      result_.end = *stopped_;
      result_.signal = WIFSIGNALED(*status) ? WTERMSIG(*status) : 0;
    } else if (WIFSIGNALED(*status)) {
      result_.end = ProcessResult::End::kSignalled;
      result_.signal = WTERMSIG(*status);
    } else {
      result_.exit_code = WEXITSTATUS(*status);
    }
    result_.last_lines.assign(last_lines_.begin(), last_lines_.end());
    return result_;
  }

 private:
  void LogCommand() {
    std::string line = "$";
    for (const std::string& argument : options_.command) line.append(" ").append(EscapePath(argument));
    log_.Write(line.append("\n"));
  }

  void TakeLine(std::string_view line) {
    last_lines_.emplace_back(line);
    if (last_lines_.size() > kLastLines) last_lines_.pop_front();
    if (options_.on_line) options_.on_line(line);
  }

  // Waits at most a tick for bytes on either pipe and takes them. False when nothing came.
  bool ReadOutput(std::chrono::milliseconds wait = kTick) {
    std::array<pollfd, 2> polled{{{output_.get(), POLLIN, 0}, {progress_.get(), POLLIN, 0}}};  // fd −1 is ignored
    if (poll(polled.data(), polled.size(), int(wait.count())) <= 0) return false;
    bool any = false;
    if (polled[0].revents) any |= Take(output_, lines_, &log_, [this](std::string_view line) { TakeLine(line); });
    if (polled[1].revents) any |= Take(progress_, progress_lines_, nullptr, options_.on_progress);
    return any;
  }

  template <typename Callback>
  bool Take(Descriptor& from, LineSplitter& splitter, Log* log, const Callback& callback) {
    std::array<char, 1 << 14> buffer{};
    const ssize_t n = read(from.get(), buffer.data(), buffer.size());
    if (n < 0 && errno == EINTR) return true;
    if (n <= 0) {
      from.Close();
      return false;
    }
    const std::string_view bytes(buffer.data(), size_t(n));
    if (log) log->Write(bytes);
    splitter.Add(bytes, callback);
    last_life_ = Clock::now();
    return true;
  }

  void Drain() {
    while (ReadOutput(std::chrono::milliseconds(0))) {
    }
  }

  std::optional<int> Reap() {
    int status = 0;
    rusage usage{};
    const pid_t ended = wait4(pid_, &status, WNOHANG, &usage);
    if (ended != pid_) return {};
    pid_ = -1;
    result_.peak_memory_bytes = uint64_t(usage.ru_maxrss) * 1024;
    return status;
  }

  void Watch() {
    if (stopped_) {
      if (SecondsSince(stop_time_) > kGrace_seconds) kill(-leader_, SIGKILL);
      return;
    }
    if (options_.cancel && *options_.cancel) return Stop(ProcessResult::End::kCancelled);
    if (options_.limit_seconds > 0 && SecondsSince(start_) > options_.limit_seconds) {
      return Stop(ProcessResult::End::kTimeLimit);
    }
    if (options_.stall_limit_seconds <= 0 || SecondsSince(last_check_) < options_.stall_limit_seconds / 10) return;
    last_check_ = Clock::now();
    const uint64_t ticks = GroupProcessorTicks(leader_);
    if (ticks != processor_ticks_) last_life_ = last_check_;
    processor_ticks_ = ticks;
    if (SecondsSince(last_life_) > options_.stall_limit_seconds) Stop(ProcessResult::End::kStalled);
  }

  void Stop(ProcessResult::End why) {
    stopped_ = why;
    stop_time_ = Clock::now();
    kill(-leader_, SIGTERM);
  }

  const ProcessOptions& options_;
  Log log_;
  pid_t pid_ = -1;     // −1 once waited for
  pid_t leader_ = -1;  // of the process group: the same number, kept
  Descriptor output_, progress_;
  LineSplitter lines_, progress_lines_;
  std::deque<std::string> last_lines_;
  Clock::time_point start_ = Clock::now(), last_life_ = start_, last_check_ = start_, stop_time_ = start_;
  uint64_t processor_ticks_ = 0;
  std::optional<ProcessResult::End> stopped_;
  ProcessResult result_;
};

}  // namespace

ProcessResult RunProcess(const ProcessOptions& options) { return Child(options).Run(); }

std::string DescribeEnd(const ProcessResult& result) {
  switch (result.end) {
    case ProcessResult::End::kExited:
      return "exited with status " + std::to_string(result.exit_code);
    case ProcessResult::End::kSignalled:
      return "was ended by signal " + std::to_string(result.signal) + " (" + strsignal(result.signal) + ")";
    case ProcessResult::End::kTimeLimit:
      return "was stopped at its time limit, after " + FormatSeconds(result.seconds);
    case ProcessResult::End::kStalled:
      return "was stopped after " + FormatSeconds(result.seconds) +
             ": it neither printed nor used the processor any more";
    case ProcessResult::End::kCancelled:
      return "was cancelled";
  }
  return {};
}

}  // namespace nrff
