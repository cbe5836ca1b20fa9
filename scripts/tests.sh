#!/usr/bin/env bash
# Builds and runs the tests of the workspace, those of the virtual bench in parallel with everything else: they take the
# longest and need only the programs, so they begin as soon as these are built. What is built later leaves the processors
# to the emulated machines. The bench's output is printed after that of the others.
# Its guest is built before all that, if it is missing; for root, while the programs are compiled.
#
#     tests.sh cargo test --locked --workspace
#
# The exit code is 0 if all passed.
set -euo pipefail
[[ $# -ge 2 ]] || { echo "usage: tests.sh CARGO TEST..." >&2; exit 2; }

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

# Building the guest takes most of a minute on a fresh machine; later runs find it built. A user who is not root may be asked for
# a password, which the output of cargo would hide: for them it is built first. It has its own process group, as the bench
# below, and not the folder for temporary files that leftovers.sh removes.
make_guest() { TMPDIR=${RAPID_OUTER_TMPDIR:-/tmp} "${0%/*}/setup.sh" image; }
image=
if [[ $(id -u) = 0 ]]; then
    set -m
    make_guest </dev/null &
    image=$!
    set +m
    trap 'kill -- "-$image" 2>/dev/null && wait "$image" || true' EXIT
else
    make_guest
fi

# With any test of a package its programs are built, too. The unit tests are the longest compilation: here it is beside that
# of the library, which takes one processor, and beside the guests it would take as long as they do. The examples are those
# that guests run: `cargo test` gives them their place only when everything else is built.
guest=$(programs "$@" --lib --test guest --test layering | grep /guest-) || { echo "tests.sh: the tests of $package are not built" >&2; exit 1; }
"$1" build "${@:3}" --example process_node --example publish_action
[[ -z $image ]] || wait "$image" || { echo "tests.sh: the guest of the virtual bench could not be built: see the lines above that begin with 'vbench image:' or 'setup:'" >&2; exit 1; }
# These run when nothing else does. rapid stops motors that answer too late, and on a machine that stands still for a second they
# do; what a camera's latency is measured by, and what the bench shows of itself, is when samples come; a chunk of the policy
# takes all of an emulated processor for seconds.
readonly alone=(adapters:: arm:: brake:: calibrate:: guard:: motors:: policy:: scenarios::bench_shows)
# A guest needs the machine's two cores, so they run in sequence. While one runs, the next is prepared.
bench() {
    printf '     Running %s %s\n' "$guest" "$*"
    # The tests of the program beside it wait more than they compute, and have less time for it than a guest has.
    (cd "$package" && RUST_TEST_THREADS=2 nice -n 5 "$guest" "$@" </dev/null)
}

output=$(mktemp)
# In its own process group: a signal that ends this script also ends the bench and its machines.
set -m
bench "${alone[@]/#/--skip=}" >"$output" 2>&1 &
readonly job=$!
set +m
finish() {
    kill -- "-$job" 2>/dev/null && wait "$job" || true
    cat "$output"
    rm -f "$output"
}
trap finish EXIT
code=0
units=$(programs idle "$@" | grep -v /guest-) || { echo "tests.sh: not built" >&2; exit 1; }
host=$(rustc -vV | sed -n 's/^host: //p' | tr 'a-z-' 'A-Z_')
export "CARGO_TARGET_${host}_RUNNER=$(realpath "${0%/*}/runner.sh")"
"$@" --no-fail-fast --exclude vbench || code=1
for unit in $units; do
    (cd "$package" && "$unit") || { code=1; echo "error: $unit failed"; }
done
idle "${0%/*}/features.sh" '' || code=1
echo "     Waiting for the virtual bench"
wait "$job" || code=1
bench "${alone[@]}" || code=1
exit "$code"
