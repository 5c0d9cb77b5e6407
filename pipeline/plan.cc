#include "pipeline/plan.h"

#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <iostream>

#include "pipeline/commands.h"
#include "pipeline/console.h"
#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/local_executor.h"
#include "pipeline/plan_table.h"
#include "pipeline/progress.h"
#include "pipeline/progress_view.h"
#include "pipeline/run.h"
#include "pipeline/scene.h"

namespace nrff {
namespace {

void AddDecision(std::vector<Decision>& decisions, const Decision& decision) {
  const auto known = std::find_if(decisions.begin(), decisions.end(),
                                  [&](const Decision& other) { return other.feature == decision.feature; });
  if (known == decisions.end()) {
    decisions.push_back(decision);
  } else {
    *known = decision;
  }
}

// What follows from the capture and the options alone, and, of stages that are done, what they decided.
void AddKnownDecisions(Graph& graph, BranchPlan& plan) {
  const bool posed = plan.facts.value("posed", false);
  plan.decisions = {needs::Sfm(posed, plan.facts.value("kind", "capture"))};
  if (plan.facts.value("has_alpha", false)) plan.decisions.push_back(needs::Contraction(false, true, {}));
  for (const Decision& decision : plan.training.value("decisions", std::vector<Decision>())) {
    plan.decisions.push_back(decision);
  }
  plan.decisions.push_back(needs::Lpips(LpipsNetworkOf(plan.request)));
  for (size_t i = 0; i < plan.nodes.size(); ++i) {
    if (plan.verdicts[i].state != Verdict::kFresh) continue;
    for (const Decision& decision : graph.Artifact(plan.nodes[i]).manifest->decisions) {
      AddDecision(plan.decisions, decision);
    }
  }
  for (const std::string& feature : ForceableFeatures(plan.nodes)) {
    const auto decided = std::find_if(plan.decisions.begin(), plan.decisions.end(),
                                      [&](const Decision& decision) { return decision.feature == feature; });
    const std::optional<bool> forced = ForcedDecision(plan.request, feature);
    if (decided != plan.decisions.end()) {
      Force(*decided, forced);
    } else if (forced) {
      plan.decisions.push_back({feature, true, "nothing measured yet", "", ""});
      Force(plan.decisions.back(), forced);
    } else {
      plan.undecided.push_back(feature);
    }
  }
}

std::string TrainingText(const BranchPlan& plan) {
  const auto size = plan.request.options.find("max-image-size");
  const double budget_seconds = plan.training.value("budget_seconds", 0.);
  const Json steps = plan.training.value("steps", Json());
  const auto preset = plan.training.value("preset", "");
  return fmt::format("training: preset {}, {}, on {}, photos of at most {} px",
                     preset == "auto" ? "small, or tiny where too few of its steps fit" : preset,
                     budget_seconds > 0 ? FormatSeconds(budget_seconds) : steps.dump() + " steps",
                     plan.training.value("device", "cpu"),
                     size == plan.request.options.end() ? std::to_string(kMaxImageSize) : size->second);
}

const char* StateText(Verdict::State state) {
  switch (state) {
    case Verdict::kFresh:
      return "reuse";
    case Verdict::kStale:
      return "run";
    case Verdict::kUndecided:
      return "decide";
  }
  return "";
}

// One plan's error was not printed with the plans: it is all there is to say.
void ThrowIfUnplanned(const std::vector<BranchPlan>& plans) {
  size_t n_unplanned = 0;
  const BranchPlan* first = nullptr;
  for (const BranchPlan& plan : plans) {
    if (plan.error.empty()) continue;
    ++n_unplanned;
    if (first == nullptr) first = &plan;
  }
  if (first == nullptr) return;
  throw Error(
      static_cast<ExitCode>(first->exit_code),
      plans.size() == 1 ? first->error : fmt::format("{} of {} captures cannot be planned", n_unplanned, plans.size()));
}

}  // namespace

BranchPlan PlanBranch(const BranchRequest& request, Executor& executor) {
  BranchPlan plan{request};
  try {
    RealDisk disk;
    Graph graph(disk, Version());
    graph.Add(FirstNode(request, ThisMachine()));
    plan.verdicts = graph.Plan([&](const Node&) {
      plan.facts = ProbeCapture(executor, request);
      return plan.facts;
    });
    plan.nodes.assign(graph.nodes().begin(), graph.nodes().end());
    if (plan.facts.empty()) plan.facts = graph.Artifact(plan.nodes.front()).manifest->facts;
    plan.extension = ProbeExtension(executor, request);
    plan.training = ProbeTraining(executor, request);
    AddKnownDecisions(graph, plan);
  } catch (const Error& error) {
    plan.exit_code = static_cast<int>(error.code());
    plan.error = error.what();
  }
  return plan;
}

void PrintPlans(const std::vector<BranchPlan>& plans, std::optional<int> explained, std::ostream& out) {
  for (const BranchPlan& plan : plans) {
    out << plan.request.name << ": " << EscapePath(plan.request.capture) << " → "
        << EscapePath(plan.request.workspace.root()) << '\n';
    if (!plan.error.empty()) {
      out << "  cannot be planned: " << plan.error << '\n';
      continue;
    }
    out << fmt::format("  {}: {} images, {} to train, {} held out ({})\n", plan.facts.value("kind", "capture"),
                       plan.facts.value("n_images", 0), plan.facts.value("n_train", 0), plan.facts.value("n_test", 0),
                       plan.facts.value("split_rule", ""));
    if (const int n_masks = plan.facts.value("n_masks", 0); n_masks > 0) {
      out << fmt::format("  masks of {} of them\n", n_masks);
    }
    if (const int n_videos = plan.facts.value("n_videos", 0); n_videos > 0) {
      out << fmt::format("  and frames of {} video{}, chosen when ingest runs\n", n_videos, n_videos == 1 ? "" : "s");
    }
    if (const std::string text = ExtensionText(plan.extension); !text.empty()) out << "  " << text << '\n';
    for (size_t i = 0; i < plan.nodes.size(); ++i) {
      const Verdict& verdict = plan.verdicts[i];
      out << fmt::format("  {:<7}{:<8}{}\n", StateText(verdict.state), plan.nodes[i].stage, verdict.reason);
    }
    const bool trains =
        std::any_of(plan.nodes.begin(), plan.nodes.end(), [](const Node& node) { return node.stage == "train"; });
    if (trains) out << "  " << TrainingText(plan) << '\n';
    if (trains && plan.extension.at("extension").is_object()) {
      out << "  of that a training that goes on takes the added views' share, a quarter at least\n";
    }
    if (explained) {
      out << DecisionTable(plan, *explained);
      continue;
    }
    for (const Decision& decision : plan.decisions) {
      const bool forced = ForcedDecision(plan.request, decision.feature).has_value();
      if (!decision.needed || forced) out << "  " << DecisionText(decision) << '\n';
    }
    if (!plan.undecided.empty()) {
      out << fmt::format("  decided on the way, from what is measured then: {}\n", fmt::join(plan.undecided, ", "));
    }
  }
}

Json PlansToJson(const std::vector<BranchPlan>& plans) {
  Json captures = Json::array();
  for (const BranchPlan& plan : plans) {
    Json nodes = Json::array();
    for (size_t i = 0; i < plan.nodes.size(); ++i) {
      const Node& node = plan.nodes[i];
      Json command = Json::array();
      for (const std::string& argument : node.command) command.push_back(EscapePath(argument));
      nodes.push_back({{"stage", node.stage},
                       {"state", StateText(plan.verdicts[i].state)},
                       {"reason", plan.verdicts[i].reason},
                       {"inputs", node.inputs},
                       {"command", command}});
    }
    Json capture = {{"name", plan.request.name},
                    {"capture", EscapePath(plan.request.capture)},
                    {"workspace", EscapePath(plan.request.workspace.root())},
                    {"facts", plan.facts},
                    {"nodes", nodes},
                    {"extension", plan.extension},
                    {"training", plan.training},
                    {"decisions", plan.decisions},
                    {"undecided", plan.undecided}};
    if (!plan.error.empty()) capture["error"] = plan.error;
    captures.push_back(std::move(capture));
  }
  return {{"captures", captures}};
}

void PlanAndPrint(const std::vector<BranchRequest>& requests, bool json, bool explain) {
  LocalExecutor executor;
  std::vector<BranchPlan> plans;
  for (const BranchRequest& request : requests) {
    plans.push_back(PlanBranch(request, executor));
    if (executor.StopSignal() != 0) throw Error(static_cast<ExitCode>(128 + executor.StopSignal()), "was stopped");
  }
  if (json) {
    PrintJson(PlansToJson(plans));
  } else if (plans.size() > 1 || plans.front().error.empty()) {
    constexpr int kColumnsOfFiles = 120;
    const int columns = TerminalColumns(STDOUT_FILENO);
    PrintPlans(plans, explain ? std::optional(columns > 0 ? columns : kColumnsOfFiles) : std::nullopt, std::cout);
  }
  ThrowIfUnplanned(plans);
}

Command AddPlanCommand(CLI::App& app) {
  struct Options {
    BranchOptions branch;
    OutputOptions output;
    bool explain = false;
  };
  auto options = std::make_shared<Options>();
  CLI::App* command = app.add_subcommand("plan", "What a run would do, and why");
  AddTargetOption(*command, options->branch);
  AddBranchOptions(*command, options->branch);
  AddJsonOption(*command, options->output);
  command->add_flag("--explain", options->explain, "All decisions: by what, with which bound, why")->excludes("--json");
  command->footer(kFeaturesHelp + std::string("Example: nrff plan photos/ --preset small --explain"));
  return {command, [options] { PlanAndPrint(MakeBranches(options->branch), options->output.json, options->explain); }};
}

}  // namespace nrff
