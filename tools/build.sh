#!/usr/bin/env bash
# Configures and builds one preset: tools/build.sh [cpu|cuda|asan|tidy|fuzz]
set -euo pipefail
cd "$(dirname "$0")/.."
preset=${1:-cpu}
cmake --preset "$preset" -Wno-dev >/dev/null
cmake --build --preset "$preset"
