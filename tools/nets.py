"""Networks to measure scale on: one-way grids made of nothing but the contract, and netgenerate's two-way ones."""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

import numpy as np

from utn_sumo import network, sumo_tools
from utn_sumo.contract import EXIT, Junction, LaneGroup, LaneSet, Link, Network, Stage, Turn

CYCLE_S, MIN_GREEN_S, YELLOW_S, ALL_RED_S = 120.0, 10.0, 3.0, 2.0
FREE_SPEED_M_S, SPACING_M, LANE_VEH_S = 40 / 3.6, 7.5, 0.5
SIDE_STREETS = 0.3
"""Share of the junctions with a third link, a side street from outside."""
SIZES = {100: (10, 10), 400: (20, 20), 1000: (25, 40)}
"""Rows and columns of the grids by their number of junctions."""


def one_way_grid(rows: int, columns: int, seed: int = 1) -> Network:
    """A grid of one-way streets in alternating directions, two or three links a junction, as `utn17` has them.

    Lengths, lanes, turning fractions and side streets are drawn; there is no file behind it and no SUMO.
    """
    rng = np.random.default_rng([seed, rows, columns])
    links: list[Link] = []
    place: dict[tuple[str, int, int], int] = {}

    def add(kind: str, row: int, column: int, *, source: bool) -> None:
        lanes, length_m = int(rng.integers(1, 4)), float(rng.uniform(200, 500))
        place[kind, row, column] = len(links)
        links.append(
            Link(
                id=f"{kind}{row}.{column}",
                edges=(f"{kind}{row}.{column}",),
                junction=row * columns + column,
                lanes=lanes,
                length_m=length_m,
                free_speed_m_s=FREE_SPEED_M_S,
                storage_veh=lanes * length_m / SPACING_M,
                queue_spacing_m=SPACING_M / lanes,
                saturation_flow_veh_s=LANE_VEH_S * lanes,
                is_source=source,
                turning_worth_veh=200.0,
            )
        )

    for row in range(rows):
        for column in range(columns):
            add("h", row, column, source=column == (0 if row % 2 == 0 else columns - 1))
            add("v", row, column, source=row == (0 if column % 2 == 0 else rows - 1))
            if rng.uniform() < SIDE_STREETS:
                add("s", row, column, source=True)

    turns: list[Turn] = []
    groups = [LaneGroup(index, tuple(range(link.lanes))) for index, link in enumerate(links)]
    lane_sets: list[LaneSet] = []
    stages: list[Stage] = []
    junctions: list[Junction] = []
    for row in range(rows):
        for column in range(columns):
            along = place.get(("h", row, column + (1 if row % 2 == 0 else -1)), EXIT)
            across = place.get(("v", row + (1 if column % 2 == 0 else -1), column), EXIT)
            here = [place[kind, row, column] for kind in "hvs" if (kind, row, column) in place]
            first_turn, first_stage = len(turns), len(stages)
            for position, link in enumerate(here):
                ahead = float(rng.uniform(0.55, 0.85))
                share_along = 1 - ahead if links[link].id.startswith("v") else ahead
                served: list[int] = []
                for next_link, share in ((along, share_along), (across, 1 - share_along)):
                    served.append(len(turns))
                    to_edge = links[next_link].id if next_link != EXIT else f"exit{row}.{column}"
                    turns.append(Turn(link, to_edge, next_link, share, (), (), link))
                own = tuple((2 * position + place,) for place in range(2))
                lane_sets.append(LaneSet(link, groups[link].lanes, tuple(served), own))
                letters = "".join("G" if other == position else "r" for other in range(len(here)) for _ in range(2))
                clearance = ((letters.replace("G", "y"), YELLOW_S), ("r" * len(letters), ALL_RED_S))
                stages.append(
                    Stage(row * columns + column, letters, clearance, tuple(served), MIN_GREEN_S, MIN_GREEN_S)
                )
            count = len(turns) - first_turn
            junctions.append(
                Junction(
                    id=f"{row}.{column}",
                    stages=tuple(range(first_stage, len(stages))),
                    cycle_s=CYCLE_S,
                    offset_s=0.0,
                    signal_turns=tuple((turn,) for turn in range(first_turn, len(turns))),
                    conflicts=tuple(tuple(a // 2 != b // 2 for b in range(count)) for a in range(count)),
                )
            )
    return Network(
        name=f"grid{rows}x{columns}",
        net_file=Path(),
        links=tuple(links),
        turns=tuple(turns),
        groups=tuple(groups),
        lane_sets=tuple(lane_sets),
        stages=tuple(stages),
        junctions=tuple(junctions),
        edge_lanes={link.id: tuple(range(link.lanes)) for link in links},
        edge_length_m={link.id: link.length_m for link in links},
        startup_lag_s=2.0,
    )


def imported_grid(rows: int, columns: int) -> Network:
    """A two-way grid by netgenerate, four approaches and four stages a junction, read as any SUMO net is."""
    with tempfile.TemporaryDirectory() as temporary:
        file = Path(temporary) / f"two-way{rows}x{columns}.net.xml"
        subprocess.run(
            [
                sumo_tools.sumo_binary("netgenerate"),
                *("--grid", "--grid.x-number", str(columns), "--grid.y-number", str(rows)),
                *("--grid.length", "300", "--grid.attach-length", "300", "--default.lanenumber", "2"),
                *("--default-junction-type", "traffic_light", "--tls.layout", "incoming", "--no-turnarounds", "true"),
                *("--tls.yellow.time", "3", "--tls.allred.time", "2", "--tls.cycle.time", "120"),
                *("--seed", "1", "--output-file", str(file)),
            ],
            check=True,
            capture_output=True,
        )
        return network.load(str(file))
