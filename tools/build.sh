#!/usr/bin/env bash
# Configures and builds one preset: tools/build.sh [cpu|asan|tidy|fuzz]. tidy compiles nothing but has clang-tidy read
# our own code.
set -euo pipefail
cd "$(dirname "$0")/.."
preset=${1:-cpu}
cmake --preset "$preset" -Wno-dev >/dev/null
if [ "$preset" = tidy ]; then
  run-clang-tidy -quiet -p build-tidy -j "$(nproc)" "^$PWD/(pipeline|sfm|model|render|eval|examples|tests)/.*\.cc$"
else
  cmake --build --preset "$preset"
fi
