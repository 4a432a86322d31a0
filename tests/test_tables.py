"""The tables: what a cell shows, what counts as a failure, what is written, and what bad input gives."""

from __future__ import annotations

import csv
import io
import math
import os
import shutil
import subprocess
from pathlib import Path

import pandas as pd
import pytest
from rich.console import Console

from harness.measurement import DESIDERATA, Verdict
from reports import files, latex
from reports.latex import latex_escape
from reports.scorecard import ReportError
from reports.tables import render_terminal, scorecard, write_tables
from reports.wording import number
from tests.handmade_rows import VA, HandmadeStore, add_disturbed, add_sweep, lcp_law, qce_law

GOLDEN = Path(__file__).parent / "golden"


def small_store() -> HandmadeStore:
    """Three laws on two scenes: one that passes, one that fails, one that refuses, crashes and is not done."""
    store = HandmadeStore()
    store.all_six("qce")
    store.all_six("lcp-pgs", failing=("WAV", "BRK"))
    store.task("zeta", "box_on_floor", outcome="refused", reason="law | applies\nto chains only")
    store.task("zeta", "ball-ring", outcome="crashed", reason="signal 11")
    return store


def cell_of(store: HandmadeStore, solver: str, name: str):  # type: ignore[no-untyped-def]
    card = next(card for card in scorecard(store).cards if card.solver == solver)
    return card.cells[name]


def text_of(store: HandmadeStore, *, width: int = 120) -> str:
    console = Console(width=width, file=io.StringIO(), color_system=None)
    render_terminal(scorecard(store), console)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_a_cell_shows_the_row_with_the_smallest_margin_and_not_the_largest_value() -> None:
    store = HandmadeStore()
    task = store.all_six("qce")
    loose = store.score(task, "KIN", 1e-4, metric="loose", tolerance=1.0)
    tight = store.score(task, "KIN", 1e-6, metric="tight", tolerance=2e-6)
    cell = cell_of(store, "qce", "KIN")
    assert cell.verdict is Verdict.PASS
    assert cell.worst.score == tight != loose


def test_a_failed_row_fails_the_cell_and_is_the_one_shown() -> None:
    store = HandmadeStore()
    task = store.all_six("qce")
    failed = store.score(task, "SYM", 0.5)
    cell = cell_of(store, "qce", "SYM")
    assert (cell.verdict, cell.failed, cell.worst.score) == (Verdict.FAIL, 1, failed)


def test_a_gated_number_that_could_not_be_had_is_the_worst_there_is() -> None:
    store = HandmadeStore()
    task = store.all_six("qce")
    store.score(task, "SYM", 0.5)
    missing = store.score(task, "SYM", math.nan, verdict="fail")
    assert cell_of(store, "qce", "SYM").worst.score == missing


@pytest.mark.parametrize("outcome", ["raised", "invalid", "crashed", "timed out", "out of memory"])
def test_a_lost_task_fails_every_desideratum_and_is_named(outcome: str, tmp_path: Path) -> None:
    store = HandmadeStore()
    store.all_six("qce")
    store.task("qce", "ball-ring", outcome=outcome, reason="it broke")
    for name in DESIDERATA:
        assert cell_of(store, "qce", name).verdict is Verdict.FAIL
    assert f"qce lost ball-ring() [task 2]: {outcome}: it broke" in text_of(store)
    write_tables(store, tmp_path)
    assert f"{outcome}: it broke" in (tmp_path / "scorecard.md").read_text(encoding="utf-8")


def test_a_lost_sweep_fails_what_it_judges_and_nothing_else() -> None:
    store = HandmadeStore()
    store.all_six("qce")
    store.task("qce", "wave", kind="sweep", outcome="timed out")
    assert cell_of(store, "qce", "WAV").verdict is Verdict.FAIL
    assert cell_of(store, "qce", "KIN").verdict is Verdict.PASS


def test_a_refusal_is_no_failure_and_shows_in_the_coverage() -> None:
    store = HandmadeStore()
    store.all_six("qce")
    store.task("qce", "box-on-floor", outcome="refused", reason="restitution must be 1")
    card = scorecard(store).cards[0]
    assert (card.coverage.planned, card.coverage.measured, card.coverage.refused) == (2, 1, 1)
    assert card.cells["KIN"].verdict is Verdict.PASS
    assert "qce: 1/2 (1 refused)" in text_of(store)


def test_a_solver_without_rows_has_no_verdict_of_its_own() -> None:
    store = HandmadeStore()
    store.task("qce", "box-on-floor", outcome="refused", reason="no")
    assert cell_of(store, "qce", "KIN").verdict is None


def test_a_planned_task_that_is_not_done_makes_the_card_incomplete(tmp_path: Path) -> None:
    store = HandmadeStore()
    store.all_six("qce")
    assert "INCOMPLETE" not in text_of(store)
    store.task("qce", "ball-ring", outcome=None)
    assert not scorecard(store).complete
    assert "INCOMPLETE: 1 planned tasks are not done" in text_of(store)
    write_tables(store, tmp_path)
    for name in ("scorecard.md", "table1.md", "departures.md"):
        assert "Incomplete" in (tmp_path / name).read_text(encoding="utf-8")
    assert "INCOMPLETE" in (tmp_path / "scorecard.tex").read_text(encoding="utf-8")


def test_validation_errors_are_spread_over_scenes_and_name_what_is_missing() -> None:
    store = HandmadeStore()
    for scenario, error in (("one", 0.3), ("two", 0.4)):
        task = store.task("qce", scenario)
        metric, within = "validation: Hertz", error < 0.35
        store.score(task, "error", error, metric=metric, verdict="shown", reference="Hertz",
                    detail={"distinguishable": not within})  # fmt: skip
    store.score(store.task("gr", "one"), "error", 0.1, metric="validation: Hertz", verdict="shown", reference="Hertz")
    store.task("gr", "two", outcome="refused")
    qce, gr = scorecard(store).cards
    spread = qce.validation["Hertz"]
    assert spread.rms == pytest.approx(math.sqrt((0.09 + 0.16) / 2))
    assert spread.median == pytest.approx(0.35)
    assert (spread.count, spread.unmeasured, spread.within) == (2, 0, 1)
    assert (gr.validation["Hertz"].count, gr.validation["Hertz"].unmeasured) == (1, 1)


def test_the_response_shown_is_the_largest_one_to_a_disturbance_of_1e_8() -> None:
    store = HandmadeStore()
    task = store.all_six("qce")
    detail = {"1e-12": 5.0, "1e-08": 0.2, "1e-02": 7.0, "repeats": 4}
    store.score(task, "robustness", 7.0, metric="largest response", verdict="shown", detail=detail)
    row = store.score(task, "robustness", 0.4, metric="largest response, disturbed cradle, size 1e-08", verdict="shown")
    response = scorecard(store).cards[0].robustness
    assert response is not None
    assert (response.value, response.row.score) == (0.4, row)


def test_table_1_lists_a_disagreement_with_its_row_value_and_bound(tmp_path: Path) -> None:
    store = HandmadeStore()
    task = store.all_six("qce", failing=("KIN",))
    store.all_six("gr", failing=("WAV",))
    store.all_six("lcp-pgs", failing=("WAV", "BRK"))
    write_tables(store, tmp_path)
    text = (tmp_path / "table1.md").read_text(encoding="utf-8")
    disputed = [line for line in text.splitlines() if line.startswith("- **")]
    assert len(disputed) == 1
    row = 100 * task + DESIDERATA.index("KIN")
    assert "QCE KIN" in disputed[0]
    assert "printed ●" in disputed[0]
    assert f"#score-{row}" in disputed[0]
    assert "0.5" in disputed[0]
    assert "1e-09" in disputed[0]
    assert f'<a id="score-{row}"></a>' in text
    assert r"\textbf{$\times$ $0.5$}" in (tmp_path / "table1.tex").read_text(encoding="utf-8")


def test_table_1_says_so_where_all_18_cells_agree(tmp_path: Path) -> None:
    store = HandmadeStore()
    store.all_six("qce")
    store.all_six("gr", failing=("WAV",))
    store.all_six("lcp-pgs", failing=("WAV", "BRK"))
    write_tables(store, tmp_path)
    assert "None: all 18 cells are as printed." in (tmp_path / "table1.md").read_text(encoding="utf-8")


def test_a_cell_without_rows_is_listed_as_not_measured(tmp_path: Path) -> None:
    store = HandmadeStore()
    store.all_six("qce")
    write_tables(store, tmp_path)
    text = (tmp_path / "table1.md").read_text(encoding="utf-8")
    assert text.count("(not measured)") == 12


@pytest.mark.parametrize("width", [80, 120])
def test_the_terminal_card_fits_and_cuts_no_number(width: int) -> None:
    store = small_store()
    task = store.all_six("a-solver-with-a-long-name", value=1.23e-105)
    store.score(task, "KIN", 1.23e-105, metric="more")
    text = text_of(store, width=width)
    assert max(map(len, text.splitlines())) <= width
    assert "✓ 1.2e-105" in text
    assert "✗ 0.5" in text
    assert "2.6e-…" not in text


def test_latex_text_is_escaped_and_has_only_letters_that_latex_sets() -> None:
    assert latex_escape(r"a_b & 50% #1 {x} $y$ ~ ^ \z") == (
        r"a\_b \& 50\% \#1 \{x\} \$y\$ \textasciitilde{} \textasciicircum{} \textbackslash{}z"
    )
    assert latex_escape("λ⁺ ≤ 1 – ✗").isascii()
    assert latex_escape("漢") == "?"


def test_latex_tables_have_one_entry_for_each_column(tmp_path: Path) -> None:
    store = small_store()
    store.all_six("my_law.py:My&Law")
    write_tables(store, tmp_path)
    for name in ("scorecard.tex", "table1.tex"):
        text = (tmp_path / name).read_text(encoding="utf-8")
        assert text.isascii()
        columns = text.split(r"\begin{tabular}{")[1].split("}")[0]
        rows = [line for line in text.splitlines() if line.endswith(r"\\")]
        assert rows
        for row in rows:
            assert row.replace(r"\&", "").count("&") == len(columns) - 1
        assert text.count("{") == text.count("}")
        assert [text.count(rule) for rule in (r"\toprule", r"\midrule", r"\bottomrule")] == [1, 1, 1]


# Default fonts and encoding, and booktabs, as the tables ask for: nothing else may be needed.
DOCUMENT = r"""
\documentclass{article}
\usepackage{booktabs}
\begin{document}
\input{scorecard.tex}
\input{table1.tex}
LETTERS
\end{document}
"""


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="there is no LaTeX here")
def test_latex_sets_the_tables_and_every_letter_that_is_escaped(tmp_path: Path) -> None:
    store = small_store()
    store.all_six('a "law" of 100 % & <more>_here.py:My|Law')
    write_tables(store, tmp_path)
    letters = latex_escape("".join(latex._LATEX))
    (tmp_path / "page.tex").write_text(DOCUMENT.replace("LETTERS", letters), encoding="ascii")
    done = subprocess.run(
        ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "page.tex"],
        cwd=tmp_path, capture_output=True, text=True, errors="replace",
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-2000:]
    assert (tmp_path / "page.pdf").stat().st_size > 0


def test_the_markdown_page_says_how_to_repeat_the_run(tmp_path: Path) -> None:
    write_tables(small_store(), tmp_path)
    text = (tmp_path / "scorecard.md").read_text(encoding="utf-8")
    for part in ("0.1.0", "0123abc", "2026-01-02", "| seed | 7 |", "a_cpu", "`impactbench scorecard`"):
        assert part in text
    assert r"law \| applies to chains only" in text.replace("\\\\", "\\")


def test_every_row_link_of_a_page_leads_to_a_row_on_it(tmp_path: Path) -> None:
    write_tables(small_store(), tmp_path)
    for name in ("scorecard.md", "table1.md"):
        text = (tmp_path / name).read_text(encoding="utf-8")
        targets = {part.split(")")[0] for part in text.split("](#")[1:]}
        assert targets
        for target in targets:
            assert text.count(f'<a id="{target}"></a>') == 1


def test_rows_csv_has_every_score_and_every_task_without_one(tmp_path: Path) -> None:
    store = small_store()
    write_tables(store, tmp_path)
    rows = list(csv.DictReader(io.StringIO((tmp_path / "rows.csv").read_text(encoding="utf-8"))))
    assert len(rows) == len(store.rows["scores"]) + 2
    crashed = next(row for row in rows if row["outcome"] == "crashed")
    assert crashed["score"] == ""
    assert "signal 11" in crashed["detail"]
    measured = next(row for row in rows if row["solver"] == "lcp-pgs" and row["name"] == "WAV")
    assert (float(measured["value"]), measured["verdict"]) == (0.5, "fail")


def test_scorecard_csv_is_tidy_and_names_the_row_of_each_worst_value(tmp_path: Path) -> None:
    write_tables(small_store(), tmp_path)
    frame = pd.read_csv(tmp_path / "scorecard.csv")
    worst = frame[(frame.solver == "lcp-pgs") & (frame.name == "BRK") & (frame.statistic == "worst")]
    assert worst.verdict.tolist() == ["fail"]
    assert worst.score.tolist() == [201]
    lost = frame[(frame.solver == "zeta") & (frame.name == "coverage") & (frame.statistic == "lost")]
    assert lost.value.tolist() == [1.0]


def test_the_same_store_gives_the_same_bytes(tmp_path: Path) -> None:
    stores = (small_store(), small_store())
    for store, folder in zip(stores, ("a", "b"), strict=True):
        add_sweep(store, "qce", qce_law(VA))
        add_sweep(store, "lcp-pgs", lcp_law(VA))
        add_disturbed(store, "qce", jump={3: 0.0, 4: 0.3})
        write_tables(store, tmp_path / folder)
    for path in sorted((tmp_path / "a").iterdir()):
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()


@pytest.mark.parametrize("name", ["scorecard.tex", "table1.md"])
def test_the_tables_of_the_small_store_are_as_they_were(name: str, tmp_path: Path) -> None:
    write_tables(small_store(), tmp_path)
    assert (tmp_path / name).read_text(encoding="utf-8") == (GOLDEN / name).read_text(encoding="utf-8")


def test_an_empty_store_is_an_error_that_says_what_to_run() -> None:
    with pytest.raises(ReportError, match=r"no task was planned.*impactbench run"):
        scorecard(HandmadeStore())


def test_a_store_in_which_nothing_is_done_is_an_error() -> None:
    store = HandmadeStore()
    store.task("qce", "bernoulli", outcome=None)
    with pytest.raises(ReportError, match="1 planned tasks and none is done"):
        scorecard(store)


def test_a_store_with_a_missing_column_is_an_error_that_names_it() -> None:
    class Spoiled(HandmadeStore):
        def frame(self, name: str) -> pd.DataFrame:
            frame = super().frame(name)
            return frame.drop(columns="verdict") if name == "scores" else frame

    store = Spoiled()
    store.all_six("qce")
    with pytest.raises(ReportError, match=r"'scores' lacks the columns verdict"):
        scorecard(store)


def test_an_unknown_verdict_is_an_error_that_names_the_row() -> None:
    store = HandmadeStore()
    task = store.all_six("qce")
    row = store.score(task, "KIN", 0.0, verdict="maybe")
    with pytest.raises(ReportError, match=rf"score {row} has the unknown verdict 'maybe'"):
        scorecard(store)


def test_a_folder_that_cannot_be_made_is_a_clear_error(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(ReportError, match="cannot make the report folder"):
        write_tables(small_store(), tmp_path / "taken")


def test_a_file_that_cannot_be_written_is_a_clear_error_and_leaves_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / "scorecard.md").mkdir()
    with pytest.raises(ReportError, match=r"cannot write .*scorecard\.md"):
        write_tables(small_store(), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["scorecard.md"]


def test_a_full_disk_keeps_the_older_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "rows.csv"
    target.write_text("older")

    def full(_file: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ReportError, match="No space left on device"):
        files.write_whole(target, b"newer")
    assert target.read_text() == "older"
    assert [path.name for path in tmp_path.iterdir()] == ["rows.csv"]


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (1.0, "1"), (0.51604, "0.516"), (2.6e-15, "2.6e-15"), (1e-8, "1e-8"), (514.2, "514"), (2083.0, "2083"),
     (1.234e7, "1.2e7"), (math.inf, "∞"), (math.nan, "–"), (-1.2e-12, "-1.2e-12")],
)  # fmt: skip
def test_a_number_is_short_and_exact_enough(value: float, text: str) -> None:
    assert number(value) == text
