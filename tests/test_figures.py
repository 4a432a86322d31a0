"""The figures: what is drawn and skipped, the same bytes from the same rows, type and width of a journal page."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from pathlib import Path

import matplotlib as mpl
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from harness.results import Results
from reports import figures
from reports.figures import FIGURES, LOOKS, ONE_COLUMN, STYLE, TWO_COLUMNS, write_figures
from reports.scorecard import ReportError
from tests.handmade_rows import VA, HandmadeStore, add_disturbed, add_sweep, gr_law, lcp_law, qce_law

# Smallest type that journals take [pt], and least resolution of a bitmap [dots per inch].
SMALLEST_TYPE = 7.0
LEAST_RESOLUTION = 200


def full_store() -> HandmadeStore:
    store = HandmadeStore()
    for solver, v_post in (("qce", qce_law(VA)), ("gr", gr_law(VA)), ("lcp-pgs", lcp_law(VA))):
        add_sweep(store, solver, v_post)
    for solver, leap in (("qce", 0.3), ("qce-defer", 0.0), ("gr", 0.6)):
        add_disturbed(store, solver, jump={3: 0.0, 4: leap})
    for solver, errors in (("qce", (0.0, 1e-16)), ("jacobi", (0.5, 700.0))):
        for error in errors:
            task = store.task(solver, "bernoulli")
            store.score(task, "KIN", error, metric="energy lost")
            store.score(task, "KIN", error, metric="energy error e", verdict="shown")
    return store


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("figures")
    written = write_figures(full_store(), folder, jobs=2)
    assert written == [folder / f"{name}.{kind}" for name in FIGURES for kind in ("pdf", "svg", "png")]
    return folder


@pytest.fixture(params=list(FIGURES))
def figure(request: pytest.FixtureRequest) -> Iterator[Figure]:
    with mpl.rc_context(STYLE):
        yield FIGURES[request.param](Results(full_store()))


def test_every_figure_is_written_whole_in_three_formats_and_nothing_else(drawn: Path) -> None:
    assert sorted(path.name for path in drawn.iterdir()) == sorted(
        f"{name}.{kind}" for name in FIGURES for kind in ("pdf", "svg", "png")
    )
    assert all(path.stat().st_size > 1000 for path in drawn.iterdir())


def test_files_carry_no_date_and_fonts_that_journals_take(drawn: Path) -> None:
    for name in FIGURES:
        pdf = (drawn / f"{name}.pdf").read_bytes()
        assert b"CreationDate" not in pdf
        assert b"/Subtype /Type3" not in pdf
        assert b"/CIDFontType2" in pdf
        assert b"<dc:date>" not in (drawn / f"{name}.svg").read_bytes()


def test_bitmaps_have_the_resolution_of_print(drawn: Path) -> None:
    for name in FIGURES:
        width = struct.unpack(">I", (drawn / f"{name}.png").read_bytes()[16:20])[0]
        assert width >= LEAST_RESOLUTION * ONE_COLUMN


def test_the_same_rows_give_the_same_bytes_for_any_number_of_jobs(
    drawn: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    some = ("fig04_three_ball_chain", "energy_error")
    monkeypatch.setattr(figures, "FIGURES", {name: FIGURES[name] for name in some})
    # Another style beforehand must not show: every figure sets its own.
    with mpl.rc_context({"font.size": 20.0, "svg.hashsalt": None, "lines.linewidth": 5.0}):
        write_figures(full_store(), tmp_path)
    for path in sorted(tmp_path.iterdir()):
        assert path.read_bytes() == (drawn / path.name).read_bytes()


def test_no_type_is_too_small_and_the_width_is_a_column(figure: Figure) -> None:
    assert figure.get_size_inches()[0] in (ONE_COLUMN, TWO_COLUMNS)
    texts = [text for text in figure.findobj(Text) if isinstance(text, Text) and text.get_text()]
    assert texts
    assert min(float(text.get_fontsize()) for text in texts) >= SMALLEST_TYPE


def test_axes_are_labelled_and_quantities_have_a_unit(figure: Figure) -> None:
    panels = figure.axes
    assert all(panel.get_xlabel() for panel in panels[-1:])
    for panel in panels:
        label = panel.get_xlabel()
        assert not label or "[–]" in label or label.startswith("ball")
    assert any("[–]" in panel.get_ylabel() + panel.get_xlabel() for panel in panels)


def test_any_one_of_color_marker_and_line_tells_the_laws_apart() -> None:
    for looks in ([look.color for look in LOOKS.values()], [look.marker for look in LOOKS.values()],
                  [str(look.line) for look in LOOKS.values()]):  # fmt: skip
        assert len(set(looks)) == len(LOOKS)


def test_a_lone_law_at_va_zero_is_a_marker_and_not_a_slope() -> None:
    with mpl.rc_context(STYLE):
        panels = figures.draw_three_ball_chain(Results(full_store())).axes
    gr = [line for line in panels[0].lines if line.get_color() == LOOKS["gr"].color or line.get_marker() == "s"]
    starts = sorted(float(line.get_xdata()[0]) for line in gr)  # type: ignore[index, arg-type]
    assert starts == [0.0, VA[1]]
    assert sorted(len(line.get_xdata()) for line in gr) == [1, VA.size - 1]  # type: ignore[arg-type]


def test_an_energy_without_bound_is_marked_and_stretches_no_axis() -> None:
    store = full_store()
    task = store.task("jacobi", "sphere-pack")
    store.score(task, "KIN", 1e199, metric="energy lost")
    store.score(task, "KIN", 1e199, metric="energy error e", verdict="shown")
    with mpl.rc_context(STYLE):
        panel = figures.draw_energy_error(Results(store)).axes[0]
    assert panel.get_xlim()[1] <= 1e5
    beyond = [len(line.get_xdata()) for line in panel.lines if line.get_marker() == ">"]  # type: ignore[arg-type]
    assert sorted(beyond) == [0, 1]


def test_what_has_no_rows_is_skipped_and_said(tmp_path: Path) -> None:
    store = HandmadeStore()
    task = store.task("qce", "bernoulli")
    store.score(task, "KIN", 1e-16, metric="energy lost")
    store.score(task, "KIN", 1e-16, metric="energy error e", verdict="shown")
    said: list[str] = []
    written = write_figures(store, tmp_path, progress=said.append)
    assert [path.name for path in written] == [f"energy_error.{kind}" for kind in ("pdf", "svg", "png")]
    assert said[-1] == "drew energy_error"
    assert [text.split(":")[0] for text in said[:-1]] == [f"skipped {name}" for name in list(FIGURES)[:-1]]


def test_an_inelastic_scene_is_not_held_to_the_energy_of_an_elastic_one(tmp_path: Path) -> None:
    store = HandmadeStore()
    task = store.task("qce-lcp", "bernoulli")
    store.score(task, "KIN", 0.7, metric="energy lost", verdict="shown")
    store.score(task, "KIN", 0.7, metric="energy error e", verdict="shown")
    with pytest.raises(ReportError, match="no energy error of an elastic scene"):
        write_figures(store, tmp_path)


def test_a_store_without_any_row_for_a_figure_is_an_error_that_says_what_is_missing(tmp_path: Path) -> None:
    with pytest.raises(ReportError, match=r"rows for no figure.*three-ball sweep.*disturbed cradle"):
        write_figures(HandmadeStore(), tmp_path)


def test_a_folder_that_cannot_be_made_is_a_clear_error(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(ReportError, match="cannot make the report folder"):
        write_figures(full_store(), tmp_path / "taken")


def test_a_series_that_cannot_be_read_is_an_error_that_names_it(tmp_path: Path) -> None:
    store = HandmadeStore()
    task = store.task("qce", "wave", kind="sweep")
    row = store.series(task, "three-ball sweep", {"va": ["fast"]})
    with pytest.raises(ReportError, match=re.escape(f"series {row}")):
        write_figures(store, tmp_path)
