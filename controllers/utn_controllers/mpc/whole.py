"""The same problem solved whole: the junctions' problems side by side under equal flows at every interaction.

What the agents' coordination is measured against. PIQP solves it, another algorithm than the agents' own.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from utn_controllers.mpc.problem import JunctionProblem, Timing
from utn_sumo.contract import Floats, Forecast, State
from utn_sumo.errors import ControllerError


def optimum(
    problems: Sequence[JunctionProblem],
    state: State,
    forecast: Forecast,
    timing: Timing,
    greens: Floats | None = None,
) -> tuple[float, list[Floats]]:
    """Least cost of the whole network and each junction's solution.

    With `greens` (Kc, S) given, the greens are fixed at these: the cost that a plan leads to when the flows under it
    are the best possible ones. Raises ControllerError if the solver finds no optimum.
    """
    import piqp  # noqa: PLC0415 - compiled, loaded at use
    import scipy.sparse as sp  # noqa: PLC0415 - heavy

    programs = [problem.program(state, forecast, timing) for problem in problems]
    sizes = [problem.layout.size for problem in problems]
    starts = np.concatenate([[0], np.cumsum(sizes)])
    lower_box = np.concatenate([program.lower[:size] for program, size in zip(programs, sizes, strict=True)])
    upper_box = np.concatenate([program.upper[:size] for program, size in zip(programs, sizes, strict=True)])
    lower = np.concatenate([program.lower[size:] for program, size in zip(programs, sizes, strict=True)])
    upper = np.concatenate([program.upper[size:] for program, size in zip(programs, sizes, strict=True)])
    rows = sp.block_diag([program.matrix for program in programs], format="csr")
    coupling = sp.csr_matrix(_coupling(problems, starts))

    if greens is not None:
        for problem, start in zip(problems, starts[:-1], strict=True):
            columns = start + problem.layout.green
            lower_box[columns] = upper_box[columns] = greens[:, problem.stages]
        budget = lower == upper
        rows, lower, upper = rows[~budget], lower[~budget], upper[~budget]
    equal = lower == upper
    solver = piqp.SparseSolver()
    solver.settings.eps_abs = solver.settings.eps_rel = 1e-9
    solver.setup(
        sp.block_diag([program.hessian for program in programs], format="csc"),
        np.concatenate([program.gradient for program in programs]),
        sp.vstack([coupling, rows[equal]], format="csc"),
        np.concatenate([np.zeros(coupling.shape[0]), upper[equal]]),
        rows[~equal].tocsc(),
        lower[~equal],
        upper[~equal],
        lower_box,
        upper_box,
    )
    status = solver.solve()
    if status != piqp.PIQP_SOLVED:
        raise ControllerError(f"the whole problem has no optimum ({status})")
    cost = solver.result.info.primal_obj + sum(program.constant for program in programs)
    return float(cost), [solver.result.x[start : start + size] for start, size in zip(starts, sizes, strict=False)]


def _coupling(problems: Sequence[JunctionProblem], starts: Floats) -> Floats:
    """Rows that say: inflow of a link, as its consumer has it, less the outflow to it, as its producer has it, is 0."""
    consumer = {link: place for place, problem in enumerate(problems) for link in problem.consumed()}
    producer = {link: place for place, problem in enumerate(problems) for link in problem.produced()}
    blocks = []
    for link, place in sorted(consumer.items()):
        block = np.zeros((problems[place].steps, int(starts[-1])))
        for owner, rows, sign in (
            (place, problems[place].inflow_rows(link), 1.0),
            (producer[link], problems[producer[link]].outflow_rows(link), -1.0),
        ):
            block[:, int(starts[owner]) : int(starts[owner + 1])] += sign * rows
        blocks.append(block)
    return np.vstack(blocks)
