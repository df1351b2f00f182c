"""What a stranger has: the wire from schemas/ alone, datagrams, floods, and a browser's page."""
