"""The work itself, led step by step: calibrate, sweep, stream, demonstrate.

Here: sessions that use devices, the sensor and the store. In: open devices and values. Out: values, runs, events.
Plug point: ``PATTERNS`` (patterns.py).
"""
