"""The scorecard, the paper's Table 1 and the departures from its claims as Markdown pages.

Every number that is shown links to the row that it comes from, at the end of the page.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from harness.claims import OURS, PAPER, PAPER_TABLE_1, SOLVER_OF, ClaimVerdict
from harness.measurement import DESIDERATA, Outcome, Verdict
from harness.results import Cell, ScoreRow
from reports.scorecard import DISTURBANCE, REFERENCES, Scorecard, SolverCard, Spread, failures
from reports.wording import (
    BEYOND,
    MEANING,
    cell_name,
    cell_text,
    claim_counts,
    coverage_text,
    loss_sentence,
    number,
    one_line,
    scene,
    work_text,
)


class _Citations:
    """Rows that a page names; each gets an anchor on the page."""

    def __init__(self) -> None:
        self.rows: dict[int, ScoreRow] = {}

    def link(self, row: ScoreRow) -> str:
        """A link to the row's line in the list at the end of the page."""
        self.rows[row.score] = row
        return f"[#{row.score}](#score-{row.score})"

    def section(self) -> list[str]:
        """The list of all rows that were named."""
        if not self.rows:
            return []
        heading = ("row", "solver", "scene", "name", "metric", "reference", "value", "bound", "margin")
        body = [
            (
                f'<a id="score-{row.score}"></a>{row.score}', row.task.solver, row.task.label, row.name, row.metric,
                row.reference or "–", repr(row.value), number(row.tolerance), number(row.margin),
            )
            for row in sorted(self.rows.values(), key=lambda row: row.score)
        ]  # fmt: skip
        return [
            "## Rows named on this page",
            "",
            "`row` is `scores.score` in the store and the column `score` of rows.csv, which has all rows.",
            "",
            *markdown_table(heading, body),
            "",
        ]


def markdown_table(heading: Sequence[str], body: Iterable[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table; bars in the text are escaped."""
    lines = ["| " + " | ".join(heading) + " |", "|" + "---|" * len(heading)]
    lines += ["| " + " | ".join(one_line(str(entry)).replace("|", "\\|") for entry in row) + " |" for row in body]
    return lines


def scorecard_markdown(card: Scorecard) -> str:
    """The whole scorecard as one Markdown page."""
    cited = _Citations()
    lines = [
        "# Scorecard of multi-impact laws",
        "",
        *_incomplete_note(card),
        *_provenance(card),
        "## The six desiderata",
        "",
        "Each cell is the worst scene of its solver: verdict, worst value, link to its row.",
        "",
        *markdown_table(
            ("solver", *DESIDERATA, "measured"),
            ((s.solver, *(_linked(s.cells[name], cited) for name in DESIDERATA), coverage_text(s)) for s in card.cards),
        ),
        "",
        "## Beyond the six",
        "",
        *markdown_table(
            ("solver", *BEYOND, f"moved by {number(DISTURBANCE)}", "iterations (median / largest)", "contact visits"),
            (_beyond_row(s, cited) for s in card.cards),
        ),
        "",
        *_errors_section(card, cited),
        *_shortcomings(card, cited),
        *_legend(card),
        *cited.section(),
    ]
    return "\n".join(lines).rstrip() + "\n"


def _incomplete_note(card: Scorecard) -> list[str]:
    """A warning where planned tasks are not done."""
    if card.complete:
        return []
    return [f"> **Incomplete:** {card.open} planned tasks are not done; every number below may still get worse.", ""]


def _provenance(card: Scorecard) -> list[str]:
    """Version, source, date, machine, command: what a reader needs to repeat the run."""
    run = card.run
    environment = _mapping(run.get("environment"))
    settings = _mapping(run.get("settings"))
    libraries = ", ".join(
        f"{key} {environment[key]}" for key in ("python", "numpy", "scipy", "numba") if key in environment
    )
    machine = ", ".join(
        str(environment[key]) + (" cores" if key == "cores" else "")
        for key in ("cpu", "cores", "machine", "os")
        if environment.get(key)
    )
    known = {
        "version": run.get("version"),
        "commit": environment.get("commit"),
        "source digest": environment.get("source"),
        "date of run": run.get("started"),
        **{key: settings[key] for key in sorted(settings)},
        "libraries": libraries,
        "machine": machine,
        "runs in this store": str(card.runs),
        "reproduce with": f"`{run['command']}`" if run.get("command") else None,
    }
    rows = [(key, str(value)) for key, value in known.items() if value not in (None, "", [])]
    return [*markdown_table(("", "measured with"), rows), ""]


def _mapping(value: Any) -> Mapping[str, Any]:
    """A JSON column, parsed or as text; empty where there is none."""
    if isinstance(value, str):
        try:
            value = json.loads(value)
        except ValueError:
            return {}
    return value if isinstance(value, Mapping) else {}


def _linked(cell: Cell, cited: _Citations) -> str:
    """A cell's text with the link to its worst row."""
    if cell.worst is None or cell.verdict in (None, Verdict.NOT_APPLICABLE):
        return cell_text(cell)
    lost = f", lost {len(cell.lost)}" if cell.lost and cell.failed else ""
    return f"{cell_text(cell)}{lost} {cited.link(cell.worst)}"


def _beyond_row(card: SolverCard, cited: _Citations) -> tuple[str, ...]:
    """One solver's gates beyond the six, its robustness and its work."""
    cells = (card.invariance, card.scale, card.termination, card.claim)
    moved = "–"
    if card.robustness is not None:
        moved = f"{number(card.robustness.value)} {cited.link(card.robustness.row)}"
    return (card.solver, *(_linked(cell, cited) for cell in cells), moved, *work_text(card))


def _errors_section(card: Scorecard, cited: _Citations) -> list[str]:
    """Validation errors against each reference, and verification errors; never mixed."""
    references = sorted({name for solver in card.cards for name in solver.validation}, key=_reference_order)
    body = []
    for solver in card.cards:
        entries = []
        for name in references:
            spread = solver.validation.get(name)
            entries.append("–" if spread is None else _spread_markdown(spread, cited))
        body.append((solver.solver, *entries, _linked(solver.verification, cited)))
    return [
        "## Errors",
        "",
        "Validation: largest velocity error of the law's outcome against a named reference, relative to the pre-impact "
        "velocity; root mean square and median over the n scenes that have it, then the worst. Verification: how well "
        "the solver solves its own equations (worst residual or distance to its own closed form).",
        "",
        *markdown_table(("solver", *(f"to {name}" for name in references), "verification, worst"), body),
        "",
    ]


def _reference_order(name: str) -> tuple[int, str]:
    """Main references first."""
    return (REFERENCES.index(name) if name in REFERENCES else len(REFERENCES), name)


def _spread_markdown(spread: Spread, cited: _Citations) -> str:
    """One spread in full."""
    missing = f", {spread.unmeasured} missing" if spread.unmeasured else ""
    missing += f", {spread.within} within its uncertainty" if spread.within else ""
    return (
        f"rms {number(spread.rms)}, median {number(spread.median)} (n={spread.count}{missing}); worst "
        f"{number(spread.worst.value)} {cited.link(spread.worst)}"
    )


def _shortcomings(card: Scorecard, cited: _Citations) -> list[str]:
    """What falls short: failed gates, lost and refused tasks, bounds reached; all from rows."""
    failed = [
        f"- **{solver.solver}** fails {cell_name(cell)}: {_failed_metrics(card, cell, cited)}"
        for solver, cell in failures(card)
        if cell.failed
    ]
    lost = [f"- **{s.solver}**: {_escaped(loss_sentence(task))}" for s in card.cards for task in s.coverage.lost]
    bounds = [
        f"- **{s.solver}**: {_escaped(task.label)}: {task.status} after {task.iterations} iterations"
        for s in card.cards
        if s.work
        for task in s.work.unconverged
    ]
    refused = [f"- **{s.solver}**: {line}" for s in card.cards for line in _refusals(card, s.solver)]
    none = ["- none"]
    return [
        "## What falls short: known limitations",
        "",
        "Made from the rows of this run.",
        "",
        "### Failed gates", "", *(failed or none), "",
        "### Lost tasks (each fails the cells that it should have filled)", "", *(lost or none), "",
        "### Bounds reached and stalls, as the solvers report them", "", *(bounds or none), "",
        "### Refused scenes (the law does not apply)", "", *(refused or none), "",
    ]  # fmt: skip


def _failed_metrics(card: Scorecard, cell: Cell, cited: _Citations) -> str:
    """Every failed metric of a cell with its count and its worst row."""
    rows = [row for row in card.results.scores_of(cell.solver, cell.name) if row.verdict is Verdict.FAIL]
    parts = []
    for metric, reference in sorted({(row.metric, row.reference) for row in rows}):
        alike = [row for row in rows if (row.metric, row.reference) == (metric, reference)]
        worst = min(alike, key=lambda row: -math.inf if math.isnan(row.margin) else row.margin)
        to = f" (to {reference})" if reference else ""
        scenes = "1 row" if len(alike) == 1 else f"{len(alike)} rows"
        parts.append(
            f"{_escaped(metric)}{to} in {scenes}, worst {number(worst.value)} against {number(worst.tolerance)} "
            f"on {_escaped(scene(worst.task))} {cited.link(worst)}"
        )
    return "; ".join(parts)


def _refusals(card: Scorecard, solver: str) -> list[str]:
    """Refused scenes grouped by reason."""
    reasons: dict[str, list[str]] = {}
    for task in card.results.tasks_of(solver):
        if task.outcome is Outcome.REFUSED:
            reasons.setdefault(one_line(task.reason) or "no reason given", []).append(task.label)
    return [
        f"{_escaped(reason)} ({len(labels)}: {', '.join(map(_escaped, labels))})"
        for reason, labels in sorted(reasons.items())
    ]


def _escaped(text: str) -> str:
    """Text that Markdown shows as it is."""
    return "".join(f"\\{letter}" if letter in "*_`<>[]|\\" else letter for letter in one_line(text))


def _legend(card: Scorecard) -> list[str]:
    """What the names, the tolerances and the margins mean; the tolerances are those of the rows."""
    body = [(name, meaning, _tolerances(card, name)) for name, meaning in (MEANING | BEYOND).items()]
    return [
        "## Legend",
        "",
        *markdown_table(("name", "what is asked", "bounds used (metric: tolerance)"), body),
        "",
        "- ✓ every gated row passes; ✗ at least one fails, or a task was lost; · measured and shown, without a gate; "
        "n/a: the scenes have nothing to measure; –: not measured.",
        "- *Value*: a dimensionless number, 0 is perfect (for BRK and skill: 1).",
        "- *Tolerance* (bound): the value at which the gate turns; every one is stored with its row.",
        "- *Margin*: distance to the bound, positive = pass. For an upper bound in decades, log₁₀(tolerance / value); "
        "for a lower bound value - bound. The worst row is the one with the smallest margin, failed rows first.",
        "- *measured*: tasks measured / planned; *refused*: the law does not apply and says so (no failure, but no "
        "pass either); *lost*: raised, invalid answer, crashed, timed out or out of memory: a failure.",
        f"- *moved by {DISTURBANCE:.0e}*: the largest change of the outcome when the pre-impact velocities change by "
        f"{DISTURBANCE:.0e} of the largest approach velocity; a law that depends continuously stays near that size.",
        "- *contact visits*: how often a contact was evaluated, all scenes together; no machine changes it. Scenes "
        "that a law refuses are not in its count.",
        "",
    ]  # fmt: skip


def _tolerances(card: Scorecard, name: str) -> str:
    """The bounds that the rows of one name were gated by."""
    bounds = {
        (row.metric.split(",")[0], row.tolerance) for row in card.results.scores if row.name == name and row.gated
    }
    return "; ".join(f"{metric}: {number(bound)}" for metric, bound in sorted(bounds)) or "–"


def table_1_markdown(card: Scorecard) -> str:
    """The paper's Table 1 beside the measured one, with every disagreement."""
    cited = _Citations()
    cells = {(s.solver, name): s.cells[name] for s in card.cards for name in DESIDERATA}
    body = []
    for law, solver in SOLVER_OF.items():
        measured = [_linked(cells[solver, name], cited) if (solver, name) in cells else "–" for name in DESIDERATA]
        body.append((f"{law}, as printed", *("●" if PAPER_TABLE_1[law][name] else "×" for name in DESIDERATA)))
        body.append((f"{law}, measured (`{solver}`)", *measured))
    lines = [
        "# Table 1 of Zhang 2015, as printed and as measured",
        "",
        *_incomplete_note(card),
        *markdown_table(("law", *DESIDERATA), body),
        "",
        "Printed: ● satisfied, × not. Measured: ✓ every gated row passes, ✗ not; worst value and its row.",
        "",
        "## Disagreements",
        "",
        *_disagreements(card, cited),
        "",
        *cited.section(),
    ]
    return "\n".join(lines).rstrip() + "\n"


def _disagreements(card: Scorecard, cited: _Citations) -> list[str]:
    """Every cell of Table 1 that the rows do not bear out, with its row; and the cells without rows."""
    lines = []
    by_key = {finding.claim.key: finding for finding in card.findings}
    for law, solver in SOLVER_OF.items():
        for name in DESIDERATA:
            evidence = by_key[f"table-1:{law}:{name}"].evidence
            printed = "●" if PAPER_TABLE_1[law][name] else "×"
            if evidence.verdict is ClaimVerdict.CONFIRMED:
                continue
            worst = card.results.cell(solver, name).worst
            link = f" {cited.link(worst)}" if worst is not None else ""
            what = "not measured" if evidence.verdict is ClaimVerdict.NOT_MEASURED else f"printed {printed}"
            lines.append(f"- **{law} {name}** ({what}): {_escaped(evidence.summary)}{link}")
    return lines or ["None: all 18 cells are as printed."]


def departures_markdown(card: Scorecard) -> str:
    """Every claim with what the rows say of it, departures first."""
    lines = [
        "# The paper's claims and the measured rows",
        "",
        *_incomplete_note(card),
        f"Claims of {PAPER}: {claim_counts(card.findings)}.",
        "",
    ]
    paper = [finding for finding in card.findings if finding.claim.source == PAPER]
    groups = (
        ("Departures", [f for f in paper if f.evidence.verdict in (ClaimVerdict.REFUTED, ClaimVerdict.PARTLY)]),
        ("Confirmed", [f for f in paper if f.evidence.verdict is ClaimVerdict.CONFIRMED]),
        ("Not measured", [f for f in paper if f.evidence.verdict is ClaimVerdict.NOT_MEASURED]),
        ("Statements of this benchmark", [f for f in card.findings if f.claim.source == OURS]),
    )
    for heading, findings in groups:
        body = [
            (
                finding.claim.where,
                finding.claim.statement,
                finding.evidence.verdict.value,
                finding.evidence.summary,
                ", ".join(finding.evidence.rows) or "–",
            )
            for finding in findings
        ]
        table = markdown_table(("where", "claim", "verdict", "what the rows say", "rows"), body)
        lines += [f"## {heading}", "", *(table if body else ["None."]), ""]
    lines += ["`score` numbers are rows of rows.csv; `series` and `task` numbers are rows of the store.", ""]
    return "\n".join(lines).rstrip() + "\n"
