"""Count the words that this project no longer uses: `python -m verification.vocabulary`.

Each word has a standard replacement. The command counts identifiers and prose of the product and its documentation. It
counts neither tests nor the changelog.
"""

import re
import subprocess
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
NOT_COUNTED = ("CHANGELOG.md", "docs/style/reject.toml")  # the latter lists rejected words
REPLACEMENTS: dict[str, str] = {
    r"twins?": "emulator, emulated drive",
    r"set[-_]points?": "setpoint",
    r"famil(y|ies)": "driver type",
    r"plant": "physics model",
    r"safe_action": "stop mode",
    r"pace": "clock mode",
    r"every_ticks": "decimation",
    r"lag_ticks": "latency_ticks",
    r"stamp_ns": "timestamp_ns",
    r"(least|most|largest|greatest)_(?!squares|common)\w+": "min_, max_",
    r"\w+_share": "_fraction, _ratio",
    r"felt\w*": "measured",
    r"hung": "suspended",
    r"uneven": "heightfield",
    r"(colou|behaviou|neighbou)rs?": "American spelling",
    r"optimis\w+|localis\w+|minimis\w+": "American spelling",
    r"centre\w*|metres?": "American spelling",
    r"came_true|CameTrue|Carried|Ruling|Patience|HandedOn|Soles|TookTooLongError": "what the class is",
    r"lacks": "missing",
    r"nobody|somebody|whoever": "name the actor",
    r"told|tells|said|says|heard|hears": "report, send, measure",
    r"(?<![Dd]ead[-_\s])reckon\w*": "estimate; `dead reckoning` is the method",
    r"strangers?": "unknown node, unauthorized client",
    r"stands still": "is stationary",
    r"lets go": "disables, releases",
}


def count_word(pattern: str, *paths: str) -> int:
    """Return how often a word occurs in tracked files, as a whole word or as a part of an identifier.

    Args:
        pattern: Regular expression of the word.
        paths: Files and folders, as `git ls-files` takes them.
    """
    word = rf"(?<![A-Za-z])({pattern})(?![A-Za-z])"
    listed = subprocess.run(
        ["git", "ls-files", *paths], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    total = 0
    for name in listed.stdout.splitlines():
        is_counted = "/vendor/" not in name and name not in NOT_COUNTED
        if is_counted and name.endswith((".py", ".md", ".toml", ".html", ".js")):
            total += len(re.findall(word, (REPOSITORY / name).read_text()))
    return total


def main() -> None:
    """Print a line for each word with its count in code, its count in the documentation, and its replacement."""
    print(f"{'word':60} {'code':>6} {'docs':>6}  write instead")
    for pattern, replacement in REPLACEMENTS.items():
        code = count_word(pattern, "snakesim*", "schemas", "deploy", "benchmarks")
        docs = count_word(pattern, "docs", "README.md")
        print(f"{pattern:60} {code:6} {docs:6}  {replacement}")


if __name__ == "__main__":
    main()
