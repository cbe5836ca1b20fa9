#!/usr/bin/env bash
# Trains and measures policies, in its own Python environment.
#
#     train.sh policy [RAPID]      demonstrations, training, export to models/POLICY, default tactile-id
#     train.sh experiment FILE ARGS...   training as an experiment (*.toml) has it, export; see models/README.md
#     train.sh ablation RAPID      the contribution of each input of the policy: models/results/ablation.{json,md}
#     train.sh texture [RAPID]     how well pictures show the texture: models/results/texture.{json,md}
#     train.sh test                tests of the Python under models/
#     train.sh python ARGS...      that Python, run in models/
#
# RAPID is the program, default target/release/rapid. Demonstrations and checkpoints are in RUNS=models/runs; existing
# ones are used again: a stopped training continues. EPISODES=240 and SEED=1000 of the handheld demonstrations (those with the arm
# are 480 from 1000 on: the experiments of the ablation say which of them); THREADS=2 of a training, MINUTES of one that is
# no part of the ablation, EVALUATE iterations between two evaluations of one, START_FROM=BUNDLE whose weights it begins with
# (tactile-id-memory: models/tactile-id); POLICY=tactile-id; JOBS=1 trainings of the
# ablation at a time, SEEDS="0 1 2" of them; ENCODER=small.
#
# Demonstrations and environment get their final names last: an interrupted run leaves nothing that looks complete.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

RUNS="$(realpath -m "${RUNS:-models/runs}")"
readonly RUNS
# The policy learns from a gripper in the hand, the comparisons from an arm.
case "${1:-}" in
    policy) KIND=(--handheld) NAME=handheld EPISODES="${EPISODES:-240}" SEED="${SEED:-1000}" ;;
    *) KIND=() NAME=arm EPISODES=480 SEED=1000 ;;
esac
readonly KIND NAME EPISODES SEED THREADS="${THREADS:-2}"
readonly DEMONSTRATIONS="$RUNS/$NAME-$EPISODES-$SEED"

SCHEDULE=(--threads "$THREADS")
[[ -z ${MINUTES:-} ]] || SCHEDULE+=(--minutes "$MINUTES")
# By the program in RAPID_BIN.
[[ -z ${EVALUATE:-} ]] || SCHEDULE+=(--evaluate-every "$EVALUATE")
readonly SCHEDULE

# Threads that spin while waiting slow down everything else on the machine.
export OMP_WAIT_POLICY="${OMP_WAIT_POLICY:-PASSIVE}"

report() { printf 'train: %s\n' "$*"; }
die() { printf 'train: %s\n' "$*" >&2; exit 1; }

main() {
    local part="${1:-}" rapid=target/release/rapid
    [[ $part != policy && $part != ablation && $part != texture ]] || rapid="${2:-$rapid}"
    rapid="$(realpath -m -- "$rapid")"
    # The verdict on the episodes before they are used for training.
    [[ $part = test ]] || export RAPID_BIN="${RAPID_BIN:-$rapid}"
    case "$part" in
        policy) environment; demonstrations "$rapid"; policy ;;
        ablation) environment; demonstrations "$rapid"; ablation "$rapid" ;;
        experiment) environment; shift; experiment "$@" ;;
        texture) environment; demonstrations "$rapid"; texture ;;
        test) environment; in_models -m unittest discover -s tests -v ;;
        python) environment; shift; in_models "$@" ;;
        *) die "unknown part '$part': policy, experiment, ablation, texture, test or python" ;;
    esac
}

in_models() {
    (cd models && exec "$PYTHON" "$@")
}

environment() {
    PYTHON=$(scripts/venv.sh train-venv models/requirements.txt)
}

demonstrations() {
    local rapid="$1"
    if [[ -d $DEMONSTRATIONS ]]; then
        report "demonstrations of an earlier run: $DEMONSTRATIONS"
        return
    fi
    [[ -x $rapid ]] || die "no program $rapid: build it with cargo build --release"
    report "recording $EPISODES demonstrations: $DEMONSTRATIONS"
    rm -rf "$DEMONSTRATIONS.partial"
    mkdir -p "$DEMONSTRATIONS.partial"
    "$rapid" --sim task "${KIND[@]}" --expert --record --episodes "$EPISODES" --out "$DEMONSTRATIONS.partial" --seed "$SEED"
    # An interrupted one ends well, with those that it had.
    [[ $(find "$DEMONSTRATIONS.partial" -name '*.mcap' | wc -l) -eq $EPISODES ]] || die "not all demonstrations were recorded"
    mv "$DEMONSTRATIONS.partial" "$DEMONSTRATIONS"
}

policy() {
    local name="${POLICY:-tactile-id}"
    learn "experiments/$name.toml" "$name" --data "$DEMONSTRATIONS"
}

# The name of the run and of the bundle is that of the file.
experiment() {
    [[ -f ${1:-} ]] || die "no experiment '${1:-}': name a file, for example models/experiments/tactile-id.toml"
    local file
    file="$(realpath "$1")"
    learn "$file" "$(basename "$file" .toml)" "${@:2}"
}

# Trains an experiment under the name of its bundle, or continues, and exports.
learn() {
    local file="$1" name="$2" run="$RUNS/$2" options=("${SCHEDULE[@]}")
    if [[ -f $run/checkpoint.pt ]]; then options+=(--resume)
    elif [[ -n ${START_FROM:-} ]]; then options+=(--start-from "$(realpath "$START_FROM")")
    fi
    in_models -m rapid_policy.train "$file" --out "$run" --cache "$RUNS/cache" "${options[@]}" "${@:3}"
    in_models -m rapid_policy.export "$run/checkpoint.pt" --out "$name"
}

texture() {
    in_models texture.py "$DEMONSTRATIONS" --cache "$RUNS/cache" --threads "$THREADS" --encoder "${ENCODER:-small}"
}

ablation() {
    local seeds
    read -ra seeds <<<"${SEEDS:-0 1 2}"
    in_models ablation.py "$DEMONSTRATIONS" --rapid "$1" --runs "$RUNS/ablation" --cache "$RUNS/cache" --threads "$THREADS" \
        --jobs "${JOBS:-1}" --seeds "${seeds[@]}"
}

main "$@"
