#!/usr/bin/env bash
# What is too long for every day, before a release and at night, after `make test`: guests on an emulated machine with the
# distribution's own kernel, for a second opinion on what User-Mode Linux shows; the longest scenario; the smoke test of `make
# bench` on its guests; every crate and every cargo feature alone; fuzzing guided by coverage (FUZZ_SECONDS=20); the suites that need
# gigabytes of Python, where those are there.
#
#     tests-all.sh cargo test --locked --workspace
#
# The last lines are a table: each part, and whether it passed, was skipped and why, or failed. The exit code is 0 if none failed.
set -euo pipefail
[[ $# -ge 2 ]] || { echo "usage: tests-all.sh CARGO TEST..." >&2; exit 2; }
cd "$(dirname "${BASH_SOURCE[0]}")/.."
cache=${XDG_CACHE_HOME:-$HOME/.cache}/rapid

# A guest of each kind of device, and one under systemd. Those that are not here have motors whose limits of time an emulated
# processor does not keep; `buses` has motors without `rapid`.
readonly second=(
    scenarios::bench_shows       # MJPG and YUYV, CDC-ACM, FTDI
    scenarios::an_unplug    # cameras and lines under rapid
    buses::                      # gs_usb, slcan and a vendor's line, CDC-Ethernet
    lan::                        # CDC-Ethernet under rapid
    streams::                    # Z16, several cameras in one device
    commands::                   # vivid
    buttons::                    # uinput, evdev, GPIO of CP210x
    unprivileged::               # users, namespaces, udev rules
    service::                    # systemd as process 1
)

table=() failed=0
part() { # NAME COMMAND...
    local name=$1 started=$SECONDS
    shift
    printf '\n=== %s\n' "$name"
    if "$@"; then table+=("passed   $name ($((SECONDS - started)) s)"); else table+=("FAILED   $name") failed=1; fi
}
skip() { table+=("skipped  $1: $2"); }

second_opinion() {
    local filter all
    all=$("$@" --test guest -- --list) || return 1
    for filter in "${second[@]}"; do
        # The name of a scenario that was renamed would select none, and nothing would fail.
        grep -q "$filter.*: test$" <<<"$all" || { echo "tests-all.sh: no guest is called $filter" >&2; return 1; }
    done
    RAPID_VBENCH_BACKEND=qemu "$@" --test guest -- --test-threads=2 "${second[@]}"
}

# In a build of all of them a crate has the features of its dependencies that another one asks for.
each_crate() {
    local manifest
    for manifest in src/*/Cargo.toml; do
        cargo check --locked --quiet --all-targets --manifest-path "$manifest" || { echo "tests-all.sh: $manifest" >&2; return 1; }
    done
}

"$@" --no-run --test guest --test smoke
part "guests on an emulated machine" second_opinion "$@"
part "90 cycles" "$@" --test guest -- --ignored
part "sections of make bench" "$@" --test smoke -- --ignored
part "unit tests, each case of them" env RAPID_THOROUGH=1 "$@" --lib
part "statistics of the simulated touch" "$@" --lib -- --ignored touch::
part "each crate alone" each_crate
part "cargo features" scripts/features.sh '' cameras export foxglove graphics lan motors policy web
part "fuzzing" env FUZZ_SECONDS="${FUZZ_SECONDS:-20}" scripts/fuzz.sh
if [[ -x $cache/train-venv/bin/python ]]; then part "train-test" make train-test; else skip train-test "its Python is not there: make train-test fetches 6 GB"; fi
if [[ -x $cache/venv-lerobot/bin/python ]]; then part "lerobot-test" make lerobot-test; else skip lerobot-test "its Python is not there: make lerobot-test fetches 8 GB"; fi
if [[ -d $cache/fleet ]]; then part "fleet-test" make fleet-test; else skip fleet-test "its servers are not there: make fleet-test fetches 2 GB"; fi

printf '\n'
printf 'test-all: %s\n' "${table[@]}"
exit "$failed"
