#!/usr/bin/env bash
# Builds and runs the tests of the workspace, in three steps, each of which has the processors to itself:
#
# 1. The programs that guests of the virtual bench need are compiled, and beside them the guest and its kernel, if they are missing.
# 2. The guests run, one per processor, ahead of everything else where that is allowed, while the remaining tests are compiled.
# 3. The tests of the host run, which wait more than they compute.
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

readonly package=tests/vbench
# The test programs of that package, one path per line, of those that are built with these options.
programs() {
    "$@" --no-run --message-format=json-render-diagnostics \
        | sed -n "s|.*\"manifest_path\":\"[^\"]*/$package/Cargo.toml\".*\"profile\":{[^}]*\"test\":true}.*\"executable\":\"\([^\"]*\)\".*|\1|p"
}

# What runs beside a guest takes only what the guest leaves of the processors.
idle() {
    if chrt --idle 0 true 2>/dev/null; then chrt --idle 0 "$@"; else nice -n 19 "$@"; fi
}

# A user who is not root may be asked for a password, which the output of cargo would hide: for them the guest is built first.
# It has its own process group, as the bench below, and not the folder for temporary files that leftovers.sh removes.
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
# In process groups of their own: a signal that ends this script also ends the bench and its machines.
set -m
image=
if [[ $(id -u) = 0 ]]; then
    make_guest </dev/null &
    image=$!
    jobs+=("$image")
else
    make_guest
fi
set +m

# With any test of a package its programs are built, too. The unit tests are the longest compilation: here it is beside that
# of the library, which takes one processor. The examples are those that guests run: `cargo test` gives them their place only
# when everything else is built.
guest=$(programs "$@" --lib --test guest --test layering | grep /guest-) || { echo "tests.sh: the tests of $package are not built" >&2; exit 1; }
"$1" build "${@:3}" --example process_node --example publish_action
[[ -z $image ]] || wait "$image" || { echo "tests.sh: the guest of the virtual bench could not be built: see the lines above that begin with 'vbench image:' or 'setup:'" >&2; exit 1; }

set -m
(cd "$package" && printf '     Running %s\n' "$guest" && RUST_TEST_THREADS=$(nproc) "$guest" </dev/null) >"$output" 2>&1 &
readonly bench=$!
jobs+=("$bench")
set +m
code=0
units=$(programs idle "$@" | grep -v /guest-) || { echo "tests.sh: not built" >&2; exit 1; }
idle "$here/features.sh" '' || code=1
echo "     Waiting for the virtual bench"
wait "$bench" || code=1
"$@" --no-fail-fast --exclude vbench || code=1
for unit in $units; do
    (cd "$package" && "$unit") || { code=1; echo "error: $unit failed"; }
done
"$here/models-tests.sh" || code=1
cat "$output"
: >"$output"
"$here/skips.sh" "$RAPID_SKIPPED" || code=1
exit "$code"
