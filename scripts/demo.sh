#!/usr/bin/env bash
# Records ten seconds of the simulated rig and shows the contents of the file.
#
#     demo.sh RAPID FOLDER
set -euo pipefail
rapid=$1
folder=$2

mkdir -p "$folder"
began=$(mktemp "$folder/.began.XXXXXX")
trap 'rm -f "$began"' EXIT
"$rapid" --sim --headless --record --duration 10s --out "$folder" --task demo
episode=$(find "$folder" -name '*.mcap' -newer "$began" -print -quit)
[[ -n $episode ]] || { echo "demo: no episode was written to $folder" >&2; exit 1; }
"$rapid" inspect "$episode"
echo
echo "Open $episode in Foxglove (File > Open local file): pictures, joint values and the mask are topics."
echo "On a terminal, 'make demo' shows the monitor instead: run $rapid --sim"
