"""The same MPC without relaxation: the exact model of SPEC 2 with rounded minima, whole and at once, by IPOPT (SPEC 3).

It is the reference that the convex problem is held against. Nothing is frozen: delays, where the green stands, and how
room opens within a step follow from the greens. What is predicted is then what the model does, at the price of a
problem that is not convex: the optimum is a local one, and the start decides which.

Decided are the greens and, at every model step, the state, the inflow and the room (multiple shooting); the model's own
`LinkModel.flows` ties them together. Units as in the model: veh per model step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sp

from utn_controllers.mpc.place import has_slack, remaining_steps
from utn_controllers.mpc.settings import ProblemSettings
from utn_sumo.contract import Floats, Forecast, Network, State
from utn_sumo.errors import ControllerError
from utn_sumo.model import LinkModel, ModelState, SmoothOperations, StepFlows, green_windows

ROUNDINGS = ((1.0, 0.1), (0.3, 0.03), (0.1, 0.02))
"""Epsilons (of vehicles and seconds, of shares) of one solve after the other: the first finds the way, the last counts.

On random states of `utn17` the last alone ends at `tts` costs 0.3 % higher in the mean and 4 % at most; predicted and
rolled-out cost then differ by 0.5 % at most.
"""
COST_AT_START = 300.0
"""What the cost is scaled to: IPOPT weighs it against vehicles that do not add up."""
MOST_ITERATIONS = 200
"""Of one solve; who needs more goes round in circles between two kinks."""
SOLVED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
OPTIONS: dict[str, Any] = {
    "print_time": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.max_iter": MOST_ITERATIONS,
    "ipopt.tol": 1e-4,
    # Starts are rolled out and so feasible: little need to keep away from the bounds.
    "ipopt.mu_init": 1e-2,
    # The filter lets iterates stray from the model and cycles at the kinks; a penalty needs fewer iterations.
    # IPOPT has no watchdog for it.
    "ipopt.line_search_method": "penalty",
    "ipopt.watchdog_shortened_iter_trigger": 0,
}


@dataclass(frozen=True)
class ExactSolution:
    """A local optimum."""

    greens_s: Floats
    """(Kc, S)"""
    cost: float
    """As predicted with rounded minima."""
    iterations: int
    """IPOPT's, of all solves together."""


class ExactProblem:
    """The problem of one network, stated once; state and forecast are its parameters."""

    def __init__(self, network: Network, settings: ProblemSettings):
        import casadi as ca  # noqa: PLC0415 - heavy

        self.network, self.settings = network, settings
        self._model = LinkModel(network, settings.step_s or network.control_step_s)
        self._substeps = round(network.control_step_s / self._model.step_s)
        links, turns, stages = len(network.links), len(network.turns), len(network.stages)

        greens = ca.SX.sym("greens", stages, settings.control_horizon)
        past = tuple(ca.SX.sym(f"past{lag}", links) for lag in range(self._model.lags))
        start = ModelState(ca.SX.sym("x", links), ca.SX.sym("q", turns), ca.SX.sym("waiting", links), past)
        demand, fraction = ca.SX.sym("demand", links, settings.horizon), ca.SX.sym("fraction", turns)
        disturbance = ca.SX.sym("disturbance", links, settings.horizon)
        rounding, scale = ca.SX.sym("rounding", 2), ca.SX.sym("scale")
        model = LinkModel(network, self._model.step_s, SmoothOperations(rounding[0], rounding[1]))
        states, variables, rows = self._predict(model, start, greens, (demand, disturbance), fraction)
        budgets = ca.vec(ca.mtimes(ca.DM(self._by_junction[has_slack(network)]), greens))
        # In the order in which `_solve_once` fills them in.
        known = [
            start.x_veh,
            start.q_veh,
            start.source_queue_veh,
            *past,
            ca.vec(demand),
            ca.vec(disturbance),
            fraction,
            rounding,
            scale,
        ]
        statement = {
            "x": ca.vertcat(ca.vec(greens), *variables),
            "p": ca.vertcat(*known),
            "f": scale * _cost(network, settings, states, ca.horzsplit(greens)),
            "g": ca.vertcat(*rows, budgets),
        }
        self._solver = ca.nlpsol("exact", "ipopt", statement, OPTIONS)
        self._bounds = self._all_bounds(statement["x"].numel(), statement["g"].numel() - budgets.numel())

    def _predict(
        self, model: LinkModel, state: ModelState, greens: Any, outside: tuple[Any, Any], fraction: Any
    ) -> tuple[list[ModelState], list[Any], list[Any]]:
        """The horizon: the state after each model step, the variables, and what the model says has to be 0.

        `outside` are demand and disturbance (Z, horizon).
        """
        import casadi as ca  # noqa: PLC0415 - heavy

        links, turns = len(self.network.links), len(self.network.turns)
        states, variables, rows = [], [], []
        for step in range(self.settings.horizon * self._substeps):
            control_step, substep = divmod(step, self._substeps)
            green = greens[:, min(control_step, self.settings.control_horizon - 1)]
            shown_s, held_s, end_s = smooth_windows(model, green, substep * model.step_s)
            demand_veh, disturbance_veh = (each[:, control_step] / self._substeps for each in outside)
            inflow, room = ca.SX.sym(f"inflow{step}", links), ca.SX.sym(f"room{step}", links)
            x, q, waiting = ca.SX.sym(f"x{step}", links), ca.SX.sym(f"q{step}", turns), ca.SX.sym(f"w{step}", links)
            # Without the bounds of `LinkModel.disturbed`, whose rounding would tell on every step.
            state = replace(state, x_veh=state.x_veh + disturbance_veh)
            flows = model.flows(model.terms(state, shown_s, demand_veh, fraction, end_s, held_s=held_s), inflow, room)
            after = model.after(state, demand_veh, flows)
            variables += [inflow, room, x, q, waiting]
            rows += [flows.inflow_veh - inflow, flows.open_room_veh - room]
            rows += [after.x_veh - x, after.q_veh - q, after.source_queue_veh - waiting]
            # What is remembered of the inflow is the variable too: that keeps the equations short.
            past = (*[inflow / model.samples] * model.samples, *state.past_inflow_veh)[: model.lags]
            state = ModelState(x, q, waiting, past)
            states.append(state)
        return states, variables, rows

    def solve(self, state: State, forecast: Forecast, greens_s: Floats, *, near: bool = False) -> ExactSolution:
        """A local optimum, from the start `greens_s` (Kc, S).

        A start that is `near`, such as the last plan's rest, is taken straight to the finest rounding. What fails
        one way is tried the other. Raises ControllerError if both fail, or for numbers that are not finite.
        """
        counted = state.x_veh, state.q_veh, state.source_queue_veh, state.past_inflow_veh, state.fraction
        if not all(np.isfinite(each).all() for each in (*counted, *forecast.outside_veh, greens_s)):
            raise ControllerError("the exact problem: its state, forecast or start is not finite")
        ways = [ROUNDINGS[-1:], ROUNDINGS] if near else [ROUNDINGS, ROUNDINGS[-1:]]
        iterations, status = 0, ""
        for way in ways:
            start_s = greens_s
            for rounding in way:
                found, status = self._solve_once(state, forecast, start_s, rounding)
                iterations += found.iterations
                if status in SOLVED:
                    start_s = found.greens_s
            if status in SOLVED:
                return ExactSolution(found.greens_s, found.cost, iterations)
        raise ControllerError(f"the exact problem has no solution ({status} after {iterations} iterations)")

    def _solve_once(
        self, state: State, forecast: Forecast, start_s: Floats, rounding: tuple[float, float]
    ) -> tuple[ExactSolution, str]:
        """Where IPOPT ends with one rounding, whatever its status is."""
        horizon, kept = self.settings.horizon, self.settings.control_horizon
        states, flows = _roll_out(self._model, state, forecast, start_s, horizon)
        cost = float(_cost(self.network, self.settings, states[1:], [*start_s]))
        first, scale = states[0], COST_AT_START / max(cost, 1.0)
        known = [first.x_veh, first.q_veh, first.source_queue_veh, *first.past_inflow_veh]
        known += [*(each[:horizon].ravel() for each in forecast.outside_veh), state.fraction, rounding, [scale]]
        guess = [start_s.ravel()]
        for moved, after in zip(flows, states[1:], strict=True):
            guess += [moved.inflow_veh, moved.open_room_veh, after.x_veh, after.q_veh, after.source_queue_veh]
        try:
            found = self._solver(x0=np.concatenate(guess), p=np.concatenate(known), **self._bounds)
        except RuntimeError as error:  # CasADi's answer to bounds that contradict each other
            raise ControllerError(f"the exact problem is impossible ({str(error).splitlines()[-1]})") from error
        stats = self._solver.stats()
        greens_s = np.array(found["x"][: start_s.size]).reshape(kept, -1)
        # IPOPT oversteps bounds by its tolerance.
        greens_s = np.clip(greens_s, *(self._bounds[side][: start_s.size].reshape(kept, -1) for side in ("lbx", "ubx")))
        return ExactSolution(greens_s, float(found["f"]) / scale, int(stats["iter_count"])), str(stats["return_status"])

    @property
    def _by_junction(self) -> Floats:
        """(J, S) 1 where a stage is of a junction."""
        return np.equal.outer(np.arange(len(self.network.junctions)), self.network.stage_junction).astype(np.float64)

    def _all_bounds(self, variables: int, equations: int) -> dict[str, Floats]:
        """Least and most green of each stage, each junction's budget filled (SPEC 3), and the model's equations."""
        net, kept = self.network, self.settings.control_horizon
        least, others = net.min_green_s, self._by_junction.T @ self._by_junction @ net.min_green_s - net.min_green_s
        free = np.full(variables - kept * len(least), np.inf)
        rows = np.concatenate([np.zeros(equations), np.tile(net.green_budget_s[has_slack(net)], kept)])
        return {
            "lbx": np.concatenate([np.tile(least, kept), -free]),
            "ubx": np.concatenate([np.tile(net.green_budget_s[net.stage_junction] - others, kept), free]),
            "lbg": rows,
            "ubg": rows,
        }


def smooth_windows(model: LinkModel, green_s: Any, begin_s: float) -> tuple[Any, Any, Any]:
    """`green_windows` of the model step that begins at `begin_s` as symbols: shown (S,), held (M,), ends by turn (M,).

    `green_s` (S,) is a column of symbols, `model` one of rounded operations. The end of a green that is not shown is
    of no account.
    """
    ops, net = model.operations, model.network
    stages, held = len(net.stages), net.held_greens
    stage = np.concatenate([np.arange(stages), [each.stage for each in held]]).astype(np.int64)
    # Where a window stands is the sum of what goes before it in its cycle: affine in the greens, as is its length.
    alone = net.since_cycle_start_s(np.zeros(stages))
    before = net.since_cycle_start_s(np.eye(stages)).T - alone[:, None]
    own, follows = np.eye(stages)[stage], np.arange(len(stage)) >= stages
    after_s, lasts_s = (np.zeros(len(stage)) for _ in range(2))
    after_s[stages:], lasts_s[stages:] = [each.after_s for each in held], [each.duration_s for each in held]
    since = ops.matmul(sp.csr_array(before[stage] + own * follows[:, None]), green_s)
    since = since + alone[stage] + after_s + net.startup_lag_s - begin_s
    lasts = ops.matmul(sp.csr_array(own * ~follows[:, None]), green_s) + lasts_s
    shown: Any = 0
    last: Any = 0
    whole: Any = 0
    for cycle_start_s in net.cycle_starts_s()[:, stage]:
        opens = since + cycle_start_s
        closes = ops.minimum(opens + lasts, model.step_s)
        overlap = ops.maximum(closes - ops.maximum(opens, 0.0), 0.0)
        shown = shown + overlap
        last = ops.maximum(last, closes * ops.share(overlap))
        ends = ops.minimum(opens + lasts, net.control_step_s - begin_s)
        whole = whole + ops.maximum(ends - ops.maximum(opens, -begin_s), 0.0)
    # Cycles that do not divide the control step show in it what they do on average.
    cycle_s = net.cycle_s[net.stage_junction][stage]
    odd = (net.control_step_s % cycle_s > 0).astype(float)
    if odd.any():
        shown = shown * (1.0 - odd + odd * (lasts * (net.control_step_s / cycle_s)) / (whole + (1.0 - odd)))
    window, starts, turns = net.turn_windows
    counts = np.diff([*starts, len(window)])
    free = net.unsignalled.astype(float) * model.step_s
    shape = (len(net.turns), len(stage))
    end: Any = free
    for position in range(counts.max(initial=0)):
        there = counts > position
        picked = turns[there], window[starts[there] + position]
        end = ops.maximum(end, ops.matmul(sp.csr_array((np.ones(len(picked[0])), picked), shape=shape), last))
    turn, piece = (
        [turn for each in held for turn in each.turns],
        [p for p, each in enumerate(held, stages) for _ in each.turns],
    )
    holds = sp.csr_array((np.ones(len(turn)), (turn, piece)), shape=shape)
    return shown[:stages], ops.matmul(holds, shown) + free, end


def rolled_out_cost(
    network: Network, settings: ProblemSettings, state: State, forecast: Forecast, greens_s: Floats
) -> float:
    """What the greens (Kc, S) cost when the exact model runs under them: the measure of any plan, however found."""
    model = LinkModel(network, settings.step_s or network.control_step_s)
    states, _ = _roll_out(model, state, forecast, greens_s, settings.horizon)
    return float(_cost(network, settings, states[1:], [*greens_s]))


def _roll_out(
    model: LinkModel, state: State, forecast: Forecast, greens_s: Floats, horizon: int
) -> tuple[list[ModelState], list[StepFlows]]:
    """The model's way over so many control steps: its states, the one at the start first, and the flows between."""
    past = model.history(state.past_inflow_veh, model.network.sample_s)
    states, flows = [ModelState(state.x_veh, state.q_veh, state.source_queue_veh, past)], []
    windows = green_windows(model.network, greens_s, model.step_s)
    substeps = windows.shown_s.shape[1]
    for step in range(horizon * substeps):
        at = min(step // substeps, len(greens_s) - 1), step % substeps
        demand_veh, disturbance_veh = (each[step // substeps] / substeps for each in forecast.outside_veh)
        now = model.disturbed(states[-1], disturbance_veh)
        after, moved = model.step(
            now, windows.shown_s[at], demand_veh, state.fraction, windows.end_s[at], held_s=windows.held_s[at]
        )
        states.append(after)
        flows.append(moved)
    return states, flows


def _cost(network: Network, settings: ProblemSettings, states: Sequence[ModelState], greens_s: Sequence[Any]) -> Any:
    """Cost of the states at the ends of the model steps and of the greens of each control step, symbols or numbers."""
    last, storage = states[-1], network.storage_veh
    spent = sum(settings.stage_cost(each.x_veh, each.source_queue_veh, storage) for each in states)
    left = settings.terminal_cost(last.x_veh, last.source_queue_veh, remaining_steps(network))
    return spent * settings.horizon / len(states) + left + sum(settings.green_cost(each) for each in greens_s)
