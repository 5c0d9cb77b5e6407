#!/bin/sh
# Times COLMAP's default feature extraction, exhaustive matching and mapping on a folder of photos against
# `nrff-pose estimate` on the same photos and machine. Run it on a machine that does nothing else.
#
#   tests/bench/fox_colmap_default.sh PHOTOS OUT.json
#
# Finished steps are kept in $WORK (default: work/colmap-default) and not timed again. $BIN names the folder of the
# executables (default: build/bin).
set -eu

if [ $# -ne 2 ]; then
  sed -n '5p' "$0" | sed 's/^# */usage: /' >&2
  exit 2
fi
here=$(cd "$(dirname "$0")" && pwd)
photos=$1 out=$2
bin=${BIN:-$here/../../build/bin}
work=${WORK:-work/colmap-default}
mkdir -p "$work/sparse" "$(dirname "$out")"
export QT_QPA_PLATFORM=offscreen

# timed NAME COMMAND...: runs it unless it was finished before; its seconds go to $work/NAME.seconds.
timed() {
  name=$1
  shift
  [ ! -f "$work/$name.seconds" ] || return 0
  echo "$name …" >&2
  start=$(date +%s)
  "$@" >"$work/$name.log" 2>&1
  echo $(($(date +%s) - start)) >"$work/$name.seconds.partial"
  mv "$work/$name.seconds.partial" "$work/$name.seconds"
}

# A step that was cut short has left rows behind.
[ -f "$work/matching.seconds" ] || rm -rf "$work/database.db" "$work"/features.seconds
timed features colmap feature_extractor --database_path "$work/database.db" --image_path "$photos" \
  --SiftExtraction.use_gpu 0
timed matching colmap exhaustive_matcher --database_path "$work/database.db" --SiftMatching.use_gpu 0
timed mapping colmap mapper --database_path "$work/database.db" --image_path "$photos" --output_path "$work/sparse"
timed ingest "$bin/nrff-ingest" "$photos" --out "$work/ingest"
timed estimate "$bin/nrff-pose" estimate --ingest "$work/ingest" --out "$work/sfm"
for model in "$work"/sparse/*; do
  colmap model_analyzer --path "$model" 2>&1 | sed -n 's/.*Registered images: *//p'
done | sort -n | tail -1 >"$work/registered"

exec python3 - "$work" "$out" <<'PYTHON'
import datetime, json, pathlib, sys

work, out = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2])
seconds = {name: float((work / f"{name}.seconds").read_text())
           for name in ["features", "matching", "mapping", "ingest", "estimate"]}
default_seconds = seconds["features"] + seconds["matching"] + seconds["mapping"]
manifest = json.loads((work / "sfm/manifest.json").read_text())
facts = manifest["facts"]
result = {
    "schema_version": 1,
    "date": datetime.datetime.fromtimestamp((work / "registered").stat().st_mtime).date().isoformat(),
    "command": "tests/bench/fox_colmap_default.sh PHOTOS OUT.json",
    "version": manifest["version"],
    "machine": manifest["host"],
    "colmap_version": facts["colmap_version"],
    "colmap_default": {"seconds_features": seconds["features"], "seconds_matching": seconds["matching"],
                       "seconds_mapping": seconds["mapping"], "seconds": default_seconds,
                       "n_registered": int((work / "registered").read_text())},
    "nrff_pose_estimate": {"seconds": seconds["estimate"], "n_registered": facts["n_registered"],
                           "n_images": facts["n_images"], "attempts": facts["attempts"],
                           "reprojection_error_px": facts["reprojection_error_px"]},
    "ratio": seconds["estimate"] / default_seconds,
}
out.write_text(json.dumps(result, indent=1) + "\n")
print(json.dumps(result, indent=1))
PYTHON
