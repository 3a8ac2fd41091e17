"""SPEC 1's topology as data, and the plain SUMO XML that is written from it.

Coordinates are in link lengths, x east and y north.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as ET

JUNCTIONS = {
    "J1": (1, 2), "J2": (2, 2), "J3": (3, 2), "J4": (0, 1),
    "J5": (1, 1), "J6": (2, 1), "J7": (3, 1), "J8": (2, 0),
}  # fmt: skip
SOURCES = {
    "in1": (1, 3), "in3": (0, 2), "in6": (4, 2), "in8": (-1, 1),
    "in9": (0, 0), "in15": (3, 0), "in16": (2, -1), "in17": (1, 0),
}  # fmt: skip
# An exit's road is half a link long, so that no two nodes coincide.
EXITS = {
    "W1": ("J1", (-0.5, 0)), "N1": ("J1", (0, 0.5)), "N2": ("J2", (0, 0.5)), "N3": ("J3", (0, 0.5)),
    "N4": ("J4", (0, 0.5)), "S5": ("J5", (0, -0.5)), "E7": ("J7", (0.5, 0)), "E8": ("J8", (0.5, 0)),
}  # fmt: skip

# link: (from, to, {next link or exit: fraction}).
LINKS: dict[str, tuple[str, str, dict[str, float]]] = {
    "1": ("in1", "J1", {"W1": 0.30, "10": 0.70}),
    "2": ("J2", "J1", {"N1": 0.20, "W1": 0.40, "10": 0.40}),
    "3": ("in3", "J1", {"10": 0.80, "N1": 0.20}),
    "4": ("J3", "J2", {"N2": 0.40, "2": 0.60}),
    "5": ("J6", "J2", {"N2": 0.50, "2": 0.50}),
    "6": ("in6", "J3", {"N3": 0.30, "4": 0.70}),
    "7": ("J7", "J3", {"N3": 0.50, "4": 0.50}),
    "8": ("in8", "J4", {"11": 0.70, "N4": 0.30}),
    "9": ("in9", "J4", {"11": 0.50, "N4": 0.50}),
    "10": ("J1", "J5", {"S5": 0.50, "12": 0.50}),
    "11": ("J4", "J5", {"S5": 0.40, "12": 0.60}),
    "12": ("J5", "J6", {"14": 0.50, "5": 0.50}),
    "13": ("J8", "J6", {"14": 0.40, "5": 0.60}),
    "14": ("J6", "J7", {"E7": 0.60, "7": 0.40}),
    "15": ("in15", "J7", {"E7": 0.40, "7": 0.60}),
    "16": ("in16", "J8", {"E8": 0.30, "13": 0.70}),
    "17": ("in17", "J8", {"E8": 0.50, "13": 0.50}),
}
LANES = 2
LENGTH_M = {"utn17": 400.0, "utn17-long": 3750.0}
FREE_SPEED_M_S = 40 / 3.6


def write_plain(name: str, folder: Path) -> None:
    """Write nodes, edges, types, connections and turning fractions of plant `name` into `folder`."""
    unit = LENGTH_M[name]
    nodes = ET.Element("nodes")
    edges = ET.Element("edges")
    connections = ET.Element("connections")
    types = ET.Element("types")
    turns = ET.Element("data")
    interval = ET.SubElement(turns, "interval", id="turning", begin="0", end="1000000")
    ET.SubElement(types, "type", id="street", numLanes=str(LANES), speed=f"{FREE_SPEED_M_S:.4f}", priority="1")

    def node(node_id: str, x: float, y: float, kind: str) -> None:
        ET.SubElement(nodes, "node", id=node_id, x=f"{x * unit:.2f}", y=f"{y * unit:.2f}", type=kind)

    def edge(edge_id: str, start: str, end: str) -> None:
        ET.SubElement(edges, "edge", {"id": edge_id, "from": start, "to": end, "type": "street"})

    for junction, (x, y) in JUNCTIONS.items():
        node(junction, x, y, "traffic_light")
    for source, (x, y) in SOURCES.items():
        node(source, x, y, "dead_end")
    for exit_id, (junction, (dx, dy)) in EXITS.items():
        x, y = JUNCTIONS[junction]
        node(f"out{exit_id}", x + dx, y + dy, "dead_end")
        edge(exit_id, junction, f"out{exit_id}")
    for link, (start, end, fractions) in LINKS.items():
        edge(link, start, end)
        for target, fraction in fractions.items():
            ET.SubElement(
                interval,
                "edgeRelation",
                {"from": link, "to": target, "probability": f"{fraction:.2f}"},
            )
            # Which lanes a turn may use is left to netconvert, which shares them among the turns.
            ET.SubElement(connections, "connection", {"from": link, "to": target})
    folder.mkdir(parents=True, exist_ok=True)
    for root, suffix in (
        (nodes, "nod"), (edges, "edg"), (connections, "con"), (types, "typ"), (turns, "turns"),
    ):  # fmt: skip
        ET.indent(root)
        (folder / f"{name}.{suffix}.xml").write_text(ET.tostring(root, encoding="unicode") + "\n", encoding="utf-8")
