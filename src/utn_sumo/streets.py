"""The network that runs are of: a shipped one, a net file's, or that of somebody else's scenario."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from utn_sumo import case, network, routes, signals
from utn_sumo.case import SUFFIX, Case
from utn_sumo.contract import Network
from utn_sumo.errors import SettingError


def named(name: str) -> Network:
    """The network of a shipped net, a net file, or a .sumocfg. Raises UtnError."""
    return controllable(case.read(Path(name))) if name.endswith(SUFFIX) else network.load(name)


def controllable(chosen: Case) -> Network:
    """A net as other people have it, with the signals left alone whose own stages can't be shown safely.

    Offsets count from the begin of the case's window.

    Raises SettingError for a mesoscopic case, where there are no lanes to watch.
    """
    if dict(chosen.options).get("mesosim", "false") == "true":
        raise SettingError(
            f"scenario {str(chosen.file)!r} has mesosim, which knows no lanes: leave it out, or use --controller native"
        )
    name, additional, coming = str(chosen.net_file), chosen.additional_files, routes.read(chosen)
    net = network.load(name, None, additional, coming)
    refused = signals.refused(net)
    if refused:
        net = network.load(name, refused, additional, coming)
    # Our clock begins where the window does.
    junctions = (replace(each, offset_s=(each.offset_s - chosen.begin_s) % each.cycle_s) for each in net.junctions)
    return replace(net, junctions=tuple(junctions))
