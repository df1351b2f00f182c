"""Imports of a plugin's file from its own folder: `import helpers` in `./wave.py` finds `helpers.py` beside it.

Python's own search comes first, so a file never replaces a module of Python or of an installed package. Only names
that the plugin's files import themselves are looked up, not optional modules that a library tries to import. So a file
that another user left in that folder does not run unless the plugin imports it by name.
"""

import ast
import sys
from collections.abc import Iterator, Sequence
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType


class SiblingFinder:
    """Finds the modules beside a plugin's file, after every other finder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._imported_names: set[str] = set()

    def allow_imports_of(self, file: Path) -> None:
        """From now on, also look up the modules that this file imports."""
        self._imported_names.update(_list_imported_modules(file))

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return where a module is beside the plugin's file; None if it is not there, or not for this finder."""
        if path is not None or fullname not in self._imported_names:
            return None
        spec = PathFinder.find_spec(fullname, [str(self.folder)], target)
        if spec is not None:
            for file in _list_source_files(spec):
                self.allow_imports_of(file)
        return spec


def enable_sibling_imports(file: Path) -> None:
    """Let the imports of a plugin's file find the modules beside it, until this process ends.

    It adds a finder for the folder of the file to `sys.meta_path`, or extends the one that is there.
    """
    folder = file.parent
    for finder in sys.meta_path:
        if isinstance(finder, SiblingFinder) and finder.folder == folder:
            finder.allow_imports_of(file)
            return
    finder = SiblingFinder(folder)
    finder.allow_imports_of(file)
    sys.meta_path.append(finder)


def _list_source_files(spec: ModuleSpec) -> Iterator[Path]:
    """Yield the file of a module, or all files of a package."""
    if spec.submodule_search_locations is not None:
        for location in spec.submodule_search_locations:
            yield from Path(location).rglob("*.py")
    elif spec.origin is not None and spec.origin.endswith(".py"):
        yield Path(spec.origin)


def _list_imported_modules(file: Path) -> Iterator[str]:
    """Yield the top-level modules that a file imports, anywhere in it; nothing for a file that is not Python."""
    try:
        tree = ast.parse(file.read_bytes())
    except (OSError, SyntaxError, ValueError, RecursionError, MemoryError):
        return  # the import itself reports what is wrong with it
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name.partition(".")[0]
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module is not None:
            yield node.module.partition(".")[0]
