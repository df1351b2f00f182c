"""Decides which web pages may connect to a server of this program on loopback: its own pages, and no others. Pure.

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
    """Return why a connection is refused; None when it may be opened.

    Args:
        host: of the request; None if it is missing.
        origin: of the request; None if it is missing.
        also: further origins that may connect.
    """
    if host is None or LOOPBACK_HOST.fullmatch(host) is None:
        return f"Host is {_shown(host)}; it has to be a name of this computer: 127.0.0.1, localhost or [::1]"
    if origin is None or origin in also:
        return None
    if origin.lower() in (f"http://{host}".lower(), f"https://{host}".lower()):
        return None
    return f"the page is of the origin {_shown(origin)}; only pages of http://{host} may connect"


def explain_head_refusal(head: bytes, also: Collection[str] = ()) -> str | None:
    """Return why a connection is refused, from the head of its HTTP request; None when it may be opened."""
    headers: dict[str, str] = {}
    for line in head.decode("latin-1").split("\r\n")[1:]:
        name, _, value = line.partition(":")
        headers[name.strip().lower()] = value.strip()
    return explain_refusal(headers.get("host"), headers.get("origin"), also)


def _shown(text: str | None) -> str:
    return "missing" if text is None else repr(text[:MAX_CHARACTERS_SHOWN])
