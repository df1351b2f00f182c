"""What a stranger has: the wire from schemas/ alone, datagrams, floods, and eyes on other machines."""
