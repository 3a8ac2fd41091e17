"""The traffic of a scenario: drawn from its profile, or what a .sumocfg of somebody else's brings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from utn_sumo import case, demand, routes
from utn_sumo.case import Case
from utn_sumo.contract import Network
from utn_sumo.errors import SettingError
from utn_sumo.scenario import Scenario


def drawn(scenario: Scenario, network: Network) -> Path:
    """The route file of the scenario's own demand on a network."""
    return demand.route_file(
        network,
        profile=scenario.profile,
        duration_s=scenario.duration_s,
        step_s=network.control_step_s,
        scale=scenario.demand,
        noise=scenario.noise,
        seed=scenario.seed,
        disturbance_veh_h=scenario.disturbance,
    )


def given(scenario: Scenario) -> Case:
    """The case of a .sumocfg; `demand` scales all of its traffic, `hours` is the most of its window that is run.

    Raises SettingError if it can't be used, or if its vehicles drive where its net has no roads.
    """
    for name in ("profile", "noise", "disturbance"):
        if name in scenario.model_fields_set:
            value = getattr(scenario, name)
            raise SettingError(f"setting {name!r} is {value!r}: {scenario.net!r} has a demand of its own, leave it out")
    found = case.read(Path(scenario.net))
    end_s = found.end_s
    if "hours" in scenario.model_fields_set:
        wished_s = found.begin_s + scenario.duration_s
        end_s = wished_s if end_s is None else min(end_s, wished_s)
    options = dict(found.options)
    if scenario.demand != 1:
        options["scale"] = f"{scenario.demand * found.scale:g}"
    chosen = replace(found, end_s=end_s, options=tuple(options.items()))
    coming = routes.read(chosen)
    routes.check(chosen, coming)
    return replace(chosen, called=coming.called)
