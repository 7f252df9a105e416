"""How a pose moves in time: filter, factor graph, follower law.

Here: trajectories in time. In: places and limits, pose estimates. Out: states. Plug point: none.
"""
