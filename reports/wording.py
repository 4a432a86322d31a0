"""How numbers, cells and rows are worded; the same in the terminal and in every file."""

from __future__ import annotations

import math
from collections.abc import Iterable

from harness.claims import PAPER, ClaimVerdict, Finding
from harness.measurement import Kind, Verdict
from harness.results import Cell, ScoreRow, TaskRow
from reports.scorecard import SolverCard, Spread

MEANING = {
    "WAV": "Wave effect: the outcome of a contact depends on what the other contacts do, and follows the reference "
    "better than the Newton LCP (skill = 1 - RMS of the law / RMS of the LCP).",
    "BRK": "Break away: touching contacts that should separate do so; the separation velocity over the ideal one.",
    "SYM": "Symmetry: the outcome of the mapped scene is the mapped outcome, also under renumbering.",
    "KIN": "Kinetic energy: none is gained, and in elastic impacts none is lost, relative to the energy before.",
    "MOM": "Momentum: every conserved momentum of the scene keeps its value, relative drift.",
    "ONE": "One-sided: contacts push and never pull, and none approaches after the impact.",
}
"""What each desideratum asks for."""

BEYOND = {
    "invariance": "The outcome does not depend on coordinates, on bodies that touch nothing, or on the sampling of a "
    "contact.",
    "scale": "Mass, speed or length in other units scale the outcome and change nothing else.",
    "termination": "The law's own stopping test passes before its iteration bound.",
    "claim": "What the solver claims is what the harness recomputes from its impulses.",
}
"""What the gates beyond the six desiderata ask for."""

MARK = {Verdict.PASS: "✓", Verdict.FAIL: "✗", Verdict.SHOWN: "·", Verdict.NOT_APPLICABLE: "n/a", None: "–"}


def number(value: float) -> str:
    """A number as short as it is readable: three figures, powers of ten below 1e-3; NaN is a dash."""
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    if value == 0:
        return "0"
    if 1e-3 <= abs(value) < 1e4:
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    mantissa, exponent = f"{value:.1e}".split("e")
    return f"{mantissa.removesuffix('.0')}e{int(exponent)}"


def cell_text(cell: Cell) -> str:
    """Mark and worst number of a cell, legible without color."""
    mark = MARK[cell.verdict]
    if cell.lost and not cell.failed:
        return f"{mark} lost {len(cell.lost)}"
    if cell.worst is None or cell.verdict in (None, Verdict.NOT_APPLICABLE):
        return mark
    return f"{mark} {number(cell.worst.value)}"


def coverage_text(card: SolverCard) -> str:
    """Measured over planned, and what the rest came to."""
    coverage = card.coverage
    text = f"{coverage.measured}/{coverage.planned}"
    parts = [f"{coverage.refused} refused"] if coverage.refused else []
    parts += [f"{len(coverage.lost)} lost"] if coverage.lost else []
    parts += [f"{coverage.open} open"] if coverage.open else []
    return f"{text} ({', '.join(parts)})" if parts else text


def spread_text(spread: Spread | None) -> str:
    """Root mean square and number of scenes of the errors against one reference."""
    if spread is None:
        return "–"
    return f"{number(spread.rms)} (n={spread.count})"


def count_text(count: float) -> str:
    """A count in three figures: 59.3M, 412k; exact below a thousand, a dash where there is none."""
    if not math.isfinite(count):
        return "–"
    for size, letter in ((10**9, "G"), (10**6, "M"), (10**3, "k")):
        if count >= size:
            return f"{count / size:.3g}{letter}" if count / size < 999.5 else f"{count / size:.0f}{letter}"
    return str(round(count))


def time_text(time_s: float) -> str:
    """A time [s] with its unit, three figures; a dash where there is none."""
    if not math.isfinite(time_s):
        return "–"
    for unit, factor in (("s", 1.0), ("ms", 1e3), ("µs", 1e6)):
        if time_s * factor >= 1.0:
            return f"{time_s * factor:.3g} {unit}"
    return f"{time_s * 1e9:.3g} ns"


def work_text(card: SolverCard) -> tuple[str, str]:
    """Iterations as median / largest, and contact visits."""
    if card.work is None:
        return "–", "–"
    return f"{card.work.median_iterations:g} / {card.work.largest_iterations}", f"{card.work.visits:,}"


def failed_count(cell: Cell) -> str:
    """How many more rows of the cell fail."""
    return f"; {cell.failed} of {cell.passed + cell.failed} gated rows fail"


def cell_name(cell: Cell) -> str:
    """What a cell is called; errors that have a gate are those of verification."""
    return "verification" if cell.name == "error" else cell.name


def scene(task: TaskRow) -> str:
    """What a task measured: a scene, or a sweep over many."""
    return f"sweep {task.label}" if task.kind == Kind.SWEEP.value else task.label


def row_sentence(row: ScoreRow) -> str:
    """One row in words: scene, metric, value and bound."""
    reference = f" (to {row.reference})" if row.reference else ""
    bound = "" if math.isnan(row.tolerance) else f", bound {number(row.tolerance)}"
    return f"{scene(row.task)}, {row.metric}{reference} = {number(row.value)}{bound} [{row.link}]"


def loss_sentence(task: TaskRow) -> str:
    """One lost task in words."""
    how = task.outcome.value if task.outcome else "open"
    return f"{scene(task)} [task {task.task}]: {how}{': ' + one_line(task.reason) if task.reason else ''}"


def one_line(text: str) -> str:
    """Text without line breaks."""
    return " ".join(text.split())


def claim_counts(findings: Iterable[Finding]) -> str:
    """How many claims of the paper were confirmed, partly, refuted, not measured."""
    verdicts = [finding.evidence.verdict for finding in findings if finding.claim.source == PAPER]
    return ", ".join(f"{verdicts.count(verdict)} {verdict.value}" for verdict in ClaimVerdict)


def disputed(findings: Iterable[Finding]) -> list[Finding]:
    """Claims of the paper that the rows do not bear out in full."""
    wrong = (ClaimVerdict.PARTLY, ClaimVerdict.REFUTED)
    return [f for f in findings if f.claim.source == PAPER and f.evidence.verdict in wrong]
