"""The network that runs are of: a shipped one, a net file's, or that of somebody else's scenario."""

from __future__ import annotations

from pathlib import Path

from utn_sumo import case, network, routes, signals
from utn_sumo.case import SUFFIX, Case
from utn_sumo.contract import Network
from utn_sumo.errors import SettingError


def named(name: str) -> Network:
    """The network of a shipped net, a net file, or a .sumocfg. Raises UtnError."""
    return controllable(case.read(Path(name))) if name.endswith(SUFFIX) else network.load(name)


def controllable(chosen: Case, usual_green_s: float = network.MIN_GREEN_S) -> Network:
    """A net as other people have it, with the signals left alone whose own stages can't be shown safely.

    A stage for which the net names no least green has `usual_green_s`. Raises SettingError for a mesoscopic case, where
    there are no lanes to watch.
    """
    if dict(chosen.options).get("mesosim", "false") == "true":
        raise SettingError(
            f"scenario {str(chosen.file)!r} has mesosim, which knows no lanes: leave it out, or use --controller native"
        )
    name, additional, coming = str(chosen.net_file), chosen.additional_files, routes.read(chosen)
    net = network.load(name, None, additional, coming, usual_green_s)
    refused = signals.refused(net)
    return network.load(name, refused, additional, coming, usual_green_s) if refused else net
