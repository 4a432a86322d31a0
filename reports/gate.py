"""The regression gate as a table: what got worse, by how much, and what the results were compared with."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from harness.baseline import WORK, Change, Comparison, Difference
from harness.revision import TIME_ALLOWANCE, TimeComparison, TimeRatio
from reports.markdown import markdown_table
from reports.wording import number, one_line, time_text

SHOWN_BETTER = 10
"""Numbers that got better, as many as are shown; all are counted."""

_HEADING = ("solver", "scene", "metric", "accepted", "now", "change", "allowed")
_TIME_HEADING = ("solver", "scene", "this tree", "other commit", "ratio", "middle half", "allowed")


def render_gate(comparison: Comparison, console: Console) -> None:
    """Print the comparison: the verdict, a table of what got worse or is missing, and the rest in counts."""
    for title, differences, style in (
        ("Got worse or is missing", comparison.failures, "red"),
        ("Got better", comparison.of(Change.BETTER)[:SHOWN_BETTER], "green"),
        ("New, not in the baseline", comparison.of(Change.NEW), "yellow"),
    ):
        if differences:
            console.print(_table(title, _HEADING, (_row(difference) for difference in differences), style))
    for line in notes(comparison):
        console.print(Text(line, style="dim"))
    console.print(Text(verdict(comparison), style="bold red" if comparison.failures else "bold green"))


def render_times(times: TimeComparison, console: Console) -> None:
    """Print times against another commit, the slowest first."""
    console.print(_table(_time_title(times), _TIME_HEADING, (_time_row(row) for row in times.ratios), ""))
    for line in (*_time_notes(times), time_verdict(times)):
        console.print(Text(line))


def gate_markdown(comparison: Comparison, times: TimeComparison | None = None) -> str:
    """The comparison as a Markdown page, for a pull request or a job's summary."""
    lines = ["# Regression gate", "", f"**{verdict(comparison)}**", ""]
    for title, differences in (
        ("Got worse or is missing", comparison.failures),
        ("Got better", comparison.of(Change.BETTER)),
        ("New, not in the baseline", comparison.of(Change.NEW)),
    ):
        if differences:
            lines += [f"## {title}", "", *markdown_table(_HEADING, map(_row, differences)), ""]
    lines += [f"- {line}" for line in notes(comparison)]
    if times is not None:
        lines += ["", f"## {_time_title(times)}", "", f"**{time_verdict(times)}**", ""]
        lines += [
            *markdown_table(_TIME_HEADING, map(_time_row, times.ratios)),
            "",
            *(f"- {line}" for line in _time_notes(times)),
        ]
    return "\n".join([*lines, ""])


def verdict(comparison: Comparison) -> str:
    """The comparison in one sentence."""
    worse, missing = comparison.of(Change.WORSE), comparison.of(Change.MISSING)
    compared = len(comparison.differences) - len(comparison.of(Change.NEW))
    if not worse and not missing:
        return f"Nothing got worse: {compared} numbers compared"
    parts = []
    if worse:
        largest = max(worse, key=lambda difference: difference.change)
        where = f"{largest.metric}, {largest.solver} on {largest.scene}: {change_text(largest)}"
        parts.append(f"{len(worse)} of {compared} numbers got worse, most of all {where}")
    if missing:
        parts.append(f"{len(missing)} missing")
    return "; ".join(parts)


def time_verdict(times: TimeComparison) -> str:
    """The times in one sentence."""
    if not times.slower:
        return f"No solve got slower than {TIME_ALLOWANCE:g} times {times.revision}: {len(times.ratios)} timed"
    worst = times.slower[0]
    return (
        f"{len(times.slower)} of {len(times.ratios)} solves got slower than {TIME_ALLOWANCE:g} times {times.revision}, "
        f"most of all {worst.solver} on {worst.scene}: × {worst.median:.2f}"
    )


def notes(comparison: Comparison) -> Sequence[str]:
    """What stands beside the table: counts, what was accepted when and why, and another machine."""
    counts = ", ".join(f"{len(comparison.of(change))} {change.value}" for change in Change)
    lines = [counts]
    if comparison.baseline.history:
        last = comparison.baseline.history[-1]
        lines.append(
            f"accepted {last.get('date', 'at an unknown time')} with impactbench {last.get('version')} at commit "
            f"{_commit(last.get('commit'))}: {last.get('reason', 'no reason is given')}"
        )
    environment = comparison.environment
    lines.append(
        f"measured with impactbench {environment.get('impactbench')} at commit {_commit(environment.get('commit'))}"
    )
    if comparison.elsewhere:
        lines.append(f"another environment, which the allowances cover: {'; '.join(comparison.elsewhere)}")
    return lines


def change_text(difference: Difference) -> str:
    """A change in words: work as a ratio, errors in decades; what is missing as its reason."""
    if math.isnan(difference.change):
        return one_line(difference.note) or "–"
    if difference.metric == WORK:
        return f"× {10**difference.change:.3g}" if math.isfinite(difference.change) else "from 0"
    return f"{difference.change:+.2f} decades"


def _commit(name: object) -> str:
    """A commit as short as it is unique, with what is not committed."""
    commit, plus, changes = str(name or "unknown").partition("+")
    return f"{commit[:12]}{plus}{changes}"


def _row(difference: Difference) -> tuple[str, ...]:
    """One difference as the table shows it."""
    if math.isnan(difference.allowance):
        allowed = "–"
    elif difference.metric == WORK:
        allowed = f"× {10**difference.allowance:.3g}"
    else:
        allowed = f"{difference.allowance:+.2f}"
    return (
        difference.solver, difference.scene, difference.metric or "all", _value(difference, difference.accepted),
        _value(difference, difference.value), change_text(difference), allowed,
    )  # fmt: skip


def _value(difference: Difference, value: float) -> str:
    """A count in full, an error as short as it is readable."""
    return f"{value:.0f}" if difference.metric == WORK and math.isfinite(value) else number(value)


def _time_title(times: TimeComparison) -> str:
    return f"CPU time against {times.revision}, {times.rounds} interleaved rounds in this job"


def _time_row(row: TimeRatio) -> tuple[str, ...]:
    return (
        row.solver, row.scene, time_text(row.now_s), time_text(row.before_s), f"× {row.median:.2f}",
        f"{row.lower:.2f} … {row.upper:.2f}", f"× {TIME_ALLOWANCE:g}",
    )  # fmt: skip


def _time_notes(times: TimeComparison) -> Sequence[str]:
    return [f"not timed: {line}" for line in times.skipped]


def _table(title: str, heading: Sequence[str], rows: Iterable[Sequence[str]], style: str) -> Table:
    """A table for the terminal; long reasons are folded, nothing is cut off."""
    table = Table(title=title, title_justify="left", title_style=f"bold {style}".strip())
    right = {"accepted", "now", "allowed", "this tree", "other commit", "ratio"}
    for name in heading:
        table.add_column(name, justify="right" if name in right else "left", overflow="fold")
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    return table
