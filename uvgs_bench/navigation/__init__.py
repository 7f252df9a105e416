"""How a pose moves in time: filter, factor graph, follower law.

Here: nothing yet but the door. In: pose estimates. Out: states. Plug point: none.
"""
