"""What the bench makes of a net: junctions and links as tables of plain data, and what it leaves alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from utn_sumo import signals
from utn_sumo.contract import EXIT, Network


def inspect(network: Network) -> dict[str, Any]:
    """`junctions`, `links` and `left_alone`, under names that carry their units."""
    refused = signals.refused(network)
    return {
        "net": network.name,
        "control_step_s": network.control_step_s,
        "junctions": [_junction(network, index, refused) for index in range(len(network.junctions))],
        "links": [_link(network, index) for index in range(len(network.links))],
        "left_alone": dict(network.left_alone),
    }


def _junction(network: Network, index: int, refused: Mapping[str, str]) -> dict[str, Any]:
    junction, part = network.junctions[index], network.part(index)
    return {
        "id": junction.id,
        "cycle_s": junction.cycle_s,
        "offset_s": junction.offset_s,
        "stages": [
            {
                "state": stage.state,
                "min_green_s": stage.min_green_s,
                "clearance": [{"state": state, "duration_s": seconds} for state, seconds in stage.clearance],
            }
            for stage in part.stages
        ],
        "green_budget_s": float(part.green_budget_s[0]),
        "links": [link.id for link in part.links],
        "refused": refused.get(junction.id, ""),
        "made_to_yield": list(junction.made_to_yield),
        "given_yellow": list(junction.given_yellow),
        "kept_waiting": list(junction.kept_waiting),
        "never_green": network.never_green.get(junction.id, []),
    }


def _link(network: Network, index: int) -> dict[str, Any]:
    link = network.links[index]
    turns = [turn for turn in network.turns if turn.link == index]
    groups = sorted({turn.group for turn in turns})
    return {
        "id": link.id,
        "junction": network.junctions[link.junction].id,
        "edges": list(link.edges),
        "lanes": link.lanes,
        "length_m": link.length_m,
        "free_speed_m_s": link.free_speed_m_s,
        "storage_veh": link.storage_veh,
        "saturation_flow_veh_h": 3600 * link.saturation_flow_veh_s,
        "is_source": link.is_source,
        "side_roads": {"joining": len(link.joining), "parting": len(link.parting)},
        "lane_groups": [
            {
                "lanes": list(network.groups[group].lanes),
                "turns": [turn.to_edge for turn in turns if turn.group == group],
            }
            for group in groups
        ],
        "turns": {
            turn.to_edge: {
                "next_link": None if turn.next_link == EXIT else network.links[turn.next_link].id,
                "fraction": turn.fraction,
            }
            for turn in turns
        },
    }
