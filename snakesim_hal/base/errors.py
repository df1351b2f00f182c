"""The one error tree. Each class is also the matching builtin, so plain `except ValueError` works too.

Each error has a code, such as `config/unknown-key`: a stable word that users search for, and that tests assert. The
text of a message may change at any time. `snakesim_hal.base.error_codes` explains every code.
"""

from collections.abc import Iterable


class SnakesimError(Exception):
    """Base of all errors of SnakeSIM. The message explains what is wrong, and what to do next."""

    code = "run/failed"  # stable; a class has its default, and a raise site may give a more specific one

    def __init__(self, *lines: str, code: str | None = None) -> None:
        """Make an error.

        Args:
            lines: The message. Each is printed as one line, whatever it quotes from file or network.
            code: One of `error_codes.ERROR_CODES`. None for the default of the class.
        """
        super().__init__("\n".join(lines))
        self.lines = lines
        if code is not None:
            self.code = code


class ConfigError(SnakesimError, ValueError):
    """A file, flag or setting is wrong: names the file, the field, the value and what is allowed."""

    code = "config/invalid-value"


class WireError(SnakesimError, ValueError):
    """A sample from the network is rejected: malformed, out of bounds, or of an unknown version.

    `reason` is a short word to count by: `unknown_message`, `unknown_version`, `malformed`, or, if the sample does not
    fit the robot, `wrong_length`, `no_rotation`, `no_path`. `detail` has the values.
    """

    code = "message/rejected"

    def __init__(self, reason: str, detail: str) -> None:
        """Make an error.

        Args:
            reason: Short word by which rejections are counted.
            detail: Values that were rejected, and what is allowed.
        """
        super().__init__(f"{reason}: {detail}")
        self.reason = reason
        self.detail = detail


class NotConnectedError(SnakesimError, ConnectionError):
    """No robot answers at the requested endpoint and namespace."""

    code = "network/no-answer"


class StalledError(SnakesimError, TimeoutError):
    """Something expected did not arrive in time."""

    code = "network/no-ticks"


class ControllerError(SnakesimError, RuntimeError):
    """A controller raised, or returned an invalid action: names the controller, field, value, and what is allowed."""

    code = "controller/failed"


class ServiceError(SnakesimError, RuntimeError):
    """A service raised, or published what no reader accepts: names service, key, tick, field, value and range."""

    code = "service/failed"


class BackendError(SnakesimError, RuntimeError):
    """A backend cannot continue: a diverged simulation, a dead bus. The host reports it and stops the robot."""

    code = "backend/failed"


class RefusedError(SnakesimError, PermissionError):
    """The HAL refused a request, with its reason: a lease held by another, an arming condition not met."""

    code = "robot/request-refused"


OUR_PACKAGES = frozenset(
    {
        "snakesim",
        "snakesim_can_backend",
        "snakesim_gnc",
        "snakesim_hal",
        "snakesim_operator",
        "snakesim_serial_backend",
        "snakesim_sim_backend",
    }
)
INSTALL_FOLDERS = ("site-packages", "dist-packages")  # the second one is Debian's


def describe_exception(error: BaseException, plugin: str = "") -> str:
    """Describe an exception of a plugin in one line: what it is, and the line of the plugin that led to it.

    Args:
        error: The exception, as caught.
        plugin: Module of the plugin's class; its package is where the line is looked for if the plugin is installed.
    """
    what = type(error).__name__
    if str(error):
        what = f"{what}: {error}"
    file, line = _find_plugin_line(error, plugin.partition(".")[0])
    return f"raised {what} ({file.rpartition('/')[2]} line {line})"


def _find_plugin_line(error: BaseException, package: str) -> tuple[str, int]:
    """Return the file and the line of plugin code that was executing when an error was raised.

    This is the innermost frame of the traceback that is not in SnakeSIM, in an installed package or in the standard
    library. If there is none, it is the innermost frame of the plugin's package, or else the innermost frame.

    Args:
        error: Error with its traceback.
        package: Name of the plugin's top-level package, which may be an installed one.
    """
    import sysconfig  # imported only for an error: `snakesim estop` must start at once
    import traceback

    standard_library_prefixes = (f"{sysconfig.get_path('stdlib')}/", "<frozen ")
    frames: list[tuple[str, str, int]] = []  # package, file and line, innermost frame first
    for frame, line in traceback.walk_tb(error.__traceback__):
        module = str(frame.f_globals.get("__name__", ""))
        frames.insert(0, (module.partition(".")[0], frame.f_code.co_filename, line))
    for frame_package, file, line in frames:
        is_installed = any(f"/{folder}/" in file for folder in INSTALL_FOLDERS)
        if (
            frame_package not in OUR_PACKAGES
            and not is_installed
            and not file.startswith(standard_library_prefixes)
        ):
            return file, line
    for frame_package, file, line in frames:
        if frame_package == package:
            return file, line
    _, file, line = frames[0]
    return file, line


def shorten(text: str, max_length: int = 120) -> str:
    """Return a text for quoting in a message, cut to a maximum number of characters."""
    if len(text) <= max_length:
        return text
    return text[: max_length - 3] + "..."


def find_nearest_word(word: str, known: Iterable[str]) -> str | None:
    """Return the known word that is most similar to a mistyped one, or None if no word is similar enough."""
    import difflib  # imported only for a mistake: `snakesim estop` must start at once

    matches = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    return matches[0] if matches else None


def suggest_word(word: str, known: Iterable[str]) -> str:
    """Return "did you mean `WORD`? " for a mistyped word, or an empty text if no known word is similar enough."""
    nearest_word = find_nearest_word(word, known)
    return f"did you mean `{nearest_word}`? " if nearest_word else ""
