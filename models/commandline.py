"""What the commands under models/ share: a parser made from the docstring of their module, and errors of one line."""

from __future__ import annotations

import argparse
import sys

# Settings of a parser, and of those of its subcommands.
PLAIN = {"formatter_class": argparse.RawDescriptionHelpFormatter, "allow_abbrev": False}


def parser(text: str) -> argparse.ArgumentParser:
    """The first line is the description, the rest is printed after the options."""
    head, _, rest = text.partition("\n")
    return argparse.ArgumentParser(description=head, epilog=rest, **PLAIN)


def failed(name: str, error: Exception) -> int:
    """Prints what is wrong in one line, and returns the exit status."""
    # Text from a foreign file must not control the terminal.
    line = "".join(c if c.isprintable() else " " for c in str(error))
    print(f"{name}: {line}", file=sys.stderr)
    return 1
