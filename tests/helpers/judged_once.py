"""Judging each run on disk once for a whole file of tests: the same run and seed give the same judgement anyway."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from uvgs_bench.accuracy.judgement import Judgement
from uvgs_bench.store import comparing, judging
from uvgs_bench.store.run import Run


@contextmanager
def judged_once() -> Iterator[None]:
    """Remember judgements by folder, number of samples and settings while the context lasts."""
    known: dict[tuple[object, ...], Judgement] = {}
    judge = judging.judge_run

    def remembered(run: Run, **settings: Any) -> Judgement:
        key = (run.path, len(run.samples), run.ended, *sorted(settings.items()))
        if key not in known:
            known[key] = judge(run, **settings)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        for module in (judging, comparing):
            patch.setattr(module, "judge_run", remembered)
        yield
