"""Which tests run without torch, and that a skipped one is reported."""

import io
import os
import tempfile
import unittest
from pathlib import Path
from unittest import mock

from without_torch import SKIPPED, TESTS, Result, chosen

FILES = {
    "package/__init__.py": "",
    "package/light.py": "import numpy\nfrom . import circle\ndef later():\n    import torch\n",
    "package/circle.py": "from .light import later\n",
    "package/heavy.py": "import torch.nn as nn\n",
    "package/through.py": "from .heavy import nn\n",
    "package/above/__init__.py": "from ..through import nn\n",
    "tests/helper.py": "import package.heavy\n",
    "tests/test_alone.py": "import json\n",
    "tests/test_light.py": "from package.light import later\n",
    "tests/test_types.py": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import torch\n",
    "tests/test_strange.py": "import torchlike\n",
    "tests/test_direct.py": "from torch import Tensor\n",
    "tests/test_tried.py": "try:\n    import torch\nexcept ImportError:\n    pass\n",
    "tests/test_through.py": "from package import through\n",
    "tests/test_above.py": "import package.above\n",
    "tests/test_class.py": "class Case:\n    import torch\n",
    "tests/test_helped.py": "import helper\n",
    "tests/test_video.py": "import av\n",
}


class Chosen(unittest.TestCase):
    def test_a_module_is_left_if_it_imports_torch_by_itself_or_through_others(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            for name, text in FILES.items():
                file = Path(folder, name)
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_text(text)
            runs, left = chosen(Path(folder, "tests"))
        self.assertEqual(runs, ["test_alone", "test_light", "test_strange", "test_types"])
        self.assertEqual(left, [f"test_{name}" for name in ("above", "class", "direct", "helped", "through", "tried", "video")])

    def test_every_module_of_this_folder_is_either(self) -> None:
        runs, left = chosen(TESTS)
        self.assertEqual(sorted([*runs, *left]), sorted(file.stem for file in TESTS.glob("test_*.py")))
        self.assertIn("test_corpus", runs)
        self.assertIn(Path(__file__).stem, runs)
        self.assertIn("test_dataset", left)


class Skipped(unittest.TestCase):
    def test_a_skipped_test_is_a_line_with_its_name_and_reason(self) -> None:
        class Case(unittest.TestCase):
            @unittest.skip("no\nprogram")
            def test_it(self) -> None:
                pass

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "skipped")
            path.write_text("other: one\n")
            runner = unittest.TextTestRunner(io.StringIO(), resultclass=Result)
            with mock.patch.dict(os.environ, {SKIPPED: str(path)}):
                runner.run(Case("test_it"))
            with mock.patch.dict(os.environ):
                os.environ.pop(SKIPPED, None)
                runner.run(Case("test_it"))
            self.assertEqual(path.read_text(), f"other: one\nmodels.{Case('test_it').id()}: no program\n")


if __name__ == "__main__":
    unittest.main()
