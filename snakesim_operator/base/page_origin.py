"""Which web pages may open a connection to a server of ours on loopback: its own, and no other. Pure.

A browser lets any page connect to loopback, and names the page's origin (scheme, host, port). So a page of another
site, and of another port of this computer, is refused. A name that a foreign site points at loopback (DNS rebinding)
shows in `Host`, which has to be a name of this computer; its port may be another one, as behind an SSH tunnel. A client
that names no origin is no web page: browsers always do.
"""

import re
from collections.abc import Collection

LOOPBACK_HOST = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d{1,5})?", re.IGNORECASE)
LONGEST_SHOWN = 80


def why_refused(host: str | None, origin: str | None, also: Collection[str] = ()) -> str | None:
    """None when the connection may be opened, else why not. host, origin: of its request; also: further origins."""
    if host is None or LOOPBACK_HOST.fullmatch(host) is None:
        return f"Host is {_shown(host)}; it has to be a name of this computer: 127.0.0.1, localhost or [::1]"
    ours = {f"http://{host}".lower(), f"https://{host}".lower()}
    if origin is None or origin.lower() in ours or origin in also:
        return None
    return f"the page is of the origin {_shown(origin)}; only pages of http://{host} may connect"


def why_head_refused(head: bytes, also: Collection[str] = ()) -> str | None:
    """As `why_refused`, of the head of an HTTP request."""
    pairs = (line.partition(":") for line in head.decode("latin-1").split("\r\n")[1:])
    headers = {name.strip().lower(): value.strip() for name, _, value in pairs}
    return why_refused(headers.get("host"), headers.get("origin"), also)


def _shown(text: str | None) -> str:
    return "missing" if text is None else repr(text[:LONGEST_SHOWN])
