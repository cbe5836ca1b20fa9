#!/usr/bin/env bash
# Runs those tests of the Python under models/ that need no torch, with the Python of the other tests (`make setup`).
#
#     models-tests.sh
#
# RAPID_BIN is the program that records the episodes of some of them, which are skipped without it. models/tests/without_torch.py
# has the rule by which they are chosen; the rest is `make train-test`. The exit code is 0 if all passed.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
readonly python=${RAPID_PYTHON:-${XDG_CACHE_HOME:-$HOME/.cache}/rapid/venv/bin/python}
[[ -x $python ]] || { echo "models-tests.sh: no Python environment at $python: run \`make setup\`" >&2; exit 2; }
[[ -z ${RAPID_BIN:-} ]] || { RAPID_BIN=$(realpath "$RAPID_BIN"); export RAPID_BIN; }
exec "$python" -B models/tests/without_torch.py
