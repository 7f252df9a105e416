"""Projection models: five lenses behind one value class.

To add a lens: 1. write its compiled scalar kernels in ``lens_kernels.py`` and give it the next model number there;
2. add one line to ``LENSES``; 3. the contract tests of ``tests/unit/camera`` then run over it.

Contract: ``project`` maps points with z > 0 inside the valid field to pixels and everything else to NaN; ``unproject``
returns unit rays, iterated until the re-projected pixel agrees to 1e-10 px, and NaN where no ray exists;
pixel (0, 0) is the centre of the top-left pixel; parameters are ordered fx, fy, cx, cy, then the coefficients
in the order of the file format.
"""
