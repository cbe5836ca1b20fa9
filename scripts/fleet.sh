#!/usr/bin/env bash
# Tests what needs more than a rig: the upload, the page for a phone in Chromium, sensors of another computer, a cluster's export,
# UMI's replay buffer, Rerun. Fetches 2 GB of Go's modules, crates, Python packages and a browser once, and is no part of
# `make test`. RAPID_BIN is the program; without one, what needs
# episodes reports that it is skipped.
set -euo pipefail
cd "$(dirname "$0")/.."

readonly server=github.com/versity/versitygw/cmd/versitygw@v1.8.0
# Of the version of zenoh that examples/remote has.
readonly router=1.10.2
cache=${XDG_CACHE_HOME:-$HOME/.cache}/rapid/fleet
sudo=
[[ $(id -u) == 0 ]] || sudo=sudo

if ! command -v rclone >/dev/null || ! command -v go >/dev/null; then
  echo "fleet: installing rclone and Go" >&2
  $sudo apt-get update -q
  $sudo apt-get install -y -q --no-install-recommends rclone golang-go ca-certificates
fi
if [[ ! -x $cache/versitygw ]]; then
  echo "fleet: building the S3 server of the test, once" >&2
  GOBIN=$cache go install "$server"
fi
python3 tests/fleet/upload.py udev/rapid-upload.service udev/rapid-upload-check.service "$cache/versitygw"

if [[ -n ${RAPID_BIN:-} ]]; then
  if ! command -v chromium >/dev/null; then
    echo "fleet: installing Chromium" >&2
    $sudo apt-get update -q
    $sudo apt-get install -y -q --no-install-recommends chromium
  fi
  python3 tests/fleet/page.py "$RAPID_BIN" "$(command -v chromium)" "$cache/page"
else
  echo "page: skipped: no program is built" >&2
fi

python=$(scripts/venv.sh venv-fleet models/requirements-fleet.txt --no-deps)

remote=(--locked --manifest-path examples/remote/Cargo.toml --target-dir "$cache/remote")
cargo test "${remote[@]}"
cargo build "${remote[@]}"
if [[ $("$cache/bin/zenohd" --version 2>/dev/null) != *"$router"* ]]; then
  echo "fleet: building the router of zenoh, once" >&2
  cargo install zenohd --version "$router" --locked --root "$cache" --target-dir "$cache/zenohd"
fi
if [[ -n ${RAPID_BIN:-} && -e /dev/net/tun ]]; then
  $sudo "$python" tests/fleet/remote.py "$RAPID_BIN" "$cache/remote/debug/rapid-remote" "$cache/bin/zenohd"
else
  echo "fleet: SKIPPED: sensors of another computer: no program is built, or no /dev/net/tun" >&2
fi
RERUN=$(dirname "$(scripts/venv.sh venv-rerun models/requirements-rerun.txt --no-deps)")/rerun
export RERUN
# The merge is LeRobot's: gigabytes that are not fetched for this alone.
lerobot=${cache%/*}/venv-lerobot
[[ ! -f $lerobot/stamp ]] || export LEROBOT_PYTHON=$lerobot/bin/python
exec "$python" -m unittest discover -s models/tests/fleet -v
