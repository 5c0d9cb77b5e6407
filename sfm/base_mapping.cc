#include "sfm/base_mapping.h"

#include <cmath>
#include <utility>

#include "pipeline/extension.h"
#include "pipeline/files.h"
#include "pipeline/log.h"
#include "sfm/merged_model.h"

namespace nrff {
namespace {

namespace fs = std::filesystem;

constexpr char kDatabaseFile[] = "database.db", kModelFolder[] = "model", kExportedFolder[] = "exported",
               kSettingsFile[] = "settings.json";

// `before`: of the base's models the one that `now` is like.
MergedModel Compare(const BaseMapping& base, const ColmapModel& before, const Capture& capture, const ColmapModel& now,
                    const std::optional<WorldShift>& shift) {
  MergedModel merged;
  merged.n_earlier = base.photos.size();
  merged.n_added = capture.images.size() - merged.n_earlier;
  merged.n_earlier_placed = before.images.size();
  std::set<std::string> placed;
  for (const auto& [id, image] : now.images) {
    placed.insert(image.name);
    merged.n_added_placed += base.photos.contains(image.name) ? 0 : 1;
  }
  for (const auto& [id, image] : before.images) merged.n_lost += placed.contains(image.name) ? 0 : 1;
  merged.error_before_px = MeanError(before);
  merged.error_px = MeanError(now);
  if (shift) merged.shift_px = shift->median_px;
  return merged;
}

}  // namespace

void KeepMapping(const Attempt& attempt, const ColmapModel& shared, const ColmapModel* own_focal, const Json& asked,
                 const fs::path& dir) {
  fs::create_directories(dir / kModelFolder);
  fs::copy_file(attempt.database_file, dir / kDatabaseFile, fs::copy_options::overwrite_existing);
  WriteColmapBinary(shared, dir / kModelFolder);
  fs::remove_all(dir / kExportedFolder);  // of an interrupted run
  if (own_focal != nullptr) {
    fs::create_directories(dir / kExportedFolder);
    WriteColmapBinary(*own_focal, dir / kExportedFolder);
  }
  Json settings = ToJson(attempt.settings);
  settings["asked"] = asked;
  settings["photos"] = Json::array();
  for (const auto& [id, image] : attempt.database.images) settings["photos"].push_back(image.name);
  WriteJson(dir / kSettingsFile, settings);
}

std::optional<BaseMapping> ReadBaseMapping(const fs::path& base_dir, const Json& asked) {
  const fs::path dir = base_dir / kMappingDir, settings = dir / kSettingsFile;
  const std::string where = EscapePath(settings);
  const Json json = ReadJson(settings);
  if (json.value("asked", Json()) != asked) {
    LogWarning(
        "poses are estimated anew: the earlier ones were estimated with other options, or by an earlier version");
    return {};
  }
  BaseMapping base;
  base.settings = SfmSettingsFromJson(json, where);
  base.photos = Get<std::set<std::string>>(json, "photos", where);
  base.mapping = {dir / kDatabaseFile, dir / kModelFolder, base.photos, {}};
  base.model = ReadColmapModel(base.mapping.model);
  base.own_focal_lengths = fs::exists(dir / kExportedFolder);
  base.exported = base.own_focal_lengths ? ReadColmapModel(dir / kExportedFolder) : base.model;
  return base;
}

bool IsInBasesWorld(const BaseMapping& base, const Capture& capture, const ColmapModel& model) {
  return needs::SameWorld(Compare(base, base.exported, capture, model, MeasureShift(base.exported, model)));
}

bool MappedAnew(const Attempt& attempt) { return BestModel(attempt) != (attempt.grown ? &*attempt.grown : nullptr); }

Attempt Extend(const BaseMapping& base, SfmSettings settings, const Capture& capture, Colmap& colmap,
               const fs::path& work, const ArtifactWriter& artifact) {
  EarlierMapping mapping = base.mapping;
  const auto holds = [&](const ColmapModel& grown) {
    return needs::SameWorld(Compare(base, base.model, capture, grown, MeasureShift(base.model, grown)));
  };
  mapping.holds = holds;
  const std::string name = settings.name;
  settings.name = "extended";  // its folder is no other attempt's
  Attempt attempt = Reconstruct(capture, settings, colmap, work / settings.name, artifact, &mapping);
  attempt.settings.name = name;
  const ColmapModel* anew = LargestModel(attempt.models);
  const bool replaceable = attempt.grown && anew && anew->images.size() >= attempt.grown->images.size();
  if (replaceable && !holds(*attempt.grown)) attempt.grown.reset();
  return attempt;
}

ColmapModel InBasesWorld(const BaseMapping& base, const Capture& capture, const Attempt& attempt, ColmapModel model,
                         ArtifactWriter& artifact) {
  const std::optional<WorldShift> shift = MeasureShift(base.exported, model);
  const MergedModel merged = Compare(base, base.exported, capture, model, shift);
  const bool mapped_anew = MappedAnew(attempt);
  const bool frame_kept = needs::SameWorld(merged);
  artifact.AddDecision(needs::PosesAnew(merged, mapped_anew));
  const Json extension = {
      {"schema_version", kExtensionSchemaVersion},
      {"frame_kept", frame_kept},
      {"n_earlier", merged.n_earlier},
      {"n_added", merged.n_added},
      {"n_added_placed", merged.n_added_placed},
      {"n_earlier_lost", merged.n_lost},
      {"mapped_anew", mapped_anew},
      {"shift_px", shift ? Json(shift->median_px) : Json()},
      {"largest_shift_px", shift && std::isfinite(shift->largest_px) ? Json(shift->largest_px) : Json()},
      {"error_before_px", merged.error_before_px},
      {"error_px", merged.error_px}};
  WriteJson(artifact.dir() / kExtensionFile, extension);
  artifact.AddOutput(kExtensionFile);
  artifact.facts()["extension"] = extension;
  if (!frame_kept) LogWarning("the model is not in the world of the earlier one: what follows is made anew");
  return shift ? Transformed(model, shift->earlier_from_now) : std::move(model);
}

}  // namespace nrff
