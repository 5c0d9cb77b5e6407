#include "pipeline/benchmark.h"

#include <fmt/chrono.h>
#include <fmt/format.h>

#include <algorithm>
#include <ctime>
#include <map>

#include "pipeline/error.h"
#include "pipeline/files.h"
#include "pipeline/manifest.h"
#include "pipeline/markdown.h"
#include "pipeline/report_content.h"
#include "pipeline/report_page.h"
#include "pipeline/report_summary.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr int kBenchmarkSchemaVersion = 1;

Json PeakMemory(const Json& stages) {
  for (const Json& stage : stages) {
    if (stage.at("name") == "train") return stage.at("peak_memory_bytes");
  }
  return nullptr;
}

Json SceneRow(const DataSet& data_set, const fs::path& folder, const fs::path& workspace) {
  const WorkspaceState state = ReadWorkspace(workspace);
  const Json summary = Summarise(state);
  const Json &metrics = summary["metrics"], &training = summary["training"], &render = state.Facts("render");
  const std::string place = EscapePath(fs::proximate(state.root, fs::absolute(folder)));
  return {{"name", state.name},
          {"published", !PublishedScene(data_set, state.name).empty()},
          {"workspace", place},
          {"report", fs::exists(state.root / "report" / "report.html") ? Json(place + "/report/report.html") : Json()},
          {"status", summary["status"]},
          {"failure", summary["failure"]},
          {"psnr", metrics["psnr"]},
          {"ssim", metrics["ssim"]},
          {"lpips", metrics["lpips"]},
          {"lpips_reason", At(metrics, "lpips_reason")},
          {"variants", At(metrics, "variants")},
          {"n_images", metrics["n_images"]},
          {"split_rule", summary["split"]["rule"]},
          {"protocol", summary["protocol"]},
          {"width", At(state.Facts("pose"), "width")},
          {"height", At(state.Facts("pose"), "height")},
          {"photo_width", At(state.Facts("ingest"), "width")},
          {"photo_height", At(state.Facts("ingest"), "height")},
          {"training_seconds", training["seconds"]},
          {"steps", training["steps"]},
          {"preset", training["preset"]},
          {"device", training["device"]},
          {"seconds_per_view", At(render, "seconds_per_view")},
          {"samples_per_ray", At(render, "samples_per_ray")},
          {"model_bytes", training["model_bytes"]},
          {"peak_memory_bytes", PeakMemory(summary["stages"])},
          {"host", summary["host"]}};
}

// Mean of what `get` finds in the rows; null where it finds nothing.
template <typename Find>
Json MeanOf(const Json& rows, const Find& find) {
  double sum = 0;
  int n = 0;
  for (const Json& row : rows) {
    const Json& value = find(row);
    if (value.is_number()) sum += value.get<double>(), ++n;
  }
  return n == 0 ? Json() : Json(sum / n);
}

Json Mean(const Json& rows) {
  Json mean = {{"n_scenes",
                std::count_if(rows.begin(), rows.end(), [](const Json& row) { return row.at("psnr").is_number(); })}};
  for (const char* key : {"psnr", "ssim", "lpips", "training_seconds", "seconds_per_view"}) {
    mean[key] = MeanOf(rows, [&](const Json& row) -> const Json& { return At(row, key); });
  }
  for (const char* key : {"psnr_pooled", "psnr_quantised", "psnr_foreground"}) {
    mean["variants"][key] = MeanOf(rows, [&](const Json& row) -> const Json& { return At(At(row, "variants"), key); });
  }
  return mean;
}

Json MissingScenes(const DataSet& data_set, const Json& rows) {
  Json missing = Json::array();
  for (const std::string& scene : data_set.scenes) {
    const bool there = std::any_of(rows.begin(), rows.end(), [&](const Json& row) {
      return PublishedScene(data_set, row.at("name").get<std::string>()) == scene;
    });
    if (!there) missing.push_back(scene);
  }
  return missing;
}

std::string Joined(const Json& texts) {
  std::string all;
  for (const Json& text : texts) all += (all.empty() ? "" : ", ") + text.get<std::string>();
  return all;
}

// "a (x, y), b (z)": which scenes have which value of what `text` makes of a row; nothing for empty texts.
template <typename Text>
std::string ByScene(const Json& rows, const Text& text) {
  std::map<std::string, Json> scenes;
  for (const Json& row : rows) {
    const std::string value = text(row);
    if (!value.empty()) scenes[value].push_back(row.at("name"));
  }
  std::string all;
  for (const auto& [value, names] : scenes) {
    all += (all.empty() ? "" : "; ") + value;
    if (names.size() < rows.size()) all += " (" + Joined(names) + ")";
  }
  return all;
}

std::string SizeOf(const Json& row, const char* width, const char* height) {
  if (!row.at(width).is_number() || !row.at(height).is_number()) return {};
  return fmt::format("{} × {}", row.at(width).get<int>(), row.at(height).get<int>());
}

Json Differences(const DataSet& data_set, const Json& rows, const Json& missing) {
  Json differences = Json::array();
  const bool compared = !data_set.published.empty();
  const auto add = [&](const std::string& text) { differences.push_back(text); };
  const auto add_beside = [&](const std::string& ours, const std::string& published) {
    add(ours + (compared ? "; published: " + published : std::string()) + ".");
  };
  if (!missing.empty()) {
    add(fmt::format("Scenes: {} of the {} that the published means are over are not here ({}).", missing.size(),
                    data_set.scenes.size(), Joined(missing)));
  }
  Json others = Json::array();
  for (const Json& row : rows) {
    if (!row.at("published").get<bool>()) others.push_back(row.at("name"));
  }
  if (compared && !others.empty()) add(fmt::format("Scenes: the published means are not over {}.", Joined(others)));

  const std::string published_size = fmt::format("{} × {}", data_set.width, data_set.height);
  const std::string sizes = ByScene(rows, [&](const Json& row) {
    const std::string size = SizeOf(row, "width", "height"), photo = SizeOf(row, "photo_width", "photo_height");
    if (size == published_size || size.empty()) return std::string();
    return size == photo ? size : fmt::format("{}, area average of {}", size, photo);
  });
  if (!sizes.empty()) add_beside("Size in px: " + sizes, published_size);

  const std::string models = ByScene(rows, [](const Json& row) {
    if (!row.at("training_seconds").is_number() || !row.at("preset").is_string()) return std::string();
    return fmt::format("preset {}, {} steps in {:.1f} s on {}", row.at("preset").get<std::string>(),
                       row.at("steps").get<int>(), row.at("training_seconds").get<double>(),
                       row.at("device") == "cuda" ? "a GPU" : "the CPU");
  });
  if (!models.empty()) add_beside("Training: " + models, "as in the table, each with its full model");

  const std::string splits = ByScene(rows, [](const Json& row) {
    if (!row.at("split_rule").is_string() || row.at("n_images") == 0) return std::string();
    return fmt::format("{} images, {}", row.at("n_images").get<int>(), row.at("split_rule").get<std::string>());
  });
  add_beside("Held out: " + (splits.empty() ? "nothing yet" : splits), data_set.split);

  const std::string background = ByScene(rows, [&](const Json& row) {
    const Json& shown = At(row.at("protocol"), "background");
    const bool differs = shown.is_string() && shown != "none" && shown != data_set.background;  // none: no alpha
    return differs ? shown.get<std::string>() : std::string();
  });
  if (!background.empty()) {
    add_beside("Background behind alpha: " + background, data_set.background);
  }
  const std::string bits = ByScene(rows, [](const Json& row) {
    const Json& stored = At(row.at("protocol"), "bits");
    return stored.is_object() ? fmt::format("photos of {} bits, renders of {}", stored.at("truth").get<int>(),
                                            stored.at("rendered").get<int>())
                              : std::string();
  });
  if (!bits.empty()) {
    add(
        fmt::format("PSNR: {}, per image, then the mean; the code of NRFF and TensoRF compares floats, nerfbaselines "
                    "images of 8 bits.",
                    bits));
  }
  const std::string machines = ByScene(rows, [](const Json& row) {
    const Json& cpu = At(row.at("host"), "cpu");
    return cpu.is_string() ? cpu.get<std::string>() : std::string();
  });
  if (machines.find(';') != std::string::npos) add("Machines: " + machines + ".");
  add("SSIM: RGB, 11 × 11 Gaussian of σ 1.5, windows inside the image, as the code of NRFF and TensoRF computes it.");
  const std::string lpips = ByScene(rows, [](const Json& row) {
    const Json& network = At(row.at("protocol"), "lpips");
    if (network.is_object()) {
      return fmt::format("{} {}", network.at("network").get<std::string>(), network.at("version").get<std::string>());
    }
    return row.at("lpips_reason").is_string() ? "not measured, since " + row.at("lpips_reason").get<std::string>()
                                              : std::string();
  });
  if (!lpips.empty()) add_beside("LPIPS: " + lpips, "VGG");
  return differences;
}

std::string Figures(const Json& row) {
  return fmt::format("{} | {} | {}", Figure(At(row, "psnr"), "{:.2f}"), Figure(At(row, "ssim"), "{:.3f}"),
                     Figure(At(row, "lpips"), "{:.3f}"));
}

std::string Variants(const Json& row) {
  const Json& variants = At(row, "variants");
  return fmt::format("{} | {} | {}", Figure(At(variants, "psnr_pooled"), "{:.2f}"),
                     Figure(At(variants, "psnr_quantised"), "{:.2f}"),
                     Figure(At(variants, "psnr_foreground"), "{:.2f}"));
}

std::string PublishedText(const Json& table) {
  std::string text = fmt::format(
      "Published, means over {}:\n\n| method | PSNR, dB | SSIM | LPIPS | training | source |\n"
      "|---|---:|---:|---:|---|---|\n",
      Joined(table.at("data_set").at("scenes")));
  for (const Json& row : table.at("published")) {
    text += fmt::format("| {} | {} | {} | {} |\n", CellText(row.at("method")), Figures(row),
                        CellText(row.at("training")), CellText(row.at("source")));
  }
  return text + "\n";
}

}  // namespace

Json BenchmarkTable(const DataSet& data_set, const fs::path& folder, const std::vector<fs::path>& workspaces,
                    const std::string& command) {
  Json rows = Json::array(), published = Json::array(), host;
  for (const fs::path& workspace : workspaces) rows.push_back(SceneRow(data_set, folder, workspace));
  for (const PublishedResult& result : data_set.published) {
    published.push_back({{"method", result.method},
                         {"psnr", result.psnr},
                         {"ssim", result.ssim ? Json(*result.ssim) : Json()},
                         {"lpips", result.lpips ? Json(*result.lpips) : Json()},
                         {"training", result.training},
                         {"source", result.source}});
  }
  const Json missing = MissingScenes(data_set, rows);
  const Json differences = Differences(data_set, rows, missing);
  for (Json& row : rows) {
    if (host.is_null()) host = row["host"];
    row.erase("host");
  }
  return {{"schema_version", kBenchmarkSchemaVersion},
          {"data_set",
           {{"name", data_set.name},
            {"title", data_set.title},
            {"scenes", data_set.scenes},
            {"width", data_set.width},
            {"height", data_set.height},
            {"split", data_set.split},
            {"background", data_set.background}}},
          {"scenes", rows},
          {"missing", missing},
          {"mean", Mean(rows)},
          {"published", published},
          {"differences", differences},
          {"command", command},
          {"host", host},
          {"version", Version()},
          {"date", fmt::format("{:%Y-%m-%d}", fmt::gmtime(std::time(nullptr)))}};
}

std::string BenchmarkMarkdown(const Json& table) {
  const Json& data_set = table.at("data_set");
  std::string text = fmt::format("# {}\n\nnrff {}, {}, {}. Command: `{}`.\n\n", data_set.at("title").get<std::string>(),
                                 CellText(table.at("version")), CellText(At(table.at("host"), "cpu")),
                                 CellText(table.at("date")), table.at("command").get<std::string>());
  text +=
      "| scene | PSNR, dB | SSIM | LPIPS | images | px | training, s | steps | preset | s a view |\n"
      "|---|---:|---:|---:|---:|---:|---:|---:|---|---:|\n";
  for (const Json& row : table.at("scenes")) {
    const std::string name = CellText(row.at("name"));
    if (row.at("status") == "failed") {
      text += fmt::format("| {} | failed: {} |||||||||\n", name, CellText(At(row.at("failure"), "error")));
      continue;
    }
    text += fmt::format("| {} | {} | {} | {} | {} | {} | {} | {} |\n", name, Figures(row),
                        Figure(row.at("n_images"), "{:.0f}"), SizeOf(row, "width", "height"),
                        Figure(row.at("training_seconds"), "{:.1f}"), Figure(row.at("steps"), "{:.0f}"),
                        CellText(row.at("preset")), Figure(row.at("seconds_per_view"), "{:.3f}"));
  }
  const Json& mean = table.at("mean");
  text += fmt::format("| **mean of {}** | {} | | | {} | | | {} |\n\n", mean.at("n_scenes").get<int>(), Figures(mean),
                      Figure(mean.at("training_seconds"), "{:.1f}"), Figure(mean.at("seconds_per_view"), "{:.3f}"));
  if (!table.at("published").empty()) text += PublishedText(table);
  text += table.at("published").empty() ? "How the figures were made:\n\n"
                                        : "What differs, and how the figures were made:\n\n";
  for (const Json& difference : table.at("differences")) text += "- " + CellText(difference) + "\n";
  text +=
      "\nThe same as other projects print it, PSNR in dB: of the mean squared error over all images; of images rounded "
      "to 8 bits; over the subject's pixels (alpha of a half or more).\n\n"
      "| scene | pooled | quantised | foreground |\n|---|---:|---:|---:|\n";
  for (const Json& row : table.at("scenes")) {
    text += fmt::format("| {} | {} |\n", CellText(row.at("name")), Variants(row));
  }
  return text + fmt::format("| **mean** | {} |\n", Variants(mean));
}

void WriteBenchmark(const fs::path& folder, const Json& table) {
  WriteJson(folder / "benchmark.json", table);
  WriteFileAtomically(folder / "benchmark.md", BenchmarkMarkdown(table));
  Json page = table;
  for (Json& row : page["scenes"]) {
    const WorkspaceState state = ReadWorkspace(folder / UnescapePath(row.at("workspace").get<std::string>()));
    try {
      row["picture"] = MedianPicture(state, Summarise(state)["images"]);
    } catch (const Error&) {
      row["picture"] = nullptr;  // a damaged file: the scene's own report says so
    }
  }
  WriteFileAtomically(folder / "benchmark.html",
                      FillPage("benchmark.html", table.at("data_set").at("title").get<std::string>(), page));
}

}  // namespace nrff
