#!/usr/bin/env bash
# Tests what happens to episodes after a rig: needs a network for Go's modules once, and is no part of `make test`.
set -euo pipefail
cd "$(dirname "$0")/.."

readonly server=github.com/versity/versitygw/cmd/versitygw@v1.8.0
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
exec python3 tests/fleet/upload.py udev/rapid-upload.service "$cache/versitygw"
