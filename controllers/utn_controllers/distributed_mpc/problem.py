"""The MPC of SPEC 3 and 4, stated once in CasADi for one junction, as a convex quadratic programme.

The model is SPEC 2 with its minimum relaxed: the leaving flow is at most each of the three terms, and the delay is
frozen at its present value. The whole network's problem is the sum of these problems under `inflow of a link as
its consumer has it = outflow to it as its producer has it`, which is what the agents coordinate.

Everything is in veh per control step and, for the cost, veh times control steps. CasADi derives Hessian and
constraint matrix once; the loop then only evaluates numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from utn_controllers.distributed_mpc.settings import Settings
from utn_sumo.contract import Floats, Forecast, Network, State
from utn_sumo.model import CasadiOperations, LinkModel

REGULARISATION = 1e-3
"""Weight of the squared flows: makes the Hessian definite and the plan unique; 1e-3 veh a step at 1 veh."""
STORAGE_PENALTY = 20.0
"""Cost of a vehicle over storage for one step. Exact: far above the 1 + horizon that holding it elsewhere costs."""


@dataclass(frozen=True)
class QuadraticProgram:
    """min 1/2 z'Hz + f'z  s.t.  lower <= (z, Az) <= upper, simple bounds first."""

    hessian: Floats
    gradient: Floats
    matrix: Floats
    lower: Floats
    upper: Floats
    constant: float


@dataclass(frozen=True)
class Layout:
    """Where an agent's variables sit in its decision vector; each (steps, n) of positions."""

    green: npt.NDArray[np.int64]
    leaving: npt.NDArray[np.int64]
    inflow: npt.NDArray[np.int64]
    over_storage: npt.NDArray[np.int64]
    size: int

    @classmethod
    def of(cls, part: Network, settings: Settings) -> Layout:
        """The layout for one junction's part of a network."""
        shapes = [
            (settings.control_horizon, len(part.stages)),
            (settings.horizon, len(part.turns)),
            (settings.horizon, len(part.links)),
            (settings.horizon, len(part.links)),
        ]
        blocks, start = [], 0
        for shape in shapes:
            count = shape[0] * shape[1]
            blocks.append(np.arange(start, start + count).reshape(shape))
            start += count
        return cls(*blocks, size=start)


class JunctionProblem:
    """The problem of one junction: numbers in (state, forecast), quadratic programme out."""

    def __init__(self, network: Network, junction: int, settings: Settings):
        self.network = network
        self.junction = junction
        self.settings = settings
        self.part = network.part(junction)
        self.links = np.flatnonzero(network.link_junction == junction)
        self.turns = np.flatnonzero(np.isin(network.turn_link, self.links))
        self.stages = np.array(network.junctions[junction].stages)
        self.layout = Layout.of(self.part, settings)
        self.model = LinkModel(self.part, network.control_step_s, CasadiOperations())
        self._numbers = LinkModel(self.part, network.control_step_s)
        self._lags = network.delay_steps
        self.model.lags = self._numbers.lags = self._lags
        self._bind(self._state_problem())

    def consumed(self) -> list[int]:
        """Links of this junction that a neighbour feeds."""
        return [int(link) for link in self.links if not self.network.links[link].is_source]

    def produced(self) -> list[int]:
        """Links that this junction feeds."""
        return sorted({int(link) for link in self.network.turn_next[self.turns] if link >= 0})

    def inflow_rows(self, link: int) -> Floats:
        """(Kp, n) matrix that picks the consumer's copy of the inflow of one of its links."""
        rows = np.zeros((self.settings.horizon, self.layout.size))
        position = int(np.flatnonzero(self.links == link)[0])
        rows[np.arange(self.settings.horizon), self.layout.inflow[:, position]] = 1
        return rows

    def outflow_rows(self, link: int) -> Floats:
        """(Kp, n) matrix that adds up the flows of this junction into `link`."""
        rows = np.zeros((self.settings.horizon, self.layout.size))
        for position in np.flatnonzero(self.network.turn_next[self.turns] == link):
            rows[np.arange(self.settings.horizon), self.layout.leaving[:, position]] = 1
        return rows

    def program(self, state: State, forecast: Forecast) -> QuadraticProgram:
        """The quadratic programme for this state."""
        q = state.q_veh[self.turns]
        queue = self._numbers.leaves @ q
        share = self._numbers.on_the_way(self._numbers.delay_s(queue))
        parameters = np.concatenate(
            [
                state.x_veh[self.links],
                q,
                state.source_queue_veh[self.links],
                state.past_inflow_veh[: self._lags, self.links].ravel(),
                forecast.demand_veh[: self.settings.horizon, self.links].ravel(),
                np.concatenate(share),
                self.network.fraction[self.turns],
            ]
        )
        self._parameters[:] = parameters
        self._run()
        constant = float(self._results[-1][0])
        hessian, gradient, matrix, lower, upper = (array.copy() for array in self._results[:-1])
        return QuadraticProgram(hessian, gradient, matrix, lower, upper, constant)

    def greens(self, solution: Floats) -> Floats:
        """(Kc, S of this junction) greens [s] of a solution."""
        return solution[self.layout.green]

    def _bind(self, function: Any) -> None:
        """Tie a CasADi function to arrays of ours: calling it then costs its arithmetic and nothing else."""
        self._parameters = np.zeros(function.size1_in(0))
        shapes = [function.size_out(i) for i in range(function.n_out())]
        # CasADi writes dense outputs by column: Fortran order; vectors come out flat.
        self._results = [np.zeros(shape, order="F") if shape[1] > 1 else np.zeros(shape[0]) for shape in shapes]
        self._function = function
        self._buffer, self._run = function.buffer()
        self._buffer.set_arg(0, memoryview(self._parameters))
        for position, array in enumerate(self._results):
            self._buffer.set_res(position, memoryview(array.T if array.ndim == 2 else array))

    def _state_problem(self) -> Any:
        """CasADi function: parameters -> Hessian, gradient, constraint matrix, bounds, constant."""
        import casadi as ca  # noqa: PLC0415 - heavy

        settings, part, model = self.settings, self.part, self.model
        links, turns = len(part.links), len(part.turns)
        z = ca.SX.sym("z", self.layout.size)

        def parameter(name: str, *shape: int) -> Any:
            symbol = ca.SX.sym(name, int(np.prod(shape)))
            parameters.append(symbol)
            return symbol if len(shape) == 1 else ca.vertsplit(symbol, shape[1])

        parameters: list[Any] = []
        x = parameter("x", links)
        q = parameter("q", turns)
        waiting = parameter("w", links)
        past = parameter("past", self._lags, links)
        demand = parameter("demand", settings.horizon, links)
        share = parameter("share", self._lags, links)
        fraction = parameter("fraction", turns)

        source = part.is_source.astype(float)
        serves = part.serves.T.astype(float)
        cost: Any = 0
        rows: list[tuple[Any, Any, Any]] = []
        budget = float(part.green_budget_s[0])
        for step in range(settings.control_horizon):
            rows.append((ca.sum1(z[self.layout.green[step]]), budget, budget))
        for step in range(settings.horizon):
            green = z[self.layout.green[min(step, settings.control_horizon - 1)]]
            leaving = z[self.layout.leaving[step]]
            inflow = z[self.layout.inflow[step]]
            over = z[self.layout.over_storage[step]]
            moving = x - model.operations.matmul(model.leaves, q)
            arriving = model.arriving_veh(moving, inflow, past, share)
            unsaturated = q + fraction * model.operations.matmul(model.leaves.T, arriving)
            turn_green = model.operations.matmul(serves, green)
            rows.append((leaving - unsaturated, -np.inf, 0))
            rows.append((leaving - model.saturated_veh(turn_green, fraction), -np.inf, 0))
            rows.append((inflow - over - model.room_veh(x), -np.inf, 0))
            q = unsaturated - leaving
            x = x + inflow - model.operations.matmul(model.leaves, leaving)
            waiting = waiting + source * (demand[step] - inflow)
            for link in np.flatnonzero(part.is_source):
                rows.append((waiting[int(link)], 0, np.inf))
            past = [inflow, *past[:-1]]
            cost += settings.stage_cost(x, waiting, part) + STORAGE_PENALTY * ca.sum1(over)
            cost += REGULARISATION / 2 * (ca.sumsqr(leaving) + ca.sumsqr(inflow) + ca.sumsqr(over))
            if step < settings.control_horizon:
                cost += settings.green_cost(green)
        expressions = ca.vertcat(*[row[0] for row in rows])
        lower = ca.vertcat(*[ca.repmat(ca.DM(row[1]), row[0].numel(), 1) for row in rows])
        upper = ca.vertcat(*[ca.repmat(ca.DM(row[2]), row[0].numel(), 1) for row in rows])

        hessian, gradient = ca.hessian(cost, z)
        matrix = ca.jacobian(expressions, z)
        at_zero = ca.substitute(
            ca.vertcat(gradient, expressions, cost), z, ca.DM.zeros(self.layout.size)
        )
        size = self.layout.size
        offset = at_zero[size : size + expressions.numel()]
        bounds = self._simple_bounds()
        outputs = [
            hessian,
            at_zero[:size],
            matrix,
            ca.vertcat(bounds[0], lower - offset),
            ca.vertcat(bounds[1], upper - offset),
            at_zero[-1],
        ]
        return ca.Function("problem", [ca.vertcat(*parameters)], [ca.densify(ca.SX(item)) for item in outputs])

    def _simple_bounds(self) -> tuple[Floats, Floats]:
        lower, upper = np.zeros(self.layout.size), np.full(self.layout.size, np.inf)
        least = self.part.min_green_s
        lower[self.layout.green] = least
        # What the cycle leaves when every other stage has its least (SPEC 3).
        upper[self.layout.green] = self.part.green_budget_s[0] - (least.sum() - least)
        return lower, upper
