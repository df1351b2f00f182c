"""Where the last run on this computer left its record, so that `snakesim status` can tell of a run that is over."""

import json
import os
from pathlib import Path


def _file() -> Path:
    state = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return Path(state) / "snakesim" / "last-run.json"


def remember(folder: Path, ended: str) -> None:
    """Note a finished run. A home that cannot be written to is no reason to fail."""
    try:
        _file().parent.mkdir(parents=True, exist_ok=True)
        _file().write_text(json.dumps({"folder": str(folder), "ended": ended}), encoding="utf-8")
    except OSError:
        return


def recall() -> tuple[str, str] | None:
    """Folder and ending of the last run, or None."""
    try:
        noted = json.loads(_file().read_text(encoding="utf-8"))
        return str(noted["folder"]), str(noted["ended"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
