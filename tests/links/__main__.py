"""See `tests.links.measure`."""

from tests.links.measure import main

if __name__ == "__main__":
    main()
