"""What ``uvgs bag info`` and ``uvgs bag check`` print."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from uvgs_bench.sessions.bag_check import BagHealth
    from uvgs_bench.sessions.bag_info import BagInfo
    from uvgs_bench.sessions.bag_stamps import StampSummary

_LEVELS = {"problem": "[bold red]problem[/]", "warning": "[yellow]warning[/]"}
_VERDICTS = {
    "healthy": "[bold green]HEALTHY[/]",
    "not_healthy": "[bold red]NOT HEALTHY[/]",
    "inconclusive": "[bold yellow]INCONCLUSIVE[/]",
}


def print_info(found: BagInfo) -> None:
    """Files, span, topics, damage."""
    from rich.markup import escape

    from uvgs_bench.cli.console import out

    for file in found.files:
        out.print(f"[bold]{escape(file.path)}[/]", soft_wrap=True)
        what = f"{file.kind}, compression {file.compression}, {_size(file.size_bytes)}"
        out.print(f"  {what}, {_counted(file.messages, 'message')}", soft_wrap=True)
    if found.start_ns is not None:
        span = f"from {_utc(found.start_ns)} to {_utc(found.end_ns)}, {found.duration_s:.3f} s"
        out.print(span, soft_wrap=True)
    for topic in found.topics:
        out.print(f"[bold]{escape(topic.topic)}[/]", soft_wrap=True)
        rate = "" if topic.mean_rate_hz is None else f", {topic.mean_rate_hz:.2f} Hz on average"
        detail = f"; {topic.detail}" if topic.detail else ""
        lens = f", lens in {topic.camera_info}" if topic.camera_info else ""
        out.print(f"  {topic.messages} x {escape(topic.msgtype)}{rate}{escape(detail + lens)}", soft_wrap=True)
    for remark in found.remarks:
        out.print(f"{_LEVELS['problem']} {escape(remark)}", soft_wrap=True)


def print_health(found: BagHealth) -> None:
    """Stamps and pictures by topic, findings as lines, the verdict last."""
    from rich.markup import escape

    from uvgs_bench.cli.console import out

    for topic in sorted({*found.stamps, *found.pictures, *found.landmarks}):
        out.print(f"[bold]{escape(topic)}[/]", soft_wrap=True)
        if topic in found.stamps:
            out.print(f"  {_stamps(found.stamps[topic])}", soft_wrap=True)
        if topic in found.pictures:
            seen = found.pictures[topic]
            kinds = f"{', '.join(seen.encodings)}, {', '.join(seen.sizes) or 'unknown size'} px"
            looked = f"{seen.torn} unreadable, {seen.black} black, {seen.overexposed} overexposed"
            out.print(f"  {escape(kinds)}; of {seen.looked} looked at {looked}", soft_wrap=True)
        if topic in found.landmarks and not found.landmarks[topic]:
            out.print("  Astrobee's localizer would use every message")
    for finding in found.findings:
        where = f"{escape(finding.topic)}: " if finding.topic else ""
        out.print(f"{_LEVELS[finding.level]} {where}{escape(finding.text)}", soft_wrap=True)
    problems = sum(finding.level == "problem" for finding in found.findings)
    counts = f"{_counted(problems, 'problem')}, {_counted(len(found.findings) - problems, 'warning')}"
    because = "no message carries a stamp; " if found.verdict == "inconclusive" else ""
    out.print(f"{_VERDICTS[found.verdict]}: {because}{_counted(found.messages, 'message')}, {counts}", soft_wrap=True)


def _stamps(run: StampSummary) -> str:
    parts = [_counted(run.messages, "stamp")]
    if run.rate_hz is not None:
        parts.append(f"{run.rate_hz:.3f} Hz, {run.dropped} dropped")
    if run.longest_gap_s is not None:
        parts.append(f"longest gap {run.longest_gap_s:.3f} s")
    if run.offset_s is not None:
        word = "after" if run.offset_s >= 0.0 else "before"
        parts.append(f"recorded {abs(run.offset_s):.3f} s {word} the stamps")
    return ", ".join(parts)


def _counted(count: int, word: str) -> str:
    return f"{count} {word if count == 1 else word + 's'}"


def _size(size_bytes: int) -> str:
    for power, unit in ((9, "GB"), (6, "MB"), (3, "kB")):
        if size_bytes >= 10**power:
            return f"{size_bytes / 10**power:.4g} {unit}"
    return _counted(size_bytes, "byte")


def _utc(t_ns: int | None) -> str:
    from datetime import UTC, datetime

    if t_ns is None:
        return "an unknown time"
    seconds, rest = divmod(t_ns, 10**9)
    try:
        return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d %H:%M:%S}.{rest // 10**6:03d} UTC"
    except (OverflowError, OSError, ValueError):
        return f"{t_ns} ns"
