"""Runs the tests of this folder that need no torch, as `make test` does: scripts/models-tests.sh.

A module is left to `make train-test` if it imports a package of HEAVY, or a module of models/ that does. What a function imports
when it is called does not count: a test that calls such a function imports what it needs itself. Every other module runs, a
new one too, and one that needs a package that is not there fails.
"""

import ast
import os
import sys
import unittest
from collections.abc import Iterator
from pathlib import Path

TESTS = Path(__file__).parent
# Of hundreds of megabytes.
HEAVY = {"torch", "av"}
# The file to which skipped tests are appended, as those in Rust do (tests/support/skip.rs).
SKIPPED = "RAPID_SKIPPED"


def chosen(tests: Path) -> tuple[list[str], list[str]]:
    """The modules of tests in a folder: those that run here, and those that are left."""
    modules = sorted(file.stem for file in tests.glob("test_*.py"))
    left = [module for module in modules if is_heavy(module, [tests, tests.parent])]
    return [module for module in modules if module not in left], left


def is_heavy(module: str, places: list[Path]) -> bool:
    """Does a module import a heavy package, by itself or through others that are in one of these places?"""
    seen, todo = set(), [module]
    while todo:
        name = todo.pop()
        if name.partition(".")[0] in HEAVY:
            return True
        file = found(name, places)
        if file is not None and file not in seen:
            seen.add(file)
            package = name if file.name == "__init__.py" else name.rpartition(".")[0]
            todo += imports(ast.parse(file.read_text()), package)
    return False


def found(name: str, places: list[Path]) -> Path | None:
    """The file of a module, if it is in one of these places."""
    paths = [place.joinpath(*name.split(".")) for place in places]
    files = [file for path in paths for file in (path.with_suffix(".py"), path / "__init__.py")]
    return next((file for file in files if file.is_file()), None)


def imports(tree: ast.AST, package: str) -> Iterator[str]:
    """The modules that are imported when a module is, and what may be modules."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            up = package.split(".")[: len(package.split(".")) + 1 - node.level] if node.level else []
            base = ".".join([*up, *([node.module] if node.module else [])])
            yield base
            yield from (f"{base}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            yield from imports(ast.Module(node.orelse, []), package)
        elif not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
            yield from imports(node, package)


class Result(unittest.TextTestResult):
    """Reports each test that is skipped."""

    def addSkip(self, test: unittest.TestCase, reason: str) -> None:
        super().addSkip(test, reason)
        if path := os.environ.get(SKIPPED):
            line = f"models.{test.id()}: {' '.join(reason.split())}\n"
            with open(path, "a") as file:
                file.write(line)


def main() -> int:
    sys.path.insert(1, str(TESTS.parent))
    modules, left = chosen(TESTS)
    suite = unittest.defaultTestLoader.loadTestsFromNames(modules)
    result = unittest.TextTestRunner(resultclass=Result).run(suite)
    failed, skipped = len(result.failures) + len(result.errors), len(result.skipped)
    passed = result.testsRun - failed - skipped
    ok = result.wasSuccessful() and passed > 0
    print(
        f"test result: {'ok' if ok else 'FAILED'}. {passed} passed; {failed} failed; {skipped} skipped; models/tests, but for "
        f"{len(left)} modules that need torch (make train-test)"
    )
    return 0 if ok else 1


if __name__ == "__main__":
    sys.exit(main())
