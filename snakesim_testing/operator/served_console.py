"""Runs the servers of a console within the process of the test.

The front server runs in a thread. The page server, if a test needs it, runs behind the front server.
"""

import asyncio
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from queue import Queue

from snakesim_operator.base.console_port import ConsolePorts, open_console_ports
from snakesim_operator.features.console.front.front_server import FrontServer, StopPath
from snakesim_operator.features.console.web.page_server import AnswerRequest
from snakesim_operator.features.console.web.serve import serve_pages
from snakesim_operator.features.console.web.viser_server import PageServer


@contextmanager
def running_front_server(ports: ConsolePorts, stop: StopPath | None) -> Iterator[FrontServer]:
    """Run a front server without a page server, in a thread, for as long as the context lasts.

    Args:
        ports: Sockets and token of the console.
        stop: Stops the robot. None for the console of a recording.
    """
    server = FrontServer(ports.browser_socket, ports.page_socket_path, ports.token, stop)
    end_requested = asyncio.Event()
    started_loops: Queue[asyncio.AbstractEventLoop] = Queue()

    async def serve() -> None:
        started_loops.put(asyncio.get_running_loop())
        await server.run(end_requested)

    thread = threading.Thread(target=asyncio.run, args=(serve(),))
    thread.start()
    loop = started_loops.get()
    try:
        yield server
    finally:
        loop.call_soon_threadsafe(end_requested.set)
        thread.join()


@contextmanager
def running_console(
    stop: StopPath | None = None,
    report: Callable[[str], None] = lambda _: None,
    answer_first: AnswerRequest = lambda _: None,
) -> Iterator[tuple[PageServer, str]]:
    """Run the front server and the page server of a console, and yield the page server and the console's address.

    Args:
        stop: Stops the robot. None for the console of a recording.
        report: Gets lines about refused requests.
        answer_first: Answers a request itself, or returns None to let the page server answer.
    """
    with (
        open_console_ports(None) as ports,
        running_front_server(ports, stop),
        serve_pages(ports.page_socket, report, answer_first, has_stop=stop is not None) as server,
    ):
        yield server, ports.address
