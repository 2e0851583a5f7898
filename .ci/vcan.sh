#!/bin/bash
# Boots a kernel that has virtual CAN interfaces and runs the tests marked `vcan` in it.
#
#   .ci/vcan.sh [PYTEST_ARGUMENT...]
#
# Requires Debian, root, and in $PYTHON (default: python3) an interpreter that has the project with its
# `test` extra. The kernel is emulated, with this machine's own files under it, read-only. Python goes
# onto disk images, because reading it file by file would take minutes, and what numba compiles is
# compiled here, because it would take longer still in there. The clock in there counts instructions,
# one a ns, and jumps to the next timer where it idles, so that a tick takes as long, and none is
# missed, whatever else this machine does.
set -euo pipefail

project=$(cd "$(dirname "$0")/.." && pwd)
python=$(command -v "${PYTHON:-python3}")
limit_s=${VCAN_LIMIT_S:-3000}
# Not under /tmp or /var: the booted kernel has file systems of its own there.
work=$(mktemp -d /opt/rig-vcan.XXXXXX)
trap 'rm -rf "$work"' EXIT

install_needed() {
    local packages=(qemu-system-x86 linux-image-amd64 can-utils kmod iproute2 busybox-static squashfs-tools)
    if ! dpkg -s "${packages[@]}" >/dev/null 2>&1; then
        timeout 600 apt-get update -qq
        DEBIAN_FRONTEND=noninteractive timeout 900 \
            apt-get install -y -qq --no-install-recommends "${packages[@]}" >"$work/apt.log" 2>&1 ||
            { tail -n 30 "$work/apt.log"; exit 1; }
    fi
    if [ ! -x /opt/rig-vng/bin/vng ]; then
        "$python" -m venv /opt/rig-vng
        timeout 300 /opt/rig-vng/bin/pip install -q virtme-ng
    fi
    export PATH=/opt/rig-vng/bin:$PATH
}

# An image of every folder that Python reads from, mounted inside where the folder is here.
build_images() {
    local index=0 folder
    : >"$work/folders"
    while read -r folder; do
        mksquashfs "$folder" "$work/$index.img" -noI -noD -noF -noX -no-xattrs -quiet -no-progress -wildcards \
            -e share include "lib/python3.*/test" "... *.a" "... asammdf" "... pandas" \
            >"$work/image.log" 2>&1 || { cat "$work/image.log"; exit 1; }
        echo "$index $folder" >>"$work/folders"
        disks+=(--disk "$work/$index.img")
        index=$((index + 1))
    done < <("$python" -c '
import sys, sysconfig
base = sysconfig.get_path("stdlib") if sys.base_prefix == "/usr" else sys.base_prefix
print(*dict.fromkeys([base, sys.prefix]), sep="\n")
')
}

# For any processor, since the emulated one is not this one.
export NUMBA_CPU_NAME=generic NUMBA_CPU_FEATURES= NUMBA_CACHE_DIR="$work/out/numba"

fill_caches() {
    (cd "$project" && timeout 600 "$python" -c '
from can_dbc.database import DEFAULT_DATABASE, load_database
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.bench import SimulatedBench
from rig.plan.config import CONFIGS
SimulatedBench(load_bench_config(CONFIGS / "reference_bench.yaml"), load_database(DEFAULT_DATABASE)).update(10**8)
'
        timeout 600 "$python" -m tests.sensors.warm)
}

# What runs inside; its exit code comes back in a file, since the emulator has its own.
write_guest_script() {
    cat >"$work/guest.sh" <<GUEST
set -e
# The disks come in the order of the folders.
modprobe -a virtio_blk squashfs
ls /dev/vd? >/tmp/disks
paste -d ' ' /tmp/disks "$work/folders" >/tmp/mounts
while read -r disk _ folder; do mount -t squashfs -o ro "\$disk" "\$folder"; done </tmp/mounts
modprobe vcan
modprobe can-gw
modprobe can-j1939
cd "$project"
export HOME=/tmp PYTHONDONTWRITEBYTECODE=1
export NUMBA_CPU_NAME=$NUMBA_CPU_NAME NUMBA_CPU_FEATURES= NUMBA_CACHE_DIR=$NUMBA_CACHE_DIR
set +e
echo "vcan: \$(uname -r), up for \$(cut -d ' ' -f 1 /proc/uptime) s"
"$python" -m pytest -m vcan -o addopts="-ra --import-mode=importlib" \
    -p no:cacheprovider -p no:hypothesispytest -p no:xdist -p no:benchmark ${*:+$(printf '%q ' "$@")} tests/vcan
echo \$? >"$work/out/exit_code"
GUEST
}

install_needed
mkdir "$work/out"
fill_caches
disks=()
build_images
write_guest_script "$@"
kernel=$(ls -v /boot/vmlinuz-*-amd64 | tail -n 1)
timeout -k 10 "$limit_s" vng --run "$kernel" --user root --cpus 1 --memory 3G --force-9p --disable-kvm \
    --qemu-opts="-icount shift=0,sleep=off" \
    "${disks[@]}" --rwdir "$work/out" --exec "bash $work/guest.sh" </dev/null 2>&1 | grep --line-buffered -v "Image format was not\|detecting the format\|raw. format explicitly" || true
if [ ! -s "$work/out/exit_code" ]; then
    echo "vcan: the booted kernel did not finish within $limit_s s" >&2
    exit 1
fi
exit "$(cat "$work/out/exit_code")"
