#include "pipeline/plan_table.h"

#include <fmt/format.h>

#include <algorithm>
#include <sstream>
#include <vector>

#include "pipeline/stages.h"

namespace nrff {
namespace {

constexpr int kFewestColumns = 60, kIndent = 2, kUseWidth = 10;

int Characters(const std::string& text) {
  return int(
      std::count_if(text.begin(), text.end(), [](char c) { return (static_cast<unsigned char>(c) & 0xC0) != 0x80; }));
}

std::vector<std::string> Wrapped(const std::string& text, int width) {
  std::vector<std::string> lines(1);
  std::istringstream words(text);
  for (std::string word; words >> word;) {
    std::string& line = lines.back();
    if (line.empty()) {
      line = word;
    } else if (Characters(line) + 1 + Characters(word) <= width) {
      line += " " + word;
    } else {
      lines.push_back(word);
    }
  }
  return lines;
}

struct Row {
  std::string use, feature, text;
};

std::string Text(const Decision& decision) {
  std::string text = decision.evidence;
  if (!decision.threshold.empty()) text += " (bound: " + decision.threshold + ")";
  if (!decision.reason.empty()) text += ": " + decision.reason;
  return text;
}

std::vector<Row> Rows(const BranchPlan& plan) {
  const auto marked = [](const std::string& feature) {
    const bool forceable = std::any_of(Forceables().begin(), Forceables().end(),
                                       [&](const Forceable& other) { return feature == other.feature; });
    return feature + (forceable ? "*" : "");
  };
  std::vector<Row> rows;
  for (const bool needed : {true, false}) {
    for (const Decision& decision : plan.decisions) {
      if (decision.needed == needed)
        rows.push_back({needed ? "needed" : "left out", marked(decision.feature), Text(decision)});
    }
  }
  for (const std::string& feature : plan.undecided)
    rows.push_back({"open", marked(feature), "decided on the way, from what is measured then"});
  return rows;
}

}  // namespace

std::string DecisionTable(const BranchPlan& plan, int columns) {
  const std::vector<Row> rows = Rows(plan);
  int feature_width = 0;
  for (const Row& row : rows) feature_width = std::max(feature_width, Characters(row.feature));
  const int before = kIndent + kUseWidth + feature_width + 2;
  const int width = std::max(kFewestColumns, columns) - before;
  std::string table;
  for (const Row& row : rows) {
    const std::vector<std::string> lines = Wrapped(row.text, width);
    table += fmt::format("{:{}}{:<{}}{:<{}}  {}\n", "", kIndent, row.use, kUseWidth, row.feature, feature_width,
                         lines.front());
    for (size_t i = 1; i < lines.size(); ++i) table += std::string(size_t(before), ' ') + lines[i] + "\n";
  }
  return table + "  * --need and --leave-out decide otherwise\n";
}

}  // namespace nrff
