"""Tests of SnakeSIM installed from a wheel, with and without extras, and without some of its packages."""
