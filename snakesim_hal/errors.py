"""The one error tree. Each class is also the matching builtin, so plain `except ValueError` works too."""


class SnakesimError(Exception):
    """Anything that SnakeSIM refuses or fails at; the message says what, and what to do next."""


class ConfigError(SnakesimError, ValueError):
    """A file, flag or setting is wrong: names the file, the field, the value and what is allowed."""


class WireError(SnakesimError, ValueError):
    """A sample from the network cannot be taken: malformed, out of bounds, or of an unknown version.

    `reason` is a short word to count by: `unknown_message`, `unknown_version`, `malformed`.
    """

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason


class NotConnectedError(SnakesimError, ConnectionError):
    """No robot answers at the endpoint and namespace asked for."""


class StalledError(SnakesimError, TimeoutError):
    """Something that had to arrive did not arrive in its time."""


class BackendError(SnakesimError, RuntimeError):
    """A backend cannot go on: a diverged simulation, a dead bus. The host reports it and goes safe."""


class RefusedError(SnakesimError, PermissionError):
    """The HAL answered no, with its reason: a lease held by another, an arming condition not met."""
