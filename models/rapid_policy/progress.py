"""Progress of a training: a bar on a terminal, lines in a log, curves in TensorBoard, a plot at the end."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from tqdm import tqdm

LINE_EVERY = 100
BOARD_EVERY = 10
SMOOTHED = 100


class Progress:
    """Shows the loss and the time left."""

    def __init__(self, name: str, iterations: int, already: int, shown: bool = True) -> None:
        self._name, self._iterations, self._shown = name, iterations, shown
        self._bar = tqdm(total=iterations, initial=already, desc=name) if shown and sys.stderr.isatty() else None

    def step(self, losses: list[float], done: float, seconds: float) -> None:
        """One more iteration; `done` is the share of the whole schedule."""
        if self._bar is not None:
            if len(losses) % 10 == 0:
                self._bar.set_postfix(loss=f"{recent(losses):.4f}", refresh=False)
            self._bar.update()
        elif self._shown and len(losses) % LINE_EVERY == 0:
            left = seconds / done * (1 - done) if done > 0 else float("nan")
            text = f"{self._name}: {len(losses)}/{self._iterations} loss {recent(losses):.4f}, {left / 60:.1f} min left"
            print(text, flush=True)

    def close(self) -> None:
        """Ends the bar."""
        if self._bar is not None:
            self._bar.close()


class Board:
    """Curves for TensorBoard: `tensorboard --logdir RUN`. Without the package there are none, and one warning."""

    def __init__(self, folder: Path, iteration: int) -> None:
        self._writer = None
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            print(f"no curves for TensorBoard: {error}; pip install tensorboard adds them", file=sys.stderr)
            return
        self._writer = SummaryWriter(str(folder), purge_step=iteration)

    def add(self, iteration: int, **values: float) -> None:
        """Points of curves."""
        if self._writer is not None:
            for name, value in values.items():
                self._writer.add_scalar(name, value, iteration)

    def close(self) -> None:
        """Writes what is left."""
        if self._writer is not None:
            self._writer.close()


def recent(losses: list[float]) -> float:
    """Mean of the last iterations."""
    return float(np.mean(losses[-SMOOTHED:]))


def plot(losses: list[float], title: str, path: Path, validation: list[tuple[int, float]] = ()) -> None:
    """Writes the loss over the iterations as a picture."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 4))
    axes.plot(losses, color="0.8", linewidth=0.5, label="each iteration")
    if len(losses) >= SMOOTHED:
        smooth = np.convolve(losses, np.ones(SMOOTHED) / SMOOTHED, "valid")
        axes.plot(np.arange(SMOOTHED - 1, len(losses)), smooth, label=f"mean of {SMOOTHED}")
    if validation:
        axes.plot(*zip(*validation, strict=True), "o-", markersize=3, label="episodes held out")
    axes.set(yscale="log", xlabel="iteration", ylabel="loss", title=title)
    axes.legend()
    axes.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    plt.close(figure)
