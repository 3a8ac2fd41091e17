"""Junctions with clocks of their own (SPEC 2.7): cycles of 60, 90 and 120 s, with offsets, in plant, model, control."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from utn_sumo import bridge, calibration, network, recording
from utn_sumo.contract import EXIT, Floats, Network
from utn_sumo.model import LinkModel, green_windows
from utn_sumo.rollout import Outside, observe
from utn_sumo.scenario import scenario

CYCLES_S = {"J1": 120, "J2": 60, "J3": 90, "J4": 60, "J5": 120, "J6": 90, "J7": 60, "J8": 90}
OFFSETS_S = {"J1": 0, "J2": 20, "J3": 40, "J4": 0, "J5": 30, "J6": 50, "J7": 10, "J8": 70}
COMMON_S = 360.0
SAMPLE_S = 10.0


@pytest.fixture(scope="module")
def retimed(utn17: Network, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """utn17 with those cycles and offsets in its signal programmes."""
    folder = tmp_path_factory.mktemp("retimed")
    tree = ET.parse(utn17.net_file)
    for logic in tree.iter("tlLogic"):
        phases = list(logic.iter("phase"))
        green = [phase for phase in phases if "G" in phase.get("state", "") and "y" not in phase.get("state", "")]
        lost = sum(float(phase.get("duration", 0)) for phase in phases if phase not in green)
        share, rest = divmod(int(CYCLES_S[logic.get("id", "")] - lost), len(green))
        for position, phase in enumerate(green):
            phase.set("duration", str(share + (position < rest)))
        logic.set("offset", str(OFFSETS_S[logic.get("id", "")]))
    stem = utn17.net_file.name.removesuffix(".net.xml")
    tree.write(folder / f"{stem}.net.xml")
    for name in (f"{stem}.turns.xml", f"{stem}.calibration.json"):
        shutil.copyfile(utn17.net_file.with_name(name), folder / name)
    return folder / f"{stem}.net.xml"


@pytest.fixture(scope="module", params=["fixed", "dmpc"])
def made(request: pytest.FixtureRequest, retimed: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Path]:
    folder = tmp_path_factory.mktemp("mixed") / request.param
    item = scenario(net=str(retimed), controller=request.param, hours=1.5, demand=0.9, seed=3)
    return bridge.run(item, folder), folder


def test_the_clocks_meet_every_six_minutes(retimed: Path) -> None:
    net = network.load(str(retimed))
    assert net.control_step_s == COMMON_S
    assert dict(zip([junction.id for junction in net.junctions], net.cycle_s, strict=True)) == CYCLES_S
    assert [junction.offset_s for junction in net.junctions] == list(OFFSETS_S.values())


def test_controllers_run_it_safely_and_without_a_fallback(made: tuple[Any, Path]) -> None:
    result, _ = made
    assert result["unsafe_signal_s"] == 0
    assert result["fallbacks"] == 0
    assert not result["gridlock"]
    assert result["arrived"] > 3000


def test_every_signal_keeps_its_own_cycle_and_offset(made: tuple[Any, Path]) -> None:
    _, folder = made
    starts: dict[str, list[float]] = {junction: [] for junction in CYCLES_S}
    last: dict[str, str] = {}
    for state in ET.parse(folder / "signals.xml").iter("tlsState"):
        junction, shown = state.get("id", ""), state.get("state", "")
        if shown[0] in "Gg" and last.get(junction, "r")[0] == "r":
            starts[junction].append(float(state.get("time", -1)))
        last[junction] = shown
    for junction, times in starts.items():
        began = np.array([time for time in times if time >= COMMON_S])
        assert len(began) >= 30
        # All starts of the stage that holds signal 0 lie within a cycle of their own clock, one in each.
        cycle = np.floor((began - OFFSETS_S[junction]) / CYCLES_S[junction])
        assert (np.diff(cycle) == 1).all(), junction


def model_inflow_veh(net: Network, folder: Path, step_s: float) -> tuple[Floats, Floats]:
    """(samples, Z) inflow of the model, each control step from the state at its start, and what the loops counted."""
    log = recording.read_log(folder)
    model = LinkModel(net, step_s)
    windows = green_windows(net, log.green_s, step_s)
    outside = Outside.known(net, log)
    steps = windows.shown_s.shape[-2]
    predicted = []
    for k in range(1, len(log.green_s)):
        state = observe(model, log, np.array([k]), outside.source_queue_veh)
        for step in range(steps):
            shown, end = windows.shown_s[k, :, step], windows.end_s[k, :, step]
            state, flows = model.step(state, shown, outside.demand_veh[k] / steps, log.fraction[k], end)
            predicted += [flows.inflow_veh[0, 0] * SAMPLE_S / step_s] * round(step_s / SAMPLE_S)
    return np.array(predicted), np.concatenate(log.entered_by_sample_veh[1:, 0])


def per_cycle(net: Network, flow_veh: Floats, link: int) -> Floats:
    """A link's inflow summed over each cycle of the junction that it enters, offset included."""
    junction = net.junctions[net.links[link].junction]
    first, length = round(junction.offset_s / SAMPLE_S), round(junction.cycle_s / SAMPLE_S)
    whole = (len(flow_veh) - first) // length
    return flow_veh[first : first + whole * length, link].reshape(whole, length).sum(axis=1)


def test_flows_across_the_clocks_are_the_plants(made: tuple[Any, Path], retimed: Path) -> None:
    _, folder = made
    net = calibration.for_model(network.load(str(retimed)), None)
    predicted, counted = model_inflow_veh(net, folder, SAMPLE_S)
    crossing = [
        (int(net.turn_next[turn]), net.junctions[net.links[net.turn_link[turn]].junction].cycle_s)
        for turn in np.flatnonzero(net.turn_next != EXIT)
    ]
    links = sorted({link for link, cycle_s in crossing if cycle_s != net.junctions[net.links[link].junction].cycle_s})
    assert len(links) >= 5
    ratios = []
    for link in links:
        ours, theirs = per_cycle(net, predicted, link), per_cycle(net, counted, link)
        assert ours.mean() == pytest.approx(theirs.mean(), rel=0.15)
        # Nobody knows how the next vehicle turns: the square root of their number is what remains.
        error = np.sqrt(np.mean((ours - theirs) ** 2))
        assert error <= 1.4 * np.sqrt(theirs.mean()), f"link {net.links[link].id}: {error:.1f} veh"
        ratios.append(error / theirs.std())
    assert np.mean(ratios) <= 0.75


def test_the_common_step_carries_the_same_vehicles(made: tuple[Any, Path], retimed: Path) -> None:
    _, folder = made
    net = calibration.for_model(network.load(str(retimed)), None)
    fine, counted = model_inflow_veh(net, folder, SAMPLE_S)
    coarse, _ = model_inflow_veh(net, folder, COMMON_S)
    assert coarse.sum() == pytest.approx(counted.sum(), rel=0.05)
    assert coarse.sum() == pytest.approx(fine.sum(), rel=0.05)
