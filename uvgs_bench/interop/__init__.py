"""Other people's formats: trajectories, camera files, ROS messages and bags, Astrobee's landmarks.

Here: ``trajectories`` (CSV, TUM, JSON lines); ``camera_files`` (Kalibr, OpenCV, mrcal, COLMAP, Astrobee);
``ros_messages`` (pictures and lenses as plain values); ``bags`` (read, whole or damaged), ``bag_writer``; ``astrobee``.
In: captures and outcomes, lenses, paths of bags. Out: files and records, lenses, messages.
Plug points: ``trajectories.WRITERS``, ``camera_files.CAMERA_FORMATS``.
"""
