#!/usr/bin/env bash
# Builds and runs the tests of the workspace, in three steps:
#
# 1. The programs that guests of the virtual bench need are compiled, and beside them the guest and its kernel, if they are missing.
# 2. The guests run, one per processor, ahead of everything else where that is allowed, while the remaining tests are compiled.
# 3. The tests of the host run: those of the program, which wait more than they compute, beside all others. The unit tests of
#    bus::leftovers make files of killed processes, which each start of the program removes: they run before.
#
# Guests are judged by virtual time and need no idle machine; the tests of the host judge no time, but are waited for less on one.
# At the end it lists which tests were skipped.
#
#     tests.sh cargo test --locked --workspace
#
# The exit code is 0 if all passed.
set -euo pipefail
[[ $# -ge 2 ]] || { echo "usage: tests.sh CARGO TEST..." >&2; exit 2; }
here=$(realpath "${0%/*}")

# The test programs that are built with these options: the folder of the package, a tab and the program, a line each. They are run
# directly: of two runs of cargo, one would wait for the other.
programs() {
    "$@" --no-run --message-format=json-render-diagnostics \
        | sed -n "s|.*\"manifest_path\":\"\([^\"]*\)/Cargo.toml\".*\"profile\":{[^}]*\"test\":true}.*\"executable\":\"\([^\"]*\)\".*|\1\t\2|p"
}

# run COMMAND...: each line of the input, a package and a program, by this command; fails if one of them does, after all have run.
run() {
    local folder program code=0
    while IFS=$'\t' read -r folder program; do
        printf '     Running %s\n' "$program"
        (cd "$folder" && "$@" "$program" </dev/null) || { code=1; echo "error: $program failed"; }
    done
    return "$code"
}

# with ARGUMENT... PROGRAM: a test program with these arguments.
with() { "${@: -1}" "${@:1:$# - 1}"; }

# The same for tests that compute, beside some that wait for clocks and for programs.
behind() { nice -n 5 "${@: -1}" "${@:1:$# - 1}"; }

# What runs beside guests takes what they leave of the processors. Not the idle class: on a busy machine it would never end.
beside() {
    if chrt --rr 1 true 2>/dev/null; then "$@"; else nice -n 5 "$@"; fi
}

# A user who is not root may be asked for a password, which the output of cargo would hide: for them the guest is built first.
# It has its own process group, as the jobs below, and not the folder for temporary files that leftovers.sh removes.
make_guest() { TMPDIR=${RAPID_OUTER_TMPDIR:-/tmp} "$here/setup.sh" image; }
jobs=()
output=$(mktemp)
# Tests add lines to it (tests/support/skip.rs).
RAPID_SKIPPED=$(mktemp)
export RAPID_SKIPPED
finish() {
    local job
    for job in "${jobs[@]}"; do kill -- "-$job" 2>/dev/null && wait "$job" || true; done
    cat "$output"
    rm -f "$output" "$RAPID_SKIPPED"
}
trap finish EXIT
image=
if [[ $(id -u) = 0 ]]; then
    # In process groups of their own: a signal that ends this script also ends them and their machines.
    set -m
    make_guest </dev/null &
    image=$!
    set +m
    jobs+=("$image")
else
    make_guest
fi

# With any test of a package its programs are built, too. The unit tests are the longest compilation: here it is beside that
# of the library, which takes one processor. The examples are those that guests run: `cargo test` gives them their place only
# when everything else is built.
guest=$(programs "$@" --lib --test guest --test layering | grep /guest-) || { echo "tests.sh: the tests of the virtual bench are not built" >&2; exit 1; }
"$1" build "${@:3}" --example process_node --example publish_action
[[ -z $image ]] || wait "$image" || { echo "tests.sh: the guest of the virtual bench could not be built: see the lines above that begin with 'vbench image:' or 'setup:'" >&2; exit 1; }
# Only those that run: another program may get the number of one that has ended.
jobs=()

set -m
run env RUST_TEST_THREADS="$(nproc)" <<<"$guest" >"$output" 2>&1 &
readonly bench=$!
set +m
jobs+=("$bench")
code=0
hosted=$(programs beside "$@" | grep -v /guest-) || { echo "tests.sh: not built" >&2; exit 1; }
echo "     Waiting for the virtual bench"
wait "$bench" || code=1
jobs=()
cat "$output"

unit=$(grep /deps/rapid- <<<"$hosted") || { echo "tests.sh: the unit tests are not built" >&2; exit 1; }
run with bus::leftovers <<<"$unit" || code=1
set -m
run env RUST_TEST_THREADS="$((4 * $(nproc)))" <<<"$(grep /program- <<<"$hosted")" >"$output" 2>&1 &
readonly waiting=$!
set +m
jobs+=("$waiting")
run behind --skip bus::leftovers <<<"$unit" || code=1
run env <<<"$(grep -v -e /program- -e /deps/rapid- <<<"$hosted")" || code=1
"$here/models-tests.sh" || code=1
echo "     Waiting for the tests of the program"
wait "$waiting" || code=1
jobs=()
cat "$output"
: >"$output"
"$here/skips.sh" "$RAPID_SKIPPED" || code=1
exit "$code"
