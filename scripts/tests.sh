#!/usr/bin/env bash
# Runs the tests of a workspace that is built, those of the virtual bench beside the others: both spend much of their time
# waiting, for an emulated machine and for clocks. What the bench prints comes behind what the others print.
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

# Each of them needs the machine's two cores: one after the other.
bench() {
    cd "$package"
    local code=0
    while IFS= read -r executable; do
        printf '     Running %s\n' "$executable"
        "$executable" </dev/null || { code=1; printf 'error: %s failed\n' "$executable"; }
    done <<<"$executables"
    return "$code"
}

output=$(mktemp)
trap 'kill $(jobs -p) 2>/dev/null; rm -f "$output"' EXIT
bench >"$output" 2>&1 &
code=0
"$@" --no-fail-fast --exclude vbench || code=1
echo "     Waiting for the virtual bench"
wait $! || code=1
cat "$output"
exit "$code"
