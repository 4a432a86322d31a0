"""The scorecard and the paper's Table 1 as LaTeX tabulars with booktabs rules."""

from __future__ import annotations

from collections.abc import Sequence

from harness.claims import PAPER_TABLE_1, SOLVER_OF, ClaimVerdict
from harness.measurement import DESIDERATA, Verdict
from harness.results import Cell
from reports.scorecard import Scorecard
from reports.wording import MARK, number, one_line

_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}",
    "|": r"\textbar{}", '"': r"\char34{}",
    "✓": r"$\bullet$", "●": r"$\bullet$", "✗": r"$\times$", "×": r"$\times$", "·": r"$\cdot$", "–": "--",
    "…": r"\ldots{}",
    "∞": r"$\infty$", "≤": r"$\le$", "≥": r"$\ge$", "→": r"$\to$", "√": r"$\surd$", "Δ": r"$\Delta$",
    "λ": r"$\lambda$", "μ": r"$\mu$", "η": r"$\eta$", "ε": r"$\varepsilon$", "π": r"$\pi$", "ξ": r"$\xi$",
    "⁺": "$^{+}$", "⁻": "$^{-}$", "₀": "$_{0}$", "²": "$^{2}$", "½": r"$\frac{1}{2}$", "−": "$-$",
}  # fmt: skip


def latex_escape(text: str) -> str:
    """Text that LaTeX sets as it is; letters that its standard fonts lack become question marks."""
    return "".join(_LATEX.get(letter, letter if letter.isascii() else "?") for letter in one_line(text))


def _latex_number(value: float) -> str:
    """A number in LaTeX, powers of ten set as such."""
    text = number(value)
    if "e" in text:
        mantissa, exponent = text.split("e")
        return rf"${mantissa}\cdot 10^{{{exponent}}}$"
    return f"${text}$" if text not in ("–", "∞", "-∞") else latex_escape(text)


def _latex_cell(cell: Cell) -> str:
    """Mark and worst value of a cell."""
    mark = latex_escape(MARK[cell.verdict])
    if cell.lost and not cell.failed:
        return f"{mark} lost {len(cell.lost)}"
    if cell.worst is None or cell.verdict in (None, Verdict.NOT_APPLICABLE):
        return mark
    return f"{mark} {_latex_number(cell.worst.value)}"


def _latex_table(comment: Sequence[str], columns: str, heading: Sequence[str], body: Sequence[str]) -> str:
    """A tabular with rules; goes into any document with booktabs by an input command."""
    lines = [
        *(f"% {line}" for line in comment),
        r"% Needs \usepackage{booktabs}. A plain tabular: put it into a table environment by \input.",
        rf"\begin{{tabular}}{{{columns}}}",
        r"\toprule",
        " & ".join(heading) + r" \\",
        r"\midrule",
        *body,
        r"\bottomrule",
        r"\end{tabular}",
    ]
    return "\n".join(lines) + "\n"


def _latex_comment(card: Scorecard, what: str) -> list[str]:
    """Where the table comes from, as comment lines."""
    run = card.run
    source = [f"{key} {run[key]}" for key in ("version", "started") if run.get(key)]
    state = "complete" if card.complete else f"INCOMPLETE: {card.open} planned tasks are not done"
    return [one_line(line) for line in (what, f"impactbench {', '.join(source)}; {state}.")]


def scorecard_latex(card: Scorecard) -> str:
    """The six desiderata of every solver as a booktabs tabular."""
    body = [
        " & ".join(
            [
                rf"\texttt{{{latex_escape(solver.solver)}}}",
                *(_latex_cell(solver.cells[name]) for name in DESIDERATA),
                f"{solver.coverage.measured}/{solver.coverage.planned}",
            ]
        )
        + r" \\"
        for solver in card.cards
    ]
    comment = _latex_comment(
        card, "Scorecard: verdict (bullet: pass, cross: fail) and worst value; last column: tasks measured / planned."
    )
    return _latex_table(comment, "l" + "l" * len(DESIDERATA) + "r", ["law", *DESIDERATA, "measured"], body)


def table_1_latex(card: Scorecard) -> str:
    """The paper's Table 1 and the measured one as a booktabs tabular; disagreeing cells are set bold."""
    cells = {(s.solver, name): s.cells[name] for s in card.cards for name in DESIDERATA}
    by_key = {finding.claim.key: finding for finding in card.findings}
    body = []
    for law, solver in SOLVER_OF.items():
        entries = []
        for name in DESIDERATA:
            printed = latex_escape("●" if PAPER_TABLE_1[law][name] else "×")
            measured = _latex_cell(cells[solver, name]) if (solver, name) in cells else "--"
            verdict = by_key[f"table-1:{law}:{name}"].evidence.verdict
            disputed = verdict in (ClaimVerdict.REFUTED, ClaimVerdict.PARTLY)
            entries.append(rf"{printed} / \textbf{{{measured}}}" if disputed else f"{printed} / {measured}")
        body.append(" & ".join([law, *entries]) + r" \\")
    comment = _latex_comment(
        card,
        "Table 1 of Zhang 2015: printed / measured with worst value (bullet: pass, cross: fail); disagreement bold.",
    )
    return _latex_table(comment, "l" + "l" * len(DESIDERATA), ["law", *DESIDERATA], body)
