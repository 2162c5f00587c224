"""Shapes that are written and read again."""

from tests.valve.conftest import shapes

__all__ = ["shapes"]
