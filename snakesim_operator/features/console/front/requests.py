"""Reads the head of an HTTP request, and decides whether it is answered. Pure, except for `read_head`."""

import asyncio
import secrets
from dataclasses import dataclass

from snakesim_operator.base.page_origin import explain_request_refusal

MAX_HEAD_BYTES = 16 * 1024  # far above what a browser sends
END_OF_HEAD = b"\r\n\r\n"
WRONG_TOKEN = (
    "this address has not the token of this console; open the address that the console printed. It changes with each "
    "start"
)


@dataclass(frozen=True)
class BadRequest:
    """A request that is not answered, and why."""

    status: int
    kind: str  # by which refusals are counted
    reason: str


@dataclass(frozen=True)
class FrontRequest:
    """A request with the right token, for the stop or for a page."""

    method: str
    path: str  # without token and query; empty if the address ends with the token
    head: bytes  # as the page server gets it: without the token
    is_websocket: bool


async def read_head(reader: asyncio.StreamReader, limit_s: float) -> bytes:
    """Return the head of the next request, with the empty line at its end.

    Raises:
        TimeoutError: The head did not arrive in time.
        IncompleteReadError: The client closed its connection.
        LimitOverrunError: The head is too long.
    """
    async with asyncio.timeout(limit_s):
        return await reader.readuntil(END_OF_HEAD)


def parse_and_authorize_head(head: bytes, token: str) -> FrontRequest | BadRequest:
    """Parse the head of an HTTP request, check its origin and token, and remove the token from its path.

    Pages of other origins do not know the token. They are refused by their origin all the same, so that a token which
    became known, from a picture of a screen for example, does not help them.

    Args:
        head: The request line and the headers, with the empty line behind them.
        token: The token of this console, which is the first part of the path.

    Returns:
        The request for the page server; a `BadRequest` with status and reason if the request is refused.
    """
    head_lines = head.removesuffix(END_OF_HEAD)
    request_line, _, header_lines = head_lines.partition(b"\r\n")
    request_line_parts = request_line.decode("latin-1").split(" ")
    if len(request_line_parts) != 3:
        return BadRequest(400, "no HTTP", "the first line of the request is not one of HTTP")
    refusal = explain_request_refusal(head_lines)
    if refusal is not None:
        return BadRequest(403, "another origin", refusal)
    method, target, version = request_line_parts
    _, _, token_and_rest = target.partition("/")
    # The token ends at a slash, at a question mark, or at the end.
    token_length = min((token_and_rest + "/").index("/"), (token_and_rest + "?").index("?"))
    requested_token = token_and_rest[:token_length]
    if not secrets.compare_digest(requested_token.encode(), token.encode()):
        return BadRequest(403, "wrong token", WRONG_TOKEN)
    path_and_query = token_and_rest[token_length:]
    target_without_token = (
        path_and_query if path_and_query.startswith("/") else f"/{path_and_query}"
    )
    new_request_line = f"{method} {target_without_token} {version}".encode("latin-1")
    return FrontRequest(
        method=method,
        path=path_and_query.partition("?")[0],
        head=b"\r\n".join((new_request_line, header_lines)) + END_OF_HEAD,
        is_websocket=b"\r\nupgrade:" in head.lower(),
    )
