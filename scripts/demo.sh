#!/usr/bin/env bash
# The demonstration. On a terminal: the monitor leads through an unplug, and then a policy through another. Otherwise: ten
# seconds of the simulated rig are recorded, and the contents of the file are shown.
#
#     demo.sh RAPID FOLDER
set -euo pipefail
rapid=$1
folder=$2

mkdir -p "$folder"
if [[ -t 0 && -t 1 ]]; then
  "$rapid" --sim --tour --out "$folder" --task demo
  echo
  echo 'Next: a policy moves a simulated arm and loses a sensor. Enter: start, ctrl-c: end.'
  read -r || exit 0
  exec "$rapid" --infer --sim task --monitor --tour --out "$folder" --task demo
fi
began=$(mktemp "$folder/.began.XXXXXX")
trap 'rm -f "$began"' EXIT
"$rapid" --sim --headless --record --duration 10s --out "$folder" --task demo
episode=$(find "$folder" -name '*.mcap' -newer "$began" -print -quit)
[[ -n $episode ]] || { echo "demo: no episode was written to $folder" >&2; exit 1; }
"$rapid" inspect "$episode"
echo
echo "Open $episode in Foxglove (File > Open local file): pictures, joint values and the mask are topics."
echo "On a terminal, 'make demo' shows the monitor instead: run $rapid --sim"
