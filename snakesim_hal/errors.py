"""The one error tree. Each class is also the matching builtin, so plain `except ValueError` works too."""


class SnakesimError(Exception):
    """Anything that SnakeSIM refuses or fails at; the message says what, and what to do next.

    lines: one, as a rule. Each is printed as one line, whatever it quotes from a file or from the network.
    """

    def __init__(self, *lines: str) -> None:
        super().__init__("\n".join(lines))
        self.lines = lines


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


class ControllerError(SnakesimError, RuntimeError):
    """A controller raised, or gave what cannot be sent: names the controller, the field, the value, what is allowed."""


class BackendError(SnakesimError, RuntimeError):
    """A backend cannot go on: a diverged simulation, a dead bus. The host reports it and goes safe."""


class RefusedError(SnakesimError, PermissionError):
    """The HAL answered no, with its reason: a lease held by another, an arming condition not met."""
