// The graph of stages: what there is to make, from what, and why it has to be made again.
//
// A node is one (capture, stage): one command line, its parameters and the artifacts it reads. Its artifact is fresh
// when it is whole, was made by this version with these parameters, and the hashes of its inputs are the ones it
// recorded. Content decides, never time: a stage run again that writes the same bytes leaves what follows it fresh
// (early cut-off), which is why what follows a stale node is undecided until that node has run.
//
// A graph grows while it runs: a node's `expand` turns the facts it measured into the nodes that follow.
#pragma once

#include <deque>
#include <filesystem>
#include <functional>
#include <map>
#include <string>
#include <vector>

#include "pipeline/disk.h"
#include "pipeline/manifest.h"

namespace nrff {

enum class When {
  kIfStale,
  kAlways,
  kNever,  // taken as it is, whatever its inputs are now
};

struct Node {
  std::string branch;  // the capture's name, unique in the graph
  std::string stage;
  std::filesystem::path artifact;            // the directory it makes
  std::vector<std::string> command;          // program and arguments
  Params params;                             // what the manifest has to record
  std::vector<std::string> inputs;           // ids of nodes, added before this one
  std::filesystem::path source;              // the capture, for the node that reads it; else empty
  std::vector<std::filesystem::path> bases;  // of an earlier run, taken over: no node makes them, all files count
  std::filesystem::path log;                 // where what it prints is kept
  When when = When::kIfStale;
  int cores = 1;              // that it keeps busy
  uint64_t memory_bytes = 0;  // that it may need
  std::function<std::vector<Node>(const Json& facts)> expand;

  std::string id() const { return branch + "/" + stage; }
};

struct Verdict {
  enum State { kFresh, kStale, kUndecided };
  State state = kFresh;
  std::string reason;  // one line, to be read after the stage's name; empty when fresh
};

class Graph {
 public:
  // `version`: of this program; artifacts of another version are stale.
  Graph(Disk& disk, std::string version) : disk_(disk), version_(std::move(version)) {}

  // Nodes stay in the order they were added, inputs first. Throws std::logic_error on an unknown input or a known id.
  void Add(Node node);
  const std::deque<Node>& nodes() const { return nodes_; }
  int IndexOf(const std::string& id) const { return index_.at(id); }

  // Whether the node has to run, given that its inputs are settled. Throws CorruptError (Disk::ReadArtifact).
  Verdict Examine(const Node& node);
  // As Examine, but for what the artifact is, not for what was asked (`when`).
  std::string WhyStale(const Node& node);
  const ArtifactState& Artifact(const Node& node);
  // To be called when the node has run: what was known about its artifact no longer holds.
  void Forget(const Node& node) { artifacts_.erase(node.artifact); }

  // Examines every node as the disk is now; verdicts by index. Nodes are expanded with the facts of their artifact if
  // it is fresh, else with those `foresee` gives.
  std::vector<Verdict> Plan(const std::function<Json(const Node&)>& foresee);

 private:
  std::string WhyInputsDiffer(const Node& node, const Manifest& manifest);
  const std::string& SourceHash(const std::filesystem::path& source);

  Disk& disk_;
  std::string version_;
  std::deque<Node> nodes_;
  std::map<std::string, int> index_;
  std::map<std::filesystem::path, ArtifactState> artifacts_;
  std::map<std::filesystem::path, std::string> sources_;
};

}  // namespace nrff
