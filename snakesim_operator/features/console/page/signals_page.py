"""Signals over time, as a page beside the console's own: what is answered to it. The page itself is `signals.js`.

/signals                  the page; with ?within it is a part of the console's page
/signals/names            units by name
/signals/values           ?name=...&from_s=...&to_s=...   what can be drawn of each
/signals/values.csv       the same, every sample
/signals/now              the time that the console shows
/signals/go               ?time_s=...   show another one; of a recording
"""

import csv
import io
import math
from base64 import b64encode
from collections.abc import Callable
from hashlib import sha256
from http import HTTPStatus
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import msgspec
import numpy as np
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from snakesim_hal.base.arrays import Floats
from snakesim_operator.features.console.robot_data.signals import Signals
from snakesim_operator.results.page.charts import LIBRARY, rounded, thinned
from snakesim_operator.results.page.palette import DARK, LIGHT, joint_colors, variables

HERE = Path(__file__).parent
PATH = "/signals"
MOST_SIGNALS, COLOURS, BUCKETS = 16, 8, 1500
OURS = "X-Snakesim"  # a header that a page of another origin cannot send unasked
POLICY = (
    "default-src 'none'; script-src 'self' {}; style-src 'unsafe-inline'; connect-src 'self'; "
    "img-src 'self' blob: data:; frame-ancestors 'self'"
)


class SignalsPage:
    """Answers for the paths below PATH. Called by the web server, in its thread."""

    def __init__(self, signals: Signals, second_stop: bytes = b"") -> None:
        """second_stop: of a live robot, for a page that is not within the console's."""
        self._signals, self._second_stop = signals, second_stop
        self._policy = POLICY.format(_hash(second_stop))
        self.now_s: Callable[[], float | None] = lambda: None  # since the first tick
        self.go: Callable[[float], None] | None = None

    def answer(self, request: Request) -> Response | None:
        """None: not one of ours."""
        address = urlsplit(request.path)
        if address.path != PATH and not address.path.startswith(f"{PATH}/"):
            return None
        asked = parse_qs(address.query, keep_blank_values=True)
        try:
            kind, body = self._found(address.path.removeprefix(PATH), asked, request)
        except KeyError as error:
            return self._response(HTTPStatus.NOT_FOUND, "text/plain", f"there is no {error}\n".encode())
        except ValueError as error:
            return self._response(HTTPStatus.BAD_REQUEST, "text/plain", f"{error}\n".encode())
        return self._response(HTTPStatus.OK, kind, body)

    def _response(self, status: HTTPStatus, kind: str, body: bytes) -> Response:
        headers = Headers(
            {
                "Content-Type": f"{kind}; charset=utf-8",
                "Content-Length": str(len(body)),
                "Cache-Control": "no-store",
                "Content-Security-Policy": self._policy,
                "X-Content-Type-Options": "nosniff",
            }
        )
        return Response(status.value, status.phrase, headers, body)

    def _found(self, path: str, asked: dict[str, list[str]], request: Request) -> tuple[str, bytes]:
        match path:
            case "":
                stop = b"" if "within" in asked else self._second_stop
                page = (HERE / "signals.html").read_bytes().replace(b"/*themes*/", _themes().encode())
                return "text/html", page.replace(b"<body>", b"<body>" + stop)
            case "/signals.js":
                return "text/javascript", (HERE / "signals.js").read_bytes()
            case "/plotly.js":
                return "text/javascript", LIBRARY.read_bytes()
            case "/names":
                return _json({"recorded": self._signals.recorded, "units": self._signals.units()})
            case "/now":
                return _json({"time_s": self.now_s()})
            case "/go":
                if self.go is None or request.headers.get(OURS) is None:
                    raise ValueError("only the page of a recording goes to another time")
                self.go(_number(asked, "time_s", math.nan))
                return _json({})
            case "/values":
                return _json({name: _drawn(*series) for name, series in self._seen(asked).items()})
            case "/values.csv":
                return "text/csv", _table(self._seen(asked), self._signals.units()).encode()
            case _:
                raise KeyError(path)

    def _seen(self, asked: dict[str, list[str]]) -> dict[str, tuple[Floats, Floats]]:
        names = list(dict.fromkeys(asked.get("name", [])))
        if len(names) > MOST_SIGNALS:
            raise ValueError(f"{len(names)} signals, at most {MOST_SIGNALS} at once")
        from_s, to_s = _number(asked, "from_s", -math.inf), _number(asked, "to_s", math.inf)
        found: dict[str, tuple[Floats, Floats]] = {}
        for name in names:
            times_s, values = self._signals.series(name)
            within = (times_s >= from_s) & (times_s <= to_s)
            found[name] = times_s[within], values[within]
        return found


def _number(asked: dict[str, list[str]], name: str, otherwise: float) -> float:
    value = float(asked[name][0]) if name in asked else otherwise
    if math.isnan(value):
        raise ValueError(f"{name}: must be a number of seconds")
    return value


def _drawn(times_s: Floats, values: Floats) -> dict[str, object]:
    """What a chart needs of it, and its range."""
    rows, known = thinned(values, BUCKETS), values[np.isfinite(values)]
    return {
        "time_s": np.round(times_s[rows], 4).tolist(),
        "values": rounded(values[rows]),
        "range": [float(known.min()), float(known.mean()), float(known.max())] if len(known) else None,
    }


def _table(series: dict[str, tuple[Floats, Floats]], units: dict[str, str]) -> str:
    """A row for every time at which one of them has a sample; empty where it has none or is unknown."""
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(["time_s", *(f"{name} [{units[name]}]" for name in series)])
    columns = [dict(zip(np.round(t, 6).tolist(), v.tolist(), strict=True)) for t, v in series.values()]
    for time_s in sorted({time_s for column in columns for time_s in column}):
        values = (column.get(time_s, math.nan) for column in columns)
        writer.writerow([time_s, *("" if math.isnan(value) else value for value in values)])
    return text.getvalue()


def _json(value: object) -> tuple[str, bytes]:
    return "application/json", msgspec.json.encode(value)


def _themes() -> str:
    """Both, for a page that is told which one it has."""
    light = variables(LIGHT | joint_colors(COLOURS, dark=False))
    dark = variables(DARK | joint_colors(COLOURS, dark=True))
    return f":root{{{light}}}:root.dark{{{dark}color-scheme:dark}}"


def _hash(script: bytes) -> str:
    """What lets a page run this one script of its own."""
    inside = script.partition(b"<script>")[2].partition(b"</script>")[0]
    return f"'sha256-{b64encode(sha256(inside).digest()).decode()}'"
