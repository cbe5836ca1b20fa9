#!/usr/bin/env bash
# Runs the guests of the virtual bench several times, and prints each asserted time (check::takes): in how many runs, the least and the
# most of them in ms, and what lies between these. Beside busy loops: scripts/busy.sh 4 scripts/guests.sh ...
#
#     guests.sh TIMES CARGO TEST...         guests.sh 10 cargo test --locked --workspace
#
# The exit code is 0 if all passed each time.
set -euo pipefail
[[ $# -ge 3 && $1 =~ ^[0-9]+$ ]] || { echo "usage: guests.sh TIMES CARGO TEST..." >&2; exit 2; }
readonly times=$1
shift
cd "$(dirname "${BASH_SOURCE[0]}")/.."
output=$(mktemp)
trap 'rm -f "$output" "$output.run"' EXIT
code=0
for ((time = 1; time <= times; time++)); do
    started=$SECONDS
    "$@" --test guest -- --test-threads="$(nproc)" --nocapture >"$output.run" 2>&1 || { code=1; grep -aE 'panicked|^test .*FAILED' -A 3 "$output.run" || tail -n 20 "$output.run"; }
    cat "$output.run" >>"$output"
    printf 'guests: run %s: %s in %s s\n' "$time" "$(grep -a '^test result' "$output.run" | cut -d. -f1-2 || echo 'no result')" "$((SECONDS - started))"
done
sed -n 's/^\([a-z-]*: .*\): \([0-9.-]*\) ms$/\1\t\2/p' "$output" | awk -F'\t' '
    !($1 in n) { least[$1] = most[$1] = $2; order[++count] = $1 }
    { n[$1]++; if ($2 < least[$1]) least[$1] = $2; if ($2 > most[$1]) most[$1] = $2 }
    END { for (at = 1; at <= count; at++) { what = order[at]; printf "%4d  %10.3f  %10.3f  %8.3f  %s\n", n[what], least[what], most[what], most[what] - least[what], what } }'
exit "$code"
