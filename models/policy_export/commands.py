"""What the commands that export checkpoints share: the forms of their options, and the folder of a bundle."""

import argparse
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import commandline

from . import Unsupported, bundle


def run(
    name: str,
    parser: argparse.ArgumentParser,
    export: Callable[[argparse.Namespace], None],
    arguments: list[str] | None,
) -> int:
    """Returns the exit status: 0, or 1 with one line that names what cannot be exported."""
    try:
        export(parser.parse_args(arguments))
    except Unsupported as error:
        return commandline.failed(name, error)
    return 0


def write(
    out: Path,
    make: Callable[[Path], dict],
    verify: Callable[[Path], dict[str, float]],
    card: Callable[[dict, Path], None],
) -> dict:
    """Fills a folder beside `out`, and gives it that name once it is verified; on an error nothing is left.

    `make` writes the graphs and returns policy.json, `verify` finds the differences, `card` writes README.md.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
    try:
        partial.chmod(0o755)
        policy = make(partial)
        bundle.save(policy, partial)
        policy["training"]["verification"] = verify(partial)
        bundle.save(policy, partial)
        card(policy, partial)
        partial.rename(out)
    except BaseException:
        shutil.rmtree(partial)
        raise
    return policy


def report(out: Path, policy: dict, source: str) -> None:
    for part, difference in policy["training"]["verification"].items():
        print(f"largest difference from {source}, {part}: {difference:.2e}")
    print(f"{out}: {policy['scheduler']['type']}, {policy['scheduler']['num_inference_steps']} steps")


def is_new(out: Path) -> None:
    if out.exists():
        raise Unsupported(f"{out}: exists already: name another folder, or remove it")


def modalities(keys: list[str], named: list[tuple[str, str]], default: Callable[[str], str]) -> dict[str, str]:
    """The modality of each observation: as the options `--modality` give it, otherwise `default`."""
    found = {key: default(key) for key in keys}
    for key, name in named:
        if key not in found:
            raise Unsupported(f"--modality {key}={name}: the checkpoint's observations are {', '.join(found)}")
        found[key] = name
    return found


def apart(cameras: list[str]) -> None:
    """Two cameras cannot be one modality."""
    if len(set(cameras)) < len(cameras):
        raise Unsupported(f"--modality: two cameras cannot both be {max(cameras, key=cameras.count)}")


def pair(text: str) -> tuple[str, str]:
    key, equals, name = text.partition("=")
    if not (key and equals and name):
        raise argparse.ArgumentTypeError(f"'{text}' is not KEY=NAME")
    return key, name


def words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",")]


def count(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not above 0")
    return value


def positive(text: str) -> float:
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"'{text}' is not above 0")
    return value
