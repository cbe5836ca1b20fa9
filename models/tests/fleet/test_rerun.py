"""`rerun FILE.mcap`: Rerun's own check of an episode, every message decoded."""

import os
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from recorded import PROGRAM, rapid

RERUN = os.environ.get("RERUN")


@unittest.skipUnless(PROGRAM and RERUN, "no program in $RAPID_BIN, or no $RERUN")
class Rerun(unittest.TestCase):
    def test_it_has_nothing_to_object_to(self) -> None:
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            rapid("--sim", "--headless", "--record", "--out", "episodes", "--duration", "5s", cwd=folder)
            (path,) = (folder / "episodes").glob("*.mcap")
            status, printed = self.check(folder, path)
            self.assertEqual(status, 0, printed)
            lines = [line.split() for line in printed.splitlines()]
            topics = {line[3]: line[0] for line in lines if len(line) > 3 and line[3].startswith("/")}
            expected = ["/rapid/frame", "/rapid/camera/wrist", "/rapid/camera/tactile", "/rapid/serial/motor"]
            self.assertEqual([topics.get(topic) for topic in expected], ["ok"] * 4, printed)
            self.assertEqual(set(topics.values()), {"ok"}, printed)
            # It does find what is wrong.
            cut = folder / "cut.mcap"
            cut.write_bytes(path.read_bytes()[:-100])
            self.assertNotEqual(self.check(folder, cut)[0], 0)

    def check(self, folder: Path, path: Path) -> tuple[int, str]:
        # Its statistics of use are of no interest: they stay in the home that is removed.
        environment = {**os.environ, "HOME": str(folder), "XDG_CONFIG_HOME": str(folder)}
        subprocess.run([RERUN, "analytics", "disable"], env=environment, capture_output=True, check=False)
        command = [RERUN, "mcap", "check", "--full", path]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        return done.returncode, done.stdout + done.stderr


if __name__ == "__main__":
    unittest.main()
