#!/usr/bin/env bash
# Fuzzes every parser of foreign bytes with libFuzzer, guided by coverage, each for FUZZ_SECONDS (60).
#
#     fuzz.sh [TARGET...]
#
# The stable compiler instruments by flags passed to LLVM (the ones cargo-fuzz uses), so no nightly is needed; there is
# no address sanitizer then, which matters little for code without `unsafe`. The corpus is kept in target/fuzz/corpus
# and used by the next run. An input that breaks an invariant is in target/fuzz/found: the last lines print how to
# reproduce it, and where to put it so that the tests run it from then on.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

readonly SECONDS_EACH="${FUZZ_SECONDS:-60}"
readonly PLACE="${CARGO_TARGET_DIR:-$PWD/target}/fuzz"
triple=$(rustc -vV | sed -n 's/^host: //p')
instrumented="-Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 -Cllvm-args=-sanitizer-coverage-inline-8bit-counters \
-Cllvm-args=-sanitizer-coverage-pc-table -Cllvm-args=-sanitizer-coverage-trace-compares -Cdebug-assertions --cfg fuzzing"

# With a target named, build scripts and procedural macros are built without these flags.
export CARGO_PROFILE_RELEASE_LTO=off CARGO_PROFILE_RELEASE_STRIP=none CARGO_PROFILE_RELEASE_DEBUG=line-tables-only
RUSTFLAGS="${RUSTFLAGS:-} $instrumented" cargo build --locked --release -p fuzz --features libfuzzer --bin libfuzzer \
    --target "$triple" --target-dir "$PLACE"
readonly BIN="$PLACE/$triple/release"
# Listing and replaying do not need the instrumentation, and cannot be linked with it.
cargo build --locked -p fuzz --bin fuzz
readonly FUZZ="${CARGO_TARGET_DIR:-$PWD/target}/debug/fuzz"

mkdir -p "$PLACE/found"
"$FUZZ" seeds "$PLACE/seeds"
targets=("$@")
[[ ${#targets[@]} -gt 0 ]] || mapfile -t targets < <("$FUZZ" list)

broken=()
for target in "${targets[@]}"; do
    mkdir -p "$PLACE/corpus/$target" "$PLACE/log"
    log=$PLACE/log/$target.log
    from=("$PLACE/corpus/$target" "$PLACE/seeds/$target")
    [[ ! -d tests/fuzz/cases/$target ]] || from+=("tests/fuzz/cases/$target")
    if FUZZ_TARGET=$target "$BIN/libfuzzer" -max_total_time="$SECONDS_EACH" -timeout=10 -rss_limit_mb=2048 \
        -malloc_limit_mb=1024 -max_len=16384 -print_final_stats=1 -verbosity=1 -artifact_prefix="$PLACE/found/$target-" \
        "${from[@]}" >"$log" 2>&1; then
        runs=$(sed -n 's/^stat::number_of_executed_units: *//p' "$log")
        cover=$(grep -o 'cov: [0-9]*' "$log" | tail -n 1)
        printf 'fuzz: %-10s %12s inputs, %s edges, no complaint\n' "$target" "$runs" "${cover#cov: }"
    else
        broken+=("$target")
        printf 'fuzz: %-10s BROKEN; the log is %s\n' "$target" "$log"
        grep -m 1 -A 2 -E 'panicked at|ERROR: libFuzzer' "$log" || tail -n 20 "$log"
    fi
done
[[ ${#broken[@]} -eq 0 ]] || {
    ls "$PLACE/found"
    echo "fuzz: again with: cargo run -p fuzz --bin fuzz run TARGET FILE"
    echo "fuzz: fixed, keep the file as tests/fuzz/cases/TARGET/NAME"
    exit 1
}
