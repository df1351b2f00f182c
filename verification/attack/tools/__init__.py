"""Tools of an unauthorized client: the protocol as `schemas/` describes it, datagrams, floods and open connections."""
