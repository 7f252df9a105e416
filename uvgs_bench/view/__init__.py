"""Running things, shown live.

Here: nothing yet but the door. In: events. Out: a picture of them. Plug point: none.
"""
