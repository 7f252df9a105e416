"""Bench-test suite that proves how accurate a uVGS-2 video guidance sensor is."""

__version__ = "0.1.0"
