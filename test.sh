#!/usr/bin/env bash
# Installs what is missing, builds, runs all tests.
#   ./test.sh                 the optimised build, with the CUDA half where the CUDA toolkit is
#   ./test.sh asan            the same tests under AddressSanitizer and UndefinedBehaviorSanitizer
#   ./test.sh tidy            clang-tidy over our own code (no tests)
#   ./test.sh fuzz [SECONDS]  libFuzzer on every parser, for 10 seconds each unless said otherwise (needs clang)
set -euo pipefail
cd "$(dirname "$0")"
preset=${1:-cpu}
case $preset in cpu) build=build ;; asan) build=build-asan ;; tidy) build=build-tidy ;;
  fuzz) build=build-fuzz ;;
  *) echo "usage: ./test.sh [cpu|asan|tidy|fuzz [SECONDS]]" >&2; exit 2 ;;
esac
tools/setup.sh "$preset"
tools/build.sh "$preset"
[ "$preset" != fuzz ] || exec tests/fuzz/campaign.sh "${2:-10}"
[ "$preset" = tidy ] || ctest --test-dir "$build" --output-on-failure --parallel "$(nproc)"
