"""Plan to signal programme: whole seconds, clearances, and a last check that refuses with a reason.

SUMO shows whatever it is told, all-green and NaN included, so nothing reaches it that this module has not admitted.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from utn_sumo.contract import Floats, Junction, Network, Plan
from utn_sumo.errors import PlanError

TOLERANCE_S = 1e-3
"""How far a wished plan may be from its budget and its least greens: solvers leave that much."""


def admit(plan: Plan, network: Network) -> Plan:
    """The plan in whole seconds, safe to show. Raises PlanError with the reason if it is not.

    Checked are its shape, that it is finite, each stage's least green, each junction's sum against
    what its cycle leaves, and then the programme that results from it.
    """
    try:
        green_s = np.asarray(plan.green_s, dtype=float)
    except (TypeError, ValueError) as error:
        raise PlanError(f"plan is no row of numbers ({error})") from error
    if green_s.shape != (len(network.stages),):
        raise PlanError(f"plan has shape {green_s.shape}: give one green for each of {len(network.stages)} stages")
    if not np.isfinite(green_s).all():
        raise PlanError(f"plan is not finite at stage {int(np.flatnonzero(~np.isfinite(green_s))[0])}")
    for index, junction in enumerate(network.junctions):
        stages = list(junction.stages)
        for stage in stages:
            least_s = network.stages[stage].min_green_s
            if green_s[stage] < least_s - TOLERANCE_S:
                raise PlanError(
                    f"junction {junction.id}: green of {green_s[stage]:g} s is under the {least_s:g} s least"
                )
        total, budget = green_s[stages].sum(), network.green_budget_s[index]
        if abs(total - budget) > TOLERANCE_S * len(stages):
            raise PlanError(f"junction {junction.id}: greens sum to {total:g} s, its cycle leaves {budget:g} s")
    admitted = replace(plan, green_s=whole_seconds(network, green_s))
    for index in range(len(network.junctions)):
        check_programme(network, index, cycle_phases(network, index, admitted.green_s))
    return admitted


def refused(network: Network) -> dict[str, str]:
    """Junctions whose cycle can't be shared out equally without breaking the rules of `admit`, and why."""
    found = {}
    for index, junction in enumerate(network.junctions):
        part = network.part(index)
        try:
            admit(part.equal_split(), part)
        except PlanError as error:
            found[junction.id] = str(error).removeprefix(f"junction {junction.id}: ")
    return found


def whole_seconds(network: Network, green_s: Floats) -> Floats:
    """Greens rounded to whole seconds that still sum to each junction's budget (largest remainder)."""
    rounded = np.floor(green_s + TOLERANCE_S)
    for index, junction in enumerate(network.junctions):
        stages = np.array(junction.stages)
        missing = round(network.green_budget_s[index] - rounded[stages].sum())
        by_remainder = stages[np.argsort(rounded[stages] - green_s[stages], kind="stable")]
        rounded[by_remainder[:missing]] += 1
    return rounded


def cycle_phases(network: Network, junction: int, green_s: Floats) -> list[tuple[str, float]]:
    """(letters, seconds) of one cycle of a junction under the stage greens (S,), clearances included."""
    phases: list[tuple[str, float]] = []
    for stage in network.junctions[junction].stages:
        phases.append((network.stages[stage].state, float(green_s[stage])))
        phases += network.stages[stage].clearance
    return phases


def check_programme(network: Network, junction: int, phases: list[tuple[str, float]]) -> None:
    """Raise PlanError unless the phases fill the cycle in whole seconds and clear every green by yellow."""
    item = network.junctions[junction]
    total = sum(duration for _, duration in phases)
    if total != item.cycle_s:
        raise PlanError(f"junction {item.id}: programme lasts {total:g} s, its cycle {item.cycle_s:g} s")
    for state, duration in phases:
        if duration < 1 or duration != round(duration):
            raise PlanError(f"junction {item.id}: phase of {duration:g} s, whole seconds from 1 on are needed")
        if len(state) != len(item.signal_turns):
            raise PlanError(f"junction {item.id}: {len(state)} letters for {len(item.signal_turns)} signals")
    states = [state for state, _ in phases]
    before = states[-1]
    protected = [False] * len(before)
    # Twice round: what the first green of a cycle follows is the last clearance.
    for state in [*states, *states]:
        for signal, (was, becomes) in enumerate(zip(before, state, strict=True)):
            if was in "Gg" and becomes == "r" and signal not in item.without_yellow:
                raise PlanError(f"junction {item.id}: signal {signal} goes from green to red without yellow")
            protected[signal] = becomes == "G" or (protected[signal] and becomes in "yY")
        _refuse_conflict(item, state, protected)
        before = state


def _refuse_conflict(junction: Junction, state: str, protected: list[bool]) -> None:
    """Raise PlanError for a protected green against another, or against the yellow that clears one.

    Who had green without protection yields while its yellow clears it, as it did before.
    """
    for a in (signal for signal, letter in enumerate(state) if letter == "G"):
        for b, foe in enumerate(junction.conflicts[a]):
            if foe and protected[b]:
                both = "are both green" if state[b] == "G" else "are open together, one of them still clearing"
                raise PlanError(f"junction {junction.id}: signals {min(a, b)} and {max(a, b)} conflict and {both}")
