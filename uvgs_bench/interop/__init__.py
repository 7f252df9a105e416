"""Other people's formats: trajectories and camera files now; bags and messages as they come.

Here: ``trajectories`` (CSV, TUM, JSON lines); ``camera_files`` (Kalibr, OpenCV, mrcal, COLMAP, Astrobee). In:
captures and outcomes, lenses. Out: files and records, lenses.
Plug points: ``trajectories.WRITERS``, ``camera_files.CAMERA_FORMATS``.
"""
