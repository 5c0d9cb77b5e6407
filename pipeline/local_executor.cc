#include "pipeline/local_executor.h"

#include <array>
#include <chrono>
#include <cstdlib>
#include <ctime>
#include <stdexcept>
#include <string_view>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/process.h"

namespace nrff {
namespace {

constexpr auto kSignalPoll = std::chrono::milliseconds(100);
constexpr auto kTick = std::chrono::milliseconds(500);
constexpr std::string_view kErrorPrefix = "error: ";

sigset_t StopSignals() {
  sigset_t signals;
  sigemptyset(&signals);
  for (const int signal : {SIGINT, SIGTERM, SIGHUP}) sigaddset(&signals, signal);
  return signals;
}

JobResult ResultOf(const ProcessResult& process, const std::string& last_error) {
  JobResult result;
  result.seconds = process.seconds;
  result.peak_memory_bytes = process.peak_memory_bytes;
  result.exit_code = process.signal != 0 ? 128 + process.signal : process.exit_code;
  if (process.end == ProcessResult::End::kCancelled) result.error = "was stopped";
  if (!process.Succeeded() && result.error.empty()) {
    result.error = last_error.empty() ? DescribeEnd(process) + " and said nothing about it" : last_error;
  }
  return result;
}

}  // namespace

JobResult RunJob(Executor& executor, Job job) {
  executor.Start(std::move(job));
  return executor.Wait().result;
}

LocalExecutor::~LocalExecutor() {
  cancel_ = true;
  const bool held = !running_.empty();
  for (auto& [number, running] : running_) running.thread.join();
  if (held) ReleaseSignals();
}

int LocalExecutor::Start(Job job) {
  if (running_.empty()) HoldSignals();  // before the thread is made, which inherits the mask
  const int number = n_started_++;
  Running& running = running_[number];
  running.job = std::move(job);
  running.thread = std::thread([this, number, &job = running.job] { Run(number, job); });
  return number;
}

void LocalExecutor::Run(int number, const Job& job) {
  std::string last_error;
  ProcessOptions options;
  options.command = job.command;
  options.log = job.log;
  options.cancel = &cancel_;
  // Threads of a parallel region that wait for one another give the core away after microseconds, not milliseconds:
  // on a machine that does anything else at the same time, training is several times faster for it.
  if (std::getenv("GOMP_SPINCOUNT") == nullptr) options.environment["GOMP_SPINCOUNT"] = "1000";
  options.on_line = [&](std::string_view line) {
    if (line.substr(0, kErrorPrefix.size()) == kErrorPrefix) last_error = line.substr(kErrorPrefix.size());
    if (job.on_line) Post([&job, text = std::string(line)] { job.on_line(text); });
  };
  options.on_progress = [&](std::string_view line) {
    const std::optional<ProgressUpdate> update = ParseProgress(line);
    if (update && job.on_progress) Post([&job, update = *update] { job.on_progress(update); });
  };
  JobResult result;
  try {
    if (!job.log.empty()) WriteFileAtomically(job.log, "");
    result = ResultOf(RunProcess(options), last_error);
  } catch (const Error& error) {
    result.exit_code = static_cast<int>(error.code());
    result.error = error.what();
  } catch (const std::exception& error) {
    result.exit_code = static_cast<int>(ExitCode::kResource);
    result.error = error.what();
  }
  Post([this, number, result] { finished_.push_back({number, result}); });
}

void LocalExecutor::Post(std::function<void()> event) {
  {
    const std::lock_guard lock(mutex_);
    events_.push_back(std::move(event));
  }
  event_posted_.notify_one();
}

Executor::Finished LocalExecutor::Wait() {
  if (running_.empty()) throw std::logic_error("Executor::Wait without a job");
  auto next_tick = std::chrono::steady_clock::now();
  while (finished_.empty()) {
    std::deque<std::function<void()>> events;
    {
      std::unique_lock lock(mutex_);
      event_posted_.wait_for(lock, kSignalPoll, [this] { return !events_.empty(); });
      events.swap(events_);
    }
    for (const auto& event : events) event();
    TakeSignal();
    if (on_tick_ && std::chrono::steady_clock::now() >= next_tick) {
      on_tick_();
      next_tick = std::chrono::steady_clock::now() + kTick;
    }
  }
  Finished finished = std::move(finished_.front());
  finished_.pop_front();
  const auto ended = running_.find(finished.job);
  ended->second.thread.join();
  running_.erase(ended);
  if (running_.empty()) ReleaseSignals();
  return finished;
}

void LocalExecutor::HoldSignals() {
  const sigset_t signals = StopSignals();
  pthread_sigmask(SIG_BLOCK, &signals, &mask_before_);
}

void LocalExecutor::ReleaseSignals() { pthread_sigmask(SIG_SETMASK, &mask_before_, nullptr); }

void LocalExecutor::TakeSignal() {
  const sigset_t signals = StopSignals();
  const timespec at_once{};
  const int signal = sigtimedwait(&signals, nullptr, &at_once);
  if (signal <= 0) return;
  stop_signal_ = signal;
  cancel_ = true;
}

}  // namespace nrff
