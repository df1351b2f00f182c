"""A file that is not readable or too large causes one short error, in bounded time and memory."""

import os
import stat
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import ConfigTable, read_table, resolve_file_path
from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_hal.model.textfiles import (
    MAX_DEPTH,
    MAX_TOML_CHARACTERS,
    parse_toml,
    read_text,
    write_text,
)
from snakesim_hal.network.router import open_router
from snakesim_testing.messages import raises_error

LIMIT_S = 10.0  # for a busy machine; on an idle one, each file needs less than two
DEEP_KEY = ".".join("a" * 50_000)


def make_sparse_file(path: Path) -> None:
    """Create a file of 50 GB that uses no disk space."""
    with path.open("wb") as file:
        file.truncate(50 * 1024**3)


def make_socket(path: Path) -> None:
    os.mknod(path, stat.S_IFSOCK | 0o600)


UNUSUAL_FILES: dict[str, Callable[[Path], object]] = {
    "pipe": os.mkfifo,
    "device that never ends": lambda path: path.symlink_to("/dev/zero"),
    "terminal": lambda path: path.symlink_to("/dev/tty"),
    "socket": make_socket,
    "folder": Path.mkdir,
    "50 GB of nothing": make_sparse_file,
    "10 MB": lambda path: path.write_text("a = 1\n" * 1_700_000),
    "5 MB of TOML": lambda path: path.write_text("a = 1\n" * 850_000),
    "link in a circle": lambda path: path.symlink_to(path),
    "UTF-16": lambda path: path.write_text("a = 1", encoding="utf-16"),
    "UTF-16 without a mark": lambda path: path.write_text("a = 1", encoding="utf-16-le"),
    "Latin-1": lambda path: path.write_bytes(b"a = '\xe4'"),
    "key of 50,000 parts": lambda path: path.write_text(f"{DEEP_KEY} = 1"),
    "section of 50,000 parts": lambda path: path.write_text(f"[{DEEP_KEY}]"),
    "quoted key of 50,000 parts": lambda path: path.write_text('"a"."b" . ' * 25_000),
    "key of 50,000 parts inside": lambda path: path.write_text(f"x = {{ {DEEP_KEY} = 1 }}"),
    "deep lists": lambda path: path.write_text("a = " + "[" * 100_000),
    "deep sections": lambda path: path.write_text("a = " + "{a=" * 100_000),
    "lists that are closed": lambda path: path.write_text("a = " + "[" * 200 + "]" * 200),
    "number of 100,000 digits": lambda path: path.write_text("a = " + "9" * 100_000),
}


@pytest.mark.parametrize("case", UNUSUAL_FILES)
def test_unusual_file_is_refused_immediately_in_one_line(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "odd.toml"
    UNUSUAL_FILES[case](path)
    start_s = time.monotonic()
    with raises_error(
        ConfigError, code=("file/invalid-syntax", "file/not-readable", "file/too-large")
    ) as refusal:
        load_scenario(str(path))
    assert time.monotonic() - start_s < LIMIT_S
    assert str(refusal.value).startswith(f"{path}: "), refusal.value
    assert len(refusal.value.lines) == 1
    assert "\n" not in str(refusal.value)
    assert len(str(refusal.value)) < 500


@pytest.mark.parametrize("depth", [MAX_DEPTH + 1, 900, 100_000])
def test_json_file_with_deep_nesting_is_refused(depth: int, tmp_path: Path) -> None:
    path = tmp_path / "config.json"
    path.write_text('{"a":' * depth + "1" + "}" * depth)
    with raises_error(ConfigError, code="file/too-large"):
        read_table(path)


@pytest.mark.slow
def test_text_file_of_maximum_size_is_read_in_bounded_time(tmp_path: Path) -> None:
    key = ".".join("k" * (MAX_DEPTH - 1))
    text = "".join(f"a{i}.{key} = 1\n" for i in range(80_000))[: MAX_TOML_CHARACTERS - 10]
    (tmp_path / "large.toml").write_text(text[: text.rindex("\n")])
    start_s = time.monotonic()
    with raises_error(ConfigError, code="config/unknown-key", stored=False):
        load_scenario(
            str(tmp_path / "large.toml"),
            [parse_set_option("robot=planar13"), parse_set_option("scene=triplet")],
        )
    assert time.monotonic() - start_s < 3 * LIMIT_S


def test_text_file_with_byte_order_mark_is_read(tmp_path: Path) -> None:
    for name, text in (("a.toml", "a = 1"), ("a.json", '{"a": 1}')):
        (tmp_path / name).write_text(text, encoding="utf-8-sig")
        assert read_table(tmp_path / name).values == {"a": 1}


@pytest.mark.parametrize(
    "text", [f"{DEEP_KEY}=1", f"robot={{{DEEP_KEY}=1}}", "rate_hz=" + "[" * 50_000, "x" * 200_000]
)
def test_set_option_of_any_length_causes_a_short_error(text: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        load_scenario("triplet", [parse_set_option(text)])
    assert len(str(refusal.value)) < 1000
    assert "\n" not in str(refusal.value)


def test_impossible_file_name_is_refused() -> None:
    for name in ("a\0b.toml", "x" * 5000 + ".toml", "~unknown-user/x.toml"):
        with pytest.raises(ConfigError):
            read_text(resolve_file_path(name, "scenarios"))
    with raises_error(ConfigError, code="config/unknown-name"):
        resolve_file_path("x" * 5000, "scenarios")
    with raises_error(ConfigError, code="config/unknown-key"):
        ConfigTable({"a": [1]}, "x").set_value("a.²", 1, "--set")


def test_router_file_with_deep_nesting_is_refused(tmp_path: Path) -> None:
    for text in ("[" * 100_000, "{plugins:" * 20_000):
        (tmp_path / "router.json5").write_text(text)
        with (
            raises_error(ConfigError, code="file/too-large"),
            open_router(tmp_path / "router.json5"),
        ):
            pass


def test_toml_text_with_many_dots_is_accepted() -> None:
    assert parse_toml("about = 'wait ..................................... 1.2.3.4'", "x")[
        "about"
    ].endswith("4")


# --- writing ---------------------------------------------------------------------------------------------------


def test_text_file_is_written_whole_into_new_folders(tmp_path: Path) -> None:
    write_text(tmp_path / "a" / "b.html", "old")
    write_text(tmp_path / "a" / "b.html", "new")
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["b.html"]
    assert (tmp_path / "a" / "b.html").read_text() == "new"


UNUSUAL_TARGETS: dict[str, Callable[[Path], object]] = {
    "link": lambda path: path.symlink_to(path.with_name("elsewhere")),
    "link to nowhere": lambda path: path.symlink_to("/nowhere/at/all"),
    "pipe": os.mkfifo,
    "folder": Path.mkdir,
}


@pytest.mark.parametrize("case", UNUSUAL_TARGETS)
def test_text_file_is_not_written_to_special_files(case: str, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").write_text("precious")
    UNUSUAL_TARGETS[case](tmp_path / "out.html")
    with raises_error(ConfigError, code="file/not-readable"):
        write_text(tmp_path / "out.html", "page")
    assert (tmp_path / "elsewhere").read_text() == "precious"


def test_text_file_link_at_partial_name_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").write_text("precious")
    (tmp_path / "out.html.partial").symlink_to(tmp_path / "elsewhere")
    write_text(tmp_path / "out.html", "page")
    assert (tmp_path / "elsewhere").read_text() == "precious"
    assert (tmp_path / "out.html").read_text() == "page"
