"""Files of settings from anywhere: what is none, or is too much, is one clear line, in bounded time and memory."""

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

LIMIT_S = 10.0  # on a busy machine; alone each takes less than two
DEEP = ".".join("a" * 50_000)


def sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(50 * 1024**3)


def make_socket(path: Path) -> None:
    os.mknod(path, stat.S_IFSOCK | 0o600)


ODD: dict[str, Callable[[Path], object]] = {
    "pipe": os.mkfifo,
    "device that never ends": lambda path: path.symlink_to("/dev/zero"),
    "terminal": lambda path: path.symlink_to("/dev/tty"),
    "socket": make_socket,
    "folder": Path.mkdir,
    "50 GB of nothing": sparse,
    "10 MB": lambda path: path.write_text("a = 1\n" * 1_700_000),
    "5 MB of TOML": lambda path: path.write_text("a = 1\n" * 850_000),
    "link in a circle": lambda path: path.symlink_to(path),
    "UTF-16": lambda path: path.write_text("a = 1", encoding="utf-16"),
    "UTF-16 without a mark": lambda path: path.write_text("a = 1", encoding="utf-16-le"),
    "Latin-1": lambda path: path.write_bytes(b"a = '\xe4'"),
    "key of 50,000 parts": lambda path: path.write_text(f"{DEEP} = 1"),
    "section of 50,000 parts": lambda path: path.write_text(f"[{DEEP}]"),
    "quoted key of 50,000 parts": lambda path: path.write_text('"a"."b" . ' * 25_000),
    "key of 50,000 parts inside": lambda path: path.write_text(f"x = {{ {DEEP} = 1 }}"),
    "deep lists": lambda path: path.write_text("a = " + "[" * 100_000),
    "deep sections": lambda path: path.write_text("a = " + "{a=" * 100_000),
    "lists that are closed": lambda path: path.write_text("a = " + "[" * 200 + "]" * 200),
    "number of 100,000 digits": lambda path: path.write_text("a = " + "9" * 100_000),
}


@pytest.mark.parametrize("odd", ODD)
def test_an_odd_file_is_one_clear_line_at_once(
    odd: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "odd.toml"
    ODD[odd](path)
    started = time.monotonic()
    with raises_error(
        ConfigError, code=("file/invalid-syntax", "file/not-readable", "file/too-large")
    ) as caught:
        load_scenario(str(path))
    assert time.monotonic() - started < LIMIT_S
    assert str(caught.value).startswith(f"{path}: "), caught.value
    assert len(caught.value.lines) == 1
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize("depth", [MAX_DEPTH + 1, 900, 100_000])
def test_a_deep_json_file_is_refused(depth: int, tmp_path: Path) -> None:
    path = tmp_path / "config.json"
    path.write_text('{"a":' * depth + "1" + "}" * depth)
    with raises_error(ConfigError, code="file/too-large"):
        read_table(path)


@pytest.mark.slow
def test_text_file_of_maximum_size_is_read_in_bounded_time(tmp_path: Path) -> None:
    key = ".".join("k" * (MAX_DEPTH - 1))
    text = "".join(f"a{i}.{key} = 1\n" for i in range(80_000))[: MAX_TOML_CHARACTERS - 10]
    (tmp_path / "large.toml").write_text(text[: text.rindex("\n")])
    started = time.monotonic()
    with raises_error(ConfigError, code="config/unknown-key", stored=False):
        load_scenario(
            str(tmp_path / "large.toml"),
            [parse_set_option("robot=planar13"), parse_set_option("scene=triplet")],
        )
    assert time.monotonic() - started < 3 * LIMIT_S


def test_a_byte_order_mark_is_skipped(tmp_path: Path) -> None:
    for name, text in (("a.toml", "a = 1"), ("a.json", '{"a": 1}')):
        (tmp_path / name).write_text(text, encoding="utf-8-sig")
        assert read_table(tmp_path / name).values == {"a": 1}


@pytest.mark.parametrize(
    "text", [f"{DEEP}=1", f"robot={{{DEEP}=1}}", "rate_hz=" + "[" * 50_000, "x" * 200_000]
)
def test_a_flag_of_any_length_is_one_short_line(text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_scenario("triplet", [parse_set_option(text)])
    assert len(str(caught.value)) < 1000
    assert "\n" not in str(caught.value)


def test_names_that_no_file_has() -> None:
    for name in ("a\0b.toml", "x" * 5000 + ".toml", "~nobody-of-this-name/x.toml"):
        with pytest.raises(ConfigError):
            read_text(resolve_file_path(name, "scenarios"))
    with raises_error(ConfigError, code="config/unknown-name"):
        resolve_file_path("x" * 5000, "scenarios")
    with raises_error(ConfigError, code="config/unknown-key"):
        ConfigTable({"a": [1]}, "x").set_value("a.²", 1, "--set")


def test_a_router_file_that_would_overflow_zenoh(tmp_path: Path) -> None:
    for text in ("[" * 100_000, "{plugins:" * 20_000):
        (tmp_path / "router.json5").write_text(text)
        with (
            raises_error(ConfigError, code="file/too-large"),
            open_router(tmp_path / "router.json5"),
        ):
            pass


def test_a_dotted_text_is_no_dotted_key() -> None:
    assert parse_toml("about = 'wait ..................................... 1.2.3.4'", "x")[
        "about"
    ].endswith("4")


# --- writing ---------------------------------------------------------------------------------------------------


def test_a_file_is_written_whole_into_folders_that_are_made(tmp_path: Path) -> None:
    write_text(tmp_path / "a" / "b.html", "old")
    write_text(tmp_path / "a" / "b.html", "new")
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["b.html"]
    assert (tmp_path / "a" / "b.html").read_text() == "new"


TAKEN: dict[str, Callable[[Path], object]] = {
    "link": lambda path: path.symlink_to(path.with_name("elsewhere")),
    "link to nowhere": lambda path: path.symlink_to("/nowhere/at/all"),
    "pipe": os.mkfifo,
    "folder": Path.mkdir,
}


@pytest.mark.parametrize("taken", TAKEN)
def test_what_is_no_file_is_not_written_to(taken: str, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").write_text("precious")
    TAKEN[taken](tmp_path / "out.html")
    with raises_error(ConfigError, code="file/not-readable"):
        write_text(tmp_path / "out.html", "page")
    assert (tmp_path / "elsewhere").read_text() == "precious"


def test_text_file_link_at_partial_name_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").write_text("precious")
    (tmp_path / "out.html.partial").symlink_to(tmp_path / "elsewhere")
    write_text(tmp_path / "out.html", "page")
    assert (tmp_path / "elsewhere").read_text() == "precious"
    assert (tmp_path / "out.html").read_text() == "page"
