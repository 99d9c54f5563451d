"""Type of the tables of a study."""

from typing import Any

Table = Any
"""A pandas DataFrame or Series. Type checkers cannot follow which of its many types an expression of pandas has."""
