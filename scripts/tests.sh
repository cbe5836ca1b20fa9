#!/usr/bin/env bash
# Builds and runs the tests of the workspace, in three steps:
#
# 1. All programs are compiled, and beside them the guest of the virtual bench and its kernel, if they are missing.
# 2. The guests run, one per processor.
# 3. The tests of the host run: those of the program, which wait more than they compute, beside all others, of which the unit
#    tests are the last: they compute most. Those that count allocations take four times as long beside the program: they begin.
#    The unit tests of the bus make files of killed processes, which each start of the program removes: they run before.
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

# behind PROGRAM: a test program that computes, beside some that wait for clocks and for programs.
behind() { nice -n 5 "$1"; }

jobs=()
# Of what runs beside something else.
output=$(mktemp)
list=$(mktemp)
# Tests add lines to it (tests/support/skip.rs).
RAPID_SKIPPED=$(mktemp)
export RAPID_SKIPPED
finish() {
    local job
    for job in "${jobs[@]}"; do kill -- "-$job" 2>/dev/null && wait "$job" || true; done
    cat "$output"
    rm -f "$output" "$list" "$RAPID_SKIPPED"
}
trap finish EXIT

# Begins a job. Each has a process group of its own: a signal that ends this script also ends all that it runs.
aside() {
    set -m
    "$@" &
    set +m
    jobs+=("$!")
}

# Waits for all jobs; fails if one did. Another program may get the number of one that has ended: they are forgotten.
ended() {
    local job code=0
    for job in "${jobs[@]}"; do wait "$job" || code=1; done
    jobs=()
    return "$code"
}

# Whoever may be asked for a password, now or when a cached one has expired, has the guest built first: the output of cargo would
# hide the question.
# Not in the folder for temporary files that leftovers.sh removes.
make_guest() {
    TMPDIR=${RAPID_OUTER_TMPDIR:-/tmp} "$here/setup.sh" image && return
    echo "tests.sh: the guest of the virtual bench could not be built: see the lines above that begin with 'vbench image:' or 'setup:'" >&2
    return 1
}
if [[ $(id -u) = 0 ]] || sudo -k -n true 2>/dev/null; then aside make_guest </dev/null; else make_guest; fi
aside programs "$@" </dev/null >"$list"
wait "${jobs[-1]}" || { echo "tests.sh: not built" >&2; exit 1; }
ended || exit 1

# of NAME: the test program of this name.
of() {
    local found
    found=$(grep -c "/deps/$1-[0-9a-f]*$" "$list") || true
    [[ $found = 1 ]] || { echo "tests.sh: $found test programs of the name $1 were built, not one" >&2; exit 1; }
    grep "/deps/$1-[0-9a-f]*$" "$list"
}
guest=$(of guest)
memory=$(of memory)
program=$(of program)
unit=$(of rapid)
bus=$(of rapid_bus)
waiting() {
    local code=0
    run env <<<"$memory" || code=1
    run env RUST_TEST_THREADS="$((4 * $(nproc)))" <<<"$program" || code=1
    return "$code"
}
computing() {
    local code=0
    run env <<<"$(grep -vE '/deps/(guest|memory|program|rapid|rapid_bus)-[0-9a-f]*$' "$list")" || code=1
    "$here/models-tests.sh" || code=1
    run behind <<<"$unit" || code=1
    echo "     Waiting for the tests of the program"
    return "$code"
}

code=0
aside run env RUST_TEST_THREADS="$(nproc)" <<<"$guest"
ended || code=1
aside run env <<<"$bus"
ended || code=1
aside waiting </dev/null >"$output" 2>&1
aside computing </dev/null
ended || code=1
cat "$output"
: >"$output"
"$here/skips.sh" "$RAPID_SKIPPED" || code=1
exit "$code"
