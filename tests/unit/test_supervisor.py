"""Whatever a controller does, the street gets a safe plan, and the record says where it came from."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest

from utn_sumo import signals
from utn_sumo.contract import Floats, Forecast, Network, Plan, State
from utn_sumo.supervisor import Decision, Supervisor


class Scripted:
    """A controller that answers from a list: exceptions are raised, anything else is returned."""

    horizon = 1

    def __init__(self, answers: Iterable[Any]) -> None:
        self.answers = list(answers)

    def plan(self, state: State, forecast: Forecast) -> Plan:
        answer = self.answers.pop(0)
        if isinstance(answer, BaseException):
            raise answer
        plan: Plan = answer
        return plan


def empty(net: Network) -> tuple[State, Forecast]:
    links, turns = np.zeros(len(net.links)), np.zeros(len(net.turns))
    past = np.zeros((net.delay_samples, len(net.links)))
    return State(0, 0.0, links, turns, links, past, turns, net.fraction, links), Forecast(np.zeros((1, len(net.links))))


def asked(net: Network, *answers: Any) -> list[Decision]:
    supervisor = Supervisor(net, Scripted(answers))
    return [supervisor.ask(*empty(net)) for _ in answers]


def greens(net: Network, first_s: float) -> Floats:
    """Greens of which J2's first stage has `first_s`."""
    green = net.equal_split().green_s
    green[3:5] = first_s, 110 - first_s
    return green


def good(net: Network) -> Plan:
    return Plan(greens(net, 60), np.stack([greens(net, 70), greens(net, 80)]))


BROKEN: dict[str, tuple[Any, str]] = {
    "raises": (ValueError("no idea"), "ValueError: no idea"),
    "is closed": (GeneratorExit(), "GeneratorExit"),
    "divides by zero": (ZeroDivisionError(), "ZeroDivisionError"),
    "returns not a number": (Plan(np.full(17, np.nan)), "not finite"),
    "returns too few": (Plan(np.full(16, 55.0)), "shape (16,)"),
    "returns words": (Plan(["long"] * 17), "long"),  # type: ignore[arg-type]
    "returns zeros": (Plan(np.zeros(17)), "least"),
    "returns no plan": (None, "NoneType"),
}


@pytest.fixture(params=BROKEN)
def broken(request: pytest.FixtureRequest) -> tuple[Any, str]:
    return BROKEN[request.param]


def test_a_good_plan_is_applied_as_solved(utn17: Network) -> None:
    [decision] = asked(utn17, good(utn17))
    assert decision.rung == "solved"
    assert decision.reason == ""
    assert decision.plan.green_s.tolist() == greens(utn17, 60).tolist()
    assert decision.control_time_s >= 0


def test_a_failing_controller_is_followed_by_its_last_plan_and_then_the_backup(
    utn17: Network, broken: tuple[Any, str]
) -> None:
    answer, reason = broken
    decisions = asked(utn17, good(utn17), answer, answer, answer, answer)
    assert [decision.rung for decision in decisions] == ["solved", "shifted", "shifted", "backup", "backup"]
    assert [decision.plan.green_s[3] for decision in decisions] == [60, 70, 80, 55, 55]
    assert all(reason in decision.reason for decision in decisions[1:])


def test_a_controller_that_fails_from_the_start_is_replaced_by_the_backup(
    utn17: Network, broken: tuple[Any, str]
) -> None:
    answer, reason = broken
    [decision] = asked(utn17, answer)
    assert decision.rung == "backup"
    assert decision.plan.green_s.tolist() == utn17.equal_split().green_s.tolist()
    assert reason in decision.reason


def test_a_controller_that_recovers_is_listened_to_again(utn17: Network) -> None:
    error = ValueError("a bad day")
    decisions = asked(utn17, error, good(utn17), error, good(utn17), error)
    assert [decision.rung for decision in decisions] == ["backup", "solved", "shifted", "solved", "shifted"]
    assert decisions[-1].plan.green_s[3] == 70


def test_a_plan_without_a_rest_is_followed_by_the_backup(utn17: Network) -> None:
    decisions = asked(utn17, good(utn17), Plan(greens(utn17, 60)), ValueError("no idea"))
    assert [decision.rung for decision in decisions] == ["solved", "solved", "backup"]


def test_an_unsafe_rest_is_passed_over_with_both_reasons(utn17: Network) -> None:
    plan = Plan(greens(utn17, 60), np.stack([greens(utn17, 5), greens(utn17, 80)]))
    decisions = asked(utn17, plan, ValueError("no idea"), ValueError("no idea"))
    assert [decision.rung for decision in decisions] == ["solved", "backup", "shifted"]
    assert "no idea" in decisions[1].reason
    assert "5 s" in decisions[1].reason


@pytest.mark.parametrize(
    "ahead",
    [5, "later", [["long"] * 17], [[1.0], [1.0, 2.0]], [None]],
    ids=["number", "word", "words", "ragged", "none"],
)
def test_a_rest_that_is_no_plan_at_all_never_brings_the_run_down(utn17: Network, ahead: Any) -> None:
    decisions = asked(utn17, Plan(greens(utn17, 60), ahead), ValueError("no idea"), good(utn17))
    assert decisions[1].rung == "backup"
    assert decisions[2].rung == "solved"


def test_every_plan_that_is_given_out_is_safe(utn17: Network) -> None:
    answers = [good(utn17), *(answer for answer, _ in BROKEN.values()), good(utn17)]
    for decision in asked(utn17, *answers):
        signals.admit(decision.plan, utn17)


def test_what_a_controller_writes_into_what_it_is_told_is_its_own_affair(utn17: Network) -> None:
    class Scribbler(Scripted):
        def plan(self, state: State, forecast: Forecast) -> Plan:
            state.x_veh[:] = forecast.demand_veh[:] = np.nan
            return super().plan(state, forecast)

    state, forecast = empty(utn17)
    assert Supervisor(utn17, Scribbler([good(utn17)])).ask(state, forecast).rung == "solved"
    assert (state.x_veh == 0).all()
    assert (forecast.demand_veh == 0).all()


def test_ctrl_c_is_not_swallowed(utn17: Network) -> None:
    class Interrupted(Scripted):
        def plan(self, state: State, forecast: Forecast) -> Plan:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Supervisor(utn17, Interrupted([])).ask(None, None)  # type: ignore[arg-type]
