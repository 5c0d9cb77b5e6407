#include "pipeline/graph.h"

#include <algorithm>
#include <set>
#include <stdexcept>

#include "pipeline/error.h"
#include "pipeline/files.h"

namespace nrff {
namespace {

std::string ValueOf(const Params& params, const std::string& name) {
  const auto found = params.find(name);
  return found == params.end() ? "the default" : found->second;
}

std::string WhyParamsDiffer(const Params& recorded, const Params& wanted) {
  std::set<std::string> names;
  for (const auto& [name, value] : recorded) names.insert(name);
  for (const auto& [name, value] : wanted) names.insert(name);
  for (const std::string& name : names) {
    const std::string before = ValueOf(recorded, name), now = ValueOf(wanted, name);
    if (before != now) return "was made with --" + name + " " + before + ", now it is " + now;
  }
  return {};
}

}  // namespace

void Graph::Add(Node node) {
  for (const std::string& input : node.inputs) {
    if (!index_.contains(input)) throw std::logic_error(node.id() + " reads the unknown node " + input);
  }
  if (!index_.emplace(node.id(), static_cast<int>(nodes_.size())).second) {
    throw std::logic_error("two nodes are called " + node.id());
  }
  nodes_.push_back(std::move(node));
}

const ArtifactState& Graph::Artifact(const Node& node) {
  auto found = artifacts_.find(node.artifact);
  if (found == artifacts_.end()) found = artifacts_.emplace(node.artifact, disk_.ReadArtifact(node.artifact)).first;
  return found->second;
}

const std::string& Graph::SourceHash(const std::filesystem::path& source) {
  auto found = sources_.find(source);
  if (found == sources_.end()) found = sources_.emplace(source, disk_.HashSource(source)).first;
  return found->second;
}

std::string Graph::WhyInputsDiffer(const Node& node, const Manifest& manifest) {
  // Artifacts are known by content alone, so that a workspace can be moved; a capture also by its place, since the
  // artifacts made from it name it.
  std::multiset<std::string> recorded;
  for (const HashedPath& input : manifest.inputs) recorded.insert(input.hash);
  if (!node.source.empty()) {
    if (manifest.inputs.empty()) return "does not name the capture it was made from";
    const HashedPath& capture = manifest.inputs.front();
    const std::string path = EscapePath(node.source);
    if (capture.path != path) return "was made from " + capture.path + ", now it is " + path;
    try {
      if (capture.hash != SourceHash(node.source)) return "was made before files in the capture changed";
    } catch (const Error& error) {
      return std::string("cannot be compared with its capture: ") + error.what();
    }
    recorded.erase(recorded.find(capture.hash));
  }
  for (const std::filesystem::path& base : node.bases) {
    const auto found = recorded.find(SourceHash(base));
    if (found == recorded.end()) return "does not extend what there was of fewer photos";
    recorded.erase(found);
  }
  for (const std::string& input : node.inputs) {
    const Node& producer = nodes_[index_.at(input)];
    const ArtifactState& state = Artifact(producer);
    if (!state.manifest) return "was made from an artifact of " + producer.stage + " that " + state.problem;
    const auto found = recorded.find(state.manifest->ContentHash());
    if (found == recorded.end()) return "was made from another " + producer.stage;
    recorded.erase(found);
  }
  return recorded.empty() ? std::string() : "was made from something that is no longer an input";
}

std::string Graph::WhyStale(const Node& node) {
  const ArtifactState& state = Artifact(node);
  if (!state.manifest) return state.problem;
  const Manifest& manifest = *state.manifest;
  if (manifest.kind != node.stage) return "is an artifact of the stage " + manifest.kind;
  if (manifest.version != version_) return "was made by version " + manifest.version + ", this is " + version_;
  const std::string params_differ = WhyParamsDiffer(manifest.params, node.params);
  return params_differ.empty() ? WhyInputsDiffer(node, manifest) : params_differ;
}

Verdict Graph::Examine(const Node& node) {
  if (node.when == When::kNever && Artifact(node).manifest) return {};
  const std::string why_stale = WhyStale(node);
  if (!why_stale.empty()) return {Verdict::kStale, why_stale};
  if (node.when == When::kAlways) return {Verdict::kStale, "was asked to run again"};
  return {};
}

std::vector<Verdict> Graph::Plan(const std::function<Json(const Node&)>& foresee) {
  std::vector<Verdict> verdicts;
  for (size_t i = 0; i < nodes_.size(); ++i) {  // grows while nodes are expanded
    const Node& node = nodes_[i];
    const auto runs_first = std::find_if(node.inputs.begin(), node.inputs.end(), [&](const std::string& input) {
      return verdicts[index_.at(input)].state != Verdict::kFresh;
    });
    Verdict verdict = Examine(node);
    const bool input_may_change = runs_first != node.inputs.end() && node.when != When::kNever;
    if (verdict.state == Verdict::kFresh && input_may_change) {
      const std::string& input = nodes_[index_.at(*runs_first)].stage;
      verdict = {Verdict::kUndecided, "runs after " + input + " if that comes out different"};
    }
    verdicts.push_back(verdict);
    if (!node.expand) continue;
    const Json facts = verdict.state == Verdict::kFresh ? Artifact(node).manifest->facts : foresee(node);
    for (Node& next : node.expand(facts)) Add(std::move(next));
  }
  return verdicts;
}

}  // namespace nrff
