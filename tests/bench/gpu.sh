#!/usr/bin/env bash
# Tests and measures the CUDA half on a machine that has a GPU, CUDA and libtorch 2.11 (cu130), and nothing else of ours:
#   tests/bench/gpu.sh --prepare NODE DATA      here: builds, and puts all that the GPU's machine needs into the folder
#                                               NODE, under 60 MB; DATA holds the capture scenes/lego_nsvf_400
#   tests/bench/gpu.sh --dry-run NODE           here or there: says what --run does and checks that all of it is there
#   tests/bench/gpu.sh --run NODE OUT.json      there, under 8 minutes: parity with the CPU, compute-sanitizer, ceilings,
#                                               training to a PSNR, steps, kernels, frames → OUT.json
# NRFF_TORCH_LIB names the folder of libtorch_cpu.so there, where it is not that of the python3 on the PATH.
# --run goes on after a part that failed, writes what there is, and fails in the end.
set -euo pipefail
root=$(cd "$(dirname "$0")/../.." && pwd)
readonly programs=(bin/nrff-train bin/nrff-render tests/gpu_cuda_test tests/kernels_cuda_test tests/stability_cuda
  tests/gpu_bench tests/gpu_ceilings libnrff_cuda.so)
readonly most_bytes=$((60 * 1000 * 1000))
readonly scene=scene.tar.xz

fail() { echo "gpu.sh: $*" >&2; exit 1; }

prepare() {
  local node=$1 capture=$2/scenes/lego_nsvf_400
  [ -d "$capture" ] || fail "$capture is not there; --prepare needs the folder that holds scenes/lego_nsvf_400"
  "$root/tools/build.sh" cpu
  [ -e "$root/build/libnrff_cuda.so" ] || fail "build/libnrff_cuda.so was not built: put nvcc of the CUDA toolkit on the PATH"
  mkdir -p "$node/bin" "$node/tests"
  for program in "${programs[@]}"; do strip -o "$node/$program" "$root/build/$program"; done
  cp "$root/tests/bench/gpu.sh" "$node/gpu.sh"
  work=$(mktemp -d)
  trap 'rm -rf "$work"' EXIT
  "$root/build/bin/nrff-ingest" "$capture" --out "$work/ingest" --quiet
  "$root/build/bin/nrff-pose" normalise --ingest "$work/ingest" --out "$work/pose" --quiet
  tar -C "$work" --sort=name --mtime=@0 --owner=0 --group=0 -cf - pose | xz -T0 -6 >"$node/$scene"
  git -C "$root" describe --always --dirty >"$node/commit"
  check "$node"
}

# All that --run uses is there, and can be carried.
check() {
  local node=$1 file bytes missing
  for file in "${programs[@]}" "$scene" gpu.sh commit; do
    [ -s "$node/$file" ] || fail "$node/$file is missing or empty; run gpu.sh --prepare"
  done
  bytes=$(du -sb "$node" | cut -f1)
  [ "$bytes" -le "$most_bytes" ] || fail "$node has $bytes bytes, more than the $most_bytes that can be carried"
  tar -tJf "$node/$scene" >/dev/null || fail "$node/$scene cannot be read"
  for file in "${programs[@]}"; do
    # What the GPU's machine has: this folder, libtorch with its libraries, CUDA's, the C and C++ libraries.
    missing=$(objdump -p "$node/$file" | sed -n 's/ *NEEDED *//p' | grep -Ev \
      '^(libnrff_cuda|libtorch_cpu|libc10|libcublasLt|libcudart|libgomp|libgcc_s|libstdc\+\+|libm|libc|libdl|libpthread|librt|ld-linux)' || true)
    [ -z "$missing" ] || fail "$file needs $missing, which the GPU's machine does not have"
  done
  echo "gpu.sh: $node is complete: $bytes bytes"
}

libraries() {
  local torch=${NRFF_TORCH_LIB:-}
  [ -n "$torch" ] || torch=$(python3 -c 'import os, torch; print(os.path.join(os.path.dirname(torch.__file__), "lib"))')
  [ -e "$torch/libtorch_cpu.so" ] || fail "libtorch_cpu.so is not in '$torch'; name its folder in NRFF_TORCH_LIB"
  echo "$torch:$torch/../../nvidia/cu13/lib:/usr/local/cuda/lib64${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}"
}

# The parts of a run: name, seconds at most (460 in all), command. racecheck looks at shared memory alone, which only the
# sums use. $work holds what they write.
parts() {
  cat <<'PARTS'
parity 60 "$node/tests/gpu_cuda_test" --gtest_output=json:"$work/parity.json"
kernels 20 "$node/tests/kernels_cuda_test" --gtest_output=json:"$work/kernels.json"
stability 30 "$node/tests/stability_cuda" --gtest_output=json:"$work/stability.json"
memcheck 45 compute-sanitizer --tool memcheck --error-exitcode 9 "$node/tests/gpu_cuda_test" --gtest_filter='*Paper:*RendersWhat*'
racecheck 30 compute-sanitizer --tool racecheck --error-exitcode 9 "$node/tests/gpu_cuda_test" --gtest_filter='*Paper'
initcheck 30 compute-sanitizer --tool initcheck --error-exitcode 9 "$node/tests/gpu_cuda_test" --gtest_filter='*Paper'
ceilings 20 "$node/tests/gpu_ceilings" "$work/ceilings.json"
train 150 "$node/bin/nrff-train" --scene "$work/pose" --out "$work/train" --device cuda --preset paper
measure 45 "$node/tests/gpu_bench" measure "$work/pose" "$work/train" "$work/measure.json"
render 30 "$node/bin/nrff-render" --scene "$work/pose" --model "$work/train" --out "$work/render" --device cuda
PARTS
}

run() {
  local node out name seconds command start code failed=0 outcomes=""
  node=$(cd "$1" && pwd) out=$2
  check "$node"
  LD_LIBRARY_PATH=$(libraries)
  export LD_LIBRARY_PATH=$node:$LD_LIBRARY_PATH
  work=$(mktemp -d)
  trap 'rm -rf "$work"' EXIT
  tar -C "$work" -xJf "$node/$scene"
  while read -r name seconds command; do
    echo "== $name"
    start=$(date +%s.%N) code=0
    (eval "timeout $seconds $command") >"$work/$name.log" 2>&1 </dev/null || code=$?
    if grep -qi 'no GPU' "$work/$name.log"; then code=77; fi  # tests skip without one, which is no pass here
    [ "$code" = 0 ] || { failed=1; tail -n 25 "$work/$name.log"; }
    outcomes+=$(printf '%s\n  "%s": {"exit_code": %d, "seconds": %.1f}' "${outcomes:+,}" "$name" "$code" \
      "$(echo "$(date +%s.%N) $start" | awk '{print $1 - $2}')")
  done < <(parts)
  printf '{%s\n}\n' "$outcomes" >"$work/parts.json"
  printf '{"date": "%s", "commit": "%s", "gpu": "%s", "command": "tests/bench/gpu.sh --run"}\n' "$(date +%F)" \
    "$(cat "$node/commit")" "$(nvidia-smi --query-gpu=name,driver_version --format=csv,noheader 2>/dev/null | head -n 1)" \
    >"$work/run.json"
  "$node/tests/gpu_bench" collect "$out" run="$work/run.json" parts="$work/parts.json" ceilings="$work/ceilings.json" \
    training="$work/train/manifest.json" rendering="$work/render/manifest.json" measured="$work/measure.json"
  echo "gpu.sh: wrote $out"
  return "$failed"
}

case "${1:-}-$#" in
  --prepare-3) prepare "$2" "$3" ;;
  --dry-run-2) check "$2"; echo "gpu.sh --run would do, with the seconds that each may take at most:"; parts ;;
  --run-3) run "$2" "$3" ;;
  *) sed -n '2,9s/^# \{0,1\}//p' "$0" >&2; exit 2 ;;
esac
