"""Running things, shown live: a panel in the terminal, a page on loopback, Foxglove.

Here: what is shown, and its renderings. In: captures with their answers. Out: pictures, and orders of whoever has the
page's key. Plug point: a rendering takes packets of ``broadcast.py``.
"""
