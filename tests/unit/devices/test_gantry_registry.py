"""Every driver in the table is a gantry."""

from __future__ import annotations

import inspect
from importlib import import_module

import pytest

from uvgs_bench.devices.gantry import Gantry
from uvgs_bench.devices.gantry.registry import GANTRIES


@pytest.mark.parametrize("target", GANTRIES.values(), ids=GANTRIES.keys())
def test_a_driver_has_the_methods_of_a_gantry(target: str) -> None:
    module, _, name = target.partition(":")
    driver = getattr(import_module(module), name)
    for method, contract in inspect.getmembers(Gantry):
        if method.startswith("_") and method not in ("__enter__", "__exit__"):
            continue
        assert hasattr(driver, method), method
        if inspect.isfunction(contract):
            wanted = list(inspect.signature(contract).parameters)
            assert list(inspect.signature(getattr(driver, method)).parameters) == wanted, method
    opened = inspect.signature(driver.open).parameters
    assert list(opened) == ["port", "envelope", "clock", "log", "homing_timeout_s"]
    assert list(inspect.signature(driver.halt).parameters) == ["port", "clock", "log"]
