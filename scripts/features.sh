#!/usr/bin/env bash
# Checks that the program compiles, and passes the lints, with each of these sets of cargo features alone.
#
#     features.sh SET...        '' is the smallest program
set -euo pipefail
[[ $# -ge 1 ]] || { echo "usage: features.sh SET..." >&2; exit 2; }
for features; do
    printf '     Features %s\n' "${features:-none}"
    cargo check --quiet --locked --package rapid --bin rapid --no-default-features --features "$features"
done
