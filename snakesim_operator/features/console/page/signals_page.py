"""The page that shows signals over time, and the answers to its requests. The page's script is `signals.js`.

/signals                  the page; with ?within it is a part of the console's page
/signals/names            unit of each signal, by name
/signals/values           ?name=...&from_s=...&to_s=...   points of each signal, as many as can be drawn
/signals/values.csv       the same, with every sample
/signals/now              the time that the console shows
/signals/go               ?time_s=...   show another time of a recording
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
from snakesim_operator.features.console.robot_data.signals import SignalSource
from snakesim_operator.results.page.charts import LIBRARY, round_values, select_rows_to_draw
from snakesim_operator.results.page.palette import (
    DARK,
    LIGHT,
    format_css_variables,
    make_joint_colors,
)

PAGE_FOLDER = Path(__file__).parent
SIGNALS_PATH = "/signals"
MAX_SIGNALS = 16  # of one request
LINE_COLORS = 8
MAX_BUCKETS = 1500  # of time, in each of which a line has at most three points
SAME_PAGE_HEADER = "X-Snakesim"  # browsers do not let a page of another origin send this header
CONTENT_SECURITY_POLICY = (
    "default-src 'none'; script-src 'self' {}; style-src 'unsafe-inline'; connect-src 'self'; "
    "img-src 'self' blob: data:; frame-ancestors 'self'"
)

Query = dict[str, list[str]]
Series = tuple[Floats, Floats]  # times in s and values, (n,) each


class SignalsPage:
    """Answers the requests for paths below PATH. The web server calls `answer` in its thread."""

    def __init__(self, signals: SignalSource, second_stop: bytes = b"") -> None:
        """Answer from a source of signals.

        Args:
            signals: The source.
            second_stop: HTML of the second stop, for a live robot. A page that stands alone has it; a page within the
                console's page does not need a stop of its own.
        """
        self._signals = signals
        self._second_stop = second_stop
        self._policy = CONTENT_SECURITY_POLICY.format(_hash_script(second_stop))
        # Set by the display loop.
        # The time that is shown, since the first tick.
        self.now_s: Callable[[], float | None] = lambda: None
        self.jump_to: Callable[[float], None] | None = None  # None: a live robot

    def answer_request(self, request: Request) -> Response | None:
        """Return the answer to a request; None if its path is not one of this page."""
        address = urlsplit(request.path)
        if address.path != SIGNALS_PATH and not address.path.startswith(f"{SIGNALS_PATH}/"):
            return None
        path = address.path.removeprefix(SIGNALS_PATH)
        query = parse_qs(address.query, keep_blank_values=True)
        try:
            content_type, body = self._make_response_content(path, query, request)
        except KeyError as error:
            return self._make_response(
                HTTPStatus.NOT_FOUND, "text/plain", f"there is no {error}\n".encode()
            )
        except ValueError as error:
            return self._make_response(HTTPStatus.BAD_REQUEST, "text/plain", f"{error}\n".encode())
        return self._make_response(HTTPStatus.OK, content_type, body)

    def _make_response(self, status: HTTPStatus, content_type: str, body: bytes) -> Response:
        headers = Headers(
            {
                "Content-Type": f"{content_type}; charset=utf-8",
                "Content-Length": str(len(body)),
                "Cache-Control": "no-store",
                "Content-Security-Policy": self._policy,
                "Referrer-Policy": "no-referrer",
                "X-Content-Type-Options": "nosniff",
            }
        )
        return Response(status.value, status.phrase, headers, body)

    def _make_response_content(
        self, path: str, query: Query, request: Request
    ) -> tuple[str, bytes]:
        """Make content type and body of the response to a request for the signals page, its scripts or its data.

        Args:
            path: Path of the request below PATH.
            query: Parameters of the request.
            request: The request itself.

        Raises:
            KeyError: There is no such path or signal.
            ValueError: The query is not valid, or the request is not allowed.
        """
        match path:
            case "":
                return "text/html", self._make_page(is_within_console="within" in query)
            case "/signals.js":
                return "text/javascript", (PAGE_FOLDER / "signals.js").read_bytes()
            case "/plotly.js":
                return "text/javascript", LIBRARY.read_bytes()
            case "/names":
                return _encode_json(
                    {"recorded": self._signals.recorded, "units": self._signals.get_units()}
                )
            case "/now":
                return _encode_json({"time_s": self.now_s()})
            case "/go":
                self._jump_in_recording(query, request)
                return _encode_json({})
            case "/values":
                series = self._read_series(query)
                return _encode_json(
                    {name: _thin_for_chart(*one_series) for name, one_series in series.items()}
                )
            case "/values.csv":
                return "text/csv", _format_csv(
                    self._read_series(query), self._signals.get_units()
                ).encode()
            case _:
                raise KeyError(path)

    def _make_page(self, *, is_within_console: bool) -> bytes:
        page = (PAGE_FOLDER / "signals.html").read_bytes()
        page = page.replace(b"/*themes*/", _format_theme_css().encode())
        if is_within_console:
            return page
        return page.replace(b"<body>", b"<body>" + self._second_stop)

    def _jump_in_recording(self, query: Query, request: Request) -> None:
        """Show another time of a recording, if the request comes from this page."""
        if self.jump_to is None or request.headers.get(SAME_PAGE_HEADER) is None:
            raise ValueError("only the page of a recording goes to another time")
        self.jump_to(_parse_number(query, "time_s", math.nan))

    def _read_series(self, query: Query) -> dict[str, Series]:
        """Return the series that a query names, within the times that it gives, by name."""
        names = list(dict.fromkeys(query.get("name", [])))
        if len(names) > MAX_SIGNALS:
            raise ValueError(f"{len(names)} signals, at most {MAX_SIGNALS} at once")
        from_s = _parse_number(query, "from_s", -math.inf)
        to_s = _parse_number(query, "to_s", math.inf)
        series: dict[str, Series] = {}
        for name in names:
            times_s, values = self._signals.read_series(name)
            is_within = (times_s >= from_s) & (times_s <= to_s)
            series[name] = times_s[is_within], values[is_within]
        return series


def _parse_number(query: Query, name: str, default: float) -> float:
    """Return a number of seconds from a query. A default of NaN makes it obligatory."""
    number = float(query[name][0]) if name in query else default
    if math.isnan(number):
        raise ValueError(f"{name}: must be a number of seconds")
    return number


def _thin_for_chart(times_s: Floats, values: Floats) -> dict[str, object]:
    """Return the points of a line that can be drawn, and minimum, mean and maximum of all its values."""
    rows = select_rows_to_draw(values, MAX_BUCKETS)
    known = values[np.isfinite(values)]
    value_range = None
    if len(known):
        value_range = [float(known.min()), float(known.mean()), float(known.max())]
    return {
        "time_s": np.round(times_s[rows], 4).tolist(),
        "values": round_values(values[rows]),
        "range": value_range,
    }


def _format_csv(series_by_name: dict[str, Series], unit_by_name: dict[str, str]) -> str:
    """Format signals as CSV, with a row for every time at which a signal has a sample.

    A cell is empty if its signal has no sample at that time, or the value is unknown.

    Args:
        series_by_name: Times in s and values of each signal, by name.
        unit_by_name: Unit of each signal, by name.
    """
    csv_text = io.StringIO()
    writer = csv.writer(csv_text)
    writer.writerow(["time_s", *(f"{name} [{unit_by_name[name]}]" for name in series_by_name)])
    value_by_time_columns: list[dict[float, float]] = []  # one for each signal
    for times_s, values in series_by_name.values():
        rounded_times_s = np.round(times_s, 6).tolist()
        value_by_time_columns.append(dict(zip(rounded_times_s, values.tolist(), strict=True)))
    all_times_s = sorted({time_s for column in value_by_time_columns for time_s in column})
    for time_s in all_times_s:
        row_values = [column.get(time_s, math.nan) for column in value_by_time_columns]
        cells = ["" if math.isnan(row_value) else row_value for row_value in row_values]
        writer.writerow([time_s, *cells])
    return csv_text.getvalue()


def _encode_json(value: object) -> tuple[str, bytes]:
    return "application/json", msgspec.json.encode(value)


def _format_theme_css() -> str:
    """Return the style of the light and of the dark page; the page's script chooses one."""
    light = format_css_variables(LIGHT | make_joint_colors(LINE_COLORS, dark=False))
    dark = format_css_variables(DARK | make_joint_colors(LINE_COLORS, dark=True))
    return f":root{{{light}}}:root.dark{{{dark}color-scheme:dark}}"


def _hash_script(html: bytes) -> str:
    """Return the source expression of a content security policy that allows the one script in this HTML."""
    script = html.partition(b"<script>")[2].partition(b"</script>")[0]
    digest = b64encode(sha256(script).digest()).decode()
    return f"'sha256-{digest}'"
