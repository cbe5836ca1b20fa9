#!/usr/bin/env bash
# Runs a command and fails if it leaves files behind in /dev/shm or in the folder for temporary files.
#
#     leftovers.sh COMMAND...           leftovers.sh cargo test --workspace
#
# The command gets its own TMPDIR, in which nothing may be left. In /dev/shm and in /tmp/iceoryx2, which all programs
# share, only new names of rapid and of its bus count that no process has open or mapped. Files left in TMPDIR are
# removed; others are listed and stay. The exit code is the command's, or 1.
set -euo pipefail
[[ $# -ge 1 ]] || { echo "usage: leftovers.sh COMMAND..." >&2; exit 2; }

# Our files in shared places, one path per line. The bus names its folders only by numbers.
shared() {
    {
        find /dev/shm -mindepth 1 -maxdepth 1 \( -name 'iox2_*' -o -name 'rapid*' \) || true
        find /tmp/iceoryx2 -mindepth 1 ! -path /tmp/iceoryx2/nodes ! -path /tmp/iceoryx2/services || true
    } 2>/dev/null | sort
}

in_use() {
    grep -qsF -- " $1" /proc/[0-9]*/maps && return 0
    [[ -n $(find /proc/[0-9]*/fd -lname "$1" -print -quit 2>/dev/null) ]]
}

temporary=$(mktemp -d)
readonly temporary
# Like /tmp: tests that run as two users enter it.
chmod 1777 "$temporary"
trap 'rm -rf "$temporary"' EXIT
before=$(shared)

# In the background: a signal ends the command at once, and then this script, which looks at what it left.
RAPID_OUTER_TMPDIR=${TMPDIR:-/tmp} TMPDIR=$temporary "$@" <&0 &
readonly command=$!
trap 'kill "$command" 2>/dev/null || true' HUP INT TERM
while :; do
    code=0
    wait "$command" || code=$?
    kill -0 "$command" 2>/dev/null || break
done

left=$(find "$temporary" -mindepth 1 -maxdepth 1 -printf '%p\n' | sort)
while IFS= read -r path; do
    if [[ -n $path && -e $path ]] && ! in_use "$path"; then left+=$'\n'$path; fi
done < <(comm -13 <(printf '%s\n' "$before") <(shared))
left=$(sed '/^$/d' <<<"$left")
if [[ -n $left ]]; then
    echo "left behind by: $*" >&2
    # With what is in a folder: its name says nothing of who made it. It may be long, or gone by now: find then fails.
    while IFS= read -r path; do { find "$path" 2>/dev/null || true; } | head -n 20 | sed 's/^/    /' >&2; done <<<"$left"
    [[ $code != 0 ]] || code=1
fi
exit "$code"
