#include "tests/program.h"

#include <fcntl.h>
#include <signal.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cerrno>
#include <chrono>
#include <fstream>
#include <sstream>
#include <stdexcept>
#include <thread>

#include "pipeline/files.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

double Now() { return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count(); }

void Sleep(double seconds) { std::this_thread::sleep_for(std::chrono::duration<double>(seconds)); }

// Never returns.
[[noreturn]] void RunChild(const std::vector<std::string>& command, const ProgramOptions& options, const fs::path& out,
                           const fs::path& err) {
  setsid();
  setenv("XDG_DATA_HOME", "/nonexistent", 1);  // no LPIPS network of the user's own
  for (const auto& [name, value] : options.environment) setenv(name.c_str(), value.c_str(), 1);
  if (options.file_size_limit_bytes > 0) {
    const rlimit limit{options.file_size_limit_bytes, options.file_size_limit_bytes};
    setrlimit(RLIMIT_FSIZE, &limit);
    signal(SIGXFSZ, SIG_IGN);
  }
  dup2(open("/dev/null", O_RDONLY), STDIN_FILENO);
  dup2(open(out.c_str(), O_WRONLY | O_CREAT | O_TRUNC, 0644), STDOUT_FILENO);
  dup2(open(err.c_str(), O_WRONLY | O_CREAT | O_TRUNC, 0644), STDERR_FILENO);
  std::vector<char*> arguments;
  arguments.reserve(command.size() + 1);
  for (const std::string& argument : command) arguments.push_back(const_cast<char*>(argument.c_str()));
  arguments.push_back(nullptr);
  execv(arguments[0], arguments.data());
  _exit(127);
}

// The session and the state letter of a process; false when it is gone.
bool ReadStat(const fs::path& process, pid_t& session, char& state) {
  std::ifstream file(process / "stat");
  std::string text;
  std::getline(file, text, '\0');
  const size_t end_of_name = text.rfind(')');
  if (end_of_name == std::string::npos) return false;
  std::istringstream fields(text.substr(end_of_name + 1));
  pid_t parent = 0, group = 0;
  return static_cast<bool>(fields >> state >> parent >> group >> session);
}

}  // namespace

std::vector<std::string> ProgramResult::Errors() const {
  constexpr std::string_view kPrefix = "error: ";
  std::vector<std::string> errors;
  std::istringstream lines(err);
  for (std::string line; std::getline(lines, line);) {
    if (line.starts_with(kPrefix)) errors.push_back(line.substr(kPrefix.size()));
  }
  return errors;
}

Program::Program(const std::vector<std::string>& command, const ProgramOptions& options)
    : limit_seconds_(options.limit_seconds), start_seconds_(Now()) {
  std::string name = fs::temp_directory_path() / "nrff-program-XXXXXX";
  if (mkdtemp(name.data()) == nullptr) throw std::runtime_error("cannot create " + name);
  output_ = name;
  std::vector<std::string> resolved = command;
  if (command[0].find('/') == std::string::npos) resolved[0] = std::string(NRFF_BIN_DIR) + "/" + command[0];
  const fs::path out = output_ / "out", err = output_ / "err";
  // Closed by the child's exec: from then on the session exists.
  int running[2];
  if (pipe2(running, O_CLOEXEC) != 0) throw std::runtime_error("cannot make a pipe");
  pid_ = fork();
  if (pid_ < 0) throw std::runtime_error("cannot fork");
  if (pid_ == 0) RunChild(resolved, options, out, err);
  close(running[1]);
  char nothing = 0;
  while (read(running[0], &nothing, 1) < 0 && errno == EINTR) continue;
  close(running[0]);
}

Program::~Program() {
  if (!waited_) {
    KillSession();
    waitpid(pid_, nullptr, 0);
  }
  std::error_code ignored;
  fs::remove_all(output_, ignored);
}

ProgramResult Program::Wait() {
  ProgramResult result;
  int status = 0;
  while (waitpid(pid_, &status, WNOHANG) == 0) {
    if (Now() - start_seconds_ > limit_seconds_) KillSession();
    Sleep(0.005);
  }
  waited_ = true;
  result.seconds = Now() - start_seconds_;
  result.exit_code = WIFEXITED(status) ? WEXITSTATUS(status) : 128 + WTERMSIG(status);
  result.out = ReadFile(output_ / "out");
  result.err = ReadFile(output_ / "err");
  return result;
}

std::vector<pid_t> Program::Session() const {
  std::vector<pid_t> members;
  std::error_code ignored;
  for (const fs::directory_entry& entry : fs::directory_iterator("/proc", ignored)) {
    const std::string name = entry.path().filename();
    if (name.find_first_not_of("0123456789") != std::string::npos) continue;
    pid_t session = 0;
    char state = 0;
    if (ReadStat(entry.path(), session, state) && session == pid_ && state != 'Z' && state != 'X') {
      members.push_back(std::stoi(name));
    }
  }
  return members;
}

void Program::KillSession() const {
  // Again, until none is left: one that was about to be started is not in the first list.
  for (std::vector<pid_t> members = Session(); !members.empty(); members = Session()) {
    for (const pid_t member : members) kill(member, SIGKILL);
  }
}

void Program::KillAlone() const { kill(pid_, SIGKILL); }

ProgramResult RunProgram(const std::vector<std::string>& command, const ProgramOptions& options) {
  return Program(command, options).Wait();
}

}  // namespace nrff
