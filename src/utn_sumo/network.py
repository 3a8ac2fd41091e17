"""A SUMO net read into links, turns, stages and junctions: the one door to sumolib.

A link is the road that leads to a signalled junction, chained upstream through nodes that neither
split nor join traffic. Stages are the programme's phases that show green; what follows each of them is
its clearance, taken from the net and never optimised. Conflicts come from the net's own right-of-way matrix.
"""

from __future__ import annotations

import gzip
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import utn_network
from utn_sumo.contract import EXIT, Junction, Link, Network, Stage, Turn
from utn_sumo.errors import NetworkError, did_you_mean

SPACE_PER_VEHICLE_M = 7.5
"""A standing vehicle and its gap: SUMO's default 5 m + 2.5 m (SPEC 1: 2 * 400 / 7.5 = 106)."""
SATURATION_FLOW_VEH_S_LANE = 0.435
"""Queue discharge per second of green and lane. Measured on eight links of `utn17`: 0.42-0.45, with an intercept
of 0 +- 0.8 veh a cycle, so that what start-up loses the yellow gives back."""
STARTUP_LAG_S = 3.0
"""From green to a moving queue, before calibration."""
MIN_GREEN_S = 10.0


def load(name: str, left_alone: Mapping[str, str] | None = None, additional: Sequence[Path] = ()) -> Network:
    """The shipped network `name`, or the one in the .net.xml file that `name` is a path of.

    Signals in `left_alone` keep the net's own programme, for the reason given there. Signal programmes in `additional`
    files stand for the net's own, the last one read for each signal, as in SUMO.

    Turning fractions are read from NAME.turns.xml beside the net (SUMO's edgeRelations); without the file every
    lane-to-lane connection of a link is taken to carry the same share.
    """
    if name in utn_network.names():
        return read(utn_network.net_file(name), name)
    path = Path(name)
    if not path.is_file():
        known = did_you_mean(name, utn_network.names())
        raise NetworkError(f"net {name!r}: neither a shipped net nor a file; {known}")
    return read(path, path.name.removesuffix(".gz").removesuffix(".xml").removesuffix(".net"), left_alone, additional)


def read(path: Path, name: str, excluded: Mapping[str, str] | None = None, additional: Sequence[Path] = ()) -> Network:
    """Read one net file. Raises NetworkError with one line if it can't be used."""
    import sumolib  # noqa: PLC0415 - heavy, and only this door needs it

    _refuse_entities(path)
    try:
        net = sumolib.net.readNet(
            str(path), withPrograms=True, withLatestPrograms=True, withFoes=True, withInternal=False
        )
    except Exception as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise NetworkError(
            f"net {str(path)!r} can't be read ({reason}): give a .net.xml written by netconvert"
        ) from error
    signals = sorted(net.getTrafficLights(), key=lambda tls: _natural(tls.getID()))
    if not signals:
        raise NetworkError(f"net {str(path)!r} has no traffic lights: there is nothing to control")
    programmes = {tls.getID(): _own_programme(tls) for tls in signals} | _programmes_in(additional)
    reasons_of = {
        tls.getID(): (excluded or {}).get(tls.getID()) or _why_left_alone(programmes[tls.getID()]) for tls in signals
    }
    left_alone = {signal: reason for signal, reason in reasons_of.items() if reason}
    controlled = [tls for tls in signals if tls.getID() not in left_alone]
    if not controlled:
        reasons = "; ".join(f"{signal}: {reason}" for signal, reason in left_alone.items())
        raise NetworkError(f"net {str(path)!r} has no signals that can be controlled ({reasons})")
    reader = _Reader(net, controlled, programmes, _read_fractions(path))
    return reader.network(path.resolve(), name, left_alone)


@dataclass(frozen=True)
class Programme:
    """A signal programme: its phases as (letters, seconds), those alike in a row as one."""

    phases: tuple[tuple[str, float], ...]
    offset_s: float

    @classmethod
    def of(cls, phases: Iterable[tuple[str, float]], offset_s: float) -> Programme:
        """Of the phases as they are written."""
        grouped = groupby(phases, key=lambda phase: phase[0])
        return cls(tuple((state, sum(seconds for _, seconds in group)) for state, group in grouped), offset_s)


def _own_programme(tls: Any) -> Programme | None:
    """The net's own for a signal, if it has one."""
    program = next(iter(tls.getPrograms().values()), None)
    if program is None:
        return None
    return Programme.of(((phase.state, float(phase.duration)) for phase in program.getPhases()), program.getOffset())


def _programmes_in(files: Sequence[Path]) -> dict[str, Programme]:
    """Signal programmes in additional files, by signal."""
    from defusedxml import ElementTree  # noqa: PLC0415

    found = {}
    for file in files:
        with gzip.open(file) if file.suffix == ".gz" else file.open("rb") as content:
            logics = [logic for logic in ElementTree.parse(content).iter("tlLogic") if logic.find("phase") is not None]
        for logic in logics:
            try:
                shown = [(phase.get("state", ""), float(phase.get("duration", ""))) for phase in logic.iter("phase")]
                found[logic.get("id")] = Programme.of(shown, float(logic.get("offset", "0")))
            except ValueError as error:
                raise NetworkError(
                    f"additional file {str(file)!r}: the programme of {logic.get('id')!r} has times that are no numbers"
                    f" ({error}): give seconds"
                ) from error
    return found


def shapes(path: Path) -> dict[str, list[tuple[float, float]]]:
    """The course of every road of a net file [m], by its edge, for drawing."""
    import sumolib  # noqa: PLC0415 - heavy, and only this door needs it

    return {edge.getID(): list(edge.getShape()) for edge in sumolib.net.readNet(str(path)).getEdges()}


def _why_left_alone(programme: Programme | None) -> str:
    """Why a signal can't be controlled; empty if it can."""
    if programme is None:
        return "it has no signal programme, as rail signals have none"
    greens = sum(_is_green(state) for state, _ in programme.phases)
    if greens == 0:
        return "no phase of its programme shows green without yellow"
    return "its programme has one stage: there is nothing to share out" if greens == 1 else ""


def _refuse_entities(path: Path) -> None:
    """Raise NetworkError for a file that declares a document type: nets have none, and entities can blow up."""
    from defusedxml import ElementTree  # noqa: PLC0415
    from defusedxml.common import DefusedXmlException  # noqa: PLC0415

    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            next(ElementTree.iterparse(file, events=("start",), forbid_dtd=True))
    except DefusedXmlException as error:
        raise NetworkError(
            f"net {str(path)!r} declares a document type, which may hide entities: give one that netconvert wrote"
        ) from error
    except (ElementTree.ParseError, OSError, EOFError, StopIteration) as error:
        reason = str(error) or "it is empty"
        raise NetworkError(
            f"net {str(path)!r} can't be read ({reason}): give a .net.xml written by netconvert"
        ) from error


class _Reader:
    """Builds the index spaces in the order links, turns, stages, junctions."""

    def __init__(
        self,
        net: Any,
        signals: list[Any],
        programmes: Mapping[str, Programme | None],
        fractions: dict[tuple[str, str], float],
    ):
        self.net = net
        self.programmes = programmes
        self.signals = signals
        self.fractions = fractions
        # Approach edge -> position of the junction that it enters.
        self.junction_of = {
            connection[0].getEdge().getID(): position
            for position, tls in enumerate(signals)
            for connection in tls.getConnections()
        }
        self.approaches = sorted(self.junction_of, key=_natural)
        self.chains = {edge: self._chain(edge) for edge in self.approaches}
        self.link_of_edge = {
            member: index for index, edge in enumerate(self.approaches) for member in self.chains[edge]
        }

    def network(self, path: Path, name: str, left_alone: Mapping[str, str]) -> Network:
        turns = self._turns()
        fed = {turn.next_link for turn in turns}
        links = tuple(self._link(edge, index in fed) for index, edge in enumerate(self.approaches))
        turn_index = {(turn.link, turn.to_edge): index for index, turn in enumerate(turns)}
        stages: list[Stage] = []
        junctions: list[Junction] = []
        for position, tls in enumerate(self.signals):
            signal_turn = self._signal_turns(tls, turn_index)
            programme = self.programmes[tls.getID()]
            assert programme is not None
            phases, begin_s = _from_first_green(programme.phases)
            first = len(stages)
            stages += _stages(phases, position, signal_turn)
            junctions.append(
                Junction(
                    id=tls.getID(),
                    stages=tuple(range(first, len(stages))),
                    cycle_s=sum(seconds for _, seconds in phases),
                    offset_s=float(programme.offset_s) + begin_s,
                    min_green_s=MIN_GREEN_S,
                    signal_turn=tuple(signal_turn),
                    conflicts=self._conflicts(tls, len(signal_turn)),
                )
            )
        edges = {edge for link in links for edge in link.edges} | {turn.to_edge for turn in turns}
        return Network(
            name,
            path,
            links,
            tuple(turns),
            tuple(stages),
            tuple(junctions),
            edge_lanes={edge: self.net.getEdge(edge).getLaneNumber() for edge in sorted(edges)},
            edge_length_m={edge: self.net.getEdge(edge).getLength() for edge in sorted(edges)},
            startup_lag_s=STARTUP_LAG_S,
            left_alone=left_alone,
        )

    def _chain(self, approach: str) -> tuple[str, ...]:
        """The approach and the edges upstream of it as long as one edge leads only to the next."""
        chain = [approach]
        while True:
            incoming = list(self.net.getEdge(chain[0]).getIncoming())
            if len(incoming) != 1 or incoming[0].getID() in self.junction_of:
                return tuple(chain)
            before = incoming[0]
            if len(before.getOutgoing()) != 1 or before.getID() in chain:
                return tuple(chain)
            chain.insert(0, before.getID())

    def _link(self, edge_id: str, fed: bool) -> Link:
        edges = [self.net.getEdge(member) for member in self.chains[edge_id]]
        last = edges[-1]
        lane_m = sum(edge.getLength() * edge.getLaneNumber() for edge in edges)
        length = sum(edge.getLength() for edge in edges)
        return Link(
            id=edge_id,
            edges=self.chains[edge_id],
            junction=self.junction_of[edge_id],
            lanes=last.getLaneNumber(),
            length_m=length,
            free_speed_m_s=length / sum(edge.getLength() / edge.getSpeed() for edge in edges),
            storage_veh=lane_m / SPACE_PER_VEHICLE_M,
            queue_spacing_m=SPACE_PER_VEHICLE_M * length / lane_m,
            saturation_flow_veh_s=last.getLaneNumber() * SATURATION_FLOW_VEH_S_LANE,
            is_source=not fed,
        )

    def _turns(self) -> list[Turn]:
        turns = []
        for index, edge_id in enumerate(self.approaches):
            outgoing = self.net.getEdge(edge_id).getOutgoing()
            targets = sorted(outgoing, key=lambda edge: _natural(edge.getID()))
            lanes = [len(outgoing[edge]) for edge in targets]
            given = [self.fractions.get((edge_id, edge.getID())) for edge in targets]
            if any(value is not None for value in given):
                weights = [value or 0.0 for value in given]
            else:
                weights = [float(count) for count in lanes]
            total = sum(weights)
            if total <= 0:
                raise NetworkError(f"link {edge_id!r}: its turning fractions sum to {total}: give it some")
            turns += [
                Turn(index, edge.getID(), self._fed_link(edge.getID()), weight / total, _via_lanes(outgoing[edge]))
                for edge, weight in zip(targets, weights, strict=True)
            ]
        return turns

    def _fed_link(self, edge_id: str) -> int:
        """The link that traffic on `edge_id` reaches with no choice left to it, or EXIT."""
        visited = set()
        while edge_id not in self.link_of_edge:
            outgoing = list(self.net.getEdge(edge_id).getOutgoing())
            if len(outgoing) != 1 or edge_id in visited:
                return EXIT
            visited.add(edge_id)
            edge_id = outgoing[0].getID()
        return self.link_of_edge[edge_id]

    def _signal_turns(self, tls: Any, turn_index: dict[tuple[int, str], int]) -> list[int]:
        size = 1 + max(index for _, _, index in tls.getConnections())
        result = [-1] * size
        for from_lane, to_lane, index in tls.getConnections():
            link = self.approaches.index(from_lane.getEdge().getID())
            result[index] = turn_index[link, to_lane.getEdge().getID()]
        return result

    def _conflicts(self, tls: Any, size: int) -> tuple[tuple[bool, ...], ...]:
        matrix = [[False] * size for _ in range(size)]
        streams = []
        for from_lane, to_lane, index in tls.getConnections():
            node = from_lane.getEdge().getToNode()
            connection = next(c for c in from_lane.getOutgoing() if c.getToLane() == to_lane)
            streams.append((node, node.getLinkIndex(connection), index))
        for node_a, request_a, a in streams:
            for node_b, request_b, b in streams:
                if node_a == node_b and a != b and node_a.areFoes(request_a, request_b):
                    matrix[a][b] = matrix[b][a] = True
        return tuple(tuple(row) for row in matrix)


def _from_first_green(phases: Sequence[tuple[str, float]]) -> tuple[list[tuple[str, float]], float]:
    """A programme's phases from its first green one on, round the cycle, and when in the cycle that one begins [s]."""
    first = next(index for index, (state, _) in enumerate(phases) if _is_green(state))
    return [*phases[first:], *phases[:first]], float(sum(seconds for _, seconds in phases[:first]))


def _stages(phases: list[tuple[str, float]], junction: int, signal_turn: list[int]) -> list[Stage]:
    """Cut a programme that opens with green into stages: a green phase with the phases up to the next green one."""
    starts = [i for i, (state, _) in enumerate(phases) if _is_green(state)]
    stages = []
    for start, end in pairwise([*starts, len(phases)]):
        green = phases[start][0]
        served = {signal_turn[i] for i, letter in enumerate(green) if letter in "Gg" and signal_turn[i] >= 0}
        clearance = tuple(phases[start + 1 : end])
        stages.append(Stage(junction, green, clearance, tuple(sorted(served))))
    return stages


def _via_lanes(connections: list[Any]) -> tuple[str, ...]:
    lanes = [connection.getViaLaneID() for connection in connections]
    if not all(lanes):
        edge = connections[0].getFrom().getID()
        raise NetworkError(f"link {edge!r} has no lanes inside its junction: build the net with internal links")
    return tuple(sorted(lanes))


def _is_green(state: str) -> bool:
    return any(letter in "Gg" for letter in state) and not any(letter in "yYu" for letter in state)


def _read_fractions(net_path: Path) -> dict[tuple[str, str], float]:
    """Turning fractions by (from edge, to edge) from the file beside the net, empty without one."""
    from defusedxml import ElementTree  # noqa: PLC0415
    from defusedxml.common import DefusedXmlException  # noqa: PLC0415

    stem = net_path.name.removesuffix(".gz").removesuffix(".xml").removesuffix(".net")
    path = net_path.with_name(f"{stem}.turns.xml")
    if not path.is_file():
        return {}
    try:
        relations = ElementTree.parse(path).iter("edgeRelation")
        fractions = {(r.get("from"), r.get("to")): float(r.get("probability")) for r in relations}
    except (ElementTree.ParseError, DefusedXmlException, TypeError, ValueError) as error:
        raise NetworkError(f"turning fractions {str(path)!r} can't be read ({error})") from error
    for (start, end), value in fractions.items():
        if not 0 <= value < math.inf:
            raise NetworkError(f"turning fractions {str(path)!r}: {start} to {end} is {value:g}: give 0 or more")
    return fractions


def _natural(text: str) -> tuple[int, int, str]:
    """Sort key that puts '2' before '10' and numbers before names."""
    return (0, int(text), "") if text.isdecimal() else (1, 0, text)
