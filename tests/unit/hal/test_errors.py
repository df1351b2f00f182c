"""An exception of a plugin is described by the line that its author has written."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from snakesim_hal.base.errors import describe_exception

PLUGIN = "import numpy as np\n\n\ndef solve():\n    return np.linalg.solve(np.zeros((2, 2)), np.ones(2))\n"


def described(folder: Path, package: str) -> str:
    """What is said of an exception within NumPy, called by `mine.plugin` in this folder."""
    folder.mkdir()
    names: dict[str, Any] = {"__name__": "mine.plugin"}
    exec(compile(PLUGIN, str(folder / "plugin.py"), "exec"), names)
    with pytest.raises(np.linalg.LinAlgError) as caught:
        names["solve"]()
    # Without this test's own line.
    return describe_exception(caught.value.with_traceback(caught.tb.tb_next), package)


@pytest.mark.parametrize(
    ("folder", "package", "place"),
    [
        ("home", "", "plugin.py line 5"),
        ("site-packages", "mine.plugin", "plugin.py line 5"),
        ("dist-packages", "mine", "plugin.py line 5"),
        ("site-packages", "another", r"_linalg.py line \d+"),
    ],
)
def test_error_location_is_plugin_line_and_not_of_numpy(
    tmp_path: Path, folder: str, package: str, place: str
) -> None:
    said = described(tmp_path / folder, package)
    assert re.fullmatch(rf"raised LinAlgError: Singular matrix \({place}\)", said)
