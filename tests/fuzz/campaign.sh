#!/usr/bin/env bash
# Runs every fuzz target of build-fuzz (./test.sh fuzz makes it) with libFuzzer, one after the other:
#   tests/fuzz/campaign.sh [SECONDS] [TARGET…]      SECONDS for each, 10 unless given; all targets unless named
# Each goes on from build-fuzz/corpus/TARGET, from the seeds it makes itself and from tests/fuzz/regressions/TARGET. The
# table goes to build-fuzz/fuzz.md. Fails when an input was found that breaks a target's laws.
set -euo pipefail
root=$(cd "$(dirname "$0")/../.." && pwd)
build=$root/build-fuzz
seconds=${1:-10}
command="tests/fuzz/campaign.sh $*"
shift || true

export TMPDIR
TMPDIR=$(mktemp -d "$([ -d /dev/shm ] && echo /dev/shm || echo /tmp)/nrff-fuzz.XXXXXX")  # inputs are files
trap 'rm -rf "$TMPDIR"' EXIT
export UBSAN_OPTIONS=print_stacktrace=1
export LSAN_OPTIONS=suppressions=$root/tests/lsan.supp:print_suppressions=0

table=$build/fuzz.md
{
  echo "# Fuzzing"
  echo
  echo "$(date +%F), $(sed -n 's/^model name.*: //p' /proc/cpuinfo | head -n 1), $(nproc) cores, one used;" \
    "nrff $(git -C "$root" describe --always --dirty 2>/dev/null || echo unknown), $(clang++-14 --version | head -n 1)."
  echo "Command: \`$command\`. Edges and corpus: all that the target has reached so far, with earlier runs."
  echo
  echo "| target | seconds | executions | executions/s | edges | corpus | findings |"
  echo "|---|---|---|---|---|---|---|"
} >"$table"

failed=()
while read -r target dictionary; do
  [ $# = 0 ] || [[ " $* " = *" $target "* ]] || continue
  program=$build/tests/fuzz_$target
  corpus=$build/corpus/$target findings=$build/findings/$target log=$build/findings/$target.log
  mkdir -p "$corpus" "$findings"
  NRFF_WRITE_SEEDS=$build/seeds/$target "$program"
  inputs=("$corpus" "$build/seeds/$target")
  [ ! -d "$root/tests/fuzz/regressions/$target" ] || inputs+=("$root/tests/fuzz/regressions/$target")
  before=$(find "$findings" -type f | wc -l)
  fast_unwind=1
  [ "$target" != image ] || fast_unwind=0  # OpenImageIO's leak is known by a frame beyond those without frame pointers
  ASAN_OPTIONS=quarantine_size_mb=16:malloc_context_size=20:fast_unwind_on_malloc=$fast_unwind \
    "$program" -max_total_time="$seconds" -timeout=10 -rss_limit_mb=1024 -malloc_limit_mb=256 -max_len=16384 \
    -dict="$root/tests/fuzz/dictionaries/$dictionary.dict" -artifact_prefix="$findings/" -print_final_stats=1 \
    "${inputs[@]}" >"$log" 2>&1 || true
  found=$(($(find "$findings" -type f | wc -l) - before))
  statistic() { sed -n "s/^stat::$1: *//p" "$log"; }
  last() { sed -n "s|.*$1: \([0-9]*\).*|\1|p" "$log" | tail -n 1; }
  row=("$seconds" "$(statistic number_of_executed_units)" "$(statistic average_exec_per_sec)" "$(last cov)" "$(last corp)"
    "$found")
  printf '%-16s %9s executions, %7s/s, %6s edges, %d new findings\n' "$target" "${row[1]:-?}" "${row[2]:-?}" \
    "${row[3]:-?}" "$found"
  (IFS='|'; echo "|$target|${row[*]}|" | sed 's/|/ | /g; s/^ //; s/ $//') >>"$table"
  if ! grep -q '^Done [0-9]* runs' "$log" || [ "$found" -gt 0 ]; then failed+=("$target"); fi
done <"$build/fuzz_targets"

echo "table: $table"
for target in "${failed[@]}"; do
  echo "fuzz: $target ended early; its report is in build-fuzz/findings/$target.log; to see it again:" >&2
  input=$(sed -n 's/.*Test unit written to //p' "$build/findings/$target.log" | tail -n 1)
  echo "  build-fuzz/tests/fuzz_$target ${input:-build-fuzz/seeds/$target/*}" >&2
done
[ ${#failed[@]} = 0 ]
