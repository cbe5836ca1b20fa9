#!/usr/bin/env bash
# Prepares a Debian or Ubuntu machine with git, make and a Rust toolchain for building, running and testing `rapid`.
#
#     setup.sh [build] [test] [image] [qemu] [fuzz]
#
# build: requirements of building and running, including the pinned onnxruntime library. test: the rest - lint tools,
# the Python that reads episodes and topics from outside, the programs of the virtual bench. image: its guest. qemu: its guest
# for an emulated machine. fuzz: the build requirements of libFuzzer.
#
# Every step checks first and does nothing if it was done before. Downloads are stored outside the tree in
# ${XDG_CACHE_HOME:-~/.cache}/rapid, checked against the hashes pinned in the tree, and get their final names last: an
# interrupted run leaves nothing that a later one would take for complete.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

readonly ORT_VERSION=1.24.4
readonly CACHE="${XDG_CACHE_HOME:-$HOME/.cache}/rapid"
readonly VENV="$CACHE/venv"

# pkg-config, libudev-dev: crate udev. libclang-dev: the V4L2 bindings. libstdc++6: onnxruntime at run time. python3,
# python3-venv: pip, which fetches onnxruntime; the program itself needs neither.
readonly BUILD_PACKAGES=(gcc libc6-dev pkg-config libudev-dev libclang-dev libstdc++6 python3 python3-venv)
# tmux: the terminals in which tests use the monitor. ffmpeg: the videos of datasets. systemd: its judgement of our units.
readonly TEST_PACKAGES=(ffmpeg tmux systemd)
readonly FUZZ_PACKAGES=(g++)

changed=0

report() { printf 'setup: %s\n' "$*"; }
die() { printf 'setup: %s\n' "$*" >&2; exit 1; }
change() { changed=1; report "$@"; }

main() {
    [[ $# -gt 0 ]] || set -- build
    mkdir -p "$CACHE"
    # Two simultaneous runs would download to the same place.
    exec 9>"$CACHE/setup.lock"
    flock 9
    rm -rf "$CACHE"/onnxruntime.partial.*

    # The packages of all parts come first, in one step: administrator rights are needed only once.
    local wanted=() part
    for part in "$@"; do
        case "$part" in
            build) wanted+=("${BUILD_PACKAGES[@]}") ;;
            test) wanted+=("${TEST_PACKAGES[@]}") && mapfile -t -O "${#wanted[@]}" wanted < <(bench_packages uml) ;;
            image) mapfile -t -O "${#wanted[@]}" wanted < <(bench_packages uml) ;;
            qemu) mapfile -t -O "${#wanted[@]}" wanted < <(bench_packages qemu) ;;
            fuzz) wanted+=("${FUZZ_PACKAGES[@]}") ;;
            *) die "unknown part '$part': build, test, image, qemu or fuzz" ;;
        esac
    done
    toolchain
    packages "${wanted[@]}"
    [[ " $* " != *" build "* ]] || onnxruntime
    [[ " $* " != *" test "* ]] || { lint_tools; python_venv; }
    [[ " $* " != *" image "* ]] || guest
    [[ " $* " != *" qemu "* ]] || guest_of qemu
    if [[ $changed = 0 ]]; then report "nothing to do ($*)"; else report "done ($*)"; fi
}

toolchain() {
    command -v cargo >/dev/null || die "no cargo: install a Rust toolchain with rustup, then run this again"
}

lint_tools() {
    if cargo fmt --version >/dev/null 2>&1 && cargo clippy --version >/dev/null 2>&1; then return; fi
    command -v rustup >/dev/null || die "no rustfmt or clippy beside cargo, and no rustup to add them"
    change "adding rustfmt and clippy to the toolchain"
    rustup component add rustfmt clippy
}

# The packages of the virtual bench for this kind of guest, one per line.
bench_packages() { sed 's/#.*//' "tests/vbench/image/$1/packages.txt" | tr -s '[:space:]' '\n' | sed '/^$/d'; }

# Installs the missing packages; asks for root only if there are any.
packages() {
    local missing=() package
    if ! command -v dpkg-query >/dev/null; then
        report "this is not Debian or Ubuntu: make sure that what these packages contain is installed: $*"
        return
    fi
    for package in "$@"; do
        [[ $(dpkg-query -W -f='${db:Status-Status}' "$package" 2>/dev/null) = installed ]] || missing+=("$package")
    done
    [[ ${#missing[@]} -gt 0 ]] || return 0

    local as_root=()
    if [[ $(id -u) != 0 ]]; then
        command -v sudo >/dev/null || die "there is no sudo; as root, run: apt-get update && apt-get install ${missing[*]}"
        as_root=(sudo)
    fi
    change "installing with apt: ${missing[*]}"
    # A machine without these packages has no crates either: they are fetched meanwhile. If that fails, the build reports it.
    cargo fetch --locked --quiet --target "$(rustc -vV | sed -n 's/^host: //p')" 2>/dev/null 9>&- &
    # shellcheck disable=SC2064  # the process of now, not of then
    trap "kill $! 2>/dev/null || true" EXIT
    "${as_root[@]}" apt-get update -q
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends "${missing[@]}"
    wait
    trap - EXIT
}

# One whose packages cannot be imported is made anew, whatever its stamp names.
python_venv() {
    # iceoryx2 is published only for x86-64.
    local imports='import mcap' before
    [[ $(uname -m) != x86_64 ]] || imports='import iceoryx2, mcap'
    "$VENV/bin/python" -c "$imports" 2>/dev/null || rm -f "$VENV/stamp"
    before=$(cat "$VENV/stamp" 2>/dev/null || true)
    scripts/venv.sh venv tests/python/requirements.txt --require-hashes >/dev/null
    "$VENV/bin/python" -c "$imports"
    [[ $(cat "$VENV/stamp") = "$before" ]] || changed=1
}

onnxruntime() {
    local arch library dir partial
    arch=$(uname -m)
    library=libonnxruntime.so.$ORT_VERSION
    dir=$CACHE/onnxruntime/$ORT_VERSION-$arch
    if ! grep -q "  $arch/$library\$" scripts/onnxruntime.sha256; then
        report "no onnxruntime is pinned for $arch: left out"
        return
    fi
    if [[ -f $dir/$library ]] && checked "$dir" "$arch/$library"; then return; fi

    change "fetching onnxruntime $ORT_VERSION for $arch: $dir/$library"
    partial=$(mktemp -d "$CACHE/onnxruntime.partial.XXXXXX")
    # shellcheck disable=SC2064  # the folder of now, not of then
    trap "rm -rf '$partial'" EXIT
    # The library in the wheel does not depend on the Python the wheel is for; one is named so that every machine
    # gets the same bytes.
    python3 -m venv "$partial/venv"
    "$partial/venv/bin/python" -m pip download --quiet --disable-pip-version-check --no-deps --only-binary=:all: \
        --python-version 3.12 --implementation cp --abi cp312 \
        --platform "manylinux_2_27_$arch" --platform "manylinux_2_28_$arch" \
        --dest "$partial" "onnxruntime==$ORT_VERSION"
    local wheels=("$partial"/*.whl)
    checked "$partial" "$arch/$(basename "${wheels[0]}")" || die "${wheels[0]##*/} is not the wheel that is pinned in scripts/onnxruntime.sha256"
    python3 -m zipfile -e "${wheels[0]}" "$partial/wheel"
    cp "$partial/wheel/onnxruntime/capi/$library" "$partial/$library"
    checked "$partial" "$arch/$library" || die "$library is not the one that is pinned in scripts/onnxruntime.sha256"
    mkdir -p "$dir"
    mv "$partial/$library" "$dir/$library"
    # A program built without it is rebuilt: cargo watches this file, but not one that did not exist.
    touch src/policy/build.rs
    rm -rf "$partial"
    trap - EXIT
}

# Whether the file in folder $1 has the hash pinned for $2 (ARCH/FILE).
checked() {
    local want have
    want=$(awk -v name="$2" '$2 == name { print $1 }' scripts/onnxruntime.sha256)
    have=$(sha256sum <"$1/${2#*/}")
    [[ -n $want && ${have%% *} = "$want" ]]
}

# The virtual bench has its own builder, which knows what a guest is made of.
readonly GUEST=tests/vbench/image/build.sh
guest_of() {
    "$GUEST" --check "$1" >/dev/null 2>&1 && return
    change "building the guest of the virtual bench ($1)"
    "$GUEST" "$1" >/dev/null
}

# Where there can be no User-Mode Linux (its builder's exit code 4), it is an emulated machine.
guest() {
    local said code=0
    if said=$("$GUEST" --check 2>&1 >/dev/null); then
        [[ -z $said ]] || report "$said"
        return
    fi
    guest_of "${RAPID_VBENCH_BACKEND:-uml}" || code=$?
    case $code in
        0) return ;;
        4) ;;
        *) exit "$code" ;;
    esac
    local wanted
    mapfile -t wanted < <(bench_packages qemu)
    packages "${wanted[@]}"
    guest_of qemu
}

main "$@"
