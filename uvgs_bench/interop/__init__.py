"""Other people's formats: trajectories now; bags, messages and camera files as they come.

Here: ``trajectories`` (CSV, TUM, JSON lines). In: captures and outcomes. Out: files and records.
Plug point: ``trajectories.WRITERS``.
"""
