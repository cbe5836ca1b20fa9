"""The verdict of `rapid inspect` on recorded files, the same as that of the recorder and the monitor.

Only the standard library is used, so that whoever picks episodes can ask without an environment for training.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

# Number of files per command line: their paths may be long.
AT_ONCE = 200
# Exit code of `rapid inspect` when a file of a list cannot be read.
UNREADABLE = 2


class JudgementError(Exception):
    """`rapid inspect` cannot be run; contains the reason and the fix."""


@dataclass(frozen=True)
class Judgement:
    """The verdict on one file."""

    verdict: str | None
    """GOOD, SUSPECT, BAD; None for a file that is not an episode of rapid or cannot be read."""
    reasons: tuple[str, ...]
    """Why it is not GOOD."""

    def __str__(self) -> str:
        return f"{self.verdict or 'no verdict'}: {'; '.join(self.reasons)}"


def program() -> str:
    """The program that gives the verdict: RAPID_BIN, otherwise `rapid` in the PATH."""
    named = os.environ.get("RAPID_BIN")
    found = shutil.which(named or "rapid")
    if found is None:
        what = f"RAPID_BIN={named} is not a program" if named else "no program `rapid` in the PATH"
        raise JudgementError(
            f"{what}: build it (cargo build --release) and set RAPID_BIN=/path/to/target/release/rapid"
        )
    return found


def judge(files: Iterable[Path]) -> dict[Path, Judgement]:
    """The verdict on every file, read completely, by its path."""
    files, rapid = list(files), program()
    judged: dict[Path, Judgement] = {}
    for first in range(0, len(files), AT_ONCE):
        judged.update(_ask(rapid, files[first : first + AT_ONCE]))
    return judged


def _ask(rapid: str, files: list[Path]) -> dict[Path, Judgement]:
    # The program reads a file with several names only once.
    asked = {file: str(file.resolve()) for file in files}
    names = sorted(set(asked.values()))
    # Naming a file twice makes the output a list, in which an unreadable file has a line like the others.
    names *= 2 if len(names) == 1 else 1
    command = [rapid, "inspect", "--json", "--", *names]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode not in (0, UNREADABLE):
        raise JudgementError(f"{rapid} inspect: exit code {done.returncode}: {done.stderr.strip()}")
    try:
        lines = [json.loads(line) for line in done.stdout.splitlines()]
        judged = {line["file"]: Judgement(line["verdict"], tuple(line["reasons"])) for line in lines}
    except (ValueError, KeyError, TypeError) as error:
        raise JudgementError(
            f"{rapid} inspect: an answer that is not understood ({error}); is it this version?"
        ) from error
    missing = [name for name in names if name not in judged]
    if missing:
        raise JudgementError(f"{rapid} inspect: no answer about {missing[0]}: {done.stderr.strip()}")
    return {file: judged[name] for file, name in asked.items()}
