"""Labs with certificates and a router, and machines as network namespaces, for tests."""
