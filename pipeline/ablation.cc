#include "pipeline/ablation.h"

#include <fmt/chrono.h>
#include <fmt/format.h>

#include <algorithm>
#include <ctime>
#include <map>
#include <optional>
#include <utility>
#include <vector>

#include "pipeline/branches.h"
#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/manifest.h"
#include "pipeline/markdown.h"
#include "pipeline/report_page.h"
#include "pipeline/report_summary.h"
#include "pipeline/trainings.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr int kAblationSchemaVersion = 1;
constexpr char kFolder[] = "ablation";
constexpr char kRee[] = "mtd-ree";  // the variant's name

struct Variant {
  std::string name, label, settings;
  std::optional<double> published;  // dB
  bool own = false;
};

struct Group {
  std::string name, title, note, published;
  std::vector<Variant> variants;
};

// The trained model's grid.
struct Grid {
  int levels, base, max;
  bool operator==(const Grid&) const = default;
};

std::string Settings(const Grid& grid) {
  return fmt::format("field.levels={} field.base_resolution={} field.max_resolution={}", grid.levels, grid.base,
                     grid.max);
}

std::string Encoding(const char* name) { return fmt::format(" field.directional_encoding=\"{}\"", name); }

std::string Mtd(const Grid& grid, const char* encoding) {
  return Settings(grid) + " field.decoded_features=0" + Encoding(encoding);
}

Group Parts(const Grid& own, const std::string& own_name) {
  constexpr int kTensorfVoxels = 300;  // an axis, where TensoRF's grids end
  const Grid single{1, std::min(own.max, kTensorfVoxels), std::min(own.max, kTensorfVoxels)};
  const std::string vector_matrix =
      Settings(single) + " field.density_channels=16 field.appearance_channels=48" + Encoding("pe");
  Group group{
      "parts",
      "Grids and directional encodings",
      fmt::format("Vector-matrix grids have TensoRF's channels (16 for density, 48 for appearance) at one scale of "
                  "{0} nodes; decoded, a linear layer makes 27 features of theirs. MTD is the model's own grid. The "
                  "networks have the same widths and depths in all rows, but for no specular, which has no directional "
                  "one. PE: positional encoding of the ray's direction; IDE: "
                  "integrated directional encoding of the reflected one; no specular: the diffuse colour alone.",
                  single.max),
      "NeRF-synthetic, mean of 8 scenes at 800 px, 60,000 steps of the full model [Han23]",
      {{"vm-decoded-pe", "vector-matrix, decoded + PE", vector_matrix + " field.decoded_features=27", {}},
       {"vm-pe", "vector-matrix + PE", vector_matrix + " field.decoded_features=0", 34.10},
       {"mtd-none", "MTD, no specular", Mtd(own, "none"), 33.53},
       {"mtd-pe", "MTD + PE", Mtd(own, "pe"), 34.58},
       {"mtd-ide", "MTD + IDE", Mtd(own, "ide"), 34.61},
       {kRee, "MTD + REE", Mtd(own, "ree"), 35.02}}};
  for (Variant& variant : group.variants) variant.own = variant.name == own_name;
  return group;
}

Group Levels(const Grid& own, const std::string& own_name) {
  Group group{"levels",
              "Levels",
              fmt::format("From {} to {} nodes, a single level at {}; nothing else changes, so that fewer levels are "
                          "also fewer features; REE.",
                          own.base, own.max, own.max),
              "ship of NeRF-synthetic [Han23]",
              {}};
  std::vector<int> levels = {1, 2, 4, 8, 16};
  if (own.levels > 1) levels.push_back(own.levels);
  std::sort(levels.begin(), levels.end());
  levels.erase(std::unique(levels.begin(), levels.end()), levels.end());
  for (const int n : levels) {
    const Grid grid{n, n == 1 ? own.max : own.base, own.max};
    const std::optional<double> published = n == 1    ? std::optional(31.3)
                                            : n == 2  ? std::optional(32.3)
                                            : n == 16 ? std::optional(33.2)
                                                      : std::nullopt;
    // The model's own levels are a row of the parts, too, and are trained once.
    group.variants.push_back({grid == own ? kRee : fmt::format("levels-{}", n),
                              fmt::format("{} level{}", n, n == 1 ? "" : "s"), Mtd(grid, "ree"), published,
                              grid == own && own_name == kRee});
  }
  return group;
}

}  // namespace

Json MeasureAblation(const Workspace& workspace, const AblationOptions& options, Verbosity verbosity) {
  const BranchRequest scene = BranchOf(workspace);
  const WorkspaceLock lock(workspace);
  const std::string where = "train's manifest";
  const Json facts = workspace.Require("train").facts;
  const Json field = Get<Json>(Get<Json>(facts, "settings", where), "field", where);
  const Grid own{Get<int>(field, "levels", where), Get<int>(field, "base_resolution", where),
                 Get<int>(field, "max_resolution", where)};
  // Models of 0.2 do not name these.
  const Json &encoding = At(field, "directional_encoding"), &decoded = At(field, "decoded_features");
  const bool plain = !decoded.is_number() || decoded == 0;
  const std::string own_name = plain ? "mtd-" + (encoding.is_string() ? encoding.get<std::string>() : "ree") : "";
  const std::vector<Group> groups = {Parts(own, own_name), Levels(own, own_name)};
  const int64_t steps = options.steps > 0 ? options.steps : Get<int64_t>(facts, "steps", where);
  const auto preset = Get<std::string>(facts, "preset", where);

  const fs::path folder = workspace.root() / kFolder;
  std::vector<BranchRequest> requests;
  std::map<std::string, size_t> first;  // request of a variant, by its name
  for (const Group& group : groups) {
    for (const Variant& variant : group.variants) {
      if (!first.try_emplace(variant.name, requests.size()).second) continue;
      for (int seed = 0; seed < options.n_seeds; ++seed) {
        BranchRequest request = TrainingBeside(scene, folder / fmt::format("{}-seed{}", variant.name, seed));
        std::string& settings = request.options["set"];
        settings += (settings.empty() ? "" : " ") + variant.settings;
        request.options.erase("directional");
        request.options["preset"] = preset;
        request.options["steps"] = std::to_string(steps);
        request.options["seed"] = std::to_string(seed);
        requests.push_back(std::move(request));
      }
    }
  }
  RunTrainings(scene, requests, verbosity);

  Json result = {{"schema_version", kAblationSchemaVersion},
                 {"name", ReadWorkspace(workspace.root()).name},
                 {"steps", steps},
                 {"seeds", options.n_seeds},
                 {"preset", preset},
                 {"groups", Json::array()},
                 {"width", At(workspace.Require("pose").facts, "width")},
                 {"height", At(workspace.Require("pose").facts, "height")},
                 {"host", ThisHost()},
                 {"version", Version()},
                 {"date", fmt::format("{:%Y-%m-%d}", fmt::gmtime(std::time(nullptr)))}};
  for (const Group& group : groups) {
    Json rows = Json::array();
    for (const Variant& variant : group.variants) {
      std::vector<Json> runs;
      runs.reserve(size_t(options.n_seeds));
      for (int seed = 0; seed < options.n_seeds; ++seed) {
        runs.push_back(TrainingRow(folder, requests[first.at(variant.name) + seed]));
      }
      Json row = {{"name", variant.name},         {"label", variant.label},
                  {"settings", variant.settings}, {"published", variant.published ? Json(*variant.published) : Json()},
                  {"own", variant.own},           {"runs", runs}};
      for (const char* key : {"psnr", "ssim", "lpips", "seconds", "seconds_per_view", "n_parameters"}) {
        row[key] = Band(runs, key);
      }
      rows.push_back(row);
    }
    result["groups"].push_back({{"name", group.name},
                                {"title", group.title},
                                {"note", group.note},
                                {"published", group.published},
                                {"rows", rows}});
  }
  WriteJson(folder / "ablation.json", result);
  WriteFileAtomically(folder / "ablation.md", AblationMarkdown(result));
  WriteFileAtomically(folder / "ablation.html", FillPage("ablation.html", result["name"].get<std::string>(), result));
  return result;
}

std::string AblationMarkdown(const Json& result) {
  const auto n_seeds = result.at("seeds").get<int>();
  std::string text = fmt::format(
      "# What each part is worth: {0}\n\nnrff {1}, {2}, {3}. Command: `nrff benchmark ablation WORKSPACE --steps {5} "
      "--seeds {6}`. Preset {4}, {8} × {9} px, {5} steps each{7}; figures are means over all held-out views, renders "
      "of 16 bits; seconds are of training alone. Bold: the model as it is.\n",
      CellText(result.at("name")), CellText(result.at("version")), CellText(At(result.at("host"), "cpu")),
      CellText(result.at("date")), CellText(result.at("preset")), result.at("steps").get<int64_t>(), n_seeds,
      n_seeds > 1 ? fmt::format(", {} seeds (in brackets the least and the most)", n_seeds) : "",
      Figure(result.at("width"), "{:.0f}"), Figure(result.at("height"), "{:.0f}"));
  for (const Json& group : result.at("groups")) {
    text += fmt::format(
        "\n## {}\n\n{} Published: {}.\n\n"
        "| model | PSNR, dB | SSIM | LPIPS | parameters | training, s | s a view | published, dB |\n"
        "|---|---:|---:|---:|---:|---:|---:|---:|\n",
        group.at("title").get<std::string>(), group.at("note").get<std::string>(),
        group.at("published").get<std::string>());
    for (const Json& row : group.at("rows")) {
      const std::string mark = row.at("own").get<bool>() ? "**" : "";
      text += fmt::format("| {0}{1}{0} | {2} | {3} | {4} | {5} | {6} | {7} | {8} |\n", mark, CellText(row.at("label")),
                          BandText(row.at("psnr"), "{:.2f}"), BandText(row.at("ssim"), "{:.4f}"),
                          BandText(row.at("lpips"), "{:.4f}"), BandText(row.at("n_parameters"), "{:.0f}"),
                          BandText(row.at("seconds"), "{:.1f}"), BandText(row.at("seconds_per_view"), "{:.3f}"),
                          Figure(row.at("published"), "{:.2f}"));
    }
  }
  return text;
}

}  // namespace nrff
