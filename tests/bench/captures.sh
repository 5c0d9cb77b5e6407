#!/bin/sh
# Runs the whole pipeline on every real capture and writes one table of what came out.
#
#   tests/bench/captures.sh DATA_DIR OUT.json [options of `nrff run`]
#
# OUT.md is written beside OUT.json. Workspaces are kept in $WORKSPACES (default: work/captures), so that a run that was
# interrupted goes on where it was, and one that is complete only writes the table again. $NRFF names the driver
# (default: build/bin/nrff).
set -u

if [ $# -lt 2 ]; then
  sed -n '4p' "$0" | sed 's/^# */usage: /' >&2
  exit 2
fi
here=$(cd "$(dirname "$0")" && pwd)
data=$1 out=$2
shift 2
nrff=${NRFF:-$here/../../build/bin/nrff}
workspaces=${WORKSPACES:-work/captures}
mkdir -p "$workspaces" "$(dirname "$out")" || exit 5
trap 'exit 130' INT TERM

captures='
castle          photos/sceaux_castle
kermit          photos/kermit
ET              photos/ET
maryrose        photos/maryrose
fox-photos      scenes/fox/images
fox-posed       scenes/fox
maryrose-tnt    scenes/maryrose_tnt
lego            scenes/lego_nsvf_400
cup             colmap_models/cup_simple_pinhole
'
printf '%s' "$captures" | while read -r name source; do
  [ -n "$name" ] || continue
  echo "== $name ($source)"
  # The exit code and what was said are what the table tells of a capture that failed.
  "$nrff" run "$data/$source" --workspace "$workspaces/$name" "$@" 2>"$workspaces/$name.stderr"
  code=$?
  grep '^error: ' "$workspaces/$name.stderr"
  echo "$code" >"$workspaces/$name.exit"
  [ "$code" -lt 128 ] || exit "$code"  # stopped by a signal: the rest is not run either
done || exit

exec python3 "$here/captures_table.py" --workspaces "$workspaces" --data "${data%/}/" \
  --out "$out" --version "$("$nrff" --version)" \
  --command "nrff run CAPTURE $*" --captures "$captures"
