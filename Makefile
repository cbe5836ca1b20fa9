# `make` lists the targets. Everything a target needs that is not in the repository comes through `make setup`.
SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help setup setup-build setup-test setup-all demo picture quick one test test-all guests features lint check bench fuzz train train-test ablation evaluation texture lerobot-loop lerobot-test fleet-test clean

# A toolchain just installed by rustup is not on the PATH of a shell that was open before.
export PATH := $(PATH):$(HOME)/.cargo/bin
TARGET := $(or $(CARGO_TARGET_DIR),$(CURDIR)/target)
CACHE := $(or $(XDG_CACHE_HOME),$(HOME)/.cache)/rapid
DEMO_DIR := demo-episodes
# What the tests in Python record episodes with: what is built already.
BUILT = $(firstword $(wildcard $(TARGET)/release/rapid $(TARGET)/debug/rapid))
# Clippy's compiler builds the tests: it makes the programs that rustc makes, and no dependency is compiled for lints alone. Both commands of `test` need the same environment: with another wrapper cargo builds the workspace again.
LINTED := RUSTC_WORKSPACE_WRAPPER=clippy-driver CLIPPY_ARGS=-Dwarnings__CLIPPY_HACKERY__
# A fresh clone builds faster and in half the space without the state of incremental builds and without line tables. Where
# there is such state, someone is at work, and changing the setting would rebuild the workspace.
INCREMENTAL := $(if $(wildcard $(TARGET)/debug/incremental/*),,CARGO_INCREMENTAL=0 CARGO_PROFILE_DEV_DEBUG=false)
# Most tests wait most of their time, for clocks and for programs: more of them than processors run side by side.
TEST_THREADS := RUST_TEST_THREADS=$(shell echo $$((2 * $$(nproc))))
TESTED := env $(INCREMENTAL) $(TEST_THREADS) RAPID_BIN='$(TARGET)/debug/rapid' RAPID_PYTHON='$(CACHE)/venv/bin/python' $(LINTED)
TESTS := cargo test --locked --workspace
# What `make quick` runs, and what it leaves out: of the unit tests those that try every byte of a file, each state that it may be
# left in, hundreds of pictures or a million steps; of the tests of the program those that wait for long, need Python or
# C, or run the scripts of tests; whole programs of tests that allocate or time motors.
QUICK := --exclude rapid-node --lib --test layering --test library
EXHAUSTIVE := every_state_of_damage compare::tests damage::an_index damage::a_file_inside damage::every_message \
	damaged_files_never_panic every_flipped_bit a_flipped_bit_loses unread_bytes_are a_truncated_or_damaged_file \
	chunks_of_other_writers a_million_random_steps the_picture_is_bounded the_mark_is_found
SLOW := alone buttons calibrate compare demonstrate docs ends export foxglove hooks infer json kill lan lan_gopro lan_hostile lan_mdns many_devices nodes observe plot process python scenarios screen scripts second_run shared_memory stops task verdict web

help: ## this list
	@sed -n 's/^\([a-z-]*\):[^#]*## /\1|/p' Makefile | sed 's/[$$](SLOW)/$(SLOW)/' | while IFS='|' read -r name what; do printf 'make %-12s %s\n' "$$name" "$$what"; done

setup: ## everything that building, running and testing need; a second run changes nothing
	@scripts/setup.sh build test image

setup-build: ## only what building and running need
	@scripts/setup.sh build

# The guest of the virtual bench is made by tests.sh, while the programs are compiled.
setup-test:
	@scripts/setup.sh build test

# The guest on an emulated machine, too.
setup-all:
	@scripts/setup.sh build test image qemu fuzz

# Built to be seen soon: in a profile of its own, and without what simulated devices do not need.
demo: setup-build ## build, then the simulated rig and a policy: the monitor on a terminal, otherwise a 10 s episode
	cargo build --locked --profile demo --no-default-features --features policy --bin rapid
	@scripts/demo.sh '$(TARGET)/demo/rapid' $(DEMO_DIR)

# A test takes the picture again and compares its words and colours with the one in the repository.
picture: setup ## take docs/monitor.svg and docs/device.svg again, from the program in a terminal of tmux
	cargo build --release --locked
	scripts/picture.py '$(TARGET)/release/rapid' docs

quick: setup-build ## by habit: format, lints, unit tests, layering, registry, the fast tests of the program; leaves out $(SLOW)
	cargo fmt --all --check
	$(TESTED) RUST_TEST_THREADS=$$((4 * $$(nproc))) $(TESTS) $(QUICK) -- $(EXHAUSTIVE:%=--skip=%)
	$(TESTED) RUST_TEST_THREADS=$$((4 * $$(nproc))) $(TESTS) --test program -- $(SLOW:%=--skip=%::)

one: ## run one test by its name, with its output: TEST=name (of a test or of a module, the virtual bench's too)
	@$(TESTED) scripts/one.sh '$(TEST)' $(TESTS)

# `cargo test` builds the program as well, into this place: no build of its own goes before it.
test: setup-test ## the whole truth: format, lints, all tests with the virtual bench, and a look at what they left behind
	cargo fmt --all --check
	$(TESTED) scripts/leftovers.sh scripts/tests.sh $(TESTS)

# Beside busy loops: scripts/busy.sh 4 make guests
guests: setup ## the guests of the virtual bench, TIMES=10 times, and how far their times differ among the runs
	$(TESTED) cargo build --locked --workspace --bin rapid --bin usbemu --example process_node --example publish_action
	$(TESTED) scripts/guests.sh $(or $(TIMES),10) $(TESTS)

# Each part after `test` is run even if one before it failed; the last lines are a table.
test-all: setup-all test ## before a release and at night: make test, then guests on an emulated machine, 90 cycles, features, fuzzing and more
	$(TESTED) scripts/tests-all.sh $(TESTS)

features: ## compile the program with no cargo feature, and with each alone
	$(TESTED) scripts/features.sh '' cameras export foxglove graphics lan motors policy web

lint: ## format and clippy
	cargo fmt --all --check
	cargo fmt --check --manifest-path examples/remote/Cargo.toml
	cargo clippy --locked --workspace --all-targets -- -D warnings

check: setup-build lint ## lints, documentation, licences, bans, sources and known vulnerabilities of the dependencies
	RUSTDOCFLAGS='-D warnings' cargo doc --locked --workspace --no-deps
	scripts/deny.sh

bench: setup-all ## print figures beside their baselines (JSON=1; BENCH="--quick --only sync"); fails if one is not measured
	cargo build --release --locked --bin rapid --example unplug_latency --example capture
	cargo build --release --locked -p vbench -p rapid-bench --bins
	RAPID_BIN='$(TARGET)/release/rapid' '$(TARGET)/release/rapid-bench' $(if $(JSON),--json) $(BENCH)

# The compiler for C++ is for libFuzzer alone.
fuzz: ## feed every reader of untrusted bytes with generated ones, each for FUZZ_SECONDS=60
	@scripts/setup.sh build fuzz
	scripts/fuzz.sh

# The program is built as the tests build it, so that it is there after `make test`.
fleet-test: setup-build ## upload to a real S3 server, sensors of another computer, the page in Chromium, Ray, UMI, Rerun, with breaks (fetches 2 GB once; needs root); fails if a part is skipped (FLEET_MAY_SKIP=1 permits it)
	$(if $(RAPID_BIN),,$(TESTED) cargo build --locked --workspace --bin rapid)
	RAPID_BIN='$(or $(RAPID_BIN),$(TARGET)/debug/rapid)' scripts/fleet.sh

# Training is no part of `test` or of `setup`: the bundle is in the repository, and its Python environment is 5 GB.
train: setup-build ## record demonstrations, train on them, export models/tactile-id (POLICY=, START_FROM=, THREADS=2, MINUTES=)
	cargo build --release --locked
	scripts/train.sh policy '$(TARGET)/release/rapid'

# Without a program that is built already the tests on its episodes report that they are skipped.
train-test: ## tests of the Python under models/
	RAPID_BIN='$(wildcard $(TARGET)/release/rapid)' scripts/train.sh test

ablation: setup-build ## train five configurations of the policy, three times each, and run them: models/results/ablation.md (JOBS=1)
	cargo build --release --locked
	scripts/train.sh ablation '$(TARGET)/release/rapid'

evaluation: setup-build ## run the policies with a sensor that is pulled out: models/results/eval.md
	cargo build --release --locked
	scripts/train.sh python evaluation.py --rapid '$(abspath $(TARGET))/release/rapid'

texture: setup-build ## what a tactile picture reveals of the texture: models/results/texture.md (ENCODER=resnet18)
	cargo build --release --locked
	scripts/train.sh texture '$(TARGET)/release/rapid'

lerobot-loop: setup-build ## what LeRobot's own loop does when a camera fails: models/results/lerobot-loop.md
	cargo build --release --locked
	python=$$(scripts/venv.sh venv-lerobot models/requirements-lerobot.txt --no-deps); \
	"$$python" models/lerobot_loop.py --rapid '$(TARGET)/release/rapid'

# In a place of its own and no part of the other tests: LeRobot and PyTorch are gigabytes that nothing else here needs.
lerobot-test: ## the exports from and to LeRobot, against LeRobot, its own loop, and training on what it wrote (fetches 8 GB of Python packages once)
	python=$$(scripts/venv.sh venv-lerobot models/requirements-lerobot.txt --no-deps); \
	RAPID_BIN='$(BUILT)' "$$python" -m unittest discover -s models/tests/lerobot -v

clean: ## remove what was built here (what setup fetched stays)
	cargo clean
	rm -rf $(DEMO_DIR)
