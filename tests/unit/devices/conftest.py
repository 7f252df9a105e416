"""What the tests of devices share."""

from __future__ import annotations

import pytest

from tests.helpers.grbl_ports import MockGantry


@pytest.fixture
def mock(monkeypatch: pytest.MonkeyPatch):
    bench = MockGantry(monkeypatch)
    yield bench
    bench.gantry.close()
