#!/usr/bin/env bash
# Installs what the build and the pipeline need, and only what is missing: Debian packages, and libtorch from its wheel.
# Says what it installs; does nothing, and needs no network, when everything is there. For the preset `fuzz`
# (tools/setup.sh fuzz) that is clang with its run-time libraries, and no libtorch.
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd)

packages=(
  # build
  g++ cmake ninja-build ccache python3 python3-pip
  nlohmann-json3-dev libcli11-dev libfmt-dev libxxhash-dev libeigen3-dev libpng-dev zlib1g-dev
  libopencv-core-dev libopencv-imgproc-dev libopencv-calib3d-dev libopencv-dnn-dev
  libopenimageio-dev libsqlite3-dev libceres-dev
  libgtest-dev libgmock-dev libbenchmark-dev
  # run
  colmap ffmpeg
)
[ "${1:-cpu}" != fuzz ] || packages+=(clang-14 libclang-rt-14-dev llvm-14)
[ "${1:-cpu}" != tidy ] || packages+=(clang-tidy)
missing=()
for package in "${packages[@]}"; do
  [ "$(dpkg-query -W -f '${db:Status-Status}' "$package" 2>/dev/null)" = installed ] || missing+=("$package")
done
if [ ${#missing[@]} -gt 0 ]; then
  echo "setup: Debian packages missing: ${missing[*]}"
  install=(apt-get install -y --no-install-recommends "${missing[@]}")
  if [ "$(id -u)" = 0 ]; then
    elevate=()
  elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then
    elevate=(sudo)
  else
    echo "setup: not root: ask for these packages, then run this again:" >&2
    echo "  apt-get install --no-install-recommends ${missing[*]}" >&2
    exit 4
  fi
  echo "setup: installing them with apt-get (log: ${TMPDIR:-/tmp}/nrff-apt.log)"
  if ! { "${elevate[@]}" apt-get update -q && "${elevate[@]}" env DEBIAN_FRONTEND=noninteractive "${install[@]}"; } \
      >"${TMPDIR:-/tmp}/nrff-apt.log" 2>&1; then
    tail -n 5 "${TMPDIR:-/tmp}/nrff-apt.log" >&2
    echo "setup: apt-get failed; the packages are: ${missing[*]}" >&2
    exit 4
  fi
fi

[ "${1:-cpu}" != fuzz ] || exit 0

# libtorch: the wheel's libraries and headers, unpacked; nothing of it is installed into Python.
torch_dir=${NRFF_DEPS:-$HOME/.cache/nrff}/torch-2.11.0
if [ ! -e "$torch_dir/complete" ]; then
  if [ "$(uname -m)" != x86_64 ]; then
    echo "setup: libtorch is pinned for x86_64, this machine is $(uname -m): unpack a torch 2.11 wheel yourself and configure with -DNRFF_TORCH_DIR=DIR" >&2
    exit 4
  fi
  echo "setup: fetching libtorch 2.11.0 (530 MB) into $torch_dir"
  mkdir -p "$torch_dir"
  wheels=$(mktemp -d "$torch_dir/wheels.XXXXXX")
  trap 'rm -rf "$wheels"' EXIT
  python3 -m pip download --quiet --disable-pip-version-check --no-deps --require-hashes --only-binary=:all: \
    --python-version 3.11 --implementation cp --abi cp311 --abi none \
    --platform manylinux_2_28_x86_64 --platform manylinux_2_25_x86_64 --platform manylinux2014_x86_64 \
    --dest "$wheels" --requirement "$root/tools/torch-requirements.txt"
  python3 - "$wheels" "$torch_dir" <<'PYTHON'
import pathlib, sys, zipfile
wheels, target = map(pathlib.Path, sys.argv[1:])
wanted = ("torch/include/", "torch/lib/libtorch_cpu.so", "torch/lib/libc10.so", "torch/lib/libgomp",
          "nvidia/cu13/lib/libcudart.so", "nvidia/cu13/lib/libcupti.so")
for wheel in wheels.glob("*.whl"):
    with zipfile.ZipFile(wheel) as archive:
        for name in archive.namelist():
            if name.startswith(wanted) or "/LICENSE" in name or name.endswith("/NOTICE"):
                archive.extract(name, target)
PYTHON
  touch "$torch_dir/complete"
fi
