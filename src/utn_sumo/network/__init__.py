"""SUMO nets read into links, turns, lane groups, stages and junctions: the one door to sumolib."""

from utn_sumo.network.programmes import MIN_GREEN_S
from utn_sumo.network.reader import load, read, shapes
from utn_sumo.network.roads import MOTOR
from utn_sumo.network.ways import Traffic

__all__ = ["MIN_GREEN_S", "MOTOR", "Traffic", "load", "read", "shapes"]
