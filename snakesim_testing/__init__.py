"""Tests for people who write a backend: the contract suite, as a pytest plug-in that loads only on request.

python -m pytest -p snakesim_testing --pyargs snakesim_testing.contract --snakesim-backend NAME_or_./file.py:Class
"""

pytest_plugins = ["snakesim_testing.contract.plugin", "snakesim_testing.messages"]
