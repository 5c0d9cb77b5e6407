// work_precision.json as Markdown.
#include <fmt/format.h>

#include "pipeline/markdown.h"
#include "pipeline/report_summary.h"
#include "pipeline/work_precision.h"

namespace nrff {
namespace {

// "small", or "small 2, tiny 1" where the machine's speed decided differently from run to run.
std::string Presets(const Json& band) {
  std::string text;
  const Json& presets = At(band, "presets");
  for (const auto& [name, n_runs] : presets.items()) {
    text += fmt::format("{}{}{}", text.empty() ? "" : ", ", name,
                        presets.size() > 1 ? fmt::format(" {}", n_runs.get<int>()) : "");
  }
  return text.empty() ? "–" : text;
}

std::string TrainingText(const Json& training) {
  std::string text = fmt::format(
      "\n## Training\n\nSeconds are of training alone; figures are means over all held-out views, renders of 16 bits; "
      "in brackets the least and the most of {} seeds.\n\n"
      "| training, s | preset | PSNR, dB | SSIM | LPIPS | steps | density evaluations |\n"
      "|---:|---|---:|---:|---:|---:|---:|\n",
      training.at("seeds").get<int>());
  for (const Json& band : training.at("bands")) {
    text += fmt::format("| {} | {} | {} | {} | {} | {} | {} |\n", BandText(band.at("seconds"), "{:.1f}"), Presets(band),
                        BandText(band.at("psnr"), "{:.2f}"), BandText(band.at("ssim"), "{:.4f}"),
                        BandText(band.at("lpips"), "{:.4f}"), BandText(band.at("steps"), "{:.0f}"),
                        BandText(band.at("samples"), "{:.2e}"));
  }
  std::string reached;
  for (const Json& mark : training.at("time_to")) {
    if (!mark.at("seconds").is_number()) continue;
    reached += fmt::format("{}{:.0f} dB: {:.0f} s", reached.empty() ? "" : ", ", mark.at("psnr").get<double>(),
                           mark.at("seconds").get<double>());
  }
  return reached.empty() ? text : text + "\nShortest of these trainings that reaches " + reached + ".\n";
}

std::string RenderingText(const Json& rendering) {
  std::string text = fmt::format(
      "\n## Rendering\n\n{} held-out views of {} × {} px, {} threads. One setting is varied, nothing else is left out. "
      "The step's error is told from an eighth of the training's step ({} s a view), the others' from the same step "
      "with every sample shaded; PSNR is to the photos. Bold: the value that nrff-render uses; the last rows have them "
      "together.\n\n"
      "| setting | value | s a view | rms error | largest | samples a ray | shaded | PSNR, dB |\n"
      "|---|---:|---:|---:|---:|---:|---:|---:|\n",
      rendering.at("n_views").get<int>(), rendering.at("width").get<int>(), rendering.at("height").get<int>(),
      rendering.at("threads").get<int>(), Figure(rendering.at("reference_seconds"), "{:.2f}"));
  for (const Json& family : rendering.at("families")) {
    for (const Json& point : family.at("points")) {
      const char* bold = point.at("chosen").get<bool>() ? "**" : "";
      text += fmt::format("| {} | {}{}{} | {} | {} | {} | {} | {} | {} |\n", family.at("family").get<std::string>(),
                          bold, Figure(point.at("value"), "{:.3g}"), bold, Figure(point.at("seconds"), "{:.3f}"),
                          Figure(point.at("rmse"), "{:.2e}"), Figure(point.at("most"), "{:.2e}"),
                          Figure(point.at("samples_per_ray"), "{:.1f}"), Figure(point.at("shaded_per_ray"), "{:.2f}"),
                          Figure(point.at("psnr"), "{:.2f}"));
    }
  }
  return text;
}

std::string QuadratureText(const Json& quadrature) {
  std::string text =
      "\n## Transmittance\n\n|T − closed form| by samples a ray, optical thickness 4, float.\n\n| samples |";
  std::string rule = "\n|---:|";
  for (const Json& density : quadrature) {
    text += fmt::format(" {} |", density.at("density").get<std::string>());
    rule += "---:|";
  }
  text += rule;
  const Json& first = quadrature.at(0).at("points");
  for (size_t i = 0; i < first.size(); ++i) {
    text += fmt::format("\n| {} |", first.at(i).at("n_samples").get<int>());
    for (const Json& density : quadrature) {
      text += fmt::format(" {} |", Figure(density.at("points").at(i).at("error"), "{:.1e}"));
    }
  }
  return text + "\n";
}

std::string ScoringText(const Json& scoring) {
  std::string text =
      "\n## Scoring\n\nThe figures of up to eight held-out views on images shrunk by area averaging, and the seconds "
      "an "
      "image takes. Bold: what nrff-eval does.\n\n"
      "| px | PSNR, dB | SSIM | LPIPS | PSNR, s | SSIM, s | LPIPS, s |\n|---:|---:|---:|---:|---:|---:|---:|\n";
  for (const Json& point : scoring) {
    const char* bold = point.at("chosen").get<bool>() ? "**" : "";
    const Json& seconds = point.at("seconds");
    text += fmt::format("| {}{} × {}{} | {} | {} | {} | {} | {} | {} |\n", bold, point.at("width").get<int>(),
                        point.at("height").get<int>(), bold, Figure(point.at("psnr"), "{:.2f}"),
                        Figure(point.at("ssim"), "{:.4f}"), Figure(point.at("lpips"), "{:.4f}"),
                        Figure(seconds.at("psnr"), "{:.1e}"), Figure(seconds.at("ssim"), "{:.1e}"),
                        Figure(seconds.at("lpips"), "{:.1e}"));
  }
  return text;
}

std::string PosesText(const Json& poses) {
  if (poses.at("reason").is_string()) {
    return fmt::format("\n## Poses\n\nNot measured: {}.\n", poses.at("reason").get<std::string>());
  }
  std::string text =
      "\n## Poses\n\nEstimated from the photos alone and compared with the capture's own after a robust alignment; "
      "positions in % of the cameras' rms distance from their mean. AUC: area under the recall curve of relative poses "
      "up to 5°, photos without a pose counted as misses. Seconds are of COLMAP. Bold: what `nrff run` begins "
      "with for so many photos.\n\n"
      "| photos, px | features | matching | s | registered | position, % | rotation, ° | AUC to 5° |\n"
      "|---:|---:|---|---:|---:|---:|---:|---:|\n";
  for (const Json& point : poses.at("points")) {
    const char* bold = point.at("chosen").get<bool>() ? "**" : "";
    text += fmt::format("| {}{}{} | {}{}{} | {} | {} |", bold, point.at("image_size").get<int>(), bold, bold,
                        point.at("features").get<int>(), bold, point.at("matching").get<std::string>(),
                        Figure(point.at("seconds"), "{:.1f}"));
    if (point.at("error").is_string()) {
      const auto error = point.at("error").get<std::string>();
      text += fmt::format(" {} ||||\n", CellText(error.substr(0, error.find("; "))));
      continue;
    }
    const Json& errors = point.at("errors");
    text += fmt::format(" {} of {} | {} | {} | {} |\n", Figure(point.at("n_registered"), "{:.0f}"),
                        Figure(point.at("n_images"), "{:.0f}"),
                        Figure(Json(100 * errors.at("position").at("median").get<double>()), "{:.3f}"),
                        Figure(errors.at("rotation_deg").at("median"), "{:.3f}"),
                        Figure(errors.at("relative_deg").at("auc").at("5"), "{:.3f}"));
  }
  return text;
}

// The options that make the measurement again.
std::string Options(const Json& result) {
  std::string parts, budgets;
  for (const Json& part : result.at("parts")) parts += (parts.empty() ? "" : ",") + part.get<std::string>();
  const Json& training = result.at("training");
  if (!training.is_object()) return " --parts " + parts;
  for (const Json& budget : training.at("budgets")) {
    budgets += fmt::format("{}{}s", budgets.empty() ? "" : ",", budget.get<double>());
  }
  return fmt::format(" --parts {} --budgets {} --seeds {}", parts, budgets, training.at("seeds").get<int>());
}

}  // namespace

std::string WorkPrecisionMarkdown(const Json& result) {
  std::string text = fmt::format(
      "# Error against run time: {}\n\nnrff {}, {}, {}. Command: `nrff benchmark "
      "work-precision WORKSPACE{}`.\n",
      result.at("name").get<std::string>(), result.at("version").get<std::string>(),
      CellText(At(result.at("host"), "cpu")), result.at("date").get<std::string>(), Options(result));
  if (result.at("training").is_object()) text += TrainingText(result.at("training"));
  if (result.at("rendering").is_object()) text += RenderingText(result.at("rendering"));
  if (result.at("quadrature").is_array()) text += QuadratureText(result.at("quadrature"));
  if (result.at("scoring").is_array()) text += ScoringText(result.at("scoring"));
  if (result.at("poses").is_object()) text += PosesText(result.at("poses"));
  return text;
}

}  // namespace nrff
