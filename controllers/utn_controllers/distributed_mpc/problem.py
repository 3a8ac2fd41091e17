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
        steps, links = settings.horizon, len(part.links)
        start = 0

        def block(rows: int, columns: int) -> npt.NDArray[np.int64]:
            nonlocal start
            start += rows * columns
            return np.arange(start - rows * columns, start).reshape(rows, columns)

        green = block(settings.control_horizon, len(part.stages))
        leaving, inflow, over = block(steps, len(part.turns)), block(steps, links), block(steps, links)
        return cls(green, leaving, inflow, over, size=start)


def remaining_steps(network: Network) -> Floats:
    """(Z,) control steps that a vehicle on each link still needs to leave the network.

    Free travel and half a cycle's wait on each link of its expected way, summed by the turning fractions.
    """
    own = network.free_time_s / network.control_step_s + 0.5
    fed = np.flatnonzero(network.turn_next >= 0)
    onward = np.zeros((len(network.links), len(network.links)))
    np.add.at(onward, (network.turn_link[fed], network.turn_next[fed]), network.fraction[fed])
    return np.asarray(np.linalg.solve(np.eye(len(network.links)) - onward, own), dtype=float)


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
        self._remaining = remaining_steps(network)[self.links]
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
        # A miscount must not leave more on the way than there is: the first step would have no feasible flow.
        past = state.past_inflow_veh[: self._lags, self.links]
        still = np.sum([part * inflow for part, inflow in zip(share[1:], past, strict=False)], axis=0)
        moving = np.maximum(state.x_veh[self.links] - queue, 0.0)
        past = past * np.minimum(1.0, moving / np.maximum(still, 1e-9))
        parameters = np.concatenate(
            [
                state.x_veh[self.links],
                q,
                state.source_queue_veh[self.links],
                past.ravel(),
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
        self._buffer.set_arg(0, memoryview(self._parameters.data))
        for position, array in enumerate(self._results):
            self._buffer.set_res(position, memoryview(array.T.data))

    def _state_problem(self) -> Any:
        """CasADi function: parameters -> Hessian, gradient, constraint matrix, bounds, constant."""
        import casadi as ca  # noqa: PLC0415 - heavy

        size = self.layout.size
        z = ca.SX.sym("z", size)
        parameters = self._symbols()
        cost, rows = self._predict(z, **parameters)
        expressions = ca.vertcat(*[row[0] for row in rows])
        lower, upper = (
            ca.vertcat(*[ca.repmat(ca.DM(row[side]), row[0].numel(), 1) for row in rows]) for side in (1, 2)
        )
        hessian, gradient = ca.hessian(cost, z)
        at_zero = ca.substitute(ca.vertcat(gradient, expressions, cost), z, ca.DM.zeros(size))
        offset = at_zero[size:-1]
        box = self._simple_bounds()
        outputs = [
            hessian,
            at_zero[:size],
            ca.jacobian(expressions, z),
            ca.vertcat(box[0], lower - offset),
            ca.vertcat(box[1], upper - offset),
            at_zero[-1],
        ]
        flat = [ca.vertcat(*item) if isinstance(item, list) else item for item in parameters.values()]
        return ca.Function("problem", [ca.vertcat(*flat)], [ca.densify(ca.SX(item)) for item in outputs])

    def _symbols(self) -> dict[str, Any]:
        """The problem's parameters, in the order in which `program` fills them in; lists run over steps or lags."""
        import casadi as ca  # noqa: PLC0415 - heavy

        links, turns = len(self.part.links), len(self.part.turns)

        def over(name: str, count: int) -> list[Any]:
            return [ca.SX.sym(f"{name}{index}", links) for index in range(count)]

        return {
            "x": ca.SX.sym("x", links),
            "q": ca.SX.sym("q", turns),
            "waiting": ca.SX.sym("waiting", links),
            "past": over("past", self._lags),
            "demand": over("demand", self.settings.horizon),
            "share": over("share", self._lags),
            "fraction": ca.SX.sym("fraction", turns),
        }

    def _predict(
        self,
        z: Any,
        *,
        x: Any,
        q: Any,
        waiting: Any,
        past: list[Any],
        demand: list[Any],
        share: list[Any],
        fraction: Any,
    ) -> tuple[Any, list[tuple[Any, float, float]]]:
        """The horizon: (cost, rows), a row being (expression, lower, upper)."""
        import casadi as ca  # noqa: PLC0415 - heavy

        settings, part, model, layout = self.settings, self.part, self.model, self.layout
        by_link = model.operations.matmul
        serves, source = part.serves.T.astype(float), part.is_source.astype(float)
        budget_s = float(part.green_budget_s[0])
        cost: Any = 0
        rows = [(ca.sum1(z[green]), budget_s, budget_s) for green in layout.green]
        for step in range(settings.horizon):
            green = z[layout.green[min(step, settings.control_horizon - 1)]]
            leaving, inflow, over = z[layout.leaving[step]], z[layout.inflow[step]], z[layout.over_storage[step]]
            moving = x - by_link(model.leaves, q)
            arriving = model.arriving_veh(moving, inflow, past, share)
            unsaturated = q + fraction * by_link(model.leaves.T, arriving)
            saturated = model.saturated_veh(by_link(serves, green), fraction)
            # The three terms of SPEC 2.3, the third as the consumer's: it knows its storage.
            rows += [
                (leaving - unsaturated, -np.inf, 0.0),
                (leaving - saturated, -np.inf, 0.0),
                (inflow - over - model.room_veh(x), -np.inf, 0.0),
            ]
            q = unsaturated - leaving
            x = x + inflow - by_link(model.leaves, leaving)
            waiting = waiting + source * (demand[step] - inflow)
            rows += [(waiting[int(link)], 0.0, np.inf) for link in np.flatnonzero(part.is_source)]
            past = [inflow, *past[:-1]]
            cost += settings.stage_cost(x, waiting, part) + STORAGE_PENALTY * ca.sum1(over)
            cost += REGULARISATION / 2 * (ca.sumsqr(leaving) + ca.sumsqr(inflow) + ca.sumsqr(over))
            if step < settings.control_horizon:
                cost += settings.green_cost(green)
        return cost + settings.terminal_cost(x, waiting, self._remaining), rows

    def _simple_bounds(self) -> tuple[Floats, Floats]:
        lower, upper = np.zeros(self.layout.size), np.full(self.layout.size, np.inf)
        least = self.part.min_green_s
        lower[self.layout.green] = least
        # What the cycle leaves when every other stage has its least (SPEC 3).
        upper[self.layout.green] = self.part.green_budget_s[0] - (least.sum() - least)
        return lower, upper
