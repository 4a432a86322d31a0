"""The paper's claims as data, each with a check that reads the measured rows and decides.

No verdict is written here: a check gets the results and returns what they say, with the numbers and the rows that
they come from. Rows that are not there make a claim "not measured", never confirmed.

Source of the claims: Zhang et al. 2015, "Quadratic Contact Energy Model for Multi-impact Simulation". Claims of this
benchmark about its own variants are marked as such.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import partial

import numpy as np

from harness.measurement import DESIDERATA, Kind, Outcome, Verdict
from harness.results import (
    DisturbedCradle,
    Results,
    ScoreRow,
    SeriesRow,
    ThreeBallSweep,
    cradles,
    disturbed_cradles,
    three_ball_sweep,
)
from solvers.solution import Floats

PAPER = "Zhang 2015"
OURS = "this benchmark"

PAPER_TABLE_1: Mapping[str, Mapping[str, bool]] = {
    "QCE": {"WAV": True, "BRK": True, "SYM": True, "KIN": True, "MOM": True, "ONE": True},
    "GR": {"WAV": False, "BRK": True, "SYM": True, "KIN": True, "MOM": True, "ONE": True},
    "LCP": {"WAV": False, "BRK": False, "SYM": True, "KIN": True, "MOM": True, "ONE": True},
}
"""Table 1 as printed: True is a dot, False a cross (the paper writes MON for MOM)."""

SOLVER_OF = {"QCE": "qce", "GR": "gr", "LCP": "lcp-pgs"}
"""Which solver stands for which row of the paper's table."""

# Two solvers that iterate to residuals near 1e-12 agree to this where their laws agree.
SAME = 1e-8
# Fig. 4 and Fig. 12 are read by eye: curves closer than 1 % of the impact velocity coincide in print.
PRINT = 0.01
# A response within this many times the disturbance is continuous dependence, not a jump: the largest slope of a
# law that passes waves on is of the order of the number of balls.
STEEP = 100.0
# The disturbance at which jumps are told from slopes: far above rounding, far below anything seen.
SMALL = 1e-8
# Mean |K⁺ - K⁻| / K⁻ as printed in Section 5.4 (falling bunnies and pawns).
PRINTED_ENERGY_ERROR = 2.43e-4


class ClaimVerdict(Enum):
    """What the measured rows say of a claim."""

    CONFIRMED = "confirmed"
    PARTLY = "partly"
    """Holds in a part of its domain, or on average, but not as stated."""
    REFUTED = "refuted"
    NOT_MEASURED = "not measured"


@dataclass(frozen=True)
class Evidence:
    """What a check found."""

    verdict: ClaimVerdict
    summary: str
    """The finding in one or two sentences, with its numbers."""
    numbers: Mapping[str, float] = field(default_factory=dict)
    rows: tuple[str, ...] = ()
    """Rows behind it: "score 12", "series 3", "task 5"."""


@dataclass(frozen=True)
class Claim:
    """One statement that the rows can confirm or refute."""

    key: str
    source: str
    """PAPER or OURS."""
    where: str
    """Section, figure, table."""
    statement: str
    """The claim in our words."""
    check: Callable[[Results], Evidence]


@dataclass(frozen=True)
class Finding:
    """A claim with what was found."""

    claim: Claim
    evidence: Evidence


def check_claims(results: Results) -> tuple[Finding, ...]:
    """Check every claim against the measured rows, in the order of CLAIMS."""
    return tuple(Finding(claim, claim.check(results)) for claim in CLAIMS)


def _not_measured(what: str) -> Evidence:
    """Evidence of a claim whose rows are not there."""
    return Evidence(ClaimVerdict.NOT_MEASURED, f"No rows: {what}.")


def _table_1(results: Results, law: str, name: str) -> Evidence:
    """One cell of Table 1 against the measured cell."""
    solver, dot = SOLVER_OF[law], PAPER_TABLE_1[law][name]
    cell = results.cell(solver, name)
    if cell.worst is None or cell.verdict not in (Verdict.PASS, Verdict.FAIL) or not cell.passed + cell.failed:
        return _not_measured(f"{solver} has no gated row under {name}")
    worst = cell.worst
    numbers = {"value": worst.value, "tolerance": worst.tolerance, "passed": cell.passed, "failed": cell.failed}
    rows = (worst.link, *(f"task {task.task}" for task in cell.lost))
    counted = (
        f"{cell.failed} of {cell.passed + cell.failed} gated rows fail"
        if cell.failed
        else (f"all {cell.passed} gated rows pass")
    )
    said = f"{counted}; worst: {worst.task.label}, {worst.metric} = {worst.value:.3g} (bound {worst.tolerance:.3g})"
    if cell.lost:
        how = sorted({task.outcome.value for task in cell.lost if task.outcome is not None})
        said += f"; {len(cell.lost)} tasks lost ({', '.join(how)})"
    if cell.failed:
        verdict = ClaimVerdict.REFUTED if dot else ClaimVerdict.CONFIRMED
    elif cell.lost:
        # What was measured passes; a lost task neither keeps nor breaks a physical rule, but it is not a pass.
        verdict = ClaimVerdict.PARTLY if dot else ClaimVerdict.NOT_MEASURED
    else:
        verdict = ClaimVerdict.CONFIRMED if dot else ClaimVerdict.REFUTED
    return Evidence(verdict, said[0].upper() + said[1:] + ".", numbers, rows)


@dataclass(frozen=True)
class Comparison:
    """Distance of two laws to one reference over va; the distance is the Euclidean norm over the three balls."""

    rival: str
    reference: str
    mean: float
    """Mean distance of the law over va, in units of v₀."""
    rival_mean: float
    worse_from: float
    """Smallest va at which the law is farther from the reference than its rival; NaN where it never is."""
    worse_share: float
    """Share of the range of va in which it is farther."""


def compare_sweeps(law: ThreeBallSweep, rival: ThreeBallSweep, *, name: str, reference: str) -> Comparison | None:
    """Compare two laws over their common va > 0 (at va = 0 GR is another law than elsewhere).

    Args:
        law: the law that is said to be better.
        rival: the law that it is compared with.
        name: the rival's name.
        reference: "ideal" or "hertz".

    Returns:
        None where there are fewer than two common points with a reference value.
    """
    common, here, there = np.intersect1d(law.va, rival.va, return_indices=True)
    truth = (law.ideal if reference == "ideal" else law.hertz)[here]
    known = (common > 0) & np.isfinite(truth).all(axis=1)
    va = common[known]
    if va.size < 2:
        return None
    distance = np.linalg.norm(law.v_post[here][known] - truth[known], axis=1)
    other = np.linalg.norm(rival.v_post[there][known] - truth[known], axis=1)
    start, share = _positive_part(va, distance - other - SAME)
    return Comparison(name, reference, _mean_over(va, distance), _mean_over(va, other), start, share)


def _mean_over(x: Floats, y: Floats) -> float:
    """Mean of a piecewise linear curve over its range."""
    return float((0.5 * (y[1:] + y[:-1]) * np.diff(x)).sum() / (x[-1] - x[0]))


def _positive_part(x: Floats, y: Floats) -> tuple[float, float]:
    """Where a piecewise linear curve first turns positive (NaN: never), and the share of its range where it is."""
    start, length = math.nan, 0.0
    for a, b, y_a, y_b in zip(x[:-1], x[1:], y[:-1], y[1:], strict=True):
        if y_a <= 0 and y_b <= 0:
            continue
        root = a + (b - a) * y_a / (y_a - y_b) if (y_a > 0) != (y_b > 0) else math.nan
        first = a if y_a > 0 else root
        last = b if y_b > 0 else root
        start = first if math.isnan(start) else start
        length += last - first
    return float(start), float(length / (x[-1] - x[0]))


def _more_accurate(results: Results) -> Evidence:
    """QCE against GR and LCP, over va, against both references."""
    law = three_ball_sweep(results, "qce")
    if law is None:
        return _not_measured("no three-ball sweep of qce")
    rows, found = [law.link], []
    for solver in ("gr", "lcp-pgs"):
        rival = three_ball_sweep(results, solver)
        if rival is None:
            continue
        rows.append(rival.link)
        for reference in ("ideal", "hertz"):
            comparison = compare_sweeps(law, rival, name=solver, reference=reference)
            if comparison is not None:
                found.append(comparison)
    if not found:
        return _not_measured("no three-ball sweep of gr or lcp-pgs to compare with")
    better_on_average = [c.mean < c.rival_mean for c in found]
    if all(better_on_average) and all(math.isnan(c.worse_from) for c in found):
        verdict = ClaimVerdict.CONFIRMED
    elif any(better_on_average):
        verdict = ClaimVerdict.PARTLY
    else:
        verdict = ClaimVerdict.REFUTED
    numbers: dict[str, float] = {}
    parts = []
    for c in found:
        numbers |= {
            f"mean, qce to {c.reference}": c.mean,
            f"mean, {c.rival} to {c.reference}": c.rival_mean,
            f"worse than {c.rival} from va (to {c.reference})": c.worse_from,
            f"share of va where worse than {c.rival} (to {c.reference})": c.worse_share,
        }
        where = "nowhere farther" if math.isnan(c.worse_from) else f"farther from va = {c.worse_from:.3f} on"
        if not math.isnan(c.worse_from) and c.worse_share < 1 - c.worse_from - 0.01:
            where = f"first farther at va = {c.worse_from:.3f}"
        parts.append(
            f"against {c.rival}, to the {_REFERENCE[c.reference]} outcome: mean distance {c.mean:.3f} v₀ against "
            f"{c.rival_mean:.3f} v₀, {where} ({100 * c.worse_share:.0f} % of the range)"
        )
    return Evidence(verdict, _sentence(parts), numbers, tuple(rows))


_REFERENCE = {"ideal": "ideal-exchange", "hertz": "Hertz"}


def _sentence(parts: Sequence[str]) -> str:
    """Join parts into one sentence."""
    text = "; ".join(parts)
    return text[:1].upper() + text[1:] + "."


def _gr_is_lcp(results: Results) -> Evidence:
    """GR and LCP over va: the same for va > 0, different at va = 0."""
    gr, lcp = three_ball_sweep(results, "gr"), three_ball_sweep(results, "lcp-pgs")
    if gr is None or lcp is None:
        return _not_measured("three-ball sweeps of gr and lcp-pgs are both needed")
    va, here, there = np.intersect1d(gr.va, lcp.va, return_indices=True)
    apart = np.abs(gr.v_post[here] - lcp.v_post[there]).max(axis=1, initial=0.0)
    positive = apart[va > 0]
    if not positive.size:
        return _not_measured("no common va > 0")
    largest = float(positive.max())
    at_zero = float(apart[va == 0].max()) if (va == 0).any() else math.nan
    verdict = ClaimVerdict.CONFIRMED if largest <= SAME else ClaimVerdict.REFUTED
    if largest <= SAME and at_zero <= SAME:
        verdict = ClaimVerdict.PARTLY
    parts = [f"largest difference {largest:.1e} v₀ over {positive.size} values of va > 0"]
    if not math.isnan(at_zero):
        parts.append(f"{at_zero:.3f} v₀ at va = 0")
    return Evidence(verdict, _sentence(parts), {"va > 0": largest, "va = 0": at_zero}, (gr.link, lcp.link))


def _exact_at_ends(results: Results) -> Evidence:
    """QCE at va = 0 and va = v₀ against the ideal exchange."""
    law = three_ball_sweep(results, "qce")
    if law is None:
        return _not_measured("no three-ball sweep of qce")
    ends = [k for k in range(law.va.size) if law.va[k] in (0.0, 1.0)]
    if len(ends) < 2:
        return _not_measured("the sweep of qce lacks va = 0 or va = v₀")
    apart = {f"va = {law.va[k]:g}": float(np.abs(law.v_post[k] - law.ideal[k]).max()) for k in ends}
    right = [value <= SAME for value in apart.values()]
    verdict = ClaimVerdict.CONFIRMED if all(right) else ClaimVerdict.PARTLY if any(right) else ClaimVerdict.REFUTED
    said = [f"distance to the ideal exchange {value:.1e} v₀ at {where}" for where, value in apart.items()]
    return Evidence(verdict, _sentence(said), apart, (law.link,))


def _follows_ideal(results: Results) -> Evidence:
    """QCE over the whole of va against both references."""
    law = three_ball_sweep(results, "qce")
    if law is None:
        return _not_measured("no three-ball sweep of qce")
    numbers: dict[str, float] = {}
    share = []
    for name, truth in (("ideal", law.ideal), ("hertz", law.hertz)):
        apart = np.abs(law.v_post - truth).max(axis=1)
        if not np.isfinite(apart).all() or not apart.size:
            continue
        numbers |= {f"largest, {name}": float(apart.max()), f"at va, {name}": float(law.va[apart.argmax()])}
        share.append(float((apart <= PRINT).mean()))
    if not share:
        return _not_measured("the sweep of qce has no reference values")
    verdict = _by_share(max(share))
    said = [
        f"largest difference of one ball to the {_REFERENCE[name]} outcome {numbers[f'largest, {name}']:.3f} v₀ "
        f"at va = {numbers[f'at va, {name}']:.2f}"
        for name in ("ideal", "hertz")
        if f"largest, {name}" in numbers
    ]
    return Evidence(verdict, _sentence(said), numbers, (law.link,))


def _by_share(share: float) -> ClaimVerdict:
    """All of the domain, at least half of it, or less."""
    if share == 1.0:
        return ClaimVerdict.CONFIRMED
    return ClaimVerdict.PARTLY if share >= 0.5 else ClaimVerdict.REFUTED


def _ideal_is_hertz(results: Results) -> Evidence:
    """The two references of the three-ball chain against each other."""
    sweeps = [sweep for solver in results.solvers if (sweep := three_ball_sweep(results, solver)) is not None]
    sweeps = [sweep for sweep in sweeps if np.isfinite(sweep.hertz).all() and sweep.va.size]
    if not sweeps:
        return _not_measured("no three-ball sweep with both references")
    sweep = sweeps[0]
    distance = np.linalg.norm(sweep.ideal - sweep.hertz, axis=1)
    share = float((distance <= PRINT).mean())
    k = int(distance.argmax())
    numbers = {"largest distance": float(distance[k]), "at va": float(sweep.va[k]), "share within print": share}
    said = (
        f"The two references differ by up to {distance[k]:.3f} v₀ (Euclidean, at va = {sweep.va[k]:g}); they lie "
        f"within {PRINT:g} v₀ for {100 * share:.0f} % of the values of va."
    )
    return Evidence(_by_share(share), said, numbers, (sweep.link,))


def _small_disturbances(results: Results, solver: str) -> list[DisturbedCradle]:
    """The solver's cradles disturbed by SMALL."""
    return [c for c in disturbed_cradles(results, solver) if math.isclose(c.size, SMALL, rel_tol=1e-6)]


def _continuous(results: Results, solver: str) -> Evidence:
    """A small disturbance may change the result in proportion to its size only."""
    found = _small_disturbances(results, solver)
    if not found:
        return _not_measured(f"no disturbed cradle of {solver} at size {SMALL:g}")
    response = {c.balls: c.response for c in found}
    within = [n for n, value in response.items() if value <= STEEP * SMALL]
    verdict = ClaimVerdict.PARTLY if within else ClaimVerdict.REFUTED
    if len(within) == len(response):
        verdict = ClaimVerdict.CONFIRMED
    said = [f"{n} balls: {value:.1e} of the impact velocity" for n, value in response.items()]
    summary = f"Largest response to a disturbance of {SMALL:g}: " + ", ".join(said) + "."
    return Evidence(verdict, summary, {f"{n} balls": v for n, v in response.items()}, _links(found))


def _links(rows: Sequence[DisturbedCradle]) -> tuple[str, ...]:
    """Links of the rows, each once."""
    return tuple(dict.fromkeys(row.link for row in rows))


def _gr_jumps(results: Results) -> Evidence:
    """GR under a small disturbance: the paper says that it jumps."""
    found = _small_disturbances(results, "gr")
    if not found:
        return _not_measured(f"no disturbed cradle of gr at size {SMALL:g}")
    jumps = {f"{c.balls} balls": c.response for c in found}
    share = sum(value > PRINT for value in jumps.values()) / len(jumps)
    verdict = ClaimVerdict.CONFIRMED if share == 1 else ClaimVerdict.PARTLY if share > 0 else ClaimVerdict.REFUTED
    said = ", ".join(f"{n}: {value:.2g} of the impact velocity" for n, value in jumps.items())
    return Evidence(verdict, f"Largest response to a disturbance of {SMALL:g}: {said}.", jumps, _links(found))


def _closer_when_disturbed(results: Results) -> Evidence:
    """QCE against GR under disturbance: root mean square distance to Hertz."""
    numbers: dict[str, float] = {}
    closer, farther, said = [], [], []
    links: tuple[str, ...] = ()
    rival = {(c.balls, c.size): c for c in disturbed_cradles(results, "gr")}
    for cradle in disturbed_cradles(results, "qce"):
        other = rival.get((cradle.balls, cradle.size))
        if other is None or not np.isfinite(cradle.hertz).all() or not cradle.v_post.size or not other.v_post.size:
            continue
        ours, theirs = (float(np.sqrt(np.mean((c.v_post - c.hertz) ** 2))) for c in (cradle, other))
        farther.append(ours > theirs + SAME)
        closer.append(ours < theirs - SAME)
        links += tuple(link for link in (cradle.link, other.link) if link not in links)
        key = f"{cradle.balls} balls, size {cradle.size:g}"
        numbers |= {f"qce, {key}": ours, f"gr, {key}": theirs}
        said.append((ours / theirs if theirs else math.inf, f"{key}: {ours:.3f} against {theirs:.3f}"))
    if not said:
        return _not_measured("disturbed cradles of qce and gr with a Hertz reference are needed")
    verdict = ClaimVerdict.PARTLY if any(closer) else ClaimVerdict.REFUTED
    if any(closer) and not any(farther):
        verdict = ClaimVerdict.CONFIRMED
    summary = (
        f"QCE is closer to Hertz in {sum(closer)} of {len(said)} cases and farther in {sum(farther)}; rms velocity "
        f"error of QCE against GR at worst {max(said)[1]}, at best {min(said)[1]}."
    )
    return Evidence(verdict, summary, numbers, links)


def _energy_error(results: Results) -> Evidence:
    """Mean of the paper's e over all single impacts of QCE."""
    rows = [row for row in results.scores_of("qce", "KIN") if is_energy_error(row) and not math.isnan(row.value)]
    if not rows:
        return _not_measured("no energy error of qce")
    values = np.array([abs(row.value) for row in rows])
    mean, largest = float(values.mean()), rows[int(values.argmax())]
    verdict = ClaimVerdict.CONFIRMED if mean <= PRINTED_ENERGY_ERROR else ClaimVerdict.REFUTED
    said = (
        f"Mean |K⁺ - K⁻|/K⁻ is {mean:.1e} over {len(rows)} scenes (largest {abs(largest.value):.1e}, "
        f"{largest.task.label}), against the printed {PRINTED_ENERGY_ERROR:.2e}; "
    )
    if mean < PRINTED_ENERGY_ERROR / 10:
        said += "an error as large as the printed one is the arithmetic's, not the law's."
    else:
        said += "the printed size is reproduced." if verdict is ClaimVerdict.CONFIRMED else "ours is larger."
    return Evidence(verdict, said, {"mean": mean, "largest": abs(largest.value)}, (largest.link,))


def is_energy_error(row: ScoreRow) -> bool:
    """True for the row that holds the paper's e = |K⁺ - K⁻| / K⁻ of one scene."""
    return row.metric.startswith("energy error")


def _entered_twice(results: Results) -> Evidence:
    """QCE with contacts entered twice must give what it gives with each once."""
    rows = [
        row
        for row in results.scores_of("qce", "invariance")
        if ("twice" in row.metric or "duplicate" in row.metric) and not math.isnan(row.value)
    ]
    if not rows:
        return _not_measured("no invariance row of qce with a contact entered twice")
    worst = max(rows, key=lambda row: row.value)
    same = [row.value <= SAME for row in rows]
    verdict = ClaimVerdict.CONFIRMED if all(same) else ClaimVerdict.PARTLY if any(same) else ClaimVerdict.REFUTED
    said = (
        f"The velocities change by up to {worst.value:.2g} of the pre-impact velocity ({worst.task.label}); "
        f"unchanged (to {SAME:g}) in {sum(same)} of {len(rows)} scenes."
    )
    return Evidence(verdict, said, {"largest change": worst.value, "unchanged": sum(same)}, (worst.link,))


def _terminates(results: Results) -> Evidence:
    """QCE's own stopping test passes on every scene that was planned for it."""
    tasks = [
        task for task in results.tasks_of("qce", kind=Kind.IMPACT) if task.done and task.outcome is not Outcome.REFUSED
    ]
    if not tasks:
        return _not_measured("no impact task of qce is done")
    ended = [task for task in tasks if task.status == "converged"]
    others = [task for task in tasks if task.status != "converged"]
    counts = [task.iterations for task in ended if task.iterations is not None]
    verdict = ClaimVerdict.CONFIRMED if not others else ClaimVerdict.PARTLY if ended else ClaimVerdict.REFUTED
    said = f"{len(ended)} of {len(tasks)} scenes end by the law's own test"
    numbers = {"converged": float(len(ended)), "scenes": float(len(tasks))}
    if counts:
        said += f", after {np.median(counts):g} iterations in the median and {max(counts)} at most"
        numbers |= {"median iterations": float(np.median(counts)), "largest iterations": float(max(counts))}
    if others:
        said += "; not: " + ", ".join(
            f"{task.label} ({task.status or (task.outcome and task.outcome.value) or 'open'})" for task in others[:5]
        )
        said += f" and {len(others) - 5} more" if len(others) > 5 else ""
    return Evidence(verdict, said + ".", numbers, tuple(f"task {task.task}" for task in others))


def solutions(results: Results, solver: str) -> Mapping[str, SeriesRow]:
    """The solver's single impacts: scenario label → its "solution" series."""
    return {row.task.label: row for row in results.series("solution", solver)}


def _velocity_change(one: SeriesRow, other: SeriesRow) -> float:
    """Largest difference of two outcomes of one scene, relative to the largest pre-impact velocity."""
    v_pre, v_one, v_other = (
        np.asarray(column, dtype=np.float64)
        for column in (one.columns["v_pre"], one.columns["v_post"], other.columns["v_post"])
    )
    scale = float(np.abs(v_pre).max(initial=0.0))
    return float(np.abs(v_one - v_other).max(initial=0.0)) / scale if scale > 0 else 0.0


def _restitution(row: SeriesRow) -> float:
    """Restitution of a scene whose family takes one number; 1 (elastic) where it names none, NaN for a list."""
    value = row.task.parameters.get("restitution", 1.0)
    return float(value) if isinstance(value, (int, float)) else math.nan


def _blend_solves(results: Results) -> Evidence:
    """The blend of the inelastic LCP and QCE against the solution of QCE-LCP."""
    blend, exact = solutions(results, "qce-blend"), solutions(results, "qce-lcp")
    # Velocities, not impulses: impulses are not unique where W is singular.
    shared = {
        label: _velocity_change(exact[label], blend[label])
        for label in sorted(blend.keys() & exact.keys())
        if _restitution(exact[label]) not in (0.0, 1.0)
    }
    if not shared:
        return _not_measured("no scene with 0 < c_r < 1 solved by both qce-blend and qce-lcp")
    worst = max(shared, key=lambda label: shared[label])
    same = sum(value <= SAME for value in shared.values())
    verdict = ClaimVerdict.CONFIRMED if same == len(shared) else ClaimVerdict.PARTLY if same else ClaimVerdict.REFUTED
    said = (
        f"The two agree (to {SAME:g}) in {same} of {len(shared)} scenes with 0 < c_r < 1; largest difference "
        f"{shared[worst]:.2g} of the pre-impact velocity ({worst})."
    )
    numbers = {"largest difference": shared[worst], "agreeing": float(same), "scenes": float(len(shared))}
    return Evidence(verdict, said, numbers, (blend[worst].link, exact[worst].link))


def _is_qce_when_elastic(results: Results) -> Evidence:
    """QCE-LCP at c_r = 1 against QCE."""
    law, qce = solutions(results, "qce-lcp"), solutions(results, "qce")
    shared = {
        label: _velocity_change(qce[label], law[label])
        for label in sorted(law.keys() & qce.keys())
        if _restitution(qce[label]) == 1.0
    }
    if not shared:
        return _not_measured("no elastic scene solved by both qce and qce-lcp")
    worst = max(shared, key=lambda label: shared[label])
    same = sum(value <= SAME for value in shared.values())
    verdict = ClaimVerdict.CONFIRMED if same == len(shared) else ClaimVerdict.PARTLY if same else ClaimVerdict.REFUTED
    said = (
        f"The two agree (to {SAME:g}) in {same} of {len(shared)} elastic scenes; largest difference "
        f"{shared[worst]:.2g} of the pre-impact velocity ({worst})."
    )
    return Evidence(verdict, said, {"largest difference": shared[worst]}, (law[worst].link, qce[worst].link))


def _energy_bounded(results: Results) -> Evidence:
    """No gated energy row of QCE-LCP gains."""
    rows = [
        row
        for row in results.scores_of("qce-lcp", "KIN")
        if row.gated and "gain" in row.metric and "friction" not in row.task.tags
    ]
    if not rows:
        return _not_measured("no gated energy row of qce-lcp without friction")
    failed = [row for row in rows if row.verdict is Verdict.FAIL]
    worst = max(rows, key=lambda row: row.value)
    verdict = ClaimVerdict.CONFIRMED if not failed else ClaimVerdict.REFUTED
    said = (
        f"{len(rows) - len(failed)} of {len(rows)} scenes gain no energy; largest gain {worst.value:.1e} of K⁻ "
        f"({worst.task.label})."
    )
    return Evidence(verdict, said, {"largest gain": worst.value, "failed": float(len(failed))}, (worst.link,))


def _friction_keeps_both(results: Results) -> Evidence:
    """QCE-LCP's gated SYM and KIN rows on the scenes with friction."""
    rows = [
        row
        for name in ("SYM", "KIN")
        for row in results.scores_of("qce-lcp", name)
        if row.gated and "friction" in row.task.tags
    ]
    if not rows:
        return _not_measured("no gated SYM or KIN row of qce-lcp on a scene with friction")
    failed = [row for row in rows if row.verdict is Verdict.FAIL]
    shown = {row.name: row for row in sorted(failed or rows, key=lambda row: row.value)}
    verdict = ClaimVerdict.REFUTED if failed else ClaimVerdict.CONFIRMED
    said = f"{len(rows) - len(failed)} of {len(rows)} rows pass; largest: " + "; ".join(
        f"{name} {row.metric} = {row.value:.2g} ({row.task.label})" for name, row in shown.items()
    )
    numbers = {name: row.value for name, row in shown.items()}
    return Evidence(verdict, said + ".", numbers, tuple(row.link for row in shown.values()))


def _cradle_exchange(results: Results) -> Evidence:
    """QCE's cradles against the ideal exchange."""
    found = [c for c in cradles(results, "qce") if np.isfinite(c.ideal).all()]
    if not found:
        return _not_measured("no cradles of qce")
    apart = {f"{c.moving} of {c.balls} moving": float(np.abs(c.v_post - c.ideal).max()) for c in found}
    hertz = max((float(np.abs(c.hertz - c.ideal).max()) for c in found), default=math.nan)
    share = sum(value <= SAME for value in apart.values()) / len(apart)
    verdict = ClaimVerdict.CONFIRMED if share == 1 else ClaimVerdict.PARTLY if share > 0 else ClaimVerdict.REFUTED
    worst = max(apart, key=lambda key: apart[key])
    said = f"Largest difference to the ideal exchange {apart[worst]:.2g} of the impact velocity ({worst})"
    if not math.isnan(hertz):
        said += f"; Hertz contact differs from the ideal by up to {hertz:.3f}"
    return Evidence(verdict, said + ".", apart | {"hertz to ideal": hertz}, (found[0].link,))


def _claims_of_table_1() -> tuple[Claim, ...]:
    """Table 1's 18 cells."""
    return tuple(
        Claim(
            f"table-1:{law}:{name}",
            PAPER,
            "Table 1",
            f"{law} {'satisfies' if PAPER_TABLE_1[law][name] else 'fails'} {name}",
            partial(_table_1, law=law, name=name),
        )
        for law in PAPER_TABLE_1
        for name in DESIDERATA
    )


CLAIMS: tuple[Claim, ...] = (
    *_claims_of_table_1(),
    Claim(
        "accuracy-over-va", PAPER, "Section 5.1, Fig. 4",
        "On the three-ball chain QCE is more accurate than GR and LCP for every va.", _more_accurate,
    ),
    Claim(
        "follows-theory", PAPER, "Section 5.1, Fig. 4",
        "QCE's velocities follow the theoretical curve for all va.", _follows_ideal,
    ),
    Claim(
        "exact-at-ends", PAPER, "Section 5.1, Fig. 4",
        "At va = 0 and va = v₀ QCE gives the theoretical outcome.", _exact_at_ends,
    ),
    Claim(
        "gr-is-lcp", PAPER, "Section 5.1, Fig. 4",
        "GR and LCP give the same result except at va = 0.", _gr_is_lcp,
    ),
    Claim(
        "ideal-is-hertz", PAPER, "Sections 5.1 and 5.5, Fig. 4",
        "The ideal exchange is the theoretical outcome: Hertz contact gives the same.", _ideal_is_hertz,
    ),
    Claim(
        "cradle-exchange", PAPER, "Section 5.2, Fig. 6",
        "QCE reproduces Newton's cradle: as many balls leave as arrive.", _cradle_exchange,
    ),
    Claim(
        "energy-error", PAPER, "Section 5.4",
        "QCE keeps the kinetic energy to a mean error of 2.43e-4.", _energy_error,
    ),
    Claim(
        "robust", PAPER, "Section 5.5, Fig. 12",
        "A small disturbance of the relative velocities has no influence on QCE's result.",
        partial(_continuous, solver="qce"),
    ),
    Claim(
        "gr-jumps", PAPER, "Section 5.5, Fig. 12",
        "GR's result is discontinuous: a small disturbance changes it much.", _gr_jumps,
    ),
    Claim(
        "closer-when-disturbed", PAPER, "Section 5.5, Fig. 12",
        "On the disturbed cradle QCE is more accurate than GR.", _closer_when_disturbed,
    ),
    Claim(
        "terminates", PAPER, "Section 6",
        "QCE's iteration ends in every scene.", _terminates,
    ),
    Claim(
        "elastic-limit", PAPER, "Section 4 and appendix, lemma",
        "QCE-LCP gives QCE's result at c_r = 1.", _is_qce_when_elastic,
    ),
    Claim(
        "blend", PAPER, "Appendix, theorem",
        "The blend (1 - c_r) λ_LCP + c_r λ_QCE solves QCE-LCP.", _blend_solves,
    ),
    Claim(
        "bounded", PAPER, "Appendix, theorem",
        "QCE-LCP never gains kinetic energy (without friction).", _energy_bounded,
    ),
    Claim(
        "friction-keeps", PAPER, "Section 4",
        "Friction in QCE-LCP breaks neither SYM nor KIN.", _friction_keeps_both,
    ),
    Claim(
        "sampling", OURS, "not in the paper; any law of rigid impact needs it",
        "QCE's result does not depend on how often one contact is entered.", _entered_twice,
    ),
    Claim(
        "defer-robust", OURS, "the variant qce-defer",
        "With contacts that hardly approach deferred, a small disturbance stays small.",
        partial(_continuous, solver="qce-defer"),
    ),
)  # fmt: skip
"""Every claim that is checked."""
