"""The catalog of impacts: each family is a function of its parameters that returns a `Scenario`."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping

from scenarios.billiards import bernoulli, four_ball_circle, pool_break
from scenarios.chains import disturbed_cradle, newtons_cradle, three_ball_bounce, three_ball_chain
from scenarios.columns import bead_column, mass_ratio_chain
from scenarios.hard import (
    ball_in_wedge,
    heavy_and_light,
    inelastic_collapse,
    jammed_box,
    long_chain,
    mixed_restitution,
    resting_stack,
)
from scenarios.jammed import ball_between_walls, ball_ring
from scenarios.packs import sphere_pack
from scenarios.redundant import box_on_floor
from scenarios.scenario import Invariant, Quantity, Reference, ReferenceKind, Scenario, Symmetry
from scenarios.tiers import TIERS

CATALOG: dict[str, Callable[..., Scenario]] = {
    "ball-between-walls": ball_between_walls,
    "ball-in-wedge": ball_in_wedge,
    "ball-ring": ball_ring,
    "bead-column": bead_column,
    "bernoulli": bernoulli,
    "box-on-floor": box_on_floor,
    "disturbed-cradle": disturbed_cradle,
    "four-ball-circle": four_ball_circle,
    "heavy-and-light": heavy_and_light,
    "inelastic-collapse": inelastic_collapse,
    "jammed-box": jammed_box,
    "long-chain": long_chain,
    "mass-ratio-chain": mass_ratio_chain,
    "mixed-restitution": mixed_restitution,
    "newtons-cradle": newtons_cradle,
    "pool-break": pool_break,
    "resting-stack": resting_stack,
    "sphere-pack": sphere_pack,
    "three-ball-bounce": three_ball_bounce,
    "three-ball-chain": three_ball_chain,
}
"""Name → scenario family. Adding one is one file and one line here."""


def describe(name: str, families: Mapping[str, Callable[..., object]] = CATALOG) -> tuple[str, str]:
    """A family as a call with its defaults, and what it is: the first line of its docstring."""
    family = families[name]
    parameters = inspect.signature(family).parameters.values()
    call = ", ".join(f"{parameter.name}={parameter.default!r}" for parameter in parameters)
    return f"{name}({call})", (inspect.getdoc(family) or "").partition("\n")[0]


__all__ = [
    "CATALOG", "TIERS", "Invariant", "Quantity", "Reference", "ReferenceKind", "Scenario", "Symmetry", "describe",
]  # fmt: skip
