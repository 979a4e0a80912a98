#!/usr/bin/env bash
# The kernels on aarch64, which has NEON, under emulation: what they give hashes to the same as here, and their tests
# and those of the boundary pass with every version. On Debian:
#
#     apt install gcc-aarch64-linux-gnu qemu-user; pip install cmake ninja
#     scripts/test_aarch64.sh FOLDER [pytest options]
#
# FOLDER gets the builds and, once, an aarch64 Python (Debian's packages, unpacked: this system's stay as they are)
# with NumPy, pytest and hypothesis. Results of the tests are cached nowhere. Exit code 0: all passed.
set -euo pipefail
folder=$(realpath -m "${1:?give a folder for builds and an aarch64 Python}")
shift
cd "$(dirname "${BASH_SOURCE[0]}")/.."
root=$folder/root site=$folder/site package=$folder/package
emulator=(nice -n 5 qemu-aarch64 -L "$root")

unpack_python() {
    local apt=$folder/apt
    mkdir -p "$apt"/{state/lists,cache/archives}/partial "$root"
    : >"$apt/status" # nothing is installed: all that Python needs is fetched, down to the C library
    local get=(apt-get -qq -o APT::Architecture=arm64 -o APT::Architectures=arm64 -o Dir::State="$apt/state"
        -o Dir::State::status="$apt/status" -o Dir::Cache="$apt/cache" -o APT::Sandbox::User="$(id -un)")
    "${get[@]}" update
    "${get[@]}" install -y --download-only --no-install-recommends python3-dev libstdc++6
    for archive in "$apt"/cache/archives/*.deb; do
        dpkg -x "$archive" "$root"
    done
    rm -r "$apt"
}

install_packages() {
    local platforms=() version
    for version in 2_17 2_24 2_27 2_28; do
        platforms+=(--platform "manylinux_${version}_aarch64")
    done
    version=$("${emulator[@]}" "$root/usr/bin/python3" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
    python3 -m pip install -q --target "$site" "${platforms[@]}" --python-version "$version" --only-binary=:all: \
        numpy pytest hypothesis
}

build() {  # build NAME OPTIONS...
    local name=$1
    shift
    cmake -G Ninja -S . -B "$folder/$name" --log-level=WARNING -DCMAKE_BUILD_TYPE=Release -DCMAKE_C_FLAGS=-Werror \
        -DCOLMAP_SPH_KERNEL_HASHES=ON "$@"
    cmake --build "$folder/$name" -- --quiet
}

[ -x "$root/usr/bin/python3" ] || unpack_python
[ -d "$site/numpy" ] || install_packages

include=$(echo "$root"/usr/include/python3.*)
build here -DCOLMAP_SPH_MODULE=OFF
build aarch64 -DCMAKE_SYSTEM_NAME=Linux -DCMAKE_SYSTEM_PROCESSOR=aarch64 -DCMAKE_C_COMPILER=aarch64-linux-gnu-gcc \
    -DPython_INCLUDE_DIR="$include" -DCMAKE_C_FLAGS="-Werror -isystem $root/usr/include"
"$folder/here/kernel_hashes" >"$folder/hashes.txt"
"${emulator[@]}" "$folder/aarch64/kernel_hashes" >"$folder/hashes-aarch64.txt"
cmp "$folder"/hashes{,-aarch64}.txt

rm -rf "$package" && mkdir "$package"
cp -r colmap_sph "$package" && cp "$folder"/aarch64/_native*.so "$package/colmap_sph"
# Without conftest.py, which needs pycolmap: that is not made for aarch64. Each file by a process of its own.
export PYTHONSAFEPATH=1 PYTHONDONTWRITEBYTECODE=1 PYTHONPATH=$package:$site
printf '%s\n' tests/test_{kernels,native_boundary}.py | xargs -P "$(nproc)" -I FILE \
    "${emulator[@]}" "$root/usr/bin/python3" -m pytest -q --noconftest -p no:cacheprovider -k "not the_stub" "$@" FILE
