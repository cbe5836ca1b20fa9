#!/usr/bin/env python3
"""Runs the tests of a folder as `python -m unittest discover -v` does, and writes down those that were skipped.

    units.py FOLDER SKIPPED

SKIPPED gets a line for each: its name, a tab, the reason. Exits with 1 if a test failed, or if there is none.
"""

import sys
import unittest


def main(folder, skipped):
    # A test's own modules stand before the folder of this file.
    found = unittest.defaultTestLoader.discover(folder)
    result = unittest.TextTestRunner(verbosity=2).run(found)
    with open(skipped, "w", encoding="utf-8") as file:
        file.writelines(f"{test.id()}\t{' '.join(reason.split())}\n" for test, reason in result.skipped)
    return 0 if result.wasSuccessful() and result.testsRun else 1


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    sys.exit(main(*sys.argv[1:]))
