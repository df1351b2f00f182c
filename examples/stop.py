"""Stop the robot at HOST PORT (127.0.0.1 7447 unless given), without Zenoh. Explained in client.md."""

import contextlib
import secrets
import socket
import sys

host, port = sys.argv[1:] or ("127.0.0.1", "7447")
request, answer = b"SNAKSTOP" + secrets.token_bytes(16) + b"anna", b""
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
    udp.settimeout(0.05)
    while not answer.startswith(b"SNAKDONE" + request[8:24]):
        udp.sendto(request, (host, int(port)))
        with contextlib.suppress(TimeoutError):
            answer = udp.recv(1024)
print(answer[24:].decode())
