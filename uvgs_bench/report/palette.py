"""Colours of every drawing. Series colours are Okabe and Ito's, told apart by people who are colour-blind.

Ink, rules and series are written into the drawings as these exact values; the web page swaps them for variables, so
that one drawing reads well on white paper and on a dark screen.

Source: M. Okabe, K. Ito, Color Universal Design, 2008.
"""

from __future__ import annotations

INK = "#1b2431"
FAINT = "#5d6a7a"
RULE = "#d3d9e1"
BLUE = "#0072b2"
ORANGE = "#d55e00"
GREEN = "#009e73"
PURPLE = "#aa4499"
YELLOW = "#e69f00"

SERIES = (BLUE, ORANGE, GREEN)
"""First, second, third component of a vector, everywhere in this order."""

MARKERS = ("o", "^", "s")
"""Shapes that repeat what the colour says."""

CSS_VARIABLES = {
    INK: "--ink",
    FAINT: "--faint",
    RULE: "--rule",
    BLUE: "--blue",
    ORANGE: "--orange",
    GREEN: "--green",
    PURPLE: "--purple",
    YELLOW: "--yellow",
}
"""Drawing colour to the variable the web page puts in its place."""
