#!/usr/bin/env python3
"""Drives the page of `rapid --web` in headless Chromium, in portrait on the screen of a phone.

    page.py RAPID CHROMIUM [FOLDER]

Screenshots of each state go to FOLDER. Chromium is spoken to by its DevTools protocol over a pipe
(https://chromedevtools.github.io/devtools-protocol), for which Python needs nothing. A run is stopped, ended and started
again under the page: it shows that it knows nothing, and then continues.
"""

import base64
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

PATIENCE = 60
SIZE = {"width": 390, "height": 844, "deviceScaleFactor": 2, "mobile": True}
# One camera sends the same picture again and again, which spoils an episode; another is away for a while.
SCENARIO = """
[[device]]
name = "cam_wrist"
[device.fault]
freeze_at = "15s"
[[device]]
name = "motor_state"
[[device]]
name = "tactile_tip"
[[event]]
at = "20s"
unplug = "tactile_tip"
[[event]]
at = "32s"
plug = "tactile_tip"
"""


def until(what, holds):
    end = time.monotonic() + PATIENCE
    while not (found := holds()):
        assert time.monotonic() < end, f"{what}: not met in time"
        time.sleep(0.05)
    return found


class Browser:
    """One page of a browser of its own."""

    def __init__(self, program, place):
        self.number, self.waiting, self.problems = 0, {}, []
        to_read, self.to = os.pipe()
        self.of, from_write = os.pipe()
        # The browser reads requests from descriptor 3 and writes answers to 4.
        shell = f'exec "$@" 3<&{to_read} 4>&{from_write}'
        command = [program, "--headless=new", "--no-sandbox", "--remote-debugging-pipe", "--disable-gpu", f"--user-data-dir={place}"]
        self.process = subprocess.Popen(
            ["bash", "-c", shell, "bash", *command, "about:blank"],
            pass_fds=(to_read, from_write),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_read), os.close(from_write)
        self.answers = os.fdopen(self.of, "rb")
        self.session = None
        pages = lambda: [one for one in self.ask("Target.getTargets")["targetInfos"] if one["type"] == "page"]
        target = until("a page", pages)[0]["targetId"]
        self.session = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self.ask("Emulation.setDeviceMetricsOverride", **SIZE)
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.ask(f"{domain}.enable")
        self.requested = []

    def ask(self, method, **parameters):
        self.number += 1
        message = {"id": self.number, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.to, json.dumps(message).encode() + b"\0")
        while True:
            answer = self.read()
            if answer.get("id") == self.number:
                assert "error" not in answer, answer
                return answer["result"]
            if answer.get("method") == "Network.requestWillBeSent":
                self.requested.append(answer["params"]["request"]["url"])
            if answer.get("method") == "Runtime.exceptionThrown":
                self.problems.append(answer["params"])

    def read(self):
        text = b""
        while not text.endswith(b"\0"):
            byte = self.answers.read(1)
            assert byte, "the browser has ended"
            text += byte
        return json.loads(text[:-1])

    def value(self, expression):
        result = self.ask("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def text(self, selector):
        return self.value(f"document.querySelector({json.dumps(selector)})?.innerText ?? ''")

    def press(self, selector):
        """A finger in the middle of what is there: what lies over it would get it."""
        place = f"(() => {{ const r = document.querySelector({json.dumps(selector)}).getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2]; }})()"
        until(f"{selector} can be pressed", lambda: not self.value(f"document.querySelector({json.dumps(selector)}).disabled"))
        x, y = self.value(place)
        self.ask("Input.dispatchTouchEvent", type="touchStart", touchPoints=[{"x": x, "y": y}])
        self.ask("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def shot(self, folder, name, dark=False):
        scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.ask("Emulation.setEmulatedMedia", features=scheme)
        data = self.ask("Page.captureScreenshot", format="png")["data"]
        (folder / f"{name}.png").write_bytes(base64.b64decode(data))

    def end(self):
        self.process.terminate()
        self.process.wait()


class Run:
    """A run of the simulated rig with its page."""

    def __init__(self, rapid, place, port, options=()):
        self.log = open(place / "run.jsonl", "ab")
        instance = os.environ | {"RAPID_INSTANCE": f"page-{os.getpid()}"}
        command = [rapid, "--sim", "scenario.toml", "--headless", "--json", "--task", "place block", "--goal", "5", "--web", f"127.0.0.1:{port}"]
        self.process = subprocess.Popen([*command, *options], cwd=place, env=instance, stdout=self.log, stderr=subprocess.DEVNULL)
        until("the page is served", lambda: socket.socket().connect_ex(("127.0.0.1", port)) == 0)

    def end(self):
        self.process.send_signal(signal.SIGINT)
        self.process.wait()


def free_port():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def check(rapid, page, place, shots):
    is_lost = lambda: page.value("document.body.classList.contains('lost') && !document.querySelector('#lost').hidden")
    port = free_port()
    run = Run(rapid, place, port)
    page.ask("Page.navigate", url=f"http://127.0.0.1:{port}/")
    until("three bits are set", lambda: page.value("document.querySelectorAll('.bit.set.streaming').length") == 3)
    pictures = "document.querySelectorAll('figure:not(.old) img').length"
    until("pictures are shown", lambda: page.value("[...document.querySelectorAll('figure:not(.old) img')].filter((i) => i.naturalWidth > 0).length") == 2)
    assert page.text("#now") == "Idle" and not is_lost()
    # Nothing is wider than the screen, and the large buttons are large.
    assert page.value("document.documentElement.scrollWidth") <= SIZE["width"]
    assert page.value("document.querySelector('#toggle').getBoundingClientRect().height") >= 70
    page.shot(shots, "idle")
    page.shot(shots, "idle-dark", dark=True)

    page.press("#toggle")
    until("it records", lambda: page.text("#now").startswith("● REC 00:0"))
    until("it counts", lambda: page.text("#now") > "● REC 00:01")
    page.shot(shots, "recording")
    page.shot(shots, "recording-dark", dark=True)
    until("a sensor is unplugged", lambda: page.value("document.querySelectorAll('.bit.absent:not(.set)').length") == 1)
    assert page.text(".bit.absent b").startswith("□")
    until("its picture is old", lambda: page.value("document.querySelectorAll('figure.old').length") == 1)
    until("the verdict so far has the reason", lambda: "cam_wrist" in page.text("#reasons"))
    page.shot(shots, "unplugged")
    until("it is back", lambda: page.value(pictures) == 2)
    page.press("#toggle")
    until("it has ended", lambda: page.text("#now") == "Idle" and page.text("#about-verdict"))
    page.press("#success")
    until("it is labelled", lambda: page.value("document.querySelector('#success').classList.contains('chosen')"))
    page.shot(shots, "ended")

    # A discard needs two presses, soon after each other.
    page.press("#discard")
    until("it asks", lambda: page.text("#discard") == "Really discard")
    page.shot(shots, "really-discard")
    until("it asks no longer", lambda: page.text("#discard") == "Discard last")
    page.press("#discard")
    until("it asks", lambda: page.text("#discard") == "Really discard")
    assert page.text("#about-file")
    page.press("#discard")
    until("it is in the trash", lambda: page.value("document.querySelector('#about').hidden"))
    page.press("#undo")
    until("it is back", lambda: not page.value("document.querySelector('#about').hidden"))

    # The network is away while everything seems to be connected: nothing is shown as if it were current.
    run.process.send_signal(signal.SIGSTOP)
    until("it is lost", lambda: is_lost() and page.text("#lost").startswith("No connection since"))
    assert page.text("#now") == "?" and page.value("document.querySelectorAll('.bit.set').length") == 0
    assert "?" in page.text(".bit b") and page.value(pictures) == 0 and page.value("document.querySelector('#toggle').disabled")
    page.shot(shots, "lost")
    page.shot(shots, "lost-dark", dark=True)
    run.process.send_signal(signal.SIGCONT)
    until("it continues", lambda: page.text("#now") == "Idle" and page.value(pictures) == 2)

    # The run ends, and another begins at its place.
    run.end()
    until("it is lost", lambda: is_lost() and page.text("#lost").startswith("No connection since"))
    run = Run(rapid, place, port)
    until("it continues", lambda: page.text("#now") == "Idle" and page.value(pictures) == 2)
    page.press("#toggle")
    until("it records", lambda: page.text("#now").startswith("● REC"))
    page.press("#toggle")
    until("it has ended", lambda: page.text("#now") == "Idle")
    run.end()

    # With a token: without the link there is nothing, and with it everything; the address bar has no token.
    run = Run(rapid, place, port, ["--web-token", "token"])
    until("it shows what it needs", lambda: "QR code" in page.text("#lost"))
    page.shot(shots, "token")
    token = (place / "token").read_text().strip()
    page.ask("Page.navigate", url=f"http://127.0.0.1:{port}/#{token}")
    until("it is let in", lambda: page.text("#now") == "Idle" and page.value(pictures) == 2)
    assert page.value("location.href") == f"http://127.0.0.1:{port}/"
    page.ask("Page.reload")
    until("a reload is let in", lambda: page.text("#now") == "Idle" and page.value(pictures) == 2)
    run.end()

    elsewhere = [url for url in page.requested if not url.startswith((f"http://127.0.0.1:{port}/", "blob:", "data:"))]
    assert not elsewhere and not any(token in url for url in page.requested), elsewhere
    assert not page.problems, page.problems


def main():
    rapid, chromium = (str(Path(path).absolute()) for path in sys.argv[1:3])
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        (place / "scenario.toml").write_text(SCENARIO)
        shots = Path(sys.argv[3]) if len(sys.argv) > 3 else place
        shots.mkdir(parents=True, exist_ok=True)
        page = Browser(chromium, place / "browser")
        try:
            check(rapid, page, place, shots)
        except BaseException:
            page.shot(shots, "failed")
            raise
        finally:
            page.end()
    print("page: everything as it should be")


if __name__ == "__main__":
    main()
