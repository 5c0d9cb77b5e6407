// Runs command lines as child processes of this one.
//
// While jobs run, SIGINT, SIGTERM and SIGHUP end them instead of this process; StopSignal() then names the signal.
// When this process is killed in a way it cannot catch, the kernel kills the jobs (process.h).
#pragma once

#include <atomic>
#include <condition_variable>
#include <csignal>
#include <deque>
#include <functional>
#include <map>
#include <mutex>
#include <thread>

#include "pipeline/executor.h"

namespace nrff {

class LocalExecutor : public Executor {
 public:
  // `on_tick` is called by Wait at least every half second.
  explicit LocalExecutor(std::function<void()> on_tick = {}) : on_tick_(std::move(on_tick)) {}
  ~LocalExecutor() override;  // ends what still runs
  LocalExecutor(const LocalExecutor&) = delete;
  LocalExecutor& operator=(const LocalExecutor&) = delete;

  int Start(Job job) override;
  Finished Wait() override;
  int StopSignal() const override { return stop_signal_; }

 private:
  struct Running {
    Job job;
    std::thread thread;
  };

  void Run(int number, const Job& job);  // in the job's thread
  void Post(std::function<void()> event);
  void HoldSignals();
  void ReleaseSignals();
  void TakeSignal();

  std::function<void()> on_tick_;
  std::map<int, Running> running_;
  int n_started_ = 0;
  int stop_signal_ = 0;
  std::atomic<bool> cancel_ = false;
  sigset_t mask_before_{};

  std::mutex mutex_;  // guards the two below
  std::condition_variable event_posted_;
  std::deque<std::function<void()>> events_;  // to be run by Wait

  std::deque<Finished> finished_;  // not yet returned by Wait
};

}  // namespace nrff
