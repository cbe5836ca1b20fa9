#!/usr/bin/env python3
"""Draws what the monitor of the real program shows, as SVG.

    picture.py [--light] RAPID FOLDER [INSTANCE]

Runs `RAPID --sim` in a terminal of tmux, in an empty folder with the repository's devices.toml, and presses keys as a user
would. FOLDER/device.svg is the page of a camera. FOLDER/monitor.svg is the monitor a second and a half after the
demonstration has unplugged the tactile camera during an episode. Nothing is drawn by hand: every character and colour is
what tmux has in its cells. `--light` draws a terminal with a light background. Needs tmux and Python 3.10 alone.
"""

import html
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
import unicodedata
from pathlib import Path

COLUMNS, ROWS = 100, 30
# Pixels of a cell.
WIDTH, HEIGHT = 8.4, 18
DARK, LIGHT = ("#d4d4d4", "#1e1e1e"), ("#333333", "#ffffff")
# The sixteen colours of a terminal, by their numbers; with a light background, others.
PALETTE = (
    "#000000 #cd3131 #0dbc79 #e5e510 #2472c8 #bc3fbc #11a8cd #e5e5e5 "
    "#808080 #f14c4c #23d18b #f5f543 #3b8eea #d670d6 #29b8db #ffffff"
).split()
PALETTE_LIGHT = (
    "#000000 #cd3131 #00bc00 #949800 #0451a5 #bc05bc #0598bc #555555 "
    "#666666 #cd3131 #14ce14 #b5ba00 #0451a5 #bc05bc #0598bc #a5a5a5"
).split()
# How long the program may take until a picture can be taken, seconds.
PATIENCE = 120


class Screen:
    """The cells of a pane, from `capture-pane -e`: rows of characters and SGR sequences."""

    def __init__(self, captured, is_light=False):
        self.foreground, self.background = LIGHT if is_light else DARK
        self.palette = PALETTE_LIGHT if is_light else PALETTE
        self.cells, style = [], {}
        for line in captured.split("\n")[:ROWS]:
            row = []
            for sgr, character in re.findall(r"\x1b\[([0-9;:]*)m|([^\x1b])", line):
                if character:
                    row += [(character, style)] + [("", style)] * (unicodedata.east_asian_width(character) in "WF")
                else:
                    style = self.styled(style, [int(n) if n else 0 for n in re.split("[;:]", sgr)])
            self.cells.append((row + [(" ", {})] * COLUMNS)[:COLUMNS])

    def colour(self, rest):
        """The colour that follows 38 or 48 in a list of numbers, and what is left of the list."""
        if rest[:1] == [2]:
            return "#%02x%02x%02x" % tuple(rest[1:4]), rest[4:]
        number, rest = rest[1], rest[2:]
        if number < 16:
            return self.palette[number], rest
        if number >= 232:
            return "#%02x%02x%02x" % ((8 + 10 * (number - 232),) * 3), rest
        levels = (0, 95, 135, 175, 215, 255)
        number -= 16
        return "#%02x%02x%02x" % (levels[number // 36], levels[number // 6 % 6], levels[number % 6]), rest

    def styled(self, before, numbers):
        style, off = dict(before), {22: ("bold", "dim"), 23: ("italic",), 24: ("under",), 27: ("reverse",)}
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
                style["fg" if code == 38 else "bg"], numbers = self.colour(numbers)
            elif code in (39, 49):
                style.pop("fg" if code == 39 else "bg", None)
            elif 30 <= code <= 37 or 90 <= code <= 97:
                style["fg"] = self.palette[code - 30 if code < 40 else code - 82]
            elif 40 <= code <= 47 or 100 <= code <= 107:
                style["bg"] = self.palette[code - 40 if code < 50 else code - 92]
        return style

    def svg(self, title):
        width, height = COLUMNS * WIDTH + 16, ROWS * HEIGHT + 16
        lines = [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" '
            f'font-family="DejaVu Sans Mono, Menlo, Consolas, monospace" font-size="14" shape-rendering="crispEdges">',
            f"<title>{html.escape(title)}</title>",
            f'<rect width="100%" height="100%" rx="6" fill="{self.background}"/>',
        ]
        for number, row in enumerate(self.cells):
            lines += self.drawn(number, row)
        return "\n".join([*lines, "</svg>", ""])

    def drawn(self, number, row):
        """A row: runs of cells of one style, each at its column."""
        # Half blocks are drawn as rectangles: those of a font leave gaps.
        kinds = [(style, character if character in ("▀", "▄") else "") for character, style in row]
        start = 0
        while start < COLUMNS:
            (style, half), end = kinds[start], start
            while end < COLUMNS and kinds[end] == kinds[start]:
                end += 1
            text = "".join(character for character, _ in row[start:end])
            x, y = 8 + start * WIDTH, 8 + number * HEIGHT
            ink, paper = style.get("fg", self.foreground), style.get("bg")
            if style.get("reverse"):
                ink, paper = paper or self.background, ink
            if paper:
                yield f'<rect x="{x:g}" y="{y:g}" width="{(end - start) * WIDTH:g}" height="{HEIGHT}" fill="{paper}"/>'
            if half:
                top = y + HEIGHT / 2 * (half == "▄")
                yield f'<rect x="{x:g}" y="{top:g}" width="{(end - start) * WIDTH:g}" height="{HEIGHT / 2:g}" fill="{ink}"/>'
            elif text.strip():
                looks = ' font-weight="bold"' * bool(style.get("bold")) + ' opacity="0.6"' * bool(style.get("dim"))
                looks += ' text-decoration="underline"' * bool(style.get("under"))
                length = (end - start) * WIDTH
                yield (
                    f'<text x="{x:g}" y="{y + 14:g}" fill="{ink}"{looks} textLength="{length:g}" '
                    f'xml:space="preserve">{html.escape(text)}</text>'
                )
            start = end


class Terminal:
    """The program in a terminal of a tmux server of its own."""

    def __init__(self, program, folder, instance):
        environment = {"HOME": folder, "TERM": "xterm-256color", "COLORTERM": "truecolor", "LC_ALL": "C.UTF-8", "TZ": "UTC"}
        self.environment = {**os.environ, **environment, "RAPID_PICTURES": "blocks"}
        self.environment.pop("TMUX", None)
        self.socket, self.folder = f"{folder}/tmux", folder
        options = ["set-option", "-g", "default-terminal", "tmux-direct", ";", "set-option", "-g", "status", "off", ";"]
        pane = ["new-session", "-d", "-x", str(COLUMNS), "-y", str(ROWS)]
        self.tmux("start-server", ";", *options, *pane, program, "--sim", "--instance", instance, "--task", "place block")

    def tmux(self, *words):
        command = ["tmux", "-S", self.socket, "-f", "/dev/null", *words]
        ended = subprocess.run(command, cwd=self.folder, env=self.environment, capture_output=True, text=True)
        if ended.returncode:
            sys.exit(f"picture.py: the program has ended: {ended.stderr}")
        return ended.stdout

    def press(self, *keys):
        self.tmux("send-keys", *keys)

    def screen(self):
        return self.tmux("capture-pane", "-p", "-e")

    def until(self, what, holds):
        """The screen, once something holds for its text."""
        end = time.monotonic() + PATIENCE
        while not holds(text := self.tmux("capture-pane", "-p")):
            if time.monotonic() > end:
                sys.exit(f"picture.py: {what} was not seen on this screen:\n{text}")
            time.sleep(0.05)
        return self.screen()

    def close(self):
        """Ends the program as a service is ended; the server ends with it."""
        tmux = ["tmux", "-S", self.socket]
        pane = subprocess.run([*tmux, "display-message", "-p", "#{pane_pid}"], capture_output=True, text=True).stdout.strip()
        if pane:
            os.kill(int(pane), signal.SIGTERM)
        end = time.monotonic() + PATIENCE
        while subprocess.run([*tmux, "ls"], capture_output=True).returncode == 0 and time.monotonic() < end:
            time.sleep(0.05)
        subprocess.run([*tmux, "kill-server"], capture_output=True)


def take(terminal):
    """The screens by the names of their pictures."""
    terminal.until("three devices", lambda text: text.count("● streaming") == 3)
    terminal.press(" ")
    terminal.until("an episode", lambda text: "● REC" in text)
    terminal.press("Enter")
    is_whole = lambda text: sum(map(text.count, "▀▄")) > 200 and "30.0 Hz of" in text
    device = terminal.until("a picture", is_whole)
    terminal.press("Enter")
    terminal.until("an unplugged device", lambda text: "○ absent" in text)
    time.sleep(1.5)
    return {"device": device, "monitor": terminal.screen()}


# What an episode may lack because of the machine.
LIMITS = ["lost", "dropped", "late", "gap", "clock", "rate", "valid", "opening", "frozen"]


def main(words):
    is_light = words[:1] == ["--light"]
    program, output, *instance = words[is_light:]
    registry = Path(__file__).resolve().parent.parent / "devices.toml"
    with tempfile.TemporaryDirectory() as folder:
        # A picture shows the program, and not how busy the machine is that takes it.
        limits = "".join(f'{name} = "off"\n' for name in LIMITS)
        text = registry.read_text(encoding="utf-8") + "\n[verdict]\n" + limits
        Path(folder, registry.name).write_text(text, encoding="utf-8")
        terminal = Terminal(os.path.abspath(program), folder, (instance or [f"picture{os.getpid()}"])[0])
        try:
            screens = take(terminal)
        finally:
            terminal.close()
    titles = {"device": "a camera in the monitor of rapid", "monitor": "the monitor of rapid while a camera is unplugged"}
    for name, screen in screens.items():
        Path(output, f"{name}.svg").write_text(Screen(screen, is_light).svg(titles[name]), encoding="utf-8")


if __name__ == "__main__":
    if not 3 <= len(sys.argv) <= 5:
        sys.exit(__doc__)
    main(sys.argv[1:])
