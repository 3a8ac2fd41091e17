"""The network that runs are of: a shipped one, a net file's, or that of somebody else's scenario."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from utn_sumo import case, network, routes, signals
from utn_sumo.case import SUFFIX, Case
from utn_sumo.contract import Network
from utn_sumo.errors import SettingError
from utn_sumo.network import Traffic

WHOLE = 1e-6
"""By how much a number of steps in a second may be off."""


def named(name: str) -> Network:
    """The network of a shipped net, a net file, or a .sumocfg, as `controllable`. Raises UtnError."""
    return controllable(case.read(Path(name))) if name.endswith(SUFFIX) else _with_refused_left_alone(name)


def controllable(chosen: Case, usual_green_s: float = network.MIN_GREEN_S) -> Network:
    """A net as other people have it, with the signals left alone whose own stages can't be shown safely.

    Offsets count from the begin of the case's window. A stage for which the net names no least green has
    `usual_green_s`.

    Raises SettingError for a mesoscopic case, where there are no lanes to watch, and for steps with which signals can't
    be switched to the second.
    """
    if chosen.switches_on("mesosim"):
        raise SettingError(
            f"scenario {str(chosen.file)!r} has mesosim, which knows no lanes: leave it out, or use --controller native"
        )
    # Greens and yellows end where a step does: with others they would be up to a step too short.
    if chosen.step_s > 1 or abs(1 / chosen.step_s - round(1 / chosen.step_s)) > WHOLE:
        raise SettingError(
            f"scenario {str(chosen.file)!r} has a step-length of {chosen.step_s:g} s: signals are switched to the "
            "second, make it 1 s or a whole part of it, such as 0.5 or 0.2 s, or use --controller native"
        )
    net = _with_refused_left_alone(str(chosen.net_file), chosen.additional_files, routes.read(chosen), usual_green_s)
    # Our clock begins where the window does.
    junctions = (replace(each, offset_s=(each.offset_s - chosen.begin_s) % each.cycle_s) for each in net.junctions)
    return replace(net, junctions=tuple(junctions))


def taken_over(chosen: Case, usual_green_s: float = network.MIN_GREEN_S) -> Network:
    """The same for a run whose signals are switched by somebody else than the net's own programmes.

    Raises SettingError too for one that begins with a saved state: what has green in it would lose it without yellow.
    """
    if dict(chosen.options).get("load-state"):
        raise SettingError(
            f"scenario {str(chosen.file)!r} has load-state, which has signals amid programmes of its own: leave it out "
            "and begin earlier, or use --controller native"
        )
    return controllable(chosen, usual_green_s)


def _with_refused_left_alone(
    name: str,
    additional: Sequence[Path] = (),
    coming: Traffic | None = None,
    usual_green_s: float = network.MIN_GREEN_S,
) -> Network:
    net = network.load(name, None, additional, coming, usual_green_s)
    refused = signals.refused(net)
    return network.load(name, refused, additional, coming, usual_green_s) if refused else net
