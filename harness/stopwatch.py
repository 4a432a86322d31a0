"""Times solves on request, in a process of its own: the solvers are those of the tree that PYTHONPATH names.

Run as a script by `harness.revision`, once for each tree. It uses only names that do not change from commit to commit
(`SOLVERS`, `CATALOG`, `choose_solver`). A request and its reply are a line of JSON each:

    {"solver": "qce", "scenario": "bernoulli", "parameters": {}, "solves": 20}      {"cpu_s": 1.3e-5}
                                                                                    {"reason": "refused: …"}
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

import solvers
from harness.selection import choose_solver
from scenarios import CATALOG
from solvers import SOLVERS, ImpactProblem, Solver, UnsupportedProblem


def main() -> None:
    """Answer requests until standard input ends."""
    replies = os.fdopen(os.dup(1), "w", encoding="utf-8")
    # What a solver prints must not stand among the replies.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    warm: dict[str, tuple[Solver, ImpactProblem]] = {}
    _say(replies, {"home": str(Path(solvers.__file__).resolve().parent.parent)})
    for line in sys.stdin:
        request = json.loads(line)
        try:
            _say(replies, {"cpu_s": _time(warm, request)})
        except UnsupportedProblem as refusal:
            _say(replies, {"reason": f"refused: {refusal}"})


def _time(warm: dict[str, tuple[Solver, ImpactProblem]], request: dict[str, object]) -> float:
    """CPU time of one solve [s], all threads together, averaged over the solves that were asked for."""
    name, scenario, parameters, solves = (request[key] for key in ("solver", "scenario", "parameters", "solves"))
    assert isinstance(name, str)
    assert isinstance(scenario, str)
    assert isinstance(parameters, dict)
    assert isinstance(solves, int)
    key = json.dumps([name, scenario, parameters], sort_keys=True)
    if key not in warm:
        solver = SOLVERS[name]() if name in SOLVERS else choose_solver(name).solver
        warm[key] = solver, CATALOG[scenario](**parameters).problem
        # Compiles the kernels and builds what the problem keeps.
        warm[key][0].solve(warm[key][1])
    solver, problem = warm[key]
    begin = time.process_time()
    for _ in range(solves):
        solver.solve(problem)
    return (time.process_time() - begin) / solves


def _say(replies: object, reply: dict[str, object]) -> None:
    """Send one reply at once."""
    replies.write(json.dumps(reply) + "\n")  # type: ignore[attr-defined]
    replies.flush()  # type: ignore[attr-defined]


if __name__ == "__main__":
    main()
