"""An exception of a plugin is described with the line of the plugin, and not with a line of a library."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from snakesim_hal.base.errors import describe_exception

PLUGIN = "import numpy as np\n\n\ndef solve():\n    return np.linalg.solve(np.zeros((2, 2)), np.ones(2))\n"


def describe_plugin_error(folder: Path, package: str) -> str:
    """Return the description of an exception in NumPy, which `mine.plugin` in this folder calls."""
    folder.mkdir()
    namespace: dict[str, Any] = {"__name__": "mine.plugin"}
    exec(compile(PLUGIN, str(folder / "plugin.py"), "exec"), namespace)
    with pytest.raises(np.linalg.LinAlgError) as raised:
        namespace["solve"]()
    # The traceback begins after the line of this test.
    return describe_exception(raised.value.with_traceback(raised.tb.tb_next), package)


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
    description = describe_plugin_error(tmp_path / folder, package)
    assert re.fullmatch(rf"raised LinAlgError: Singular matrix \({place}\)", description)
