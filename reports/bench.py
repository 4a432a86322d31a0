"""Speed against error as tables: Markdown and CSV, with the figures beside them. Made from a store, never measured.

bench.md             what a reader wants to know, in order
bench_points.csv     every setting of every solver on every scene: errors, visits, times
bench_reach.csv      cost to reach each error
bench_scaling.csv    times, memory and work over size
bench_profiles.csv   performance profiles with their bootstrap bands
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from harness.measurement import Outcome
from harness.results import Frames
from harness.statistics import LEVEL, bootstrap_band, compare_costs, performance_profile
from harness.timing import NOISE_RATIO, is_noisy
from harness.work_precision import APPROACH, ENERGY, MOMENTUM, OWN_EQUATIONS, OWN_LIMIT, VERIFICATION
from reports.bench_figures import LCP_LOOKS, write_bench_figures
from reports.bench_rows import (
    COMPARED_AT,
    FIT_FROM,
    TARGETS,
    VALIDATION_TARGETS,
    Bench,
    Point,
    cost_matrix,
    exponent,
    is_own_reference,
    laws,
    reach,
    scenes,
    sweep,
    validation_metric,
)
from reports.files import prepare, write_whole
from reports.markdown import markdown_table
from reports.spreadsheet import csv_text
from reports.wording import count_text, number, time_text

# Zhang 2015, Section 5.3: average time of frictional contact resolution in the pattern "Hex", 60,000 grains.
PAPER_QCE_S, PAPER_GR_S = 0.25, 6.1
NOT_REACHED = "not reached"
MEBIBYTE = 2**20
# Memory grows by pages of 4 KiB and arenas of 128 KiB: below so many contacts a number for each would be those.
MEASURABLE_FROM = 1000
BAND_SEED = 0
# Factors at which the Markdown page quotes the performance profile.
QUOTED_FACTORS = (1.0, 2.0, 10.0, 100.0)
PROFILE_FACTORS = tuple(float(10.0**k) for k in np.arange(0.0, 4.01, 0.1))


def write_bench(store: Frames, folder: str | os.PathLike[str]) -> list[Path]:
    """Write all tables and figures of a bench.

    Args:
        store: anything with `frame(name)` for "tasks", "scores", "series" and "runs".
        folder: where to; made where it is missing.

    Returns:
        The files.

    Raises:
        ReportError: the store has no bench in it, or the folder cannot be written to.
    """
    bench = Bench(store)
    path = prepare(folder)
    texts = {
        "bench.md": bench_markdown(bench),
        "bench_points.csv": csv_text(_point_rows(bench)),
        "bench_reach.csv": csv_text(_reach_rows(bench)),
        "bench_scaling.csv": csv_text(_scaling_rows(bench)),
        "bench_profiles.csv": csv_text(_profile_rows(bench)),
    }
    written = [write_whole(path / name, text.encode()) for name, text in texts.items()]
    return [*written, *write_bench_figures(bench, path)]


def bench_markdown(bench: Bench) -> str:
    """The whole bench as one Markdown page."""
    sections = (
        _heading(bench), _table_2(bench), _reach_section(bench), _finest_section(bench), _profile_section(bench),
        _ratio_section(bench), _scaling_section(bench), _cold_section(bench), _warm_section(bench),
        _lost_section(bench),
    )  # fmt: skip
    return "\n".join(line for section in sections for line in section) + "\n"


def _heading(bench: Bench) -> list[str]:
    """What was measured, on what, and how quiet it was."""
    environment = bench.environment
    machine = ", ".join(
        f"{key} {environment[key]}"
        for key in ("cpu", "cores", "python", "numpy", "numba", "commit")
        if key in environment
    )
    lines = ["# Speed against error", ""]
    if bench.open:
        lines += [f"**INCOMPLETE: {bench.open} planned tasks are not done.** The same command goes on.", ""]
    lines += [
        f"Measured on: {machine}.",
        "",
        "Times are CPU time of one solve, all threads together: median over interleaved rounds, with the minimum and "
        "the spread (interquartile range over median). Errors come from runs of their own. Contact visits are a cost "
        "that no machine changes. *Verification* is the residual of the law's own equations, recomputed (energy and "
        "what still approaches; the natural map of an LCP); for a law without one, the distance to its own answer at "
        "the finest setting. *Validation* is the distance to the named reference over the largest velocity before.",
        "",
        *_noise(bench),
        "",
    ]
    return lines


def _noise(bench: Bench) -> list[str]:
    """Whether the machine was quiet."""
    times = bench.calibrations
    if times.size == 0:
        return ["No timing was made."]
    best = float(times.min())
    noisy = sum(is_noisy(float(time), best) for time in times)
    verdict = "**NOISY MACHINE**" if noisy * 10 > times.size else "quiet"
    return [
        f"Calibration kernel: {verdict}. {noisy} of {times.size} runs took more than {NOISE_RATIO:g} times the best "
        f"({time_text(best)}); median {np.median(times) / best:.2f}, worst {times.max() / best:.2f} times the best. "
        "Where it is noisy, compare minima and contact visits, not medians."
    ]


def _table_2(bench: Bench) -> list[str]:
    """QCE against GR: the paper's times beside ours."""
    heading = ("where", "contacts", "QCE", "GR", "GR / QCE", "rounds", "GR / QCE, visits")
    body: list[tuple[str, ...]] = [
        (
            "Zhang 2015, Hex pattern, with friction; GR from Smith 2012, other code and machine", "–",
            f"{PAPER_QCE_S} s", f"{PAPER_GR_S} s", f"{PAPER_GR_S / PAPER_QCE_S:.0f}", "–", "–",
        )
    ]  # fmt: skip
    for scene in scenes(bench.scaling):
        pair = [next((p for p in bench.scaling if p.scene == scene and p.law == law), None) for law in ("qce", "gr")]
        if "pack" not in (pair[0].tags if pair[0] else ()) or pair[0] is None or pair[1] is None:
            continue
        body.append(_pair(scene, pair[0], pair[1]))
    return [
        "## QCE against GR (Table 2 and Section 5.3 of the paper)",
        "",
        "The paper compares its own code with times printed for another code. Here both laws run in one code, on one "
        "machine, to the same tolerance, elastic and without friction; the range is that of the ratios of the rounds.",
        "",
        *markdown_table(heading, body),
        "",
    ]


def _pair(scene: str, qce: Point, gr: Point) -> tuple[str, ...]:
    """One row of the comparison."""
    ratio, span = NOT_REACHED, "–"
    if qce.timed and gr.timed and qce.converged and gr.converged:
        ratio = f"{gr.median_s / qce.median_s:.2f}"
        rounds = [gr.timed.rounds[k] / qce.timed.rounds[k] for k in qce.timed.rounds if k in gr.timed.rounds]
        span = f"{min(rounds):.2f} … {max(rounds):.2f}" if rounds else "–"
    visits = f"{gr.work / qce.work:.2f}" if math.isfinite(gr.work) and math.isfinite(qce.work) else "–"
    return scene, f"{qce.contacts:,}", _median_text(qce), _median_text(gr), ratio, span, visits


def _reach_section(bench: Bench) -> list[str]:
    """Cost to reach each error, one table a scene and kind of error."""
    lines = [
        "## Cost to reach an error",
        "",
        "CPU time, and contact visits in brackets, straight in log-log between the settings around the error. An error "
        "that the coarsest setting meets costs at most what that setting costs (≤).",
        "",
    ]
    for scene in scenes(bench.points):
        here = [point for point in bench.points if point.scene == scene]
        for metric, targets in ((VERIFICATION, TARGETS), (validation_metric(here), VALIDATION_TARGETS)):
            body = [
                (law, *_reach_cells(sweep(here, law, scene), metric, targets))
                for law in laws(here)
                if metric
                and not is_own_reference(law, metric)
                and any(metric in p.errors for p in sweep(here, law, scene))
            ]
            if body:
                title = (
                    metric if metric == VERIFICATION else f"validation against {metric.removeprefix('validation: ')}"
                )
                lines += [f"### {scene}: {title}", ""]
                lines += [*markdown_table(("law", *(number(target) for target in targets)), body), ""]
    return lines


def _reach_cells(points: Sequence[Point], metric: str, targets: Sequence[float]) -> list[str]:
    """Time and visits to reach each target."""
    times = reach(points, metric, targets, visits=False)
    visits = reach(points, metric, targets, visits=True)
    cells = []
    for target, time, work in zip(targets, times, visits, strict=True):
        if not math.isfinite(work):
            cells.append(NOT_REACHED)
            continue
        cheapest = min((p for p in points if math.isfinite(p.work)), key=lambda p: p.work)
        bound = "≤ " if cheapest.error(metric) <= target else ""
        cells.append(f"{bound}{time_text(float(time))} ({count_text(float(work))})")
    return cells


def _finest_section(bench: Bench) -> list[str]:
    """All errors at the finest setting: what more time cannot mend."""
    lines = ["## Errors at the finest setting", ""]
    for scene in scenes(bench.points):
        here = [point for point in bench.points if point.scene == scene]
        metrics = (VERIFICATION, OWN_EQUATIONS, APPROACH, ENERGY, MOMENTUM)
        truths = sorted({metric for point in here for metric in point.errors if metric.startswith("validation: ")})
        heading = ("law", "setting", "status", *metrics, *(truth.removeprefix("validation: ") for truth in truths))
        body = []
        for law in laws(here):
            point = sweep(here, law, scene)[-1]
            cells = ["own" if is_own_reference(law, m) else number(point.error(m)) for m in (*metrics, *truths)]
            body.append((law, point.setting or "–", _ended(point), *cells))
        lines += [f"### {scene}", "", *markdown_table(heading, body), ""]
    return lines


def _profile_section(bench: Bench) -> list[str]:
    """Performance profiles at a few factors."""
    if len(scenes(bench.points)) < 2:
        return []
    lines = [
        f"## Performance profiles (verification error ≤ {COMPARED_AT:g})",
        "",
        "Share of the scenes that a solver solves within a factor of the best one (Dolan and Moré 2002). A failure is "
        "infinite, the best is taken over successes, and a scene that nobody solves stays in the count. In brackets "
        f"the {LEVEL:.0%} bootstrap band over scenes. Laws answer differently: a profile says what an answer to the "
        "law's own equations costs, not how true it is.",
        "",
    ]
    for visits, title in ((False, "CPU time"), (True, "contact visits")):
        where, names, costs = cost_matrix(bench, visits=visits)
        if not names:
            continue
        share = performance_profile(costs, QUOTED_FACTORS)
        low, high = _band(costs, QUOTED_FACTORS)
        body = [
            (
                law, f"{int(np.isfinite(costs[:, k]).sum())}/{len(where)}",
                *(f"{share[t, k]:.2f} [{low[t, k]:.2f}, {high[t, k]:.2f}]" for t in range(len(QUOTED_FACTORS))),
            )
            for k, law in enumerate(names)
        ]  # fmt: skip
        heading = (f"law, {title}", "solved", *(f"within {factor:g}" for factor in QUOTED_FACTORS))
        lines += [*markdown_table(heading, body), ""]
    return lines


def _ratio_section(bench: Bench) -> list[str]:
    """Every law's cost over QCE's on the same scenes."""
    where, names, costs = cost_matrix(bench, visits=False)
    if "qce" not in names or len(where) < 2:
        return []
    base = costs[:, names.index("qce")]
    body = []
    for k, law in enumerate(names):
        if law == "qce":
            continue
        ratios = compare_costs(costs[:, k], base)
        body.append((
            law, number(ratios.geometric_mean),
            f"{number(ratios.smallest)} … {number(ratios.largest)}" if ratios.both else "–",
            number(ratios.median), str(ratios.both), str(ratios.first_fails), str(ratios.second_fails),
            str(ratios.neither),
        ))  # fmt: skip
    heading = (
        "law over qce", "geometric mean", "range", "median with failures", "both solve", "law fails", "qce fails",
        "neither",
    )  # fmt: skip
    return [f"## CPU time over QCE's (verification error ≤ {COMPARED_AT:g})", "", *markdown_table(heading, body), ""]


def _scaling_section(bench: Bench) -> list[str]:
    """Growth with size: exponents, and the numbers that they come from."""
    if not bench.scaling:
        return []
    families = list(dict.fromkeys(point.family for point in bench.scaling))
    lines = [
        "## Growth with the number of contacts",
        "",
        f"Exponent of time over contacts by least squares in log-log, with its {LEVEL:.0%} interval, over the sizes "
        f"from {FIT_FROM} contacts on at which the solver's own test passed. Default settings.",
        "",
    ]
    body = []
    for law in laws(bench.scaling):
        cells = []
        for family in families:
            fit = exponent(p for p in bench.scaling if p.law == law and p.family == family)
            cells.append("–" if fit is None else f"{fit.exponent:.2f}{_interval(fit.low, fit.high)} (n={fit.points})")
        body.append((law, *cells))
    lines += [*markdown_table(("law", *families), body), "", *_unfinished(bench.scaling)]
    heading = (
        "law",
        "contacts",
        "median",
        "minimum",
        "spread",
        "noisy rounds",
        "fresh",
        "visits",
        "memory beyond the problem",
        "status",
    )
    for family in families:
        here = [point for point in bench.scaling if point.family == family]
        body = [_size_row(point) for law in laws(here) for point in here if point.law == law]
        lines += [f"### {family}", "", *markdown_table(heading, body), ""]
    return [
        *lines,
        "*Fresh* is a solve that also builds what it keeps of the problem (such as W); *memory* is the growth of the "
        "process during it, which comes in pages: small problems tell nothing.",
        "",
    ]


def _unfinished(points: Sequence[Point]) -> list[str]:
    """Say in words who did not meet its own test at which sizes, and who solves the same equations there."""
    sentences = []
    for family in dict.fromkeys(point.family for point in points):
        here = [point for point in points if point.family == family]
        for law in laws(here):
            missed = [point for point in here if point.law == law and point.timed and not point.converged]
            if not missed:
                continue
            where = ", ".join(f"{point.contacts:,} contacts ({point.status})" for point in missed)
            sentences.append(f"- `{law}` on {family}: {where}.{_peers(law, missed[-1], here)}")
    if not sentences:
        return []
    return [
        "Not converged: here a law's own test did not pass at its default settings. The times below are then until "
        "it gave up, not of an answer to its tolerance, and no exponent is fitted to them; what it reaches in which "
        "time is in the tables of the cost to reach an error.",
        "",
        *sentences,
        "",
    ]


def _peers(law: str, missed: Point, points: Sequence[Point]) -> str:
    """Methods for the Newton LCP that converged where another of them did not; empty for all other laws."""
    here = [p for p in points if p.law.partition(":")[0] in LCP_LOOKS and p.contacts == missed.contacts]
    if law not in laws(here):
        return ""
    able = [point.law for point in here if point.converged]
    at = f"at {missed.contacts:,} contacts"
    return f" The same equations are solved {at} by {', '.join(able)}." if able else f" No method solved them {at}."


def _size_row(point: Point) -> tuple[str, ...]:
    """One size of one law."""
    timed = point.timed
    if timed is None:
        return point.law, f"{point.contacts:,}", *["–"] * 7, _ended(point)
    growth = timed.memory_bytes / MEBIBYTE
    memory = "–" if math.isnan(growth) else f"{growth:.2f} MiB"
    if point.contacts >= MEASURABLE_FROM and not math.isnan(growth):
        memory += f", {timed.memory_bytes / point.contacts:.0f} B a contact"
    return (
        point.law, f"{point.contacts:,}", time_text(timed.repeats.median), time_text(timed.repeats.minimum),
        f"{timed.repeats.spread:.0%}", f"{timed.noisy}/{len(timed.rounds)}", time_text(timed.fresh_s),
        count_text(point.work), memory, _ended(point),
    )  # fmt: skip


def _cold_section(bench: Bench) -> list[str]:
    """First and second solve in a process."""
    if not bench.first_solves:
        return []
    body = [
        (first.law, time_text(first.first.median), time_text(first.second.median), str(first.first.count))
        for first in bench.first_solves
    ]
    return [
        "## First solve",
        "",
        "First solve in a fresh process (kernels are read from the cache), and the second one; three balls.",
        "",
        *markdown_table(("law", "first", "second", "processes"), body),
        "",
    ]


def _warm_section(bench: Bench) -> list[str]:
    """Warm start over a sequence of impacts."""
    if not bench.warm_steps:
        return []
    body = [
        (
            steps.law, steps.scene, str(steps.steps), time_text(steps.cold.median), time_text(steps.warm.median),
            f"{steps.cold.median / steps.warm.median:.2f}" if steps.warm.median > 0 else "–",
            f"{count_text(steps.cold_visits)} → {count_text(steps.warm_visits)}", number(steps.difference),
            ", ".join(steps.statuses),
        )
        for steps in bench.warm_steps
    ]  # fmt: skip
    heading = (
        "law", "layer", "steps", "cold", "warm", "cold / warm", "contact visits", "difference of the answers", "status",
    )  # fmt: skip
    return [
        "## Cold and warm start over a sequence of impacts",
        "",
        "A layer comes down, then rests under gravity step by step (restitution 0); every step is solved from zero and "
        "from the impulse that the same solver found a step before. Time of all steps together, median over rounds. "
        "Laws that are not here start from zero always: their answer depends on its way.",
        "",
        *markdown_table(heading, body),
        "",
    ]


def _lost_section(bench: Bench) -> list[str]:
    """What gave no answer, with its reason."""
    lost = bench.lost()
    if not lost:
        return []
    return ["## Without an answer", "", *markdown_table(("run", "solver", "scene", "reason"), lost), ""]


def _band(costs: np.ndarray, factors: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    return bootstrap_band(costs, lambda rows: performance_profile(rows, factors), seed=BAND_SEED)


def _point_rows(bench: Bench) -> Iterable[Sequence[object]]:
    """Heading and rows of bench_points.csv."""
    metrics = list(dict.fromkeys(metric for point in bench.points for metric in point.errors))
    yield (
        "task", "law", "solver", "setting", "scene", "contacts", "outcome", "status", "iterations", "visits",
        *metrics, "median_s", "minimum_s", "spread", "samples", "wall_s", "fresh_s", "noisy_rounds", "reason",
    )  # fmt: skip
    for point in bench.points:
        yield (
            point.rows[0], point.law, point.specification, point.setting, point.scene, point.contacts,
            point.outcome.value if point.outcome else "planned", point.status, point.iterations, point.visits,
            *(point.errors.get(metric) for metric in metrics), *_timed_cells(point), point.reason,
        )  # fmt: skip


def _timed_cells(point: Point) -> tuple[object, ...]:
    timed = point.timed
    if timed is None:
        return (None,) * 7
    repeats = timed.repeats
    return repeats.median, repeats.minimum, repeats.spread, repeats.count, timed.wall_s, timed.fresh_s, timed.noisy


def _reach_rows(bench: Bench) -> Iterable[Sequence[object]]:
    """Heading and rows of bench_reach.csv; what is not reached is "inf"."""
    yield "law", "scene", "error", "target", "cpu_s", "visits"
    wanted = sorted({*TARGETS, *VALIDATION_TARGETS}, reverse=True)
    for scene in scenes(bench.points):
        here = [point for point in bench.points if point.scene == scene]
        metrics = [
            VERIFICATION,
            OWN_LIMIT,
            *sorted({m for p in here for m in p.errors if m.startswith("validation: ")}),
        ]
        for law in laws(here):
            for metric in metrics:
                points = sweep(here, law, scene)
                if is_own_reference(law, metric) or not any(metric in p.errors for p in points):
                    continue
                times, visits = (reach(points, metric, wanted, visits=kind) for kind in (False, True))
                for target, time, work in zip(wanted, times, visits, strict=True):
                    yield law, scene, metric, target, time, work


def _scaling_rows(bench: Bench) -> Iterable[Sequence[object]]:
    """Heading and rows of bench_scaling.csv."""
    yield (
        "task", "law", "family", "scene", "contacts", "outcome", "status", "iterations", "visits", "median_s",
        "minimum_s", "spread", "samples", "wall_s", "fresh_s", "noisy_rounds", "memory_bytes", "reason",
    )  # fmt: skip
    for point in bench.scaling:
        yield (
            point.rows[0], point.law, point.family, point.scene, point.contacts,
            point.outcome.value if point.outcome else "planned", point.status, point.iterations, point.visits,
            *_timed_cells(point), point.timed.memory_bytes if point.timed else None, point.reason,
        )  # fmt: skip


def _profile_rows(bench: Bench) -> Iterable[Sequence[object]]:
    """Heading and rows of bench_profiles.csv."""
    yield "cost", "law", "factor", "share", "low", "high"
    for visits, title in ((False, "cpu_s"), (True, "visits")):
        where, names, costs = cost_matrix(bench, visits=visits)
        if not where or not names:
            continue
        share = performance_profile(costs, PROFILE_FACTORS)
        low, high = _band(costs, PROFILE_FACTORS)
        for k, law in enumerate(names):
            for t, factor in enumerate(PROFILE_FACTORS):
                yield title, law, f"{factor:.6g}", share[t, k], low[t, k], high[t, k]


def _ended(point: Point) -> str:
    """How a point ended: the solver's status, or the outcome of a task without an answer."""
    if point.outcome is None:
        return "open"
    return point.status if point.outcome is Outcome.MEASURED else point.outcome.value


def _median_text(point: Point) -> str:
    return time_text(point.median_s) if point.timed else _ended(point)


def _interval(low: float, high: float) -> str:
    return "" if math.isnan(low) else f" [{low:.2f}, {high:.2f}]"
