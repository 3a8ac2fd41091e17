"""The conflict monitor counts the seconds in which signals were unsafe, and says why."""

from __future__ import annotations

from dataclasses import replace
from itertools import accumulate
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from utn_sumo import monitor, signals
from utn_sumo.contract import Network, Plan
from utn_sumo.errors import ResultError

Phases = list[tuple[str, float]]

FIRST, YELLOW, RED, SECOND, THIRD = "GGGrrrrrrr", "yyyrrrrrrr", "r" * 10, "rrrGGGGrrr", "rrrrrrrGGG"
BOTH = "GGGGGGGrrr"
DURATION_S = 240


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("record") / "signals.xml"


def judge(net: Network, record: Path, first: Phases | None = None, plan: Plan | None = None) -> monitor.Verdict:
    """The verdict on a run of two cycles in which J1 shows `first`, and all others (or all) the plan."""
    green_s = (plan or net.equal_split()).green_s
    lines = []
    for index, junction in enumerate(net.junctions):
        phases = 2 * signals.cycle_phases(net, index, green_s)
        if junction.id == "J1" and first is not None:
            phases = first
        starts = [0.0, *accumulate(duration for _, duration in phases)]
        lines += [
            f'<tlsState time="{start:.2f}" id="{junction.id}" programID="utn" phase="0" state="{state}"/>'
            for start, (state, _) in zip(starts, phases, strict=False)
        ]
    record.write_text(f"<tlsStates>{''.join(lines)}</tlsStates>", encoding="utf-8")
    return monitor.watch(net, record, DURATION_S)


def test_a_yellow_that_was_under_way_when_the_run_began_is_taken_to_have_been_long_enough(
    utn17: Network, record: Path
) -> None:
    rest: Phases = [(YELLOW, 1), (RED, 2), (SECOND, 35), (RED, 202)]
    shifted = replace(utn17, junctions=tuple(replace(each, offset_s=83.0) for each in utn17.junctions))
    amid = [reason for reason in judge(shifted, record, rest).reasons if reason.startswith("J1 at 1 s")]
    fresh = [reason for reason in judge(utn17, record, rest).reasons if reason.startswith("J1 at 1 s")]
    assert amid == []
    assert "too little yellow" in fresh[0]


@given(weights=st.lists(st.floats(0, 1), min_size=17, max_size=17))
def test_whatever_plan_is_admitted_is_shown_without_an_unsafe_second(
    utn17: Network, record: Path, weights: list[float]
) -> None:
    green = utn17.min_green_s.copy()
    for junction, budget in zip(utn17.junctions, utn17.green_budget_s, strict=True):
        stages = list(junction.stages)
        weight = np.array(weights)[stages] + 1e-3
        green[stages] += (budget - green[stages].sum()) * weight / weight.sum()
    verdict = judge(utn17, record, plan=signals.admit(Plan(green), utn17))
    assert verdict.unsafe_signal_s == 0
    assert verdict.reasons == []


@pytest.mark.parametrize(
    ("first", "reason"),
    [
        ([("G" * 10, 240)], "conflict"),
        ([(FIRST, 40), (RED, 5), (SECOND, 195)], "without yellow"),
        ([(FIRST, 40), (YELLOW, 2), (RED, 3), (SECOND, 193)], "too little yellow"),
        ([(FIRST, 40.2), (YELLOW, 2.8), (RED, 3), (SECOND, 194)], "too little yellow"),
        ([(FIRST, 40.2), (YELLOW, 3), (RED, 1.8), (SECOND, 195)], "too soon"),
        ([(FIRST, 40), (YELLOW, 3), (RED, 1), (SECOND, 196)], "too soon"),
        ([(FIRST, 40), (YELLOW, 3), (SECOND, 197)], "too soon"),
        ([(FIRST, 40), ("yyyGGGGrrr", 3), (SECOND, 197)], "conflict"),
        ([(FIRST, 40), (YELLOW, 3), (RED, 2), (SECOND, 5), ("rrryyyyrrr", 3), (RED, 187)], "less than its least"),
        ([(FIRST, 40), (YELLOW, 1), (FIRST, 199)], "yellow"),
        ([("XGGrrrrrrr", 240)], "shows 'XGGrrrrrrr'"),
        ([("GGGrrr", 240)], "shows 'GGGrrr'"),
        ([], "shows ''"),
    ],
    ids=[
        "all green",
        "no yellow",
        "yellow of two seconds",
        "yellow of less than three",
        "red of less than two",
        "red of one second",
        "no red",
        "green against yellow",
        "green of five seconds",
        "yellow taken back",
        "unknown letter",
        "too few letters",
        "silent",
    ],
)
def test_an_unsafe_signal_is_counted_with_its_reason(utn17: Network, record: Path, first: Phases, reason: str) -> None:
    verdict = judge(utn17, record, first)
    assert verdict.unsafe_signal_s > 0
    assert {junction for junction, _ in verdict.seconds} == {"J1"}
    assert any(line.startswith("J1 at ") and reason in line for line in verdict.reasons)


@pytest.mark.parametrize("begin_s", [0.5, 600.125, 21600.3])
def test_a_run_may_begin_amid_a_second(utn17: Network, record: Path, begin_s: float) -> None:
    judge(utn17, record)
    tree = ET.parse(record)
    for switch in tree.getroot():
        # As SUMO writes it: hundredths.
        switch.set("time", f"{begin_s + float(switch.attrib['time']) + 1e-6:.2f}")
    tree.write(record)
    assert monitor.watch(utn17, record, DURATION_S, begin_s).reasons == []


def test_a_run_that_ends_amid_a_second_is_judged_to_its_end(utn17: Network, record: Path) -> None:
    record.write_text("<tlsStates/>", encoding="utf-8")
    assert monitor.watch(utn17, record, 9.5).unsafe_signal_s == 8 * 10


def starting_at(net: Network, offset_s: float) -> Network:
    """The network with that offset at J1."""
    return replace(
        net,
        junctions=tuple(
            replace(junction, offset_s=offset_s) if junction.id == "J1" else junction for junction in net.junctions
        ),
    )


OPENS_WITH_FIVE_SECONDS: Phases = [(FIRST, 5), (YELLOW, 3), (RED, 2), (SECOND, 230)]


@pytest.mark.parametrize("offset_s", [0, 120, 240])
def test_a_cycle_that_begins_at_second_0_has_its_least_green(utn17: Network, record: Path, offset_s: float) -> None:
    verdict = judge(starting_at(utn17, offset_s), record, OPENS_WITH_FIVE_SECONDS)
    assert verdict.unsafe_signal_s == 1
    assert "J1 at 5 s" in verdict.reasons[0]
    assert "less than its least" in verdict.reasons[0]


@pytest.mark.parametrize("offset_s", [10, 119, 130, -110])
def test_a_green_amid_which_the_run_begins_is_not_accused_of_being_too_short(
    utn17: Network, record: Path, offset_s: float
) -> None:
    assert judge(starting_at(utn17, offset_s), record, OPENS_WITH_FIVE_SECONDS).reasons == []


def test_with_an_offset_too_every_later_green_has_its_least(utn17: Network, record: Path) -> None:
    second_is_short: Phases = [*OPENS_WITH_FIVE_SECONDS[:3], (SECOND, 5), ("rrryyyyrrr", 3), (RED, 222)]
    verdict = judge(starting_at(utn17, 10), record, second_is_short)
    assert sorted(verdict.seconds) == [("J1", 15)]
    assert "less than its least" in verdict.reasons[0]


def test_a_green_that_follows_a_red_start_has_its_least_whatever_the_offset(utn17: Network, record: Path) -> None:
    phases: Phases = [(RED, 3), *OPENS_WITH_FIVE_SECONDS]
    assert judge(starting_at(utn17, 10), record, phases).seconds == {("J1", 8)}


@pytest.mark.parametrize("seconds", [1, 2, 7, 60])
def test_every_second_of_a_conflict_counts(utn17: Network, record: Path, seconds: int) -> None:
    opening = [(FIRST, 40.0), (YELLOW, 3.0), (RED, DURATION_S - 43.0 - seconds)]
    assert judge(utn17, record, [*opening, (BOTH, seconds)]).unsafe_signal_s == seconds


def test_every_second_without_a_signal_counts(utn17: Network, record: Path) -> None:
    assert judge(utn17, record, []).unsafe_signal_s == DURATION_S
    assert judge(utn17, record, [("rrrr", 30), (FIRST, 210)]).unsafe_signal_s == 30


def test_a_record_that_starts_late_is_silent_until_then(utn17: Network, record: Path) -> None:
    judge(utn17, record)
    late = record.read_text(encoding="utf-8").replace('time="0.00" id="J3"', 'time="17.00" id="J3"')
    record.write_text(late, encoding="utf-8")
    assert monitor.watch(utn17, record, DURATION_S).unsafe_signal_s == 17


def test_seconds_are_summed_over_junctions(utn17: Network, record: Path) -> None:
    record.write_text("<tlsStates/>", encoding="utf-8")
    assert monitor.watch(utn17, record, 100).unsafe_signal_s == 8 * 100


def test_what_the_record_says_beyond_the_run_is_not_judged(utn17: Network, record: Path) -> None:
    assert judge(utn17, record, [(FIRST, 240), ("G" * 10, 100)]).unsafe_signal_s == 0


def test_streams_that_do_not_conflict_may_be_green_together(utn17: Network, record: Path) -> None:
    conflicts = np.array(utn17.junctions[0].conflicts)
    free = next(signal for signal in range(10) if not conflicts[signal].any())
    state = "".join("G" if signal == free or letter == "G" else "r" for signal, letter in enumerate(FIRST))
    assert judge(utn17, record, [(state, 240)]).unsafe_signal_s == 0


@pytest.mark.parametrize("content", ["", "<tlsStates><tlsState"])
def test_an_unreadable_record_is_refused_in_one_line(utn17: Network, tmp_path: Path, content: str) -> None:
    path = tmp_path / "signals.xml"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(ResultError, match="can't be read"):
        monitor.watch(utn17, path, 10)
    path.unlink()
    with pytest.raises(ResultError, match="can't be read"):
        monitor.watch(utn17, path, 10)


def test_in_any_order_a_stage_between_two_others_need_last_for_its_least_green_only(
    utn17: Network, record: Path
) -> None:
    # The clearance after the last stage is far longer than those about the short one amid it.
    stages = list(utn17.stages)
    _, second, third = utn17.junctions[0].stages
    long = (*stages[third].clearance[:-1], ("r" * 10, 14.0))
    stages[third] = replace(stages[third], clearance=long)
    net = replace(utn17, stages=tuple(stages))
    least_s = stages[second].least_green_s
    assert least_s < stages[second].min_green_s
    shown = [(FIRST, 30), (YELLOW, 3), (RED, 2), (SECOND, least_s), ("rrryyyyrrr", 3), (RED, 2), (THIRD, 300)]
    starts = [0.0, *accumulate(seconds for _, seconds in shown)]
    lines = [
        f'<tlsState time="{start:g}" id="J1" state="{state}"/>'
        for start, (state, _) in zip(starts, shown, strict=False)
    ]
    record.write_text(f"<tlsStates>{''.join(lines)}</tlsStates>", encoding="utf-8")
    found = monitor.watch(net, record, 60, in_order=False)
    assert [reason for reason in found.reasons if reason.startswith("J1")] == []
    in_order = monitor.watch(net, record, 60)
    assert any("least" in reason for reason in in_order.reasons if reason.startswith("J1"))
