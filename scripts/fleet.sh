#!/usr/bin/env bash
# Tests what needs more than a rig: the upload, the page for a phone in Chromium, sensors of another computer, a cluster's export,
# UMI's replay buffer, Rerun. Fetches 2 GB of Go's modules, crates, Python packages and a browser once, and is not part of
# `make test`.
#
# RAPID_BIN is the program, which `make fleet-test` builds. The last lines are a table: each part, and whether it ran, was skipped
# and why, or failed. What was skipped is a failure, unless FLEET_MAY_SKIP=1.
set -euo pipefail
cd "$(dirname "$0")/.."

readonly server=github.com/versity/versitygw/cmd/versitygw@v1.8.0
# Of the version of zenoh that examples/remote has.
readonly router=1.10.2
cache=${XDG_CACHE_HOME:-$HOME/.cache}/rapid/fleet
sudo=
[[ $(id -u) == 0 ]] || sudo=sudo

table=() skipped=0 part=
begin() {
  part=$1
  printf 'fleet: %s\n' "$part" >&2
}
ran() {
  table+=("ran      $part")
  part=
}
skip() { # NAME REASON
  table+=("SKIPPED  $1: $2")
  skipped=$((skipped + 1))
}
report() {
  local status=$?
  if [[ -n $part ]]; then
    table+=("FAILED   $part; what follows it did not run")
  elif [[ $status != 0 ]]; then
    table+=("FAILED   the preparation of the next part; what follows did not run")
  fi
  [[ ${#table[@]} == 0 ]] || printf 'fleet: %s\n' "${table[@]}" >&2
  if [[ $status == 0 && $skipped != 0 && ${FLEET_MAY_SKIP:-} != 1 ]]; then
    printf 'fleet: skipped: %s, which is a failure: FLEET_MAY_SKIP=1 permits it\n' "$skipped" >&2
    status=1
  fi
  rm -f "${notes:-}"
  exit "$status"
}

if [[ ! -x ${RAPID_BIN:-} ]]; then
  echo "fleet: there is no program at RAPID_BIN='${RAPID_BIN:-}': run make fleet-test, which builds it, or set RAPID_BIN to one" >&2
  exit 2
fi
RAPID_BIN=$(realpath "$RAPID_BIN")
export RAPID_BIN
notes=$(mktemp)
trap report EXIT

install() { # COMMAND PACKAGE...
  if ! command -v "$1" >/dev/null; then
    echo "fleet: installing ${*:2}" >&2
    $sudo apt-get update -q
    $sudo apt-get install -y -q --no-install-recommends "${@:2}"
  fi
}

begin "upload to an S3 server"
install rclone rclone
if [[ ! -x $cache/versitygw ]]; then
  install go golang-go ca-certificates
  echo "fleet: building the S3 server of the test, once" >&2
  GOBIN=$cache go install "$server"
fi
python3 tests/fleet/upload.py udev/rapid-upload.service udev/rapid-upload-check.service "$cache/versitygw"
ran

begin "the page for a phone, in Chromium"
install chromium chromium
python3 tests/fleet/page.py "$RAPID_BIN" "$(command -v chromium)" "$cache/page"
ran

begin "sensors of another computer: unit tests of rapid-remote"
remote=(--locked --manifest-path examples/remote/Cargo.toml --target-dir "$cache/remote")
cargo test "${remote[@]}"
cargo build "${remote[@]}"
ran

python=$(scripts/venv.sh venv-fleet models/requirements-fleet.txt --no-deps)
name="sensors of another computer, with breaks and through a router"
if [[ -e /dev/net/tun ]]; then
  begin "$name"
  if [[ $("$cache/bin/zenohd" --version 2>/dev/null) != *"$router"* ]]; then
    echo "fleet: building the router of zenoh, once" >&2
    cargo install zenohd --version "$router" --locked --root "$cache" --target-dir "$cache/zenohd"
  fi
  $sudo "$python" tests/fleet/remote.py "$RAPID_BIN" "$cache/remote/debug/rapid-remote" "$cache/bin/zenohd"
  ran
else
  skip "$name" "there is no /dev/net/tun: modprobe tun, or give it to the container (--device /dev/net/tun)"
fi

begin "Ray, UMI and Rerun"
RERUN=$(dirname "$(scripts/venv.sh venv-rerun models/requirements-rerun.txt --no-deps)")/rerun
export RERUN
# The merge is LeRobot's: gigabytes that are not fetched for this alone.
lerobot=${cache%/*}/venv-lerobot
[[ ! -f $lerobot/stamp ]] || export LEROBOT_PYTHON=$lerobot/bin/python
"$python" tests/fleet/units.py models/tests/fleet "$notes"
ran
while IFS=$'\t' read -r test reason; do
  skip "$test" "$reason"
done <"$notes"
