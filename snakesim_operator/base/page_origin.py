"""Decides which web pages may connect to a server of this program on loopback: only its own pages.

A browser lets any page connect to loopback, and sends the page's origin (scheme, host, port). So a page of another
site, and of another port of this computer, is refused. A name that a foreign site points at loopback (DNS rebinding)
shows in `Host`, which has to be a name of this computer; its port may be another one, as behind an SSH tunnel. A client
that sends no origin is not a web page: browsers always send it.
"""

import re
from collections.abc import Collection

LOOPBACK_HOST = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d{1,5})?", re.IGNORECASE)
MAX_CHARACTERS_SHOWN = 80


def explain_refusal(host: str | None, origin: str | None, also: Collection[str] = ()) -> str | None:
    """Explain why a connection is refused; None if it may be opened.

    Args:
        host: Header `Host` of the request; None if it is missing.
        origin: Header `Origin` of the request; None if it is missing.
        also: Further origins that may connect.
    """
    if host is None or LOOPBACK_HOST.fullmatch(host) is None:
        return f"Host is {_format_header(host)}; it has to be a name of this computer: 127.0.0.1, localhost or [::1]"
    if origin is None or origin in also:
        return None
    if origin.lower() in (f"http://{host}".lower(), f"https://{host}".lower()):
        return None
    return f"the page is of the origin {_format_header(origin)}; only pages of http://{host} may connect"


def explain_request_refusal(head: bytes, also: Collection[str] = ()) -> str | None:
    """Explain why a connection is refused, from the headers of its HTTP request; None if it may be opened.

    Args:
        head: Request line and headers of the request.
        also: Further origins that may connect.
    """
    headers: dict[str, str] = {}
    for line in head.decode("latin-1").split("\r\n")[1:]:
        name, _, value = line.partition(":")
        headers[name.strip().lower()] = value.strip()
    return explain_refusal(headers.get("host"), headers.get("origin"), also)


def _format_header(text: str | None) -> str:
    """Format a header for a message: quoted and shortened, or "missing"."""
    return "missing" if text is None else repr(text[:MAX_CHARACTERS_SHOWN])
