"""The moving scenes by name: each is a function of its parameters that returns a `MovingScene`.

world = MOVING["extended-pattern"](pattern="stripes").world(solver="qce-lcp-fast", seed=1)
report = world.step()
"""

from __future__ import annotations

from collections.abc import Callable

from scenarios.bunnies import bunnies_and_pawns
from scenarios.card_house import card_house
from scenarios.granular import extended_pattern, granular_shake
from scenarios.moving_billiards import four_balls_in_motion, pool_break_in_motion
from scenarios.pendulums import cradle_3d
from scenarios.rube_goldberg import rube_goldberg
from scenarios.world.moving_scene import MovingScene

MOVING: dict[str, Callable[..., MovingScene]] = {
    "bunnies-and-pawns": bunnies_and_pawns,
    "card-house": card_house,
    "cradle-3d": cradle_3d,
    "extended-pattern": extended_pattern,
    "four-ball-circle": four_balls_in_motion,
    "granular-shake": granular_shake,
    "pool-break": pool_break_in_motion,
    "rube-goldberg": rube_goldberg,
}
"""Name → family of moving scenes. Adding one is one file and one line here."""
