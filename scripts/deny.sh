#!/usr/bin/env bash
# Checks the dependencies against deny.toml: licences, bans, sources, and known vulnerabilities if their database can be
# fetched (it is not in the package registry).
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

if ! cargo deny --version >/dev/null 2>&1; then
    echo "check: installing cargo-deny (some minutes, once)"
    cargo install cargo-deny --locked --version 0.20.2
fi
cargo deny --locked check licenses bans sources
if cargo deny --locked fetch db; then
    cargo deny --locked check --disable-fetch advisories
else
    echo "check: NOT CHECKED: known vulnerabilities. Their database could not be fetched from here."
fi
