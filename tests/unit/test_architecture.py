"""The walks of docs/concepts/architecture.md lead through functions that exist, and its tour from line to line."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "concepts" / "architecture.md").read_text()
WALKS = PAGE.partition("## Walks through the code\n")[2].partition("\n## ")[0]
ROWS = re.findall(r"^\|(?: (\d) \|)? `(\w+)` in `([\w/.]+)` \| (.+) \|$", WALKS, re.MULTILINE)
HOPS = [(name, path, line.strip("`")) for number, name, path, line in ROWS if number]


def sources(path: str, name: str) -> list[str]:
    """Of the functions of this name in a file."""
    text = (ROOT / path).read_text()
    functions = [
        node
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FunctionDef) and node.name == name
    ]
    return [ast.get_source_segment(text, node) or "" for node in functions]


def test_every_function_of_the_walks_is_where_they_say() -> None:
    assert len(ROWS) == len(re.findall(r"^\| (?:\d|`)", WALKS, re.MULTILINE)) >= 15
    assert not [f"{name} in {path}" for _, name, path, _ in ROWS if not sources(path, name)]


def test_readme_walk_reaches_the_line_that_limits_torque() -> None:
    readme = (ROOT / "README.md").read_text()
    assert "](docs/concepts/architecture.md#walks-through-the-code)" in readme
    assert f"]({HOPS[0][1]})" in readme
    assert len(HOPS) < 5
    assert HOPS[-1][1] == "snakesim_hal/safety/limiter.py"
    for (name, path, line), following in zip(HOPS, [*HOPS[1:], None], strict=True):
        assert any(line in source for source in sources(path, name)), (
            f"{line!r} is not in {name} of {path}"
        )
        if following is not None:
            assert following[0] in line, f"{line!r} does not lead to {following}"
