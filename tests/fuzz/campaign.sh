#!/usr/bin/env bash
# Runs every fuzz target of build-fuzz (./test.sh fuzz makes it) with libFuzzer, one after the other:
#   tests/fuzz/campaign.sh [SECONDS] [TARGET…]      SECONDS for each, 10 unless given; all targets unless named
# SECONDS are of processor time, so that other work on the machine takes nothing away from them. Each target goes on from
# build-fuzz/corpus/TARGET, from the seeds it makes itself and from tests/fuzz/regressions/TARGET; several campaigns of
# different targets may run at once. The table in build-fuzz/fuzz.md has all that was run since build-fuzz/totals was
# made. Fails when an input was found that breaks a target's laws.
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

table=$build/fuzz.md totals=$build/totals
mkdir -p "$totals"

write_table() {
  local file=$table.$$
  {
    echo "# Fuzzing"
    echo
    echo "$(date +%F), $(sed -n 's/^model name.*: //p' /proc/cpuinfo | head -n 1), $(nproc) cores, one used for each;" \
      "nrff $(git -C "$root" describe --always --dirty 2>/dev/null || echo unknown), $(clang++-14 --version | head -n 1)."
    echo "Command, the last: \`$command\`. Seconds of processor time, executions and findings are those of all runs"
    echo "together; edges and corpus are what the target has reached."
    echo
    echo "| target | seconds | executions | executions/s | edges | corpus | findings |"
    echo "|---|---|---|---|---|---|---|"
    local total
    for total in "$totals"/*; do
      awk -v target="$(basename "$total")" \
        '{printf "| %s | %d | %d | %d | %d | %d | %d |\n", target, $1, $2, $2 / $1, $3, $4, $5}' "$total"
    done
  } >"$file"
  mv "$file" "$table"
}

failed=()
while read -r target dictionary; do
  [ $# = 0 ] || [[ " $* " = *" $target "* ]] || continue
  program=$build/tests/fuzz_$target
  corpus=$build/corpus/$target findings=$build/findings/$target log=$build/findings/$target.log
  mkdir -p "$corpus" "$findings"
  NRFF_WRITE_SEEDS=$build/seeds/$target "$program"
  inputs=("$corpus" "$build/seeds/$target")
  [ ! -d "$root/tests/fuzz/regressions/$target" ] || inputs+=("$root/tests/fuzz/regressions/$target")
  fast_unwind=1 most_mb=256
  if [ "$target" = image ]; then
    fast_unwind=0  # OpenImageIO's leak is known by a frame beyond those without frame pointers
    most_mb=1100   # its WebP reader makes room for all pixels of the header, up to 16383 x 16383, before it reads one
  fi
  spent=0 executions=0 found=0
  [ ! -e "$totals/$target" ] || read -r spent executions edges corpus_size found <"$totals/$target"
  wanted=$(awk "BEGIN {print $spent + $seconds}") before=$executions
  while true; do
    left=$(awk "BEGIN {left = $wanted - $spent; print left < 1 ? 0 : int(left + 0.5)}")
    [ "$left" -gt 0 ] || break
    n_before=$(find "$findings" -type f | wc -l)
    TIMEFORMAT='%U %S'  # and a time-out that work of higher priority does not bring about
    used=$({ time ASAN_OPTIONS=quarantine_size_mb=16:malloc_context_size=20:fast_unwind_on_malloc=$fast_unwind \
      "$program" -max_total_time="$left" -timeout=60 -report_slow_units=60 -rss_limit_mb=$((4 * most_mb)) -malloc_limit_mb=$most_mb -max_len=16384 \
      -dict="$root/tests/fuzz/dictionaries/$dictionary.dict" -artifact_prefix="$findings/" -print_final_stats=1 \
      "${inputs[@]}" >"$log" 2>&1 || true; } 2>&1)
    last() { sed -n "s|.*$1: *\([0-9]*\).*|\1|p" "$log" | tail -n 1; }
    spent=$(awk "BEGIN {split(\"$used\", t, \" \"); print $spent + t[1] + t[2]}")
    new=$(($(find "$findings" -type f | wc -l) - n_before))
    executions=$((executions + $(last stat::number_of_executed_units || echo 0))) found=$((found + new))
    edges=$(last cov) corpus_size=$(last corp)
    echo "$spent $executions ${edges:-0} ${corpus_size:-0} $found" >"$totals/$target"
    if ! grep -q '^Done [0-9]* runs' "$log" || [ "$new" -gt 0 ]; then
      failed+=("$target")
      break
    fi
  done
  printf '%-16s %9d executions, %6s edges, %d findings\n' "$target" $((executions - before)) "${edges:-?}" "$found"
  write_table
done <"$build/fuzz_targets"

echo "table: $table"
for target in "${failed[@]}"; do
  echo "fuzz: $target ended early; its report is in build-fuzz/findings/$target.log; to see it again:" >&2
  input=$(sed -n 's/.*Test unit written to //p' "$build/findings/$target.log" | tail -n 1)
  echo "  build-fuzz/tests/fuzz_$target ${input:-build-fuzz/seeds/$target/*}" >&2
done
[ ${#failed[@]} = 0 ]
