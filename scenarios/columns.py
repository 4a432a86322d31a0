"""Columns on a fixed floor or wall, one velocity a ball, upward positive; ball 0 touches the floor.

u_0 = v_0,   u_i = v_i - v_{i-1}      the floor turns a wave back into the column
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import scipy.sparse as sp

from scenarios.contacts import linear_momenta
from scenarios.parameters import check_choice, check_count, check_number, check_positive, given
from scenarios.references import (
    billiard_iterations,
    billiard_sweeps,
    billiard_velocity,
    hertz,
    ideal_exchange_on_wall,
    single_contact,
    tapered_chain,
)
from scenarios.scenario import Invariant, Reference, Scenario
from solvers import ImpactProblem, ProblemError
from solvers.solution import Floats


def bead_column(
    *, beads: int = 5, start: str = "falling", stiffness_ratio: float = 1.0, restitution: float = 1.0
) -> Scenario:
    """A column of touching beads on a wall.

    Args:
        beads: number of equal beads, ≥ 1.
        start: "falling": the whole column comes down with speed 1, so that only the wall is approached; "struck": the
            column rests on the wall and its top bead comes down with speed 1.
        stiffness_ratio: stiffness of the contact with the wall over that between beads, > 0. Rigid laws do not see it.
        restitution: of all contacts, in [0, 1].

    Source: the experiment of Falcon et al. 1998, "Collision of a 1-D column of beads with a wall".

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_count("beads", beads, 1)
    check_choice("start", start, ("falling", "struck"))
    check_positive("stiffness_ratio", stiffness_ratio)
    check_number("restitution", restitution, low=0.0, high=1.0)
    v_pre = np.full(beads, -1.0)
    if start == "struck":
        v_pre[:-1] = 0.0
    stiffness = np.ones(beads)
    stiffness[0] = stiffness_ratio
    problem = ImpactProblem(np.ones(beads), _column(beads), v_pre, restitution, stiffness=stiffness)
    builders: list[Callable[[], Reference]] = []
    if beads == 1:
        builders.append(partial(single_contact, problem))
    elif restitution == 1.0:
        builders += [partial(ideal_exchange_on_wall, problem), partial(hertz, problem)]
    return Scenario(
        "bead-column",
        given(bead_column, locals()),
        problem,
        "Falcon et al. 1998",
        reference_builders=tuple(builders),
        tags=frozenset({"chain", "wall"}),
    )


def mass_ratio_chain(
    *, mass_ratio: float = 100.0, variant: str = "floor", balls: int | None = None, restitution: float = 1.0
) -> Scenario:
    """Unequal masses: a light ball between the floor and a heavy one, or a chain whose masses fall geometrically.

    Args:
        mass_ratio: heaviest mass over the lightest (1 kg), ≥ 1.
        variant: "floor": the light ball rests on the floor and the heavy one comes down on it with speed 1; exactly
            ⌈π / arctan(1/√M)⌉ - 1 impacts follow (3, 10, 31, 99, 314 for M = 1, 10, 100, 10³, 10⁴), which no tolerance
            shortens. "geometric": a free chain from the heaviest ball, which comes with speed 1, to the lightest.
        balls: of the geometric chain, ≥ 2 (None: 5); the floor variant has always 2.
        restitution: of all contacts, in [0, 1].

    Source: Galperin 2003, "Playing pool with π"; the chain is chosen here.

    Raises:
        ProblemError: names the parameter and the rule.
    """
    check_number("mass_ratio", mass_ratio, low=1.0)
    check_choice("variant", variant, ("floor", "geometric"))
    chain = 5 if balls is None else balls
    check_count("balls", chain, 2)
    if variant == "floor" and balls not in (None, 2):
        raise ProblemError(f"balls must be 2 (or None) with variant 'floor', not {balls}")
    check_number("restitution", restitution, low=0.0, high=1.0)
    invariants: tuple[Invariant, ...] = ()
    builders: list[Callable[[], Reference]] = []
    if variant == "floor":
        problem = ImpactProblem(1.0 / np.array([1.0, mass_ratio]), _column(2), np.array([0.0, -1.0]), restitution)
        if restitution == 1.0:
            builders += [
                partial(build, mass_ratio) for build in (billiard_velocity, billiard_iterations, billiard_sweeps)
            ]
    else:
        masses = _falling_masses(mass_ratio, chain)
        v_pre = np.zeros(chain)
        v_pre[0] = 1.0
        problem = ImpactProblem(1.0 / masses, _column(chain)[1:], v_pre, restitution)
        invariants = linear_momenta(chain, 1, "x")
        if restitution == 1.0:
            builders.append(partial(tapered_chain, masses))
    if restitution == 1.0:
        builders.append(partial(hertz, problem))
    return Scenario(
        "mass-ratio-chain",
        given(mass_ratio_chain, locals()),
        problem,
        "Galperin 2003" if variant == "floor" else "chosen here: masses in geometric progression",
        reference_builders=tuple(builders),
        invariants=invariants,
        tags=frozenset({"chain", "mass-ratio"} | ({"wall"} if variant == "floor" else set())),
    )


def _column(balls: int) -> sp.csr_array:
    """Jacobian of a column on a floor: contact 0 with the floor, contact i between balls i - 1 and i."""
    return sp.csr_array(sp.diags_array([np.ones(balls), -np.ones(balls - 1)], offsets=[0, -1], shape=(balls, balls)))


def _falling_masses(mass_ratio: float, balls: int) -> Floats:
    """Masses [kg] in geometric progression from `mass_ratio` to 1."""
    return np.asarray(mass_ratio ** (np.arange(balls)[::-1] / (balls - 1)), dtype=np.float64)
