"""Results of experiments: figures for programs beside a table for people."""

from __future__ import annotations

import json
import math
import textwrap
from pathlib import Path
from typing import Any


def write(folder: Path, name: str, report: dict[str, Any], markdown: str) -> None:
    """Writes NAME.json and NAME.md."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.json").write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    (folder / f"{name}.md").write_text(markdown, encoding="utf-8")
    print(f"{folder / name}.json and .md")


def wilson(successes: int, trials: int, z: float = 1.96) -> tuple[float, float]:
    """An interval that would contain the true share in 95 % of repetitions (Wilson's score interval)."""
    share, spread = successes / trials, z * z / trials
    middle = (share + spread / 2) / (1 + spread)
    half = z / (1 + spread) * math.sqrt(share * (1 - share) / trials + spread / (4 * trials))
    # Rounding must not leave the share outside.
    return max(0.0, min(share, middle - half)), min(1.0, max(share, middle + half))


def paragraph(*sentences: str) -> list[str]:
    """The lines of a paragraph of a page; links and words with hyphens stay whole."""
    return textwrap.wrap(" ".join(filter(None, sentences)), 125, break_long_words=False, break_on_hyphens=False)
