// The graph and its scheduler, on a disk and with processes that exist in memory only.
#include "pipeline/graph.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <deque>
#include <set>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/scheduler.h"

namespace nrff {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;

constexpr char kVersion[] = "1.0";

class FakeDisk : public Disk {
 public:
  ArtifactState ReadArtifact(const std::filesystem::path& artifact) override {
    if (too_new.contains(artifact)) throw CorruptError("made by a newer program");
    const auto damage = damaged.find(artifact);
    if (damage != damaged.end()) return {{}, damage->second};
    const auto found = manifests.find(artifact);
    if (found == manifests.end()) return {{}, "has not been made"};
    return {found->second, ""};
  }
  std::string HashSource(const std::filesystem::path& source) override {
    ++n_hashed;
    return sources.at(source);
  }
  std::map<std::filesystem::path, Manifest> manifests;
  std::map<std::filesystem::path, std::string> sources, damaged;
  std::set<std::filesystem::path> too_new;
  int n_hashed = 0;
};

// Each command line is {the node's id}; a job "runs" for as many steps as Wait needs to come to it.
class FakeExecutor : public Executor {
 public:
  // Makes what the node of that id makes.
  std::function<JobResult(const std::string& id)> run;

  int Start(Job job) override {
    started.push_back(job.command.front());
    running.emplace_back(n_started, job.command.front());
    most_at_once = std::max(most_at_once, running.size());
    return n_started++;
  }
  Finished Wait() override {
    const auto [number, id] = running.front();
    running.pop_front();
    if (id == stop_after) stop_signal = 15;
    return {number, run(id)};
  }
  int StopSignal() const override { return stop_signal; }

  std::vector<std::string> started;
  std::deque<std::pair<int, std::string>> running;
  size_t most_at_once = 0;
  std::string stop_after;
  int n_started = 0, stop_signal = 0;
};

class Notes : public RunObserver {
 public:
  void OnStart(const Node& node, const std::string& reason) override { reasons[node.id()] = reason; }
  void OnLine(const Node& node, const std::string& line) override { lines.push_back(node.id() + " " + line); }
  void OnProgress(const Node&, const ProgressUpdate&) override {}
  void OnEnd(const Node& node, const Outcome& outcome, const std::optional<Manifest>&) override {
    states[node.id()] = outcome.state;
  }
  std::map<std::string, std::string> reasons;
  std::map<std::string, Outcome::State> states;
  std::vector<std::string> lines;
};

// Two stages after a first that reads the capture: photos → a → b → c, as often as there are branches.
class GraphTest : public ::testing::Test {
 protected:
  GraphTest() {
    disk_.sources["/photos"] = "photos-hash";
    executor_.run = [this](const std::string& id) { return RunStage(id); };
  }

  static Node MakeNode(const std::string& branch, const std::string& stage, const std::vector<std::string>& inputs) {
    Node node;
    node.branch = branch;
    node.stage = stage;
    node.artifact = "/work/" + branch + "/" + stage;
    node.command = {node.id()};
    for (const std::string& input : inputs) node.inputs.push_back(branch + "/" + input);
    return node;
  }

  void AddBranch(const std::string& branch) {
    Node a = MakeNode(branch, "a", {});
    a.source = "/photos";
    nodes_.push_back(a);
    nodes_.push_back(MakeNode(branch, "b", {"a"}));
    nodes_.push_back(MakeNode(branch, "c", {"b"}));
  }

  Node& NodeOf(const std::string& id) {
    return *std::find_if(nodes_.begin(), nodes_.end(), [&](const Node& node) { return node.id() == id; });
  }

  std::unique_ptr<Graph> MakeGraph() {
    auto graph = std::make_unique<Graph>(disk_, kVersion);
    for (const Node& node : nodes_) graph->Add(node);
    return graph;
  }

  // What a stage does: reads its inputs' manifests and writes its own. `payload_` is what it makes.
  JobResult RunStage(const std::string& id) {
    if (const auto failure = failures_.find(id); failure != failures_.end()) return {failure->second, "broken", 1, 1};
    const Node& node = NodeOf(id);
    Manifest manifest;
    manifest.kind = node.stage;
    manifest.version = kVersion;
    manifest.params = node.params;
    if (!node.source.empty()) manifest.inputs.push_back({EscapePath(node.source), disk_.sources.at(node.source), 0});
    for (const std::string& input : node.inputs) {
      const Node& producer = NodeOf(input);
      manifest.inputs.push_back({producer.stage, disk_.manifests.at(producer.artifact).ContentHash(), 0});
    }
    manifest.outputs.push_back({"payload", payload_[id], 1});
    manifest.facts = {{"posed", true}};
    disk_.manifests[node.artifact] = manifest;
    disk_.damaged.erase(node.artifact);
    return {0, "", 1, 1};
  }

  std::vector<Outcome> Run() {
    executor_.started.clear();
    notes_ = Notes();
    graph_ = MakeGraph();
    return RunGraph(*graph_, executor_, machine_, notes_);
  }

  std::string ReasonOf(const std::string& id) {
    graph_ = MakeGraph();
    return graph_->Examine(graph_->nodes()[graph_->IndexOf(id)]).reason;
  }

  FakeDisk disk_;
  FakeExecutor executor_;
  Notes notes_;
  std::vector<Node> nodes_;
  std::map<std::string, std::string> payload_;
  std::map<std::string, int> failures_;
  Machine machine_{4, 1000};
  std::unique_ptr<Graph> graph_;
};

TEST_F(GraphTest, EverythingRunsOnceInputsFirstAndThenNothing) {
  AddBranch("x");
  Run();
  EXPECT_THAT(executor_.started, ElementsAre("x/a", "x/b", "x/c"));
  EXPECT_EQ(notes_.reasons["x/a"], "has not been made");
  const std::vector<Outcome> again = Run();
  EXPECT_THAT(executor_.started, IsEmpty());
  for (const Outcome& outcome : again) EXPECT_EQ(outcome.state, Outcome::kReused);
}

TEST_F(GraphTest, EveryReasonToRunIsNamed) {
  AddBranch("x");
  Run();
  EXPECT_EQ(ReasonOf("x/b"), "");

  NodeOf("x/b").params = {{"steps", "10"}};
  EXPECT_EQ(ReasonOf("x/b"), "was made with --steps the default, now it is 10");
  disk_.manifests["/work/x/b"].params = {{"steps", "20"}};
  EXPECT_EQ(ReasonOf("x/b"), "was made with --steps 20, now it is 10");
  NodeOf("x/b").params = {};
  EXPECT_EQ(ReasonOf("x/b"), "was made with --steps 20, now it is the default");
  disk_.manifests["/work/x/b"].params = {};

  disk_.manifests["/work/x/b"].version = "0.9";
  EXPECT_EQ(ReasonOf("x/b"), "was made by version 0.9, this is 1.0");
  disk_.manifests["/work/x/b"].version = kVersion;

  disk_.manifests["/work/x/b"].kind = "c";
  EXPECT_EQ(ReasonOf("x/b"), "is an artifact of the stage c");
  disk_.manifests["/work/x/b"].kind = "b";

  disk_.manifests["/work/x/a"].outputs[0].hash = "other";
  EXPECT_EQ(ReasonOf("x/b"), "was made from another a");
  EXPECT_EQ(ReasonOf("x/c"), "");

  disk_.sources["/photos"] = "more photos";
  EXPECT_EQ(ReasonOf("x/a"), "was made before files in the capture changed");
  NodeOf("x/a").source = "/elsewhere";
  EXPECT_EQ(ReasonOf("x/a"), "was made from /photos, now it is /elsewhere");

  NodeOf("x/c").inputs = {};
  EXPECT_EQ(ReasonOf("x/c"), "was made from something that is no longer an input");
  NodeOf("x/c").when = When::kAlways;
  disk_.manifests["/work/x/c"].inputs = {};
  EXPECT_EQ(ReasonOf("x/c"), "was asked to run again");
}

TEST_F(GraphTest, DamagedArtifactIsMadeAgainAndWhatFollowsIsCutOff) {
  AddBranch("x");
  Run();
  disk_.damaged["/work/x/b"] = "has a damaged manifest";
  EXPECT_EQ(ReasonOf("x/c"), "was made from an artifact of b that has a damaged manifest");
  Run();
  EXPECT_THAT(executor_.started, ElementsAre("x/b"));
}

TEST_F(GraphTest, ArtifactOfNewerProgramIsNotTouched) {
  AddBranch("x");
  Run();
  disk_.too_new.insert("/work/x/b");
  const std::vector<Outcome> outcomes = Run();
  EXPECT_THAT(executor_.started, IsEmpty());
  EXPECT_EQ(outcomes[1].state, Outcome::kFailed);
  EXPECT_EQ(outcomes[1].job.exit_code, static_cast<int>(ExitCode::kCorrupt));
  EXPECT_EQ(outcomes[2].state, Outcome::kNotRun);
}

TEST_F(GraphTest, SameBytesCutOffWhatFollowsAndOtherBytesDoNot) {
  AddBranch("x");
  Run();
  NodeOf("x/a").when = When::kAlways;
  Run();
  EXPECT_THAT(executor_.started, ElementsAre("x/a"));
  payload_["x/a"] = "other";
  Run();
  EXPECT_THAT(executor_.started, ElementsAre("x/a", "x/b"));  // b came out the same
}

TEST_F(GraphTest, FailureStopsOnlyWhatDependsOnIt) {
  AddBranch("x");
  AddBranch("y");
  failures_["x/b"] = 4;
  const std::vector<Outcome> outcomes = Run();
  EXPECT_EQ(notes_.states["x/b"], Outcome::kFailed);
  EXPECT_EQ(outcomes[1].job.exit_code, 4);
  EXPECT_EQ(notes_.states["x/c"], Outcome::kNotRun);
  EXPECT_EQ(outcomes[2].reason, "b failed");
  EXPECT_EQ(notes_.states["y/c"], Outcome::kRan);
}

TEST_F(GraphTest, StageThatSucceedsWithoutAnArtifactFails) {
  AddBranch("x");
  executor_.run = [](const std::string&) { return JobResult{}; };
  const std::vector<Outcome> outcomes = Run();
  EXPECT_EQ(outcomes[0].state, Outcome::kFailed);
  EXPECT_EQ(outcomes[0].job.exit_code, static_cast<int>(ExitCode::kCorrupt));
  EXPECT_THAT(outcomes[0].job.error, HasSubstr("has not been made"));
}

TEST_F(GraphTest, StageThatRecordsOtherParametersIsReported) {
  AddBranch("x");
  NodeOf("x/b").params = {{"seed", "1"}};
  executor_.run = [this](const std::string& id) {
    JobResult result = RunStage(id);
    disk_.manifests["/work/x/b"].params = {};
    return result;
  };
  Run();
  EXPECT_THAT(notes_.lines, ElementsAre(HasSubstr("x/b warning: what b made will not be used again")));
}

TEST_F(GraphTest, TakenAsItIsNeverRunsAndHasToBeThere) {
  AddBranch("x");
  Run();
  disk_.sources["/photos"] = "more photos";
  NodeOf("x/a").when = When::kNever;
  Run();
  EXPECT_THAT(executor_.started, IsEmpty());
  disk_.manifests.erase("/work/x/a");
  const std::vector<Outcome> outcomes = Run();
  EXPECT_EQ(outcomes[0].state, Outcome::kFailed);
  EXPECT_EQ(outcomes[0].job.exit_code, static_cast<int>(ExitCode::kInput));
}

TEST_F(GraphTest, BranchesRunSideBySideWithinCoresAndMemory) {
  for (const char* branch : {"x", "y", "z"}) AddBranch(branch);
  Run();
  EXPECT_EQ(executor_.most_at_once, 3u);

  const auto run_with = [&](int cores, uint64_t memory_bytes) {
    disk_.manifests.clear();
    executor_.most_at_once = 0;
    for (Node& node : nodes_) {
      node.cores = cores;
      node.memory_bytes = memory_bytes;
    }
    Run();
    EXPECT_EQ(executor_.started.size(), nodes_.size());
    return executor_.most_at_once;
  };
  EXPECT_EQ(run_with(2, 0), 2u);
  EXPECT_EQ(run_with(1, 400), 2u);
  EXPECT_EQ(run_with(100, 0), 1u);  // more than there is: alone, but it runs
  EXPECT_EQ(run_with(1, 100000), 1u);
}

TEST_F(GraphTest, StopSignalStartsNothingNew) {
  AddBranch("x");
  executor_.stop_after = "x/a";
  const std::vector<Outcome> outcomes = Run();
  EXPECT_THAT(executor_.started, ElementsAre("x/a"));
  EXPECT_EQ(outcomes[0].state, Outcome::kRan);
  EXPECT_EQ(outcomes[1].state, Outcome::kNotRun);
}

TEST_F(GraphTest, FactsExpandTheGraphWhetherReusedOrRun) {
  Node a = MakeNode("x", "a", {});
  a.source = "/photos";
  nodes_ = {a, MakeNode("x", "b", {"a"})};
  for (int i = 0; i < 2; ++i) {
    executor_.started.clear();
    Graph graph(disk_, kVersion);
    Node first = a;
    first.expand = [&](const Json& facts) {
      EXPECT_EQ(facts.at("posed"), true);
      return std::vector<Node>{nodes_[1]};
    };
    graph.Add(first);
    const std::vector<Outcome> outcomes = RunGraph(graph, executor_, machine_, notes_);
    ASSERT_EQ(outcomes.size(), 2u);
    EXPECT_EQ(executor_.started.size(), i == 0 ? 2u : 0u);
  }
}

TEST_F(GraphTest, PlanSaysWhatRunsWhatIsReusedAndWhatDepends) {
  AddBranch("x");
  const auto plan = [&] {
    graph_ = MakeGraph();
    return graph_->Plan([](const Node&) { return Json::object(); });
  };
  for (const Verdict& verdict : plan()) EXPECT_EQ(verdict.state, Verdict::kStale);
  Run();
  for (const Verdict& verdict : plan()) EXPECT_EQ(verdict.state, Verdict::kFresh);
  disk_.sources["/photos"] = "more photos";
  const std::vector<Verdict> verdicts = plan();
  EXPECT_EQ(verdicts[0].state, Verdict::kStale);
  EXPECT_EQ(verdicts[1].state, Verdict::kUndecided);
  EXPECT_EQ(verdicts[1].reason, "runs after a if that comes out different");
  EXPECT_EQ(verdicts[2].state, Verdict::kUndecided);
  EXPECT_THAT(executor_.started, ElementsAre("x/a", "x/b", "x/c"));  // planning ran nothing
}

TEST_F(GraphTest, CaptureIsHashedOnceHoweverManyNodesAsk) {
  AddBranch("x");
  AddBranch("y");
  Run();
  disk_.n_hashed = 0;
  Run();
  EXPECT_EQ(disk_.n_hashed, 1);
}

TEST_F(GraphTest, UnknownInputsAndTwinsAreProgrammingErrors) {
  Graph graph(disk_, kVersion);
  EXPECT_THROW(graph.Add(MakeNode("x", "b", {"a"})), std::logic_error);
  graph.Add(MakeNode("x", "a", {}));
  EXPECT_THROW(graph.Add(MakeNode("x", "a", {})), std::logic_error);
}

}  // namespace
}  // namespace nrff
