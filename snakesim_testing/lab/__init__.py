"""A lab on loopback, with certificates and a router."""
