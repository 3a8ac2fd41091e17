"""The MPC of SPEC 3 and 4, stated once in CasADi for one junction, as a convex quadratic programme.

The model is SPEC 2 with its minimum relaxed: the leaving flow is at most each of the three terms. Frozen are the
delays, at what the last plan predicted, and where in the cycle the green stands, at what was planned last. The whole
network's problem is the sum of these problems under `inflow of a link as its consumer has it = outflow to it as its
producer has it`, which is what the agents coordinate.

Everything is in veh per model step and, for the cost, veh times control steps, times `ProblemSettings.scale`.
Junctions of the same structure share one CasADi function: Hessian and constraint pattern are found once, the loop then
only evaluates numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from utn_controllers.mpc.settings import ProblemSettings
from utn_sumo.contract import Floats, Ints, Network
from utn_sumo.model import CasadiOperations, LinkModel, LinkNumbers

REGULARISATION = 1e-3
"""Weight of the squared flows: makes the Hessian definite and the plan unique; 1e-3 veh a step at 1 veh."""


@dataclass(frozen=True)
class Pattern:
    """Where a constraint matrix has numbers, column by column (CSC)."""

    shape: tuple[int, int]
    rows: Ints
    columns: Ints
    starts: Ints
    """(columns + 1,) where each column begins."""


@dataclass(frozen=True)
class Layout:
    """Where an agent's variables sit in its decision vector; each (steps, n) of positions."""

    green: Ints
    leaving: Ints
    inflow: Ints
    over_storage: Ints
    """Of the links that a neighbour feeds: a source is never forced to take more than it holds."""
    size: int

    @classmethod
    def of(cls, part: Network, control_horizon: int, steps: int) -> Layout:
        """The layout for one junction's part of a network, over so many model steps."""
        links = len(part.links)
        start = 0

        def block(rows: int, columns: int) -> Ints:
            nonlocal start
            start += rows * columns
            return np.arange(start - rows * columns, start).reshape(rows, columns)

        green = block(control_horizon, len(part.stages))
        leaving, inflow = block(steps, len(part.turns)), block(steps, links)
        over = block(steps, int(np.count_nonzero(~part.is_source)))
        return cls(green, leaving, inflow, over, size=start)


@dataclass(frozen=True)
class Structure:
    """What decides the shape of a junction's problem."""

    settings: ProblemSettings
    step_s: float
    substeps: int
    """Model steps of a control step."""
    lags: int
    """Model steps back from which somebody can still be on the way."""
    turn_link: tuple[int, ...]
    turn_group: tuple[int, ...]
    stage_turns: tuple[tuple[int, ...], ...]
    is_source: tuple[bool, ...]
    example: Network = field(compare=False)
    """Any junction of this structure."""

    @classmethod
    def of(cls, part: Network, settings: ProblemSettings) -> Structure:
        """The structure of one junction's part of a network."""
        step_s = settings.step_s or part.control_step_s
        substeps = round(part.control_step_s / step_s)
        return cls(
            settings=ProblemSettings(
                **settings.model_dump(include=set(ProblemSettings.model_fields), exclude_unset=True)
            ),
            step_s=step_s,
            substeps=substeps,
            lags=min(int(np.ceil(part.free_time_s.max() / step_s)), settings.horizon * substeps),
            turn_link=tuple(part.turn_link.tolist()),
            turn_group=tuple(part.turn_group.tolist()),
            stage_turns=tuple(stage.turns for stage in part.stages),
            is_source=tuple(part.is_source.tolist()),
            example=part,
        )

    @cached_property
    def steps(self) -> int:
        """Model steps of the horizon."""
        return self.settings.horizon * self.substeps


class Statement:
    """The problem of a structure as CasADi functions of its numbers. Cut `of` a structure, once for all."""

    def __init__(self, structure: Structure):
        import casadi as ca  # noqa: PLC0415 - heavy

        self.structure = structure
        part, settings = structure.example, structure.settings
        self.layout = Layout.of(part, settings.control_horizon, structure.steps)
        z = ca.SX.sym("z", self.layout.size)
        parameters = self._symbols()
        cost, rows = self._predict(z, **parameters)
        expressions = ca.vertcat(*[row[0] for row in rows])
        side = [ca.vertcat(*[ca.repmat(ca.SX(row[end]), row[0].numel(), 1) for row in rows]) for end in (1, 2)]
        hessian, gradient = ca.hessian(cost, z)
        at_zero = ca.substitute(ca.vertcat(gradient, expressions, cost), z, ca.DM.zeros(self.layout.size))
        offset = at_zero[self.layout.size : -1]
        matrix = ca.jacobian(expressions, z)
        starts, filled = (np.array(part, dtype=np.int64) for part in matrix.sparsity().get_ccs())
        columns = np.repeat(np.arange(self.layout.size), np.diff(starts))
        self.pattern = Pattern(matrix.shape, filled, columns, starts)
        outputs = [
            at_zero[: self.layout.size],
            matrix.nz[:],
            side[0] - offset,
            side[1] - offset,
            at_zero[-1],
        ]
        flat = [ca.vertcat(*item) if isinstance(item, list) else item for item in parameters.values()]
        self.function = ca.Function("problem", [ca.vertcat(*flat)], [ca.densify(item) for item in outputs])
        self._curvature = ca.Function("curvature", [parameters["storage"]], [hessian])

    @classmethod
    def of(cls, structure: Structure) -> Statement:
        """The statement of a structure, made once."""
        return _statement(structure)

    def hessian(self, storage_veh: Floats) -> Floats:
        """The Hessian, which depends on nothing but the links' storage."""
        return np.array(self._curvature(storage_veh), dtype=float)

    def _symbols(self) -> dict[str, Any]:
        """The parameters, in the order in which `JunctionProblem` fills them in; lists run over steps or lags."""
        import casadi as ca  # noqa: PLC0415 - heavy

        structure = self.structure
        links, turns, stages = (len(each) for each in (structure.is_source, structure.turn_link, structure.stage_turns))

        def over(name: str, count: int, size: int) -> list[Any]:
            return [ca.SX.sym(f"{name}{index}", size) for index in range(count)]

        return {
            "x": ca.SX.sym("x", links),
            "q": ca.SX.sym("q", turns),
            "waiting": ca.SX.sym("waiting", links),
            "demand": over("demand", structure.steps, links),
            "disturbance": over("disturbance", structure.steps, links),
            "fraction": ca.SX.sym("fraction", turns),
            "share_in_green": over("share_in_green", structure.steps * (structure.lags + 1), turns),
            "still_in_green": over("still_in_green", structure.lags, turns),
            "shown": over("shown", structure.substeps, stages),
            "held": over("held", structure.substeps, turns),
            "opening": over("opening", structure.substeps, turns),
            "excess": ca.SX.sym("excess", links),
            "saturation": ca.SX.sym("saturation", turns),
            "storage": ca.SX.sym("storage", links),
            "room_share": ca.SX.sym("room_share", links),
            "remaining": ca.SX.sym("remaining", links),
            "budget": ca.SX.sym("budget", 1),
        }

    def _predict(
        self,
        z: Any,
        *,
        x: Any,
        q: Any,
        waiting: Any,
        demand: list[Any],
        disturbance: list[Any],
        fraction: Any,
        share_in_green: list[Any],
        still_in_green: list[Any],
        shown: list[Any],
        held: list[Any],
        opening: list[Any],
        excess: Any,
        saturation: Any,
        storage: Any,
        room_share: Any,
        remaining: Any,
        budget: Any,
    ) -> tuple[Any, list[tuple[Any, Any, Any]]]:
        """The horizon: (cost, rows), a row being (expression, lower, upper)."""
        import casadi as ca  # noqa: PLC0415 - heavy

        structure, layout = self.structure, self.layout
        settings, lags = structure.settings, structure.lags + 1
        kept = settings.constraints == "kept"
        scale, over_storage = settings.scale, settings.over_storage_cost(structure.steps)
        numbers = LinkNumbers(saturation, storage, room_share)
        model = LinkModel(structure.example, structure.step_s, CasadiOperations(), numbers)
        source = np.array(structure.is_source, dtype=float)
        fed = sp.csr_array(np.eye(len(source))[:, source == 0])
        cost: Any = 0
        rows = [(ca.sum1(z[green]), budget, budget) for green in layout.green] if kept else []
        inflows: list[Any] = []
        for step in range(structure.steps):
            control_step, substep = divmod(step, structure.substeps)
            green = z[layout.green[min(control_step, settings.control_horizon - 1)]]
            x = x + disturbance[step]
            leaving, inflow, over = z[layout.leaving[step]], z[layout.inflow[step]], z[layout.over_storage[step]]
            inflows = [inflow, *inflows][:lags]
            # Who can be in the queue before the green ends: everybody but those still on the way then. q holds who was
            # queued at first less who left; when who arrives joins it makes no difference to the sum.
            in_time = model.at_turns(x - model.by_link(q) + inflow)
            if step < structure.lags:
                in_time = in_time - still_in_green[step]
            for lag, entered in enumerate(inflows):
                in_time = in_time - share_in_green[step * lags + lag] * model.at_turns(entered)
            by_turn_s = model.operations.matmul(model.served, green * shown[substep]) + held[substep]
            # The three terms of SPEC 2.3, the third as the consumer's: it knows its storage.
            rows += [
                (leaving - q - fraction * in_time, -np.inf, 0.0),
                (leaving - model.saturated_veh(by_turn_s, fraction), -np.inf, 0.0),
            ]
            if kept:
                room = model.room_veh(x) + room_share * excess + model.by_link(opening[substep] * leaving)
                rows.append((inflow - model.operations.matmul(fed, over) - room, -np.inf, 0.0))
            q = q - leaving
            x = x + inflow - model.by_link(leaving)
            waiting = waiting + source * (demand[step] - inflow)
            rows += [(waiting[int(link)], 0.0, np.inf) for link in np.flatnonzero(source)]
            part_of_step = scale * settings.stage_cost(x, waiting, storage) + over_storage * ca.sum1(over)
            cost += part_of_step / structure.substeps
            cost += REGULARISATION / 2 * (ca.sumsqr(leaving) + ca.sumsqr(inflow) + ca.sumsqr(over))
        cost += scale * sum(settings.green_cost(z[green]) for green in layout.green)
        return cost + scale * settings.terminal_cost(x, waiting, remaining), rows


@cache
def _statement(structure: Structure) -> Statement:
    return Statement(structure)
