#!/usr/bin/env bash
# Runs the tests of a built workspace, those of the virtual bench in parallel with the others: both spend much of their
# time waiting, for an emulated machine and for clocks. The bench's output is printed after that of the others.
#
#     tests.sh cargo test --locked --workspace
#
# The exit code is 0 if all passed.
set -euo pipefail
[[ $# -ge 1 ]] || { echo "usage: tests.sh CARGO TEST..." >&2; exit 2; }

readonly package=tests/vbench
messages=$("$@" --no-run --message-format=json)
executables=$(sed -n "s|.*\"manifest_path\":\"[^\"]*/$package/Cargo.toml\".*\"profile\":{[^}]*\"test\":true}.*\"executable\":\"\([^\"]*\)\".*|\1|p" <<<"$messages")
[[ -n $executables ]] || { echo "tests.sh: no tests in $package" >&2; exit 1; }

# Each of them needs the machine's two cores, so they run in sequence. While a guest runs, the next one is prepared.
bench() {
    cd "$package"
    local code=0
    while IFS= read -r executable; do
        printf '     Running %s\n' "$executable"
        RUST_TEST_THREADS=2 "$executable" </dev/null || { code=1; printf 'error: %s failed\n' "$executable"; }
    done <<<"$executables"
    return "$code"
}

output=$(mktemp)
# In its own process group: a signal that ends this script also ends the bench and its machines.
set -m
bench >"$output" 2>&1 &
readonly job=$!
set +m
finish() {
    kill -- "-$job" 2>/dev/null && wait "$job" || true
    cat "$output"
    rm -f "$output"
}
trap finish EXIT
code=0
"$@" --no-fail-fast --exclude vbench || code=1
echo "     Waiting for the virtual bench"
wait "$job" || code=1
exit "$code"
