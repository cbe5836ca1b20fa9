# `make` lists the targets. Everything a target needs that is not in the repository comes through `make setup`.
SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help setup setup-build demo test lint check bench fuzz train train-test ablation texture lerobot-test clean

# A toolchain just installed by rustup is not on the PATH of a shell that was open before.
export PATH := $(PATH):$(HOME)/.cargo/bin
TARGET := $(or $(CARGO_TARGET_DIR),$(CURDIR)/target)
CACHE := $(or $(XDG_CACHE_HOME),$(HOME)/.cache)/rapid
DEMO_DIR := demo-episodes
# Clippy's compiler builds what is tested: it makes the programs that rustc makes, and no dependency is compiled for the
# lints alone. Both commands of `test` need the same environment: with another wrapper cargo builds the workspace again.
LINTED := RUSTC_WORKSPACE_WRAPPER=clippy-driver CLIPPY_ARGS=-Dwarnings__CLIPPY_HACKERY__
# What is built once, in a fresh clone, is built sooner and in half the room without the state of incremental builds. Where
# there is some already, someone is at work, and changing the setting would build the workspace again.
INCREMENTAL := $(if $(wildcard $(TARGET)/debug/incremental),,CARGO_INCREMENTAL=0)
TESTED := env $(INCREMENTAL) RAPID_BIN='$(TARGET)/debug/rapid' RAPID_PYTHON='$(CACHE)/venv/bin/python' $(LINTED)
TESTS := cargo test --locked --workspace

help: ## this list
	@sed -n 's/^\([a-z-]*\):[^#]*## /\1|/p' Makefile | while IFS='|' read -r name what; do printf 'make %-12s %s\n' "$$name" "$$what"; done

setup: ## everything that building, running and testing need; a second run changes nothing
	@scripts/setup.sh build test

setup-build: ## only what building and running need
	@scripts/setup.sh build

demo: setup-build ## build, then the simulated rig: the monitor on a terminal, otherwise a 10 s episode
	cargo build --release --locked
	@if [ -t 0 ] && [ -t 1 ]; then exec '$(TARGET)/release/rapid' --sim; else scripts/demo.sh '$(TARGET)/release/rapid' $(DEMO_DIR); fi

# `cargo test` builds the program as well, into this place: no build of its own goes before it.
test: setup ## set up, format, lints, all tests, and a look at what they left behind
	cargo fmt --all --check
	$(TESTED) $(TESTS) --no-run
	$(TESTED) scripts/leftovers.sh scripts/tests.sh $(TESTS)

lint: ## format and clippy
	cargo fmt --all --check
	cargo clippy --locked --workspace --all-targets -- -D warnings

check: setup-build lint ## lints, documentation, licences, bans, sources and known vulnerabilities of the dependencies
	RUSTDOCFLAGS='-D warnings' cargo doc --locked --workspace --no-deps
	scripts/deny.sh

bench: setup ## print figures beside their baselines (JSON=1; BENCH="--quick --only sync"); fails if one is not measured
	cargo build --release --locked --bin rapid --example unplug_latency
	cargo build --release --locked -p vbench -p rapid-bench --bins
	RAPID_BIN='$(TARGET)/release/rapid' '$(TARGET)/release/rapid-bench' $(if $(JSON),--json) $(BENCH)

# The compiler for C++ is for libFuzzer alone.
fuzz: ## feed every reader of strangers' bytes with made-up ones, each for FUZZ_SECONDS=60
	@scripts/setup.sh build fuzz
	scripts/fuzz.sh

# Training is no part of `test` or of `setup`: the bundle is in the repository, and its Python environment is 5 GB.
train: setup-build ## record demonstrations, train on them, export models/tactile-id (THREADS=2, MINUTES=)
	cargo build --release --locked
	scripts/train.sh policy '$(TARGET)/release/rapid'

# Without a program that is built already the tests on its episodes say that they are left out.
train-test: ## tests of the Python under models/
	RAPID_BIN='$(wildcard $(TARGET)/release/rapid)' scripts/train.sh test

ablation: setup-build ## train five configurations of the policy and run each: models/results/ablation.md
	cargo build --release --locked
	scripts/train.sh ablation '$(TARGET)/release/rapid'

texture: ## what a tactile picture says of the texture: models/results/texture.md
	scripts/train.sh texture

# In a place of its own and no part of the other tests: LeRobot and PyTorch are gigabytes that nothing else here needs.
lerobot-test: LEROBOT := $(CACHE)/venv-lerobot
lerobot-test: ## the export of LeRobot checkpoints, against LeRobot (fetches 8 GB of Python packages once)
	@stamp=$$(sha256sum <models/requirements-lerobot.txt); \
	if [[ $$(cat '$(LEROBOT)/stamp' 2>/dev/null) != "$$stamp" ]]; then \
	    rm -rf '$(LEROBOT)' && python3 -m venv '$(LEROBOT)'; \
	    '$(LEROBOT)/bin/python' -m pip install --quiet --disable-pip-version-check --only-binary=:all: --no-deps -r models/requirements-lerobot.txt; \
	    echo "$$stamp" >'$(LEROBOT)/stamp'; \
	fi
	'$(LEROBOT)/bin/python' -m unittest discover -s models/tests/lerobot -v

clean: ## remove what was built here (what setup fetched stays)
	cargo clean
	rm -rf $(DEMO_DIR)
