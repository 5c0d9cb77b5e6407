#!/usr/bin/env bash
# Installs what is missing, builds, makes the example capture, runs the whole pipeline on it.
set -euo pipefail
cd "$(dirname "$0")"
tools/setup.sh
tools/build.sh
photos=work/example-capture/photos
if [ ! -d "$photos" ]; then
  echo "demo: ray-tracing the example capture into $photos"
  build/bin/make_capture --out work/example-capture.new
  mv work/example-capture.new work/example-capture
fi
build/bin/nrff run "$photos" --workspace work/example "$@"
echo
echo "The report: $PWD/work/example/report/report.html"
