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


def named(name: str) -> Network:
    """The network of a shipped net, a net file, or a .sumocfg, as `controllable`. Raises UtnError."""
    return controllable(case.read(Path(name))) if name.endswith(SUFFIX) else _with_refused_left_alone(name)


def controllable(chosen: Case) -> Network:
    """A net as other people have it, with the signals left alone whose own stages can't be shown safely.

    Offsets count from the begin of the case's window.

    Raises SettingError for a mesoscopic case, where there are no lanes to watch.
    """
    if dict(chosen.options).get("mesosim", "false") == "true":
        raise SettingError(
            f"scenario {str(chosen.file)!r} has mesosim, which knows no lanes: leave it out, or use --controller native"
        )
    net = _with_refused_left_alone(str(chosen.net_file), chosen.additional_files, routes.read(chosen))
    # Our clock begins where the window does.
    junctions = (replace(each, offset_s=(each.offset_s - chosen.begin_s) % each.cycle_s) for each in net.junctions)
    return replace(net, junctions=tuple(junctions))


def _with_refused_left_alone(name: str, additional: Sequence[Path] = (), coming: Traffic | None = None) -> Network:
    net = network.load(name, None, additional, coming)
    refused = signals.refused(net)
    return network.load(name, refused, additional, coming) if refused else net
