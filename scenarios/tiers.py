"""Which instances of the catalog a run tries: "smoke" in seconds, "default" for the scorecard, "full" without hurry.

"hard" is what laws break on. Each tier stands alone; "full" holds all of "default".
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

Instance: TypeAlias = tuple[str, dict[str, object]]


def _each(name: str, parameter: str, values: Sequence[object], **fixed: object) -> tuple[Instance, ...]:
    """One instance of a family for each value of a parameter."""
    return tuple((name, {parameter: value, **fixed}) for value in values)


_SMOKE: tuple[Instance, ...] = (
    ("three-ball-chain", {}),
    ("newtons-cradle", {}),
    ("bernoulli", {}),
    ("pool-break", {}),
    ("four-ball-circle", {}),
    ("box-on-floor", {}),
    ("ball-between-walls", {}),
    ("sphere-pack", {"spheres": 100}),
)

_CHAINS: tuple[Instance, ...] = (
    ("three-ball-chain", {"va": 0.0}),
    ("three-ball-chain", {"va": 0.25}),
    ("three-ball-chain", {}),
    ("three-ball-chain", {"va": 1.0}),
    ("three-ball-chain", {"restitution": 0.5}),
    ("three-ball-chain", {"restitution": 0.0}),
    ("three-ball-chain", {"masses": [1.0, 3.0, 2.0]}),
    ("three-ball-bounce", {}),
    ("newtons-cradle", {"balls": 3}),
    ("newtons-cradle", {}),
    ("newtons-cradle", {"moving": 2}),
    ("newtons-cradle", {"restitution": 0.5}),
    ("newtons-cradle", {"restitution": 0.0}),
    ("disturbed-cradle", {}),
    ("disturbed-cradle", {"size": 0.001, "seed": 1}),
    ("bead-column", {}),
    ("bead-column", {"start": "struck", "stiffness_ratio": 4.0}),
    ("mass-ratio-chain", {"mass_ratio": 1.0}),
    ("mass-ratio-chain", {"mass_ratio": 10.0}),
    ("mass-ratio-chain", {}),
    ("mass-ratio-chain", {"mass_ratio": 1000.0}),
    ("mass-ratio-chain", {"mass_ratio": 10000.0}),
    ("mass-ratio-chain", {"variant": "geometric"}),
)

_BILLIARDS: tuple[Instance, ...] = (
    ("bernoulli", {}),
    ("bernoulli", {"mass_ratio": 12.1}),
    ("bernoulli", {"mass_ratio": 23.3}),
    ("bernoulli", {"friction": 0.3}),
    ("pool-break", {}),
    ("pool-break", {"balls": 55}),
    ("pool-break", {"rack": "nine-ball"}),
    ("pool-break", {"rack": "nine-ball", "struck": "both"}),
    ("pool-break", {"struck": "both"}),
    ("pool-break", {"restitution": 0.9, "friction": 0.1}),
    ("four-ball-circle", {}),
    ("four-ball-circle", {"start": "inward"}),
    ("four-ball-circle", {"start": "outward"}),
)

_BOXES: tuple[Instance, ...] = (
    ("box-on-floor", {}),
    ("box-on-floor", {"points": 9}),
    ("box-on-floor", {"points": 9, "copies": 2}),
    ("box-on-floor", {"spin": [0.3, 0.2, 0.0]}),
    ("box-on-floor", {"points": 100, "spin": [0.3, 0.2, 0.0]}),
    ("box-on-floor", {"points": 1000}),
    ("box-on-floor", {"spin": [0.3, 0.2, 0.0], "restitution": 0.5}),
    ("box-on-floor", {"restitution": 0.0}),
    ("box-on-floor", {"points": 9, "slide": 1.0, "restitution": 0.5, "friction": 0.3}),
)

_JAMMED: tuple[Instance, ...] = (
    ("ball-between-walls", {}),
    ("ball-between-walls", {"balls": 3, "restitution": 0.5}),
    ("ball-ring", {}),
)

_PACKS: tuple[Instance, ...] = (
    ("sphere-pack", {}),
    ("sphere-pack", {"start": "hot"}),
    ("sphere-pack", {"start": "patch"}),
    ("sphere-pack", {"start": "hot", "restitution": 0.3}),
)

_MORE: tuple[Instance, ...] = (
    *_each("three-ball-chain", "va", (0.1, 0.4, 0.6, 0.75, 0.9)),
    *_each("newtons-cradle", "balls", (2, 4, 6, 8, 10, 15, 20)),
    *_each("newtons-cradle", "moving", (3, 4)),
    ("newtons-cradle", {"balls": 20, "moving": 7}),
    ("newtons-cradle", {"masses": [1.0, 2.0, 1.0, 2.0, 1.0]}),
    *_each("disturbed-cradle", "size", (1e-12, 1e-8, 1e-4, 0.1), seed=2),
    *_each("disturbed-cradle", "size", (1e-12, 1e-8, 1e-4, 0.1), seed=3),
    ("bead-column", {"beads": 20}),
    ("bead-column", {"stiffness_ratio": 0.25}),
    ("bead-column", {"restitution": 0.9}),
    ("mass-ratio-chain", {"mass_ratio": 1e6}),
    ("mass-ratio-chain", {"mass_ratio": 1e6, "variant": "geometric", "balls": 20}),
    ("bernoulli", {"restitution": 0.5}),
    ("bernoulli", {"restitution": 0.5, "friction": 0.2}),
    ("pool-break", {"balls": 55, "struck": "both"}),
    ("pool-break", {"balls": 210}),
    ("pool-break", {"rack": "nine-ball", "restitution": 0.9, "friction": 0.1}),
    ("four-ball-circle", {"restitution": 0.5}),
    ("box-on-floor", {"copies": 2}),
    ("box-on-floor", {"points": 9, "spin": [0.3, 0.2, 0.0]}),
    ("box-on-floor", {"points": 9, "spin": [0.3, 0.2, 0.0], "copies": 2}),
    ("box-on-floor", {"points": 1000, "spin": [0.3, 0.2, 0.0]}),
    ("box-on-floor", {"points": 100, "slide": 1.0, "restitution": 0.5, "friction": 0.3}),
    ("ball-between-walls", {"balls": 10}),
    ("ball-ring", {"start": "all"}),
    ("ball-ring", {"balls": 24}),
    *_each("sphere-pack", "seed", (1, 2), start="hot"),
    *_each("sphere-pack", "start", ("kick", "hot"), spheres=4000),
    ("sphere-pack", {"start": "hot", "restitution": 0.3, "friction": 0.2}),
)

HARD = "hard"
"""Tier of the hard cases: one solve each, and what it came to."""

HARD_CASES: dict[str, tuple[Instance, ...]] = {
    "mass ratios to 1e12": (
        ("mass-ratio-chain", {"mass_ratio": 1e6}),
        ("mass-ratio-chain", {"mass_ratio": 1e12}),
        ("mass-ratio-chain", {"mass_ratio": 1e12, "variant": "geometric"}),
        ("heavy-and-light", {"mass_ratio": 1e4}),
        ("heavy-and-light", {"mass_ratio": 1e12}),
        ("heavy-and-light", {"mass_ratio": 1e12, "arrangement": "alternating"}),
        ("heavy-and-light", {"mass_ratio": 1e12, "arrangement": "light-striker"}),
    ),
    "long chains": (
        ("long-chain", {"balls": 1000}),
        ("long-chain", {"balls": 1000, "start": "converging"}),
        ("long-chain", {"balls": 1000, "restitution": 0.0}),
        ("long-chain", {"balls": 100_000}),
        ("long-chain", {"balls": 100_000, "start": "converging"}),
        ("long-chain", {"balls": 100_000, "restitution": 0.0}),
    ),
    "W without full rank": (
        ("box-on-floor", {"points": 4, "spin": [0.3, 0.2, 0.0]}),
        ("box-on-floor", {"points": 100, "spin": [0.3, 0.2, 0.0]}),
        ("box-on-floor", {"points": 100, "copies": 2, "spin": [0.3, 0.2, 0.0], "restitution": 0.5}),
        ("box-on-floor", {"points": 1000, "spin": [0.3, 0.2, 0.0]}),
        ("box-on-floor", {"points": 1000, "spin": [0.3, 0.2, 0.0], "restitution": 0.5, "friction": 0.3}),
    ),
    "squeezed from all sides": (
        *_each("ball-between-walls", "balls", (1, 3, 10)),
        ("ball-between-walls", {"balls": 3, "restitution": 0.5}),
        ("ball-ring", {"balls": 8}),
        ("ball-ring", {"balls": 8, "start": "all"}),
        ("ball-ring", {"balls": 24, "restitution": 0.5}),
        ("jammed-box", {"rows": 3}),
        ("jammed-box", {"rows": 3, "start": "all"}),
        ("jammed-box", {"rows": 8, "columns": 8}),
        ("jammed-box", {"rows": 8, "columns": 8, "restitution": 0.5}),
        ("jammed-box", {"rows": 8, "columns": 8, "restitution": 0.0}),
    ),
    "disturbances from 1e-16 to 1e-1": (
        ("three-ball-chain", {"va": 1e-16}),
        ("three-ball-chain", {"va": 1e-8}),
        *_each("disturbed-cradle", "size", (1e-16, 1e-13, 1e-10, 1e-7, 1e-4, 1e-2, 1e-1), balls=5),
    ),
    "normals nearly parallel or opposed": (
        ("ball-in-wedge", {"angle": 1e-3}),
        ("ball-in-wedge", {"angle": 1e-8}),
        ("ball-in-wedge", {"angle": 1e-6, "planes": 10}),
        ("ball-in-wedge", {"angle": 1e-6, "planes": 10, "restitution": 0.5}),
        ("ball-in-wedge", {"angle": 1e-2, "normals": "opposed"}),
        ("ball-in-wedge", {"angle": 1e-4, "normals": "opposed"}),
    ),
    "no contact approaches, or there is none": (
        ("long-chain", {"balls": 100, "start": "separating"}),
        ("long-chain", {"balls": 100, "start": "together"}),
        ("long-chain", {"balls": 1}),
    ),
    "restitution 0, 1 and between, by contact": (
        ("three-ball-chain", {"va": 0.5, "restitution": 0.0}),
        ("three-ball-chain", {"va": 0.5, "restitution": 1e-6}),
        ("three-ball-chain", {"va": 0.5, "restitution": 0.5}),
        *_each("mixed-restitution", "scene", ("struck", "converging", "column", "triangle")),
    ),
    "stacks at rest": (
        *_each("resting-stack", "restitution", (0.0, 0.5), height=10),
        ("resting-stack", {"height": 10}),
        *_each("resting-stack", "restitution", (0.0, 0.5), height=6, shape="pyramid"),
        ("resting-stack", {"height": 6, "shape": "pyramid"}),
    ),
    "inelastic collapse": (
        ("inelastic-collapse", {"balls": 3}),
        ("inelastic-collapse", {"balls": 3, "restitution": 0.0}),
        ("inelastic-collapse", {"balls": 20, "restitution": 0.5}),
    ),
}
"""What is hard → its instances, with the parameters in the form in which `Scenario.parameters` has them."""

_HARD = tuple(instance for instances in HARD_CASES.values() for instance in instances)

_DEFAULT = (*_CHAINS, *_BILLIARDS, *_BOXES, *_JAMMED, *_PACKS)

TIERS: dict[str, tuple[Instance, ...]] = {
    "smoke": _SMOKE,
    "default": _DEFAULT,
    "full": (*_DEFAULT, *_MORE),
    HARD: _HARD,
}
"""Tier → (family, parameters) of each instance."""
