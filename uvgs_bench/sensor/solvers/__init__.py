"""Pose solvers behind one calling shape, one file each; the table is ``uvgs_bench.sensor.solution.SOLVERS``."""
