#!/usr/bin/env python3
"""Draws what the monitor of the real program shows while a device is unplugged, as an SVG.

    picture.py RAPID OUTPUT.svg [INSTANCE]

Runs `RAPID --sim` on a terminal of its own (100 columns, 30 rows) in an empty folder, starts an episode with the space
bar, waits until the demonstration has unplugged the tactile camera, takes the cells of the screen, and quits. The
registry is the repository's devices.toml. Nothing is drawn by hand: every character and colour was sent to the terminal.
Needs Python 3.10 alone.
"""

import fcntl
import html
import os
import pty
import re
import select
import shutil
import struct
import sys
import tempfile
import termios
import time
import unicodedata
from pathlib import Path

COLUMNS, ROWS = 100, 30
# Pixels of a cell.
WIDTH, HEIGHT = 8.4, 18
FOREGROUND, BACKGROUND = "#d4d4d4", "#1e1e1e"
# The sixteen colours of a terminal, by their numbers.
PALETTE = (
    "#000000 #cd3131 #0dbc79 #e5e510 #2472c8 #bc3fbc #11a8cd #e5e5e5 "
    "#808080 #f14c4c #23d18b #f5f543 #3b8eea #d670d6 #29b8db #ffffff"
).split()
# How long the program may take until the picture can be taken, seconds.
PATIENCE = 120


def colour(code, rest):
    """The colour that follows 38 or 48 in a list of numbers, and what is left of the list."""
    if rest[:1] == [2]:
        return "#%02x%02x%02x" % tuple(rest[1:4]), rest[4:]
    number, rest = rest[1], rest[2:]
    if number < 16:
        return PALETTE[number], rest
    if number >= 232:
        return "#%02x%02x%02x" % ((8 + 10 * (number - 232),) * 3), rest
    levels = (0, 95, 135, 175, 215, 255)
    number -= 16
    return "#%02x%02x%02x" % (levels[number // 36], levels[number // 6 % 6], levels[number % 6]), rest


class Screen:
    """The cells of a terminal: understands what crossterm sends (cursor, colours, erasing)."""

    PIECE = re.compile(r"\x1b\[([?>=]?)([0-9;:]*)([@-~])|\x1b\][^\x07\x1b]*(?:\x07|\x1b\\)|\x1b[()][A-Z0-9]|\x1b[=>78c]|[^\x1b]")

    def __init__(self):
        self.cells = [[(" ", {})] * COLUMNS for _ in range(ROWS)]
        self.row = self.column = 0
        self.style = {}
        self.rest = ""

    def feed(self, text):
        text, at = self.rest + text, 0
        while match := self.PIECE.match(text, at):
            at = match.end()
            if match[3]:
                if not match[1]:
                    self.control(match[3], [int(n) if n else 0 for n in re.split("[;:]", match[2])])
            elif not match[0].startswith("\x1b"):
                self.put(match[0])
        self.rest = text[at:]

    def put(self, character):
        if character == "\r":
            self.column = 0
        elif character == "\n":
            self.row = min(self.row + 1, ROWS - 1)
        elif character >= " " and self.row < ROWS and self.column < COLUMNS:
            self.cells[self.row][self.column] = (character, self.style)
            self.column += 2 if unicodedata.east_asian_width(character) in "WF" else 1

    def control(self, final, numbers):
        first = numbers[0]
        if final in "Hf":
            self.row, self.column = max(first, 1) - 1, (max(numbers[1], 1) if len(numbers) > 1 else 1) - 1
        elif final == "J":
            self.cells = [[(" ", {})] * COLUMNS for _ in range(ROWS)]
        elif final == "K":
            for column in range(self.column, COLUMNS):
                self.cells[self.row][column] = (" ", self.style)
        elif final in "ABCDG":
            step = max(first, 1)
            self.row += {"A": -step, "B": step}.get(final, 0)
            self.column = step - 1 if final == "G" else self.column + {"C": step, "D": -step}.get(final, 0)
        elif final == "m":
            self.styled(numbers)

    def styled(self, numbers):
        style, off = dict(self.style), {22: ("bold", "dim"), 23: ("italic",), 24: ("under",), 27: ("reverse",)}
        on = {1: "bold", 2: "dim", 3: "italic", 4: "under", 7: "reverse"}
        while numbers:
            code, *numbers = numbers
            if code == 0:
                style = {}
            elif code in on:
                style[on[code]] = True
            elif code in off:
                for key in off[code]:
                    style.pop(key, None)
            elif code in (38, 48):
                style["fg" if code == 38 else "bg"], numbers = colour(code, numbers)
            elif code in (39, 49):
                style.pop("fg" if code == 39 else "bg", None)
            elif 30 <= code <= 37 or 90 <= code <= 97:
                style["fg"] = PALETTE[code - 30 if code < 40 else code - 82]
            elif 40 <= code <= 47 or 100 <= code <= 107:
                style["bg"] = PALETTE[code - 40 if code < 50 else code - 92]
        self.style = style

    def text(self):
        return ["".join(character for character, _ in row).rstrip() for row in self.cells]

    def svg(self, title):
        width, height = COLUMNS * WIDTH + 16, ROWS * HEIGHT + 16
        lines = [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" '
            f'font-family="DejaVu Sans Mono, Menlo, Consolas, monospace" font-size="14">',
            f"<title>{html.escape(title)}</title>",
            f'<rect width="100%" height="100%" rx="6" fill="{BACKGROUND}"/>',
        ]
        for number, row in enumerate(self.cells):
            lines += self.drawn(number, row)
        return "\n".join([*lines, "</svg>", ""])

    def drawn(self, number, row):
        """A row: runs of cells of one style, each at its column."""
        start = 0
        while start < COLUMNS:
            style, end = row[start][1], start
            while end < COLUMNS and row[end][1] == style:
                end += 1
            text = "".join(character for character, _ in row[start:end])
            x, y = 8 + start * WIDTH, 8 + number * HEIGHT
            ink, paper = style.get("fg", FOREGROUND), style.get("bg")
            if style.get("reverse"):
                ink, paper = paper or BACKGROUND, ink
            if paper:
                yield f'<rect x="{x:g}" y="{y:g}" width="{(end - start) * WIDTH:g}" height="{HEIGHT}" fill="{paper}"/>'
            if text.strip():
                looks = ' font-weight="bold"' * bool(style.get("bold")) + ' opacity="0.6"' * bool(style.get("dim"))
                looks += ' text-decoration="underline"' * bool(style.get("under"))
                length = (end - start) * WIDTH
                yield (
                    f'<text x="{x:g}" y="{y + 14:g}" fill="{ink}"{looks} textLength="{length:g}" '
                    f'xml:space="preserve">{html.escape(text)}</text>'
                )
            start = end


def start(program, folder, instance):
    """Starts the program on a terminal of its own; its process and the terminal."""
    process, terminal = pty.fork()
    if process == 0:
        os.chdir(folder)
        environment = {"HOME": folder, "TERM": "xterm-256color", "COLORTERM": "truecolor", "LANG": "C.UTF-8", "TZ": "UTC"}
        os.execve(program, [program, "--sim", "--instance", instance, "--task", "place block"], os.environ | environment)
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, COLUMNS, 0, 0))
    return process, terminal


def take(program, folder, instance):
    """The screen a second and a half after the unplug, while an episode is recorded."""
    process, terminal = start(program, folder, instance)
    screen, decoder = Screen(), __import__("codecs").getincrementaldecoder("utf-8")("replace")
    end, recording, unplugged = time.monotonic() + PATIENCE, False, None
    try:
        while unplugged is None or time.monotonic() < unplugged + 1.5:
            if time.monotonic() > end:
                sys.exit("picture.py: no unplug was seen on this screen:\n" + "\n".join(screen.text()))
            if select.select([terminal], [], [], 0.05)[0]:
                screen.feed(decoder.decode(os.read(terminal, 65536)))
            shown = "\n".join(screen.text())
            if not recording and shown.count("● streaming") == 3:
                os.write(terminal, b" ")
                recording = True
            if recording and unplugged is None and "○ absent" in shown:
                unplugged = time.monotonic()
        return screen
    except OSError as error:
        sys.exit(f"picture.py: the program ended: {error}\n" + "\n".join(screen.text()))
    finally:
        try:
            os.kill(process, 15)
            while os.waitpid(process, os.WNOHANG)[0] == 0:
                if select.select([terminal], [], [], 0.05)[0]:
                    os.read(terminal, 65536)
        except OSError:
            os.waitpid(process, 0)
        os.close(terminal)


def main(program, output, instance=None):
    registry = Path(__file__).resolve().parent.parent / "devices.toml"
    with tempfile.TemporaryDirectory() as folder:
        shutil.copy(registry, folder)
        screen = take(os.path.abspath(program), folder, instance or f"picture{os.getpid()}")
    Path(output).write_text(screen.svg("the monitor of rapid while a camera is unplugged"), encoding="utf-8")


if __name__ == "__main__":
    if not 3 <= len(sys.argv) <= 4:
        sys.exit(__doc__)
    main(*sys.argv[1:])
