#!/usr/bin/env bash
# Runs a command beside busy loops, to find tests that judge the machine and not the program.
#
#     busy.sh LOOPS COMMAND...          busy.sh 2 make test
#
# The loops end with this script, however it ends; the exit code is the command's.
set -euo pipefail
[[ $# -ge 2 && $1 =~ ^[0-9]+$ ]] || { echo "usage: busy.sh LOOPS COMMAND..." >&2; exit 2; }
readonly loops=$1
shift

pids=()
stop() { [[ ${#pids[@]} = 0 ]] || kill "${pids[@]}" 2>/dev/null || true; }
trap stop EXIT
trap 'exit 130' INT
trap 'exit 143' TERM HUP

readonly parent=$$
for ((loop = 0; loop < loops; loop++)); do
    # Each checks regularly whether the script still runs: SIGKILL runs no trap.
    (
        trap - EXIT INT TERM HUP
        while kill -0 "$parent" 2>/dev/null; do
            for ((spin = 0; spin < 500000; spin++)); do :; done
        done
    ) &
    pids+=($!)
done
# In the background, so that a signal takes effect at once and not when the command has ended.
"$@" <&0 &
readonly command=$!
pids+=("$command")
code=0
wait "$command" || code=$?
exit "$code"
