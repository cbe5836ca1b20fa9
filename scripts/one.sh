#!/usr/bin/env bash
# Builds what one test needs and runs it with its output, wherever it is in the workspace.
#
#     one.sh NAME CARGO TEST...         one.sh plugging_again cargo test --locked --workspace
#
# NAME is the name of a test or a part of it (`plugging_again`), with or without its modules (`process::plugging`), or a
# module (`second_run`, `guest`): then all its tests run. The exit code is 0 if at least one test ran and all passed.
set -euo pipefail
[[ $# -ge 2 && -n $1 ]] || { echo "usage: one.sh NAME CARGO TEST..." >&2; exit 2; }
readonly name=$1 last=${1##*::}
shift
cd "$(dirname "${BASH_SOURCE[0]}")/.."
[[ $last =~ ^[A-Za-z0-9_]+$ ]] || { echo "one.sh: not a name of a test: $name" >&2; exit 2; }

# Files that contain a test of that name, or else a module of that name; a few tests are named in a macro or a table.
[[ $name == *::* ]] && readonly first=${name%%::*} || readonly first=
sources() { git ls-files --cached --others --exclude-standard -- '*.rs' | grep -E "$1" || true; }
tests() { LAST=$last xargs perl -0ne 'print "$ARGV\n" if /#\[(tokio::)?test\b[^\]]*\](\s*(#\[|\/\/)[^\n]*)*\s*(async )?fn \w*$ENV{LAST}/'; }
mapfile -t files < <(sources "${first:-.}" | tests)
[[ ${#files[@]} -gt 0 ]] || mapfile -t files < <(sources "(^|/)$last(/|\.rs$)")
[[ ${#files[@]} -gt 0 ]] || mapfile -t files < <(sources "(^|/)tests/.*${first}" | xargs grep -lE "$last" || true)

# The name of a whole test program selects all its tests.
filter=$name
mapfile -t whole < <(sources "^tests/([a-z]*/tests/)?$name(/main)?\.rs$")
[[ ${#whole[@]} -eq 0 ]] || files=("${whole[@]}") filter=

# The cargo targets that contain these files. The program that they start is built as for the other tests: cargo does
# that for those of its package.
targets=() beside=() all='' guest=''
for file in "${files[@]}"; do
    case $file in
        tests/vbench/tests/*) target="--test guest" guest=yes beside+=(--test program) ;;
        tests/bench/tests/*) target="--test smoke" all=yes ;;
        tests/bench/src/*) target="--bin rapid-bench" ;;
        tests/vbench/src/* | tests/fuzz/src/* | examples/c/*.rs) target=--lib ;;
        src/*)
            target=--lib
            # In a crate of its own the names of tests begin below it.
            [[ -z $filter || ! -e ${file%/*}/Cargo.toml ]] || filter=$last
            ;;
        # They start examples, which cargo builds only together with all others.
        tests/program/process.rs | tests/program/docs.rs) target="--test program" all=yes ;;
        tests/support/*) target="--test program" ;;
        tests/*/tests/*.rs | examples/*/tests/*.rs) target="--test $(basename "$file" .rs)" ;;
        tests/*/*) target=${file#tests/} target="--test ${target%%/*}" ;;
        tests/*.rs) target="--test $(basename "$file" .rs)" ;;
        *) continue ;;
    esac
    [[ " ${targets[*]} " == *" $target "* ]] || targets+=("$target")
done
[[ ${#targets[@]} -gt 0 ]] || { echo "one.sh: no test named $name" >&2; exit 1; }

# shellcheck disable=SC2206 # a target is a word or two
targets=(${targets[*]})
[[ -z $guest ]] || { RUST_TEST_THREADS=$(nproc); export RUST_TEST_THREADS; }
if [[ $all ]]; then "$@" --no-run; elif [[ ${#beside[@]} -gt 0 ]]; then "$@" --no-run "${targets[@]}" "${beside[@]}"; fi
output=$(mktemp)
trap 'rm -f "$output"' EXIT
"$@" --no-fail-fast "${targets[@]}" -- --nocapture ${filter:+"$filter"} 2>&1 | tee "$output"
grep -qE '^running [1-9]|^test .* ok$' "$output" || { echo "one.sh: no test named $name" >&2; exit 1; }
