"""Signal programmes are cut into stages and clearances that show, laid end to end, what the programme shows."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import accumulate
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from utn_sumo.errors import NetworkError
from utn_sumo.network import programmes
from utn_sumo.network.programmes import MIN_GREEN_S, SHORTEST_STAGE_S, Block, Phase, Programme


def programme(*phases: tuple[float, str], offset_s: float = 0.0) -> Programme:
    return Programme.of((Phase(state, seconds) for seconds, state in phases), offset_s, "static")


def states(blocks: list[Block]) -> list[tuple[str, tuple[str, ...]]]:
    """Letters of each stage and of the parts of its clearance."""
    return [(block.stage.state, tuple(phase.state for phase in block.clearance)) for block in blocks]


def at(phases: list[tuple[str, float]], second: float) -> str:
    """What phases that begin at 0 and go round show then."""
    ends = list(accumulate(seconds for _, seconds in phases))
    into = second % ends[-1]
    return next(state for (state, _), end in zip(phases, ends, strict=True) if into < end)


TWO_STAGES = ((25, "GGrr"), (3, "yyrr"), (2, "rrrr"), (25, "rrGG"), (3, "rryy"), (2, "rrrr"))


def test_green_without_yellow_is_a_stage_and_what_follows_it_its_clearance() -> None:
    assert states(programme(*TWO_STAGES).blocks) == [("GGrr", ("yyrr", "rrrr")), ("rrGG", ("rryy", "rrrr"))]


def test_red_and_yellow_before_a_green_is_part_of_the_clearance_before_it() -> None:
    found = programme((25, "Gr"), (3, "yr"), (2, "ru"), (25, "rG"), (3, "ry"), (2, "ur"))
    assert states(found.blocks) == [("Gr", ("yr", "ru")), ("rG", ("ry", "ur"))]


def test_a_green_beside_a_yellow_is_no_stage() -> None:
    found = programme((25, "GGr"), (12, "Gyr"), (3, "yrr"), (25, "rrG"), (3, "rry"))
    assert states(found.blocks) == [("GGr", ("Gyr", "yrr")), ("rrG", ("rry",))]


@pytest.mark.parametrize("seconds", [SHORTEST_STAGE_S, 7.0, MIN_GREEN_S - 1])
def test_a_short_remnant_of_the_green_before_is_clearance(seconds: float) -> None:
    """Pedestrians have red, the cars beside them still have green."""
    found = programme((20, "GGr"), (seconds, "GrG"[:2] + "r"), (3, "yrr"), (25, "rrG"), (3, "rry"))
    assert states(found.blocks) == [("GGr", ("Grr", "yrr")), ("rrG", ("rry",))]


def test_a_remnant_that_lasts_is_a_stage_of_its_own() -> None:
    found = programme((20, "GGr"), (MIN_GREEN_S, "Grr"), (3, "yrr"), (25, "rrG"), (3, "rry"))
    assert [stage for stage, _ in states(found.blocks)] == ["GGr", "Grr", "rrG"]


@pytest.mark.parametrize("seconds", [SHORTEST_STAGE_S, 7.0])
def test_a_green_that_becomes_a_protected_one_is_a_stage_though_short(seconds: float) -> None:
    found = programme((20, "Ggr"), (seconds, "rGr"), (3, "ryr"), (25, "rrG"), (3, "rry"))
    assert states(found.blocks) == [("Ggr", ()), ("rGr", ("ryr",)), ("rrG", ("rry",))]


def test_a_protected_green_that_loses_its_protection_is_no_new_one() -> None:
    found = programme((20, "GGr"), (7, "rgr"), (3, "ryr"), (25, "rrG"), (3, "rry"))
    assert states(found.blocks) == [("GGr", ("rgr", "ryr")), ("rrG", ("rry",))]


@pytest.mark.parametrize("state", ["GrG", "rGG", "Grr"])
def test_what_lasts_under_five_seconds_is_never_a_stage(state: str) -> None:
    found = programme((20, "Ggr"), (SHORTEST_STAGE_S - 0.5, state), (3, "yyr"), (25, "rrG"), (3, "rry"))
    assert [stage for stage, _ in states(found.blocks)] == ["Ggr", "rrG"]


def test_a_phase_that_goes_round_the_cycle_is_one_from_where_it_begins() -> None:
    found = programme((10, "Gr"), (3, "yr"), (20, "rG"), (3, "ry"), (14, "Gr"), offset_s=5)
    assert states(found.blocks) == [("Gr", ("yr",)), ("rG", ("ry",))]
    assert found.blocks[0].stage.duration_s == 24
    assert found.cycle_s == 50
    # At 5 s the programme begins amid its first green, of which 14 s were before.
    assert found.offset_s + found.begin_s == 5 - 14


def test_phases_alike_in_a_row_are_one() -> None:
    found = programme((3, "Gr"), (3, "Gr"), (20, "Gr"), (3, "yr"), (20, "rG"), (3, "ry"))
    assert [block.stage.duration_s for block in found.blocks] == [26, 20]


def test_a_programme_that_shows_one_thing_only_has_one_stage() -> None:
    found = programme((30, "GG"), (60, "GG"))
    assert [(block.stage.duration_s, block.clearance) for block in found.blocks] == [(90, ())]
    assert "one stage" in programmes.why_left_alone(found, 2, ())


@pytest.mark.parametrize(
    ("duration_s", "least_s", "expected_s"),
    [
        (25, None, MIN_GREEN_S),
        (7, None, 7),
        (25, 6, 6),
        (25, 12.5, 13),
        (25, 20, 20),
        (25, 40, 25),
        (25, 0, 1),
    ],
    ids=["none said", "short itself", "short", "fraction", "long", "longer than shown", "nothing"],
)
def test_a_stage_lasts_what_mindur_says_but_no_more_than_the_net_shows(
    duration_s: float, least_s: float | None, expected_s: float
) -> None:
    assert Block(Phase("Gr", duration_s, least_s), ()).min_green_s(MIN_GREEN_S) == expected_s


def test_the_leasts_of_phases_alike_in_a_row_add_up() -> None:
    shown = [Phase("Gr", 20, 5.0), Phase("Gr", 10, 7.0), Phase("yr", 3), Phase("rG", 20), Phase("ry", 3)]
    assert [block.stage.least_s for block in Programme.of(shown, 0, "static").blocks] == [12, None]


DURATIONS = st.integers(1, 30)
SHOWN = st.lists(st.tuples(DURATIONS, st.text("Ggyru", min_size=3, max_size=3)), min_size=1, max_size=9)


@given(shown=SHOWN, offset_s=st.integers(-200, 200))
def test_stages_and_clearances_laid_end_to_end_show_the_programme_letter_for_letter(
    shown: list[tuple[int, str]], offset_s: int
) -> None:
    found = programme(*shown, offset_s=offset_s)
    written = [(state, float(seconds)) for seconds, state in shown]
    cycle_s = sum(seconds for seconds, _ in shown)
    assert found.cycle_s == cycle_s
    if not found.opens:
        return
    laid = [(phase.state, phase.duration_s) for block in found.blocks for phase in (block.stage, *block.clearance)]
    begins_s = found.offset_s + found.begin_s
    assert sum(seconds for _, seconds in laid) == cycle_s
    for second in range(-cycle_s, 2 * cycle_s):
        assert at(laid, second - begins_s) == at(written, second - offset_s)


@given(shown=SHOWN)
def test_every_stage_is_plain_green_that_somebody_can_use(shown: list[tuple[int, str]]) -> None:
    found = programme(*shown)
    if not found.opens:
        return
    longer = [block.stage.green for block in found.blocks if block.stage.duration_s >= SHORTEST_STAGE_S]
    for block in found.blocks:
        assert block.stage.is_plain_green
        # A shorter one has somebody for himself.
        assert block.stage.duration_s >= SHORTEST_STAGE_S or block.stage.green.difference(*longer)
        assert 1 <= block.min_green_s(MIN_GREEN_S) <= math.ceil(block.stage.duration_s)
        assert block.min_green_s(MIN_GREEN_S) == round(block.min_green_s(MIN_GREEN_S))
    # Nobody who turns green, or gets protection, for five seconds or more and beside no yellow is left in a clearance.
    cleared = [phase for block in found.blocks for phase in block.clearance]
    assert not [phase for phase in cleared if phase.is_plain_green and phase.duration_s >= MIN_GREEN_S]
    # Nor is anybody in no stage at all who has green without yellow beside it.
    served = frozenset().union(*(block.stage.green for block in found.blocks))
    assert all(phase.green <= served for phase in found.phases if phase.is_plain_green)


def test_who_has_green_for_four_seconds_only_has_a_stage_and_who_keeps_his_for_four_has_none() -> None:
    found = programme((30, "Gr"), (4, "yr"), (4, "rG"), (4, "ry"))
    assert [block.stage.state for block in found.blocks] == ["Gr", "rG"]
    assert found.blocks[1].min_green_s(MIN_GREEN_S) == 4
    kept = programme((30, "GGr"), (4, "Gyr"), (4, "Grr"), (4, "yrr"), (20, "rrG"), (4, "rry"))
    assert [block.stage.state for block in kept.blocks] == ["GGr", "rrG"]


def test_a_signal_is_left_alone_whom_a_stage_would_forget() -> None:
    found = programme((30, "Grr"), (4, "yGr"), (20, "rrG"), (4, "rry"))
    assert "signal 1 has green amid clearances only" in programmes.why_left_alone(found, 3, range(3))
    # Whoever uses no motor.
    assert programmes.why_left_alone(found, 3, (0, 2)) == ""


@given(shown=SHOWN, turn=st.integers(0, 8), offset_s=st.integers(-50, 50))
def test_where_the_writing_of_a_cycle_begins_makes_no_difference(
    shown: list[tuple[int, str]], turn: int, offset_s: int
) -> None:
    """The same cycle written from another phase on has the same stages, at the same times."""
    turn %= len(shown)
    before_s = sum(seconds for seconds, _ in shown[:turn])
    one = programme(*shown, offset_s=offset_s)
    other = programme(*shown[turn:], *shown[:turn], offset_s=offset_s + before_s)
    if not one.opens:
        assert not other.opens
        return

    def timed(each: Programme) -> set[tuple[float, Block]]:
        lengths = [block.stage.duration_s + sum(phase.duration_s for phase in block.clearance) for block in each.blocks]
        begins = accumulate(lengths[:-1], initial=each.offset_s + each.begin_s)
        return {(begin % each.cycle_s, block) for begin, block in zip(begins, each.blocks, strict=True)}

    assert timed(one) == timed(other)


def written(folder: Path, *logics: str) -> Path:
    file = folder / "signals.add.xml"
    file.write_text(f"<additional>{''.join(logics)}</additional>", encoding="utf-8")
    return file


def logic(signal: str, *phases: str, head: str = 'programID="1" offset="4"') -> str:
    return f'<tlLogic id="{signal}" type="static" {head}>{"".join(f"<phase {said}/>" for said in phases)}</tlLogic>'


def added(file: Path, of_net: Mapping[str, Programme | None] | None = None) -> dict[str, Programme]:
    found = programmes.added([file], of_net or {})
    return {signal: each for signal, each in found.items() if each is not None}


def test_programmes_of_additional_files_are_read_with_leasts_and_offset(tmp_path: Path) -> None:
    phases = 'duration="20" state="Gr" minDur="7"', 'duration="3" state="yr"', 'duration="25" state="rG"'
    found = added(written(tmp_path, logic("C", *phases)))
    assert set(found) == {"C"}
    assert found["C"].offset_s == 4
    assert [phase.least_s for phase in found["C"].phases] == [7, None, None]


def test_of_two_programmes_for_a_signal_the_last_one_stands(tmp_path: Path) -> None:
    first, second = logic("C", 'duration="20" state="Gr"'), logic("C", 'duration="30" state="rG"')
    nothing = logic("C", head='programID="off"')
    assert added(written(tmp_path, first, second, nothing))["C"].phases == (Phase("rG", 30),)


def test_a_programme_without_phases_moves_the_one_of_its_id(tmp_path: Path) -> None:
    shown = Phase("Gr", 12), Phase("yr", 3), Phase("rG", 20), Phase("ry", 3), Phase("Gr", 8)
    own = Programme.of(shown, 5.0, "static", "0")
    moved, other = (f'<tlLogic id="{signal}" programID="0" offset="50"/>' for signal in "CD")
    found = added(written(tmp_path, moved, other), {"C": own, "D": replace(own, id="1"), "E": None})
    # The last phase goes on as the first one.
    assert [own.offset_s, found["C"].offset_s, found["D"].offset_s] == [-3, 42, -3]
    assert found["C"].phases == own.phases
    # Without an offset SUMO takes it to be 0.
    plain = '<tlLogic id="C" programID="0"><param key="detector-gap" value="2"/></tlLogic>'
    assert added(written(tmp_path, plain), {"C": own})["C"].offset_s == -8
    later = logic("C", 'duration="30" state="rG"', head='programID="0" offset="7"')
    for order, offset_s in (((moved, later), 7), ((later, moved), 50)):
        assert added(written(tmp_path, *order), {"C": own})["C"].offset_s == offset_s


def test_a_programme_of_an_additional_file_whose_phases_name_their_successors_is_left_alone(tmp_path: Path) -> None:
    phases = (
        'duration="20" state="Gr" next="1 2"',
        'duration="3" state="yr"',
        'duration="25" state="rG"',
        'duration="3" state="ry"',
    )
    found = added(written(tmp_path, logic("C", *phases)))["C"]
    assert "next" in programmes.why_left_alone(found, 2, ())


def test_what_an_additional_file_includes_stands_where_it_is_included(tmp_path: Path) -> None:
    off, on = '<tlLogic id="A" type="static" programID="off"/>', logic("B", 'duration="20" state="Gr"')
    (tmp_path / "sub").mkdir()
    written(tmp_path / "sub", off, on)
    said = '<include href="sub/signals.add.xml"/>'
    before, after = logic("B", 'duration="30" state="rG"'), logic("A", 'duration="30" state="rG"')
    file = written(tmp_path, before, said)
    assert added(file)["B"].phases == (Phase("Gr", 20),)
    assert set(programmes.switched_elsewhere([file])) == {"A"}
    file = written(tmp_path, said, before, after)
    assert added(file)["B"].phases == (Phase("rG", 30),)
    assert not programmes.switched_elsewhere([file])


@pytest.mark.parametrize(
    "said",
    ['duration="1e999" state="Gr"', 'duration="soon" state="Gr"', 'state="Gr"', 'duration="9" state="Gr" minDur="x"'],
)
def test_times_that_are_no_numbers_are_refused_in_one_line(tmp_path: Path, said: str) -> None:
    with pytest.raises(NetworkError, match="no numbers") as caught:
        added(written(tmp_path, logic("C", said)))
    assert "\n" not in str(caught.value)


def test_signals_that_sumo_switches_itself_are_named_until_a_later_programme_stands(tmp_path: Path) -> None:
    off, on = '<tlLogic id="A" type="static" programID="off"/>', logic("B", 'duration="20" state="Gr"')
    waut = '<WAUT id="w" startProg="1"/><wautJunction wautID="w" junctionID="D"/>'
    late = '<tlLogic id="B" type="static" programID="off"/>'
    found = programmes.switched_elsewhere([written(tmp_path, late, off, on, waut)])
    assert set(found) == {"A", "D"}


@pytest.mark.parametrize(
    ("found", "signals", "reason"),
    [
        (None, 2, "no signal programme"),
        (programme((20, "Go"), (3, "yo"), (20, "rG"), (3, "ry")), 2, "switches signals off"),
        (programme((20, "yy"), (3, "rr")), 2, "no phase that shows green"),
        (programme((20, "Gr"), (3, "yr")), 2, "one stage"),
        (programme((20, "Gr"), (3, "yr"), (20, "rG"), (3, "ry")), 3, "not a letter for each"),
        (programme((20, "Gr"), (3, "yr"), (20, "rGr"), (3, "ry")), 2, "not a letter for each"),
        (programme((20, "Gr"), (3, "yr"), (20, "rG"), (3, "ry")), 2, ""),
    ],
    ids=["none", "off", "no green", "one stage", "few letters", "uneven", "good"],
)
def test_why_a_signal_is_left_alone_is_said(found: Programme | None, signals: int, reason: str) -> None:
    why = programmes.why_left_alone(found, signals, range(signals))
    assert reason in why
    assert bool(why) == bool(reason)


FORGOTTEN = ((20, "GGrr"), (3, "Gyrr"), (12, "Grrr"), (2, "rrrr"), (20, "rrGG"), (3, "rryy"), (2, "rrrr"))
"""The first letter's green goes on and ends in red at once."""


def test_a_green_that_ends_without_yellow_is_given_what_the_programme_has_elsewhere_out_of_its_own_time() -> None:
    given = programme(*FORGOTTEN)
    assert given.without_yellow({0, 1, 2, 3}) == {0}
    mended = given.cleared({0})
    shown = [(phase.state, phase.duration_s) for phase in mended.phases]
    assert shown[2:5] == [("Grrr", 9), ("yrrr", 3), ("rrrr", 2)]
    assert mended.cycle_s == given.cycle_s
    assert mended.without_yellow({0, 1, 2, 3}) == set()


def test_a_phase_as_long_as_the_yellow_is_all_of_it_for_who_had_green_before() -> None:
    # Letter 2 goes on while 0 is cleared, and ends in red with that; 1, green in that phase alone, has no time for it.
    given = programme((20, "GrGr"), (3, "yGGr"), (20, "rrrG"), (3, "rrry"))
    mended = given.cleared(given.without_yellow({0, 1, 2, 3}))
    assert [(phase.duration_s, phase.state) for phase in mended.phases] == [
        (20, "GrGr"),
        (3, "yGyr"),
        (20, "rrrG"),
        (3, "rrry"),
    ]
    assert mended.without_yellow({0, 1, 2, 3}) == {1}


def test_who_needs_no_yellow_and_a_programme_that_knows_none_stay_as_they_are() -> None:
    given = programme(*FORGOTTEN)
    assert given.without_yellow({1, 2, 3}) == set()
    bare = programme((25, "GGrr"), (2, "rrrr"), (25, "rrGG"), (2, "rrrr"))
    assert bare.without_yellow({0, 1, 2, 3}) == set()
    assert bare.cleared({0, 1, 2, 3}) == bare


def test_a_green_too_short_for_yellow_stays_as_it_is() -> None:
    given = programme((20, "GGrr"), (3, "Gyrr"), (2, "Grrr"), (2, "rrrr"), *TWO_STAGES[3:])
    assert given.cleared({0}) == given


def test_who_gets_way_while_another_whom_he_meets_is_cleared_waits_for_that() -> None:
    meet = [[False, True], [True, False]]
    given = programme((20, "Gr"), (2, "yr"), (1, "yG"), (20, "rG"), (3, "ry"), (2, "rr"))
    assert given.too_soon(meet) == {(2, 1)}
    assert [phase.state for phase in given.waiting({(2, 1)}).phases] == ["Gr", "yr", "yr", "rG", "ry", "rr"]
    goes_on = programme((20, "Gg"), (3, "yG"), (20, "rG"), (3, "ry"), (2, "rr"))
    assert [phase.state for phase in goes_on.waiting(goes_on.too_soon(meet)).phases][:3] == ["Gg", "yg", "rG"]
    # Who is cleared from a green that gave way gives way still, and who is at peace may go.
    assert programme((20, "gr"), (3, "yG"), (20, "rG"), (3, "ry"), (2, "rr")).too_soon(meet) == set()
    assert given.too_soon([[False, False], [False, False]]) == set()
