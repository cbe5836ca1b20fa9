#!/usr/bin/env bash
# Makes a Python environment in the cache, or finds it there, and prints the path of its Python.
#
#     venv.sh NAME REQUIREMENTS [PIP-OPTION...]
#
# It is complete if its stamp, written last, names the present requirements and its Python runs: an interrupted run
# leaves nothing that a later one would take for complete.
set -euo pipefail

readonly requirements=$2 venv=${XDG_CACHE_HOME:-$HOME/.cache}/rapid/$1
mkdir -p "${venv%/*}"
# Two simultaneous runs would create it in the same place.
exec 9>"$venv.lock"
flock 9
stamp=$(sha256sum <"$requirements")
if [[ $(cat "$venv/stamp" 2>/dev/null) != "$stamp" ]] || ! "$venv/bin/python" -c '' 2>/dev/null; then
    echo "venv: creating the Python environment $venv" >&2
    rm -rf "$venv"
    python3 -m venv "$venv"
    "$venv/bin/python" -m pip install --quiet --disable-pip-version-check --only-binary=:all: "${@:3}" -r "$requirements" >&2
    echo "$stamp" >"$venv/stamp"
fi
echo "$venv/bin/python"
