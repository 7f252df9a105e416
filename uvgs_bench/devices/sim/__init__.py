"""The simulated twins: one true bench, a camera that sees it, a controller that moves it.

In: ``[simulated]`` of ``bench.toml``. Out: captures and bytes as the real devices give them. It shares nothing with
the sensor but lens and geometry, so that errors cannot cancel. Plug point: none.
"""
