"""The terminal: parse, call one thing, print.

Here: one file per command. In: arguments. Out: text, JSON, exit codes. Plug point: ``COMMANDS`` (app.py).
"""
